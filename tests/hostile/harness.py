"""Registers the hostile cases; has the folder that each of them damages, and every reader."""

import gzip
import io
import os
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import dataclass, replace
from pathlib import Path

from captures import write_lists, write_nerfstudio
from co3d_folders import sequence_data, write_identities
from safetensors.torch import save_file
from uco3d_folders import write_uco3d

from zsp_lite import Co3D, Frame, load_backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.cli.main import main
from zsp_lite.data.exchange import read_stored_poses
from zsp_lite.data.frames import read_depth, read_image, read_mask
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import shipped_pairs
from zsp_lite.data.published import import_labels
from zsp_lite.data.writing import write_co3d
from zsp_lite.importers import open_capture
from zsp_lite.importers.files import read_depth_file
from zsp_lite.importers.uco3d import import_uco3d

CASES: list["Case"] = []
BENCHMARK = "benchmark --pairs 2 --targets 2 --methods icp"
POSES = """pair,target_frame,rotation,translation,scale
"cup/a:0/b:1,4",1,1 0 0 0 1 0 0 0 1,0 0 1,1.5
"""
# Files that several cases damage, relative to the folder.
OF_UCO3D = "uco3d/things/cup/a"
FRAMES = "data/cup/frame_annotations.jgz"
RESULTS = "out/run.jsonl"


@dataclass(frozen=True)
class Case:
    """A call that gets a copy of the folder, and raises InputError or returns an outcome and a
    message.

    Outcomes are "refused", which an InputError counts as, "right" and "wrong".
    """

    group: str
    name: str
    call: Callable[[Path], tuple[str, str]]


def case(
    group: str, name: str, read: Callable[[Path], object], change: Callable[[Path], object]
) -> None:
    """Register a reader that must raise InputError after a change of the folder."""

    def call(folder: Path) -> tuple[str, str]:
        change(folder)
        return "wrong", repr(read(folder))

    CASES.append(Case(group, name, call))


def command(
    group: str, name: str, line: str, change: Callable[[Path], object] | None = None, code: int = 2
) -> None:
    """Register a command line that must end with an exit code; where it is 2, with one line on
    stderr. ROOT in the line is the folder."""

    def call(folder: Path) -> tuple[str, str]:
        if change is not None:
            change(folder)
        # As the real stderr, it escapes what is not Unicode.
        stderr = io.TextIOWrapper(io.BytesIO(), "utf-8", errors="backslashreplace")
        with redirect_stderr(stderr):
            status = main([word.replace("ROOT", str(folder)) for word in line.split()])
        stderr.flush()
        text = stderr.buffer.getvalue().decode()
        one_line = len(text.strip().splitlines()) == 1
        if status != code or "Traceback" in text or (code == 2 and not one_line):
            return "wrong", f"exit code {status}, expected {code}, and one line on stderr: {text}"
        return "refused" if code == 2 else "right", text

    CASES.append(Case(group, name, call))


def prepare(folder: Path) -> Path:
    """Write the folder of which each case changes a copy.

    - data: two labelled sequences of one category
    - uco3d: one of them in the layout of uCO3D
    - out: a benchmark run on them
    - capture: one frame in the layouts of lists and of nerfstudio
    - poses.csv: one pose
    - x.safetensors: a small network
    """
    data = folder / "data"
    write_co3d(data, "cup", [sequence_data("a", 6), sequence_data("b", 6, seed=1)])
    write_identities(data, "cup", "ab")
    write_uco3d(folder / "uco3d", Co3D(data), "cup", ["a"])
    words = f"{BENCHMARK} --quiet --data".split()
    assert main([*words, str(data), "--out", str(folder / "out")]) == 0
    for write in (write_lists, write_nerfstudio):
        write(folder / "capture", [replace(sequence_data("c", 1).frames[0], name="0")])
    (folder / "poses.csv").write_text(POSES)
    save_file(
        VisionTransformer(32, 8, 64, 2, 1).state_dict(),
        folder / "x.safetensors",
        {"num_heads": "1"},
    )
    return folder


