"""Widget on the best view: the target views around their object, their scores, and the matches of the best."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float

from zsp_lite.best_view import VIEW_SELECTORS, ViewMatch
from zsp_lite.data.cameras import Camera, ground_axes
from zsp_lite.views import View
from zsp_lite.viz.plots import BLUE, CHOSEN, draw_image, draw_matches, match_pixels
from zsp_lite.widgets.common import Widget, choice, interactive_figure, redrawing, slider, small_text


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
    figure, (above, graph, *images) = plt.subplots(
        1, 4, figsize=(9, 2.9), width_ratios=(1, 1.15, 0.85, 0.85), layout="constrained"
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
    for axis, view, title in zip(images, (reference, targets[0]), ("reference", "best view")):
        draw_image(axis, view.frame.rgb)
        axis.set_axis_off()
        axis.set_title(title, fontsize=9)
    lines = redrawing(draw_matches)

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
        images[1].images[0].set_data(targets[best].frame.rgb)
        lines(images, match_pixels((reference, targets[best]), pairs[best].matches))
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
