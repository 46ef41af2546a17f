"""Plots for the verified solver: the point terms of a pose in every view, and its score."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from zsp_lite.alignment import Sim3
from zsp_lite.verified.confidence import MODE_ANGLE
from zsp_lite.verified.maps import ViewMaps
from zsp_lite.verified.poses import Poses
from zsp_lite.verified.verification import TERM_NAMES, PointTerms, ScoreCoefficients
from zsp_lite.views import View
from zsp_lite.viz.plots import BLUE, ORANGE, VERMILLION, draw_axes, draw_points, mark, object_cloud, show_images

# Classes of a projected point, each with its colour and marker.
POINT_CLASSES: dict[str, tuple[str, str]] = {
    "on the surface": (BLUE, "o"),
    "occluded": ("0.75", "."),
    "in free space": (ORANGE, "^"),
    "outside the silhouette": (VERMILLION, "X"),
    "depth unknown": ("white", "s"),
}
_SURFACE, _OCCLUDED, _FREE_SPACE, _OUTSIDE, _UNKNOWN = range(5)
# Point terms that can be drawn, with their label and the limits of their colours.
_POINT_TERMS = {
    "silhouette": ("silhouette violation", (0.0, 1.0)),
    "free_space": ("free-space violation", (0.0, 1.0)),
    "surface": ("surface weight", (0.0, 1.0)),
    "similarity": ("feature similarity", (-0.3, 0.3)),
}
_HATCHES = ("", "///", "...", "xx")
_COLOURS = (BLUE, ORANGE, "0.6", VERMILLION)
_AXIS_LENGTH = 1.2  # of the reference camera, in its units


def classify_points(terms: PointTerms, pose: int = 0) -> Int[np.ndarray, "v n"]:
    """Classify each point in each view under one of the poses, as indices into `POINT_CLASSES`.

    A point is on the surface if its surface weight is at least half of what it would be exactly on the surface. The
    points that are left are behind it: occluded.
    """
    projection = terms.projection
    distance, weight = projection.silhouette_distance[pose].numpy(), projection.weight[pose].numpy()
    surface, free_space = terms.surface[pose].numpy(), terms.free_space[pose].numpy()
    conditions = [distance > 0, weight <= 0, surface >= weight / 2, free_space > 0]
    return np.select(conditions, [_OUTSIDE, _UNKNOWN, _SURFACE, _FREE_SPACE], _OCCLUDED)


def show_point_classes(
    images: Sequence[np.ndarray],
    terms: PointTerms,
    maps: ViewMaps,
    views: Sequence[int],
    names: Sequence[str],
    poses: Sequence[str],
    size: float = 3.0,
) -> Figure:
    """Show the points of each pose by their classes: one row per pose, one column per view (a single view: one row).

    `images` and `names` are those of the `views` of the maps. Points outside an image are drawn at its border.
    """
    figure, rows = _show_poses(images, names, poses, len(images) if len(images) > 1 else len(poses), size)
    for pose, axes in enumerate(rows):
        classes, pixels = classify_points(terms, pose)[views], _image_pixels(terms, maps, pose)[views]
        # Violations are drawn last, so that no other point covers them.
        for index in (_OCCLUDED, _UNKNOWN, _SURFACE, _FREE_SPACE, _OUTSIDE):
            colour, marker = list(POINT_CLASSES.values())[index]
            style = {"s": 6 if index == _UNKNOWN else 14, "c": colour, "marker": marker, "linewidths": 0.4}
            for axis, view_classes, view_pixels in zip(axes, classes, pixels):
                at = _clip_to_image(axis, view_pixels[view_classes == index])
                axis.scatter(*at.T, edgecolors="black", zorder=3, **style)
    handles = [
        plt.Line2D([], [], marker=marker, linestyle="", color=colour, markeredgecolor="black", label=name)
        for name, (colour, marker) in POINT_CLASSES.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=9, handletextpad=0.1)
    return figure


def show_point_term(
    images: Sequence[np.ndarray],
    terms: PointTerms,
    maps: ViewMaps,
    term: str,
    views: Sequence[int],
    names: Sequence[str],
    poses: Sequence[str],
) -> Figure:
    """Show one of `_POINT_TERMS` of every point: one row per pose, one column per view (see `show_point_classes`).

    Marker areas grow with the term; those of the similarity grow with the surface weight that multiplies it.
    """
    figure, rows = _show_poses(images, names, poses, len(images), 3.0)
    label, (low, high) = _POINT_TERMS[term]
    for pose, axes in enumerate(rows):
        values = getattr(terms, term)[pose].numpy()[views]
        weights = terms.surface[pose].numpy()[views] if term == "similarity" else values
        for axis, value, weight, pixels in zip(axes, values, weights, _image_pixels(terms, maps, pose)[views]):
            order = np.argsort(weight, kind="stable")
            style = {"s": 16 * (0.15 + 1.2 * weight[order]), "c": value[order], "vmin": low, "vmax": high}
            at = _clip_to_image(axis, pixels[order])
            drawn = axis.scatter(*at.T, cmap="viridis", edgecolors="black", linewidths=0.3, zorder=3, **style)
        bar = figure.colorbar(drawn, ax=axes, location="right", shrink=0.8, pad=0.01)
        bar.set_label(label, fontsize=8)
        bar.ax.tick_params(labelsize=8)
    return figure


def score_contributions(terms: Mapping[str, float], weights: ScoreCoefficients) -> dict[str, float]:
    """Return what each term adds to the score, weight times term in nats, by name."""
    return {name: getattr(weights, name) * terms[name] for name in TERM_NAMES}


def draw_score_contributions(
    axis: Axes, hypotheses: Mapping[str, Mapping[str, float]], weights: ScoreCoefficients
) -> None:
    """Draw what each term adds to the scores of one to four hypotheses. Terms of weight 0 are left out."""
    names = [name for name in TERM_NAMES if getattr(weights, name)]
    height = 0.8 / len(hypotheses)
    for place, (label, terms) in enumerate(hypotheses.items()):
        parts = score_contributions(terms, weights)
        y = np.arange(len(names)) + (place - (len(hypotheses) - 1) / 2) * height
        axis.barh(
            y, [parts[name] for name in names], height, color=_COLOURS[place], hatch=_HATCHES[place],
            edgecolor="black", linewidth=0.6, label=f"{label}: {sum(parts.values()):.1f}",
        )  # fmt: skip
    axis.axvline(0, color="black", linewidth=0.8)
    axis.set_yticks(range(len(names)), [name.replace("_", " ") for name in names])
    axis.invert_yaxis()
    axis.set_xlabel("weight × term (nats)")
    axis.legend(title="score", fontsize=9)


def show_moved_reference(
    reference: View,
    targets: Sequence[View],
    poses: Sequence[Sim3],
    marks: Mapping[int, tuple[str, str]],
    most: int = 2500,
) -> Figure:
    """Show the reference, and every target view with the points of the reference moved into it, in their own colours.

    `poses` lead from the reference camera to each target camera; `marks` are the text and the colour of a frame by the
    index of the target view.
    """
    frame, cloud = reference.frame, object_cloud(reference, most=most)
    x, y = frame.camera.project(frame.camera.to_world(cloud))[0].astype(int).T
    titles = ["reference", *(f"target {number}" for number in range(1, len(targets) + 1))]
    images = [view.frame.rgb for view in (reference, *targets)]
    figure, (first, *axes) = show_images(images, titles, columns=3, size=3.0)
    draw_axes(first, frame.camera, lambda points: points, cloud.mean(axis=0), _AXIS_LENGTH)
    for axis, view, pose in zip(axes, targets, poses, strict=True):
        draw_points(axis, view.frame.camera, pose.apply(cloud), frame.rgb[y, x] / 255, size=9)
        draw_axes(axis, view.frame.camera, pose.apply, cloud.mean(axis=0), _AXIS_LENGTH)
    for view, (text, colour) in marks.items():
        mark(axes[view], text, colour)
    return figure


def show_proposal_errors(errors: Float[np.ndarray, " m"], sources: Sequence[str]) -> Figure:
    """Show the rotation error of every proposal, one row per source, in order of appearance."""
    rows = list(dict.fromkeys(sources))
    figure, axis = plt.subplots(figsize=(7.5, 0.9 + 0.42 * len(rows)), layout="constrained")
    axis.axvspan(0, MODE_ANGLE, color="0.9", zorder=0, label="within 30 degrees of the truth")
    axis.axvspan(150, 180, color=ORANGE, alpha=0.25, zorder=0, linewidth=0, label="about half a turn off")
    axis.scatter(errors, [rows.index(source) for source in sources], s=50, color=BLUE, edgecolors="white", zorder=3)
    axis.set(xlabel="rotation error (degrees)", xlim=(-4, 184), xticks=range(0, 181, 30))
    axis.set_yticks(range(len(rows)), rows)
    axis.set_ylim(len(rows) - 0.4, -0.6)
    figure.legend(loc="outside upper center", ncols=2, fontsize=9)
    return figure


def show_from_above(
    reference_points: Float[Tensor, "n 3"], target_points: Float[Tensor, "m 3"], poses: Poses, titles: Sequence[str]
) -> Figure:
    """Show the targets' points and the moved points of the reference from above, one panel per pose.

    Above means along the y axis of the scene's first target camera, which points down.
    """
    columns = min(len(poses), 3)
    rows = -(-len(poses) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.3 * columns, 3.5 * rows + 0.3), sharex=True, sharey=True, squeeze=False,
        layout="constrained",
    )  # fmt: skip
    for axis in list(axes.flat)[len(poses) :]:
        axis.set_axis_off()
    there = target_points.numpy()[:, [0, 2]].T
    for axis, moved, title in zip(axes.flat, poses.apply(reference_points).numpy(), titles):
        axis.scatter(*there, s=5, marker="D", color=ORANGE, linewidths=0, label="targets, all views")
        axis.scatter(*moved[:, [0, 2]].T, s=7, color=BLUE, linewidths=0, label="reference, moved")
        axis.set(title=title, xlim=(-2.6, 2.6), ylim=(-2.6, 2.6), box_aspect=1, xlabel="x, to the right")
        axis.title.set_fontsize(10)
    for axis in axes[:, 0]:
        axis.set_ylabel("z, away")
    figure.get_layout_engine().set(h_pad=0.08)  # otherwise the legend covers the labels
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2, markerscale=3)
    return figure


def show_stages(stages: Mapping[str, tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]) -> Figure:
    """Show score (nats) against rotation error (degrees) of every pose after each stage; a star marks the highest."""
    figure, axes = plt.subplots(
        1, len(stages), figsize=(3.1 * len(stages), 3.4), sharey=True, squeeze=False, layout="constrained"
    )
    for axis, (stage, (error, score)) in zip(axes[0], stages.items()):
        best = int(np.argmax(score))
        axis.axvspan(0, MODE_ANGLE, color="0.9", zorder=0)
        axis.scatter(error, score, s=30, color=BLUE, edgecolors="white", linewidths=0.5, label="a pose")
        axis.scatter(
            error[best], score[best], s=150, marker="*", color=ORANGE, edgecolors="black", label="highest score"
        )
        axis.set(title=f"{stage} ({len(error)})", xlabel="rotation error (degrees)")
        axis.set(xlim=(-8, 188), xticks=range(0, 181, 60))
    axes[0, 0].set_ylabel("score (nats)")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9)
    return figure


def _show_poses(
    images: Sequence[np.ndarray], names: Sequence[str], poses: Sequence[str], columns: int, size: float
) -> tuple[Figure, list[list[Axes]]]:
    """Show the images of some views once for each pose; return the axes by pose."""
    titles = [f"{pose}: {name}" for pose in poses for name in names]
    figure, axes = show_images(list(images) * len(poses), titles, columns=columns, size=size)
    return figure, [axes[start : start + len(images)] for start in range(0, len(axes), len(images))]


def _image_pixels(terms: PointTerms, maps: ViewMaps, pose: int) -> Float[np.ndarray, "v n 2"]:
    """Pixels (x, y) of the points in the images of the views."""
    return (terms.projection.pixels[pose] * maps.pixel_scale[:, None]).double().numpy()


def _clip_to_image(axis: Axes, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Clip pixels to the limits of `axis`, which its image covers."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    return np.clip(pixels, [left, top], [right, bottom])
