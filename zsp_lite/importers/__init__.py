"""Import of RGB-D captures: formats, object masks, and sequences in CO3D's layout."""

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from itertools import product
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Literal

from zsp_lite.data.annotations import FRAMES_FILE
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import (
    MOST_FRAMES,
    Capture,
    Makers,
    OutsideError,
    find_masks,
    first_three,
    natural_order,
    sharpest,
)
from zsp_lite.importers.files import PICTURES
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
    options: tuple[str, ...] = ()  # options of this format alone, which `read` takes
    # Direction up in its worlds, by their documents; "floor" if they say nothing of it.
    up: tuple[float, float, float] | Literal["floor"] = "floor"
    unless: tuple[str, ...] = ()  # patterns of files that a folder of the format does not have


PACKED = (".zip", ".r3d")  # extensions of files that apps export

_COLMAP = (
    "sparse",
    "images.bin",
    "images.txt",
    "cameras.bin",
    "cameras.txt",
    "points3[Dd].*",
    "database.db",
)
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
    "bop": Format(("scene_gt.json", "scene_camera.json", "rgb"), "BOP", read_bop, ("object",)),
    "scannet": Format(("pose", "intrinsic/intrinsic_color.txt"), "ScanNet", read_scannet),
    "recording": Format(
        (RECORDED, "depth"),
        "recordings without poses",
        read_recording,
        ("intrinsics",),
        # Signs of other formats: poses that they have are not to be found again.
        unless=(
            *("scene*", "pose", "groundtruth.txt", "rgb.txt", "trajectory.log", "depth/*.exr"),
            *_COLMAP,
        ),
    ),
    "open3d": Format(("*intrinsic.json", "color"), "Open3D's recorder", read_open3d),
}
_HOW = (
    "expected raw data with depth and poses, as Stray Scanner, Record3D or Polycam export them "
    "from LiDAR"
)
_LISTS = "expected its files as the format lists: rgb.txt, depth.txt, poses.txt, intrinsics.txt"
# Patterns of files, in lower case, that show what is no capture; what it is, and the way out. The
# first that has a match counts.
_OTHERS = (
    (
        ("cameras/*.json", "corrected_cameras/*.json"),
        "has cameras/*.json, as the inner folder of Polycam's raw data",
        "expected all of Polycam's in a folder keyframes/, or of others the files of the format "
        "lists: rgb.txt, depth.txt, poses.txt, intrinsics.txt",
    ),
    (("frame_[0-9]*.json",), "is a scan of 3d Scanner App", _LISTS),
    (("lowres_wide.traj", "lowres_depth"), "is a scene of ARKitScenes", _LISTS),
    (
        ("scene_camera_*.json", "rgb_cam*"),
        "is a BOP scene of several cameras",
        "expected the files of one with the usual names: scene_gt.json, scene_camera.json, rgb, "
        "depth, mask_visib",
    ),
    (("gray",), "is a BOP scene in grey", "expected rgb/ and depth/ as PNG"),
    (
        ("scene_camera.json", "scene_gt.json"),
        "lacks scene_gt.json, scene_camera.json or rgb/ of a BOP scene",
        _HOW,
    ),
    (
        ("depth/*.exr",),
        "has depth/*.exr, as Record3D's EXR + JPG export, which no library here decodes",
        "expected Record3D's .r3d export",
    ),
    (
        _COLMAP,
        "has COLMAP's poses, whose lengths are not those of measured depth",
        "expected rgb/ and depth/ without them, raw data of LiDAR, or lists in metres",
    ),
    (("odometry.csv",), "lacks rgb.mp4 of Stray Scanner's scan", _HOW),
    (
        ("rgb.txt", "depth.txt", "depth"),
        "has images and depth, but no poses (groundtruth.txt, poses.txt, pose/, ...)",
        "expected their file; or rgb/ and depth/ alone, in millimetres or --depth-unit, whose "
        "poses are found",
    ),
    (("*.sens",), "is ScanNet's packed scan", "expected it unpacked by ScanNet's SensReader"),
    (
        ("*.bag",),
        "is a recording of RealSense",
        "expected the folder that open3d.t.io.RGBDVideoReader.create(FILE).save_frames(FOLDER) "
        "writes",
    ),
    (
        ("*.mkv",),
        "is a video, such as Azure Kinect's",
        "expected the folder that Open3D's azure_kinect_mkv_reader.py writes",
    ),
    (("*.mp4", "*.mov", "*.m4v"), "is a video without depth and poses", _HOW),
    (
        ("*.ply", "*.splat", "*.obj", "*.glb", "*.usdz"),
        "is a model as Luma or KIRI export it, without depth and poses",
        _HOW,
    ),
    (
        tuple(f"{folder}*{ending}" for folder in ("", "images/") for ending in PICTURES),
        "has photographs, but no depth and poses in a known format",
        _HOW,
    ),
)


