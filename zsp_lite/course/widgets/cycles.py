"""A widget on matching: the cycle of one patch."""

import numpy as np
from jaxtyping import Float
from torch import Tensor

from zsp_lite.course.widgets.common import Widget, interactive_figure, patch_sliders, redrawing
from zsp_lite.matching import nearest_neighbours
from zsp_lite.views import View
from zsp_lite.viz import plots


def cycle(
    reference: View,
    target: View,
    sim: Float[Tensor, "n1 n2"],
    start: tuple[int, int] = (14, 14),
) -> Widget:
    """Show the cycle of a reference patch u, from its nearest neighbour v in the target back to u'
    (eq. 2); it opens at the patch `start`."""
    grid = reference.features.grid
    values = sim.numpy()
    forth, back = nearest_neighbours(sim)
    titles = ["reference: similarity to v", "target: similarity to u"]
    figure, axes = plots.show_images([reference.frame.rgb, target.frame.rgb], titles, size=3.7)
    maps = [plots.overlay_map(axis, np.zeros(grid), alpha=0.4, limits=(0, 1)) for axis in axes]
    draw = redrawing(plots.draw_cycle)

    def update(row: int, col: int) -> str:
        # Numbers of the patches u, v and u' (w in this code), and their cells.
        u = row * grid[1] + col
        v = int(forth[u])
        w = int(back[v])
        maps[0].set_data(values[:, v].reshape(grid))
        maps[1].set_data(values[u].reshape(grid))
        cells = (row, col), divmod(v, grid[1]), divmod(w, grid[1])
        draw(axes, cells, grid)
        text = (
            f"u {cells[0]} → v {cells[1]}, cosine {values[u, v]:.2f} → "
            f"u' {cells[2]}, cosine {values[w, v]:.2f}: "
            f"d(u, u') = {np.hypot(*np.subtract(cells[0], cells[2])):.1f} patches"
        )
        stops = zip(("u", "v", "u'"), cells, (reference, target, reference))
        off = [name for name, cell, view in stops if not view.foreground[cell]]
        if off:
            text += f"; {', '.join(off)} not on the foreground, so the distance is infinite"
        return f"{text}."

    alt = "A solid arrow from the patch u to its nearest neighbour v, a dashed one from v to u'."
    return interactive_figure(figure, patch_sliders(grid, start, " of u"), update, alt)
