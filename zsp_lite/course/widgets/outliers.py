"""Widgets on alignment: the settings of RANSAC, and the effect of one outlier on least squares."""

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Real
from matplotlib.collections import LineCollection

from zsp_lite.alignment import SCALE_RANGE, ransac, umeyama
from zsp_lite.course.widgets.common import (
    Widget,
    interactive_figure,
    load_package,
    redrawing,
    slider,
)
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.viz.plots import BLUE, ORANGE, VERMILLION, draw_image, draw_matches, show_points

_FARTHEST = 6.0  # largest distance by which `one_outlier` moves the point, scene units
_TRIALS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def ransac_settings(
    images: tuple[np.ndarray, np.ndarray],
    pixels: tuple[Real[np.ndarray, "n 2"], Real[np.ndarray, "n 2"]],
    points: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]],
    truth: Float[np.ndarray, "3 3"] | None = None,
) -> Widget:
    """Show the inliers of RANSAC on matches.

    Args:
        images: Images of the reference and of the target.
        pixels: Pixels (x, y) of the matches in both images.
        points: Points of the matches in the frames of both cameras, scene units.
        truth: True rotation, for the error of the fit; None leaves the error out.
    """
    source, target = points
    n = len(source)
    figure, (*axes, graph) = plt.subplots(
        1, 3, figsize=(9.6, 3.6), width_ratios=(1, 1, 1.3), layout="constrained"
    )
    for axis, image, title in zip(axes, images, ("reference", "target")):
        draw_image(axis, image)
        axis.set_axis_off()
        axis.set_title(title)
    lines = redrawing(draw_matches)
    inside = graph.scatter([], [], s=26, color=BLUE, marker="o", label="inlier")
    outside = graph.scatter([], [], s=26, color="0.45", marker="x", label="outlier")
    line = graph.axhline(1, color=VERMILLION, linestyle="--", label="threshold")
    graph.set(xlim=(-1, n), ylim=(0.01, 10), yscale="log", title="residuals")
    graph.set(xlabel="match, sorted by residual", ylabel="residual (scene units)")
    graph.legend(loc="upper left")

    def update(trials: int, threshold: float, seed: int) -> str:
        line.set_ydata([threshold, threshold])
        try:
            sim3, inliers = ransac(
                source, target, threshold, trials, seed=seed, scale_range=SCALE_RANGE
            )
        except InputError as error:
            lines(axes, pixels, np.zeros(n, bool))
            for dots in (inside, outside):
                dots.set_offsets(np.empty((0, 2)))
            return f"No fit: {error}."
        distance = np.linalg.norm(sim3.apply(source) - target, axis=1).clip(0.01, 10)
        order = np.argsort(distance)
        positions = np.column_stack([np.arange(n), distance[order]])
        inside.set_offsets(positions[inliers[order]])
        outside.set_offsets(positions[~inliers[order]])
        lines(axes, pixels, inliers)
        text = f"{inliers.sum()} of {n} matches are inliers; scale {sim3.scale:.2f}"
        if truth is not None:
            text += f"; rotation error {rotation_error(sim3.R, truth):.0f}°"
        return f"{text}."

    widgets = load_package()
    controls = {
        "trials": widgets.SelectionSlider(options=_TRIALS, value=1000, description="trials"),
        "threshold": slider("threshold", 0.02, 1.0, 0.2, 0.02),
        "seed": slider("seed", 0, 20, 0),
    }
    alt = (
        "Two images with the inliers between them, and the residual of each match with the "
        "threshold"
    )
    return interactive_figure(figure, controls, update, alt)


def one_outlier(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> Widget:
    """Show the least-squares fit of corresponding points while the last target point moves
    along x."""
    exact = umeyama(source, target)
    # The panel is made with the farthest place of the point, so that it has room for all.
    farthest = np.vstack([target, target[-1] + [_FARTHEST, 0, 0]])
    sets = {"target": farthest, "source after the fit": target}
    labels = {"xlabel": "x (scene units)", "ylabel": "y, down (scene units)"}
    figure = show_points({"": sets}, size=7, colours=(ORANGE, BLUE), down=True, **labels)
    (axis,) = figure.axes
    circles, crosses = axis.collections
    bars = axis.add_collection(LineCollection([], colors="0.5", linewidths=0.8))

    def update(distance: float) -> str:
        changed = target.copy()
        changed[-1, 0] += distance
        fit = umeyama(source, changed)
        fitted = fit.apply(source)[:, :2]
        circles.set_offsets(changed[:, :2])
        crosses.set_offsets(fitted)
        bars.set_segments(np.stack([fitted, changed[:, :2]], axis=1))
        return (
            f"The last of {len(source)} points has moved by {distance:.1f}: the rotation "
            "changes by "
            f"{rotation_error(fit.R, exact.R):.1f}°, the scale from {exact.scale:.2f} to "
            f"{fit.scale:.2f}."
        )

    controls = {"distance": slider("moved by", 0.0, _FARTHEST, 0.0, 0.1)}
    alt = (
        "Target points and source points after the least-squares fit; lines connect "
        "corresponding points"
    )
    return interactive_figure(figure, controls, update, alt)