def read_frames(folder: Path) -> list[Frame]:
    """Read the frames of a sequence."""
    data = Co3D(folder / "data")
    return [data.load(frame) for frame in data.frames("cup", "a")]


def read_capture(layout: str) -> Callable[[Path], list[Frame]]:
    """Return a function that reads the frames of the capture in a layout."""
    return lambda folder: [
        frame.load() for frame in open_capture(folder / "capture", layout).frames
    ]


def read_uco3d(folder: Path) -> list:
    """Import the sequences of a small uCO3D."""
    return list(import_uco3d(folder / "uco3d", folder / "imported", "cup"))


# Readers of single files, by a name: the file, relative to the folder, and its reader. A file that
# the folder lacks is written by the case.
_OF_FILES = {
    "image": ("a.jpg", read_image),
    "mask": ("a_mask.png", read_mask),
    "depth": ("a_depth.png", read_depth),
    "depth file": ("z.npz", read_depth_file),
    "checkpoint": ("x.pth", load_backbone),
    "safetensors": ("x.safetensors", load_backbone),
    "poses": ("poses.csv", read_stored_poses),
}
# Every reader, by a name: the file, and the call that reads it in the folder.
READERS_OF: dict[str, tuple[str, Callable[[Path], object]]] = {
    what: (name, lambda folder, name=name, read=read: read(folder / name))
    for what, (name, read) in _OF_FILES.items()
} | {
    "frame annotations": (FRAMES, read_frames),
    "sequence annotations": (
        "data/cup/sequence_annotations.jgz",
        lambda folder: Co3D(folder / "data").sequences("cup"),
    ),
    "point cloud": (
        "data/cup/a/pointcloud.ply",
        lambda folder: Co3D(folder / "data").point_cloud("cup", "a"),
    ),
    "label": (
        "data/class_labels/cup/b.json",
        lambda folder: read_labels(folder / "data", "cup"),
    ),
    "pairs": (
        "data/determ_eval/1samples_2tgt/cup.pt",
        lambda folder: shipped_pairs(Co3D(folder / "data"), "cup", 2),
    ),
    "labels to import": (
        "new/class_labels/cup/c.json",
        lambda folder: import_labels(folder / "new", folder / "data"),
    ),
    "lists": ("capture/rgb.txt", read_capture("lists")),
    "nerfstudio": ("capture/transforms.json", read_capture("nerfstudio")),
    "uCO3D's metadata": ("uco3d/metadata.sqlite", read_uco3d),
    "uCO3D's images": (f"{OF_UCO3D}/rgb_video.mp4", read_uco3d),
    "uCO3D's masks": (f"{OF_UCO3D}/mask_video.mkv", read_uco3d),
    "uCO3D's depth": (f"{OF_UCO3D}/depth_maps.h5", read_uco3d),
}


def written(name: str, data: bytes | str | Callable[[], bytes]) -> Callable[[Path], object]:
    """Return a function that writes a file of the folder, or replaces it."""

    def write(folder: Path):
        content = data() if callable(data) else data
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)

    return write


def gzip_bomb() -> bytes:
    """8 GB of spaces, compressed: 128 times a gzip member of 64 MB, which are read one after the
    other."""
    return gzip.compress(b" " * (1 << 26)) * 128


def _sparse(path: Path) -> None:
    """Write a file of zeros that takes no room on the disk."""
    with open(path, "wb") as file:
        file.truncate(20 << 30)


# Files that do not end or do not fit into memory. Damaged files are the subject of
# tests/test_files.py and tests/test_fuzzing.py.
STRANGE: dict[str, Callable[[Path], object]] = {
    "pipe": lambda path: os.mkfifo(path),  # looked up late: Windows has none
    "link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "20 GB of nothing": _sparse,
}


def strange(name: str, kind: str) -> Callable[[Path], object]:
    """Return a function that replaces a file of the folder by a strange one."""

    def write(folder: Path):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).unlink(missing_ok=True)
        STRANGE[kind](folder / name)

    return write
