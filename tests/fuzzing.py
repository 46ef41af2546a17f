"""Fuzzing of everything that reads files: damaged and invented files must be read or refused by InputError.

`tests/test_fuzzing.py` runs the targets.
"""

import atexit
import gzip
import json
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from zsp_lite.backbones.checkpoints import read_checkpoint
from zsp_lite.benchmark.own import read_poses
from zsp_lite.benchmark.runs import read_run
from zsp_lite.data.annotations import SEQUENCES_FILE, read_frame_index, read_sequences
from zsp_lite.data.frames import read_depth, read_image
from zsp_lite.data.labels import parse_label
from zsp_lite.errors import InputError
from zsp_lite.importers import READERS
from zsp_lite.io.ply import read_ply

_FOLDER = tempfile.TemporaryDirectory(prefix="fuzzing-")
atexit.register(_FOLDER.cleanup)
ROOT = Path(_FOLDER.name)  # every target overwrites its own files


@dataclass(frozen=True)
class Target:
    """A reader of the content of a file."""

    read: Callable[[bytes], object]
    seed: bytes  # a valid content; text formats are mutated as bytes, JSON also as values
    is_json: bool = False


def _file(name: str, read: Callable[[Path], object], pack: Callable[[bytes], bytes] = lambda data: data):
    path = ROOT / name

    def run(data: bytes):
        path.write_bytes(pack(data))
        return read(path)

    return run


def _gzip(data: bytes) -> bytes:
    return gzip.compress(data, 1)


def _lines(text: bytes) -> bytes:
    """A file with a line for each member of a list."""
    try:
        return b"".join(_text(line) + b"\n" for line in json.loads(text))
    except (ValueError, TypeError):
        return text + b"\n"


def _run(name: str, other: str, content: bytes, pack: Callable[[bytes], bytes] = lambda data: data):
    """Reader of a run of which one file is fuzzed."""
    root = ROOT / f"run {name}"
    root.mkdir()
    (root / other).write_bytes(content)
    return _file(f"run {name}/{name}", lambda path: read_run(path.parent).summary, pack)


def _frames(path: Path) -> None:
    index = read_frame_index(path)
    for position in range(len(index.keys)):
        index.frame(position)


def _capture(layout: str, name: str, others: dict[str, bytes]):
    """Reader of a capture of which one file is fuzzed."""
    root = ROOT / f"{layout} {Path(name).stem}"
    for part in ("rgb", "depth"):
        (root / part).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(root / "rgb/0.png"), np.zeros((24, 32, 3), np.uint8))
    cv2.imwrite(str(root / "depth/0.png"), np.full((24, 32), 1000, np.uint16))
    for other, content in others.items():
        (root / other).write_bytes(content)

    def run(data: bytes):
        (root / name).write_bytes(data)
        for frame in READERS[layout](root)[:3]:
            frame.load()

    return run


