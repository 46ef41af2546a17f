"""RGB-D captures: the files and camera of a frame, and what the readers of formats share."""

import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple, NoReturn

import cv2
import msgspec
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.spatial.transform import Rotation

from zsp_lite.data.arrays import (
    camera_from_pose,
    distortion_coefficients,
    enlarge_depth,
    undistort,
)
from zsp_lite.data.cameras import Camera, Values
from zsp_lite.data.frames import Frame, check_pixels, decode_image
from zsp_lite.errors import InputError, real_array
from zsp_lite.importers import files
from zsp_lite.io.files import read_bytes, shown

# OpenCV's and Open3D's pixel centres are at integers: their principal points are smaller by this.
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
# The camera of TUM's benchmark and of Redwood's scans, where none is given; pixel centres at
# half-integers.
PRIMESENSE = {
    "intrinsics": (525.0, 525.0, 320.0, 240.0),
    "doubt": "no --intrinsics FX,FY,CX,CY: the camera is taken for TUM's and Redwood's PrimeSense",
}
FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenGL's camera: +y up, looking along -z
# Greater depth counts as unknown, such as Blender's 1e10; in units of the world.
_FARTHEST = 1e4
MOST_FRAMES = 100  # by default, so many sharp frames of a larger capture are chosen
_CANDIDATES = 10  # largest number of frames of which the sharpest is chosen
# Longest side in pixels of the copy of an image whose sharpness is measured.
_SHARPNESS_SIDE = 640


class OutsideError(InputError):
    """A path whose text leads out of its folder, not a link on it."""


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """Files and camera of a frame."""

    image: Path
    depth: Path  # of the image's aspect ratio; phones store it smaller than the image
    camera: Camera
    depth_unit: float = 0.001  # world units per stored depth value
    # OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]. `load` undistorts image, depth and mask.
    distortion: Values = ()
    mask: Path | None = None
    # Whether the distortion is that of OpenCV's fisheye cameras: k1, k2, k3, k4.
    fisheye: bool = False
    confidence: Path | None = None  # of each pixel of the depth map, see `trusted`
    label: int | None = None  # number of the object in masks that label several objects
    # Whether camera, depth and mask are those of the photograph as "stored", or as "displayed" by
    # its EXIF orientation; None if their sizes show it (see `files.lies_as_stored`).
    orientation: str | None = None
    posed: bool = True  # False for a single image, whose world is its camera's frame
    doubt: str = ""  # what may be wrong: camera, pose, or which image it is
    number: int = 0  # the last in the image's name, or else the position

    def load(self) -> Frame:
        """Load the frame as viewers display it; InputError if a file cannot be used."""
        rgb, exif = files.read_picture(self.image)
        # A function that says whether an image of a size is in the form of the stored pixels, which
        # the EXIF orientation turns to the displayed form.
        lies_stored = partial(files.lies_as_stored, rgb.shape, exif, self.orientation, self.image)

        def displayed(image: np.ndarray) -> np.ndarray:
            """Turn an image to the form that viewers display, if it is not in that form."""
            return files.display_image(image, exif) if lies_stored(image.shape) else image

        camera = self.camera
        if lies_stored(camera.size):
            camera = files.display_camera(camera, exif, self.image.name, self.posed)
        rgb = files.display_image(rgb, exif)
        depth = displayed(self._read_depth())
        check_pixels(self.image, rgb, camera.size)
        enlarged = enlarge_depth(depth, camera.size)
        if enlarged.shape != camera.size:
            raise InputError(
                f"depth {self.depth} is {depth.shape} pixels, expected (H, W) = {camera.size} as "
                "the image, or smaller with its aspect ratio"
            )
        mask = None
        if self.mask is not None:
            mask = displayed(files.read_mask_file(self.mask, self.label))
            check_pixels(self.mask, mask, camera.size)
        coefficients = np.array(self.distortion)
        if len(coefficients) and not self.fisheye:
            # In OpenCV's model, p2 shifts points along x and p1 along y: the vector (p2, p1) turns
            # with the image.
            turn = (camera.R @ self.camera.R.T)[:2, :2]
            coefficients[[3, 2]] = turn @ coefficients[[3, 2]]
        frame = Frame(rgb, enlarged, mask, camera, self.image.name)
        return undistort(frame, coefficients, self.fisheye)

    def _read_depth(self) -> Float32[np.ndarray, "h w"]:
        """Read the depth, 0 where it is unknown, implausibly far or not trusted."""
        depth = files.read_depth_file(self.depth) * np.float32(self.depth_unit)
        known = depth <= _FARTHEST
        if self.confidence is not None:
            levels = decode_image(self.confidence, "confidence", cv2.IMREAD_GRAYSCALE)
            check_pixels(self.confidence, levels, depth.shape)
            known &= trusted(levels)
        return np.where(known, depth, np.float32(0))


