"""The reliability of confidences: calibration and ranking."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.stats import binomtest, mannwhitneyu


@dataclass(frozen=True, eq=False)
class Reliability:
    """How well confidences are calibrated and how well they rank estimates. `print` shows it as a table.

    Bins hold equal numbers of estimates, in order of confidence.
    """

    auroc: float  # area under the ROC curve (see `auroc`)
    calibration_error: float  # expected calibration error, in [0, 1]
    top_half_accuracy: float  # fraction of correct estimates among the more confident half
    count: np.ndarray  # (bins,) number of estimates
    confidence: Float[np.ndarray, " bins"]  # (bins,) mean confidence
    accuracy: Float[np.ndarray, " bins"]  # (bins,) fraction of correct estimates
    interval: Float[np.ndarray, "2 bins"]  # lower and upper ends of its 95 % interval (Wilson)

    def __str__(self) -> str:
        shares = {"n": self.count, "confidence (%)": 100 * self.confidence, "correct (%)": 100 * self.accuracy}
        return (
            f"{pd.DataFrame(shares).round(1).to_string(index=False)}\n"
            f"AUROC {self.auroc:.3f}, expected calibration error {100 * self.calibration_error:.1f} points, "
            f"accuracy of the more confident half {100 * self.top_half_accuracy:.1f} %"
        )


def reliability(confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], bins: int = 10) -> Reliability:
    """Measure the reliability of confidences.

    Args:
        confidence: Confidences of n estimates, in [0, 1].
        correct: Which of the estimates were correct.
        bins: Number of bins of equal count.
    """
    confidence, correct = np.asarray(confidence, dtype=np.float64), np.asarray(correct, dtype=bool)
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, bins)
    mean = np.array([confidence[part].mean() for part in parts])
    accuracy = np.array([correct[part].mean() for part in parts])
    count = np.array([len(part) for part in parts])
    upper_half = order[len(order) // 2 :]
    ends = [binomtest(int(correct[part].sum()), len(part)).proportion_ci(method="wilson") for part in parts]
    interval = np.array([[end.low for end in ends], [end.high for end in ends]])
    error = float((count * np.abs(mean - accuracy)).sum() / count.sum())
    upper = float(correct[upper_half].mean())
    return Reliability(auroc(confidence, correct), error, upper, count, mean, accuracy, interval)


def auroc(confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"]) -> float:
    """Estimate the probability that a correct estimate has a higher confidence than a wrong one, ties counting half."""
    correct = np.asarray(correct, dtype=bool)
    positive, negative = np.asarray(confidence)[correct], np.asarray(confidence)[~correct]
    if not len(positive) or not len(negative):
        return float("nan")
    return float(mannwhitneyu(positive, negative).statistic / (len(positive) * len(negative)))
