r"""Calibrated confidence: the probability that a hypothesis's rotation is within 30 degrees of the truth.

A logistic function of two numbers: the margin of the hypothesis's score over the best one with another rotation, and
the standard deviation of the target views' feature similarity to the reference. If that is small, the features hardly
distinguish the sides of the object. `reliability` measures how well confidences are calibrated.

The coefficients were fitted with the backbone zsp-tiny-primitives on synthetic objects. They are not calibrated for
other backbones.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from zsp_lite.errors import InputError

# Hypotheses whose rotations differ by more than this many degrees are distinct: the paper's wider error threshold.
MODE_ANGLE = 30.0
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
