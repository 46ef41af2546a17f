"""Shapes of whole scans: what all frames of an object show together, upright, and how well two of
them fit.

Where both verticals are known, only the heading between two objects is unknown, an angle about the
vertical. `compare_headings` compares 72 of them by the Chamfer distance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from zsp_lite.alignment import Sim3, umeyama_batch
from zsp_lite.data.azimuths import view_span
from zsp_lite.data.frames import Frame
from zsp_lite.errors import NoPoseError
from zsp_lite.points import near_median, standard_deviation, world_cloud

HEADINGS = np.arange(0, 360, 5)  # degrees
# These values are chosen, not fitted.
FRAMES = 12  # of a scan that its shape is fused from
_POINTS = 600  # of a shape
# Largest distance that counts, in sizes of the object: what only one of two objects has costs no
# more.
_MOST_DISTANCE = 0.5
# Of `refine`: steps, the distance at which a pair of points has a quarter of its weight, and the
# range of the scale between two whole objects of unit size.
_STEPS = 6
_WIDTH = 0.15
_SCALES = (0.6, 1.7)

_Poses = Float[np.ndarray, "m 4 4"]  # matrices of similarities from one shape to the other


@dataclass(frozen=True, eq=False)
class Shape:
    """Points on the surface of an object, in a frame of its own: in the middle of the object, of
    standard deviation 1, with z up where the vertical is known."""

    points: Float[np.ndarray, "n 3"]
    from_world: Sim3  # from the world of the object's frames
    upright: bool  # whether the vertical is known
    span: float  # angle in degrees that the cameras span around the object

    @classmethod
    def of(cls, frames: Sequence[Frame], up: Float[np.ndarray, "3"] | None) -> "Shape":
        """Fuse frames of one world, in which `up` is the vertical, if it is known; NoPoseError if
        no frame shows the surface."""
        cloud = world_cloud(frames)[0]
        if not len(cloud):
            raise NoPoseError("no frame shows the object with depth")
        vertical = np.array([0.0, 0.0, 1.0]) if up is None else up / np.linalg.norm(up)
        # The second right singular vector of the vertical as a (1, 3) matrix is normal to it.
        across = np.linalg.svd(vertical[None])[2][1]
        axes = np.stack([across, np.cross(vertical, across), vertical])
        cloud = cloud[near_median(cloud)]
        chosen = np.random.default_rng(0).permutation(len(cloud))[:_POINTS]
        points = cloud[chosen] @ axes.T
        middle = _middle(points)
        scale = 1 / (standard_deviation(points) or 1)
        span = view_span([frame.camera for frame in frames], axes.T @ middle)
        from_world = Sim3(scale, axes, -scale * middle)
        return cls(scale * (points - middle), from_world, up is not None, span)

    @cached_property
    def tree(self) -> KDTree:
        """The points, to find the nearest one."""
        return KDTree(self.points)


def _middle(points: Float[np.ndarray, "*b n 3"]) -> Float[np.ndarray, "*b 3"]:
    """Return the middle of the box around points, without the outermost."""
    return np.percentile(points, (1, 99), axis=-2).mean(axis=0)


def centred(shape: Shape, turns: Float[np.ndarray, "m 3 3"]) -> _Poses:
    """Return the poses with some rotations that bring the middle of a shape to that of another."""
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, :3, :3] = turns
    poses[:, :3, 3] = -_middle(shape.points @ turns.swapaxes(1, 2))
    return poses


def compare_headings(first: Shape, second: Shape) -> tuple[_Poses, Float[np.ndarray, " 72"]]:
    """Return the poses of one upright shape at all `HEADINGS`, and its Chamfer distance to the
    other after each."""
    turns = Rotation.from_euler("z", HEADINGS[:, None], degrees=True).as_matrix()
    poses = centred(first, turns)
    return poses, chamfer_distance(first, second, poses)


def chamfer_distance(first: Shape, second: Shape, poses: _Poses) -> Float[np.ndarray, " m"]:
    """Compute the mean squared distance of the points of each of two shapes to the nearest one of
    the other, in sizes of the second and capped, summed over both."""
    there, back, _, _ = _nearest(first, second, poses)
    return sum(np.square(way.clip(max=_MOST_DISTANCE)).mean(axis=1) for way in (there, back))


def _nearest(
    first: Shape, second: Shape, poses: _Poses
) -> tuple[
    Float[np.ndarray, "m n"],
    Float[np.ndarray, "m k"],
    Int[np.ndarray, "m n"],
    Int[np.ndarray, "m k"],
]:
    """Find the nearest point of the second shape to each moved one of the first, and the other way
    round: distances, then indices."""
    moved = first.points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]
    there, partner = second.tree.query(moved)
    inverse = np.linalg.inv(poses)
    returned = second.points @ inverse[:, :3, :3].swapaxes(1, 2) + inverse[:, None, :3, 3]
    back, origin = first.tree.query(returned)
    scale = np.cbrt(np.linalg.det(poses[:, :3, :3]))
    return there, scale[:, None] * back, partner, origin


def refine(first: Shape, second: Shape, poses: _Poses) -> _Poses:
    """Align each pose by ICP over nearest points of both shapes (Besl and McKay 1992), the far ones
    with little weight."""
    m = len(poses)
    for _ in range(_STEPS):
        there, back, partner, origin = _nearest(first, second, poses)
        source = [np.broadcast_to(first.points, (m, *first.points.shape)), first.points[origin]]
        target = [second.points[partner], np.broadcast_to(second.points, (m, *second.points.shape))]
        weight = 1 / np.square(1 + np.square(np.concatenate([there, back], axis=1) / _WIDTH))
        scale, turn, shift, _ = umeyama_batch(
            np.concatenate(source, axis=1), np.concatenate(target, axis=1), _SCALES, weight
        )
        poses = np.tile(np.eye(4), (m, 1, 1))
        poses[:, :3, :3] = scale[:, None, None] * turn
        poses[:, :3, 3] = shift
    return poses