def recognise(given: Any) -> tuple[str, Any]:
    """Return the format of an object's frames, and the folder or file that its reader takes.

    The format is "image", "sequence" of a data folder, a name in `FORMATS` of a capture (a folder,
    the zip or .r3d file of an app, or a transforms.json), or "frames" for what is no path.
    InputError for another path. The message says what is missing, or what is expected.
    """
    if not isinstance(given, str | Path):
        return "frames", given
    path = Path(given)
    if path.is_file() and path.suffix.lower() in PICTURES:
        return "image", path
    # The path as it is given, or behind links; both absolute, so that "." and "mine/cup/.." have
    # names.
    for folder in (Path(os.path.abspath(path)), path.resolve()):
        if folder.is_dir() and (folder.parent / FRAMES_FILE).is_file():
            return "sequence", folder
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
    names = [path.name.lower()] if path.exists() else []
    for place, level in product(places, ("*", "*/*")):
        names += (file.relative_to(place).as_posix().lower() for file in place.glob(level))
    for signs, problem, way_out in _OTHERS:
        for sign, name in product(signs, names):
            if fnmatch(name, sign) and name.count("/") == sign.count("/"):
                raise InputError(f"{path} {problem}, {way_out}")
    problem = "has another format" if path.exists() else "does not exist"
    if len(files) > 1:
        problem += f" ({', '.join(sorted(file.name for file in files)[:4])}, ...)"
    known = "; ".join(f"{layout.what} ({', '.join(layout.signs)})" for layout in FORMATS.values())
    known = known.replace(RECORDED, "rgb or color")
    raise InputError(
        f"{path} {problem}, expected a picture (.jpg, .png, .webp), CATEGORY/SEQUENCE of a data "
        f"folder, or a folder or zip with the files of {known}"
    )


def open_capture(
    path: str | Path,
    layout: str | None = None,
    count: int = MOST_FRAMES,
    masks: Path | None = None,
    attributes: Mapping[str, Any] = {},
    **options: Any,
) -> Capture:
    """Read a capture's frames (see `open_source`), with the masks of its folder masks/, if any.

    The `layout`, a name in `FORMATS`, is recognised by default; otherwise the path is what its
    reader takes. `attributes` are of `CaptureFrame` and replace those of every frame.
    InputError if the capture cannot be read, or no frame can be used.
    """
    folder = Path(path)
    if layout is None:
        layout, folder = recognise(path)
    if layout == "stray":  # the reader chooses the sharp frames, because it decodes a video
        options["count"] = count
    if layout == "recording":  # the reader loads the frames to find their poses
        options["attributes"] = attributes
    frames = []
    left_out = []
    # The folder to which a zip is unpacked.
    unpacked = re.compile(rf"{re.escape(gettempdir())}.zsp-lite-\w+.")
    try:
        for make in FORMATS[layout].read(folder, **options):
            try:
                frames.append(make())
            # A path out of the folder is no mistake of one frame: nothing of such a capture is
            # read.
            except OutsideError:
                raise
            except (InputError, OSError) as error:  # OSError for a name that is too long
                left_out.append(str(error))
    except InputError as error:
        raise InputError(unpacked.sub("", str(error))) from error
    frames.sort(key=lambda frame: natural_order(frame.image))

    # The number of a frame is the last one in its image's name, or 0; of a long number, the last 15
    # digits, which a float holds, too. If they do not rise with the order, it is the position.
    names = [Path(frame.image.name) for frame in frames]
    numbers = [[0, *natural_order(name)][-2] % 10**15 for name in names]
    if numbers != sorted(set(numbers)):
        numbers = range(len(frames))

    # A frame's own mask comes before the one in the capture's folder masks/. If the folder `masks`
    # is given, all masks are from it.
    images = [frame.image for frame in frames]
    if folder.is_file():
        folder = folder.parent
    paths = find_masks(masks or folder / "masks", images)
    if masks and frames and not any(paths):
        raise InputError(
            f"--masks {masks} has no mask that is named like an image, such as {images[0].stem}.png"
        )
    if not masks:
        paths = [frame.mask or mask for frame, mask in zip(frames, paths)]
    frames = [
        replace(frame, mask=mask, number=number, **attributes)
        for frame, mask, number in zip(frames, paths, numbers)
    ]

    sharp = sharpest(frames, count, lambda frame: frame.load().rgb, left_out)
    frames = [frame for frame, _ in sharp]
    left_out = [unpacked.sub("", problem) for problem in left_out]
    if not frames:
        raise InputError(
            f"capture {folder.resolve().name}: none of {len(left_out)} frames can be used: "
            f"{first_three(left_out) or 'it lists none'}"
        )
    return Capture(frames, left_out)
