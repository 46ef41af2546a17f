"""A picture of the lesson on the best view: scores of views around an object."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from zsp_lite.viz.plots import BLUE, CHOSEN, draw_image, mark

_LIMITS = (-52, -22)  # scores in the middle and at the rim
_EVERY = 3  # views from one thumbnail to the next
_THUMBNAIL = 0.17  # width and height, of the figure's
_RING = 0.395  # distance of the thumbnails from the middle, of the figure's width


def show_view_circle(
    reference: np.ndarray,
    images: Sequence[np.ndarray],
    turns: Float[np.ndarray, " n"],
    scores: Float[np.ndarray, " n"],
) -> Figure:
    """Show scores of views as radius over their turn from the reference, which is in the middle.

    `turns` are the angles from the reference to the views in degrees, of both signs; 0 is at the
    top. Every third view has a thumbnail with its score, the best one among them.
    """
    figure = plt.figure(figsize=(7, 7))
    circle = figure.add_axes((0.25, 0.25, 0.5, 0.5), projection="polar")
    circle.set(theta_zero_location="N", theta_direction=-1, ylim=_LIMITS)
    circle.set_xticks(np.radians(range(0, 360, 90)), ["0°", "90°", "180°", "90°"])
    circle.set_yticks(np.arange(-40, _LIMITS[1], 5))
    circle.tick_params(axis="y", labelsize=8)

    order = np.argsort(turns)
    closed = np.append(order, order[0])
    circle.fill(np.radians(turns[closed]), scores[closed], color=BLUE, alpha=0.2)
    circle.plot(np.radians(turns[closed]), scores[closed], "o-", color=BLUE, markersize=5)
    best = int(scores.argmax())
    circle.plot(np.radians(turns[best]), scores[best], "o", color=CHOSEN, markersize=12)

    place = order.tolist().index(best)
    for view in order[place % _EVERY :: _EVERY]:
        angle = np.radians(turns[view])
        centre = 0.5 + _RING * np.array([np.sin(angle), np.cos(angle)])
        axis = figure.add_axes((*(centre - _THUMBNAIL / 2), _THUMBNAIL, _THUMBNAIL))
        draw_image(axis, images[view])
        axis.set_axis_off()
        axis.set_title(f"{scores[view]:.1f}", fontsize=9, pad=2)
        if view == best:
            mark(axis, "wins", size=8)
    middle = figure.add_axes((0.435, 0.435, 0.13, 0.13))
    draw_image(middle, reference)
    middle.set_axis_off()
    middle.set_title("reference", fontsize=8, pad=1)
    return figure
