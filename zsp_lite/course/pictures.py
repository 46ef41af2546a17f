"""Pictures of the lesson on metrics."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zsp_lite.viz.plots import BLUE, GREEN, VERMILLION


def show_winners(gains: Mapping[str, np.ndarray], true_gain: float) -> Figure:
    """Show the measured gains of simulated benchmarks as a row of dots for each name; those in
    which the better method does not win are red crosses."""
    figure, axis = plt.subplots(figsize=(7.4, 0.9 + 0.75 * len(gains)), layout="constrained")
    for row, values in enumerate(gains.values()):
        height = row + np.linspace(-0.28, 0.28, len(values))
        wins = np.asarray(values) > 0
        better, worse = ("", "") if row else ("better method wins", "it does not")
        axis.plot(values[wins], height[wins], "o", color=BLUE, label=better)
        style = {"color": VERMILLION, "markeredgewidth": 2.2, "label": worse}
        axis.plot(values[~wins], height[~wins], "x", **style)
    axis.axvline(0, color="0.3", linewidth=1)
    axis.axvline(true_gain, color=GREEN, linestyle="--", label="true gain")
    axis.set_yticks(range(len(gains)), gains)
    axis.set(xlabel="measured gain (points of Acc30)", ylim=(len(gains) - 0.5, -0.5))
    figure.legend(ncols=3, loc="outside upper center", fontsize=9)
    return figure
