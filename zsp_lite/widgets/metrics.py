"""Widgets on metrics: the uncertainty of a measured accuracy, and rotation errors of symmetric objects."""

from collections.abc import Mapping

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Real
from scipy.spatial.transform import Rotation
from scipy.stats import binom
from sklearn.neighbors import NearestNeighbors

from zsp_lite.viz.plots import BLUE, ORANGE, show_curves
from zsp_lite.widgets.common import Widget, choice, interactive_figure, slider, small_text


def order_probabilities(n: int, first: float, second: float) -> tuple[float, float]:
    """Return how likely the second of two true accuracies in [0, 1] measures above, and below, each on n pairs."""
    k = np.arange(n + 1)
    probability = binom.pmf(k, n, second)
    return float(probability @ binom.cdf(k - 1, n, first)), float(probability @ binom.sf(k, n, first))


def measured_accuracy() -> Widget:
    """Show the distributions of the measured Acc30 of two methods, and how often a benchmark ranks them correctly."""
    labels = {"xlabel": "measured Acc30 (%)", "ylabel": "probability density (1/%)"}
    figure = show_curves([0, 100], {"first method": [0, 0], "second method": [0, 0]}, xlim=(0, 100), **labels)
    (axis,) = figure.axes

    def update(pairs: int, accuracy: int, gain: int) -> str:
        true = accuracy / 100, min(accuracy + gain, 100) / 100
        k = np.arange(pairs + 1)
        densities = [binom.pmf(k, pairs, p) * pairs / 100 for p in true]
        for line, density in zip(axis.lines, densities, strict=True):
            line.set(data=(100 * k / pairs, density), marker="")
        axis.set_ylim(0, 1.08 * np.max(densities))
        half = 196 * np.sqrt(true[0] * (1 - true[0]) / pairs)
        above, below = order_probabilities(pairs, *true)
        return (
            f"On {pairs} pairs the 95 % interval of the first method is about ± {half:.1f} points. The second measures "
            f"above it in {100 * above:.0f} % of all benchmarks, below it in {100 * below:.0f} %."
        )

    controls = {
        "pairs": slider("pairs", 20, 2000, 100, 20),
        "accuracy": slider("Acc30 of the first (%)", 5, 90, 46),
        "gain": slider("gain of the second (points)", 0, 10, 4),
    }
    alt = "The distributions of the measured accuracies of two methods"
    return interactive_figure(figure, controls, update, alt)


def rotated_distance(
    cloud: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "m 3"], degrees: Real[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Return the mean closest-point distance of a cloud, rotated about z, to another cloud.

    With the same cloud twice, it is the error for symmetric objects (ADD-S) of Hinterstoisser et al.
    """
    search = NearestNeighbors(n_neighbors=1).fit(other)
    return np.array([search.kneighbors(_rotate_z(cloud, angle))[0].mean() for angle in degrees.tolist()])


def symmetry_rotation(clouds: Mapping[str, Float[np.ndarray, "n 3"]]) -> Widget:
    """Show a centred cloud rotated about z over itself, with its rotation error and its closest-point distance."""
    angles = np.arange(0, 181, 5)
    curves = {name: rotated_distance(cloud, cloud, angles) for name, cloud in clouds.items()}
    figure, (above, graph) = plt.subplots(1, 2, figsize=(8, 3.3), width_ratios=(1, 1.3), layout="constrained")
    fixed = above.scatter([], [], s=5, color=ORANGE, marker="D", linewidths=0, label="true pose")
    rotated = above.scatter([], [], s=5, color=BLUE, linewidths=0, label="rotated")
    reach = 1.05 * max(np.linalg.norm(np.asarray(cloud)[:, :2], axis=1).max() for cloud in clouds.values())
    above.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", title="from above (scene units)")
    above.legend(loc="upper right", markerscale=2)
    (line,) = graph.plot(angles, angles, color="0.3")
    (dot,) = graph.plot([], [], "o", color=BLUE, markersize=9, clip_on=False)
    graph.set(xlim=(-4, 184), ylim=(0, 1.1 * max(curve.max() for curve in curves.values())), xticks=range(0, 181, 45))
    graph.set(xlabel="rotation error (degrees)", ylabel="closest-point distance (scene units)")
    small_text(above)
    small_text(graph)

    def update(cloud: str, angle: int) -> str:
        points = np.asarray(clouds[cloud])
        fixed.set_offsets(points[:, :2])
        rotated.set_offsets(_rotate_z(points, angle)[:, :2])
        line.set_ydata(curves[cloud])
        distance = float(np.interp(angle, angles, curves[cloud]))
        dot.set_data([angle], [distance])
        return (
            f"{cloud}: rotation error {angle}°, closest-point distance {distance:.2f}, "
            f"{100 * distance / curves[cloud].max():.0f} % of its maximum over all angles."
        )

    controls = {"cloud": choice("object", list(clouds)), "angle": slider("rotated by (degrees)", 0, 180, 180, 5)}
    alt = "A point cloud and its rotated copy from above, and the closest-point distance over the angle"
    return interactive_figure(figure, controls, update, alt)


def accuracy_threshold(errors: Mapping[str, Real[np.ndarray, " n"]]) -> Widget:
    """Show the share of pairs within a rotation error (degrees), a bar per method. The control is the threshold."""
    figure, axis = plt.subplots(figsize=(6.5, 3), layout="constrained")
    bars = axis.barh(list(errors), np.zeros(len(errors)), color=BLUE)
    axis.invert_yaxis()
    axis.set(xlim=(0, 100), xlabel="pairs within the threshold (%)")

    def update(threshold: int) -> str:
        shares = {name: 100 * float(np.mean(np.asarray(one) < threshold)) for name, one in errors.items()}
        for bar, share in zip(bars, shares.values(), strict=True):
            bar.set_width(share)
        ranked = sorted(shares, key=lambda name: -shares[name])
        return f"Within {threshold}°: " + ", ".join(f"{name} {shares[name]:.0f} %" for name in ranked)

    alt = "One bar per method: the share of pairs within the threshold"
    return interactive_figure(figure, {"threshold": slider("threshold (°)", 5, 180, 30, 5)}, update, alt)


def _rotate_z(points: np.ndarray, degrees: float) -> np.ndarray:
    return Rotation.from_euler("z", degrees, degrees=True).apply(points)
