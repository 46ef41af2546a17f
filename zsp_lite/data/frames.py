"""RGB-D frames with object masks: cropping, resizing, and the image files of data folders."""

import io
import pkgutil
import reprlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Real, UInt8
from PIL import Image

from zsp_lite.data.cameras import Box, Camera, Values
from zsp_lite.data.depth import decode_depth
from zsp_lite.errors import MAX_LENGTH, InputError, real_array
from zsp_lite.io.files import read_bytes

MAX_PIXELS = 1 << 26  # of an image file
# What is expected in place of files that no decoder here reads.
_NOT_READ = {
    ".heic": "the photograph as JPEG",
    ".heif": "the photograph as JPEG",
    ".exr": "the depth as .npy or a float .tiff",
}
ON_OBJECT = 0.5  # a pixel is on the object if its mask probability is above this
# An image of which at most one value in 1000 is above this one is black, as CO3D's hidden frames
# are, and noise under a lens cap.
_BLACK = 25


@dataclass(frozen=True, eq=False)
class Frame:
    """Image with its camera and, if known, its depth map and object mask.

    The arrays are copied. InputError if they do not fit together.
    """

    rgb: UInt8[np.ndarray, "h w 3"]  # (H, W, 3) colours, uint8
    # (H, W) along +z in units of the camera's world, 0 where unknown.
    depth: Float32[np.ndarray, "h w"] | None
    # (H, W) probability that a pixel is on the object, in [0, 1].
    mask: Float32[np.ndarray, "h w"] | None
    camera: Camera
    name: str = ""  # for error messages
    defect: str = ""  # why the frame cannot be used, such as "the camera's pose is not finite"

    def __post_init__(self):
        label = f"frame {self.name}".rstrip()
        size = self.camera.size
        rgb = np.array(self.rgb)
        if rgb.dtype != np.uint8 or rgb.shape != (*size, 3):
            raise InputError(
                f"{label} rgb is {rgb.dtype} {rgb.shape}, expected uint8 {(*size, 3)} as the camera"
            )
        object.__setattr__(self, "rgb", rgb)
        for name, top in (("depth", MAX_LENGTH), ("mask", 1.0)):
            values = getattr(self, name)
            if values is None:
                continue
            if getattr(values, "dtype", None) == np.float32:
                values = np.array(values)
            else:
                values = real_array(f"{label} {name}", values).astype(np.float32)
            problem = ""
            if values.shape != size:
                problem = f"shape {values.shape}"
            elif not (values.min() >= 0 and values.max() <= top):  # NaN is not in the range
                problem = f"{values.min()} to {values.max()}"
            if problem:
                raise InputError(
                    f"{label} {name} has {problem}, expected shape {size} and values from 0 to "
                    f"{top:g}"
                )
            object.__setattr__(self, name, values)

    @classmethod
    def from_arrays(
        cls,
        rgb: np.ndarray,
        depth: np.ndarray,
        K: Values,
        mask: np.ndarray | None = None,
        pose: Values | None = None,
        depth_unit: float = 1.0,
        name: str = "",
        distortion: Values | None = None,
    ) -> "Frame":
        """Make a frame of arrays as a camera gives them, in any unit of length.

        Args:
            rgb: Colours (H, W, 3), with or without alpha, or grey (H, W) or (H, W, 1): uint8, or
                floats from 0 to 1.
            depth: Numbers (h, w) or (h, w, 1) along +z, registered to the colours, of their size,
                or smaller and of the same aspect ratio; unknown where NaN, infinite, zero or
                negative.
            K: Intrinsics of the colours, (3, 3) or (fx, fy, cx, cy), pixels; the first pixel's
                centre is (0, 0).
            mask: The object's pixels (H, W) or (H, W, 1): booleans, 0 and 1, or 0 to 255. By
                default, `estimate_pose` finds the object.
            pose: Rigid transform (4, 4) or (3, 4) from camera to world in OpenCV's axes (x right, y
                down, z forward), in units of the world. By default, the world is the camera's
                frame. A frame whose pose is NaN, as where a tracker is lost, has a `defect`:
                estimates leave it out.
            depth_unit: World units per unit of `depth`.
            name: Name for messages and reports.
            distortion: Coefficients of the lens in OpenCV's order, k1, k2, p1, p2[, k3[, k4, k5,
                k6]]. Colours, depth and mask are undistorted; `K` stays.

        Raises:
            InputError: An array has another shape or type, or the arrays do not fit together.
        """
        # A module above this one, imported when it is used.
        frame_from_arrays = pkgutil.resolve_name("zsp_lite.data.arrays:frame_from_arrays")
        return frame_from_arrays(rgb, depth, K, mask, pose, depth_unit, name, distortion)

    @property
    def shows_object(self) -> bool:
        """Whether some pixel is on the object; without a mask all are."""
        return self.mask is None or bool((self.mask > ON_OBJECT).any())

    def __repr__(self) -> str:
        height, width = self.camera.size
        return f"Frame({self.name!r}, {height} x {width} pixels)"


