"""The reliability of confidences: calibration and ranking."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.stats import binomtest, mannwhitneyu


@dataclass(frozen=True, eq=False)
class Reliability:
    """How well confidences are calibrated and how well they rank estimates.

    `print` shows it as a table.
    """

    # probability that a correct estimate has a higher confidence than a wrong one, ties counting
    # half
    auroc: float
    calibration_error: float  # expected calibration error, in [0, 1]
    top_half_accuracy: float  # fraction of correct estimates among the more confident half
    count: np.ndarray  # number of estimates in each bin
    confidence: Float[np.ndarray, " bins"]  # mean
    accuracy: Float[np.ndarray, " bins"]  # fraction of correct estimates
    interval: Float[np.ndarray, "2 bins"]  # lower and upper ends of its 95 % interval (Wilson)

    def __str__(self) -> str:
        shares = {
            "n": self.count,
            "confidence (%)": 100 * self.confidence,
            "correct (%)": 100 * self.accuracy,
        }
        return (
            f"{pd.DataFrame(shares).round(1).to_string(index=False)}\n"
            f"AUROC {self.auroc:.3f}, expected calibration error "
            f"{100 * self.calibration_error:.1f} points, "
            f"accuracy of the more confident half {100 * self.top_half_accuracy:.1f} %"
        )


def reliability(
    confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], bins: int = 10
) -> Reliability:
    """Measure the reliability of confidences, in [0, 1], in bins of equal count in order of
    confidence."""
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, bins)
    mean = np.array([confidence[part].mean() for part in parts])
    accuracy = np.array([correct[part].mean() for part in parts])
    count = np.array([len(part) for part in parts])
    tests = [binomtest(int(correct[part].sum()), len(part)) for part in parts]
    interval = np.transpose([test.proportion_ci(method="wilson") for test in tests])
    error = float((count * np.abs(mean - accuracy)).sum() / count.sum())
    upper = float(correct[order[len(order) // 2 :]].mean())
    right = confidence[correct]
    wrong = confidence[~correct]
    pairs = len(right) * len(wrong)  # for which Mann and Whitney's U counts the right order
    auroc = float(mannwhitneyu(right, wrong).statistic / pairs) if pairs else float("nan")
    return Reliability(auroc, error, upper, count, mean, accuracy, interval)
