"""What the verified solver weighs, as pictures: the evidence for a pose in every view, its score, its confidence.

The first two draw into axes that `plots.show_images` made, one per view, in the order of the scene's views.
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
from zsp_lite.verified.verification import TERMS, Evidence, Weights
from zsp_lite.viz.plots import BLUE, ORANGE, VERMILLION

# What becomes of a point in a view, each with its colour and its marker.
KINDS: dict[str, tuple[str, str]] = {
    "on the seen surface": (BLUE, "o"),
    "hidden behind it": ("0.75", "."),
    "floating before it": (ORANGE, "^"),
    "outside the silhouette": (VERMILLION, "X"),
    "depth unknown": ("white", "s"),
}
_ON, _HIDDEN, _FLOATING, _OUTSIDE, _UNKNOWN = range(5)
# What to call the parts of the evidence, and the values at the ends of their colours.
_TERMS = {
    "off": ("offence (1: in full)", (0.0, 1.0)),
    "front": ("offence (1: in full)", (0.0, 1.0)),
    "touch": ("on the surface (weight)", (0.0, 1.0)),
    "alike": ("similarity", (-0.3, 0.3)),
}
_HATCHES = ("", "///", "...", "xx")
_COLOURS = (BLUE, ORANGE, "0.6", VERMILLION)
_NORMAL_95 = 1.96


def point_kinds(evidence: Evidence, pose: int = 0) -> Int[np.ndarray, "v n"]:
    """What becomes of each point in each view under one of the poses, as positions in `KINDS`.

    A point is on the surface where it counts at least half as much as one that lies right on it.
    """
    seen = evidence.seen
    off, weight, touch, front = (x[pose].numpy() for x in (seen.off, seen.weight, evidence.touch, evidence.front))
    known, on = weight > 0, touch >= weight / 2
    choices = [(off > 0, _OUTSIDE), (~known, _UNKNOWN), (on, _ON), (front > 0, _FLOATING)]
    return np.select([condition for condition, _ in choices], [kind for _, kind in choices], _HIDDEN)


def draw_kinds(
    axes: Sequence[Axes], evidence: Evidence, maps: ViewMaps, pose: int = 0, size: float = 16.0, legend: bool = True
) -> Int[np.ndarray, "v kinds"]:
    """Every point over every view's image, marked by what becomes of it there; the numbers of each kind per view.

    maps: what the evidence was looked up in. Points beyond an image are drawn at its border.
    Raises InputError where there is not one axis per view.
    """
    kinds, pixels = point_kinds(evidence, pose), _pixels(evidence, maps, pose)
    _one_axis_per_view(axes, maps)
    # Hidden points first, then what agrees, offences last: they must not be covered.
    for kind in (_HIDDEN, _UNKNOWN, _ON, _FLOATING, _OUTSIDE):
        colour, marker = list(KINDS.values())[kind]
        for axis, view_kinds, view_pixels in zip(axes, kinds, pixels):
            at = _inside(axis, view_pixels[view_kinds == kind])
            axis.scatter(
                *at.T, s=size * (0.4 if kind == _UNKNOWN else 1), c=colour, marker=marker, edgecolors="black",
                linewidths=0.4, zorder=3,
            )  # fmt: skip
    if legend:
        figure = axes[0].figure
        handles = [
            plt.Line2D([], [], marker=marker, linestyle="", color=colour, markeredgecolor="black", label=name)
            for name, (colour, marker) in KINDS.items()
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(KINDS), fontsize=9, handletextpad=0.1)
    return np.stack([np.bincount(view_kinds, minlength=len(KINDS)) for view_kinds in kinds])


def draw_term(
    axes: Sequence[Axes], evidence: Evidence, maps: ViewMaps, term: str, pose: int = 0, size: float = 16.0
) -> None:
    """One part of the evidence ("off", "front", "touch" or "alike") over every view's image, with a colour bar.

    Where there is more of it points are larger too; likeness is sized by the weight with which it counts.
    Raises InputError for another name, and where there is not one axis per view.
    """
    if term not in _TERMS:
        raise InputError(f"term is {term!r}, expected one of {', '.join(_TERMS)}")
    _one_axis_per_view(axes, maps)
    label, (low, high) = _TERMS[term]
    values = getattr(evidence, term)[pose].numpy()
    weight = (evidence.touch if term == "alike" else getattr(evidence, term))[pose].numpy()
    drawn: PathCollection | None = None
    for axis, value, much, pixels in zip(axes, values, weight, _pixels(evidence, maps, pose)):
        order = np.argsort(much, kind="stable")
        sizes = size * (0.15 + 1.2 * much[order])
        at = _inside(axis, pixels[order])
        drawn = axis.scatter(
            *at.T, s=sizes, c=value[order], cmap="viridis", vmin=low, vmax=high, edgecolors="black", linewidths=0.3,
            zorder=3,
        )  # fmt: skip
    bar = axes[0].figure.colorbar(drawn, ax=list(axes), location="right", shrink=0.8, pad=0.01)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=8)


def contributions(terms: Mapping[str, float], weights: Weights) -> dict[str, float]:
    """What each term brings into the score: weight times value, in nats, by name."""
    return {name: getattr(weights, name) * terms[name] for name in TERMS}


def draw_contributions(axis: Axes, hypotheses: Mapping[str, Mapping[str, float]], weights: Weights) -> None:
    """What each term brings into the scores of up to four hypotheses (terms by name, by the hypotheses' names).

    Terms without weight are left out. Bars of different hypotheses differ in their hatching too.
    Raises InputError for none and for more than four.
    """
    if not 1 <= len(hypotheses) <= len(_HATCHES):
        raise InputError(f"{len(hypotheses)} hypotheses to draw, expected 1 to {len(_HATCHES)}")
    names = [name for name in TERMS if getattr(weights, name)]
    height = 0.8 / len(hypotheses)
    for place, (label, terms) in enumerate(hypotheses.items()):
        parts = contributions(terms, weights)
        y = np.arange(len(names)) + (place - (len(hypotheses) - 1) / 2) * height
        widths = [parts[name] for name in names]
        axis.barh(
            y, widths, height, color=_COLOURS[place], hatch=_HATCHES[place], edgecolor="black", linewidth=0.6,
            label=f"{label}: {sum(parts.values()):.1f}",
        )  # fmt: skip
    axis.axvline(0, color="black", linewidth=0.8)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.set_xlabel("weight × term (nats)")
    axis.legend(title="score", fontsize=9)


def draw_reliability(axis: Axes, reliability: Reliability) -> None:
    """Share of right estimates against their mean confidence, with 95 % intervals (Wilson) and the numbers of each.

    On the dashed diagonal confidences are frequencies; below it they promise too much.
    """
    share, count = reliability.accuracy, reliability.count
    low, high = _wilson(share, count)
    bars = np.maximum([share - low, high - share], 0)
    axis.plot([0, 1], [0, 1], color="0.4", linestyle="--", label="confidence = frequency")
    axis.errorbar(
        reliability.confidence, share, bars, fmt="o", color=BLUE, ecolor="0.5", capsize=3, markeredgecolor="black",
        label="measured",
    )  # fmt: skip
    for x, y, n in zip(reliability.confidence, share, count):
        axis.annotate(str(n), (x, y), (5, -10), textcoords="offset points", fontsize=8, color="0.3")
    axis.set(xlabel="mean confidence of a bin", ylabel="share within 30 degrees", xlim=(0, 1.03), ylim=(0, 1.03))
    axis.set_aspect("equal")
    axis.legend(loc="upper left", fontsize=9)


def _wilson(
    share: Float[np.ndarray, " bins"], count: Int[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]]:
    square = _NORMAL_95**2 / count
    middle = (share + square / 2) / (1 + square)
    half = np.sqrt(share * (1 - share) * square + square**2 / 4) / (1 + square)
    return middle - half, middle + half


def _pixels(evidence: Evidence, maps: ViewMaps, pose: int) -> Float[np.ndarray, "v n 2"]:
    """Where the points fall in the views' own images."""
    with torch.no_grad():
        return (evidence.seen.pixels[pose] * maps.zoom[:, None]).double().numpy()


def _inside(axis: Axes, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Pixels moved into the image that covers `axis`."""
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    return np.clip(pixels, [left, top], [right, bottom])


def _one_axis_per_view(axes: Sequence[Axes], maps: ViewMaps) -> None:
    if len(axes) != len(maps):
        raise InputError(f"{len(axes)} axes, expected one for each of the {len(maps)} views")
