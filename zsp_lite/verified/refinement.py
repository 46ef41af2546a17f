"""Refinement: each pose climbs the score by random search.

The score is piecewise constant in places (silhouettes, pixels), so gradients do not help. The
search is a simple evolution strategy: per round it perturbs every pose with Gaussian steps of
shrinking width and keeps the best one.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from zsp_lite.verified.poses import (
    SCALE_RANGE,
    Poses,
    concatenate,
    non_maximum_suppression,
    rotation_matrices,
)
from zsp_lite.verified.scene import Scene
from zsp_lite.verified.verification import WEIGHTS, score_terms

MAX_HYPOTHESES = 6  # kept from search to search
MIN_ANGLE = 15.0  # degrees between them
_MAX_POLISHED = 3  # of these, the best that are polished
# About this many points of the reference and of the targets are scored, in the searches and in the
# polish.
_SEARCH_POINTS = (150, 375)
_POLISH_POINTS = (450, 2000)
# Steps of a round that are recombined into one candidate of the next round (mu in CMA-ES).
_PARENTS = 6


class SearchSchedule(NamedTuple):
    """The rounds of a search, and standard deviations of the steps in the first round."""

    rounds: int
    samples: int  # steps per round and pose
    rotation: float  # of each component of the rotation vector, degrees
    translation: float  # of each component, working units
    scale: float  # of the logarithm
    decay: float  # factor on all three after each round


COARSE = SearchSchedule(
    rounds=3, samples=16, rotation=7.0, translation=0.12, scale=0.08, decay=0.65
)
FINE = SearchSchedule(rounds=5, samples=24, rotation=4.7, translation=0.08, scale=0.06, decay=0.75)
POLISH = SearchSchedule(
    rounds=4, samples=24, rotation=2.0, translation=0.035, scale=0.025, decay=0.8
)


def refine_coarse_to_fine(scene: Scene, poses: Poses, rng: np.random.Generator) -> Poses:
    """Refine poses in three searches of decreasing width, on some of the points."""

    def score(poses: Poses, points: tuple[int, int] = _SEARCH_POINTS) -> Float[Tensor, " m"]:
        """Score poses on about so many points of the reference and of the targets."""
        totals = (len(scene.reference_points), len(scene.target_points))
        # Every so many points are scored, of the reference and of the targets.
        stride = tuple(max(round(total / count), 1) for total, count in zip(totals, points))
        return WEIGHTS.score(score_terms(scene, poses, stride))

    for schedule in (COARSE, FINE):
        poses, reached = refine(poses, score, schedule, rng)
        poses = poses[non_maximum_suppression(poses.rotation, reached, MIN_ANGLE, MAX_HYPOTHESES)]
    polished, _ = refine(poses[:_MAX_POLISHED], partial(score, points=_POLISH_POINTS), POLISH, rng)
    return concatenate([polished, poses[_MAX_POLISHED:]])


def refine(
    poses: Poses,
    score: Callable[[Poses], Float[Tensor, " _"]],
    schedule: SearchSchedule,
    rng: np.random.Generator,
) -> tuple[Poses, Float[Tensor, " m"]]:
    """Improve every pose by random search within `SCALE_RANGE`; return poses and scores."""
    best_score = score(poses)
    m = len(poses)
    rows = torch.arange(m)
    # A candidate of the next round is the mean of the best steps, with the weights of CMA-ES
    # (Hansen 2016).
    weights = np.log(_PARENTS + 0.5) - np.log(np.arange(1, _PARENTS + 1))
    weights = torch.tensor(weights / weights.sum(), dtype=torch.float32)[:, None]
    recombined = None  # (m, 7), one step of the next round for each pose
    for turn in range(schedule.rounds):
        # All poses get the same steps: the result for one pose does not depend on the number of
        # others.
        draws = rng.standard_normal((schedule.samples, 7)).astype(np.float32) * schedule.decay**turn
        steps = torch.from_numpy(draws).repeat(m, 1, 1)  # (m, samples, 7)
        if recombined is not None:
            steps[:, 0] = recombined

        # The best steps of each pose, best first: (m, parents).
        candidates = _perturb(poses, steps, schedule)
        top_score, top = score(candidates).view(m, -1).topk(_PARENTS, dim=1)
        index = rows * schedule.samples + top[:, 0]  # of the best step, among all candidates
        improved = top_score[:, 0] > best_score

        mean = (steps[rows[:, None], top] * weights).sum(dim=1)
        # Relative to the pose from which the next round starts.
        recombined = mean - torch.where(improved[:, None], steps[rows, top[:, 0]], 0)
        # The candidates stand behind the m poses.
        poses = concatenate([poses, candidates])[torch.where(improved, m + index, rows)]
        best_score = torch.maximum(best_score, top_score[:, 0])
    return poses, best_score


def _perturb(poses: Poses, steps: Float[Tensor, "m samples 7"], schedule: SearchSchedule) -> Poses:
    """Apply each step to its pose: 3 components of rotation, 3 of translation, 1 of log-scale."""
    vectors = torch.deg2rad(schedule.rotation * steps[..., :3]).flatten(0, 1)
    rotation = rotation_matrices(vectors).view(*steps.shape[:2], 3, 3) @ poses.rotation[:, None]
    scale = (poses.scale[:, None] * torch.exp(schedule.scale * steps[..., 6])).clamp(*SCALE_RANGE)
    translation = poses.translation[:, None] + schedule.translation * steps[..., 3:6]
    return Poses(scale.flatten(), rotation.flatten(0, 1), translation.flatten(0, 1))
