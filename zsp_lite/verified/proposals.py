"""Pose proposals: fits to three matches of one target view, and viewpoints around the object.

Unlike in RANSAC, the sample with the largest consensus is not taken as the result, because errors
of matches are correlated (the front of an object can match its back everywhere). Each view
contributes several proposals, and the score over all views selects among them (see `verification`).
"""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from zsp_lite.alignment import umeyama_batch
from zsp_lite.verified.poses import (
    SCALE_RANGE,
    Poses,
    float_tensor,
    non_maximum_suppression,
    rotation_matrices,
)
from zsp_lite.verified.scene import Scene

# These values are chosen, not fitted.
_TRIALS = 300  # number of samples of three matches, per view
_PER_VIEW = 6  # largest number of proposals of a view
_INLIER_DISTANCE = 0.3  # working units
_MIN_ANGLE = 20.0  # degrees between the proposals of a view
# So many best samples of a view go into non-maximum suppression, which compares all pairs.
_POOL = 200
# Turns of the first view's viewpoint about the vertical: once around in steps of 30 degrees. The
# turn by 0 is a proposal already.
_TURNS = torch.deg2rad(torch.arange(30.0, 360.0, 30.0))
# Scale of the proposals that are viewpoints: the points that one view shows have about this
# fraction of the whole object's spread.
_VIEW_SCALE = 0.9


def poses_from_matches(
    source: Float[Tensor, "k 3"], target: Float[Tensor, "k 3"], rng: np.random.Generator
) -> Poses:
    """Fit poses to random samples of three of k >= 3 matches, and keep the best that differ."""
    # The positions of the three smallest of k random numbers are a sample without repetition:
    # (trials, 3).
    sample = np.argpartition(rng.random((_TRIALS, len(source))), (0, 1, 2), axis=1)[:, :3]
    fitted = umeyama_batch(source.double().numpy()[sample], target.double().numpy()[sample])
    poses = Poses(*map(float_tensor, fitted[:3]))  # scales, rotations, translations
    poses = poses[poses.scale == poses.scale.clamp(*SCALE_RANGE)]

    squared_residual = (poses.apply(source) - target).square_().sum(dim=2)  # (trials, k)
    # The score of MSAC (Torr and Zisserman 2000): sum_i max(0, 1 - (|T x_i - y_i| / 0.3)^2).
    score = (1 - squared_residual / _INLIER_DISTANCE**2).clamp_min_(0).sum(dim=1)
    best = torch.argsort(score, descending=True, stable=True)[:_POOL]
    different = non_maximum_suppression(poses.rotation[best], score[best], _MIN_ANGLE, _PER_VIEW)
    return poses[best[different]]


def poses_from_views(scene: Scene) -> Poses:
    """Return poses with the viewpoint of each target view, or the first one's turned sideways."""
    # A pose with the inverse of a view's rotation gives the reference's camera that view's axes.
    views = scene.target_maps.rotation.transpose(1, 2)
    # The mean of the directions that are up in the target images.
    vertical = F.normalize(-scene.target_maps.rotation[:, 1].mean(dim=0), dim=0)
    rotation = torch.cat([views, rotation_matrices(_TURNS[:, None] * vertical) @ views[0]])
    return Poses(torch.full((len(rotation),), _VIEW_SCALE), rotation, torch.zeros(len(rotation), 3))
