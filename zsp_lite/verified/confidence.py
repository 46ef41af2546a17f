r"""Calibrated confidence: the probability that a hypothesis's rotation is within 30 degrees of the truth.

That of the best hypothesis is a logistic function of two numbers: the margin of its score over the best one with
another rotation, and the standard deviation of the target views' feature similarity to the reference. If that is small,
the features hardly distinguish the sides of the object. `hypothesis_probabilities` derives those of the other
hypotheses from it, and `reliability` measures how well confidences are calibrated.

The coefficients were fitted with the backbone zsp-tiny-primitives on synthetic objects. They are not calibrated for
other backbones.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from zsp_lite.errors import InputError

# Hypotheses whose rotations differ by more than this many degrees are distinct: the paper's wider error threshold.
MODE_ANGLE = 30.0
# Hypotheses are tied if their scores differ by less than this many nats. On ellipsoids whose features have the same
# symmetry, seen from all sides, the scores of equally correct poses differ by 0.6 nats in the median and by less than
# 1 in three of four cases. Of training pairs with a margin below 1, the best hypothesis was correct in 62 %
# (tools/tuning.py). Ties are not detected if the views show more of the object under one pose than under the other:
# then scores of equally correct poses differ by several nats.
TIE_MARGIN = 1.0
# Margins are clipped at this many nats. It is also the margin of a hypothesis without a distinct rival.
_MAX_MARGIN = 8.0


@dataclass(frozen=True)
class Calibration:
    r"""Logistic calibration: confidence = 1 / (1 + \exp(-(bias + margin * x_1 + view_std * x_2))).

    The defaults are for five target views, rounded from a fit on objects of training categories (-1.07, 0.97, 25.6).
    Scores are in nats, so a coefficient of 1 for the margin means that the score itself is calibrated.

    Attributes:
        bias: Intercept.
        margin: Coefficient of the score margin in nats, x_1 (see `score_margins`).
        view_std: Coefficient of the standard deviation of view similarities, x_2 (see `Scene.view_similarity_std`).
    """

    bias: float = -1.0
    margin: float = 1.0
    view_std: float = 25.0

    def confidence(
        self, margin: float | Float[np.ndarray, " m"], view_std: float | Float[np.ndarray, " m"]
    ) -> float | Float[np.ndarray, " m"]:
        """Return confidences in [0, 1] from score margins in nats and standard deviations of view similarities."""
        return 1 / (1 + np.exp(-(self.bias + self.margin * margin + self.view_std * view_std)))


# By number of target views. With fewer views poses are tested less, and a given margin means less: with one view
# the most confident hypotheses are correct in two of five cases. For one and three views only the margin is used.
CALIBRATIONS = {1: Calibration(-1.8, 0.2, 0.0), 3: Calibration(-0.7, 0.7, 0.0), 5: Calibration()}


def calibration_for(n_views: int) -> Calibration:
    """Return the calibration for a number of target views, interpolated between those in `CALIBRATIONS`."""
    columns = ([getattr(one, name) for one in CALIBRATIONS.values()] for name in ("bias", "margin", "view_std"))
    return Calibration(*(float(np.interp(n_views, list(CALIBRATIONS), column)) for column in columns))


def score_margins(score: Float[np.ndarray, " m"], angle: Float[np.ndarray, "m m"]) -> Float[np.ndarray, " m"]:
    """Return each hypothesis's score minus the best score more than 30 degrees away, clipped to [-8, 8] nats.

    Args:
        score: Scores of the hypotheses, nats.
        angle: Angles between their rotations, degrees.
    """
    rivals = np.where(angle > MODE_ANGLE, score, -np.inf)
    return np.clip(score - rivals.max(axis=1), -_MAX_MARGIN, _MAX_MARGIN)


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


def hypothesis_probabilities(
    score: Float[np.ndarray, " m"], angle: Float[np.ndarray, "m m"], calibration: Calibration, view_std: float
) -> Float[np.ndarray, " m"]:
    r"""Return the probability of each hypothesis; over different poses (see `modes`) they sum to at most 1.

    The best hypothesis has its calibrated confidence c. The score is a conditional logit (McFadden 1974), so that pose
    k, of score S_k, has the odds o_k against the best one, with the calibrated coefficient a of the margin. The odds
    that none of the poses is right, o_0, are those of a best hypothesis without any rival, whose margin is 8 nats:

        o_k = \exp(-a (S_1 - S_k)),   o_0 = (1 - c_8) / c_8,   c_8 = confidence(8, view_std)

        p_1 = c,   p_k = o_k \min(c, (1 - c) / (o_0 + \sum_{j \geq 2} o_j))   for k \geq 2.

    The second argument of the minimum divides what the best pose leaves among the others and "none of these" by their
    odds; the first keeps a pose from being more probable, relative to the best, than their scores say. The rest,
    1 - \sum_k p_k, is the probability of none of these. It has not been measured how well the p_k below the first are
    calibrated.

    Args:
        score: Scores of the hypotheses in nats, best first.
        angle: Angles between their rotations, degrees.
        calibration: Calibration of the best one's confidence.
        view_std: Standard deviation of view similarities.

    Returns:
        Probabilities that the rotation error is below 30 degrees. A hypothesis has that of the one that stands for it.
    """
    mode = modes(angle)
    best = calibration.confidence(score_margins(score, angle), view_std)[0]
    probability = np.full(len(score), best)
    others = np.flatnonzero(mode == np.arange(len(mode)))[1:]
    if len(others):
        odds = np.exp(-calibration.margin * (score[0] - score[others]))
        without_rival = calibration.confidence(_MAX_MARGIN, view_std)
        none = (1 - without_rival) / without_rival
        probability[others] = odds * min(best, (1 - best) / (none + odds.sum()))
    return probability[mode]


def is_one_of_two(probability: Float[np.ndarray, " m"], angle: Float[np.ndarray, "m m"]) -> bool:
    """Tell whether the answer is one of two poses that are nearly equally probable and far apart.

    Three conditions: the probability of the second pose, and of no other, is above 1/e of the first's (one nat less,
    see `TIE_MARGIN`); together they are more probable than not; and their rotations differ by more than 60 degrees, so
    that no rotation is within 30 degrees of both.

    Args:
        probability: Probabilities of the hypotheses, best first (see `hypothesis_probabilities`).
        angle: Angles between their rotations, degrees.
    """
    mode = modes(angle)
    distinct = np.flatnonzero(mode == np.arange(len(mode)))
    likely = distinct[probability[distinct] > probability[0] * np.exp(-TIE_MARGIN)]
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
