"""Widgets on matching: one cycle from patch to patch, and the matches that each way of choosing them gives."""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.collections import LineCollection
from matplotlib.patches import ConnectionPatch
from matplotlib.patheffects import Normal, Stroke
from torch import Tensor

from zsp_lite.matchers import MATCHERS
from zsp_lite.matching import match, nearest_neighbours, similarity
from zsp_lite.synthetic.ground_truth import correct_matches
from zsp_lite.views import View
from zsp_lite.viz import plots
from zsp_lite.widgets.common import (
    choice,
    example_pair,
    example_truth,
    explorer,
    load_ipywidgets,
    patch_box,
    patch_map,
    patch_slider,
    slider,
)

if TYPE_CHECKING:
    from ipywidgets import VBox


def cycle(reference: View, target: View, sim: Float[Tensor, "n1 n2"]) -> "VBox":
    """Choose a patch u of the reference; see its nearest neighbour v in the target, v's own u', and d(u, u') (eq. 2).

    sim: `similarity` of the two views' features.
    """
    grid, grid2 = reference.features.grid, target.features.grid
    forth, back = (x.numpy() for x in nearest_neighbours(sim))
    values = sim.cpu().numpy()
    crops = [reference.frame.rgb, target.frame.rgb]
    size, size2 = crops[0].shape[:2], crops[1].shape[:2]
    titles = ["reference: similarity to v", "target: similarity to u"]
    figure, axes = plots.show_images(crops, titles, size=3.7)
    maps = [patch_map(axis, g, s, alpha=0.55) for axis, g, s in zip(axes, (grid, grid2), (size, size2))]
    boxes = [patch_box(axes[0], grid, size, "u", before=True), patch_box(axes[1], grid2, size2, "v")]
    # u' is a circle: where the cycle closes, it lies inside u's frame.
    look = {"markersize": 11, "color": "white", "markeredgecolor": "black", "linestyle": "none", "zorder": 10}
    returned = axes[0].plot([], [], "o", **look)[0]
    outline = [Stroke(linewidth=4, foreground="black"), Normal()]
    way = {
        "coordsA": axes[0].transData,
        "coordsB": axes[1].transData,
        "linewidth": 2,
        "zorder": 9,
        "path_effects": outline,
    }
    arrows = [
        figure.add_artist(ConnectionPatch((0, 0), (0, 0), color="white", **way)),
        figure.add_artist(ConnectionPatch((0, 0), (0, 0), color="white", linestyle="--", **way)),
    ]

    def update(row: int, col: int) -> str:
        u = row * grid[1] + col
        v, w = int(forth[u]), int(back[forth[u]])
        (v_row, v_col), (w_row, w_col) = divmod(v, grid2[1]), divmod(w, grid[1])
        maps[0].set_data(values[:, v].reshape(grid))
        maps[1].set_data(values[u].reshape(grid2))
        boxes[0](row, col)
        boxes[1](v_row, v_col)
        ends = plots.patch_centres(np.array([(row, col), (w_row, w_col)]), grid, size)
        there = plots.patch_centres(np.array([(v_row, v_col)]), grid2, size2)[0]
        returned.set_data(*ends[1:].T)
        for arrow, end in zip(arrows, ends):
            arrow.xy1, arrow.xy2 = end, there
        off = [
            name
            for name, on in (
                ("u", reference.foreground[row, col]), ("v", target.foreground[v_row, v_col]),
                ("u'", reference.foreground[w_row, w_col]),
            ) if not on
        ]  # fmt: skip
        distance = np.hypot(row - w_row, col - w_col)
        return (
            f"u ({row}, {col}) → v ({v_row}, {v_col}), cosine {values[u, v]:.2f} → u' ({w_row}, {w_col}), cosine "
            f"{values[w, v]:.2f}: d(u, u') = {distance:.1f} patches"
            + (f"; {', '.join(off)} off the foreground, so the map has no value here." if off else ".")
        )

    row, col = np.unravel_index(np.where(reference.foreground.cpu(), values.max(1).reshape(grid), -2).argmax(), grid)
    controls = {
        "row": patch_slider("row of u", grid[0], int(row)), "col": patch_slider("column of u", grid[1], int(col)),
    }  # fmt: skip
    alt = "A solid line from a framed patch u to its nearest neighbour v, a dashed line from v back to a circle, u'."
    return explorer(figure, controls, update, alt)


