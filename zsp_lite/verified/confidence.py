r"""Calibrated probabilities: how likely is the rotation of each hypothesis within 30 degrees of the truth?

The score S is a conditional logit (McFadden 1974), with one more alternative: that none of the poses is right. Of the
different poses (see `modes`) of an estimate from N target views, pose k has the probability

    p_k = \exp(-a (S_1 - S_k)) / (\exp(b) + \sum_j \exp(-a (S_1 - S_j))),
    a = \exp(\alpha_0 + \alpha_1 \log N),   b = \beta_0 + \beta_1 \log N + \beta_2 s + \beta_3 g,

where s is the standard deviation of the target views' feature similarity to the reference, and g that part of the best
score which compares shapes (overlap, silhouettes and free space). If s is small, the features hardly distinguish the
sides of the object; if g is small, the two shapes do not fit under any pose that was found. What the p_k leave of 1 is
the probability of none of these. The confidence of an estimate is p_1. `metrics.reliability` measures how well such
probabilities are calibrated.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

# Hypotheses whose rotations differ by more than this many degrees are distinct: the paper's wider error threshold.
MODE_ANGLE = 30.0
TIE_RATIO = float(np.exp(-1))  # of the best pose's probability: above it, another pose is nearly as probable


@dataclass(frozen=True)
class Calibration:
    r"""The six coefficients, fitted on validation categories of equal weight for N = 1 to 10 (`tools/tuning.py`)."""

    scale: float = -1.01  # \alpha_0
    scale_views: float = 0.52  # \alpha_1
    none: float = 1.23  # \beta_0
    none_views: float = -0.99  # \beta_1
    none_std: float = -32.6  # \beta_2
    none_shape: float = -0.339  # \beta_3

    def probabilities(
        self, deficit: Float[np.ndarray, "*batch m"], n_views: float | Float[np.ndarray, "*batch 1"],
        view_std: float | Float[np.ndarray, "*batch 1"], shape_fit: float | Float[np.ndarray, "*batch 1"],
    ) -> Float[np.ndarray, "*batch m"]:  # fmt: skip
        """Return the probabilities of different poses; the `deficit` S_1 - S_k is infinite for no pose."""
        log_n = np.log(n_views)
        odds = np.exp(-np.exp(self.scale + self.scale_views * log_n) * deficit)
        none = self.none + self.none_views * log_n + self.none_std * view_std + self.none_shape * shape_fit
        return odds / (np.exp(none) + odds.sum(axis=-1, keepdims=True))


def modes(angle: Float[np.ndarray, "m m"]) -> Int[np.ndarray, " m"]:
    """Return for each hypothesis the index of the one that stands for its pose: the nearest better one that stands for
    itself within 30 degrees, or its own.
    """
    found: list[int] = []
    for i, row in enumerate(angle):
        near = [j for j in range(i) if found[j] == j and row[j] < MODE_ANGLE]
        found.append(min(near, key=row.__getitem__, default=i))
    return np.array(found)


def different_poses(mode: Int[np.ndarray, " m"]) -> Int[np.ndarray, " k"]:
    """Return the indices of the hypotheses that stand for themselves (see `modes`), best first."""
    return np.flatnonzero(mode == np.arange(len(mode)))


def hypothesis_probabilities(
    score: Float[np.ndarray, " m"], mode: Int[np.ndarray, " m"], n_views: int, view_std: float, shape_fit: float,
    calibration: Calibration,
) -> Float[np.ndarray, " m"]:  # fmt: skip
    """Return the probability of each hypothesis; over different poses they sum to at most 1."""
    different, probability = different_poses(mode), np.empty(len(score))
    probability[different] = calibration.probabilities(score[0] - score[different], n_views, view_std, shape_fit)
    return probability[mode]


def nearly_as_probable(probability: Float[np.ndarray, " m"], mode: Int[np.ndarray, " m"]) -> Int[np.ndarray, " k"]:
    """Return the indices of the best pose and of the others whose probability is above 1/e of its, best first."""
    different = different_poses(mode)
    return different[probability[different] > TIE_RATIO * probability[0]]


def is_one_of_two(
    probability: Float[np.ndarray, " m"], mode: Int[np.ndarray, " m"], angle: Float[np.ndarray, "m m"]
) -> bool:
    """Tell whether the answer is one of two poses: both nearly as probable and no third, together more probable than
    not, and more than 60 degrees apart, so that no rotation is within 30 degrees of both.
    """
    likely = nearly_as_probable(probability, mode)
    return bool(len(likely) == 2 and probability[likely].sum() > 0.5 and angle[likely[0], likely[1]] > 2 * MODE_ANGLE)
