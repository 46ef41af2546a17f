"""Pinhole cameras: OpenCV conventions inside, exact conversion from and to PyTorch3D (CO3D v1 and v2).

Inside the library a camera maps world points as column vectors, `x_cam = R @ x_world + t`, +x right, +y down,
+z forward, and its pixel coordinates are (x, y) with pixel centres at half-integers: the image covers
[0, W] x [0, H].
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Real

from zsp_lite.errors import InputError

Box = tuple[int, int, int, int]  # (top, left, height, width), pixels

NDC_NORM_IMAGE_BOUNDS = "ndc_norm_image_bounds"  # CO3D v1, and wherever the format is not given
NDC_ISOTROPIC = "ndc_isotropic"  # CO3D v2

# PyTorch3D's camera axes are +x left, +y up, +z forward: OpenCV's turned by 180 degrees about z.
_AXES = np.array([-1.0, -1.0, 1.0])
# Annotations carry float32 rotations; what deviates more than this is not a rotation at all.
_ROTATION_TOLERANCE = 1e-3
_EXACT = 1e-6  # what float32 leaves of one


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated view of the world.

    `R` (3, 3) and `t` (3,): world to camera; `focal_length` (2,) and `principal_point` (2,): (x, y), pixels; `size`:
    image (height, width), pixels. Lengths are in the unit of the world. Raises InputError on values that are
    not finite, an `R` that is not a rotation (to 1e-3; the nearest one is kept), a focal length or size that is
    not positive.
    """

    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]
    focal_length: Float[np.ndarray, "2"]
    principal_point: Float[np.ndarray, "2"]
    size: tuple[int, int]

    def __post_init__(self):
        for name, shape in (("R", (3, 3)), ("t", (3,)), ("focal_length", (2,)), ("principal_point", (2,))):
            object.__setattr__(self, name, _finite(getattr(self, name), shape, f"camera {name}"))
        deviation = np.abs(self.R @ self.R.T - np.eye(3)).max()
        if deviation > _ROTATION_TOLERANCE or np.linalg.det(self.R) < 0:
            raise InputError(f"camera R is {self.R.tolist()}, expected a rotation: R @ R.T = identity, det R = 1")
        if deviation > _EXACT:  # written with few decimals: what follows takes it for a rotation
            left, _, right = np.linalg.svd(self.R)
            object.__setattr__(self, "R", left @ right)
        if (self.focal_length <= 0).any():
            raise InputError(f"camera focal_length is {self.focal_length.tolist()}, expected positive pixels")
        object.__setattr__(self, "size", _image_size(self.size))

    @classmethod
    def from_pytorch3d(
        cls,
        R: Real[np.ndarray, "3 3"] | Sequence,
        T: Real[np.ndarray, "3"] | Sequence,
        focal_length: Real[np.ndarray, "2"] | Sequence,
        principal_point: Real[np.ndarray, "2"] | Sequence,
        size: Sequence[int],
        intrinsics_format: str = NDC_NORM_IMAGE_BOUNDS,
    ) -> "Camera":
        """The camera of a CO3D viewpoint.

        `R` (3, 3) and `T` (3,) act on row vectors, `X_cam = X_world @ R + T`, +x left, +y up; `focal_length`
        (2,) and `principal_point` (2,) are in the units of `intrinsics_format`; `size` is the image's
        (height, width). Raises InputError on another format and on what `Camera` refuses.
        """
        R, T = _finite(R, (3, 3), "viewpoint R"), _finite(T, (3,), "viewpoint T")
        focal_length = _finite(focal_length, (2,), "viewpoint focal_length")
        principal_point = _finite(principal_point, (2,), "viewpoint principal_point")
        size = _image_size(size)
        scale, centre = _ndc(size, intrinsics_format)
        # NDC's axes point left and up like the camera's, pixels' right and down: hence the minus.
        return cls(_AXES[:, None] * R.T, _AXES * T, focal_length * scale, centre - principal_point * scale, size)

    def to_pytorch3d(self, intrinsics_format: str = NDC_NORM_IMAGE_BOUNDS) -> dict:
        """The exact inverse of `from_pytorch3d`: its arguments by name, but for `size`; arrays are numpy float64."""
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
        (fx, fy), (cx, cy) = self.focal_length, self.principal_point
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """World-to-camera transform (the paper's T^cam in column-vector form)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.R, self.t
        return matrix

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Where the camera stands in the world."""
        return -self.R.T @ self.t

    def to_camera(self, points: Real[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """World points in the camera's frame."""
        return np.asarray(points, dtype=np.float64) @ self.R.T + self.t

    def to_world(self, points: Real[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Camera-frame points in the world."""
        return (np.asarray(points, dtype=np.float64) - self.t) @ self.R

    def project(
        self, points: Real[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 2"], Float[np.ndarray, "*batch"]]:
        """Pixels (x, y) and depths of world points.

        Depth is the distance along +z. Points at depth 0 have pixels that are not finite, and those at a
        negative depth lie behind the camera: look at the depth before using the pixel.
        """
        in_camera = self.to_camera(points)
        depth = in_camera[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = in_camera[..., :2] / depth[..., None] * self.focal_length + self.principal_point
        return pixels, depth

    def unproject_camera(
        self, pixels: Real[np.ndarray, "*batch 2"], depth: Real[np.ndarray, "*batch"] | float | np.floating
    ) -> Float[np.ndarray, "*batch 3"]:
        """Camera-frame points seen at `pixels` (x, y) at `depth` along +z."""
        depth = np.asarray(depth, dtype=np.float64)[..., None]
        rays = (np.asarray(pixels, dtype=np.float64) - self.principal_point) / self.focal_length
        return np.concatenate([rays * depth, np.broadcast_to(depth, (*rays.shape[:-1], 1))], axis=-1)

    def unproject(
        self, pixels: Real[np.ndarray, "*batch 2"], depth: Real[np.ndarray, "*batch"] | float | np.floating
    ) -> Float[np.ndarray, "*batch 3"]:
        """World points seen at `pixels` (x, y) at `depth`: the inverse of `project`."""
        return self.to_world(self.unproject_camera(pixels, depth))

    def crop(self, box: Box) -> "Camera":
        """The camera of the image cut to `box`: cropping moves the principal point and nothing else."""
        top, left, height, width = box
        return replace(self, principal_point=self.principal_point - (left, top), size=(height, width))

    def resize(self, size: Sequence[int]) -> "Camera":
        """The camera of the image resized to (height, width): both intrinsics scale, per axis."""
        size = _image_size(size)
        scale = np.array([size[1] / self.size[1], size[0] / self.size[0]])
        return replace(
            self, focal_length=self.focal_length * scale, principal_point=self.principal_point * scale, size=size
        )


def rotation_from_quaternion(
    quaternion: Real[np.ndarray, "4"] | Sequence, what: str = "quaternion"
) -> Float[np.ndarray, "3 3"]:
    """The rotation matrix of (x, y, z, w), normalised. Raises InputError for one without length."""
    x, y, z, w = _finite(quaternion, (4,), what)
    length = float(np.sqrt(x * x + y * y + z * z + w * w))
    if length < 1e-6:
        raise InputError(f"{what} is {list(quaternion)}, expected a quaternion (x, y, z, w) of length 1")
    x, y, z, w = np.array([x, y, z, w]) / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _ndc(size: tuple[int, int], intrinsics_format: str) -> tuple[np.ndarray, np.ndarray]:
    """Pixels per NDC unit and the NDC origin's pixel, each (2,) as (x, y)."""
    height, width = size
    half = np.array([width, height]) / 2
    if intrinsics_format == NDC_NORM_IMAGE_BOUNDS:
        return half, half
    if intrinsics_format == NDC_ISOTROPIC:
        return np.full(2, half.min()), half
    raise InputError(
        f"intrinsics_format is {intrinsics_format!r}, expected {NDC_NORM_IMAGE_BOUNDS!r} or {NDC_ISOTROPIC!r}"
    )


def _finite(value: np.ndarray | Sequence, shape: tuple[int, ...], what: str) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} is {value!r}, expected numbers of shape {shape}") from error
    if array.shape != shape:
        raise InputError(f"{what} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise InputError(f"{what} is not finite: {array.tolist()}")
    return array


def _image_size(size: Sequence[int]) -> tuple[int, int]:
    try:
        height, width = (int(side) for side in size)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"image size is {size!r}, expected (height, width)") from error
    if height <= 0 or width <= 0:
        raise InputError(f"image size is {(height, width)}, expected positive (height, width)")
    return height, width
