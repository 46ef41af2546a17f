"""A capture as every reader gives it: files, cameras, times; and what the readers share."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame, read_grey16, read_image, read_mask
from zsp_lite.errors import InputError
from zsp_lite.io.files import path_inside, read_bytes

Pair = Sequence[float] | Float[np.ndarray, "2"]  # (x, y), pixels
# Matrices in files are printed numbers; what deviates more is no rotation.
_ROTATION_TOLERANCE = 2e-2


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """One picture of a capture.

    camera: of the image as stored (OpenCV axes, pixel centres at half-integers).  depth: a 16-bit PNG or a .npy file,
    whose values times `depth_unit` are in the world's unit.  distortion: OpenCV's k1 k2 p1 p2 k3, () for none; camera,
    image and depth are undistorted on loading.  A smaller depth map of the image's proportions, which phones store, is
    enlarged to it.  time: seconds.
    """

    image: Path
    depth: Path
    camera: Camera
    time: float
    depth_unit: float = 0.001
    distortion: tuple[float, ...] = ()
    mask: Path | None = None

    def load(self) -> Frame:
        """The frame. Raises InputError where a file is missing, broken, or of another size than the camera's."""
        size = self.camera.size
        rgb = _sized(read_image(self.image), size, self.image)
        depth = _enlarged(_read_depth(self.depth) * np.float32(self.depth_unit), size)
        depth = _sized(depth, size, self.depth)
        mask = None if self.mask is None else _sized(read_mask(self.mask), size, self.mask)
        if any(self.distortion):
            columns, rows = self._undistorted_pixels()
            rgb = cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR)
            depth = cv2.remap(depth, columns, rows, cv2.INTER_NEAREST)
            mask = None if mask is None else cv2.remap(mask, columns, rows, cv2.INTER_LINEAR)
        return Frame(rgb, depth, mask, self.camera, self.image.name)

    def _undistorted_pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each pixel of the undistorted image lies in the stored one; OpenCV counts from pixel centres."""
        matrix = self.camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        coefficients = np.array(self.distortion, dtype=np.float64)
        return cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, self.camera.size[::-1], cv2.CV_32FC1)


@dataclass(frozen=True)
class Capture:
    """The shots of one object, in the order in which they were taken, with cameras in one world."""

    shots: tuple[CaptureFrame, ...]

    def thinned(self, count: int) -> "Capture":
        """At most `count` shots, evenly spread."""
        if count < 1:
            raise InputError(f"frames to keep are {count}, expected at least 1")
        chosen = np.unique(np.linspace(0, len(self.shots) - 1, min(count, len(self.shots))).round().astype(int))
        return Capture(tuple(self.shots[index] for index in chosen))


def camera_from_pose(
    to_world: Float[np.ndarray, "4 4"],
    focal: Pair,
    principal_point: Pair,
    size: tuple[int, int],
    where: str,
) -> Camera:
    """A camera from its pose in the world (OpenCV axes). Raises InputError, naming `where`, where it is not rigid."""
    to_world = np.asarray(to_world, dtype=np.float64)
    rotation = to_world[:3, :3]
    if (
        not np.isfinite(to_world).all()
        or np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION_TOLERANCE
        or np.abs(to_world[3] - (0, 0, 0, 1)).max() > _ROTATION_TOLERANCE  # such as a matrix column by column
    ):
        raise InputError(f"{where}: pose is {to_world.tolist()}, expected a finite rigid camera-to-world matrix")
    left, _, right = np.linalg.svd(rotation)  # printed with few digits: the nearest rotation
    rotation = left @ right
    try:
        return Camera(rotation.T, -rotation.T @ to_world[:3, 3], np.array(focal), np.array(principal_point), size)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def listed_file(folder: Path, relative: str, where: str) -> Path:
    """A file that a list names. Raises InputError where it is not there or leads out of the capture's folder."""
    path = path_inside(folder, relative)
    if not path.is_file():
        raise InputError(f"{where}: file {relative} is not in {folder}")
    return path


def read_rows(path: Path, columns: int, what: str) -> list[tuple[int, list[str]]]:
    """The lines of a text file that are no comments, split at blanks, with their numbers (from 1).

    Raises InputError where one has fewer than `columns` words.
    """
    rows = []
    for number, line in enumerate(read_bytes(path, what).decode("utf-8", "replace").splitlines(), 1):
        words = line.split("#")[0].split()
        if words and len(words) < columns:
            raise InputError(f"{what} {path}, line {number}: {line.strip()!r}, expected {columns} columns")
        if words:
            rows.append((number, words))
    return rows


def numbers(words: Sequence[str], where: str) -> list[float]:
    """Words as finite numbers, or InputError."""
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{where}: {' '.join(words)!r}, expected numbers") from error
    if not np.isfinite(values).all():
        raise InputError(f"{where}: {' '.join(words)!r}, expected finite numbers")
    return values


def image_size(path: Path) -> tuple[int, int]:
    """(height, width) of an image file."""
    return read_image(path).shape[:2]


def _read_depth(path: Path) -> Float[np.ndarray, "h w"]:
    if path.suffix == ".npy":
        try:
            values = np.asarray(np.load(path, allow_pickle=False))
        except (OSError, ValueError, EOFError) as error:
            raise InputError(f"depth {path} cannot be read as .npy: {error}") from error
    else:
        values = read_grey16(path)
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise InputError(f"depth {path} holds {values.dtype} of shape {values.shape}, expected numbers (H, W)")
    values = values.astype(np.float32)
    return np.where(np.isfinite(values) & (values > 0), values, np.float32(0))


def _enlarged(depth: Float[np.ndarray, "h w"], size: tuple[int, int]) -> Float[np.ndarray, "h2 w2"]:
    """A smaller map of the same proportions, to a percent, at `size`; nearest values, for means lie on no surface."""
    (rows, columns), (height, width) = depth.shape, size
    if (rows, columns) != (height, width) and rows < height and abs(rows * width / (columns * height) - 1) < 0.01:
        return cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return depth


def _sized(image: np.ndarray, size: tuple[int, int], path: Path) -> np.ndarray:
    if image.shape[:2] != tuple(size):
        raise InputError(f"{path} is {image.shape[:2]} pixels, expected the camera's (H, W) = {tuple(size)}")
    return image
