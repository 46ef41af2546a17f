"""How sure a hypothesis is: a calibrated chance that its rotation is within 30 degrees of the truth.

A logistic function of the hypothesis's margin, which says how much better it explains the views than any other more
than 30 degrees away, and of how well the features tell this object's sides apart. Reliability is measured as ever:
AUROC asks whether right answers get more confidence than wrong ones, the expected calibration error whether confidences
are frequencies.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from zsp_lite.errors import InputError

# Poses further apart are different answers: the paper's wider threshold.
MODES_APART = 30.0
# Beyond this many nats a lead says nothing more; also the lead of a hypothesis without a rival.
_MARGIN_CAP = 8.0


@dataclass(frozen=True)
class Calibration:
    """chance = sigmoid(bias + margin * margin_slope + spread * spread_slope).

    margin: of a hypothesis, see `margins`.  spread: standard deviation of the target views' likeness to the reference
    (`scene.view_likeness`): where all views look alike to the features, they tell the sides of this object badly.
    The defaults are for five target views, rounded from a fit on objects of training categories: -1.07, 0.97 and 25.6.
    Scores are in nats, so a lead of so many should have the odds of e to it, and does.
    """

    bias: float = -1.0
    margin: float = 1.0
    spread: float = 25.0

    def confidence(
        self, margin: Float[np.ndarray, " m"], spread: float | Float[np.ndarray, " m"]
    ) -> Float[np.ndarray, " m"]:
        """Confidences of hypotheses."""
        return 1 / (1 + np.exp(-(self.bias + self.margin * margin + self.spread * spread)))


# By the number of target views, from the margin alone, fitted likewise. Few views show few surfaces, and a lead among
# poses that could hardly be tested says little: with one view it is right two times of five.
CALIBRATIONS = {1: Calibration(-1.8, 0.2, 0.0), 3: Calibration(-0.7, 0.7, 0.0), 5: Calibration()}


def calibration_for(views: int) -> Calibration:
    """The calibration for so many target views; between those that were fitted, and the nearest beyond them."""
    parts = ([getattr(one, name) for one in CALIBRATIONS.values()] for name in ("bias", "margin", "spread"))
    return Calibration(*(float(np.interp(views, list(CALIBRATIONS), part)) for part in parts))


def margins(score: Float[np.ndarray, " m"], apart: Float[np.ndarray, "m m"]) -> Float[np.ndarray, " m"]:
    """Each hypothesis's lead over the best of those more than 30 degrees away, at most 8 nats either way.

    apart: degrees between their rotations.
    """
    rivals = np.where(apart > MODES_APART, score, -np.inf)
    return np.clip(score - rivals.max(axis=1), -_MARGIN_CAP, _MARGIN_CAP)


def fit_calibration(
    margin: Float[np.ndarray, " n"], spread: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"], ridge: float = 1e-3
) -> Calibration:
    """The calibration under which the outcomes `right` are likeliest (logistic regression by Newton's method).

    ridge: of the slopes, per standard deviation. Raises InputError where all outcomes are the same.
    """
    right = np.asarray(right, dtype=np.float64)
    if right.min() == right.max():
        raise InputError(f"{len(right)} outcomes are all {bool(right[0])}, expected some right and some wrong")
    features = np.stack([margin, spread], axis=1)
    mean, std = features.mean(axis=0), features.std(axis=0) + 1e-9
    x = np.column_stack([np.ones(len(right)), (features - mean) / std])
    penalty = ridge * len(right) * np.diag([0.0, 1.0, 1.0])
    w = np.zeros(3)
    for _ in range(50):
        chance = 1 / (1 + np.exp(-x @ w))
        gradient = x.T @ (right - chance) - penalty @ w
        w += np.linalg.solve((x * (chance * (1 - chance))[:, None]).T @ x + penalty, gradient)
    slopes = w[1:] / std
    return Calibration(float(w[0] - slopes @ mean), *map(float, slopes))


@dataclass(frozen=True, eq=False)
class Reliability:
    """How far confidences can be trusted: AUROC, expected calibration error, and a row per bin.

    Bins hold equally many estimates, least confident first. count: of each.  confidence: its mean in each.
    accuracy: share that was right.  surest_half: accuracy (share) among the more confident half.
    """

    auroc: float
    calibration_error: float
    surest_half: float
    count: np.ndarray
    confidence: Float[np.ndarray, " bins"]
    accuracy: Float[np.ndarray, " bins"]

    def __str__(self) -> str:
        lines = [f"{'n':>5} {'confidence':>11} {'right':>7}"]
        lines += [
            f"{n:5d} {100 * c:10.1f}% {100 * a:6.1f}%" for n, c, a in zip(self.count, self.confidence, self.accuracy)
        ]
        lines.append(
            f"AUROC {self.auroc:.3f}, expected calibration error {100 * self.calibration_error:.1f} points, "
            f"surest half {100 * self.surest_half:.1f} % right"
        )
        return "\n".join(lines)


def reliability(confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"], bins: int = 10) -> Reliability:
    """The reliability of some confidences, given which of the estimates were right.

    Raises InputError for unequal lengths and for fewer estimates than bins.
    """
    confidence, right = np.asarray(confidence, dtype=np.float64), np.asarray(right, dtype=bool)
    if confidence.shape != right.shape or confidence.ndim != 1 or len(right) < bins:
        raise InputError(
            f"{len(right)} outcomes and {len(confidence)} confidences, expected equally many, at least {bins}"
        )
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, bins)
    mean = np.array([confidence[part].mean() for part in parts])
    share = np.array([right[part].mean() for part in parts])
    count = np.array([len(part) for part in parts])
    upper = order[len(order) // 2 :]
    error = float((count * np.abs(mean - share)).sum() / count.sum())
    return Reliability(auroc(confidence, right), error, float(right[upper].mean()), count, mean, share)


def auroc(confidence: Float[np.ndarray, " n"], right: Bool[np.ndarray, " n"]) -> float:
    """Chance that a right estimate is more confident than a wrong one, ties counting half; nan where one kind lacks."""
    sure, unsure = np.asarray(confidence)[right], np.asarray(confidence)[~np.asarray(right)]
    if not len(sure) or not len(unsure):
        return float("nan")
    lead = sure[:, None] - unsure
    return float(((lead > 0) + 0.5 * (lead == 0)).mean())
