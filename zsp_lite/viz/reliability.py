"""The reliability of confidences: calibration, ranking, and their diagrams."""

from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import binomtest

from zsp_lite.viz.plots import BLUE


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
    """
    confidence, correct = np.asarray(confidence, dtype=np.float64), np.asarray(correct, dtype=bool)
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, bins)
    mean = np.array([confidence[part].mean() for part in parts])
    accuracy = np.array([correct[part].mean() for part in parts])
    count = np.array([len(part) for part in parts])
    upper_half = order[len(order) // 2 :]
    error = float((count * np.abs(mean - accuracy)).sum() / count.sum())
    return Reliability(auroc(confidence, correct), error, float(correct[upper_half].mean()), count, mean, accuracy)


def auroc(confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"]) -> float:
    """Estimate the probability that a correct estimate has a higher confidence than a wrong one, ties counting half."""
    correct = np.asarray(correct, dtype=bool)
    positive, negative = np.asarray(confidence)[correct], np.asarray(confidence)[~correct]
    if not len(positive) or not len(negative):
        return float("nan")
    difference = positive[:, None] - negative
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())


def draw_reliability(axis: Axes, measured: Reliability) -> None:
    """Draw a reliability diagram: accuracy against mean confidence of each bin, with 95 % Wilson intervals.

    Counts stand beside the points, or in the title if they are equal.
    On the dashed diagonal confidences are calibrated; below it they are too high.
    """
    accuracy, count = measured.accuracy, measured.count
    right = np.rint(accuracy * count).astype(int)
    ends = [binomtest(k, n).proportion_ci(method="wilson") for k, n in zip(right.tolist(), count.tolist())]
    bars = np.maximum([accuracy - [end.low for end in ends], [end.high for end in ends] - accuracy], 0)
    axis.plot([0, 1], [0, 1], color="0.4", linestyle="--", label="calibrated")
    axis.errorbar(
        measured.confidence, accuracy, bars, fmt="o", color=BLUE, ecolor="0.5", capsize=3, markeredgecolor="black",
        label="measured",
    )  # fmt: skip
    if len(set(count.tolist())) == 1:
        axis.set_title(f"{count[0]} answers for each point", fontsize=10)
    else:
        for x, y, n in zip(measured.confidence, accuracy, count):
            axis.annotate(str(n), (x, y), (5, -10), textcoords="offset points", fontsize=8, color="0.3")
    axis.set(xlabel="mean confidence", ylabel="fraction within 30 degrees", xlim=(0, 1.03), ylim=(0, 1.03))
    axis.set_aspect("equal")
    axis.legend(loc="upper left", fontsize=9)


def show_calibration(confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"]) -> Figure:
    """Show a reliability diagram, and the accuracy among the most confident answers against their share."""
    measured = reliability(confidence, correct, bins=max(2, min(10, len(correct) // 20)))
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.4, 4.2), layout="constrained")
    draw_reliability(left, measured)
    order = np.argsort(-confidence, kind="stable")
    number = np.arange(1, len(order) + 1)
    right.plot(100 * number / len(order), 100 * np.cumsum(correct[order]) / number, color=BLUE, label="surest first")
    right.axhline(100 * correct.mean(), color="0.4", linestyle="--", label="all answers")
    right.set(xlabel="share of pairs that are answered (per cent)", ylabel="of these within 30 degrees (per cent)")
    right.set(xlim=(0, 100), ylim=(0, 103))
    right.legend(loc="lower left")
    return figure
