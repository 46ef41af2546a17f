"""Widgets on alignment: one match that is dragged away from its place, and the settings of
RANSAC."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Real
from matplotlib.artist import Artist
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from zsp_lite.alignment import SCALE_RANGE, ransac, umeyama
from zsp_lite.course.widgets.common import (
    Widget,
    interactive_figure,
    load_package,
    redrawing,
    show,
    slider,
)
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.viz.plots import BLUE, VERMILLION, draw_image, draw_matches

# Twelve points of a chair in scene units, y down: ends of the legs, corners of the seat, ends of
# two rails of the back.
CHAIR = np.array(
    [[x, y, z] for y in (1.2, 0.0) for x in (-0.7, 0.7) for z in (-0.7, 0.7)]
    + [[-0.7, y, z] for y in (-0.8, -1.6) for z in (-0.7, 0.7)]
)
# Pairs of its points that are joined: legs and seat, then the back.
_BARS = [(0, 4), (1, 5), (2, 6), (3, 7), (4, 5), (6, 7), (4, 6), (5, 7)]
_BARS += [(4, 8), (5, 9), (8, 10), (9, 11), (8, 9), (10, 11)]
_SEEN_FROM = Rotation.from_euler("yx", [-25, 15], degrees=True).as_matrix()
RIGHT = _SEEN_FROM[0]  # the picture's direction to the right, in which a corner is dragged
_FARTHEST = 4.0  # largest distance of the dragged point from its place, scene units
_THRESHOLD = 0.2  # largest residual of a match that agrees, scene units: the default of RANSAC
_DRAGGED = "A grey chair, one corner dragged away; least squares tilts its fit, RANSAC does not"
_TRIALS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def ransac_settings(
    images: tuple[np.ndarray, np.ndarray],
    pixels: tuple[Real[np.ndarray, "n 2"], Real[np.ndarray, "n 2"]],
    points: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]],
    truth: Float[np.ndarray, "3 3"] | None = None,
) -> Widget:
    """Show the inliers of RANSAC on matches: their pixels (x, y) in the images of the reference and
    of the target, and their points in the frames of both cameras, scene units.

    `truth` is the true rotation, for the error of the fit.
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
    inside = graph.scatter([], [], s=26, color=BLUE, label="inlier")
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
        # Residuals beyond the range of the axis are drawn at its end.
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

    controls = {
        "trials": load_package().SelectionSlider(options=_TRIALS, value=1000, description="trials"),
        "threshold": slider("threshold", 0.02, 1.0, 0.2, step=0.02),
        "seed": slider("seed", 0, 20, 0),
    }
    alt = "Two images with the inliers between them, and the residual of each match"
    return interactive_figure(figure, controls, update, alt)


def drag_match() -> Widget:
    """Show `draw_dragged` with a slider for the distance."""
    figure, axes = _dragging_panels(1)
    draw = redrawing(draw_dragged)

    def update(distance: float) -> str:
        draw(axes[0], distance)
        titles = [axis.get_title().replace("\n", " ") for axis in axes[0]]
        return f"{'; '.join(titles)}."

    controls = {"distance": slider("one match is wrong by", 0.0, _FARTHEST, 0.0, step=0.1)}
    return interactive_figure(figure, controls, update, _DRAGGED)


def show_dragged(distances: Sequence[float]) -> None:
    """Show the picture of `drag_match` at some distances, one below the other."""
    figure, axes = _dragging_panels(len(distances))
    for row, distance in zip(axes, distances):
        draw_dragged(row, distance)
    show(figure, _DRAGGED)


def draw_dragged(axes: np.ndarray, distance: float) -> list[Artist]:
    """Draw two fits of a chair to its copy, one corner of which is moved to the right by a
    distance: least squares and RANSAC.

    The copy is grey; a line joins each fitted point to its partner, dashed where the two are more
    than the threshold apart.
    """
    target = CHAIR.copy()
    target[-1] += distance * RIGHT
    fits = {"least squares": umeyama(CHAIR, target), "RANSAC": ransac(CHAIR, target)[0]}
    drawn: list[Artist] = []
    for axis, (name, fit) in zip(axes, fits.items()):
        fitted = fit.apply(CHAIR)
        agree = np.linalg.norm(fitted - target, axis=1) < _THRESHOLD
        turn = rotation_error(fit.R, np.eye(3))
        axis.set_title(
            f"Wrong by {distance:g}, {name}: {turn:.0f}° off,\n"
            f"{agree.sum()} of {len(CHAIR)} matches agree"
        )
        flat = [(points @ _SEEN_FROM.T)[:, :2] for points in (target, fitted)]
        for points, colour, width in zip(flat, ("0.7", BLUE), (5, 2)):
            bars = [points[list(bar)] for bar in _BARS]
            drawn.append(axis.add_collection(LineCollection(bars, colors=colour, linewidths=width)))
        pulls = np.stack(flat, axis=1)[~agree]
        style = {"colors": VERMILLION, "linewidths": 1.5, "linestyles": "--"}
        drawn.append(axis.add_collection(LineCollection(pulls, **style)))
        drawn += axis.plot(*flat[0][-1], "o", color=VERMILLION, markersize=9)
    return drawn


def _dragging_panels(rows: int) -> tuple[Figure, np.ndarray]:
    """Return a figure with two axes in each row, which have room for the farthest corner."""
    figure, axes = plt.subplots(
        rows, 2, figsize=(8, 3.2 * rows), layout="constrained", squeeze=False
    )
    for axis in axes.flat:
        axis.set(xlim=(-1.5, 4.6), ylim=(2, -2.1), aspect="equal")
        axis.set_axis_off()
    return figure, axes
