"""Pictures of the lesson on hypotheses: a curve above what it measures, a graph of objects."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsp_lite.data.co3d import Co3D
from zsp_lite.viz.category_sheet import nearest_crop
from zsp_lite.viz.plots import GREEN, VERMILLION, draw_image

# In `show_graphs`, where pictures stand on a circle of radius 1.
_PICTURE = 0.34  # half the width of a picture
_ENDS = 0.42  # distance of the ends of arrows from the middle of a picture
# Colour, line and label of right answers, of wrong ones, and where none fits.
_ARROWS = {
    True: (GREEN, "-", "right answer"),
    False: (VERMILLION, "--", "wrong answer"),
    None: ("0.6", ":", ""),
}


def curve_above_pictures(
    curve: tuple[np.ndarray, np.ndarray],
    pictures: Mapping[float, np.ndarray],
    title: str,
    **labels: Any,
) -> tuple[Figure, list[Axes]]:
    """Show a curve (x, y) with dots at some x, and below it one picture for each of these x.

    `title` is formatted with x; `labels` is what `Axes.set` takes. Returns the figure and the axes
    of the pictures.
    """
    places = list(pictures)
    figure, axes = plt.subplot_mosaic(
        [["curve"] * len(places), places],
        figsize=(7.4, 5.2),
        layout="constrained",
        height_ratios=(1, 1.15),
    )
    above = axes.pop("curve")
    above.plot(*curve)
    above.plot(places, np.interp(places, *curve), "o", color=VERMILLION, markersize=9)
    above.set(**labels)
    for place, picture in pictures.items():
        axes[place].set_axis_off()
        axes[place].set_title(title.format(place), fontsize=10)
        draw_image(axes[place], picture)
    return figure, [axes[place] for place in places]


def show_graphs(
    graphs: Mapping[str, tuple[Mapping[str, np.ndarray], Mapping[tuple[str, str], bool | None]]],
) -> Figure:
    """Show for each title named pictures on a circle, with arrows between pairs of names: True is
    green, False red and dashed, None grey and dotted."""
    size = (4.1 * len(graphs), 4.4)
    figure, axes = plt.subplots(1, len(graphs), figsize=size, layout="constrained", squeeze=False)
    for axis, (title, (pictures, arrows)) in zip(axes.flat, graphs.items()):
        # The first picture is at the upper left.
        angles = np.pi * (0.75 + 2 * np.arange(len(pictures)) / len(pictures))
        centres = dict(zip(pictures, np.column_stack([np.cos(angles), np.sin(angles)])))
        for name, picture in pictures.items():
            x, y = centres[name]
            box = (x - _PICTURE, x + _PICTURE, y - _PICTURE, y + _PICTURE)
            axis.imshow(picture, extent=box, zorder=2)
            axis.text(x, y - _PICTURE, name, ha="center", va="top", fontsize=9, parse_math=False)
        for (start, end), right in arrows.items():
            along = centres[end] - centres[start]
            gap = _ENDS * along / np.linalg.norm(along)
            colour, line, _ = _ARROWS[right]
            # Curved, so that two opposite arrows can be told apart.
            style = {
                "arrowstyle": "-|>",
                "connectionstyle": "arc3,rad=0.12",
                "mutation_scale": 16,
                "color": colour,
                "linestyle": line,
                "linewidth": 2.2,
            }
            # `annotate` takes the head of the arrow first.
            axis.annotate("", centres[end] - gap, centres[start] + gap, arrowprops=style, zorder=1)
        axis.set(xlim=(-1.1, 1.1), ylim=(-1.15, 1.1), aspect="equal", title=title)
        axis.set_axis_off()
    for colour, line, name in _ARROWS.values():
        axes[0, 0].plot([], [], line, color=colour, label=name)
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def alike(
    dataset: Co3D, category: str, rotations: Mapping[str, np.ndarray], first: str
) -> dict[str, np.ndarray]:
    """Return for each object the crop of the frame that is nearest to the first frame of the object
    `first`.

    `rotations` lead from the objects' worlds to a common frame: if they are right, all objects are
    seen from the same side.
    """
    camera = dataset.camera(dataset.frames(category, first)[0]).R
    pictures = {}
    for name, rotation in rotations.items():
        wanted = camera @ rotations[first].T @ rotation
        pictures[name] = nearest_crop(dataset, dataset.frames(category, name), wanted).rgb
    return pictures
