"""Ground-truth matches between views of synthetic objects, for evaluation only.

Instances of a category have different proportions. Their points are therefore compared in box
coordinates, from 0 (rear, right, bottom) to 1 (front, left, top) along each axis of the object's
bounding box.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.depth import patch_points
from zsp_lite.data.frames import Frame
from zsp_lite.data.ground_truth import ObjectPose, object_poses
from zsp_lite.views import object_crop, patch_mask

_LARGEST_DISTANCE = 0.1  # of the points of a match, in box coordinates
_MARGIN = 0.05  # a point farther outside the box than this belongs to the background
_MASK_THRESHOLD = 0.8  # above this a pixel is surely of the object: masks are soft at its border

# Box coordinates of patches, and where they are known.
PatchCoordinates = tuple[Float[np.ndarray, "_ _ 3"], Bool[np.ndarray, "_ _"]]


@dataclass(frozen=True, eq=False)
class GroundTruthPair:
    """Object crops of two instances of a category with their ground-truth matches."""

    category: str
    reference: Frame  # object crop, like the target
    target: Frame
    # matching target patch (row, col) of each reference patch
    cells: Int[np.ndarray, "rows cols 2"]
    valid: Bool[np.ndarray, "rows cols"]  # reference patches that have a match


def patch_coordinates(frame: Frame, pose: ObjectPose, grid: tuple[int, int]) -> PatchCoordinates:
    """Return the box coordinates of the object point that each patch shows, and where they are
    known: the mask covers a quarter of the patch, and an object pixel has depth inside the box."""
    # Only object pixels count: the floor between the spokes of a bicycle is inside the box, too.
    points, measured = patch_points(
        np.where(frame.mask > _MASK_THRESHOLD, frame.depth, 0), frame.camera, grid
    )
    coordinates = pose.to_box(frame.camera.to_world(points))
    inside = (np.abs(coordinates - 0.5) <= 0.5 + _MARGIN).all(axis=-1)
    return coordinates, measured & inside & patch_mask(frame, grid).numpy()


def ground_truth_matches(
    reference: PatchCoordinates, target: PatchCoordinates
) -> tuple[Int[np.ndarray, "rows cols 2"], Bool[np.ndarray, "rows cols"]]:
    """Match each reference patch to the target patch with the nearest of the `patch_coordinates`,
    at most 0.1 away.

    Returns the target patch of each reference patch, (0, 0) without a match, and which have one.
    """
    points, known = reference
    target_points, target_known = target
    cells = np.zeros((*known.shape, 2), int)
    valid = np.zeros_like(known)
    if known.any() and target_known.any():
        distance, index = cKDTree(target_points[target_known]).query(points[known])
        cells[known] = np.argwhere(target_known)[index]
        valid[known] = distance <= _LARGEST_DISTANCE
        cells[~valid] = 0
    return cells, valid


def correct_matches(
    cells: Int[np.ndarray, "*batch 2"],
    true_cells: Int[np.ndarray, "*batch 2"],
    tolerance: float = 1,
) -> Bool[np.ndarray, "*batch"]:
    """Return which cells (row, col) are within `tolerance` patches of the true cells, in rows and
    in columns."""
    return np.abs(np.asarray(cells) - true_cells).max(axis=-1) <= tolerance


def ground_truth_pair(dataset: Co3D, pair: Pair) -> GroundTruthPair:
    """Load a pair with its ground-truth matches of 28 x 28 patches, for the target view that has
    the most of them."""
    grid = (28, 28)  # of ViT-S/8 on a crop of 224 x 224 pixels
    poses = object_poses(dataset, pair.category)
    reference, targets = dataset.load_pair(pair)
    reference, *targets = map(object_crop, (reference, *targets))
    coordinates = patch_coordinates(reference, poses[pair.reference_sequence], grid)
    matches = [
        ground_truth_matches(
            coordinates, patch_coordinates(target, poses[pair.target_sequence], grid)
        )
        for target in targets
    ]
    best = np.argmax([valid.sum() for _, valid in matches])
    return GroundTruthPair(pair.category, reference, targets[best], *matches[best])