def _png(bits: bytes) -> bytes:
    """A 16-bit PNG of fuzzed values: damage of the file itself would only reach the checksums."""
    values = np.frombuffer(bits[: 2 * (len(bits) // 2)], np.uint16)
    return cv2.imencode(".png", values[:, None])[1].tobytes() if len(values) else bits


def _header(text: bytes) -> bytes:
    """A .safetensors file with a fuzzed header."""
    return struct.pack("<Q", len(text)) + text + bytes(8)


_EYE = np.eye(4).tolist()
_FRAME = {
    "sequence_name": "a", "frame_number": 1, "frame_timestamp": 0.1, "image": {"path": "a.jpg", "size": [24, 32]},
    "depth": {"path": "d.png", "scale_adjustment": 1.0, "mask_path": None}, "mask": {"path": "m.png", "mass": 5.0},
    "viewpoint": {"R": np.eye(3).tolist(), "T": [0, 0, 1], "focal_length": [2, 2], "principal_point": [0, 0]},
}  # fmt: skip
_SEQUENCE = {"sequence_name": "a", "category": "cup", "point_cloud": {"path": "p.ply", "quality_score": 1.0}}
_NERF = {
    "fl_x": 30, "cx": 16, "cy": 12, "w": 32, "h": 24, "k1": 0.1,
    "frames": [{"file_path": "rgb/0.png", "depth_file_path": "depth/0.png", "transform_matrix": _EYE}],
}  # fmt: skip
_CALL = {
    "time": "t", "command": ["c"], "versions": {"python": "3"}, "machine": {"cores": 2}, "workers": 1,
    "rows": ["ours"], "pairs": {"cup": 4},
}  # fmt: skip
_SETTINGS = {
    "data": "d", "backbone": "n 0", "targets": 2, "library": [{"version": "0", "commit": None}],
    "methods": {"ours": "x"}, "labels": {"cup": "0"}, "origins": {"cup, N = 2": "sampled"}, "calls": [_CALL],
}  # fmt: skip
_FOUND = {"error": 1.0, "symmetric_error": 0.5, "confidence": 0.5, "scale": 1.1, "view": 1, "inliers": 9, "note": "x"}
_RESULTS = [
    {"pair": f"cup/a:{i}/b:0,1", "results": {"ours": _FOUND}, "timings": {"reading": 0.1}} for i in range(4)
]  # fmt: skip
_POSES = b"""category,reference_sequence,reference_frame,target_sequence,target_frame,rotation,translation,scale
cup,a,0,b,1,1 0 0 0 1 0 0 0 1,0 0 1,1.5
"""
_PLY = "ply\nformat {} 1.0\nelement vertex 3\n" + "".join(f"property float {x}\n" for x in "xyz") + "end_header\n"
_TENSORS = save({"a": np.zeros(2, np.float32)})


def _text(content: object) -> bytes:
    return json.dumps(content).encode()


TARGETS: dict[str, Target] = {
    "frame annotations": Target(_file("frames.jgz", _frames, _gzip), _text([_FRAME]), True),
    "sequence annotations": Target(
        _file(SEQUENCES_FILE, read_sequences, _gzip),
        _text([_SEQUENCE]), True,
    ),
    "gzip": Target(_file("annotations.jgz", _frames), _gzip(_text([_FRAME]))),
    "label": Target(
        lambda data: parse_label(data, Path("b.json")), _text({"trans": _EYE, "seq": "b", "reference_seq": "a"}), True
    ),
    "point cloud": Target(_file("ascii.ply", read_ply), (_PLY.format("ascii") + "0 0 0\n1 0 0\n0 1 0\n").encode()),
    "binary point cloud": Target(
        _file("binary.ply", read_ply),
        _PLY.format("binary_little_endian").encode() + np.eye(3, dtype="<f4").tobytes(),
    ),
    "depth": Target(_file("depth.png", read_depth, _png), np.arange(0, 65535, 999, np.uint16).tobytes()),
    "image": Target(
        _file("image.jpg", read_image), cv2.imencode(".jpg", np.zeros((9, 9, 3), np.uint8))[1].tobytes()
    ),
    "header of a checkpoint": Target(
        _file("header.safetensors", read_checkpoint, _header), _TENSORS[8 : 8 + int.from_bytes(_TENSORS[:8], "little")],
        True,
    ),
    "checkpoint": Target(_file("whole.safetensors", read_checkpoint), _TENSORS),
    "lists": Target(
        _capture("lists", "poses.txt", {
            "rgb.txt": b"rgb/0.png\n", "depth.txt": b"depth/0.png\n", "intrinsics.txt": b"30 0 16\n0 30 12\n0 0 1\n",
        }),
        b"# camera to world\n1 0 0 0 0 1 0 0 0 0 1 0\n",
    ),
    "nerfstudio": Target(_capture("nerfstudio", "transforms.json", {}), _text(_NERF), True),
    "results": Target(_run("run.jsonl", "run.json", _text(_SETTINGS), _lines), _text(_RESULTS), True),
    "packed results": Target(_run("run.jsonl.gz", "run.json", _text(_SETTINGS)), _gzip(_lines(_text(_RESULTS)))),
    "settings of a run": Target(_run("run.json", "run.jsonl", _lines(_text(_RESULTS))), _text(_SETTINGS), True),
    "poses": Target(_file("poses.csv", read_poses), _POSES),
}  # fmt: skip


def check(name: str, data: bytes) -> bool:
    """Read a content. Returns whether it was accepted; raises what is no InputError."""
    try:
        TARGETS[name].read(data)
    except InputError as error:
        assert "\n" not in str(error) or "\n" in data.decode(errors="replace"), error
        return False
    return True


_STRANGE = st.sampled_from(
    [b"", b"\0", b"\xff", b"-1", b"1e308", b"NaN", b"9" * 30, b"[", b"{", b'"', b"\n", b"#", b"/../", b"\xed\xa0\x80"]
)  # fmt: skip


@st.composite
def mutated(draw, seed: bytes) -> bytes:
    """A content with parts that were replaced, removed or repeated."""
    data = seed
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
def changed_json(draw, seed: bytes) -> bytes:
    """A JSON document of which one or two values were replaced, or members removed."""
    content = json.loads(seed)
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


def inputs(name: str) -> st.SearchStrategy[bytes]:
    """Contents for a target."""
    target = TARGETS[name]
    return mutated(target.seed) | changed_json(target.seed) if target.is_json else mutated(target.seed)


def run(name: str, examples: int) -> None:
    """Read many contents; the first that raises another error than InputError is printed in its smallest form."""
    options = {"deadline": None, "database": None, "derandomize": True, "suppress_health_check": list(HealthCheck)}

    @settings(max_examples=examples, **options)
    @given(inputs(name))
    def test_one(data: bytes) -> None:
        check(name, data)

    test_one()
