"""Plots of trainings: pictures with the renderer's knowledge, distributions of answers, and curves.

Functions whose names begin with `show_` return whole figures.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float, Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle

from zsp_lite.viz.plots import BLUE, GREEN, ORANGE, VERMILLION, overlay_map, show_images

_STYLES = ((BLUE, "-", "o"), (VERMILLION, "--", "s"), (ORANGE, ":", "^"), (GREEN, "-.", "D"), ("0.3", "-", "v"))
# Objects are three or four units wide; this many fit into the range of colours.
_COORDINATE_SPAN = 2.6


def coordinate_picture(surface: Real[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Colour pixels by their place on the object; pixels without one (NaN, the background) are white."""
    colours = (np.asarray(surface, np.float32) / _COORDINATE_SPAN + 0.5).clip(0, 1)
    return np.where(np.isnan(surface), np.float32(1), colours)


def show_object_coordinates(
    pictures: Real[np.ndarray, "objects v h w 3"], surfaces: Real[np.ndarray, "objects v h2 w2 3"]
) -> Figure:
    """Show the views of several objects, and below each view the place on the object of each pixel as a colour."""
    views = len(pictures[0])
    rows = [row for pair in zip(pictures, (map(coordinate_picture, one) for one in surfaces)) for row in pair]
    images = [image for row in rows for image in row]
    titles = [f"view {i}" for i in range(views)] + [""] * (len(images) - views)
    return show_images(images, titles, columns=views, size=1.2)[0]


def draw_answers(axis: Axes, probabilities: Float[np.ndarray, "pictures outputs"]) -> AxesImage:
    """Draw distributions over outputs as an image, one row per picture; fill it again with `set_data`."""
    pictures, outputs = probabilities.shape
    axis.set(xlabel="output", xticks=range(outputs), yticks=range(pictures))
    return axis.imshow(probabilities, vmin=0, vmax=1, cmap="viridis")


def show_answers(cases: Mapping[str, Float[np.ndarray, "pictures outputs"]]) -> Figure:
    """Show distributions over outputs side by side, one panel per case."""
    figure, axes = plt.subplots(
        1, len(cases), figsize=(3.2 * len(cases), 3), layout="constrained", sharey=True, squeeze=False
    )
    for axis, (name, probabilities) in zip(axes[0], cases.items()):
        drawn = draw_answers(axis, probabilities)
        axis.set_title(name, fontsize=10)
    axes[0, 0].set_ylabel("picture")
    figure.colorbar(drawn, ax=axes, label="probability", shrink=0.8)
    return figure


