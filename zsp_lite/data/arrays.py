"""Frames and cameras from arrays as cameras and other programs give them."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

from zsp_lite.data.cameras import Camera, Values
from zsp_lite.data.depth import zero_unknown
from zsp_lite.data.frames import ON_OBJECT, Frame
from zsp_lite.errors import InputError, check_magnitude, check_number, real_array, rigid_matrix

# Largest relative difference of the aspect ratios of an image and its smaller depth map: sides are
# rounded to whole pixels.
_SAME_ASPECT = 0.01
# Largest p1 and p2 of a distortion, which are small for every lens.
_MOST_TANGENTIAL = 0.1
# How each image of a frame is sampled: means of depth lie on no surface.
_SAMPLING = {"rgb": cv2.INTER_LINEAR, "depth": cv2.INTER_NEAREST, "mask": cv2.INTER_LINEAR}


def frame_from_arrays(
    rgb: np.ndarray,
    depth: np.ndarray,
    K: Values,
    mask: np.ndarray | None,
    pose: Values | None,
    depth_unit: float,
    name: str,
    distortion: Values | None,
) -> Frame:
    """Make a frame of arrays (see `Frame.from_arrays`)."""
    label = f"frame {name}".rstrip()

    # Colours (H, W, 3), uint8. `Frame` refuses what is still of another type below.
    image = np.asarray(rgb)
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise InputError(
            f"{label} rgb has shape {image.shape}, expected (H, W), (H, W, 3) or (H, W, 4)"
        )
    image = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image[..., :3]
    size = image.shape[:2]

    # The camera. Pixel centres at integers become ones at half-integers.
    intrinsics = _split_intrinsics(f"{label} K", K) + (0, 0, 0.5, 0.5)
    pose = real_array(f"{label} pose", np.eye(4) if pose is None else pose)
    defect = ""
    if not np.isfinite(pose).all():
        defect = "the camera's pose is not finite"
        pose = np.eye(4)
    camera = camera_from_pose(pose, intrinsics, size, label)
    if image.dtype.kind == "f" and 0 <= image.min() and image.max() <= 1:
        image = np.rint(255 * image).astype(np.uint8)

    # Depth in units of the world, 0 where unknown.
    check_number("depth_unit", depth_unit, above=0)
    depth = _read_map(f"{label} depth", depth) * depth_unit
    depth = zero_unknown(depth).astype(np.float32)

    # Mask from 0 to 1.
    if mask is not None:
        mask = _read_map(f"{label} mask", mask).astype(np.float32)
        largest = mask.max()
        # Such a mask has labels or another scale: as 0 to 255, no pixel would be on the object.
        if 1 < largest <= ON_OBJECT * 255:
            raise InputError(
                f"{label} mask has {largest:g} at most, expected booleans, 0 and 1, or 0 to 255"
            )
        if largest > 1:
            mask = mask / np.float32(255)
    frame = Frame(image, enlarge_depth(depth, size), mask, camera, name, defect)
    return undistort(frame, distortion_coefficients(label, distortion))


def distortion_coefficients(where: str, values: Values | None) -> Float[np.ndarray, " n"]:
    """Check coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]] of OpenCV, or none; errors begin with
    `where`."""
    numbers = real_array(f"{where}: distortion", () if values is None else values).ravel()
    check_magnitude(f"{where}: distortion", numbers)
    if numbers.size not in (0, 4, 5, 8) or not (np.abs(numbers[2:4]) <= _MOST_TANGENTIAL).all():
        raise InputError(
            f"{where}: distortion is {numbers.tolist()}, expected OpenCV's k1, k2, p1, p2, then k3,"
            f" or k3 to k6, or none, with p1 and p2 from -{_MOST_TANGENTIAL} to {_MOST_TANGENTIAL}"
        )
    return numbers


def undistort(frame: Frame, coefficients: Float[np.ndarray, " n"], fisheye: bool = False) -> Frame:
    """Return a frame without the distortion of its lens, in OpenCV's model or its fisheye one."""
    if not coefficients.any():
        return frame
    camera = frame.camera
    K = camera.K
    K[:2, 2] -= 0.5  # OpenCV's pixel centres
    undistortion = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    maps = undistortion(K, coefficients, np.eye(3), K, camera.size[::-1], cv2.CV_32FC1)
    straight = {
        name: cv2.remap(getattr(frame, name), *maps, sampling)
        for name, sampling in _SAMPLING.items()
        if getattr(frame, name) is not None
    }
    return replace(frame, **straight)


def _read_map(name: str, values: np.ndarray) -> Float64[np.ndarray, "h w"]:
    """Convert numbers (h, w) or (h, w, 1); InputError for another shape."""
    values = real_array(name, values)
    if values.shape[2:] == (1,):
        values = values[..., 0]
    if values.ndim != 2 or not values.size:
        raise InputError(f"{name} has shape {values.shape}, expected (h, w) or (h, w, 1)")
    return values


def enlarge_depth(
    depth: Float32[np.ndarray, "h w"], size: tuple[int, int]
) -> Float32[np.ndarray, "..."]:
    """Enlarge a depth map of the same aspect ratio to an image's size (H, W).

    Pixels take the nearest value, because the mean of two surfaces' depths lies on neither. Depth
    maps of other aspect ratios, or no smaller than the image, are returned as they are.
    """
    rows, columns = depth.shape
    height, width = size
    if rows >= height or abs(rows * width / (columns * height) - 1) > _SAME_ASPECT:
        return depth
    return cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)


def _split_intrinsics(name: str, values: Values) -> Float[np.ndarray, "4"]:
    """Return fx, fy, cx, cy of four numbers, of a matrix (3, 3), or of its 9 numbers."""
    numbers = real_array(name, values)
    if numbers.shape in ((3, 3), (9,)):
        entries = numbers.ravel().tolist()
        fx, _, cx, _, fy, cy, *_ = entries
        if entries != [fx, 0, cx, 0, fy, cy, 0, 0, 1]:
            raise InputError(
                f"{name} is {numbers.tolist()}, expected fx 0 cx, 0 fy cy, 0 0 1 in pixels"
            )
        numbers = np.array([fx, fy, cx, cy])
    return real_array(name, numbers, (4,))


def camera_from_pose(pose: Values, intrinsics: Values, size: tuple[int, int], where: str) -> Camera:
    """Create a camera from intrinsics and a camera-to-world pose (4, 4) or (3, 4); errors begin
    with `where`."""
    if np.shape(pose) == (3, 4):
        pose = np.vstack([pose, (0, 0, 0, 1)])
    pose = rigid_matrix(f"{where}: camera-to-world pose", pose)
    rotation = pose[:3, :3]
    values = _split_intrinsics(f"{where}: intrinsics", intrinsics)
    try:
        return Camera(rotation.T, -rotation.T @ pose[:3, 3], values[:2], values[2:], size)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
