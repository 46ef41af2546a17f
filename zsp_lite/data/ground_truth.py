"""Object poses of synthetic data, and ground-truth correspondences between views, for evaluation only.

Instances of a category have different proportions. Their points are therefore compared in box coordinates, from 0
(rear, right, bottom) to 1 (front, left, top) along each axis of the object's bounding box.
"""

import functools
import logging
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from sklearn.neighbors import NearestNeighbors

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.depth import patch_points
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, rigid_matrix
from zsp_lite.io.files import read_json
from zsp_lite.views import object_crop, patch_mask

_warn_once = functools.cache(logging.getLogger(__name__).warning)
POSES_FILE = "object_poses.json"  # in each category folder: the pose of each sequence's object in its world
_MARGIN = 0.05  # a point farther outside the box than this belongs to the background
_MASK_THRESHOLD = 0.8  # masks are soft and accurate to one or two pixels
_Vector = tuple[float, float, float]
_Row = tuple[float, float, float, float]


class ObjectPose(msgspec.Struct):
    """Pose of an object in its world, `world = scale * R @ object + t`, and its bounding box in object coordinates."""

    trans: tuple[_Row, _Row, _Row, _Row]  # the matrix [R t]
    scale: float
    low: _Vector  # corners of the box
    high: _Vector
    turns: tuple[int, ...] = ()  # about the up axis, in degrees, after which the shape is the same; 0 is not among them

    @property
    def R(self) -> Float[np.ndarray, "3 3"]:
        return np.array(self.trans)[:3, :3]

    @property
    def t(self) -> Float[np.ndarray, "3"]:
        return np.array(self.trans)[:3, 3]

    def to_object(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Map world points to object coordinates (front +x, left +y, up +z, surface of unit standard deviation)."""
        return (np.asarray(world, np.float64) - self.t) @ self.R / self.scale

    def to_box(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Map world points to box coordinates, 0 to 1 along each object axis."""
        return (self.to_object(world) - self.low) / np.subtract(self.high, self.low)


@dataclass(frozen=True, eq=False)
class GroundTruthPair:
    """Object crops of two instances of a category with their ground-truth matches."""

    category: str
    reference: Frame  # object crops
    target: Frame
    cells: Int[np.ndarray, "rows cols 2"]  # matching target patch (row, col) of each reference patch
    valid: Bool[np.ndarray, "rows cols"]  # reference patches that have a match


def read_poses(out: Path, category: str) -> dict[str, ObjectPose]:
    """Return the object pose of every sequence of a category; none without the file."""
    if not (path := out / category / POSES_FILE).is_file():
        return {}
    poses = read_json(path, dict[str, ObjectPose], "object poses")
    exact = {name: rigid_matrix(f"object poses {path}: {name}", one.trans).tolist() for name, one in poses.items()}
    return {name: msgspec.structs.replace(one, trans=exact[name]) for name, one in poses.items()}


def common_turns(out: Path, category: str, first: str, second: str) -> Float[np.ndarray, "s 3 3"] | None:
    """Return the turns in the world of the second object after which both look the same; None where nothing is known.

    The first is the identity.
    """
    try:
        poses = read_poses(out, category)
    except InputError as error:  # a file of an older layout, for instance, costs one figure only
        _warn_once("%s", f"{error}: without it there is no symmetric_acc30")
        return None
    if not {first, second} <= poses.keys():
        return None
    angles = [[0.0], *([turn] for turn in poses[first].turns if turn in poses[second].turns)]
    world = poses[second].R
    return world @ Rotation.from_euler("z", angles, degrees=True).as_matrix() @ world.T


def object_poses(dataset: Co3D, category: str) -> dict[str, ObjectPose]:
    """Read the object pose of every sequence of a category; InputError if the folder is not a synthetic export."""
    if not (poses := read_poses(dataset.root, category)):
        path = dataset.root / category / POSES_FILE
        raise InputError(f"{path} is missing, expected a synthetic export: other data has no exact object poses")
    return poses


def patch_coordinates(
    frame: Frame, pose: ObjectPose, grid: tuple[int, int]
) -> tuple[Float[np.ndarray, "rows cols 3"], Bool[np.ndarray, "rows cols"]]:
    """Return the box coordinates of the object point that each patch shows, and the patches where they are known.

    They are known where the mask covers a quarter of the patch, one of its object pixels has depth, and the point is
    inside the box.
    """
    # Object pixels only: the floor between the spokes of a bicycle is inside the box as well.
    points, measured = patch_points(np.where(frame.mask > _MASK_THRESHOLD, frame.depth, 0), frame.camera, grid)
    coordinates = pose.to_box(frame.camera.to_world(points))
    inside = (np.abs(coordinates - 0.5) <= 0.5 + _MARGIN).all(axis=-1)
    return coordinates, measured & inside & patch_mask(frame, grid).numpy()


def ground_truth_matches(
    reference: tuple[Float[np.ndarray, "r1 c1 3"], Bool[np.ndarray, "r1 c1"]],
    target: tuple[Float[np.ndarray, "r2 c2 3"], Bool[np.ndarray, "r2 c2"]],
    tolerance: float = 0.1,
) -> tuple[Int[np.ndarray, "r1 c1 2"], Bool[np.ndarray, "r1 c1"]]:
    """Match each reference patch to the target patch with the nearest box coordinates, at most `tolerance` away.

    `reference` and `target` are results of `patch_coordinates`. Returns the target patch (row, col) of each reference
    patch, (0, 0) without a match, and the reference patches that have one.
    """
    (points, known), (target_points, target_known) = reference, target
    cells, valid = np.zeros((*known.shape, 2), int), np.zeros_like(known)
    if known.any() and target_known.any():
        search = NearestNeighbors(n_neighbors=1).fit(target_points[target_known])
        distance, index = search.kneighbors(points[known])
        cells[known] = np.argwhere(target_known)[index[:, 0]]
        valid[known] = distance[:, 0] <= tolerance
        cells[~valid] = 0
    return cells, valid


def correct_matches(
    cells: Int[np.ndarray, "*batch 2"], true_cells: Int[np.ndarray, "*batch 2"], tolerance: float = 1
) -> Bool[np.ndarray, "*batch"]:
    """Return which cells (row, col) are within `tolerance` patches of the true cells, in rows and in columns."""
    return np.abs(np.asarray(cells) - true_cells).max(axis=-1) <= tolerance


def ground_truth_pair(dataset: Co3D, pair: Pair) -> GroundTruthPair:
    """Load a pair with its ground-truth matches of 28 x 28 patches, for the target view that has the most of them."""
    grid = (28, 28)
    poses = object_poses(dataset, pair.category)
    reference, targets = dataset.load_pair(pair)
    reference, targets = object_crop(reference), [object_crop(target) for target in targets]
    coordinates = patch_coordinates(reference, poses[pair.reference_sequence], grid)
    target_pose = poses[pair.target_sequence]
    matches = [ground_truth_matches(coordinates, patch_coordinates(target, target_pose, grid)) for target in targets]
    best = int(np.argmax([valid.sum() for _, valid in matches]))
    return GroundTruthPair(pair.category, reference, targets[best], *matches[best])