def list_frames(frames: Frame | Iterable[Frame]) -> list[Frame]:
    """List the frames of any iterable, or a single one; InputError if they are none."""
    listed = list(frames) if np.iterable(frames) else [frames]
    if not listed or not all(isinstance(frame, Frame) for frame in listed):
        raise InputError(
            f"frames are {reprlib.repr(frames)}, expected one zsp_lite.Frame or several"
        )
    return listed


def frame_defect(frame: Frame) -> str:
    """Say why a frame cannot be used, such as "black image"; "" for a usable frame."""
    if frame.defect:
        return frame.defect
    if (frame.rgb > _BLACK).mean() <= 0.001:
        return "black image"
    if not frame.shows_object:
        return "empty object mask"
    if frame.depth is None:
        return "no depth map"
    return "" if (frame.depth > 0).any() else "no known depth"


def mask_to_bbox(mask: Real[np.ndarray, "h w"], padding: float = 0.1) -> Box:
    """Compute the padded bounding box (top, left, height, width) of the mask above 0.4.

    If no pixel is above it, the threshold is lowered in steps of 0.05, down to 0. Height and width
    grow by the fraction `padding`, half of it on each side, as in CO3D's loader. InputError if the
    mask is empty.
    """
    if not (mask > 0).any():
        raise InputError(f"object mask of shape {mask.shape} is empty, expected a pixel above 0")
    threshold = 0.4
    inside = mask > threshold
    while not inside.any():
        threshold = max(threshold - 0.05, 0.0)
        inside = mask > threshold
    top, bottom = _span(inside.any(axis=1), padding)
    left, right = _span(inside.any(axis=0), padding)
    return top, left, bottom - top, right - left


def crop_to_object(frame: Frame) -> Frame:
    """Crop a frame and its camera to the bounding box of its object mask (see `mask_to_bbox`)."""
    box = mask_to_bbox(frame.mask)
    top, left, height, width = box
    inside = np.s_[top : top + height, left : left + width]
    return with_images(frame, frame.camera.crop(box), lambda image: image[inside])


def resize_frame(frame: Frame, size: tuple[int, int]) -> Frame:
    """Resize a frame to (height, width); colours are averaged along a side that shrinks."""
    camera = frame.camera.resize(size)
    height, width = camera.size
    old_height, old_width = frame.camera.size
    # INTER_AREA averages only if neither side grows: first shrink, then enlarge the sides that
    # grow.
    rgb = cv2.resize(
        frame.rgb, (min(width, old_width), min(height, old_height)), interpolation=cv2.INTER_AREA
    )
    rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_LINEAR)
    depth = frame.depth
    mask = frame.mask
    # Depth is that of the nearest pixel: values interpolated at an edge or hole lie on no surface.
    # The centre of pixel i is at the fraction (2 i + 1) / (2 height) of the side.
    if depth is not None:
        rows = (2 * np.arange(height) + 1) * old_height // (2 * height)
        cols = (2 * np.arange(width) + 1) * old_width // (2 * width)
        depth = depth[np.ix_(rows, cols)]
    if mask is not None:
        mask = cv2.resize(
            np.ascontiguousarray(mask), (width, height), interpolation=cv2.INTER_LINEAR
        ).clip(0, 1)
    return replace(frame, rgb=rgb, depth=depth, mask=mask, camera=camera)


