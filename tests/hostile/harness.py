"""Cases, and the folder that they damage."""

import gzip
import io
import json
import os
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from co3d_folders import sequence_data
from safetensors.torch import save_file

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.cli.main import main
from zsp_lite.data.co3d import write_co3d
from zsp_lite.data.labels import PoseLabel, write_label

CASES: list["Case"] = []


class Wrong(Exception):
    """An answer without an error to an input that has none, or another answer than expected."""


@dataclass(frozen=True)
class Case:
    """A call with hostile input.

    Attributes:
        group: Its class, a line of the table.
        name: What is hostile.
        call: Called with the case's own copy of the folder of `prepare`. It must raise InputError, or return `REFUSED`
            or `RIGHT`.
    """

    group: str
    name: str
    call: Callable[[Path], object]


REFUSED, RIGHT = object(), object()


def case(group: str, name: str, read: Callable[[Path], object], change: Callable[[Path], object]) -> None:
    """Register a reader that must raise InputError after a change of the folder."""
    CASES.append(Case(group, name, lambda folder: (change(folder), read(folder))[1]))


def command(group: str, name: str, *argv: str, change: Callable[[Path], object] | None = None, codes=(2,)) -> None:
    """Register a command line that must end with one of the exit codes: with 2, one line on stderr."""

    def call(folder: Path):
        if change is not None:
            change(folder)
        stderr = io.TextIOWrapper(io.BytesIO(), "utf-8", errors="backslashreplace")
        with redirect_stderr(stderr):
            code = main([text.replace("ROOT", str(folder)) for text in argv])
        stderr.flush()
        text = stderr.buffer.getvalue().decode()
        if code not in codes:
            raise Wrong(f"exit code {code}, expected {codes}: {text}")
        if code == 2 and len(text.strip().splitlines()) != 1:
            raise Wrong(f"{len(text.splitlines())} lines on stderr: {text}")
        if "Traceback" in text or (folder / "executed").exists():
            raise Wrong(f"a traceback, or code of the input was executed: {text}")
        return REFUSED if code == 2 else RIGHT

    CASES.append(Case(group, name, call))


def prepare(folder: Path) -> Path:
    """Write what the cases change, each in its own copy.

    data: two labelled sequences of one category; out: a benchmark run on them; capture: one frame as lists and as
    nerfstudio's; a.png and b.png: pictures with depth and mask; x.safetensors: a small network.
    """
    data = folder / "data"
    write_co3d(data, "cup", [sequence_data("a", 6), sequence_data("b", 6, seed=1)])
    for name in ("a", "b"):
        write_label(data, "cup", PoseLabel(np.eye(4), name, "a"))
    if main([*BENCHMARK, "--data", str(data), "--out", str(folder / "out"), "--quiet"]):
        raise Wrong("the benchmark of the prepared data failed")
    capture = folder / "capture"
    for part in ("rgb", "depth"):
        (capture / part).mkdir(parents=True)
    cv2.imwrite(str(capture / "rgb/0.png"), np.zeros((24, 32, 3), np.uint8))
    cv2.imwrite(str(capture / "depth/0.png"), np.full((24, 32), 1000, np.uint16))
    for name, text in LISTS.items():
        (capture / name).write_text(text)
    (capture / "transforms.json").write_text(json.dumps(NERFSTUDIO))
    y, x = np.mgrid[:64, :64]
    disc = (y - 32) ** 2 + (x - 32) ** 2 < 24**2
    depth = np.where(disc, 1000 + 4 * x + 2 * y, 0).astype(np.uint16)
    for name in ("a", "b"):
        picture = np.stack([4 * x, 4 * y, 2 * (x + y)], axis=-1).astype(np.uint8)
        for end, image in (("", picture), ("_depth", depth), ("_mask", 255 * disc.astype(np.uint8))):
            cv2.imwrite(str(folder / f"{name}{end}.png"), image)
    save_file(VisionTransformer(32, 8, 64, 2, 1).state_dict(), folder / "x.safetensors", {"num_heads": "1"})
    return folder


BENCHMARK = ("benchmark", "--pairs", "2", "--targets", "2", "--methods", "icp")
LISTS = {
    "rgb.txt": "rgb/0.png\n",
    "depth.txt": "depth/0.png\n",
    "poses.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n",
    "intrinsics.txt": "30 0 16\n0 30 12\n0 0 1\n",
}
NERFSTUDIO = {
    "fl_x": 30, "cx": 16, "cy": 12, "w": 32, "h": 24,
    "frames": [{"file_path": "rgb/0.png", "depth_file_path": "depth/0.png", "transform_matrix": np.eye(4).tolist()}],
}  # fmt: skip


def edited(name: str, change: Callable[[object], object]) -> Callable[[Path], object]:
    """Return a function that changes a JSON file of the folder, gzipped or not, or the lines of one as a list."""

    def write(folder: Path):
        path = folder / name
        zipped = path.suffix in (".jgz", ".gz")
        text, lines = gzip.decompress(path.read_bytes()) if zipped else path.read_bytes(), ".jsonl" in name
        content = [json.loads(line) for line in text.splitlines()] if lines else json.loads(text)
        change(content)
        data = "\n".join(map(json.dumps, content if lines else [content])).encode()
        path.write_bytes(gzip.compress(data) if zipped else data)

    return write


def written(name: str, data: bytes | str | Callable[[], bytes]) -> Callable[[Path], object]:
    """Return a function that replaces a file of the folder."""

    def write(folder: Path):
        content = data() if callable(data) else data
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return write


def gzip_bomb(gigabytes: int = 8, start: bytes = b"") -> bytes:
    """Compressed spaces."""
    return gzip.compress(start) + gzip.compress(b" " * (1 << 26)) * (16 * gigabytes)


def _sparse(path: Path) -> None:
    with open(path, "wb") as file:
        file.truncate(20 << 30)


# What is not an ordinary file, or not of ordinary size.
STRANGE: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "random bytes": lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)),
    "pipe": os.mkfifo,
    "link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
    "20 GB of nothing": _sparse,
    "link to itself": lambda path: path.symlink_to(path),
    "missing": lambda path: None,
}


def strange(name: str, kind: str) -> Callable[[Path], object]:
    """Return a function that replaces a file of the folder by a strange one."""

    def write(folder: Path):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).unlink(missing_ok=True)
        STRANGE[kind](folder / name)

    return write
