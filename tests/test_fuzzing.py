"""Fuzzing of everything that reads files: damaged and invented files must be read or refused by
InputError.

The readers are those of the hostile inputs with the valid files of their folder; the inputs are the
same in each run.
"""

import gzip
import json

import pytest
from benchmark_folder import write_run
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.hostile.harness import READERS_OF, prepare, read_capture
from zsp_lite import InputError
from zsp_lite.benchmark.runs import read_run
from zsp_lite.data.frames import read_image

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
_JPEG = "data/cup/a/images/frame000001.jpg"
# Every reader, with the file that it reads.
READERS = {name: READERS_OF[name] for name in _NAMES} | {
    "image": (_JPEG, lambda folder: read_image(folder / _JPEG)),
    "lists": ("capture/poses.txt", read_capture("lists")),
    "results": ("made/run.jsonl", lambda folder: read_run(folder / "made").summary),
    "settings of a run": ("made/run.json", lambda folder: read_run(folder / "made").summary),
}
_STRANGE = st.sampled_from(
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
_NUMBERS = (
    st.integers()
    | st.floats()
    | st.sampled_from([10**30, 1e308, -1e308, 1e155, 1e-300, 0, -1, 2**63, 1 << 53])
)
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
    result = {
        "error": 10.0,
        "symmetric_error": 5.0,
        "translation": 0.5,
        "scale": 1.1,
        "view": 1,
        "inliers": 9,
        "seconds": 2.0,
        "note": "flat",
        "confidence": 0.7,
        "position": [0.5, 1.0, 2.0],
    }
    write_run(folder / "made", {"icp": {"cup/a:0/b:1,3": result, "cup/b:2/a:0,2": result}}, ["cup"])
    return folder


def unpack(file: str, data: bytes) -> bytes:
    """The text of a gzipped file, and the lines of results as a list."""
    text = gzip.decompress(data) if file.endswith(".jgz") else data
    return b"[" + b",".join(text.splitlines()) + b"]" if file.endswith(".jsonl") else text


def pack(file: str, text: bytes) -> bytes:
    if file.endswith(".jsonl"):
        try:
            text = b"".join(json.dumps(line).encode() + b"\n" for line in json.loads(text))
        except (ValueError, TypeError):  # damaged
            text += b"\n"
    return gzip.compress(text, 1) if file.endswith(".jgz") else text


@st.composite
def mutated(draw, data: bytes) -> bytes:
    """A content with parts that were replaced, removed or repeated; most are near the start, where
    headers are."""
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, min(len(data), 1500)) | st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 12)))
        part = draw(_STRANGE | st.binary(max_size=8) | st.just(data[start:end] * 3))
        data = data[:start] + part + data[end:]
    return data


@st.composite
def changed_json(draw, data: bytes) -> bytes:
    """A JSON document of which one or two values were replaced, or members removed."""
    content = json.loads(data)
    for _ in range(draw(st.integers(1, 2))):
        places = list(_places(content))
        parent, key = places[draw(st.integers(0, len(places) - 1))]
        if draw(st.integers(0, 4)) == 0:
            del parent[key]
        else:
            parent[key] = draw(_VALUES)
        if not content:
            break
    return json.dumps(content).encode()


def _places(content):
    """The members of a JSON document, as (object or list, key or index)."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        yield content, key
        if isinstance(value, dict | list):
            yield from _places(value)


@pytest.mark.parametrize("name", READERS)
def test_a_reader_accepts_its_format_and_refuses_damage_by_an_input_error(folder, name):
    """The first content that raises another error than InputError is printed in its
    smallest form."""
    file, read = READERS[name]
    valid = (folder / file).read_bytes()
    text = unpack(file, valid)
    contents = mutated(text).map(lambda one: pack(file, one)) | mutated(valid)
    if text[:1] in (b"[", b"{"):
        contents |= changed_json(text).map(lambda one: pack(file, one))
    read(folder)

    @settings(
        max_examples=100, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
    )
    @given(contents)
    def test_one(data: bytes) -> None:
        (folder / file).write_bytes(data)
        try:
            read(folder)
        except InputError as error:
            assert "\n" not in str(error) or b"\n" in data

    try:
        test_one()
    finally:
        (folder / file).write_bytes(valid)
