"""Refinement: each pose climbs the score by random search.

The score is piecewise constant in places (silhouettes, pixels), so gradients do not help. The
search is a simple evolution strategy: per round it perturbs every pose with Gaussian steps of
shrinking width and keeps the best one.
"""

from collections.abc import Callable
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

# All values here are chosen, not fitted.
# Each search keeps at most this many poses, as does the ranking after the last one.
MAX_HYPOTHESES = 6
# The rotations of the poses that are kept differ by at least this angle, degrees.
MIN_ANGLE = 15.0
# The polish scores many points and takes long, so that only the best poses get it.
_MAX_POLISHED = 3
# Approximate numbers of reference points and of target points that a search scores. Few points
# suffice to find the better of two distant poses; the polish compares near ones.
_SEARCH_POINTS = (150, 375)
_POLISH_POINTS = (450, 2000)
# Number of a round's best steps whose mean is a candidate of the next round (mu in CMA-ES).
_PARENTS = 6


class SearchSchedule(NamedTuple):
    """The rounds of a search, and standard deviations of the steps in the first round."""

    rounds: int
    samples: int  # steps per round and pose
    rotation: float  # of each component of the rotation vector, degrees
    translation: float  # of each component, working units
    scale: float  # of the logarithm
    decay: float  # factor on all three after each round


# Each search begins with narrower steps than the one before began with, but with wider steps than
# that one ended with.
COARSE = SearchSchedule(
    rounds=3, samples=16, rotation=7.0, translation=0.12, scale=0.08, decay=0.65
)
FINE = SearchSchedule(rounds=5, samples=24, rotation=4.7, translation=0.08, scale=0.06, decay=0.75)
POLISH = SearchSchedule(
    rounds=4, samples=24, rotation=2.0, translation=0.035, scale=0.025, decay=0.8
)


def refine_coarse_to_fine(scene: Scene, poses: Poses, rng: np.random.Generator) -> Poses:
    """Refine poses in three searches of decreasing width, on some of the points."""
    for schedule in (COARSE, FINE):
        poses, reached = refine(poses, _scorer(scene, _SEARCH_POINTS), schedule, rng)
        poses = poses[non_maximum_suppression(poses.rotation, reached, MIN_ANGLE, MAX_HYPOTHESES)]
    polished, _ = refine(poses[:_MAX_POLISHED], _scorer(scene, _POLISH_POINTS), POLISH, rng)
    return concatenate([polished, poses[_MAX_POLISHED:]])


def _scorer(scene: Scene, counts: tuple[int, int]) -> Callable:
    """Return a function that scores poses on about `counts` reference points and target points."""
    reference_stride = max(round(len(scene.reference_points) / counts[0]), 1)
    target_stride = max(round(len(scene.target_points) / counts[1]), 1)
    return lambda poses: WEIGHTS.score(score_terms(scene, poses, (reference_stride, target_stride)))


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
    for done in range(schedule.rounds):
        # All poses get the same random steps: the result for one pose does not depend on the number
        # of others. From the second round on, the mean of a pose's best steps replaces the first
        # step.
        draws = rng.standard_normal((schedule.samples, 7)).astype(np.float32) * schedule.decay**done
        steps = torch.from_numpy(draws).repeat(m, 1, 1)  # (m, samples, 7)
        if recombined is not None:
            steps[:, 0] = recombined

        # A step has 3 components of rotation, 3 of translation, 1 of log-scale.
        vectors = torch.deg2rad(schedule.rotation * steps[..., :3]).flatten(0, 1)
        turns = rotation_matrices(vectors).view(*steps.shape[:2], 3, 3)
        scale = poses.scale[:, None] * torch.exp(schedule.scale * steps[..., 6])
        translation = poses.translation[:, None] + schedule.translation * steps[..., 3:6]
        candidates = Poses(
            scale.clamp(*SCALE_RANGE).flatten(),
            (turns @ poses.rotation[:, None]).flatten(0, 1),
            translation.flatten(0, 1),
        )
        # Scores and numbers of each pose's best steps, best first: (m, parents).
        top_scores, top_steps = score(candidates).view(m, -1).topk(_PARENTS, dim=1)
        best_step = top_steps[:, 0]
        improved = top_scores[:, 0] > best_score

        # The next round starts from the best candidate where it improves the pose: the mean step
        # leads from there. The difference of two rotation vectors is nearly the rotation between
        # them, since steps are small; the score judges the candidate in any case.
        mean_step = (steps[rows[:, None], top_steps] * weights).sum(dim=1)
        recombined = mean_step - torch.where(improved[:, None], steps[rows, best_step], 0)
        # The candidates follow the m poses in the concatenation, `samples` of them for each pose.
        best_candidate = m + rows * schedule.samples + best_step
        poses = concatenate([poses, candidates])[torch.where(improved, best_candidate, rows)]
        best_score = torch.maximum(best_score, top_scores[:, 0])
    return poses, best_score
