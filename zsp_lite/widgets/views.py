"""Widget on the best view: the target views around their object, their scores, and the matches of the best."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float, Real
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from zsp_lite.best_view import VIEW_SELECTORS, ViewMatch
from zsp_lite.data.cameras import Camera, ground_axes
from zsp_lite.views import View
from zsp_lite.viz.plots import BLUE, CHOSEN, patch_centres
from zsp_lite.widgets.common import Widget, choice, interactive_figure, slider, small_text

_GAP = 16  # pixels between the two images of a `MatchCanvas`


class MatchCanvas:
    """Two images (H, W, 3) side by side in one axes; `draw` replaces the lines between them."""

    def __init__(self, axis: Axes, first: np.ndarray, second: np.ndarray, titles: tuple[str, str]):
        """Draw the images; both have one size."""
        height, width = first.shape[:2]
        self.offset = width + _GAP
        self.images = []
        for image, title, left in zip((first, second), titles, (0, self.offset)):
            extent = (left, left + width, height, 0)
            self.images.append(axis.imshow(image, extent=extent, interpolation="nearest"))
            axis.text(left + width / 2, -5, title, ha="center", va="bottom", fontsize=9)
        axis.set(xlim=(0, self.offset + width), ylim=(height, -22))
        axis.set_axis_off()
        dashed = LineCollection([], colors="0.45", linewidths=0.7, linestyles="dashed", alpha=0.8)
        self.outliers = axis.add_collection(dashed)
        self.inliers = axis.add_collection(LineCollection([], cmap="cividis", linewidths=1.5))
        self.inliers.set_clim(0, 1.1 * height)  # without the brightest end of the colour map, invisible on light images

    def draw(
        self,
        first: Real[np.ndarray, "n 2"],
        second: Real[np.ndarray, "n 2"],
        inliers: Bool[np.ndarray, " n"] | None = None,
    ) -> None:
        """Draw lines between matched pixels; the lines of outliers are thin, dashed and grey."""
        segments = np.stack([first, np.asarray(second) + (self.offset, 0)], axis=1)
        inliers = np.ones(len(segments), bool) if inliers is None else inliers
        self.inliers.set_segments(segments[inliers])
        self.inliers.set_array(segments[inliers, 0, 1])
        self.outliers.set_segments(segments[~inliers])


def viewpoints_from_above(
    cameras: Sequence[Camera], others: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 2"]]:
    """Return unit vectors from the mean camera centre towards the cameras and other camera centres, from above."""
    centres = np.stack([camera.centre for camera in cameras])
    flat = [(points - centres.mean(axis=0)) @ ground_axes(cameras).T for points in (centres, others)]
    return tuple(points / np.linalg.norm(points, axis=1, keepdims=True) for points in flat)


def evenly_spaced(n: int, count: int, first: int) -> np.ndarray:
    """Return `count` of n indices on a ring, evenly spaced from `first` on, like the target frames of a pair."""
    return (first + np.arange(count) * n // count) % n


def best_view(
    reference: View,
    targets: Sequence[View],
    pairs: Sequence[ViewMatch],
    positions: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "1 2"]],
    angles: Float[np.ndarray, " n"],
) -> Widget:
    """Show the best of N target views, in the order of the camera's path, by each view selector, and its matches.

    `positions` are those of the targets and of the reference, from `viewpoints_from_above`, and `angles` the rotation
    in degrees between each target view and the reference.
    """
    n = len(targets)
    scores = {name: np.array([score(pair) for pair in pairs]) for name, score in VIEW_SELECTORS.items()}
    pixels = [_match_pixels(reference, target, pair) for target, pair in zip(targets, pairs)]
    figure, (above, graph, images) = plt.subplots(
        1, 3, figsize=(9, 3.1), width_ratios=(1, 1.15, 1.75), layout="constrained"
    )
    above.set(xlim=(-1.45, 1.45), ylim=(-1.45, 1.45), aspect="equal", title="from above")
    above.set_axis_off()
    above.plot(*positions[1].T, "*", color=BLUE, markersize=13)
    for number, position in enumerate(positions[0], 1):
        above.text(*(1.27 * position), str(number), ha="center", va="center", fontsize=8)
    shown = above.scatter(*positions[0].T, s=90, c=np.zeros(n), cmap="cividis", edgecolors="0.3", zorder=3)
    ring = above.scatter([], [], s=230, facecolors="none", edgecolors=CHOSEN, linewidths=2.5, zorder=4)
    above.text(0, 0, "object", ha="center", va="center", fontsize=8, color="0.4")
    above.text(0, -1.42, "star: reference; bright: high score", ha="center", fontsize=7)
    dots = graph.scatter(angles, np.zeros(n), s=40, c=np.zeros(n), cmap="cividis", edgecolors="0.3", zorder=3)
    circle = graph.scatter([], [], s=150, facecolors="none", edgecolors=CHOSEN, linewidths=2.5)
    graph.set(xlim=(-8, 188), xticks=(0, 90, 180), title="score against angle")
    graph.set_xlabel("angle to the reference (degrees)")
    small_text(above)
    small_text(graph)
    rgb = [view.frame.rgb for view in targets]
    canvas = MatchCanvas(images, reference.frame.rgb, rgb[0], ("reference", "best view"))

    def update(score: str, views: int, first: int) -> str:
        available = evenly_spaced(n, views, first - 1)
        values = scores[score]
        best = int(available[values[available].argmax()])
        low, high = values.min(), max(values.max(), values.min() + 1e-9)
        offered = np.isin(np.arange(n), available)
        shown.set_sizes(np.where(offered, 90, 12))
        dots.set_sizes(np.where(offered, 40, 4))
        for artist in (shown, dots):
            artist.set_array(values)
            artist.set_clim(low, high)
        dots.set_offsets(np.column_stack([angles, values]))
        margin = 0.08 * (high - low)
        graph.set_ylim(low - margin, high + margin)
        ring.set_offsets(positions[0][[best]])
        circle.set_offsets([[angles[best], values[best]]])
        canvas.images[1].set_data(rgb[best])
        canvas.draw(*pixels[best])
        nearest = int(available[angles[available].argmin()])
        return (
            f'Of {views} view{"s" * (views > 1)}, "{score}" selects view {best + 1}, {angles[best]:.0f}° from the '
            f"reference; the nearest is view {nearest + 1} at {angles[nearest]:.0f}°."
        )

    controls = {
        "score": choice("score", list(VIEW_SELECTORS)),
        "views": slider("target views N", 1, n, n),
        "first": slider("first view", 1, n, 1),
    }
    alt = (
        "Target views on a circle around the object, their scores against their angle to the reference, "
        "and the matches between the reference and the best view"
    )
    return interactive_figure(figure, controls, update, alt)


def _match_pixels(reference: View, target: View, pair: ViewMatch) -> tuple[np.ndarray, np.ndarray]:
    matches = pair.matches
    return tuple(
        patch_centres(cells, view.features.grid, view.frame.rgb.shape[:2])
        for cells, view in ((matches.reference, reference), (matches.target, target))
    )