def read_image(path: str | Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read the colours (H, W, 3) of an image file; InputError if it is damaged."""
    # An orientation tag is ignored, because the camera refers to the pixels as stored.
    image = decode_image(path, "image", cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.ascontiguousarray(image[..., ::-1])


def read_mask(path: str | Path) -> Float32[np.ndarray, "h w"]:
    """Read an 8-bit or 1-bit mask file as probabilities (H, W) in [0, 1]."""
    return decode_image(path, "mask", cv2.IMREAD_GRAYSCALE).astype(np.float32) / 255


def read_depth(path: str | Path, scale_adjustment: float = 1.0) -> Float32[np.ndarray, "h w"]:
    """Read a CO3D depth file (see `decode_depth`) as (H, W), 0 where unknown."""
    bits = decode_image(path, "depth", cv2.IMREAD_UNCHANGED)
    if bits.dtype != np.uint16 or bits.ndim != 2:
        raise InputError(
            f"depth {path} holds {bits.dtype} of shape {bits.shape}, expected a 16-bit "
            "greyscale PNG"
        )
    return decode_depth(bits, scale_adjustment)


def check_pixels(path: str | Path, image: np.ndarray, size: tuple[int, int]) -> None:
    """Raise InputError if the image of a file is not of this size (H, W)."""
    if image.shape[:2] != size:
        raise InputError(f"{path} is {image.shape[:2]} pixels, expected (H, W) = {size}")


def with_images(frame: Frame, camera: Camera, change: Callable[[np.ndarray], np.ndarray]) -> Frame:
    """Return a frame with a new camera, and with `change` applied to colours, depth and mask."""
    images = {"rgb": frame.rgb, "depth": frame.depth, "mask": frame.mask}
    changed = {name: change(image) for name, image in images.items() if image is not None}
    return replace(frame, camera=camera, **changed)


def _span(inside: np.ndarray, padding: float) -> tuple[int, int]:
    """Return the range [start, end) of the true values of an array, padded within its length."""
    first, last = np.flatnonzero(inside)[[0, -1]]
    end = last + 1
    margin = (end - first) * padding / 2
    return max(0, int(np.floor(first - margin))), min(len(inside), int(np.ceil(end + margin)))


@contextmanager
def decoding(path: str | Path, what: str) -> Iterator[bytes]:
    """Read a file; InputError, in one line that names it, if the block cannot decode it."""
    data = read_bytes(path, what)
    try:
        yield data
    except InputError:
        raise
    except Exception as error:  # numpy, Pillow and OpenCV may raise anything
        suffix = Path(path).suffix.lower()
        complete = f"a complete {suffix or 'image'} file of at most {MAX_PIXELS} pixels"
        problem = error if isinstance(error, ValueError) else type(error).__name__
        raise InputError(
            f"{what} {path} cannot be decoded ({problem}, {len(data)} bytes), "
            f"expected {_NOT_READ.get(suffix, complete)}"
        ) from error


def open_image(data: bytes, formats: Sequence[str] = ("JPEG", "PNG")) -> Image.Image:
    """Open an image of one of Pillow's formats, without decoding its pixels; ValueError for too
    many."""
    file = Image.open(io.BytesIO(data), formats=formats)
    if file.width * file.height > MAX_PIXELS:
        raise ValueError(f"{file.height} x {file.width} pixels")
    return file


def decode_image(path: str | Path, what: str, flags: int) -> np.ndarray:
    """Decode a JPEG or PNG file by OpenCV with its flags; InputError if it is damaged."""
    with decoding(path, what) as data:
        # Pillow refuses incomplete files; OpenCV would fill missing parts with grey.
        file = open_image(data)
        if file.format == "PNG":
            file.verify()
        else:
            file.load()
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
        if image is None:
            raise ValueError("damaged")
    return image