class Capture(NamedTuple):
    """Frames of a capture, sorted by the names of their images: frame 10 follows frame 9."""

    frames: list[CaptureFrame]
    left_out: list[str]  # for each frame that is left out, what is wrong with it


# A reader yields functions, each of which makes a frame, or raises InputError if it cannot be used.
Makers = Iterator[Callable[[], CaptureFrame]]


def make_frame(
    folder: Path,
    image: str | Path,
    depth: str | Path,
    pose: Values,
    intrinsics: Values,
    where: str,
    axes: Values = np.eye(4),
    size: tuple[int, int] | None = None,
    mask: str | None = None,
    confidence: str | Path | None = None,
    distortion: Values = (),
    **others: Any,
) -> CaptureFrame:
    """Make a frame from files and numbers of a capture; InputError if a file is missing or wrong.

    The pose, camera to world, is a matrix of 12 or 16 numbers, or a position and a quaternion x, y,
    z, w. After multiplication by `axes`, it has OpenCV's camera axes. Intrinsics are fx, fy, cx, cy
    or a matrix. Mask and confidence may be missing.
    """
    names = (image, depth, mask, confidence)
    paths = [find_inside(folder, name) if isinstance(name, str) else name for name in names]
    # The image and the depth are needed.
    if None in paths[:2]:
        raise InputError(f"{where}: {names[paths.index(None)]} is missing in {folder}")

    # The pose as a matrix (4, 4) or (3, 4).
    pose = real_array(f"{where}: pose", pose)
    if pose.size not in (7, 12, 16):
        raise InputError(f"{where}: the pose has {pose.size} numbers, expected 7, 12 or 16")
    if pose.size == 7:
        length = np.linalg.norm(pose[3:])
        if not 0.9 < length < 1.1:  # farther from 1 than by rounding: other numbers
            raise InputError(
                f"{where}: quaternion {pose[3:].tolist()} has the length {length:.3g}, expected 1"
            )
        pose = np.column_stack([Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]])
    with np.errstate(invalid="ignore"):  # `camera_from_pose` refuses numbers that are not finite
        pose = pose.reshape(-1, 4) @ axes

    camera = camera_from_pose(pose, intrinsics, size or files.picture_size(paths[0]), where)
    if not others.get("fisheye"):
        distortion = distortion_coefficients(where, distortion)
    return CaptureFrame(
        *paths[:2],
        camera,
        distortion=distortion,
        mask=paths[2],
        confidence=paths[3],
        **others,
    )


def first_three(problems: Iterable[str]) -> str:
    """List three different problems, and count the others."""
    different = list(dict.fromkeys(problems))
    more = f"; and {len(different) - 3} more" if len(different) > 3 else ""
    return f"{'; '.join(different[:3])}{more}"


def refuse(problem: str) -> NoReturn:
    """Raise InputError: a maker for a frame that cannot be made."""
    raise InputError(problem)


def natural_order(path: Path) -> list[str | int]:
    """Return a key to sort paths: frame 10 follows frame 9."""
    parts = re.split(r"(\d+)", path.as_posix())  # every second part is a number
    return [int(part) if k % 2 else part for k, part in enumerate(parts)]


