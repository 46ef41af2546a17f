"""Pictures, depth maps and masks of cameras, apps and labelling tools; doubts about intrinsics.

A photograph's EXIF orientation says how viewers turn and mirror the stored pixels. Its depth, its
mask and its camera may refer to the pixels as stored or as displayed.
"""

import io
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8
from PIL import ExifTags

from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import decode_image, decoding, open_image, read_depth, read_image
from zsp_lite.errors import InputError
from zsp_lite.io.files import MAX_FILE

WINDOW_5 = np.ones((5, 5), np.uint8)  # of OpenCV's filters of masks, pixels
PICTURES = (".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif")
_FORMATS = ("JPEG", "PNG", "WEBP")
DEPTHS = (".png", ".npy", ".npz", ".tiff", ".tif", ".pfm", ".exr")
MASKS = (".png", ".jpg", ".jpeg", ".webp", ".tiff", ".tif", ".npy")
CO3D_DEPTH = ".geometric.png"  # such a file has the bits of float16 values
# For each EXIF orientation, 1 to 8, the number of quarter turns as in `numpy.rot90`; and the
# orientations whose image is mirrored left to right after the turn.
_QUARTERS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 3, 7: 1, 8: 1}
_MIRRORED = (2, 4, 5, 7)
# Compression of these files blurs two values of a mask to many.
_LOSSY = (".jpg", ".jpeg", ".webp")
# A mask has labels if it has at most this many values and no greater value; otherwise it has
# probabilities.
_MOST_LABELS = 32
_LARGEST_LABEL = 50
_VOID = 255  # label of pixels that belong to nothing, as in PASCAL VOC
# Range of the field of view of a camera, degrees.
_LEAST_VIEW = 10.0
_LARGEST_VIEW = 120.0
_LARGEST_SENSOR = 60  # width of the largest sensor of a camera, millimetres
_UNEQUAL = 1.3  # ratio of the focal lengths above which they are doubtful
# Distance of the principal point from the middle, relative to half of the side, above which it is
# doubtful.
_OFF_MIDDLE = 0.3


def read_picture(path: str | Path) -> tuple[UInt8[np.ndarray, "h w 3"], int]:
    """Read the colours of a JPEG, PNG or WebP file as stored, and its EXIF orientation."""
    with decoding(path, "image") as data:
        file = open_image(data, _FORMATS)
        # Without EXIF, `getexif` would decode a whole PNG, and take the orientation of XMP.
        orientation = file.getexif().get(ExifTags.Base.Orientation) if "exif" in file.info else 1
        rgb = np.array(file.convert("RGB")) if file.format == "WEBP" else read_image(path)
    return rgb, orientation if orientation in _QUARTERS else 1


def picture_size(path: str | Path) -> tuple[int, int]:
    """Read the size (H, W) of a picture as stored from its header."""
    with decoding(path, "image") as data:
        return open_image(data, _FORMATS).size[::-1]


