"""Pictures of the lessons: a curve above what it measures, and a graph of objects."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch

from zsp_lite.viz.plots import GREEN, VERMILLION, draw_image

# Radii of the circle of pictures, of a picture, and of the arrows' ends, in axis units.
_CIRCLE = 1.0
_PICTURE = 0.3
_ENDS = 0.36
_ARROWS = {True: (GREEN, "-"), False: (VERMILLION, "--"), None: ("0.6", ":")}


def curve_above_pictures(
    curve: tuple[np.ndarray, np.ndarray],
    pictures: Mapping[float, np.ndarray],
    title: str = "x = {:.0f}",
    **labels: str,
) -> tuple[Figure, list[Axes]]:
    """Show a curve (x, y) with dots at some x, and below it one picture for each of these x.

    `title` is formatted with x; `labels` is what `Axes.set` takes. Returns the figure and the axes
    of the pictures.
    """
    places = list(pictures)
    figure = plt.figure(figsize=(7.4, 5.2), layout="constrained")
    grid = figure.add_gridspec(2, len(places), height_ratios=(1, 1.15))
    above = figure.add_subplot(grid[0, :])
    above.plot(*curve)
    above.plot(places, np.interp(places, *curve), "o", color=VERMILLION, markersize=9)
    above.set(**labels)
    axes = []
    for column, (place, picture) in enumerate(pictures.items()):
        axis = figure.add_subplot(grid[1, column])
        axis.set_axis_off()
        axis.set_title(title.format(place), fontsize=10)
        draw_image(axis, picture)
        axes.append(axis)
    return figure, axes


def show_graphs(
    pictures: Mapping[str, np.ndarray],
    graphs: Mapping[str, Mapping[tuple[str, str], bool | None]],
    turned: Mapping[str, Sequence[str]],
) -> Figure:
    """Show named pictures on a circle with arrows between them, once for each graph by its title.

    An arrow is green if it is true, red and dashed if it is false, grey and dotted if it is None.
    `turned` has the names of the pictures of each graph that are marked as wrong.
    """
    size = (3.9 * len(graphs), 4.1)
    figure, axes = plt.subplots(1, len(graphs), figsize=size, layout="constrained")
    angles = np.pi / 4 + 2 * np.pi * np.arange(len(pictures)) / len(pictures)
    centres = dict(zip(pictures, _CIRCLE * np.column_stack([np.cos(angles), np.sin(angles)])))
    for axis, (title, arrows) in zip(np.atleast_1d(axes), graphs.items()):
        axis.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), aspect="equal", title=title)
        axis.set_axis_off()
        for name, picture in pictures.items():
            x, y = centres[name]
            box = (x - _PICTURE, x + _PICTURE, y - _PICTURE, y + _PICTURE)
            axis.imshow(picture, extent=box, zorder=2)
            if name in turned[title]:
                frame = plt.Rectangle(
                    (box[0], box[2]), 2 * _PICTURE, 2 * _PICTURE, fill=False, zorder=3
                )
                frame.set(edgecolor=VERMILLION, linewidth=4)
                axis.add_patch(frame)
        for (start, end), right in arrows.items():
            axis.add_patch(_arrow(centres[start], centres[end], *_ARROWS[right]))
        axis.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4))
    return figure


def _arrow(start: np.ndarray, end: np.ndarray, colour: str, line: str) -> FancyArrowPatch:
    """Return a curved arrow between the borders of two pictures, so that two opposite ones can be
    told apart."""
    along = (end - start) / np.linalg.norm(end - start)
    return FancyArrowPatch(
        start + _ENDS * along,
        end - _ENDS * along,
        arrowstyle="-|>",
        mutation_scale=16,
        connectionstyle="arc3,rad=0.12",
        color=colour,
        linestyle=line,
        linewidth=2.2,
        zorder=1,
    )