def sharpest(
    items: Sequence[Any], count: int, read: Callable[[Any], np.ndarray], left_out: list[str]
) -> Iterator[tuple[Any, np.ndarray]]:
    """Split items into `count` stretches, and yield the sharpest item of each with its image.

    The problems of unreadable items are added to `left_out`. The first item is a stretch of its
    own, because a user may have drawn a box in it.
    """
    stretches = [[position] for position in range(len(items))]
    if len(items) > count:
        # With a count of 1, the slice below drops the single later stretch.
        later = np.array_split(np.arange(1, len(items)), max(count - 1, 1))
        # Evenly spaced candidates of each stretch: the step is rounded up.
        stretches = [[0], *(part[:: -(-len(part) // _CANDIDATES)].tolist() for part in later)]
    for stretch in stretches[:count]:
        best = -1.0
        chosen = None
        for position in stretch:
            try:
                image = read(items[position])
            except InputError as error:
                left_out.append(str(error))
                continue
            sharpness = _sharpness(image)
            if sharpness > best:
                best = sharpness
                chosen = (items[position], image)
        if chosen:
            yield chosen


def _sharpness(image: UInt8[np.ndarray, "..."]) -> float:
    """Return the variance of the Laplacian of a small copy of an image."""
    scale = min(1.0, _SHARPNESS_SIDE / max(image.shape))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(small, cv2.CV_32F).var())


def trusted(levels: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Select the pixels of measured depth by levels of confidence: 0, 1, 2, or 0 to 255.

    The highest level is measured, the lowest unknown. Pixels of a middle level are trusted in wide
    regions, such as dark surfaces. They are not trusted in thin bands along silhouettes, where the
    depth is a mean of object and background.
    """
    best = levels >= (2 if levels.max() <= 2 else 255)
    middle = ((levels > 0) & ~best).astype(np.uint8)
    return best | (cv2.morphologyEx(middle, cv2.MORPH_OPEN, files.WINDOW_5) > 0)


def find_masks(folder: str | Path, images: Sequence[Path]) -> list[Path | None]:
    """Find the mask of each image in a folder: its path there is an end of the image's path.

    For example, the mask of `scan/images/a/1.jpg` is `images/a/1.png`, `a/1.png`, `1.jpg.png` or
    `1.png` in the folder. The extension of the image may be part of the mask's name. The longest
    such path counts. An end that several images share is no name of a mask.
    """
    # The images that each end of a path belongs to.
    owners = defaultdict(list)
    for image in images:
        for parts in (image.parts, image.with_suffix("").parts):
            for start in range(len(parts)):
                owners["/".join(parts[start:])].append(image)
    masks = {}
    # A longer path comes later and replaces a shorter one.
    for path in sorted(Path(folder).rglob("*.*"), key=lambda path: (len(str(path)), path)):
        owner = owners[path.relative_to(folder).with_suffix("").as_posix()]
        if path.suffix.lower() in files.MASKS and len(owner) == 1:
            masks[owner[0]] = path
    return [masks.get(image) for image in images]


def read_text_lines(path: Path, least: int = 1) -> list[str]:
    """Read the lines of a text file, without empty lines and lines that begin with #."""
    text = read_bytes(path, "list").decode("utf-8-sig", "replace")
    lines = [line.strip() for line in text.splitlines()]
    lines = [line for line in lines if line and line[0] != "#"]
    if len(lines) < least:
        raise InputError(f"{path} has {len(lines)} lines, expected at least {least}")
    return lines


def read_numbers(
    path: Path, columns: tuple[int, ...], **options: Any
) -> Float[np.ndarray, "rows columns"]:
    """Read a text file by `numpy.loadtxt`; `columns` has the possible numbers of columns."""
    lines = read_text_lines(path)
    try:
        values = np.loadtxt(lines, ndmin=2, **options)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if values.shape[1] not in columns:
        raise InputError(
            f"{path}: {values.shape[1]} numbers per line, expected {' or '.join(map(str, columns))}"
        )
    return values


def find_inside(root: str | Path, text: str) -> Path | None:
    """Find a file in a folder by a path, relative or absolute, that another file gives.

    The path of an image may lack its extension. Links inside the folder may lead anywhere, because
    its owner made them. OutsideError if the text of the path leads out of the folder.
    """
    root = os.path.abspath(root)
    text = text.replace("\\", "/")
    # A path with a drive is absolute, also on systems that have no drives.
    path = os.path.normpath(text if PureWindowsPath(text).drive else os.path.join(root, text))
    # An absolute path may begin with the folder as it is given, or with the folder behind links.
    if text and not path.startswith(
        (os.path.join(root, ""), os.path.join(os.path.realpath(root), ""))
    ):
        expected = "a path inside, relative or absolute; a link inside may lead elsewhere"
        raise OutsideError(
            f"path {shown(text)} leads out of the folder {root}, expected {expected}"
        )
    for ending in ("", ".png", ".jpg", ".jpeg"):
        if os.path.isfile(path + ending):
            return Path(path + ending)
    return None


def convert_plain(value: Any, kind: Any, what: str) -> Any:
    """Convert plain values, such as decoded JSON or the row of a table, to a type of msgspec, with
    the errors of `decode_json`."""
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{what}: {error}") from error
