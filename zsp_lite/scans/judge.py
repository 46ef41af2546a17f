r"""The poses between two scans by all that was seen: the votes of the frames, the whole shapes, and
the vertical.

Frames of each object, solved against views of the other, vote by hypotheses with probabilities (see
`category.world_hypotheses`). The candidates are their rotations, and the best headings of the
upright shapes. Candidate k has the score

    S_k = (w_1 + w_2 h) V_k - (w_3 + w_4 h) \log D_k - w_5 T_k,

with V_k the mean over the frames of \log(\epsilon + \sum_h p_h \exp(\kappa (\cos\theta_{kh} - 1))),
a frame's part of the objective in `category`; D_k the Chamfer distance of the shapes, aligned from
the candidate on; h the share that is hidden of the object that was seen from more sides; and T_k
the angle between both verticals, in units of 45 degrees and at most 1: an object that lies in the
second scan is not forced upright. A conditional logit with one more case, that no candidate is
right, gives the probabilities.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.special import softmax

from zsp_lite.alignment import Sim3, nearest_rotation
from zsp_lite.data.evaluation import spread
from zsp_lite.metrics import rotation_angle, vector_angle
from zsp_lite.scans.category import FLOOR, PairHypotheses, agreement
from zsp_lite.scans.shapes import Shape, centred, chamfer_distance, compare_headings, refine
from zsp_lite.verified.confidence import hidden_share, modes
from zsp_lite.verified.poses import float_tensor, non_maximum_suppression

# w_1 to w_5, and the score of the case that no candidate is right. Fitted on validation
# categories (docs/rebuild.md).
WEIGHTS = (2.15, -3.76, 3.16, -4.38, 2.67)
_NONE = -0.42
# What follows is chosen, not fitted.
REFERENCES = 4  # frames of each object that are asked at most
_FIRST = 2  # frames of each object that are asked first
_SURE = 0.9  # a pair with this probability asks no more
_DIFFERENT = 15.0  # degrees between the candidates of the votes
_OF_VOTES = 10  # largest number of these candidates
_OF_HEADINGS = 3  # largest number of the candidates of the headings
_TILT = 45.0  # degrees, the unit of T
_ROUNDING = 1e-4  # added to Chamfer distances, which are 0 between equal shapes
_LEAST = 0.05  # weight of the aligned shapes in a pose for which frames vote


class Question(NamedTuple):
    """How does a frame of one object stand to another object?"""

    reference: str
    rank: int  # of the frame among the reference's frames that are asked
    target: str


# Answers questions in their order, by None where the views determine no pose.
Ask = Callable[[list[Question]], Iterable[PairHypotheses | None]]


def asked_positions(count: int, frames: int) -> list[int]:
    """Return the positions of at most `count` of an object's frames in the order in which they are
    asked: the first two are from different sides."""
    positions = spread(count, frames)
    return positions[::2] + positions[1::2]


def judge_pairs(
    shapes: Mapping[str, Shape],
    references: Mapping[str, int],
    ask: Ask,
    pairs: Sequence[tuple[str, str]],
) -> list[PairHypotheses]:
    """Find the poses between the objects of each pair.

    Two frames of each object are asked; where the answer is not sure, up to the number that
    `references` has for the object. Pairs for which nothing speaks are left out.
    """
    answers: dict[tuple[str, str], list[PairHypotheses]] = {pair: [] for pair in pairs}
    judged: dict[tuple[str, str], PairHypotheses | None] = {}
    most = max(references.values())
    ranks = range(_FIRST)
    while pairs and ranks.start < most:
        questions = [
            (pair, Question(a, rank, b))
            for pair in pairs
            for a, b in permutations(pair)
            for rank in ranks
            if rank < references[a]
        ]
        for (pair, _), answer in zip(questions, ask([one for _, one in questions]), strict=True):
            if answer is not None:
                answers[pair].append(answer)
        for pair in pairs:
            judged[pair] = judge(pair, shapes, answers[pair])
        pairs = [
            pair
            for pair, found in judged.items()
            if found is None or found.probabilities[0] < _SURE
        ]
        ranks = range(ranks.stop, 2 * ranks.stop)
    return [found for found in judged.values() if found is not None]


def judge(
    names: tuple[str, str], shapes: Mapping[str, Shape], answers: Sequence[PairHypotheses]
) -> PairHypotheses | None:
    """Find the poses between the worlds of two objects, with their probabilities; None without a
    candidate."""
    first, second = (shapes[name] for name in names)
    votes = Votes(names[0], answers)
    candidates, terms, aligned = score_terms(first, second, votes)
    if not len(candidates):
        return None
    scores = terms @ WEIGHTS
    order = np.argsort(-scores, kind="stable")
    probabilities = softmax([*scores, _NONE])

    # Candidates within 30 degrees of a better one are the same pose.
    mode_of = order[modes(rotation_angle(candidates[order][:, None], candidates[order]))]
    sums = np.bincount(mode_of, probabilities[order])
    best = np.argsort(-sums, kind="stable")[: np.count_nonzero(sums)]
    poses = tuple(votes.mean(candidates[k], aligned[k]) for k in best)
    centre = first.from_world.inverse().t
    return PairHypotheses(*names, poses, sums[best], centre)


class Votes:
    """The hypotheses of several frames as similarities from the world of the first object."""

    def __init__(self, first: str, answers: Sequence[PairHypotheses]):
        sim3s = [
            one if answer.reference == first else one.inverse()
            for answer in answers
            for one in answer.sim3s
        ]
        self.matrices = np.array([one.matrix for one in sim3s]).reshape(-1, 4, 4)
        self.turns = np.array([one.R for one in sim3s]).reshape(-1, 3, 3)
        # The probability of each hypothesis, in the row of its frame.
        self.weights = block_diag(*(answer.probabilities for answer in answers))

    def score(self, turns: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, " m"]:
        """Return V of rotations, 0 without votes."""
        if not len(self.turns):
            return np.zeros(len(turns))
        return np.log(FLOOR + agreement(turns, self.turns) @ self.weights.T).mean(axis=1)

    def different(self) -> Float[np.ndarray, "m 3 3"]:
        """Return the rotations of the best hypotheses that differ."""
        if not len(self.turns):
            return self.turns
        score = float_tensor(self.score(self.turns))
        best = non_maximum_suppression(float_tensor(self.turns), score, _DIFFERENT, _OF_VOTES)
        return self.turns[best.numpy()]

    def mean(self, turn: Float[np.ndarray, "3 3"], aligned: Sim3) -> Sim3:
        """Return the mean of the hypotheses that agree with a rotation, and of the aligned
        shapes."""
        weight = self.weights.sum(axis=0) * agreement(turn[None], self.turns)[0]
        total = np.tensordot(weight, self.matrices, 1) + _LEAST * aligned.matrix
        mean = total / (weight.sum() + _LEAST)
        linear = mean[:3, :3]
        return Sim3(
            np.cbrt(np.linalg.det(linear)), nearest_rotation(linear[None])[0][0], mean[:3, 3]
        )


def _best_headings(first: Shape, second: Shape) -> Float[np.ndarray, "m 3 3"]:
    """Return the rotations between worlds at the deepest minima of the Chamfer distance."""
    poses, distance = compare_headings(first, second)
    lowest = (distance <= np.roll(distance, 1)) & (distance <= np.roll(distance, -1))
    order = np.argsort(np.where(lowest, distance, np.inf))[: min(_OF_HEADINGS, lowest.sum())]
    return second.from_world.R.T @ poses[order, :3, :3] @ first.from_world.R


def score_terms(
    first: Shape, second: Shape, votes: Votes
) -> tuple[Float[np.ndarray, "m 3 3"], Float[np.ndarray, "m 5"], list[Sim3]]:
    """Return the candidates for the rotation, the terms that `WEIGHTS` weigh, and the similarities
    between the worlds that align the shapes."""
    candidates = votes.different()
    upright = first.upright and second.upright
    if upright:
        candidates = np.concatenate([candidates, _best_headings(first, second)])
    turns = second.from_world.R @ candidates @ first.from_world.R.T
    poses = refine(first, second, centred(first, turns))
    score = votes.score(candidates)
    fit = -np.log(chamfer_distance(first, second, poses) + _ROUNDING)
    hidden = hidden_share(max(first.span, second.span) / 360)
    tilt = np.minimum(vector_angle(turns[:, :, 2], np.array([0.0, 0.0, 1.0])) / _TILT, 1) * upright
    terms = np.stack([score, hidden * score, fit, hidden * fit, -tilt], axis=1)
    to_world = second.from_world.inverse()
    aligned = [to_world @ Sim3.from_matrix(one) @ first.from_world for one in poses]
    return candidates, terms, aligned
