"""The score itself climbed by trial: each pose tries random small changes and keeps the best.

The score has steps (silhouettes, pixels), so there is no gradient to follow; but a thousand poses cost milliseconds.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from zsp_lite.verified.poses import Poses

_SCALES = (0.5, 1.6)


@dataclass(frozen=True)
class Search:
    """Widths of the changes (degrees, shares of the object's spread, logarithm of the scale) and how they shrink."""

    rounds: int
    tries: int
    rotation: float
    translation: float
    scale: float
    shrink: float


COARSE = Search(rounds=3, tries=16, rotation=7.0, translation=0.12, scale=0.08, shrink=0.65)
FINE = Search(rounds=6, tries=24, rotation=4.7, translation=0.08, scale=0.06, shrink=0.75)


def refine(
    poses: Poses, score: Callable[[Poses], Float[Tensor, "m"]], search: Search, seed: int | np.random.Generator = 0
) -> tuple[Poses, Float[Tensor, "m"]]:
    """The poses after the search, and their scores: never worse than before.

    Rotations are about the reference's centre, which working units put at the origin.
    """
    rng = np.random.default_rng(seed)
    best, all_poses = score(poses), torch.arange(len(poses))
    for turn in range(search.rounds):
        width = search.shrink**turn
        # All poses try the same changes: what becomes of one does not depend on how many others there are.
        draws = torch.from_numpy(rng.standard_normal((search.tries, 7)).astype(np.float32)) * width
        turned = rotations(torch.deg2rad(search.rotation * draws[:, :3])) @ poses.rotation[:, None]
        scale = (poses.scale[:, None] * torch.exp(search.scale * draws[:, 6])).clamp(*_SCALES)
        moved = poses.translation[:, None] + search.translation * draws[:, 3:6]
        tried = score(Poses(scale.flatten(), turned.flatten(0, 1), moved.flatten(0, 1))).view(len(poses), -1)
        highest, at = tried.max(dim=1)
        better = highest > best
        poses = Poses(
            torch.where(better, scale[all_poses, at], poses.scale),
            torch.where(better[:, None, None], turned[all_poses, at], poses.rotation),
            torch.where(better[:, None], moved[all_poses, at], poses.translation),
        )
        best = torch.where(better, highest, best)
    return poses, best


def rotations(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Rotation by |v| radians about v (Rodrigues)."""
    angle = vectors.norm(dim=-1, keepdim=True)
    x, y, z = (vectors / angle.clamp_min(1e-12)).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(-1, 3, 3)
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    return torch.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)
