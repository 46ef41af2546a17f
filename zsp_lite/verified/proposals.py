"""Where the search starts: poses that three matches of one view suggest, and the views' own rotations.

Consensus does not decide here, for the errors of matches are shared (a front looks like a back from all around): a
view proposes several poses, and what all views saw decides between them.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from zsp_lite.verified.poses import SCALE_RANGE, Poses, fit_poses, join, suppress
from zsp_lite.verified.scene import Scene

TRIALS = 300
PER_VIEW = 6
_INLIER = 0.3
_APART = 20.0  # degrees
_POOL = 200
# One view shows a part of the object, all targets together nearly the whole: their spreads differ by about this.
_PART = 0.9


def propose(scene: Scene, seed: int | np.random.Generator = 0, trials: int = TRIALS, per_view: int = PER_VIEW) -> Poses:
    """Each view's best poses by its own matches, then the N view rotations; never none."""
    rng = np.random.default_rng(seed)
    found = [from_matches(source, target, rng, trials, per_view) for source, target in scene.matches]
    return join([*found, view_rotations(scene)])


def from_matches(
    source: Float[Tensor, "k 3"],
    target: Float[Tensor, "k 3"],
    seed: int | np.random.Generator = 0,
    trials: int = TRIALS,
    keep: int = PER_VIEW,
) -> Poses:
    """At most `keep` poses, 20 degrees apart, that agree best with matched points in working units.

    Each trial fits three matches; agreement is the truncated score sum of max(0, 1 - (residual / 0.3)^2) over all.
    None where there are fewer than three matches, or no fit has a plausible scale.
    """
    rng = np.random.default_rng(seed)
    if len(source) < 3:
        return Poses(torch.zeros(0), torch.zeros(0, 3, 3), torch.zeros(0, 3))
    sample = torch.from_numpy(np.argsort(rng.random((trials, len(source))), axis=1)[:, :3].copy())
    poses = fit_poses(source[sample], target[sample])
    smallest, largest = SCALE_RANGE
    poses = poses[(poses.scale >= smallest) & (poses.scale <= largest)]
    residual = (poses.apply(source) - target).square_().sum(dim=2)
    score = (1 - residual / _INLIER**2).clamp_min_(0).sum(dim=1)
    best = torch.argsort(score, descending=True, stable=True)[:_POOL]
    return poses[best[suppress(poses.rotation[best], score[best], _APART, keep)]]


def view_rotations(scene: Scene) -> Poses:
    """For each target view the pose in which the reference was seen from just there, centre upon centre."""
    rotation = scene.target_maps.rotation.transpose(1, 2).contiguous()
    return Poses(torch.full((len(rotation),), _PART), rotation, torch.zeros(len(rotation), 3))
