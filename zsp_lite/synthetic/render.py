"""Rendered views with their exact geometry, and the cameras that they are rendered from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.data.cameras import Camera


@dataclass(frozen=True)
class Rendering:
    """One rendered view with its exact geometry."""

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]  # z in the camera frame, 0 where the ray hits neither the object nor the floor
    mask: Bool[np.ndarray, "h w"]  # pixels of the object
    canonical: Float[np.ndarray, "h w 3"]  # object coordinates of each object pixel, NaN elsewhere
    normals: Float[np.ndarray, "h w 3"]  # unit normals of the object pixels in the camera frame, 0 elsewhere
    camera: Camera


def orbit_pose(azimuth: float, elevation: float, roll: float, distance: float, target) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of a camera on a sphere around `target` (3,) that looks at its centre; angles in radians.

    The azimuth is the angle about z, 0 in front of the object at +x; the elevation is the angle above the horizontal
    plane, the roll the rotation about the optical axis. Returns world-to-camera rotation (3, 3) and translation (3,).
    """
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    forward = -away
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    c, s = np.cos(roll), np.sin(roll)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.stack([right, np.cross(forward, right), forward])
    return R, -R @ (np.asarray(target, float) + away * distance)


def framed_camera(vertices: Float[np.ndarray, "v 3"], R: np.ndarray, t: np.ndarray, size: int, margin: float = 1.1,
                  shift: Float[np.ndarray, "2"] | None = None) -> Camera:  # fmt: skip
    """Return a camera at pose R, t with a square image of `size` pixels that contains all vertices.

    The bounding square of the object is enlarged by the factor `margin` and shifted by `shift`, a fraction of its
    width.
    """
    in_camera = vertices @ R.T + t
    plane = in_camera[:, :2] / in_camera[:, 2:]
    low, high = plane.min(0), plane.max(0)
    width = (high - low).max() * margin
    centre = (low + high) / 2 + (0 if shift is None else np.asarray(shift) * width)
    focal_length = size / width
    return Camera(R, t, np.full(2, focal_length), size / 2 - centre * focal_length, (size, size))
