"""Widgets on matching: the cycle of one patch, and the matches of every matcher."""

from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.collections import LineCollection
from matplotlib.patches import ConnectionPatch
from matplotlib.patheffects import Normal, Stroke
from torch import Tensor

from zsp_lite.matchers import MATCHERS
from zsp_lite.matching import match, nearest_neighbours
from zsp_lite.synthetic.ground_truth import correct_matches
from zsp_lite.views import View
from zsp_lite.viz import plots
from zsp_lite.widgets import common
from zsp_lite.widgets.common import Widget, interactive_figure, patch_outline, patch_sliders


def cycle(reference: View, target: View, sim: Float[Tensor, "n1 n2"]) -> Widget:
    """Show the cycle of a reference patch u, from its nearest neighbour v in the target back to u' (eq. 2)."""
    grid, grid2 = reference.features.grid, target.features.grid
    forth, back = (x.numpy() for x in nearest_neighbours(sim))
    values = sim.cpu().numpy()
    crops = [reference.frame.rgb, target.frame.rgb]
    size, size2 = crops[0].shape[:2], crops[1].shape[:2]
    titles = ["reference: similarity to v", "target: similarity to u"]
    figure, axes = plots.show_images(crops, titles, size=3.7)
    maps = [plots.overlay_map(axis, np.zeros(g), 0.55, limits=(0, 1)) for axis, g in zip(axes, (grid, grid2))]
    outlines = [patch_outline(axes[0], grid, size, "u", label_left=True), patch_outline(axes[1], grid2, size2, "v")]
    # u' is a circle, inside the outline of u where the cycle closes.
    style = {"markersize": 11, "color": "white", "markeredgecolor": "black", "linestyle": "none", "zorder": 10}
    returned = axes[0].plot([], [], "o", **style)[0]
    line = {"coordsA": axes[0].transData, "coordsB": axes[1].transData, "color": "white", "linewidth": 2, "zorder": 9}
    line["path_effects"] = [Stroke(linewidth=4, foreground="black"), Normal()]
    arrows = [
        figure.add_artist(ConnectionPatch((0, 0), (0, 0), linestyle=style, **line)) for style in ("solid", "dashed")
    ]

    def update(row: int, col: int) -> str:
        u = row * grid[1] + col
        v, w = int(forth[u]), int(back[forth[u]])
        (v_row, v_col), (w_row, w_col) = divmod(v, grid2[1]), divmod(w, grid[1])
        maps[0].set_data(values[:, v].reshape(grid))
        maps[1].set_data(values[u].reshape(grid2))
        outlines[0](row, col)
        outlines[1](v_row, v_col)
        ends = plots.patch_centres(np.array([(row, col), (w_row, w_col)]), grid, size)
        v_centre = plots.patch_centres(np.array([(v_row, v_col)]), grid2, size2)[0]
        returned.set_data(*ends[1:].T)
        for arrow, end in zip(arrows, ends):
            arrow.xy1, arrow.xy2 = end, v_centre
        on = {"u": reference.foreground[row, col], "v": target.foreground[v_row, v_col]}
        on["u'"] = reference.foreground[w_row, w_col]
        off = ", ".join(name for name, foreground in on.items() if not foreground)
        return (
            f"u ({row}, {col}) → v ({v_row}, {v_col}), cosine {values[u, v]:.2f} → u' ({w_row}, {w_col}), cosine "
            f"{values[w, v]:.2f}: d(u, u') = {np.hypot(row - w_row, col - w_col):.1f} patches"
            + (f"; {off} not on the foreground, so the distance is infinite." if off else ".")
        )

    start = divmod(int(np.where(reference.foreground.cpu(), values.max(1).reshape(grid), -2).argmax()), grid[1])
    controls = patch_sliders(grid, start, " of u")
    alt = "A solid line from the outlined patch u to its nearest neighbour v, a dashed line from v to the circle u'."
    return interactive_figure(figure, controls, update, alt)


def matches(
    reference: View,
    target: View,
    sim: Float[Tensor, "n1 n2"],
    cells: Int[np.ndarray, "h w 2"],
    valid: Bool[np.ndarray, "h w"],
) -> Widget:
    """Show which matches are correct; choose the matcher, the number of matches and k-means."""
    grid = reference.features.grid
    (height, width), gap = reference.frame.rgb.shape[:2], 12
    side = np.full((height, gap, 3), 255, np.uint8)
    picture = np.concatenate([reference.frame.rgb, side, target.frame.rgb], axis=1)
    figure, (axis,) = plots.show_images([picture], ["reference and target"], size=7.4)
    styles = {
        "correct": {"colors": plots.BLUE, "linewidths": 1.6, "linestyles": "-"},
        "wrong": {"colors": plots.ORANGE, "linewidths": 1.2, "linestyles": "--"},
        "no ground truth": {"colors": "0.35", "linewidths": 0.8, "linestyles": ":"},
    }
    border = [Stroke(linewidth=2.6, foreground="white"), Normal()]
    lines = {
        kind: axis.add_collection(LineCollection([], path_effects=border, label=kind, **style))
        for kind, style in styles.items()
    }
    dots = axis.plot([], [], "o", markersize=4, color="white", markeredgecolor="black", linestyle="none")[0]
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=3, fontsize=9, frameon=False)

    @cache
    def compute(matcher: str, k: int, kmeans: bool):
        return match(
            reference.features, target.features, k, kmeans, sim=sim, matcher=matcher,
            ref_foreground=reference.foreground, target_foreground=target.foreground,
        )  # fmt: skip

    def update(matcher: str, k: int, kmeans: bool) -> str:
        found = compute(matcher, k, kmeans)
        known = valid[tuple(found.reference.T)]
        correct = correct_matches(found.target, cells[tuple(found.reference.T)]) & known
        first = plots.patch_centres(found.reference, grid, (height, width))
        second = plots.patch_centres(found.target, target.features.grid, target.frame.rgb.shape[:2])
        ends = np.stack([first, second + (width + gap, 0)], axis=1)
        for kind, which in zip(lines, (correct, known & ~correct, ~known)):
            lines[kind].set_segments(ends[which])
        dots.set_data(*ends.reshape(-1, 2).T)
        distances = np.linalg.norm(found.reference[:, None] - found.reference, axis=-1)
        np.fill_diagonal(distances, np.inf)
        spacing = distances.min(axis=1).mean() if len(found) > 1 else 0.0
        return (
            f"{matcher}: {len(found)} matches, {correct.sum()} correct, {(known & ~correct).sum()} wrong, "
            f"{(~known).sum()} without ground truth; mean distance to the nearest match {spacing:.1f} patches."
        )

    controls = {
        "matcher": common.choice("matcher", ["cyclical", *MATCHERS]), "k": common.slider("K", 5, 100, 50, 5),
        "kmeans": common.load_package().Checkbox(value=True, description="k-means on the best 2K", indent=False),
    }  # fmt: skip
    return interactive_figure(figure, controls, update, "Two objects and lines between matched patches.")
