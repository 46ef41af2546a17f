"""Umeyama and RANSAC, to be played with: one outlier moved away, and trials and threshold with the inliers redrawn."""

from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Real
from matplotlib.collections import LineCollection

from zsp_lite.alignment import SCALE_RANGE, ransac, umeyama
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.viz.plots import BLUE, ORANGE, VERMILLION
from zsp_lite.widgets.common import example_pair, explorer, load_ipywidgets, slider
from zsp_lite.widgets.views import match_canvas

if TYPE_CHECKING:
    from ipywidgets import VBox

_TRIALS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def ransac_settings(
    images: tuple[np.ndarray, np.ndarray],
    pixels: tuple[Real[np.ndarray, "n 2"], Real[np.ndarray, "n 2"]],
    points: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]],
    truth: Float[np.ndarray, "3 3"] | None = None,
) -> "VBox":
    """Widget: RANSAC on the matches of two images, with its trials, its threshold and its draw on sliders.

    images: of one size.  pixels, points: of each match in both, (x, y) and camera-frame 3D in scene units.
    truth: the true rotation, if known.  Raises InputError where lengths differ, or for fewer than four matches.
    """
    source, target = (np.asarray(part, np.float64) for part in points)
    if not (len(source) == len(target) == len(pixels[0]) == len(pixels[1]) >= 4):
        raise InputError(
            f"{len(source)} and {len(target)} points, {len(pixels[0])} and {len(pixels[1])} pixels, "
            "expected as many of each and at least four"
        )
    n = len(source)
    figure, (matches, graph) = plt.subplots(1, 2, figsize=(9, 3.3), width_ratios=(1.5, 1), layout="constrained")
    canvas = match_canvas(matches, *images, ("reference", "target"))
    inside = graph.scatter([], [], s=26, color=BLUE, marker="o", label="inlier")
    outside = graph.scatter([], [], s=26, color="0.45", marker="x", label="outlier")
    line = graph.axhline(1, color=VERMILLION, linestyle="--", label="threshold")
    graph.set(xlim=(-1, n), ylim=(0.01, 10), yscale="log", title="distances after the fit")
    graph.set_xlabel("match, nearest first", fontsize=8)
    graph.set_ylabel("distance (scene units)", fontsize=8)
    graph.tick_params(labelsize=8)
    graph.title.set_fontsize(9)
    graph.legend(fontsize=8, loc="upper left")

    def update(trials: int, threshold: float, draw: int) -> str:
        line.set_ydata([threshold, threshold])
        try:
            sim3, inliers = ransac(source, target, threshold, trials, seed=draw, scale_range=SCALE_RANGE)
        except InputError as error:
            canvas.draw(*pixels, np.zeros(n, bool))
            for dots in (inside, outside):
                dots.set_offsets(np.empty((0, 2)))
            return f"No fit: {error}."
        distance = np.linalg.norm(sim3.apply(source) - target, axis=1).clip(0.01, 10)
        order = np.argsort(distance)
        places = np.column_stack([np.arange(n), distance[order]])
        inside.set_offsets(places[inliers[order]])
        outside.set_offsets(places[~inliers[order]])
        canvas.draw(*pixels, inliers)
        text = f"{inliers.sum()} of {n} matches are inliers; scale {sim3.scale:.2f}"
        return text + (f"; rotation {rotation_error(sim3.R, truth):.0f}° from the truth." if truth is not None else ".")

    widgets = load_ipywidgets()
    controls = {
        "trials": widgets.SelectionSlider(options=_TRIALS, value=1000, description="trials"),
        "threshold": slider("threshold", 0.02, 1.0, 0.2, 0.02),
        "draw": slider("draw", 0, 20, 0),
    }
    alt = "Two images with the matches that agree with the pose, and each match's distance against the threshold"
    return explorer(figure, controls, update, alt)


def one_outlier(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> "VBox":
    """Widget: least squares on n corresponding points of which the last is moved away from where it belongs.

    Seen from the front, x to the right and y down.  The rotation is compared with that of the fit before the move.
    Raises InputError as `umeyama` does.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    right = umeyama(source, target)
    figure, axis = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
    wanted = axis.scatter(*target[:, :2].T, s=70, facecolors="none", edgecolors=ORANGE, linewidths=1.8, label="target")
    moved = axis.scatter(*target[:, :2].T, s=22, color=BLUE, marker="x", label="source after the fit")
    bars = LineCollection([], colors="0.5", linewidths=0.8)
    axis.add_collection(bars)
    size = np.ptp(target[:, :2], axis=0).max()
    low, high = target[:, :2].min(axis=0), target[:, :2].max(axis=0)
    axis.set(xlim=(low[0] - 0.6 * size, high[0] + 2.2 * size), ylim=(high[1] + 0.4 * size, low[1] - 0.4 * size),
             xlabel="x (scene units)", ylabel="y, down (scene units)", aspect="equal")  # fmt: skip
    axis.legend(fontsize=8, loc="upper right")

    def update(distance: float) -> str:
        spoilt = target.copy()
        spoilt[-1, 0] += distance
        fit = umeyama(source, spoilt)
        places = fit.apply(source)[:, :2]
        wanted.set_offsets(spoilt[:, :2])
        moved.set_offsets(places)
        bars.set_segments(np.stack([places, spoilt[:, :2]], axis=1))
        return (
            f"The last of {len(source)} points is {distance:.1f} off: the rotation turns by "
            f"{rotation_error(fit.R, right.R):.1f}°, the scale goes from {right.scale:.2f} to {fit.scale:.2f}."
        )

    alt = "Points and their fitted partners from the front; lines join each to where the least-squares fit puts it"
    return explorer(figure, {"distance": slider("moved by", 0.0, 6.0, 0.0, 0.1)}, update, alt)


def example_ransac_settings() -> "VBox":
    """`ransac_settings` on a pair of sample views."""
    from zsp_lite.matching import match
    from zsp_lite.pipeline import match_points
    from zsp_lite.viz.plots import patch_centres

    views = example_pair()
    matches = match(views[0].features, views[1].features)
    images = tuple(view.frame.rgb for view in views)
    cells = (matches.reference, matches.target)
    pixels = [patch_centres(c, v.features.grid, v.frame.rgb.shape[:2]) for c, v in zip(cells, views)]
    return ransac_settings(images, tuple(pixels), match_points(*views, matches))


def example_one_outlier() -> "VBox":
    """`one_outlier` on points drawn at random."""
    points = np.random.default_rng(0).normal(size=(12, 3))
    return one_outlier(points, points)
