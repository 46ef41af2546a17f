"""The reliability of confidences: calibration and ranking."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.stats import mannwhitneyu


@dataclass(frozen=True, eq=False)
class Reliability:
    """How well confidences are calibrated and how well they rank estimates.

    `print` shows it as a table.
    """

    # Probability that a correct estimate has a higher confidence than a wrong one; a tie counts
    # half.
    auroc: float
    calibration_error: float  # expected calibration error, in [0, 1]
    top_half_accuracy: float  # fraction of correct estimates among the more confident half
    count: np.ndarray  # number of estimates in each bin
    confidence: Float[np.ndarray, " bins"]  # mean
    accuracy: Float[np.ndarray, " bins"]  # fraction of correct estimates

    def __str__(self) -> str:
        columns = {
            "n": self.count,
            "confidence (%)": 100 * self.confidence,
            "correct (%)": 100 * self.accuracy,
        }
        return (
            f"{pd.DataFrame(columns).round(1).to_string(index=False)}\n"
            f"AUROC {self.auroc:.3f}, expected calibration error "
            f"{100 * self.calibration_error:.1f} points, "
            f"accuracy of the more confident half {100 * self.top_half_accuracy:.1f} %"
        )


def reliability(
    confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], bins: int = 10
) -> Reliability:
    """Measure how reliable confidences are.

    Args:
        confidence: Confidences of estimates, in [0, 1].
        correct: Whether each estimate is correct.
        bins: Number of bins, which have equal numbers of estimates, in order of confidence.

    Returns:
        Calibration and ranking; NaN for the AUROC if all estimates are correct or none is.
    """
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, bins)
    mean_confidence = np.array([confidence[part].mean() for part in parts])
    accuracy = np.array([correct[part].mean() for part in parts])
    count = np.array([len(part) for part in parts])
    calibration_error = float((count * np.abs(mean_confidence - accuracy)).sum() / count.sum())
    top_half_accuracy = float(correct[order[len(order) // 2 :]].mean())
    right = confidence[correct]
    wrong = confidence[~correct]
    # Mann and Whitney's U is the number of pairs (right, wrong) in the right order.
    pairs = len(right) * len(wrong)
    auroc = float(mannwhitneyu(right, wrong).statistic / pairs) if pairs else float("nan")
    return Reliability(
        auroc, calibration_error, top_half_accuracy, count, mean_confidence, accuracy
    )
