r"""Calibrated probabilities: how likely is the rotation of each hypothesis within 30 degrees of the truth?

The score S is a conditional logit (McFadden 1974), with one more alternative: that none of the poses is right. Of the
different poses (see `modes`) of an estimate from N target views, pose k has the probability

    p_k = \exp(-a (S_1 - S_k)) / (\exp(b) + \sum_j \exp(-a (S_1 - S_j))),
    a = \exp(\alpha_0 + \alpha_1 \log N),   b = \beta_0 + \beta_1 \log N + \beta_2 s + \beta_3 g,

where s is the standard deviation of the target views' feature similarity to the reference, and g that part of the best
score which compares shapes (overlap, silhouettes and free space). If s is small, the features hardly distinguish the
sides of the object; if g is small, the two shapes do not fit under any pose that was found. What the p_k leave of 1 is
the probability of none of these. The confidence of an estimate is p_1. `reliability` measures how well such
probabilities are calibrated.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from zsp_lite.errors import InputError

# Hypotheses whose rotations differ by more than this many degrees are distinct: the paper's wider error threshold.
MODE_ANGLE = 30.0
# Another pose is nearly as probable as the best one above this fraction of its probability.
TIE_RATIO = float(np.exp(-1))


@dataclass(frozen=True)
class Calibration:
    r"""The six coefficients, fitted on validation categories of equal weight for N = 1 to 10 (`tools/tuning.py`).

    Attributes:
        scale: \alpha_0.
        scale_views: \alpha_1.
        none: \beta_0.
        none_views: \beta_1.
        none_std: \beta_2.
        none_shape: \beta_3.
    """

    scale: float = -1.33
    scale_views: float = 0.62
    none: float = 0.82
    none_views: float = -1.16
    none_std: float = -30.9
    none_shape: float = -0.269

    def probabilities(
        self, deficit: Float[np.ndarray, "*batch m"], n_views: float | Float[np.ndarray, "*batch 1"],
        view_std: float | Float[np.ndarray, "*batch 1"], shape_fit: float | Float[np.ndarray, "*batch 1"],
    ) -> Float[np.ndarray, "*batch m"]:  # fmt: skip
        """Return the probabilities of different poses.

        Args:
            deficit: S_1 - S_k, nats; infinite for no pose.
            n_views: Number N of target views.
            view_std: Standard deviation s of view similarities (see `Scene.view_similarity_std`).
            shape_fit: Shape part g of the best score, nats (see `ScoreWeights.shape_fit`).
        """
        log_n = np.log(n_views)
        odds = np.exp(-np.exp(self.scale + self.scale_views * log_n) * deficit)
        none = self.none + self.none_views * log_n + self.none_std * view_std + self.none_shape * shape_fit
        return odds / (np.exp(none) + odds.sum(axis=-1, keepdims=True))


def modes(angle: Float[np.ndarray, "m m"]) -> Int[np.ndarray, " m"]:
    """Merge hypotheses that are the same pose: those whose rotations differ by less than 30 degrees.

    Args:
        angle: Angles between the rotations of the hypotheses in degrees, best hypothesis first.

    Returns:
        For each hypothesis, the index of the one that stands for it: its own, or that of the nearest better one that
        stands for itself.
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
    """Return the probability of each hypothesis; over different poses they sum to at most 1.

    Args:
        score: Scores of the hypotheses in nats, best first.
        mode: The hypothesis that stands for each (see `modes`).
        n_views: Number of target views.
        view_std: Standard deviation of view similarities.
        shape_fit: Shape part of the best score, nats.
        calibration: Coefficients.

    Returns:
        Probabilities that the rotation error is below 30 degrees. A hypothesis has that of the one that stands for it.
    """
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
    """Tell whether the answer is one of two poses that are nearly equally probable and far apart.

    Args:
        probability: Probabilities of the hypotheses, best first (see `hypothesis_probabilities`).
        mode: The hypothesis that stands for each (see `modes`).
        angle: Angles between their rotations, degrees.

    Returns:
        Whether three conditions hold: the second pose, and no other, is nearly as probable as the first (see
        `nearly_as_probable`); together they are more probable than not; and their rotations differ by more than 60
        degrees, so that no rotation is within 30 degrees of both.
    """
    likely = nearly_as_probable(probability, mode)
    return bool(len(likely) == 2 and probability[likely].sum() > 0.5 and angle[likely[0], likely[1]] > 2 * MODE_ANGLE)


@dataclass(frozen=True, eq=False)
class Reliability:
    """How well confidences are calibrated and how well they rank estimates. `print` shows it as a table.

    Bins hold equal numbers of estimates, in order of confidence.

    Attributes:
        auroc: Area under the ROC curve (see `auroc`).
        calibration_error: Expected calibration error, in [0, 1].
        top_half_accuracy: Fraction of correct estimates among the more confident half.
        count: (bins,) number of estimates.
        confidence: (bins,) mean confidence.
        accuracy: (bins,) fraction of correct estimates.
    """

    auroc: float
    calibration_error: float
    top_half_accuracy: float
    count: np.ndarray
    confidence: Float[np.ndarray, " bins"]
    accuracy: Float[np.ndarray, " bins"]

    def __str__(self) -> str:
        lines = [f"{'n':>5} {'confidence':>11} {'correct':>8}"]
        lines += [
            f"{n:5d} {100 * c:10.1f}% {100 * a:7.1f}%" for n, c, a in zip(self.count, self.confidence, self.accuracy)
        ]
        lines.append(
            f"AUROC {self.auroc:.3f}, expected calibration error {100 * self.calibration_error:.1f} points, "
            f"accuracy of the more confident half {100 * self.top_half_accuracy:.1f} %"
        )
        return "\n".join(lines)


def reliability(confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], bins: int = 10) -> Reliability:
    """Measure the reliability of confidences.

    Args:
        confidence: Confidences of n estimates, in [0, 1].
        correct: Which of the estimates were correct.
        bins: Number of bins of equal count.

    Raises:
        InputError: If the lengths differ or there are fewer estimates than bins.
    """
    confidence, correct = np.asarray(confidence, dtype=np.float64), np.asarray(correct, dtype=bool)
    if confidence.shape != correct.shape or confidence.ndim != 1 or len(correct) < bins:
        raise InputError(
            f"{len(correct)} outcomes and {len(confidence)} confidences, expected equal numbers of at least {bins}"
        )
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, bins)
    mean = np.array([confidence[part].mean() for part in parts])
    accuracy = np.array([correct[part].mean() for part in parts])
    count = np.array([len(part) for part in parts])
    upper_half = order[len(order) // 2 :]
    error = float((count * np.abs(mean - accuracy)).sum() / count.sum())
    return Reliability(auroc(confidence, correct), error, float(correct[upper_half].mean()), count, mean, accuracy)


def auroc(confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"]) -> float:
    """Estimate the probability that a correct estimate has a higher confidence than a wrong one, ties counting half.

    Returns:
        Area under the ROC curve in [0, 1]; nan if all estimates are correct or all are wrong.
    """
    correct = np.asarray(correct, dtype=bool)
    positive, negative = np.asarray(confidence)[correct], np.asarray(confidence)[~correct]
    if not len(positive) or not len(negative):
        return float("nan")
    difference = positive[:, None] - negative
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())
