"""A frame of an RGB-D capture, and functions that the readers of the formats share."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Real

from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame, read_grey16, read_image, read_mask
from zsp_lite.errors import InputError, check_integer, check_magnitude, check_number
from zsp_lite.io.files import path_inside, read_bytes

# OpenCV's and Open3D's pixel centres are at integers: subtract this from an intrinsic matrix with half-integer centres.
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
# Largest deviation of a pose from a rigid transform: poses in files are decimal numbers of few digits.
_RIGID_TOLERANCE = 2e-2
_MOST_DISTORTION = 100.0


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """Files and camera of a frame.

    Attributes:
        image: Image file.
        depth: Depth file: a 16-bit PNG or .npy. A smaller depth map of the image's aspect ratio, as phones store it,
            is enlarged to the size of the image.
        camera: Camera of the image.
        time: Time of the frame, seconds.
        depth_unit: World units per stored depth value.
        distortion: OpenCV's coefficients k1, k2, p1, p2, k3, or () for none. Image, depth and mask are undistorted.
        mask: Mask file, or None.

    Raises:
        InputError: The depth unit is not positive or above 1e9, or a coefficient is above 100.
    """

    image: Path
    depth: Path
    camera: Camera
    time: float
    depth_unit: float = 0.001
    distortion: tuple[float, ...] = ()
    mask: Path | None = None

    def __post_init__(self):
        check_number(f"{self.depth}: depth unit", self.depth_unit, above=0)
        check_magnitude(f"{self.depth}: depth unit", self.depth_unit)
        check_magnitude(f"{self.image}: distortion", self.distortion, _MOST_DISTORTION)

    def load(self) -> Frame:
        """Load the frame; InputError if a file is missing, corrupt or of another size than the camera's image."""
        size = self.camera.size
        rgb = _check_size(read_image(self.image), size, self.image)
        depth = _enlarge(_read_depth(self.depth) * np.float32(self.depth_unit), size)
        depth = _check_size(depth, size, self.depth)
        mask = None if self.mask is None else _check_size(read_mask(self.mask), size, self.mask)
        if any(self.distortion):
            matrix, coefficients = self.camera.K - HALF_PIXEL, np.array(self.distortion, dtype=np.float64)
            maps = cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, size[::-1], cv2.CV_32FC1)
            rgb = cv2.remap(rgb, *maps, cv2.INTER_LINEAR)
            depth = cv2.remap(depth, *maps, cv2.INTER_NEAREST)
            mask = None if mask is None else cv2.remap(mask, *maps, cv2.INTER_LINEAR)
        return Frame(rgb, depth, mask, self.camera, self.image.name)


def subsample(frames: Sequence[CaptureFrame], count: int) -> list[CaptureFrame]:
    """Select at most `count` evenly spaced frames, with the first and the last."""
    check_integer("maximum number of frames", count, 1)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
    return [frames[index] for index in chosen]


def camera_from_pose(
    pose: Float[np.ndarray, "4 4"],
    focal_length: Sequence[float] | Real[np.ndarray, "2"],
    principal_point: Sequence[float] | Real[np.ndarray, "2"],
    size: tuple[int, int],
    where: str,
) -> Camera:
    """Create a camera from its camera-to-world pose in OpenCV's axes, with the nearest exact rotation.

    `where` is the file and line of the pose, for error messages.

    Raises:
        InputError: The pose is not rigid, or the intrinsics are invalid.
    """
    rotation = pose[:3, :3]
    if (
        not np.isfinite(pose).all()
        or np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID_TOLERANCE
        or np.abs(pose[3] - (0, 0, 0, 1)).max() > _RIGID_TOLERANCE  # for instance a transposed matrix
    ):
        raise InputError(f"{where}: pose is {pose.tolist()}, expected a finite rigid camera-to-world matrix")
    left, _, right = np.linalg.svd(rotation)
    rotation = left @ right
    try:
        return Camera(
            rotation.T, -rotation.T @ pose[:3, 3], np.array(focal_length, float), np.array(principal_point, float), size
        )
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def listed_file(folder: Path, relative: str, where: str) -> Path:
    """Return the path of a file named in a list; InputError if it does not exist or is not inside the folder."""
    path = path_inside(folder, relative)
    if not path.is_file():
        raise InputError(f"{where}: file {relative} is not in {folder}")
    return path


def read_rows(path: Path, columns: int, what: str) -> list[tuple[int, list[str]]]:
    """Read the line number and the words of each line of a text file, without comments (#) and empty lines.

    InputError if a line has fewer words than `columns`.
    """
    rows = []
    for number, line in enumerate(read_bytes(path, what).decode("utf-8", "replace").splitlines(), 1):
        words = line.split("#")[0].split()
        if words and len(words) < columns:
            raise InputError(f"{what} {path}, line {number}: {line.strip()!r}, expected {columns} columns")
        if words:
            rows.append((number, words))
    return rows


def parse_numbers(words: Sequence[str], where: str) -> list[float]:
    """Convert words to finite numbers; InputError if one is not."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [np.nan]
    if not np.isfinite(values).all():
        raise InputError(f"{where}: {' '.join(words)!r}, expected finite numbers")
    return values


def image_size(path: Path) -> tuple[int, int]:
    """Return (height, width) of an image file."""
    return read_image(path).shape[:2]


def _read_depth(path: Path) -> Float[np.ndarray, "h w"]:
    if path.suffix == ".npy":
        data = read_bytes(path, "depth")
        try:
            values = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
        except (ValueError, OSError, EOFError, MemoryError) as error:
            raise InputError(f"depth {path} cannot be read as .npy: {error}, expected numbers (H, W)") from error
    else:
        values = read_grey16(path)
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise InputError(f"depth {path} holds {values.dtype} of shape {values.shape}, expected numbers (H, W)")
    values = values.astype(np.float32)
    return np.where(np.isfinite(values) & (values > 0), values, np.float32(0))


def _enlarge(depth: Float[np.ndarray, "h w"], size: tuple[int, int]) -> Float[np.ndarray, "h2 w2"]:
    """Resize a smaller map whose aspect ratio agrees to 1 %, by the nearest values (means lie on no surface)."""
    (rows, columns), (height, width) = depth.shape, size
    if (rows, columns) != (height, width) and rows < height and abs(rows * width / (columns * height) - 1) < 0.01:
        return cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return depth


def _check_size(image: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    if image.shape[:2] != tuple(size):
        raise InputError(f"{path} is {image.shape[:2]} pixels, expected the camera's (H, W) = {tuple(size)}")
    return image
