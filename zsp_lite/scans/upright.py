"""The vertical of a scan: which way is up around an object, in the world of its frames.

The floor or table around the object tells it: the plane through most points of the background
(RANSAC; Fischler and Bolles 1981). It must agree with the ring of the cameras, which walk around an
object at about one height, or else with the images' own up. Without a floor, the ring tells it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from zsp_lite.data.clouds import best_plane
from zsp_lite.data.frames import Frame
from zsp_lite.metrics import vector_angle
from zsp_lite.points import world_points

# These values are chosen, not fitted.
_TRIALS = 400  # planes through three points each
# Largest distance of a point of the floor to its plane, in median distances of the background's
# points to their middle.
_NEAR = 0.03
_LEAST_SHARE = 0.2  # of the background's points that a floor has
_POINTS = 600  # of the background of a frame
_STEEPEST = 60.0  # degrees between a floor's normal and what it must agree with, roughly
_AGREE = 25.0  # degrees between the floor's normal and that of the ring
# A ring of cameras is flat and round: the largest ratio of its extent across its plane to the
# smaller one within, and the smallest ratio of the smaller one to the larger one.
_FLAT = 0.15
_ROUND = 0.3


def find_up(frames: Sequence[Frame]) -> tuple[Float[np.ndarray, "3"] | None, str]:
    """Find the direction up from the background's depth and the cameras of an object's frames.

    The frames may be object crops, which show the floor close around the object.
    Returns None where nothing tells it, or what tells it disagrees; then also a sentence that says
    so.
    """
    cameras = [frame.camera for frame in frames]
    centres = np.stack([camera.centre for camera in cameras])
    of_images = -np.mean([camera.R[1] for camera in cameras], axis=0)  # image rows go down
    ring = _ring_axis(centres)
    # Images may be stored turned, cameras that walk around an object do not roll over.
    floor = _floor_normal(frames, of_images if ring is None else ring, centres.mean(axis=0))
    if ring is None:
        if floor is not None and floor @ of_images < 0:
            return None, "no vertical: the cameras are below the floor, or the images upside down"
        return floor, ""
    if floor is None:
        up = ring * np.sign(ring @ of_images)
        return (up if vector_angle(up, of_images) < _STEEPEST else None), ""
    angle = _between_axes(floor, ring)
    if angle > _AGREE:
        return None, f"no vertical: floor and ring of the cameras differ by {angle:.0f} degrees"
    return floor, ""


def _between_axes(
    first: Float[np.ndarray, "*n 3"], second: Float[np.ndarray, "3"]
) -> np.ndarray | float:
    """Return the angles in degrees between axes, whatever their signs."""
    angle = vector_angle(first, second)
    return np.minimum(angle, 180 - angle)


def _floor_normal(
    frames: Sequence[Frame], axis: Float[np.ndarray, "3"], above: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"] | None:
    """Return the normal of the largest plane of the background that is about normal to an axis, on
    the side of a point."""
    clouds = [np.zeros((0, 3))]
    for frame in frames:
        if frame.depth is not None and frame.mask is not None:
            # Surely background, not the rim of a soft mask.
            background = (frame.mask < 0.02) & (frame.depth > 0)
            step = 1 + int(background.sum()) // _POINTS
            clouds.append(world_points(frame, background, step))
    points = np.concatenate(clouds)
    if len(points) < _POINTS // 2:  # too few for a floor
        return None
    tolerance = _NEAR * np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    normal, middle, count = best_plane(
        points, tolerance, _TRIALS, lambda normals: _between_axes(normals, axis) < _STEEPEST
    )
    if count < _LEAST_SHARE * len(points):
        return None
    return normal * np.sign(normal @ (above - middle))


def _ring_axis(centres: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"] | None:
    """Return the axis of the ring in which cameras stand around an object, if they do."""
    if len(centres) < 4:  # three are always in a plane
        return None
    _, extents, axes = np.linalg.svd(centres - centres.mean(axis=0), full_matrices=False)
    widest, middle, least = extents
    return axes[2] if least < _FLAT * middle and middle > _ROUND * widest else None
