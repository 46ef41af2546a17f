"""The score itself climbed by trial: each pose tries random small changes and keeps the best.

The score has steps (silhouettes, pixels), so there is no gradient to follow; but a thousand poses cost milliseconds.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from zsp_lite.verified.poses import SCALE_RANGE, Poses


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
POLISH = Search(rounds=5, tries=24, rotation=2.0, translation=0.035, scale=0.025, shrink=0.8)
# The best changes of a round that point the way together; their logarithmic weights are evolution strategies' usual.
_TOGETHER = 6


def refine(
    poses: Poses, score: Callable[[Poses], Float[Tensor, " m"]], search: Search, seed: int | np.random.Generator = 0
) -> tuple[Poses, Float[Tensor, " m"]]:
    """The poses after the search, and their scores: never worse than before.

    Of the changes that a round tries the best is kept; the weighted mean of the best six is tried in the next round,
    for what each got right by chance adds up while the rest averages out.
    Rotations are about the reference's centre, which working units put at the origin.
    """
    rng = np.random.default_rng(seed)
    best, m = score(poses), len(poses)
    each = torch.arange(m)
    count = min(_TOGETHER, search.tries)
    share = np.log(count + 0.5) - np.log(np.arange(1, count + 1))
    share = torch.tensor(share / share.sum(), dtype=torch.float32)[:, None]
    rest = None
    for turn in range(search.rounds):
        # All poses try the same changes: what becomes of one does not depend on how many others there are.
        draws = rng.standard_normal((search.tries, 7)).astype(np.float32) * search.shrink**turn
        steps = torch.from_numpy(draws).repeat(m, 1, 1)
        if rest is not None:
            steps[:, 0] = rest
        tried = _moved(poses, steps, search)
        reached = score(tried).view(m, -1)
        highest, order = reached.topk(count, dim=1)
        at = each * search.tries + order[:, 0]
        better = highest[:, 0] > best
        mean = (steps[each[:, None], order] * share).sum(dim=1)
        rest = mean - torch.where(better[:, None], steps[each, order[:, 0]], 0)
        poses = Poses(
            torch.where(better, tried.scale[at], poses.scale),
            torch.where(better[:, None, None], tried.rotation[at], poses.rotation),
            torch.where(better[:, None], tried.translation[at], poses.translation),
        )
        best = torch.where(better, highest[:, 0], best)
    return poses, best


def _moved(poses: Poses, steps: Float[Tensor, "m tries 7"], search: Search) -> Poses:
    """Each pose changed by each of its steps: three of rotation, three of translation, one of scale."""
    turn = rotations(torch.deg2rad(search.rotation * steps[..., :3]).flatten(0, 1)).view(*steps.shape[:2], 3, 3)
    scale = (poses.scale[:, None] * torch.exp(search.scale * steps[..., 6])).clamp(*SCALE_RANGE)
    translation = poses.translation[:, None] + search.translation * steps[..., 3:6]
    return Poses(scale.flatten(), (turn @ poses.rotation[:, None]).flatten(0, 1), translation.flatten(0, 1))


def rotations(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Rotation by |v| radians about v (Rodrigues)."""
    angle = vectors.norm(dim=-1, keepdim=True)
    x, y, z = (vectors / angle.clamp_min(1e-12)).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).view(-1, 3, 3)
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    return torch.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)
