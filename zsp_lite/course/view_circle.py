"""A picture of the lesson on the best view: scores of views around an object."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from zsp_lite.viz.plots import BLUE, CHOSEN, draw_image, mark

_RINGS = (-45, -35, -25)  # scores with a circle
_EVERY = 3  # views from one thumbnail to the next
# As fractions of the figure's width:
_THUMBNAIL = 0.17  # width of a thumbnail
_RADIUS = 0.395  # distance of the thumbnails from the middle


def show_view_circle(
    reference: np.ndarray,
    images: Sequence[np.ndarray],
    turns: Float[np.ndarray, " n"],
    scores: Float[np.ndarray, " n"],
) -> Figure:
    """Show the scores of views as radius over their turn from the reference.

    A thumbnail with its score stands outside at every third view, the one with the best score among
    them, and the reference in a corner.

    Args:
        reference: Image of the reference.
        images: Images of the views.
        turns: Angle from the reference to each view, degrees, of both signs.
        scores: Score of each view.

    Returns:
        The figure, with 0 degrees at the top and 180 at the bottom.
    """
    figure = plt.figure(figsize=(7, 7))
    circle = figure.add_axes((0.25, 0.25, 0.5, 0.5), projection="polar")
    # A score of -52 is in the middle, one of -22 at the rim: the lesson's scores are between.
    circle.set(theta_zero_location="N", theta_direction=-1, ylim=(-52, -22))
    circle.set_thetagrids(range(0, 360, 90), ["turn 0°", "+90°", "180°", "−90°"])
    # The rings have their labels at the view whose score is farthest from all of them.
    away = np.abs(scores[:, None] - _RINGS).min(axis=1)
    circle.set_rgrids(_RINGS, ["score −45", "−35", "−25"], turns[away.argmax()], fontsize=8)

    order = np.argsort(turns)
    closed = np.append(order, order[0])
    curve = np.radians(turns[closed]), scores[closed]
    circle.fill(*curve, color=BLUE, alpha=0.2)
    circle.plot(*curve, "o-", color=BLUE, markersize=5)
    place = scores[order].argmax()
    best = order[place]
    circle.plot(np.radians(turns[best]), scores[best], "o", color=CHOSEN, markersize=12)

    for view in order[place % _EVERY :: _EVERY]:
        angle = np.radians(turns[view])
        centre = 0.5 + _RADIUS * np.array([np.sin(angle), np.cos(angle)])
        axis = figure.add_axes((*(centre - _THUMBNAIL / 2), _THUMBNAIL, _THUMBNAIL))
        draw_image(axis, images[view])
        axis.set_axis_off()
        axis.set_title(f"{scores[view]:.1f}", fontsize=9, pad=2)
        if view == best:
            mark(axis, "wins", size=8)
    corner = figure.add_axes((0, 0.855, 0.12, 0.12))
    draw_image(corner, reference)
    corner.set_axis_off()
    corner.set_title("reference", fontsize=9, pad=2)
    return figure
