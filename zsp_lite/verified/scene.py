"""The scene: the points, feature similarities and maps of all views, in two normalised frames.

Working units: the reference's points are centred at their mean and divided by their spread (standard deviation,
averaged over the axes); the points of all target views together likewise, with the axes of the first target camera. A
pose between the two then has a scale near 1 and a translation near 0, and all lengths in the solver are relative to
the size of the object.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera, view_span
from zsp_lite.errors import InputError
from zsp_lite.matching import Matches
from zsp_lite.points import near_median, standard_deviation
from zsp_lite.verified.maps import ViewMaps, build_maps
from zsp_lite.verified.poses import Poses, exp_, float_tensor
from zsp_lite.views import View

# Points farther from the median point than this many median distances are outliers: patches at a silhouette may have
# the depth of the background.
_OUTLIER_DISTANCE = 3.0
_DENSITY_SIGMA = 0.25  # working units
_DENSITY_ROWS = 200  # points at a time
MIN_POINTS = 8  # fewer do not determine a shape to align


@dataclass(frozen=True, eq=False)
class Scene:
    """A reference view and v target views of another object, prepared for scoring poses."""

    reference_points: Float[Tensor, "n 3"]  # foreground patches of known depth in the reference, working units
    target_points: Float[Tensor, "m 3"]  # the same of all target views
    target_column: Int[Tensor, " m"]  # column of each target point in `similarity`
    target_weight: Float[Tensor, " m"]  # share of the surface that each target point represents; they sum to 1
    similarity: Float[Tensor, "n columns"]  # of each point to each foreground patch of all targets, double-centred
    reference_maps: ViewMaps  # per-pixel maps of the reference
    target_maps: ViewMaps  # per-pixel maps of the targets
    reference_to_working: Sim3  # Reference camera to working units
    target_to_working: Sim3  # first target camera to working units
    target_cameras: tuple[Camera, ...]  # cameras of the targets
    matches: tuple[tuple[Float[Tensor, "_ 3"], Float[Tensor, "_ 3"]], ...]  # points of reference and target, per target
    view_similarity: Float[Tensor, " v"]  # of each target view to the reference, less their mean
    view_span: float  # angle in degrees that the target views span around the target

    @property
    def view_similarity_std(self) -> float:
        """Standard deviation of the target views' similarity to the reference."""
        return float(self.view_similarity.std(correction=0))

    def to_sim3(self, poses: Poses, index: int, view: int) -> Sim3:
        """Convert a pose from working units to a similarity from the reference camera to a target view's camera."""
        left, _, right = np.linalg.svd(poses.rotation[index].double().numpy())  # orthogonal again in float64
        pose = Sim3(float(poses.scale[index]), left @ right, poses.translation[index].double().numpy())
        rotation, translation = _relative_pose(self.target_cameras[0], self.target_cameras[view])
        return Sim3(1.0, rotation, translation) @ self.target_to_working.inverse() @ pose @ self.reference_to_working


def build_scene(
    reference: View, targets: Sequence[View], similarities: Sequence[Tensor], matches: Sequence[Matches] = ()
) -> Scene:
    """Prepare the scene of a reference view and its target views."""
    first = targets[0].frame.camera
    to_camera = [_relative_pose(first, target.frame.camera) for target in targets]
    source, *clouds = [view.measured_points[0].reshape(-1, 3) for view in (reference, *targets)]
    source_valid, *valid = [view.known_foreground.ravel() for view in (reference, *targets)]
    clouds = [(points - t) @ R for points, (R, t) in zip(clouds, to_camera)]
    reference_to_working, (source_valid,) = _normalisation(
        [source], [source_valid], reference.frame.name or "reference"
    )
    target_to_working, valid = _normalisation(clouds, valid, "target views")

    foregrounds = [np.asarray(target.foreground.cpu()).ravel() for target in targets]
    starts = np.cumsum([0, *(foreground.sum() for foreground in foregrounds)])
    columns = [_number(foreground, start) for foreground, start in zip(foregrounds, starts)]
    reference_foreground = reference.foreground.cpu().ravel()
    between_foregrounds = [
        similarity.cpu().float()[reference_foreground][:, torch.from_numpy(foreground)]
        for similarity, foreground in zip(similarities, foregrounds, strict=True)
    ]
    view_similarities = torch.stack([view_similarity(similarity) for similarity in between_foregrounds])
    valid_rows = torch.from_numpy(source_valid)[reference_foreground]
    centred = [double_centre(similarity[valid_rows]) for similarity in between_foregrounds]

    matched = []
    for target, cloud, match in zip(targets, clouds, matches):
        u, v = _matched_patches(reference, target, match)
        matched.append(
            (float_tensor(reference_to_working.apply(source[u])), float_tensor(target_to_working.apply(cloud[v])))
        )
    target_points = target_to_working.apply(np.concatenate([cloud[chosen] for cloud, chosen in zip(clouds, valid)]))
    return Scene(
        reference_points=float_tensor(reference_to_working.apply(source[source_valid])),
        target_points=float_tensor(target_points),
        target_column=torch.from_numpy(np.concatenate([column[chosen] for column, chosen in zip(columns, valid)])),
        target_weight=surface_weights(float_tensor(target_points)),
        similarity=torch.cat(centred, dim=1).contiguous(),
        reference_maps=build_maps(
            [reference], [(np.eye(3), np.zeros(3))], reference_to_working, [_number(source_valid)]
        ),
        target_maps=build_maps(targets, to_camera, target_to_working, columns),
        reference_to_working=reference_to_working,
        target_to_working=target_to_working,
        target_cameras=tuple(target.frame.camera for target in targets),
        matches=tuple(matched),
        view_similarity=view_similarities - view_similarities.mean(),
        view_span=view_span(
            [target.frame.camera for target in targets], first.to_world(target_to_working.inverse().apply(np.zeros(3)))
        ),
    )


