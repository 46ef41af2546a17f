r"""Soft ICP: iterated alignment with soft correspondences that are near in space and similar in
features.

A variant of EM-ICP (Granger and Pennec 2002) with features. Reference point x_i under the current
pose T and target point y_j have the affinity

    A_ij = \exp(-|T x_i - y_j|^2 / (2 \sigma^2) + \lambda C_ij),

with C the double-centred feature similarity and \lambda = 8. Each x_i is paired with the mean
\sum_j A_ij y_j / a_i, where a_i = \sum_j A_ij, and gets the weight a_i / (a_i + a_0) in a weighted
fit of the pose: a point without a target point that is near and similar has nearly no influence.
\sigma decreases geometrically from 0.5 to 0.15 working units.
"""

import numpy as np
import torch

from zsp_lite.alignment import nearest_rotation
from zsp_lite.data.evaluation import spread
from zsp_lite.verified.poses import SCALE_RANGE, Poses, exp_, float_tensor
from zsp_lite.verified.scene import Scene

# These values are chosen, not fitted.
_ITERATIONS = 6
_FEATURE_WEIGHT = 8.0  # lambda
_MAX_POINTS = (100, 300)  # largest numbers of reference points and of target points
_SIGMAS = (0.5, 0.15)  # first and last, working units
_OUTLIER_AFFINITY = 0.01  # a_0 divided by the number of target points


def soft_icp(scene: Scene, poses: Poses) -> Poses:
    """Align every pose to the local optimum, independently of the others."""
    # Evenly spaced points of both sides.
    rows = spread(_MAX_POINTS[0], len(scene.reference_points))
    columns = spread(_MAX_POINTS[1], len(scene.target_points))
    source = scene.reference_points[rows]
    target = scene.target_points[columns]
    feature_term = _FEATURE_WEIGHT * scene.similarity[rows][:, scene.target_column[columns]]
    target_square = target.square().sum(dim=1)
    for sigma in np.geomspace(*_SIGMAS, _ITERATIONS):
        # Squared distances |x|^2 + |y|^2 - 2 x.y of each source to each target point: (m, n, k).
        moved = poses.apply(source)
        square = moved.square().sum(dim=2, keepdim=True) + target_square
        targets = target.T.expand(len(moved), 3, -1)  # a view of it for each pose
        square = torch.baddbmm(square, moved, targets, alpha=-2).clamp_min_(0)

        # Each source point gets a soft partner, (m, n, 3), and a weight that says if it has one.
        affinity = exp_(square.mul_(-0.5 / sigma**2).add_(feature_term))
        total = affinity.sum(dim=2, keepdim=True)
        partner = (affinity @ target) / total.clamp_min(1e-12)
        weight = total / (total + _OUTLIER_AFFINITY * len(target))
        weight = weight / weight.sum(dim=1, keepdim=True).clamp_min(1e-6)

        # Weighted alignment of the source to the partners.
        source_mean = (weight * source).sum(dim=1)
        partner_mean = (weight * partner).sum(dim=1)
        x = source - source_mean[:, None]
        y = partner - partner_mean[:, None]
        covariance = (weight * y).transpose(1, 2) @ x
        rotation = float_tensor(nearest_rotation(covariance.double().numpy())[0])
        # Soft partners are averages and have a smaller spread than the targets, so the
        # least-squares scale would shrink in each iteration. The ratio of spreads does not shrink.
        # The mean of that ratio and the last scale makes the iteration converge.
        source_variance = (weight * x.square()).sum(dim=(1, 2)).clamp_min(1e-9)
        variance_ratio = (weight * y.square()).sum(dim=(1, 2)) / source_variance
        scale = (variance_ratio.sqrt().clamp(*SCALE_RANGE) + poses.scale) / 2
        rotated_mean = (rotation @ source_mean[..., None])[..., 0]
        poses = Poses(scale, rotation, partner_mean - scale[:, None] * rotated_mean)
    return poses
