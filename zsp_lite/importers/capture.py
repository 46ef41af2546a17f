"""A frame of an RGB-D capture: its files, its camera, and how they become a `Frame`."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame, check_pixels, read_grey16, read_image, read_mask
from zsp_lite.errors import MAX_LENGTH, InputError, real_array
from zsp_lite.io.files import path_inside, read_bytes

# OpenCV's and Open3D's pixel centres are at integers: subtract this from an intrinsic matrix with half-integer centres.
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
# Largest deviation of a pose from a rigid transform: poses in files are decimal numbers of few digits.
_RIGID_TOLERANCE = 2e-2
_SAME_ASPECT = 0.01  # largest relative difference of the aspect ratios of an image and its smaller depth map


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """Files and camera of a frame."""

    image: Path
    depth: Path  # a 16-bit PNG or .npy, of the image's aspect ratio; phones store it smaller than the image
    camera: Camera
    depth_unit: float = 0.001  # world units per stored depth value
    distortion: tuple[float, ...] = ()  # OpenCV's k1, k2, p1, p2, k3; image, depth and mask are undistorted
    mask: Path | None = None

    def load(self) -> Frame:
        """Load the frame; InputError if a file is missing, damaged or of another size than the camera's image."""
        height, width = self.camera.size
        rgb, depth = read_image(self.image), _read_depth(self.depth) * np.float32(self.depth_unit)
        rows, columns = depth.shape
        if rows < height and abs(rows * width / (columns * height) - 1) < _SAME_ASPECT:
            # The nearest values, because means of two surfaces lie on neither.
            depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        mask = None if self.mask is None else read_mask(self.mask)
        for path, pixels in ((self.image, rgb), (self.depth, depth), (self.mask, mask)):
            if pixels is not None:
                check_pixels(path, pixels, (height, width))
        if any(self.distortion):
            matrix, coefficients = self.camera.K - HALF_PIXEL, np.array(self.distortion)
            maps = cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, (width, height), cv2.CV_32FC1)
            rgb = cv2.remap(rgb, *maps, cv2.INTER_LINEAR)
            depth = cv2.remap(depth, *maps, cv2.INTER_NEAREST)
            mask = None if mask is None else cv2.remap(mask, *maps, cv2.INTER_LINEAR)
        return Frame(rgb, depth, mask, self.camera, self.image.name)


def evenly_spaced(frames: Sequence[CaptureFrame], count: int) -> list[CaptureFrame]:
    """Select at most `count` evenly spaced frames, with the first and the last."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
    return [frames[index] for index in chosen]


def files_by_stem(folder: str | Path) -> dict[str, Path]:
    """Return the files of a folder by their names without extension; links may not lead out of it."""
    return {path.stem: path_inside(folder, path.name) for path in sorted(Path(folder).glob("*"))}


def camera_from_pose(
    pose: Float[np.ndarray, "4 4"], intrinsics: Sequence[float], size: tuple[int, int], where: str
) -> Camera:
    """Create a camera, with the nearest exact rotation, from its camera-to-world pose in OpenCV's axes.

    The intrinsics are fx, fy, cx, cy in pixels. InputError, which begins with `where`, if they or the pose are wrong.
    """
    rotation = pose[:3, :3]
    if (
        not np.abs(pose).max() <= MAX_LENGTH  # false for NaN too
        or np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID_TOLERANCE
        or np.linalg.det(rotation) < 0
        or np.abs(pose[3] - (0, 0, 0, 1)).max() > _RIGID_TOLERANCE  # for instance a transposed matrix
    ):
        raise InputError(f"{where}: pose is {pose.tolist()}, expected a finite rigid camera-to-world matrix")
    rotation = np.linalg.multi_dot(np.linalg.svd(rotation)[::2])
    values = real_array(f"{where}: intrinsics", intrinsics, (4,))
    try:
        return Camera(rotation.T, -rotation.T @ pose[:3, 3], values[:2], values[2:], size)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _read_depth(path: Path) -> Float[np.ndarray, "h w"]:
    """Read the stored values of a depth map, 0 where unknown."""
    if path.suffix != ".npy":
        return read_grey16(path).astype(np.float32)
    data = read_bytes(path, "depth")
    try:
        values = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
        found = f"{values.dtype} of shape {values.shape}" if values.ndim != 2 or values.dtype.kind not in "fiu" else ""
    except (ValueError, OSError, EOFError, MemoryError) as error:
        found = f"no array ({error})"
    if found:
        raise InputError(f"depth {path} holds {found}, expected an .npy file of numbers (H, W)")
    values = values.astype(np.float32)
    return np.where(np.isfinite(values) & (values > 0), values, np.float32(0))