def double_centre(similarity: Float[Tensor, "n1 n2"]) -> Float[Tensor, "n1 n2"]:
    """Subtract the means of each row and each column, and add the mean of all entries.

    A patch in the middle of an object is similar to most patches, one at the silhouette to few. Centring removes this
    and leaves how much more similar a patch is to one place than to the others.
    """
    rows, columns = similarity.mean(dim=1, keepdim=True), similarity.mean(dim=0, keepdim=True)
    return similarity - rows - columns + similarity.mean()


def view_similarity(similarity: Float[Tensor, "n1 n2"]) -> Float[Tensor, ""]:
    """Average each foreground patch's highest similarity in the other view, in both directions."""
    return (similarity.amax(dim=1).mean() + similarity.amax(dim=0).mean()) / 2


def surface_weights(points: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    """Weight points by the inverse of a Gaussian kernel density, so that densely sampled surface does not count more.

    A part of the surface that three views show has three times as many points as a part that one view shows.
    """
    points = points / _DENSITY_SIGMA
    square = points.square().sum(dim=1, keepdim=True)
    left, right = torch.cat([points, square], dim=1), torch.cat([points, torch.full_like(square, -0.5)], dim=1)
    # |x - y|^2 / 2 is a product of few rows at a time with all, so that it stays in the processor's cache.
    products = (torch.addmm(-square.T / 2, part, right.T) for part in left.split(_DENSITY_ROWS))
    density = torch.cat([exp_(product).sum(dim=1) for product in products])
    return (1 / density) / (1 / density).sum()


def _relative_pose(first: Camera, second: Camera) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return the rotation and translation from the first camera's frame to the second's."""
    rotation = second.R @ first.R.T
    return rotation, second.t - rotation @ first.t


def _number(selected: Bool[np.ndarray, " n"], start: int | np.integer = 0) -> Int[np.ndarray, " n"]:
    """Number the selected entries consecutively from `start`, -1 for the others."""
    return np.where(selected, start + np.cumsum(selected) - 1, -1)


def _matched_patches(
    reference: View, target: View, matches: Matches
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Return the flat indices of the matched patches of both views, for the matches with known depth on both sides."""
    u = np.ravel_multi_index(tuple(matches.reference.T), reference.features.grid)
    v = np.ravel_multi_index(tuple(matches.target.T), target.features.grid)
    known = reference.measured_points[1].ravel()[u] & target.measured_points[1].ravel()[v]
    return u[known], v[known]


def _normalisation(
    clouds: Sequence[Float[np.ndarray, "_ 3"]], valid: Sequence[Bool[np.ndarray, " _"]], name: str
) -> tuple[Sim3, list[Bool[np.ndarray, " _"]]]:
    """Compute the similarity that gives the valid points mean 0 and unit spread, and mark the outliers as invalid."""
    points = np.concatenate([cloud[chosen] for cloud, chosen in zip(clouds, valid)])
    if len(points) < MIN_POINTS:
        raise InputError(f"{name}: {len(points)} foreground patches of known depth, expected at least {MIN_POINTS}")
    near = near_median(points, _OUTLIER_DISTANCE)
    points, kept = points[near], [chosen.copy() for chosen in valid]
    for chosen, part in zip(kept, np.split(near, np.cumsum([chosen.sum() for chosen in valid])[:-1])):
        chosen[chosen] = part
    mean, spread = points.mean(axis=0), standard_deviation(points)
    return Sim3(1 / spread, np.eye(3), -mean / spread), kept
