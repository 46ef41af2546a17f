"""Figures of the notebooks on the first estimate (00), features (01) and cyclical distances (02).

Each function shows one thing and returns the figure, made of the primitives of `plots`. A patch is given by its cell
(row, col), `grid` is the number of (rows, columns) of patches, `size` the width of a panel in inches, and mappings go
from the title of a panel, or the name in the legend, to what is drawn there.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from jaxtyping import Float, Int, Real, UInt8
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch, Rectangle
from matplotlib.patheffects import Normal, Stroke

from zsp_lite.estimates import PoseEstimate
from zsp_lite.matching import Matches
from zsp_lite.viz import plots

Image = UInt8[np.ndarray, "height width 3"]

_POINTS = 1500  # drawn of a cloud
_WRONG = "#D40000"  # with black borders or beside orange, also distinguishable with colour-vision deficiencies


def moved_points(estimates: Mapping[str, PoseEstimate], size: float = 3.4) -> Figure:
    """Show the reference under its own points, and for each estimate its target view under the moved points.

    The colour of a point is its position along the reference object.
    """
    reference = next(iter(estimates.values())).reference_view
    cloud = plots.object_cloud(reference, most=_POINTS)
    colours = plots.coordinate_colours(cloud)
    chosen = [estimate.target_views[estimate.view].frame for estimate in estimates.values()]
    pictures = [reference.frame.rgb, *(frame.rgb for frame in chosen)]
    figure, axes = plots.show_images(pictures, ["reference, its own points", *estimates], size=size)
    plots.draw_points(axes[0], reference.frame.camera, cloud, colours)
    for axis, frame, estimate in zip(axes[1:], chosen, estimates.values()):
        plots.draw_points(axis, frame.camera, estimate.sim3.apply(cloud), colours)
    return figure


def matches_of_estimate(estimate: PoseEstimate, size: float = 3.6) -> Figure:
    """Show the matches between the reference and the chosen target view; see `plots.show_matches` for the lines."""
    views = estimate.reference_view, estimate.target_views[estimate.view]
    pictures, cells = [view.frame.rgb for view in views], (estimate.matches.reference, estimate.matches.target)
    grid, titles = views[0].features.grid, ("reference", "chosen target")
    return plots.show_matches(pictures, cells, grid, estimate.inliers, titles, size)


def image_in_patches(image: Image, patches: UInt8[np.ndarray, "rows cols p p 3"], corner: tuple[int, int]) -> Figure:
    """Show an image under the grid of its patches, and 8 x 8 of them, from `corner` on, pulled apart."""
    count = 8
    rows, cols, p = patches.shape[:3]
    (top, left), last = corner, count - 1
    titles = [f"{rows} x {cols} patches", f"rows {top} to {top + last}, columns {left} to {left + last}"]
    figure, axes = plots.show_images([image, image[:1, :1]], titles, size=3.4)
    axes[0].vlines(np.arange(0, cols * p, p), 0, rows * p, color="white", linewidth=0.5)
    axes[0].hlines(np.arange(0, rows * p, p), 0, cols * p, color="white", linewidth=0.5)
    for row, col in np.ndindex(count, count):
        x, y = 1.25 * col, 1.25 * row
        axes[1].imshow(patches[top + row, left + col], extent=(x, x + 1, y + 1, y))
    axes[1].set(xlim=(-0.25, 1.25 * count), ylim=(1.25 * count, -0.25))
    return figure


def similarities_of_patch(
    image: Image,
    cell: tuple[int, int],
    pictures: Sequence[Image],
    maps: Mapping[str, Real[np.ndarray, "rows cols"]],
    true_cell: Int[np.ndarray, "2"] | None = None,
    limits: tuple[float, float] | None = None,
    size: float = 3.2,
) -> Figure:
    """Show a patch of an image, and how similar the patches of other pictures are to it.

    A circle marks the patch, and in each other panel the most similar patch; a star marks the true partner.
    """
    columns = 2 if len(maps) == 3 else min(1 + len(maps), 3)
    figure, axes = plots.show_images([image, *pictures], ["this patch", *maps], columns=columns, size=size)
    plots.circle_patch(axes[0], cell, next(iter(maps.values())).shape, image)
    for axis, picture, values in zip(axes[1:], pictures, maps.values()):
        values = np.asarray(values)
        plots.overlay_map(axis, values, limits=limits, label="cosine")
        plots.circle_patch(axis, divmod(int(values.argmax()), values.shape[1]), values.shape, picture)
        if true_cell is not None:
            centre = plots.patch_centres(true_cell[None], values.shape, picture.shape[:2])[0]
            axis.plot(*centre, "*", color=plots.ORANGE, markersize=18, markeredgecolor="black")
    return figure


def overlap_by_threshold(thresholds: Float[np.ndarray, " t"], overlap: Float[np.ndarray, "n t"], used: float) -> Figure:
    """Draw the overlap (IoU) of foreground and mask over the threshold, thin for each image, bold for the mean."""
    figure, axis = plt.subplots(figsize=(5.6, 3.6), layout="constrained")
    axis.plot(thresholds, overlap.T, color="0.75", linewidth=1)
    axis.plot(thresholds, overlap.mean(axis=0), color=plots.BLUE, linewidth=2.5, label=f"mean of {len(overlap)}")
    axis.axvline(used, color="black", linestyle="--", label=f"threshold {used}")
    axis.set(xlabel="threshold of the saliency", ylabel="intersection over union (IoU)", ylim=(0, 1))
    axis.legend(loc="lower left", fontsize=9)
    return figure


def bins_of_patches(image: Image, cells: Mapping[str, tuple[int, int]], grid: tuple[int, int]) -> Figure:
    """Show the 17 bins of the log-binned descriptor of some patches: nine white cells and eight dashed blocks."""
    figure, axes = plots.show_images([image] * len(cells), list(cells), size=3.4)
    height, width = image.shape[0] / grid[0], image.shape[1] / grid[1]
    near = {"edgecolor": "white", "linewidth": 1.2}
    far = {"edgecolor": "black", "linewidth": 2, "linestyle": "--"}
    for axis, cell in zip(axes, cells.values()):
        for step in np.ndindex(3, 3):
            for reach, half, style in ((1, 0, near), (3, 1, far)):
                if half and step == (1, 1):
                    continue
                row, col = (np.clip(c + reach * (s - 1), 0, n - 1) for c, s, n in zip(cell, step, grid))
                (top, left), (bottom, right) = (
                    [np.clip(place, 0, n) for place, n in zip(corner, grid)]
                    for corner in ((row - half, col - half), (row + half + 1, col + half + 1))
                )
                box = (left * width, top * height), (right - left) * width, (bottom - top) * height
                axis.add_patch(Rectangle(*box, fill=False, **style))
    return figure


def toy_cycles(
    values: tuple[Real[np.ndarray, "rows cols"], Real[np.ndarray, "rows cols"]],
    cycles: Sequence[tuple[tuple[int, int], tuple[int, int], tuple[int, int]]],
    wrong: Sequence[int] = (),
) -> Figure:
    """Show two grids of numbers and some cycles u, v, u' between them: solid arrows to v, dashed ones back to u'.

    Cycles whose index is in `wrong` are red.
    """
    figure, axes = plt.subplots(1, 2, figsize=(8.6, 4.3), layout="constrained")
    for axis, numbers, title in zip(axes, values, ("first image", "second image")):
        axis.imshow(numbers, cmap="Greys", vmin=0, vmax=400)
        ticks = {"xticks": range(numbers.shape[1]), "yticks": range(numbers.shape[0])}
        axis.set(title=title, xlabel="column", ylabel="row", **ticks)
        for (row, col), number in np.ndenumerate(numbers):
            axis.text(col - 0.42, row - 0.3, number, va="center")
    for index, (u, v, back) in enumerate(cycles):
        colour = _WRONG if index in wrong else plots.ORANGE
        for (start, end), (first, last), line in (((u, v), axes, "-"), ((v, back), axes[::-1], "--")):
            arrow = ConnectionPatch(
                start[::-1], end[::-1], "data", "data", axesA=first, axesB=last, arrowstyle="-|>", mutation_scale=18,
                connectionstyle="arc3,rad=-0.1", linestyle=line, linewidth=2.2, color=colour,
            )  # fmt: skip
            figure.add_artist(arrow)
        axes[0].plot(*u[::-1], "o", color=colour, markeredgecolor="black", markersize=10)
    return figure


def cycles_between(
    reference: Image,
    target: Image,
    cycles: Mapping[str, Int[np.ndarray, "3 2"]],
    grid: tuple[int, int],
    wrong: Sequence[str] = (),
) -> Figure:
    """Show cycles between two images, one per row: a solid line from u to v, a dashed one from v to u'.

    `cycles` has the cells u, v and u' by title; those whose title is in `wrong` are red.
    """
    (height, width), gap = reference.shape[:2], 10
    picture = np.concatenate([reference, np.full((height, gap, 3), 255, np.uint8), target], axis=1)
    figure, axes = plots.show_images([picture] * len(cycles), list(cycles), columns=1, size=6.6)
    for axis, (title, cells) in zip(axes, cycles.items()):
        ends = plots.patch_centres(cells, grid, (height, width)) + [(0, 0), (width + gap, 0), (0, 0)]
        border = [Stroke(linewidth=4.5, foreground="black"), Normal()]
        style = {"color": _WRONG if title in wrong else "white", "linewidth": 2.2, "path_effects": border}
        for part, line in (([0, 1], "-"), ([1, 2], "--")):
            axis.plot(*ends[part].T, line, **style)
        for name, end, side in zip(("u", "v", "u'"), ends, ("left", "left", "right")):
            white = [Stroke(linewidth=3, foreground="white"), Normal()]
            axis.text(*end, name, fontsize=11, weight="bold", va="bottom", ha=side, path_effects=white)
    return figure


def counts_of_matches(counts: Mapping[str, pd.DataFrame], wanted: int) -> Figure:
    """Draw how many matches each rule (column) finds in the pairs of views (rows) of several categories."""
    figure, axis = plt.subplots(figsize=(8, 3.8), layout="constrained")
    rules = list(next(iter(counts.values())).columns)
    for index, (name, table) in enumerate(counts.items()):
        for place, rule in enumerate(reversed(rules)):
            heights = np.full(len(table), place) + 0.16 * (index - (len(counts) - 1) / 2)
            axis.scatter(
                table[rule], heights, s=45, marker=plots.MARKERS[index % 4], color=plots.COLOURS[index % 4],
                edgecolors="black", label=None if place else name,
            )  # fmt: skip
    axis.axvline(wanted, color="0.4", linestyle="--")
    labels = {"yticks": range(len(rules)), "yticklabels": rules[::-1]}
    axis.set(xlabel=f"matches (dashed: {wanted})", xlim=(0, None), **labels)
    axis.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def spread_of_matches(image: Image, matches: Mapping[str, Matches], grid: tuple[int, int]) -> Figure:
    """Show where the matches of several rules start, coloured by their cyclical distance."""
    figure, axes = plots.show_images([image] * len(matches), list(matches), size=4.0)
    for axis, some in zip(axes, matches.values()):
        centres = plots.patch_centres(some.reference, grid, image.shape[:2]).T
        style = {"cmap": "cividis_r", "vmin": 0, "vmax": 3, "s": 50, "edgecolors": "white"}
        dots = axis.scatter(*centres, c=some.distance, **style)
    figure.colorbar(dots, ax=axes, label="d(u, u') in patches", shrink=0.8)
    return figure
