"""Import of RGB-D captures: formats, object masks, and sequences in CO3D's layout."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from zsp_lite.errors import InputError
from zsp_lite.importers.capture import (
    MOST_FRAMES,
    Capture,
    Makers,
    collect,
    find_masks,
    sharpest,
)
from zsp_lite.importers.lists import read_lists, read_tum
from zsp_lite.importers.nerfstudio import read_nerfstudio
from zsp_lite.importers.phones import read_polycam, read_record3d, read_stray
from zsp_lite.importers.recordings import RECORDED, read_recording
from zsp_lite.importers.scenes import read_bop, read_open3d, read_scannet
from zsp_lite.importers.unpacked import unpack


@dataclass(frozen=True)
class Format:
    """A format of captures."""

    signs: tuple[str, ...]  # patterns of files: a folder of the format has a match for each
    what: str  # name of the format, for messages
    read: Callable[..., Makers]
    options: tuple[str, ...] = ()  # options that `read` takes, without `count`
    # Direction up in its worlds, by their documents; "floor" if they say nothing of it.
    up: tuple[float, float, float] | Literal["floor"] = "floor"
    unless: tuple[str, ...] = ()  # patterns of files that a folder of the format does not have


PACKED = (".zip", ".r3d")  # extensions of files that apps export

_ARKIT_UP = (0.0, 1.0, 0.0)  # gravity points along -y
# The format of a folder is the first one whose signs it has.
FORMATS = {
    "nerfstudio": Format(
        ("transforms*.json",), "nerfstudio, Blender, NeRFCapture or instant-ngp", read_nerfstudio
    ),
    "stray": Format(("rgb.mp4", "odometry.csv"), "Stray Scanner", read_stray, up=_ARKIT_UP),
    "polycam": Format(("keyframes/*cameras",), "Polycam's raw data", read_polycam, up=_ARKIT_UP),
    "record3d": Format(("metadata", "rgbd"), "Record3D", read_record3d, up=_ARKIT_UP),
    "lists": Format(("poses.txt",), "lists", read_lists),
    "tum": Format(("groundtruth.txt", "rgb.txt"), "TUM RGB-D", read_tum, ("intrinsics",)),
    "bop": Format(("scene_gt.json", "scene_camera.json"), "BOP", read_bop, ("object",)),
    "scannet": Format(("pose", "intrinsic/intrinsic_color.txt"), "ScanNet", read_scannet),
    "recording": Format(
        (RECORDED, "depth"),
        "recordings without poses: rgb/ or color/, and depth/",
        read_recording,
        ("intrinsics",),
        # Signs of other formats: poses that they have are not to be found again.
        unless=("scene*", "pose", "groundtruth.txt", "rgb.txt", "trajectory.log"),
    ),
    "open3d": Format(("intrinsic.json", "color"), "Open3D's recorder", read_open3d),
}
_HOW = (
    "expected raw data with depth and poses, as Stray Scanner, Record3D or Polycam export them "
    "from LiDAR"
)
# Files, by name or extension, that show why a folder is no capture, and the reason.
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


def recognise(path: str | Path) -> tuple[str, Path]:
    """Return a capture's format, a name in `FORMATS`, and the folder or file that its reader takes.

    A capture is a folder, the zip or .r3d file of an app, or a transforms.json. InputError for
    anything else. The message says what is missing, or what is expected.
    """
    path = Path(path)
    folder = path
    if path.is_file() and path.suffix.lower() in PACKED:
        folder = unpack(path.resolve())
    if path.is_file() and path.match("transforms*.json"):
        return "nerfstudio", path
    files = [file for file in folder.glob("*") if not file.name.startswith((".", "__MACOSX"))]
    places = [folder]
    if len(files) == 1:  # an app may put a folder into its zip
        places += files
    if path.resolve().name == "keyframes":  # the inner folder of Polycam's raw data
        places.append(path.resolve().parent)
    for place in places:
        for name, layout in FORMATS.items():
            if all(any(place.glob(sign)) for sign in layout.signs) and not any(
                any(place.glob(sign)) for sign in layout.unless
            ):
                return name, place

    # The path has no format: say why, if its files show a reason.
    for signs, problem in _INCOMPLETE.items():
        if any(file.name in signs or file.suffix.lower() in signs for file in (path, *files)):
            raise InputError(f"{path} {problem}, {_HOW}")
    problem = "has another format" if path.exists() else "does not exist"
    known = "; ".join(f"{layout.what} ({', '.join(layout.signs)})" for layout in FORMATS.values())
    raise InputError(
        f"{path} {problem}, expected a picture (.jpg, .png, .webp), CATEGORY/SEQUENCE of a data "
        f"folder, or a folder or zip with the files of {known}"
    )


def open_capture(
    path: str | Path,
    layout: str | None = None,
    count: int = MOST_FRAMES,
    masks: Path | None = None,
    files: Mapping[str, Any] = {},
    **options: Any,
) -> Capture:
    """Read a capture's frames (see `open_source`), with the masks of its folder masks/, if any.

    The `layout`, a name in `FORMATS`, is recognised by default; otherwise the path is what its
    reader takes. `files` has attributes of `CaptureFrame` that replace those of every frame.
    InputError if the capture cannot be read, or no frame can be used.
    """
    folder = Path(path)
    if layout is None:
        layout, folder = recognise(path)
    if layout == "stray":  # the reader chooses the sharp frames, because it decodes a video
        options["count"] = count
    if layout == "recording":
        options["attributes"] = files
    frames, left_out = collect(FORMATS[layout].read(folder, **options))

    # A frame's own mask comes before the one in the capture's folder masks/. If the folder `masks`
    # is given, all masks are from it.
    images = [frame.image for frame in frames]
    if folder.is_file():
        folder = folder.parent
    paths = find_masks(masks or folder / "masks", images)
    if masks is not None and not any(paths):
        raise InputError(
            f"--masks {masks} has no mask that is named like an image, such as {images[0].stem}.png"
        )
    if not masks:
        paths = [frame.mask or mask for frame, mask in zip(frames, paths)]
    frames = [replace(frame, mask=mask, **files) for frame, mask in zip(frames, paths)]

    frames_and_images = sharpest(frames, count, lambda frame: frame.load().rgb, left_out)
    frames = [frame for frame, _ in frames_and_images]
    if not frames:
        problem = "no frame, expected some"
        if left_out:
            problem = f"none of {len(left_out)} frames can be used: {left_out[0]}"
        raise InputError(f"capture {path}: {problem}")
    return Capture(frames, left_out)
