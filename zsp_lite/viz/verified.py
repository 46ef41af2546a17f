"""Plots for the verified solver: the point terms of a pose in every view, and its score."""

from collections.abc import Mapping, Sequence
from itertools import product

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
from zsp_lite.viz.plots import (
    BLUE,
    ORANGE,
    VERMILLION,
    draw_axes,
    draw_points,
    mark,
    object_cloud,
    show_dots,
    show_images,
    show_panels,
    show_points,
)

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
    figure, panels = _show_poses(images, terms, maps, views, names, poses, size)
    for axis, pose, view, pixels in panels:
        classes = classify_points(terms, pose)[view]
        # Violations are drawn last, so that no other point covers them.
        for index in (_OCCLUDED, _UNKNOWN, _SURFACE, _FREE_SPACE, _OUTSIDE):
            name, (colour, marker) = list(POINT_CLASSES.items())[index]
            style = {"marker": marker, "edgecolors": "black", "linewidths": 0.4, "zorder": 3, "label": name}
            axis.scatter(*pixels[classes == index].T, 6 if index == _UNKNOWN else 14, colour, **style)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9, handletextpad=0.1)
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
    figure, panels = _show_poses(images, terms, maps, views, names, poses, 3.0)
    label, (low, high) = _POINT_TERMS[term]
    for axis, pose, view, pixels in panels:
        values = getattr(terms, term)[pose, view].numpy()
        weights = terms.surface[pose, view].numpy() if term == "similarity" else values
        order = np.argsort(weights, kind="stable")
        style = {"s": 16 * (0.15 + 1.2 * weights[order]), "c": values[order], "vmin": low, "vmax": high}
        drawn = axis.scatter(*pixels[order].T, edgecolors="black", linewidths=0.3, zorder=3, **style)
    figure.colorbar(drawn, ax=[axis for axis, *_ in panels], shrink=0.6, pad=0.01, label=label)
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
    rows = {name: errors[np.array(sources) == name] for name in dict.fromkeys(sources)}
    labels = {"xlabel": "rotation error (degrees)", "xlim": (-4, 184), "xticks": range(0, 181, 30)}
    figure = show_dots({"": rows}, median=False, **labels)
    (axis,) = figure.axes
    axis.axvspan(0, MODE_ANGLE, color="0.9", zorder=0, label="within 30 degrees of the truth")
    axis.axvspan(150, 180, color=ORANGE, alpha=0.25, zorder=0, linewidth=0, label="about half a turn off")
    figure.legend(loc="outside upper center", ncols=2, fontsize=9)
    return figure


def show_from_above(
    reference_points: Float[Tensor, "n 3"], target_points: Float[Tensor, "m 3"], poses: Poses, titles: Sequence[str]
) -> Figure:
    """Show the targets' points and the moved points of the reference from above, one panel per pose.

    Above means along the y axis of the scene's first target camera, which points down.
    """
    moved, across = poses.apply(reference_points).numpy(), [0, 2]
    targets = {"targets, all views": target_points.numpy()[:, across]}
    panels = {title: targets | {"reference, moved": one[:, across]} for title, one in zip(titles, moved)}
    return show_points(panels, 3, 3.3, (ORANGE, BLUE), xlabel="x, to the right", ylabel="z, away")


def show_stages(stages: Mapping[str, tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]]) -> Figure:
    """Show score (nats) against rotation error (degrees) of every pose after each stage; a star marks the highest."""
    scores = np.concatenate([score for _, score in stages.values()])
    margin = 0.06 * np.ptp(scores)
    labels = {"xlim": (-8, 188), "xticks": range(0, 181, 60), "ylim": (scores.min() - margin, scores.max() + margin)}
    labels |= {"xlabel": "rotation error (degrees)", "ylabel": "score (nats)"}
    panels = {f"{stage} ({len(found[0])})": {"a pose; star: highest score": found} for stage, found in stages.items()}
    figure = show_panels(panels, joined=False, size=(3.1 * len(stages), 3.4), **labels)
    for axis, (error, score) in zip(figure.axes, stages.values()):
        best = int(np.argmax(score))
        axis.axvspan(0, MODE_ANGLE, color="0.9", zorder=0)
        axis.plot(error[best], score[best], "*", color=ORANGE, markersize=14, markeredgecolor="black")
    return figure


def _show_poses(
    images: Sequence[np.ndarray],
    terms: PointTerms,
    maps: ViewMaps,
    views: Sequence[int],
    names: Sequence[str],
    poses: Sequence[str],
    size: float,
) -> tuple[Figure, list[tuple[Axes, int, int, Float[np.ndarray, "n 2"]]]]:
    """Show the images of some views once for each pose; return axis, pose, view, and the points' pixels in the image.

    Pixels outside the image are moved to its border.
    """
    titles = [f"{pose}: {name}" for pose in poses for name in names]
    columns = len(images) if len(images) > 1 else len(poses)
    figure, axes = show_images(list(images) * len(poses), titles, columns=columns, size=size)
    panels = []
    for axis, (pose, view) in zip(axes, product(range(len(poses)), views)):
        pixels = (terms.projection.pixels[pose, view] * maps.pixel_scale[view]).double().numpy()
        panels.append((axis, pose, view, pixels.clip(0, (axis.get_xlim()[1], axis.get_ylim()[0]))))
    return figure, panels