def smoothed(values: Sequence[float], window: int) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the running mean over `window` values (odd), and the steps, counted from 1, at its middles."""
    means = np.convolve(np.asarray(values, float), np.ones(window) / window, "valid")
    return np.arange(len(means)) + (window + 1) / 2, means


def show_collapses(runs: Mapping[str, Sequence[Mapping[str, float]]], outputs: int) -> Figure:
    """Show the teacher's entropy, the divergence of the student and the information over the steps of several runs.

    A run is the list of what `training.distillation` measures in each step; the entropy is at most log `outputs`.
    """
    panels = {"teacher_entropy": "teacher's entropy", "kl": "divergence of the student", "information": "information"}
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.4), layout="constrained")
    for axis, (name, label) in zip(axes, panels.items()):
        for (run, rows), (colour, line, _) in zip(runs.items(), _STYLES):
            steps, values = smoothed([row[name] for row in rows], 9)
            axis.plot(steps, values, color=colour, linestyle=line, linewidth=2, label=run)
        axis.set(xlabel="step", ylabel=f"{label} (nats)", ylim=(-0.1, None))
    top = np.log(outputs)
    axes[0].axhline(top, color="0.5", linewidth=1)
    for height, text in ((top + 0.08, "log K: all outputs alike"), (0.1, "0: one output for all")):
        axes[0].text(0.97, height, text, ha="right", fontsize=9, transform=axes[0].get_yaxis_transform())
    axes[0].set_ylim(-0.1, 1.12 * top)
    figure.legend(*axes[2].get_legend_handles_labels(), loc="outside lower center", ncols=len(runs))
    return figure


def show_query(
    views: Real[np.ndarray, "v h w 3"], query: tuple[int, int],
    targets: Real[np.ndarray, "v rows cols"], answers: Real[np.ndarray, "v rows cols"], least: float = 0.05,
) -> Figure:  # fmt: skip
    """Show a query patch (row, col) in the first view, and over the others its target (above) and an answer (below).

    Weights of patches below `least` are left out.
    """
    columns = len(views)
    titles = ["query: framed", *["target"] * (columns - 1), "query: framed", *["answer"] * (columns - 1)]
    figure, axes = show_images([*views, *views], titles, columns=columns, size=1.6)
    for row, maps in enumerate((targets, answers)):
        for axis, weights in zip(axes[row * columns + 1 : (row + 1) * columns], maps[1:]):
            overlay_map(axis, np.where(weights > least, weights, np.nan), alpha=1, limits=(0, 1))
    height, width = (size / cells for size, cells in zip(views[0].shape[:2], targets.shape[1:]))
    for axis in (axes[0], axes[columns]):
        for colour, line in (("black", 4), ("white", 2)):
            corner = (query[1] * width, query[0] * height)
            axis.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=colour, linewidth=line))
    return figure


def show_supervision(
    view: Real[np.ndarray, "h w 3"], normals: Real[np.ndarray, "rows cols 3"], depth: Real[np.ndarray, "rows cols"],
    coverage: Real[np.ndarray, "rows cols"], inside: Bool[np.ndarray, "rows cols"],
) -> Figure:  # fmt: skip
    """Show what a renderer knows of each patch of a view: normals, relative depth and share of the object.

    The depth is relative to the object's mean, in standard deviations; patches that are not `inside` are white.
    """
    pictures = [view, np.where(inside[..., None], normals / 2 + 0.5, 1), np.ones_like(view), view]
    titles = ["the view", "geometry: normals", "geometry: depth", "attention: the object"]
    figure, axes = show_images(pictures, titles, size=2.3)
    overlay_map(axes[2], np.where(inside, depth, np.nan), alpha=1, label="relative depth (standard deviations)")
    overlay_map(axes[3], coverage, alpha=1, limits=(0, 1), label="share of the patch")
    return figure


def show_losses(rows: Sequence[Mapping[str, float]], losses: Mapping[str, str], change: int) -> Figure:
    """Show the running means of several losses over the steps; a dotted line marks the step of a change."""
    figure, axes = plt.subplots(1, len(losses), figsize=(3.4 * len(losses), 2.9), layout="constrained", squeeze=False)
    for axis, (name, label) in zip(axes[0], losses.items()):
        steps, values = smoothed([row[name] for row in rows], 11)
        axis.plot(steps, values, color=BLUE, linewidth=2)
        axis.axvline(change, color="0.5", linestyle=":")
        axis.set(xlabel="step", ylabel=f"{label} loss", ylim=(0, 1.05 * max(values)))
    return figure


def show_keys_and_attention(
    pictures: Sequence[np.ndarray], rows: Sequence[tuple[str, Sequence[np.ndarray], Sequence[np.ndarray]]],
    size: float = 1.15,
) -> Figure:  # fmt: skip
    """Show pictures above the colours of their keys (left) and their attention (right).

    A row is the name of a network, and its keys' colours and its attention for each picture.
    """
    count = len(pictures)
    images = [*pictures, *pictures]
    for _, colours, attention in rows:
        images += [*colours, *attention]
    figure, axes = show_images(images, [""] * len(images), columns=2 * count, size=size)
    axes[0].set_title("keys of these pictures", fontsize=10, loc="left")
    axes[count].set_title("attention in these pictures", fontsize=10, loc="left")
    for row, (name, _, _) in enumerate(rows, 1):
        axes[2 * count * row].set_title(name, fontsize=9, loc="left")
        for axis in axes[2 * count * row + count : 2 * count * (row + 1)]:
            axis.images[0].set_cmap("viridis")
    return figure
