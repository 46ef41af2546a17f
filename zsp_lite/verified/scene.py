"""What all views saw, in one frame and unit.

Working units: the reference's points relative to their centre, in units of their spread; the targets' points, of all
views together, likewise, along the axes of the first target camera. A pose between the two then has a scale near 1
and a translation near 0, and every length in the solver is a share of the object's size: thresholds adapt to it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError
from zsp_lite.matching import Matches
from zsp_lite.verified.maps import ViewMaps, make_maps
from zsp_lite.verified.poses import Poses
from zsp_lite.views import View

# Patches at a silhouette may lie on the background behind: points this many median distances off are dropped.
_STRAY = 3.0
_DENSITY_WIDTH = 0.25
# Fewer points than this have no shape to align.
MIN_POINTS = 8


@dataclass(frozen=True, eq=False)
class Scene:
    """A reference view and N target views of one object, ready to test poses on.

    reference_points, target_points: foreground patches with a known depth, in working units; the targets' of all
    views.  target_view, target_column: of each target point, its view and its column in `similarity`.
    target_share: of each target point, the share of the surface that it stands for; their sum is 1.
    similarity: of each reference point to each foreground patch of all targets, less what either has in common with
    all of the other view (see `contrast`).
    reference_maps, target_maps: what the views say about their pixels.
    reference_frame: reference camera to working units.  target_frame: first target camera to working units.
    cameras: of the targets.  matches: per target the matched points of both sides, in working units.
    likeness: of each target view to the reference (see `view_likeness`), less their mean.
    """

    reference_points: Float[Tensor, "n 3"]
    target_points: Float[Tensor, "m 3"]
    target_view: Int[Tensor, " m"]
    target_column: Int[Tensor, " m"]
    target_share: Float[Tensor, " m"]
    similarity: Float[Tensor, "n columns"]
    reference_maps: ViewMaps
    target_maps: ViewMaps
    reference_frame: Sim3
    target_frame: Sim3
    cameras: tuple[Camera, ...]
    matches: tuple[tuple[Float[Tensor, "_ 3"], Float[Tensor, "_ 3"]], ...]
    likeness: Float[Tensor, " v"]

    @property
    def spread(self) -> float:
        """How much the target views differ in likeness to the reference: their standard deviation."""
        return float(self.likeness.std(correction=0))

    def sim3(self, poses: Poses, index: int, view: int) -> Sim3:
        """A pose as the similarity from reference-camera points to a target view's camera points."""
        left, _, right = np.linalg.svd(poses.rotation[index].double().numpy())  # float32's rounding off
        pose = Sim3(float(poses.scale[index]), left @ right, poses.translation[index].double().numpy())
        rotation, translation = _relative(self.cameras[0], self.cameras[view])
        return Sim3(1.0, rotation, translation) @ self.target_frame.inverse() @ pose @ self.reference_frame

    def poses(self, sim3s: Sequence[Sim3], view: int) -> Poses:
        """The inverse of `sim3`: similarities to a target view's camera points, as poses in working units."""
        rotation, translation = _relative(self.cameras[view], self.cameras[0])
        to_first = Sim3(1.0, rotation, translation)
        found = [self.target_frame @ to_first @ sim3 @ self.reference_frame.inverse() for sim3 in sim3s]
        return Poses(*(_tensor([getattr(one, name) for one in found]) for name in ("scale", "R", "t")))


