r"""Agreement of photo features: the term `agreement` of the score, with a weight for every channel.

The deepest features of a network that was trained on photographs say in some of their channels what part of an object a
place belongs to, and in others what it looks like. Which channels tell right from wrong poses was learnt on training
categories (`python -m tools.tuning agreement`).

Let e_i be the photo features at point i of one object: layer-normalised, less their mean over the object's points, and
of unit length. Under a pose, the features of the other object near that point are the weighted mean

    m_i = (\sum_j K_ij e_j) / (\sum_j K_ij + 0.3),   K_ij = \exp(-d_ij^2 / (2 \cdot 0.25^2)),

with d_ij the distance between the points in the reference's working frame. Without points near by, m_i is 0. The
agreement of channel c is the mean of e_ic m_ic over the points, once of the reference and once of the targets, and

    agreement = \sum_c w_c agreement_c.

The weights w are in nats. They are those of a conditional logit in which the score without this term has a weight of
its own, divided by that weight.
"""

from functools import lru_cache

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from safetensors.torch import load_file
from torch import Tensor

from zsp_lite.backbones.pretrained import WEIGHTS, check_shipped
from zsp_lite.verified.poses import Poses, exp_
from zsp_lite.verified.scene import Scene

CHANNEL_WEIGHTS = WEIGHTS / "agreement.safetensors"
_SIGMA = 0.25  # working units
_PRIOR = 0.3  # weight of "nothing near by"
_REFERENCE_POINTS, _TARGET_POINTS = 160, 320  # at most, evenly spaced in the scene's order


def channel_agreement(scene: Scene, poses: Poses) -> Float[Tensor, "m channels"]:
    """Compute the agreement of every channel under every pose: of the reference's points, then of the targets'.

    Args:
        scene: Scene with photo features.
        poses: The m poses.
    """
    reference, target, kernel = _near_points(scene, poses)
    forward = kernel @ target / (kernel.sum(dim=2, keepdim=True) + _PRIOR)
    reverse = kernel.transpose(1, 2) @ reference / (kernel.sum(dim=1)[..., None] + _PRIOR)
    return torch.cat([(forward * reference).mean(dim=1), (reverse * target).mean(dim=1)], dim=1)


def agreement_term(scene: Scene, poses: Poses) -> Float[Tensor, " m"]:
    """Compute the agreement term; 0 for a scene without photo features, or with another number of channels.

    The weighted sum over the channels is taken before that over the points: it does not depend on the pose.
    """
    if scene.reference_photo is None or 2 * scene.reference_photo.shape[1] != len(channel_weights()):
        return torch.zeros(len(poses))
    reference, target, kernel = _near_points(scene, poses)
    forward, reverse = ((reference * weights) @ target.T for weights in channel_weights().chunk(2))
    forward = (kernel * forward).sum(dim=2) / (kernel.sum(dim=2) + _PRIOR)
    reverse = (kernel * reverse).sum(dim=1) / (kernel.sum(dim=1) + _PRIOR)
    return forward.mean(dim=1) + reverse.mean(dim=1)


def _near_points(
    scene: Scene, poses: Poses
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "k c"], Float[Tensor, "m n k"]]:
    """Return the descriptors of some points of the reference and of the targets, and their kernel K under the poses."""
    rows, columns = (
        _spaced(len(points), most)
        for points, most in ((scene.reference_points, _REFERENCE_POINTS), (scene.target_points, _TARGET_POINTS))
    )
    moved = poses.inverse().apply(scene.target_points[columns])
    squared = torch.cdist(scene.reference_points[rows].expand(len(poses), -1, -1), moved).square_()
    kernel = exp_(squared.mul_(-0.5 / _SIGMA**2))
    return _descriptors(scene.reference_photo)[rows], _descriptors(scene.target_photo)[columns], kernel


@lru_cache(maxsize=1)
def channel_weights() -> Float[Tensor, " channels"]:
    """Load the weights of the channels, in the order of `channel_agreement`."""
    check_shipped(CHANNEL_WEIGHTS)
    return load_file(CHANNEL_WEIGHTS)["weights"]


def _spaced(n: int, most: int) -> Int[Tensor, " k"]:
    return torch.linspace(0, n - 1, min(n, most)).long()


def _descriptors(photo: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
    photo = F.layer_norm(photo, photo.shape[1:])
    return F.normalize(photo - photo.mean(dim=0), dim=1, eps=1e-3)  # equal features have no direction
