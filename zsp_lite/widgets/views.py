"""Choosing the best view, to be played with: the target views around their object, their scores, the chosen matches."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float, Real
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.image import AxesImage

from zsp_lite.best_view import VIEW_SELECTORS, ViewPair
from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError
from zsp_lite.views import View
from zsp_lite.viz.plots import BLUE, CHOSEN, patch_centres
from zsp_lite.widgets.common import choice, explorer, slider

if TYPE_CHECKING:
    from ipywidgets import VBox

_GAP = 16  # pixels between the two images of a `MatchCanvas`


@dataclass(frozen=True, eq=False)
class MatchCanvas:
    """Two images side by side in one axes, and lines between them that are replaced, not drawn anew, by `draw`."""

    images: tuple[AxesImage, AxesImage]
    kept: LineCollection
    dropped: LineCollection
    offset: float

    def draw(
        self,
        first: Real[np.ndarray, "n 2"],
        second: Real[np.ndarray, "n 2"],
        inliers: Bool[np.ndarray, " n"] | None = None,
    ) -> None:
        """Lines between pixels (x, y) of the two images; those of outliers are thin, dashed and grey."""
        segments = np.stack([first, np.asarray(second) + (self.offset, 0)], axis=1)
        inliers = np.ones(len(segments), bool) if inliers is None else np.asarray(inliers, bool)
        self.kept.set_segments(segments[inliers])
        self.kept.set_array(segments[inliers, 0, 1])
        self.dropped.set_segments(segments[~inliers])


def match_canvas(axis: Axes, first: np.ndarray, second: np.ndarray, titles: tuple[str, str]) -> MatchCanvas:
    """Put two images (H, W, 3) of one size into `axis`, ready for lines.  Raises InputError where the sizes differ."""
    if first.shape != second.shape:
        raise InputError(f"images have shapes {first.shape} and {second.shape}, expected equal ones")
    height, width = first.shape[:2]
    offset = width + _GAP
    images = tuple(
        axis.imshow(image, extent=(left, left + width, height, 0), interpolation="nearest")
        for image, left in ((first, 0), (second, offset))
    )
    axis.set(xlim=(0, offset + width), ylim=(height, -22))
    axis.set_axis_off()
    for title, left in zip(titles, (0, offset), strict=True):
        axis.text(left + width / 2, -5, title, ha="center", va="bottom", fontsize=9)
    dropped = LineCollection([], colors="0.45", linewidths=0.7, linestyles="dashed", alpha=0.8)
    kept = LineCollection([], cmap="cividis", linewidths=1.5)
    kept.set_clim(0, 1.1 * height)  # the brightest end of cividis would vanish on light images
    axis.add_collection(dropped)
    axis.add_collection(kept)
    return MatchCanvas(images, kept, dropped, offset)


def around(
    cameras: Sequence[Camera], others: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "m 2"]]:
    """Where cameras that walk round an object stand, seen from above: unit vectors from the middle of the walk.

    others: more camera centres in the same world.  The plane is the walk's own; up is what the cameras have above.
    Raises InputError for fewer than three cameras, or a walk along a line, which goes round nothing.
    """
    centres = np.array([camera.centre for camera in cameras]).reshape(-1, 3)
    middle = centres.mean(axis=0) if len(centres) else np.zeros(3)
    _, spread, axes = np.linalg.svd(centres - middle)
    if len(centres) < 3 or spread[1] < 0.05 * spread[0]:
        raise InputError(f"{len(centres)} camera centres are too few or on one line, expected a walk round an object")
    across, ahead = axes[:2]
    down = np.mean([camera.R[1] for camera in cameras], axis=0)
    if np.cross(across, ahead) @ down > 0:
        ahead = -ahead
    flat = [(points - middle) @ np.stack([across, ahead], axis=1) for points in (centres, np.asarray(others))]
    return tuple(points / np.linalg.norm(points, axis=1, keepdims=True) for points in flat)


def evenly(n: int, count: int, first: int) -> np.ndarray:
    """`count` of n places on a ring, evenly spaced from `first` on, as evaluation pairs take target frames."""
    return (first + np.arange(count) * n // count) % n


def best_view(
    reference: View,
    targets: Sequence[View],
    comparisons: Sequence[ViewPair],
    places: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "1 2"]],
    angles: Float[np.ndarray, " n"],
) -> "VBox":
    """Widget: which of N target views each of the four scores chooses, and the matches that it goes on with.

    targets, comparisons: n views in the order of the walk, each compared with the reference.  places: where they and
    the reference stand as seen from above (`around`).  angles: degrees between each view and the reference, which the
    method does not know.  Controls: the score, how many of the views there are, and the first of them.
    Raises InputError where the numbers of views differ.
    """
    n = len(targets)
    if not (n == len(comparisons) == len(places[0]) == len(angles) > 0):
        raise InputError(
            f"{n} targets, {len(comparisons)} comparisons, {len(places[0])} places and {len(angles)} angles, "
            "expected as many of each"
        )
    scores = {name: np.array([score(one) for one in comparisons]) for name, score in VIEW_SELECTORS.items()}
    pixels = [_match_pixels(reference, target, one) for target, one in zip(targets, comparisons)]
    figure, (above, graph, images) = plt.subplots(
        1, 3, figsize=(9, 3.1), width_ratios=(1, 1.15, 1.75), layout="constrained"
    )
    above.set(xlim=(-1.45, 1.45), ylim=(-1.45, 1.45), aspect="equal", title="from above")
    above.set_axis_off()
    above.plot(*places[1].T, "*", color=BLUE, markersize=13)
    for number, place in enumerate(places[0], 1):
        above.text(*(1.27 * place), str(number), ha="center", va="center", fontsize=8)
    shown = above.scatter(*places[0].T, s=90, c=np.zeros(n), cmap="cividis", edgecolors="0.3", zorder=3)
    ring = above.scatter([], [], s=230, facecolors="none", edgecolors=CHOSEN, linewidths=2.5, zorder=4)
    above.text(0, 0, "object", ha="center", va="center", fontsize=8, color="0.4")
    above.text(0, -1.42, "star: reference; bright: high score", ha="center", fontsize=7)
    dots = graph.scatter(angles, np.zeros(n), s=40, c=np.zeros(n), cmap="cividis", edgecolors="0.3", zorder=3)
    circle = graph.scatter([], [], s=150, facecolors="none", edgecolors=CHOSEN, linewidths=2.5)
    graph.set(xlim=(-8, 188), xticks=(0, 90, 180), title="score against angle")
    graph.set_xlabel("angle to the reference (degrees)", fontsize=8)
    graph.tick_params(labelsize=8)
    for axis in (above, graph):
        axis.title.set_fontsize(9)
    rgb = [view.frame.rgb for view in targets]
    canvas = match_canvas(images, reference.frame.rgb, rgb[0], ("reference", "chosen view"))

    def update(score: str, views: int, first: int) -> str:
        available = evenly(n, views, first - 1)
        values = scores[score]
        best = int(available[values[available].argmax()])
        low, high = values.min(), max(values.max(), values.min() + 1e-9)
        there = np.isin(np.arange(n), available)
        shown.set_sizes(np.where(there, 90, 12))
        dots.set_sizes(np.where(there, 40, 4))
        for artist in (shown, dots):
            artist.set_array(values)
            artist.set_clim(low, high)
        dots.set_offsets(np.column_stack([angles, values]))
        margin = 0.08 * (high - low)
        graph.set_ylim(low - margin, high + margin)
        ring.set_offsets(places[0][[best]])
        circle.set_offsets([[angles[best], values[best]]])
        canvas.images[1].set_data(rgb[best])
        canvas.draw(*pixels[best])
        nearest = int(available[angles[available].argmin()])
        return (
            f'Of {views} view{"s" * (views > 1)}, "{score}" chooses view {best + 1}, {angles[best]:.0f}° from the '
            f"reference; the nearest is view {nearest + 1}, {angles[nearest]:.0f}°."
        )

    controls = {
        "score": choice("score", list(VIEW_SELECTORS)),
        "views": slider("target views N", 1, n, n),
        "first": slider("first view", 1, n, 1),
    }
    alt = (
        "Target views on a circle around the object, their scores against their angle to the reference, "
        "and the matches between the reference and the chosen view"
    )
    return explorer(figure, controls, update, alt)


def _match_pixels(reference: View, target: View, comparison: ViewPair) -> tuple[np.ndarray, np.ndarray]:
    matches = comparison.matches
    return tuple(
        patch_centres(cells, view.features.grid, view.frame.rgb.shape[:2])
        for cells, view in ((matches.reference, reference), (matches.target, target))
    )


def example_best_view() -> "VBox":
    """`best_view` on sample data: one object against four views of another."""
    from zsp_lite.backbones.load import load_backbone
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.labels import read_labels, relative_pose
    from zsp_lite.data.samples import sample_data
    from zsp_lite.demo import demo_pairs
    from zsp_lite.metrics import rotation_error
    from zsp_lite.pipeline import ZeroShotPose

    dataset = Co3D(sample_data())
    pair = demo_pairs(dataset)[0]
    first, second = (
        read_labels(dataset.root, pair.category)[s] for s in (pair.reference_sequence, pair.target_sequence)
    )
    reference, targets = dataset.load_pair(replace(pair, target_frames=(0, 6, 12, 18)))
    method = ZeroShotPose(load_backbone("zsp-tiny", "cpu"))
    reference, *targets = method.views([reference, *targets])
    frames = [view.frame for view in (reference, *targets)]
    compared = [method.match_pair(reference, *one) for one in zip(targets, method.similarities(reference, targets))]
    truths = [relative_pose(first, frames[0].camera, second, frame.camera) for frame in frames[1:]]
    seen_from = second.trans @ np.linalg.inv(first.trans) @ np.append(frames[0].camera.centre, 1)
    angles = rotation_error(np.eye(3), np.stack(truths)[:, :3, :3])
    return best_view(
        reference, targets, compared, around([frame.camera for frame in frames[1:]], seen_from[None, :3]), angles
    )
