"""Import of RGB-D captures: formats, object masks, and sequences in CO3D's layout."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from zsp_lite.errors import InputError
from zsp_lite.importers.capture import (
    MOST_FRAMES,
    Capture,
    CaptureFrame,
    Makers,
    collect,
    find_masks,
    sharpest,
)
from zsp_lite.importers.lists import read_lists, read_tum
from zsp_lite.importers.nerfstudio import read_nerfstudio
from zsp_lite.importers.phones import read_polycam, read_record3d, read_stray
from zsp_lite.importers.scenes import read_bop, read_open3d, read_scannet
from zsp_lite.importers.unpacked import unpack

__all__ = ["FORMATS", "Capture", "CaptureFrame", "open_capture", "recognise"]


@dataclass(frozen=True)
class Format:
    """A format of captures."""

    signs: tuple[str, ...]  # patterns of files; a folder of the format has all
    what: str
    read: Callable[..., Makers]
    options: tuple[str, ...] = ()  # of `read`, without `count`


# A folder has the first format whose signs it has.
FORMATS = {
    "nerfstudio": Format(
        ("transforms*.json",), "nerfstudio, Blender, NeRFCapture or instant-ngp", read_nerfstudio
    ),
    "stray": Format(("rgb.mp4", "odometry.csv"), "Stray Scanner", read_stray),
    "polycam": Format(("keyframes/*cameras",), "Polycam's raw data", read_polycam),
    "record3d": Format(("metadata", "rgbd"), "Record3D", read_record3d),
    "lists": Format(("poses.txt",), "lists", read_lists),
    "tum": Format(("groundtruth.txt", "rgb.txt"), "TUM RGB-D", read_tum, ("intrinsics",)),
    "bop": Format(("scene_gt.json", "scene_camera.json"), "BOP", read_bop, ("object",)),
    "scannet": Format(("pose", "intrinsic/intrinsic_color.txt"), "ScanNet", read_scannet),
    "open3d": Format(("intrinsic.json", "color"), "Open3D's recorder", read_open3d),
}
_HOW = (
    "expected raw data with depth and poses, as Stray Scanner, Record3D or Polycam export them "
    "from LiDAR"
)
# What is near to a capture, by names and extensions of its files.
_INCOMPLETE = {
    (
        "sparse",
        "images.bin",
        "images.txt",
        "database.db",
    ): "has COLMAP's poses, but no measured depth",
    (
        "rgb.txt",
        "depth.txt",
        "depth",
    ): "has images and depth, but no poses (groundtruth.txt, poses.txt, pose/, ...)",
    (
        "scene_camera.json",
        "scene_gt.json",
    ): "lacks scene_gt.json or scene_camera.json of a BOP scene",
    (".sens",): "is ScanNet's packed scan: unpack it by ScanNet's SensReader",
    (".mp4", ".mov", ".m4v"): "is a video without depth and poses",
    (
        ".ply",
        ".splat",
        ".obj",
        ".glb",
        ".usdz",
    ): "is a model as Luma or KIRI export it, without depth and poses",
}


def recognise(path: str | Path, also: str = "") -> tuple[str, Path]:
    """Return a capture's format, a name in `FORMATS`, and the folder or file that its reader takes.

    A capture is a folder, the zip or .r3d file of an app, or a transforms.json. InputError for
    anything else; it says what is missing, or what is expected, and `also`.
    """
    path = Path(path)
    folder = path
    if path.is_file() and path.suffix.lower() in (".zip", ".r3d"):
        folder = unpack(path.resolve())
    if path.is_file() and path.match("transforms*.json"):
        return "nerfstudio", path
    files = [file for file in folder.glob("*") if not file.name.startswith((".", "__MACOSX"))]
    places = [folder]
    if len(files) == 1:  # an app may put a folder into its zip
        places += files
    for place in places:
        for name, layout in FORMATS.items():
            if all(any(place.glob(sign)) for sign in layout.signs):
                return name, place

    # No format: say why, if it is near to one.
    for signs, problem in _INCOMPLETE.items():
        if any(file.name in signs or file.suffix.lower() in signs for file in (path, *files)):
            raise InputError(f"{path} {problem}, {_HOW}")
    found = "has another format" if path.exists() else "does not exist"
    known = "; ".join(f"{layout.what} ({', '.join(layout.signs)})" for layout in FORMATS.values())
    raise InputError(f"{path} {found}, expected {also}a folder or zip with the files of {known}")


def open_capture(
    path: str | Path,
    layout: str | None = None,
    count: int = MOST_FRAMES,
    masks: Path | None = None,
    files: Mapping[str, Any] = {},
    **options: Any,
) -> Capture:
    """Read a capture's frames (see `open_source`), with the masks of its folder masks/, if any.

    `files` replaces members of each `CaptureFrame`. InputError if the capture cannot be read, or no
    frame can be used.
    """
    path = Path(path)
    folder = path
    try:
        found, place = recognise(path)
        layout = layout or found
        if found == layout:
            folder = place
    except InputError:
        if not layout:
            raise
    if layout == "stray":  # its reader keeps the sharp frames of a video only
        options["count"] = count
    frames, left_out = collect(FORMATS[layout].read(folder, **options))

    # A frame's own mask, or that of the folder; a folder that is named has precedence.
    images = [frame.image for frame in frames]
    if folder.is_file():
        folder = folder.parent
    found = find_masks(masks or folder / "masks", images)
    if masks is not None and not any(found):
        raise InputError(
            f"--masks {masks} has no mask that is named like an image, such as {images[0].stem}.png"
        )
    if not masks:
        found = [frame.mask or mask for frame, mask in zip(frames, found)]
    frames = [replace(frame, mask=mask, **files) for frame, mask in zip(frames, found)]

    sharp = sharpest(frames, count, lambda frame: frame.load().rgb, left_out)
    frames = [frame for frame, _ in sharp]
    if not frames:
        problem = "no frame, expected some"
        if left_out:
            problem = f"none of {len(left_out)} frames can be used: {left_out[0]}"
        raise InputError(f"capture {path}: {problem}")
    return Capture(frames, left_out)
