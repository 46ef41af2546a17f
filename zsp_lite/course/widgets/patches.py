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
    start: tuple[int, int] = (14, 14),
) -> Widget:
    """Show how similar one patch is to all patches of the target, its nearest neighbour (a dot) and
    its partner, the true match (a star).

    Args:
        reference: Image of the reference.
        target: Image of the target.
        sims: Similarities of all pairs of patches, by the name of their kind.
        cells: Partner (row, col) of each reference patch, as of `ground_truth_matches`.
        valid: Whether a reference patch has a partner.
        start: The patch (row, col) at which the widget opens.
    """
    grid = valid.shape
    figure, axes = plots.show_images(
        [reference, target], ["reference", "similarity to the patch u"], size=3.2
    )
    figure.set_figheight(4)  # space for the colour bar
    axes[0].set_anchor("N")
    shown = plots.overlay_map(
        axes[1],
        np.zeros(grid),
        alpha=0.5,
        limits=(0, 1),
        label="cosine; dot: nearest neighbour, star: partner",
    )

    @redrawing
    def mark(cell: tuple[int, int], nearest: tuple[int, int]) -> list[Artist]:
        drawn = plots.outline_patch(
            axes[0], cell, grid, label="u", linewidth=2, path_effects=plots.BORDER
        )
        if valid[cell]:
            drawn += plots.circle_patch(axes[1], cells[cell], grid, "*")
        return drawn + plots.circle_patch(axes[1], nearest, grid)  # the dot lies on the star

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
        true = "its partner is not visible"
        if valid[row, col]:
            true_row, true_col = cells[row, col]
            distance = np.abs(np.subtract(nearest, cells[row, col])).max()
            true = f"partner ({true_row}, {true_col}), distance {distance} patches"
        return (
            f"{kind}: nearest neighbour {nearest}, cosine {similar[nearest]:.2f}; {true}. Of the "
            f"{valid.sum()} patches with a partner, {share_correct(kind):.0%} have their nearest "
            "neighbour within one patch of it."
        )

    controls = patch_sliders(grid, start)
    controls["kind"] = load_package().Dropdown(options=list(sims), description="similarity")
    alt = "A patch of the reference; its similarities, nearest neighbour and partner in the target."
    return interactive_figure(figure, controls, update, alt)
