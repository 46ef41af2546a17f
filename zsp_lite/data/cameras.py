"""Pinhole cameras in OpenCV conventions, and their exact conversion from and to PyTorch3D (CO3D v1
and v2).

A camera maps world points to camera coordinates by `x_cam = R @ x_world + t` (column vectors; +x
right, +y down, +z forward). Pixel coordinates are (x, y) with pixel centres at half-integers: the
image covers [0, W] x [0, H].
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Real
from numpy.typing import ArrayLike

from zsp_lite.alignment import Sim3
from zsp_lite.errors import (
    check_integer,
    check_magnitude,
    check_number,
    real_array,
    rotation_matrix,
)

Box = tuple[int, int, int, int]  # (top, left, height, width), pixels
Values = Real[np.ndarray, "..."] | Sequence

# CO3D v1, and the default if the format is not given
NDC_NORM_IMAGE_BOUNDS = "ndc_norm_image_bounds"
NDC_ISOTROPIC = "ndc_isotropic"  # CO3D v2

# Rotation of camera coordinates if the image is turned by 90 degrees counterclockwise: its right
# becomes its top.
_QUARTER_TURN = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
# PyTorch3D's camera axes (+x left, +y up, +z forward) are OpenCV's rotated by 180 degrees about z.
_AXES = np.array([-1.0, -1.0, 1.0])
MOST_PIXELS = 1_000_000  # of a side of an image


@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera without distortion.

    InputError for a value out of range, or an `R` that is no rotation.
    """

    # (3, 3) rotation, world to camera; the nearest rotation to the given matrix.
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]  # (3,) translation, world to camera, in units of the world
    focal_length: Float[np.ndarray, "2"]  # (2,) along x and y, pixels
    principal_point: Float[np.ndarray, "2"]  # (2,) as (x, y), pixels
    size: tuple[int, int]  # image (height, width), pixels

    def __post_init__(self):
        for name, shape in (
            ("R", (3, 3)),
            ("t", (3,)),
            ("focal_length", (2,)),
            ("principal_point", (2,)),
        ):
            array = np.array(real_array(f"camera {name}", getattr(self, name), shape))
            check_magnitude(f"camera {name}", array)
            object.__setattr__(self, name, array)
        object.__setattr__(self, "R", rotation_matrix("camera R", self.R))
        check_number("camera focal_length", float(self.focal_length.min()), above=1e-3)
        real_array("image size (height, width)", tuple(self.size), (2,))
        for side in self.size:
            check_integer("image size (height, width)", side, 1, MOST_PIXELS)
        object.__setattr__(self, "size", tuple(map(int, self.size)))

    @classmethod
    def from_pytorch3d(
        cls,
        R: Values,
        T: Values,
        focal_length: Values,
        principal_point: Values,
        intrinsics_format: str,
        size: Sequence[int],
    ) -> "Camera":
        """Convert a PyTorch3D camera, such as a CO3D viewpoint, of an image of (height, width).

        `X_cam = X_world @ R + T` with row vectors, +x left, +y up. Each side of the image covers
        [-1, 1] in the format "ndc_norm_image_bounds", the shorter side in "ndc_isotropic".
        """
        scale, centre = _ndc(size, intrinsics_format)
        # NDC axes point left and up, pixel axes right and down: hence the minus.
        return cls(
            _AXES[:, None] * np.transpose(R),
            _AXES * T,
            np.multiply(focal_length, scale),
            centre - np.multiply(principal_point, scale),
            size,
        )

    def to_pytorch3d(self, intrinsics_format: str = NDC_NORM_IMAGE_BOUNDS) -> dict:
        """Convert to the arguments of `from_pytorch3d` by name, without `size`."""
        scale, centre = _ndc(self.size, intrinsics_format)
        return {
            "R": (_AXES[:, None] * self.R).T,
            "T": _AXES * self.t,
            "focal_length": self.focal_length / scale,
            "principal_point": (centre - self.principal_point) / scale,
            "intrinsics_format": intrinsics_format,
        }

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """Intrinsic matrix, pixels: `pixel ~ K @ x_cam`."""
        fx, fy = self.focal_length
        cx, cy = self.principal_point
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """World-to-camera transform for column vectors (T^cam in the paper)."""
        return np.vstack([np.column_stack([self.R, self.t]), [0.0, 0.0, 0.0, 1.0]])

    @property
    def sim3(self) -> Sim3:
        """World-to-camera transform."""
        return Sim3(1.0, self.R, self.t)

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Camera centre in world coordinates."""
        return -self.R.T @ self.t

    def to_camera(self, points: Real[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Transform points (..., 3) from world to camera coordinates."""
        return np.asarray(points, dtype=np.float64) @ self.R.T + self.t

    def to_world(self, points: Real[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Transform points (..., 3) from camera to world coordinates."""
        return (np.asarray(points, dtype=np.float64) - self.t) @ self.R

    def project(
        self, points: Real[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """Project world points (..., 3) to pixels (..., 2) as (x, y), and depths (...) along +z.

        Points at depth 0 have pixels that are not finite, and points at negative depth are behind
        the camera.
        """
        in_camera = self.to_camera(points)
        depth = in_camera[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = (
                in_camera[..., :2] / depth[..., None] * self.focal_length + self.principal_point
            )
        return pixels, depth

    def unproject_camera(
        self, pixels: Real[np.ndarray, "*batch 2"], depth: ArrayLike
    ) -> Float[np.ndarray, "*batch 3"]:
        """Compute camera points (..., 3) at given pixels (x, y) and depths along +z."""
        depth = np.asarray(depth, dtype=np.float64)[..., None]
        rays = (np.asarray(pixels, dtype=np.float64) - self.principal_point) / self.focal_length
        return np.concatenate(
            [rays * depth, np.broadcast_to(depth, (*rays.shape[:-1], 1))], axis=-1
        )

    def unproject(
        self, pixels: Real[np.ndarray, "*batch 2"], depth: ArrayLike
    ) -> Float[np.ndarray, "*batch 3"]:
        """Compute world points (..., 3) at given pixels and depths; the inverse of `project`."""
        return self.to_world(self.unproject_camera(pixels, depth))

    def crop(self, box: Box) -> "Camera":
        """Return the camera of the image cropped to `box` (top, left, height, width)."""
        top, left, height, width = box
        return replace(
            self, principal_point=self.principal_point - (left, top), size=(height, width)
        )

    def resize(self, size: Sequence[int]) -> "Camera":
        """Return the camera of the image resized to (height, width), whatever the aspect ratio."""
        scale = np.divide(size, self.size)[::-1]  # (x, y)
        return replace(
            self,
            focal_length=self.focal_length * scale,
            principal_point=self.principal_point * scale,
            size=size,
        )

    def turn(self, quarters: int) -> "Camera":
        """Return the camera of the image turned as in `numpy.rot90`, about its optical axis."""
        camera = self
        for _ in range(quarters % 4):
            x, y = camera.principal_point
            # The distance from the right border becomes the distance from the top.
            camera = Camera(
                _QUARTER_TURN @ camera.R,
                _QUARTER_TURN @ camera.t,
                camera.focal_length[::-1],
                np.array([y, camera.size[1] - x]),
                camera.size[::-1],
            )
        return camera


def _ndc(size: Sequence[int], intrinsics_format: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels per NDC unit and the pixel of the NDC origin, each (2,) as (x, y)."""
    half = np.array(size)[::-1] / 2
    scales = {NDC_NORM_IMAGE_BOUNDS: half, NDC_ISOTROPIC: np.full(2, half.min())}
    return scales[intrinsics_format], half
