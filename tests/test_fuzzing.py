"""Fuzzing of everything that reads files: damaged and invented files must be read or refused by InputError.

The targets are readers of the hostile inputs with the valid files of their folder; the inputs are the same in each run.
"""

import atexit
import functools
import gzip
import json
import shutil
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from tests.hostile.harness import READERS_OF, RESULTS, edited, prepare, read_capture
from zsp_lite.backbones.checkpoints import read_checkpoint
from zsp_lite.benchmark.runs import read_run
from zsp_lite.data.frames import read_image
from zsp_lite.errors import InputError

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Target:
    """A reader of a file of the folder. What the file holds is fuzzed, and packed again as the file has it."""

    file: str
    read: Callable[[Path], object]
    is_json: bool = False  # the values are mutated as well
    unpack: Callable[[bytes], bytes] = bytes
    pack: Callable[[bytes], bytes] = bytes


def _first_entry(data: bytes) -> bytes:
    """One of many entries alike, so that the mutations are not spread over all of them."""
    return json.dumps(json.loads(gzip.decompress(data))[:1]).encode()


def _gzip(data: bytes) -> bytes:
    return gzip.compress(data, 1)


def _as_list(lines: bytes) -> bytes:
    return b"[" + b",".join(lines.splitlines()) + b"]"


def _as_lines(text: bytes) -> bytes:
    """A file with a line for each member of a list."""
    try:
        return b"".join(json.dumps(line).encode() + b"\n" for line in json.loads(text))
    except (ValueError, TypeError):
        return text + b"\n"


def _png(bits: bytes) -> bytes:
    """A 16-bit PNG of fuzzed values: damage of the file itself would only reach the checksums."""
    values = np.frombuffer(bits[: 2 * (len(bits) // 2)], np.uint16)
    return cv2.imencode(".png", values[:, None])[1].tobytes() if len(values) else bits


def _with_header(text: bytes) -> bytes:
    """A .safetensors file with a fuzzed header."""
    return struct.pack("<Q", len(text)) + text + bytes(8)


def _run(folder: Path):
    return read_run(folder / "out").summary


def _checkpoint(folder: Path):
    return read_checkpoint(folder / "x.safetensors")


_JPEG = "data/cup/a/images/frame000001.jpg"
_TENSORS = save({"a": np.zeros(2, np.float32)})
_HEADER = _TENSORS[8 : 8 + int.from_bytes(_TENSORS[:8], "little")]
_DEPTH = np.arange(0, 65535, 999, np.uint16).tobytes()
_PLY = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {x}\n" for x in "xyz") + "end_header\n"
_ASCII = (_PLY + "0 0 0\n1 0 0\n0 1 0\n").encode()
TARGETS: dict[str, Target] = {
    "frame annotations": Target(*READERS_OF["frame annotations"], True, _first_entry, _gzip),
    "sequence annotations": Target(*READERS_OF["sequence annotations"], True, _first_entry, _gzip),
    "gzip": Target(*READERS_OF["frame annotations"]),
    "label": Target(*READERS_OF["label"], True),
    "point cloud": Target(*READERS_OF["point cloud"], unpack=lambda data: _ASCII),
    "binary point cloud": Target(*READERS_OF["point cloud"]),
    "depth": Target(*READERS_OF["depth"], unpack=lambda data: _DEPTH, pack=_png),
    "image": Target(_JPEG, lambda folder: read_image(folder / _JPEG)),
    "header of a checkpoint": Target("x.safetensors", _checkpoint, True, lambda data: _HEADER, _with_header),
    "checkpoint": Target("x.safetensors", _checkpoint, unpack=lambda data: _TENSORS),
    "lists": Target("capture/poses.txt", read_capture("lists")),
    "nerfstudio": Target(*READERS_OF["nerfstudio"], True),
    "results": Target(RESULTS, _run, True, _as_list, _as_lines),
    "settings of a run": Target("out/run.json", _run, True),
    "poses": Target(*READERS_OF["poses"]),
}


@functools.cache
def _prepared() -> Path:
    """The folder, without what differs between machines and calls: the inputs are the same everywhere."""
    folder = Path(tempfile.mkdtemp(prefix="fuzzing-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    prepare(folder / "template")
    call = {"time": "t", "command": ["c"], "versions": {"python": "3"}, "machine": {"cores": 2}}

    def constant(settings):
        settings.update(data="d", backbone="n 0", library=[{"version": "0", "commit": None}])
        settings["calls"][0].update(call)

    def complete(lines):
        for line in lines:
            line["timings"] = {"reading": 0.1}
            line["results"]["icp"].update(seconds=0.1, symmetric_error=0.5, confidence=0.5, inliers=9)

    edited("out/run.json", constant)(folder / "template")
    edited(RESULTS, complete)(folder / "template")
    return folder


@functools.cache
def folder_of(name: str) -> Path:
    """A target's own copy of the folder."""
    return shutil.copytree(_prepared() / "template", _prepared() / name)


@functools.cache
def seed(name: str) -> bytes:
    return TARGETS[name].unpack((_prepared() / "template" / TARGETS[name].file).read_bytes())


def check(name: str, data: bytes) -> bool:
    """Read a content. Returns whether it was accepted; raises what is no InputError."""
    (folder_of(name) / TARGETS[name].file).write_bytes(TARGETS[name].pack(data))
    try:
        TARGETS[name].read(folder_of(name))
    except InputError as error:
        assert "\n" not in str(error) or "\n" in data.decode(errors="replace"), error
        return False
    return True


_STRANGE = st.sampled_from(
    [b"", b"\0", b"\xff", b"-1", b"1e308", b"NaN", b"9" * 30, b"[", b"{", b'"', b"\n", b"#", b"/../", b"\xed\xa0\x80"]
)  # fmt: skip


@st.composite
def mutated(draw, data: bytes) -> bytes:
    """A content with parts that were replaced, removed or repeated."""
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 12)))
        part = draw(_STRANGE | st.binary(max_size=8) | st.just(data[start:end] * 3))
        data = data[:start] + part + data[end:]
    return data


_NUMBERS = st.integers() | st.floats() | st.sampled_from([10**30, 1e308, -1e308, 1e155, 1e-300, 0, -1, 2**63, 1 << 53])
_VALUES = st.recursive(
    st.none() | st.booleans() | _NUMBERS | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


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


@pytest.mark.parametrize("name", TARGETS)
def test_a_reader_accepts_its_format_and_refuses_damage_by_an_input_error(name):
    """The first content that raises another error than InputError is printed in its smallest form."""
    assert check(name, seed(name))
    contents = mutated(seed(name)) | changed_json(seed(name)) if TARGETS[name].is_json else mutated(seed(name))

    @settings(max_examples=150, database=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(contents)
    def test_one(data: bytes) -> None:
        check(name, data)

    test_one()
