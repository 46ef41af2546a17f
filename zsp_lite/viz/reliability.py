"""The reliability of confidences: whether they are the shares of correct estimates."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Reliability(NamedTuple):
    """How well confidences are calibrated."""

    calibration_error: float  # expected calibration error, in [0, 1]
    confidence: Float[np.ndarray, " bins"]  # mean of each bin
    accuracy: Float[np.ndarray, " bins"]  # fraction of correct estimates of each bin


def reliability(
    confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], bins: int = 10
) -> Reliability:
    """Measure how reliable confidences are.

    Args:
        confidence: Confidences of estimates, in [0, 1].
        correct: Whether each estimate is correct.
        bins: Number of bins, which have equal numbers of estimates, in order of confidence.

    Returns:
        The mean confidence and the accuracy of each bin, and the calibration error: the mean of
        their absolute differences, weighted by the sizes of the bins.
    """
    parts = np.array_split(np.argsort(confidence, kind="stable"), bins)
    means = np.array([confidence[part].mean() for part in parts])
    accuracy = np.array([correct[part].mean() for part in parts])
    error = np.average(np.abs(means - accuracy), weights=list(map(len, parts)))
    return Reliability(float(error), means, accuracy)
