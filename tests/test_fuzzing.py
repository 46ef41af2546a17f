"""Fuzzing of everything that reads files: damaged and invented files must be read, or refused by
InputError.

Most readers, and the folder of valid files, are shared with `tests.hostile`. The inputs are the
same in each run.
"""

import gzip
import json
from collections.abc import Iterator
from functools import partial

import pytest
from benchmark_folder import RESULT, write_run
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.hostile.harness import READERS_OF, prepare, read_capture
from zsp_lite import InputError
from zsp_lite.benchmark.runs import read_run

pytestmark = pytest.mark.slow

_NAMES = (
    "frame annotations",
    "sequence annotations",
    "label",
    "point cloud",
    "safetensors",
    "nerfstudio",
    "poses",
)
# Every reader, by a name: the valid file, relative to the folder, and the call that reads it.
READERS = {name: READERS_OF[name] for name in _NAMES} | {
    "lists": ("capture/poses.txt", read_capture("lists")),
    "results": ("made/run.jsonl", lambda folder: read_run(folder / "made").summary),
    "settings of a run": ("made/run.json", lambda folder: read_run(folder / "made").summary),
}
# Bytes that break text, numbers, JSON, paths or UTF-8.
_STRANGE_BYTES = st.sampled_from(
    [
        b"",
        b"\0",
        b"\xff",
        b"-1",
        b"1e308",
        b"NaN",
        b"9" * 30,
        b"[",
        b"{",
        b'"',
        b"\n",
        b"#",
        b"/../",
        b"\xed\xa0\x80",
    ]
)
# Beside all others, numbers at the limits: squares that overflow or vanish, integers beyond 64 bits
# and beyond what a double holds exactly.
_NUMBERS = (
    st.integers()
    | st.floats()
    | st.sampled_from([10**30, 1e308, -1e308, 1e155, 1e-300, 0, -1, 2**63, 2**53])
)
# Small JSON documents of any kind.
_VALUES = st.recursive(
    st.none() | st.booleans() | _NUMBERS | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=8,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of the hostile inputs, and a benchmark run without the times and versions of this
    machine."""
    folder = prepare(tmp_path_factory.mktemp("fuzzing"))
    write_run(folder / "made", {"icp": {"cup/a:0/b:1,3": RESULT}}, ["cup"])
    return folder


@st.composite
def mutated(draw, data: bytes) -> bytes:
    """Draw a content in which one to four parts are replaced, removed or repeated."""
    for _ in range(draw(st.integers(1, 4))):
        # Half of the parts are among the first 1500 bytes, where headers are.
        start = draw(st.integers(0, min(len(data), 1500)) | st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 12)))
        part = draw(_STRANGE_BYTES | st.binary(max_size=8) | st.just(data[start:end] * 3))
        data = data[:start] + part + data[end:]
    return data


@st.composite
def changed_json(draw, data: bytes) -> bytes:
    """Draw a JSON document in which one or two members are replaced or removed."""
    content = json.loads(data)
    for _ in range(draw(st.integers(1, 2))):
        members = list(_members(content))
        parent, key = members[draw(st.integers(0, len(members) - 1))]
        if draw(st.integers(0, 4)) == 0:  # one time in five
            del parent[key]
        else:
            parent[key] = draw(_VALUES)
        if not content:
            break
    return json.dumps(content).encode()


def _members(content: dict | list) -> Iterator[tuple[dict | list, str | int]]:
    """The members of a JSON document at all depths, as (object or list, key or index)."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        yield content, key
        if isinstance(value, dict | list):
            yield from _members(value)


@pytest.mark.parametrize("name", READERS)
def test_a_reader_accepts_its_format_and_refuses_damage_by_an_input_error(folder, name):
    """Hypothesis prints the smallest content that raises another error than InputError."""
    file, read = READERS[name]
    path = folder / file
    valid = path.read_bytes()
    read(folder)
    # Damage of the file, of the text that is packed in it, and of the values in the text.
    contents = mutated(valid)
    if file.endswith(".jgz"):
        text = gzip.decompress(valid)
        contents |= (mutated(text) | changed_json(text)).map(
            partial(gzip.compress, compresslevel=1)
        )
    elif valid[:1] in (b"[", b"{"):
        contents |= changed_json(valid)

    @settings(
        max_examples=100, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
    )
    @given(contents)
    def read_damaged(data: bytes) -> None:
        path.write_bytes(data)
        try:
            read(folder)
        except InputError as error:
            # A message is of one line, unless it quotes a line break of the file.
            assert "\n" not in str(error) or b"\n" in data

    try:
        read_damaged()
    finally:
        path.write_bytes(valid)
