"""A widget on features: the similarities of one patch."""

from collections.abc import Mapping
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.artist import Artist
from torch import Tensor

from zsp_lite.course.true_matches import correct_matches
from zsp_lite.course.widgets.common import (
    Widget,
    interactive_figure,
    load_package,
    patch_sliders,
    redrawing,
)
from zsp_lite.viz import plots

Image = UInt8[np.ndarray, "height width 3"]


def patch_similarities(
    reference: Image,
    target: Image,
    sims: Mapping[str, Float[Tensor, "n n"]],
    cells: Int[np.ndarray, "h w 2"],
    valid: Bool[np.ndarray, "h w"],
) -> Widget:
    """Show how similar one patch is to all patches of the target, its nearest neighbour and its
    true match.

    `sims` has similarities of all pairs of patches by the name of their kind; `cells` and `valid`
    are those of `ground_truth_matches`.
    """
    grid = valid.shape
    figure, axes = plots.show_images(
        [reference, target], ["reference", "similarity to the patch u"], size=3.2
    )
    figure.set_figheight(4)  # space for the colour bar
    axes[0].set_anchor("N")
    shown = plots.overlay_map(
        axes[1], np.zeros(grid), limits=(0, 1), label="cosine; star: true match"
    )

    @redrawing
    def mark(cell: tuple[int, int], nearest: tuple[int, int]) -> list[Artist]:
        drawn = plots.outline_patch(
            axes[0], cell, grid, label="u", linewidth=2, path_effects=plots.BORDER
        )
        drawn += plots.circle_patch(axes[1], nearest, grid)
        if valid[cell]:
            drawn += plots.circle_patch(axes[1], cells[cell], grid, "*")
        return drawn

    @cache
    def share_correct(kind: str) -> float:
        # Numbers of the nearest neighbours, and their cells (rows, cols, 2).
        numbers = sims[kind].argmax(1).numpy()
        nearest = np.stack(np.divmod(numbers, grid[1]), -1).reshape(*grid, 2)
        return correct_matches(nearest, cells)[valid].mean()

    def update(row: int, col: int, kind: str) -> str:
        similar = sims[kind][row * grid[1] + col].view(grid).numpy()
        nearest = divmod(int(similar.argmax()), grid[1])
        shown.set_data(similar)
        mark((row, col), nearest)
        true = "the true match is not visible"
        if valid[row, col]:
            true_row, true_col = cells[row, col]
            distance = np.abs(np.subtract(nearest, cells[row, col])).max()
            true = f"true match ({true_row}, {true_col}), distance {distance} patches"
        return (
            f"{kind}: nearest neighbour {nearest}, cosine {similar[nearest]:.2f}; {true}. Of the "
            f"{valid.sum()} patches with a true match, {share_correct(kind):.0%} have their "
            "nearest neighbour within one patch of it."
        )

    # It begins at the patch with a true match that is nearest to the middle of all of them.
    known = np.argwhere(valid)
    off_middle = np.abs(known - np.median(known, axis=0)).sum(axis=1)
    middle = tuple(known[off_middle.argmin()].tolist())
    kinds = load_package().Dropdown(options=list(sims), description="similarity")
    controls = {**patch_sliders(grid, middle), "kind": kinds}
    alt = "A patch of the reference, and its nearest neighbour and true match in the target"
    return interactive_figure(figure, controls, update, alt)
