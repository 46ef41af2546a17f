"""Iterated alignment of the clouds in which every point has a soft partner, near in space and alike in features.

Point i of the reference under the pose at hand is bound to point j of the targets with the affinity
A_ij = exp(-d_ij^2 / 2 s^2 + 8 C_ij), C being the similarity less its means. It is drawn to the affinity's mean place,
and counts a_i / (a_i + a0), a_i = sum_j A_ij: what finds no partner (unseen, or unlike) has no say. s shrinks from 0.5
to 0.15 of the object's spread.
"""

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from zsp_lite.verified.poses import SCALE_RANGE, Poses, nearest_rotation
from zsp_lite.verified.scene import Scene

ITERATIONS = 6
_POINTS = 100, 300  # of the reference, of the targets
_WIDTHS = 0.5, 0.15
_FEATURES = 8.0
# a0 per target point: the affinity that a partner must outweigh to count more than a half.
_UNBOUND = 0.01


def soft_icp(scene: Scene, poses: Poses, iterations: int = ITERATIONS, features: float = _FEATURES) -> Poses:
    """Every pose improved by itself.  features: weight of the similarity; 0 aligns by shape alone."""
    rows, chosen = (
        spread_indices(len(scene.reference_points), _POINTS[0]),
        spread_indices(len(scene.target_points), _POINTS[1]),
    )
    source, target = scene.reference_points[rows], scene.target_points[chosen]
    alike = features * scene.similarity[rows][:, scene.target_column[chosen]]
    target_square = target.square().sum(dim=1)
    for width in np.geomspace(*_WIDTHS, iterations):
        moved = poses.apply(source)
        square = moved.square().sum(dim=2, keepdim=True) + target_square
        square = torch.baddbmm(square, moved, target.T.expand(len(moved), 3, -1), alpha=-2).clamp_min_(0)
        affinity = square.mul_(-0.5 / width**2).add_(alike).exp_()
        bound = affinity.sum(dim=2, keepdim=True)
        partner = (affinity @ target) / bound.clamp_min(1e-12)
        weight = bound / (bound + _UNBOUND * len(target))
        weight = weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-6)
        source_mean, partner_mean = (weight * source).sum(dim=1), (weight * partner).sum(dim=1)
        x, y = source - source_mean[:, None], partner - partner_mean[:, None]
        rotation = nearest_rotation((weight * y).transpose(1, 2) @ x)
        # Means of many shrink towards each other, which least squares would answer with an ever smaller scale: the
        # ratio of spreads does not, and half a step at a time it settles.
        spreads = (weight * y.square()).sum(dim=(1, 2)) / (weight * x.square()).sum(dim=(1, 2)).clamp_min(1e-9)
        scale = (spreads.sqrt().clamp(*SCALE_RANGE) + poses.scale) / 2
        turned = (rotation @ source_mean[..., None])[..., 0]
        poses = Poses(scale, rotation, partner_mean - scale[:, None] * turned)
    return poses


def spread_indices(n: int, count: int) -> Int[Tensor, " chosen"]:
    """At most `count` of n indices, evenly spread."""
    return torch.arange(min(n, count)) * n // min(n, count)