def read_depth_file(path: str | Path) -> Float32[np.ndarray, "h w"]:
    """Read the stored values of a depth map, 0 where unknown.

    A value is unknown if it is not finite, not positive, or 65535 in 16 bits.
    """
    path = Path(path)
    if path.name.endswith(CO3D_DEPTH):
        return read_depth(path)
    values = _read_values(path, "depth")
    # Blender writes the depth three times, as colours of an .exr file.
    if values.ndim == 3 and (values.shape[2] == 1 or path.suffix.lower() == ".exr"):
        values = values[..., 0]
    if (
        values.ndim != 2
        or values.dtype.kind not in "fiu"
        or values.dtype.itemsize < 2
        or not values.size
    ):
        raise InputError(
            f"depth {path} holds {values.dtype} of shape {values.shape}, expected numbers (H, W): "
            "a 16-bit greyscale PNG or TIFF, .npy, .npz with one array, or float .tiff or .pfm"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        depth = values.astype(np.float32)
    known = np.isfinite(depth) & (depth > 0) & ((depth != 65535) | (values.dtype.itemsize != 2))
    return np.where(known, depth, np.float32(0))


def read_mask_file(path: str | Path, label: int | None = None) -> Float32[np.ndarray, "h w"]:
    """Read a mask file as probabilities (H, W) in [0, 1].

    Of two values, the larger is the object. A picture with a palette, or with at most 32 values
    from 0 to 50, has labels: the object is the only label beside 0, or the given `label`. Other
    values are probabilities. JPEG and WebP blur two values to many: values above half of the
    largest are the object.
    """
    values, has_labels = _mask_values(Path(path))
    levels = np.unique(values)  # sorted
    integers = values.dtype.kind in "iu"
    lossy = Path(path).suffix.lower() in _LOSSY
    labels = levels[(levels > 0) & (levels != _VOID)]
    if integers and len(levels) <= _MOST_LABELS and max(labels, default=0) <= _LARGEST_LABEL:
        has_labels = True

    if label is not None:
        mask = values == label
    elif len(levels) <= 2:
        mask = (values == levels[-1]) & (values > 0)
    elif lossy:
        mask = values > levels[-1] / 2
    elif not has_labels:
        certain = max(1.0, levels[-1])  # the value for a probability of 1
        if integers:
            certain = 65535 if values.dtype == np.uint16 else 255
        mask = values / certain
    elif len(labels) == 1:
        mask = values == labels[0]
    else:
        raise InputError(
            f"mask {path} has the labels {', '.join(map(str, labels))}, expected --label with "
            "one of them"
        )
    return mask.astype(np.float32)


def _mask_values(path: Path) -> tuple[Shaped[np.ndarray, "h w"], bool]:
    """Read the values of a mask file, and whether they are labels, each of one colour."""
    values = _read_values(path, "mask")
    if path.suffix.lower() == ".png":
        with decoding(path, "mask") as data:
            file = open_image(data)
            if file.mode == "P" and np.ptp(np.array(file.convert("RGB")), axis=2).any():
                return np.array(file), True
    if values.ndim == 3 and values.shape[2] in (1, 3, 4):
        colours = values[..., :3]
        alpha = values[..., 3:]
        # The transparency of a picture that is cut out is its mask.
        if alpha.size and np.ptp(alpha):
            return alpha[..., 0], False
        if path.suffix.lower() not in _LOSSY and (colours != colours[..., :1]).any():
            # Each colour, three channels of up to 16 bits, becomes one number.
            codes = colours @ np.array([1 << 32, 1 << 16, 1])
            kinds, numbers = np.unique(codes, return_inverse=True)
            if len(kinds) <= _MOST_LABELS:
                return numbers.reshape(colours.shape[:2]), True
        values = colours.max(axis=2)
    if values.ndim != 2 or values.dtype.kind not in "fiub" or not values.size:
        raise InputError(
            f"mask {path} holds {values.dtype} of shape {values.shape}, expected one value "
            "per pixel"
        )
    return values, False


def _read_values(path: Path, what: str) -> Shaped[np.ndarray, "..."]:
    """Read the values of an array or image file as stored."""
    suffix = path.suffix.lower()
    with decoding(path, what) as data, warnings.catch_warnings(action="ignore"):
        if suffix not in (".npy", ".npz"):
            if suffix in (".tif", ".tiff", ".pfm", ".webp"):
                return np.array(open_image(data, ("TIFF", "PPM", "WEBP")))
            if suffix != ".exr":
                return decode_image(path, what, cv2.IMREAD_UNCHANGED)
            # Without the variable OPENCV_IO_ENABLE_OPENEXR, this returns None or raises an error.
            values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            if values is None:
                raise ValueError("damaged, or OpenCV reads no .exr here")
            return values
        values = np.load(io.BytesIO(data), allow_pickle=False)
        if isinstance(values, np.ndarray):
            return values
        if len(values.files) != 1:
            raise InputError(f"{what} {path} holds {len(values.files)} arrays, expected one")
        if values.zip.infolist()[0].file_size > MAX_FILE:
            raise ValueError("the array is too large")
        return values[values.files[0]]


def lies_as_stored(
    stored: Sequence[int], orientation: int, form: str | None, path: Path, size: Sequence[int]
) -> bool:
    """Tell whether an image of a size lies as a photograph's stored pixels, or as displayed.

    The size tells it if the EXIF orientation exchanges the sides, and `form` otherwise.
    """
    if orientation == 1:
        return True
    # Orientations above 4 exchange height and width.
    if orientation > 4 and stored[0] != stored[1]:
        return (size[0] < size[1]) == (stored[0] < stored[1])
    if form is None:
        raise InputError(
            f"{path}: EXIF orientation {orientation} turns it, and sizes do not show whether "
            "depth, mask and intrinsics are turned, too, expected --orientation stored or "
            "--orientation displayed"
        )
    return form == "stored"


def display_image(image: Shaped[np.ndarray, "..."], orientation: int) -> Shaped[np.ndarray, "..."]:
    """Turn and mirror an image from its stored form to the one that viewers display."""
    turned = np.rot90(image, _QUARTERS[orientation])
    return np.ascontiguousarray(np.fliplr(turned) if orientation in _MIRRORED else turned)


def display_camera(camera: Camera, orientation: int, where: str, posed: bool) -> Camera:
    """Return the camera of the displayed image, given the camera of the stored one.

    A camera without a pose keeps the identity as its rotation, and its image may be mirrored.
    """
    turned = camera.turn(_QUARTERS[orientation])
    if posed and orientation in _MIRRORED:
        raise InputError(
            f"image {where} is mirrored by its EXIF orientation {orientation}, expected 1, 3, "
            "6 or 8"
        )
    if orientation in _MIRRORED:
        x, y = turned.principal_point
        turned = replace(turned, principal_point=np.array([turned.size[1] - x, y]))
    return turned if posed else replace(turned, R=np.eye(3))


def question_intrinsics(camera: Camera, where: str) -> str:
    """Say what speaks against the intrinsics of an image, or return "".

    InputError for a field of view that no camera has.
    """
    side = np.array(camera.size[::-1], float)
    centre = camera.principal_point
    values = np.concatenate([camera.focal_length, centre])
    subject = f"the intrinsics {_listed(values)}"
    doubt = _doubt(values, side)
    # The field of view of the smallest image that contains this one and has the principal point in
    # its middle.
    whole = 2 * np.maximum(centre, side - centre)
    view = np.degrees(2 * np.arctan(whole / camera.focal_length / 2)).max()
    if not _LEAST_VIEW <= view <= _LARGEST_VIEW:
        also = f"{doubt}; they " if doubt else ""
        raise InputError(
            f"{where}: {subject} {also}have a field of view of {view:.3g} degrees, expected "
            f"{_LEAST_VIEW:g} to {_LARGEST_VIEW:g}"
        )
    return f"{subject} {doubt}" if doubt else ""


def _doubt(values: Float[np.ndarray, "4"], side: Float[np.ndarray, "2"]) -> str:
    """Say what is unusual about intrinsics of an image of (width, height) pixels, or return ""."""
    focal = values[:2]
    centre = values[2:]
    # Focal lengths of at most 5 and a principal point of at most 1 are not in pixels.
    if max(*centre, *focal / 5) <= 1:
        return f"look normalised: for this image they would be {_listed(values * np.tile(side, 2))}"
    # The principal point is near the middle of the image for which the intrinsics were measured,
    # unless it was cropped. The ratios of that image's sides to those of this image:
    ratios = 2 * centre / side
    ratio = ratios.mean()
    # Both ratios are equal within 5 %: that image has the aspect ratio of this one.
    alike = min(ratios) > 0 and np.ptp(ratios) < 0.05 * ratio
    if alike and abs(ratio - 1) > _OFF_MIDDLE:
        fitted_to = "an image" if max(2 * centre) > _LARGEST_SENSOR else "a sensor in millimetres"
        wide, high = 2 * centre
        return (
            f"fit {fitted_to} of {wide:.4g} x {high:.4g}, not {side[0]:.0f} x {side[1]:.0f} pixels:"
            f" for this image they would be {_listed(values / ratio)}"
        )
    if np.abs(ratios - 1).max() > _OFF_MIDDLE:
        return "have their principal point far from the middle, as those of a crop"
    if focal.max() > _UNEQUAL * focal.min():
        return "have unequal focal lengths"
    return ""


def _listed(values: Float[np.ndarray, " n"]) -> str:
    """Write numbers as an option of the command line."""
    return ",".join(f"{value:.4g}" for value in values)