def make_scene(
    reference: View, targets: Sequence[View], similarities: Sequence[Tensor], matches: Sequence[Matches] = ()
) -> Scene:
    """The scene of some views.

    similarities: per target (patches of the reference, patches of the target), as `matching.similarities` gives them.
    matches: per target, on the patch grids; those without a known depth on both sides are left out.
    Raises InputError where the reference, or all targets together, have fewer than MIN_POINTS foreground patches of
    known depth.
    """
    first = targets[0].frame.camera
    to_camera = [_relative(first, target.frame.camera) for target in targets]
    source, source_on = _cloud(reference)
    clouds, on = zip(*(_cloud(target) for target in targets))
    clouds = [(points - t) @ R for points, (R, t) in zip(clouds, to_camera)]
    reference_frame, (source_on,) = _working_frame([source], [source_on], reference.frame.name or "reference")
    target_frame, on = _working_frame(clouds, on, "target views")

    rows = np.flatnonzero(source_on)
    foregrounds = [np.flatnonzero(np.asarray(target.foreground.cpu()).ravel()) for target in targets]
    columns, blocks, width, likeness = [], [], 0, []
    for target, patches, similarity in zip(targets, foregrounds, similarities, strict=True):
        column = np.full(target.foreground.numel(), -1)
        column[patches] = width + np.arange(len(patches))
        width += len(patches)
        columns.append(column)
        similarity = similarity.cpu().float()[:, torch.from_numpy(patches)]
        blocks.append(contrast(similarity[torch.from_numpy(rows)]))
        likeness.append(view_likeness(similarity[reference.foreground.cpu().ravel()]))
    row = np.full(source_on.shape, -1)
    row[rows] = np.arange(len(rows))

    pairs = []
    for match, cloud, known in zip(matches, clouds, (target.patch_points[1].ravel() for target in targets)):
        u = np.ravel_multi_index(tuple(match.reference.T), reference.features.grid)
        v = np.ravel_multi_index(tuple(match.target.T), targets[0].features.grid)
        both = reference.patch_points[1].ravel()[u] & known[v]
        pairs.append((_tensor(reference_frame.apply(source[u[both]])), _tensor(target_frame.apply(cloud[v[both]]))))
    target_points = _tensor(target_frame.apply(np.concatenate([cloud[chosen] for cloud, chosen in zip(clouds, on)])))
    return Scene(
        _tensor(reference_frame.apply(source[source_on])),
        target_points,
        torch.from_numpy(np.repeat(np.arange(len(targets)), [chosen.sum() for chosen in on])),
        torch.from_numpy(np.concatenate([column[chosen] for column, chosen in zip(columns, on)])),
        surface_shares(target_points),
        torch.cat(blocks, dim=1).contiguous(),
        make_maps([reference], [(np.eye(3), np.zeros(3))], reference_frame, [row]),
        make_maps(targets, to_camera, target_frame, columns),
        reference_frame,
        target_frame,
        tuple(target.frame.camera for target in targets),
        tuple(pairs),
        torch.stack(likeness) - torch.stack(likeness).mean(),
    )


def contrast(similarity: Float[Tensor, "n1 n2"]) -> Float[Tensor, "n1 n2"]:
    """Similarities less the means of their row and their column, plus the mean of all.

    A patch in the object's middle is somewhat like every patch, one at its rim like none; what tells places apart is
    whom it resembles more than the others do.
    """
    if similarity.numel() == 0:
        return similarity
    rows, columns = similarity.mean(dim=1, keepdim=True), similarity.mean(dim=0, keepdim=True)
    return similarity - rows - columns + similarity.mean()


def view_likeness(similarity: Float[Tensor, "n1 n2"]) -> Float[Tensor, ""]:
    """How alike two views are: each foreground patch's highest similarity in the other, averaged, both ways.

    A view without foreground is as unlike as can be.
    """
    if not similarity.numel():
        return similarity.new_tensor(-1.0)
    return (similarity.amax(dim=1).mean() + similarity.amax(dim=0).mean()) / 2


def surface_shares(points: Float[Tensor, "m 3"]) -> Float[Tensor, " m"]:
    """The share of the surface that each point stands for, by the density around it; their sum is 1.

    What three views saw has three times as many points as what one saw, and shall not count three times.
    """
    density = torch.cdist(points, points).square_().mul_(-0.5 / _DENSITY_WIDTH**2).exp_().sum(dim=1)
    return (1 / density) / (1 / density).sum()


def _relative(first: Camera, second: Camera) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """First camera's frame to the second's."""
    rotation = second.R @ first.R.T
    return rotation, second.t - rotation @ first.t


def _cloud(view: View) -> tuple[Float[np.ndarray, "patches 3"], Bool[np.ndarray, " patches"]]:
    """Camera-frame points of all patches, and which are foreground with a known depth."""
    points, known = view.patch_points
    return points.reshape(-1, 3), (known & np.asarray(view.foreground.cpu())).ravel()


def _working_frame(
    clouds: Sequence[Float[np.ndarray, "_ 3"]], chosen: Sequence[Bool[np.ndarray, " _"]], name: str
) -> tuple[Sim3, list[Bool[np.ndarray, " _"]]]:
    """The similarity that gives the chosen points mean 0 and unit spread, and which of them are no strays."""
    points = np.concatenate([cloud[on] for cloud, on in zip(clouds, chosen)])
    if len(points) < MIN_POINTS:
        raise InputError(f"{name}: {len(points)} foreground patches of known depth, expected at least {MIN_POINTS}")
    middle = np.median(points, axis=0)
    limit = _STRAY * np.median(np.linalg.norm(points - middle, axis=1))
    kept = [on & (np.linalg.norm(cloud - middle, axis=1) <= limit) for cloud, on in zip(clouds, chosen)]
    points = np.concatenate([cloud[on] for cloud, on in zip(clouds, kept)])
    mean = points.mean(axis=0)
    spread = np.sqrt(np.square(points - mean).sum(axis=1).mean() / 3)
    if not spread > 0:
        raise InputError(f"{name}: all {len(points)} foreground points are equal, expected an object with extent")
    return Sim3(1 / spread, np.eye(3), -mean / spread), kept


def _tensor(values) -> Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float32))
