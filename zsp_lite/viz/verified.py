"""Plots for the verified solver: the point terms of a pose in every view, its score, and the reliability diagram.

`draw_point_classes` and `draw_point_term` draw into axes from `plots.show_images`, one per view of the scene.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection

from zsp_lite.errors import InputError
from zsp_lite.verified.confidence import Reliability
from zsp_lite.verified.maps import ViewMaps
from zsp_lite.verified.verification import TERM_NAMES, PointTerms, ScoreWeights
from zsp_lite.viz.plots import BLUE, ORANGE, VERMILLION

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
_NORMAL_95 = 1.96


def classify_points(terms: PointTerms, pose: int = 0) -> Int[np.ndarray, "v n"]:
    """Classify each point in each view under one of the poses.

    A point is on the surface if its surface weight is at least half of what it would be exactly on the surface.

    Args:
        terms: Point terms of m poses.
        pose: Index of the pose.

    Returns:
        (v, n) indices into `POINT_CLASSES`.
    """
    projection = terms.projection
    distance, weight = projection.silhouette_distance[pose].numpy(), projection.weight[pose].numpy()
    surface, free_space = terms.surface[pose].numpy(), terms.free_space[pose].numpy()
    conditions = [distance > 0, weight <= 0, surface >= weight / 2, free_space > 0]
    return np.select(conditions, [_OUTSIDE, _UNKNOWN, _SURFACE, _FREE_SPACE], _OCCLUDED)


def draw_point_classes(
    axes: Sequence[Axes], terms: PointTerms, maps: ViewMaps, pose: int = 0, size: float = 16.0, legend: bool = True
) -> Int[np.ndarray, "v classes"]:
    """Draw every point over every view's image, marked by its class. Points outside an image are drawn at its border.

    Args:
        axes: One per view, from `plots.show_images`.
        terms: Point terms of m poses.
        maps: Maps of the views that the points were projected into.
        pose: Index of the pose.
        size: Marker size in points squared.
        legend: Whether to add a legend below the figure.

    Returns:
        (v, classes) number of points of each class in each view.

    Raises:
        InputError: There is not one axis per view.
    """
    classes, pixels = classify_points(terms, pose), _image_pixels(terms, maps, pose)
    _check_axes(axes, maps)
    # Violations are drawn last, so that no other point covers them.
    for index in (_OCCLUDED, _UNKNOWN, _SURFACE, _FREE_SPACE, _OUTSIDE):
        colour, marker = list(POINT_CLASSES.values())[index]
        for axis, view_classes, view_pixels in zip(axes, classes, pixels):
            x, y = _clip_to_image(axis, view_pixels[view_classes == index]).T
            axis.scatter(
                x, y, s=size * (0.4 if index == _UNKNOWN else 1), c=colour, marker=marker, edgecolors="black",
                linewidths=0.4, zorder=3,
            )  # fmt: skip
    if legend:
        handles = [
            plt.Line2D([], [], marker=marker, linestyle="", color=colour, markeredgecolor="black", label=name)
            for name, (colour, marker) in POINT_CLASSES.items()
        ]
        axes[0].figure.legend(
            handles=handles, loc="outside lower center", ncols=len(POINT_CLASSES), fontsize=9, handletextpad=0.1
        )
    return np.stack([np.bincount(view_classes, minlength=len(POINT_CLASSES)) for view_classes in classes])


def draw_point_term(
    axes: Sequence[Axes], terms: PointTerms, maps: ViewMaps, name: str, pose: int = 0, size: float = 16.0
) -> None:
    """Draw one point term over every view's image, with a colour bar.

    Marker areas grow with the term; those of the similarity grow with the surface weight that multiplies it.

    Args:
        axes: One per view, from `plots.show_images`.
        terms: Point terms of m poses.
        maps: Maps of the views that the points were projected into.
        name: "silhouette", "free_space", "surface" or "similarity".
        pose: Index of the pose.
        size: Marker size in points squared.

    Raises:
        InputError: Another name, or there is not one axis per view.
    """
    if name not in _POINT_TERMS:
        raise InputError(f"point term is {name!r}, expected one of {', '.join(_POINT_TERMS)}")
    _check_axes(axes, maps)
    label, (low, high) = _POINT_TERMS[name]
    values = getattr(terms, name)[pose].numpy()
    weights = terms.surface[pose].numpy() if name == "similarity" else values
    drawn: PathCollection | None = None
    for axis, value, weight, pixels in zip(axes, values, weights, _image_pixels(terms, maps, pose)):
        order = np.argsort(weight, kind="stable")
        x, y = _clip_to_image(axis, pixels[order]).T
        drawn = axis.scatter(
            x, y, s=size * (0.15 + 1.2 * weight[order]), c=value[order], cmap="viridis", vmin=low, vmax=high,
            edgecolors="black", linewidths=0.3, zorder=3,
        )  # fmt: skip
    bar = axes[0].figure.colorbar(drawn, ax=list(axes), location="right", shrink=0.8, pad=0.01)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=8)


def score_contributions(terms: Mapping[str, float], weights: ScoreWeights) -> dict[str, float]:
    """Return what each term adds to the score, weight times term in nats, by name."""
    return {name: getattr(weights, name) * terms[name] for name in TERM_NAMES}


def draw_score_contributions(axis: Axes, hypotheses: Mapping[str, Mapping[str, float]], weights: ScoreWeights) -> None:
    """Draw what each term adds to the scores of one to four hypotheses. Terms of weight 0 are left out.

    Args:
        axis: Axis to draw on.
        hypotheses: The terms of each hypothesis by its name in the legend.
        weights: Weights of the score.

    Raises:
        InputError: No hypothesis, or more than four.
    """
    if not 1 <= len(hypotheses) <= len(_HATCHES):
        raise InputError(f"{len(hypotheses)} hypotheses to draw, expected 1 to {len(_HATCHES)}")
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


def draw_reliability(axis: Axes, reliability: Reliability) -> None:
    """Draw a reliability diagram: accuracy against mean confidence of each bin, with 95 % Wilson intervals and counts.

    On the dashed diagonal confidences are calibrated; below it they are too high.
    """
    accuracy, count = reliability.accuracy, reliability.count
    low, high = _wilson_interval(accuracy, count)
    bars = np.maximum([accuracy - low, high - accuracy], 0)
    axis.plot([0, 1], [0, 1], color="0.4", linestyle="--", label="calibrated")
    axis.errorbar(
        reliability.confidence, accuracy, bars, fmt="o", color=BLUE, ecolor="0.5", capsize=3, markeredgecolor="black",
        label="measured",
    )  # fmt: skip
    for x, y, n in zip(reliability.confidence, accuracy, count):
        axis.annotate(str(n), (x, y), (5, -10), textcoords="offset points", fontsize=8, color="0.3")
    axis.set(xlabel="mean confidence", ylabel="fraction within 30 degrees", xlim=(0, 1.03), ylim=(0, 1.03))
    axis.set_aspect("equal")
    axis.legend(loc="upper left", fontsize=9)


def _wilson_interval(
    share: Float[np.ndarray, " bins"], count: Int[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    square = _NORMAL_95**2 / count
    centre = (share + square / 2) / (1 + square)
    half = np.sqrt(share * (1 - share) * square + square**2 / 4) / (1 + square)
    return centre - half, centre + half


def _image_pixels(terms: PointTerms, maps: ViewMaps, pose: int) -> Float[np.ndarray, "v n 2"]:
    """Pixels (x, y) of the points in the images of the views."""
    with torch.no_grad():
        return (terms.projection.pixels[pose] * maps.pixel_scale[:, None]).double().numpy()


def _clip_to_image(axis: Axes, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Clip pixels to the limits of `axis`, which its image covers."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    return np.clip(pixels, [left, top], [right, bottom])


def _check_axes(axes: Sequence[Axes], maps: ViewMaps) -> None:
    if len(axes) != len(maps):
        raise InputError(f"{len(axes)} axes, expected one for each of the {len(maps)} views")