def matches(
    reference: View,
    target: View,
    sim: Float[Tensor, "n1 n2"],
    partners: Int[np.ndarray, "h w 2"],
    found: Bool[np.ndarray, "h w"],
) -> "VBox":
    """Choose how matches are made, how many, and whether k-means spreads them; see which of them are right.

    partners, found: as `synthetic.ground_truth.ground_truth_matches` gives them.
    """
    grid = reference.features.grid
    height, width = reference.frame.rgb.shape[:2]
    gap = 12
    side = np.full((height, gap, 3), 255, np.uint8)
    picture = np.concatenate([reference.frame.rgb, side, target.frame.rgb], axis=1)
    figure, (axis,) = plots.show_images([picture], ["reference and target"], size=7.4)
    styles = {
        "right": {"colors": plots.BLUE, "linewidths": 1.6, "linestyles": "-"},
        "wrong": {"colors": plots.ORANGE, "linewidths": 1.2, "linestyles": "--"},
        "truth not known": {"colors": "0.35", "linewidths": 0.8, "linestyles": ":"},
    }
    border = [Stroke(linewidth=2.6, foreground="white"), Normal()]
    lines = {
        kind: axis.add_collection(LineCollection([], path_effects=border, label=kind, **style))
        for kind, style in styles.items()
    }
    dots = axis.plot([], [], "o", markersize=4, color="white", markeredgecolor="black", linestyle="none")[0]
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=3, fontsize=9, frameon=False)

    @cache
    def chosen(way: str, k: int, kmeans: bool):
        return match(
            reference.features, target.features, k, kmeans, sim=sim, matcher=way,
            ref_foreground=reference.foreground, target_foreground=target.foreground,
        )  # fmt: skip

    def update(way: str, k: int, kmeans: bool) -> str:
        made = chosen(way, k, kmeans)
        known = found[tuple(made.reference.T)]
        right = correct_matches(made.target, partners[tuple(made.reference.T)]) & known
        ends = np.stack(
            [
                plots.patch_centres(made.reference, grid, (height, width)),
                plots.patch_centres(made.target, target.features.grid, target.frame.rgb.shape[:2]) + (width + gap, 0),
            ],
            axis=1,
        )
        for kind, which in zip(lines, (right, known & ~right, ~known)):
            lines[kind].set_segments(ends[which])
        dots.set_data(*ends.reshape(-1, 2).T)
        apart = np.linalg.norm(made.reference[:, None] - made.reference, axis=-1) + np.diag(np.full(len(made), np.inf))
        spread = apart.min(axis=1).mean() if len(made) > 1 else 0.0
        wrong, unknown = (known & ~right).sum(), (~known).sum()
        return (
            f"{way}: {len(made)} matches, {right.sum()} right, {wrong} wrong, {unknown} without a known truth; "
            f"{spread:.1f} patches from a match to the nearest other."
        )

    controls = {
        "way": choice("way", ["cyclical", *MATCHERS]), "k": slider("K", 5, 100, 50, 5),
        "kmeans": load_ipywidgets().Checkbox(value=True, description="k-means of the best 2K", indent=False),
    }  # fmt: skip
    return explorer(figure, controls, update, "Two objects and lines between matched patches.")


def example_cycle() -> "VBox":
    """`cycle` on a sample pair."""
    views = example_pair()
    return cycle(*views, similarity(*(view.features for view in views)))


def example_matches() -> "VBox":
    """`matches` on a sample pair."""
    views, truth = example_pair(), example_truth()
    return matches(*views, similarity(*(view.features for view in views)), truth.cells, truth.valid)
