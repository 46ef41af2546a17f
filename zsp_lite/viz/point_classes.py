"""Points of the verified solver in a view: on a surface, occluded, or in contradiction to the
pose."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int, Real
from matplotlib.figure import Figure

from zsp_lite.verified.verification import PointTerms
from zsp_lite.viz.plots import BLUE, ORANGE, VERMILLION, show_images

# Classes of a projected point, each with its colour and marker.
POINT_CLASSES: dict[str, tuple[str, str]] = {
    "on the surface": (BLUE, "o"),
    "occluded": ("0.75", "."),
    "in free space": (ORANGE, "^"),
    "outside the silhouette": (VERMILLION, "X"),
    "depth unknown": ("white", "s"),
}
# Order in which the classes are drawn, by index: contradictions last, so that nothing covers them.
_DRAWN = (1, 4, 0, 2, 3)


def classify_points(terms: PointTerms, pose: int = 0) -> Int[np.ndarray, "v n"]:
    """Classify each point in each view under one of the poses, as indices into `POINT_CLASSES`.

    A point is on the surface if its surface weight is at least half of what it would be exactly on
    the surface. Points for which no condition holds are behind the surface: occluded.
    """
    distance = terms.projection.silhouette_distance[pose].numpy()
    weight = terms.projection.weight[pose].numpy()
    surface = terms.surface[pose].numpy()
    free_space = terms.free_space[pose].numpy()
    # The first condition that holds decides: outside the silhouette (3), depth unknown (4), on the
    # surface (0), in free space (2); where none holds, occluded (1).
    conditions = [distance > 0, weight <= 0, surface >= weight / 2, free_space > 0]
    return np.select(conditions, [3, 4, 0, 2], default=1)


def show_point_classes(
    images: Sequence[np.ndarray],
    titles: Sequence[str],
    pixels: Sequence[Real[np.ndarray, "n 2"]],
    classes: Sequence[Int[np.ndarray, " n"]],
    columns: int | None = None,
    size: float = 3.0,
) -> Figure:
    """Show points at pixels (x, y) of each image by their class; those outside are drawn at the
    border."""
    figure, axes = show_images(images, titles, columns, size)
    for axis, image, places, point_classes in zip(axes, images, pixels, classes):
        places = np.clip(places, 0, image.shape[1::-1])
        for index in _DRAWN:
            name = list(POINT_CLASSES)[index]
            colour, marker = POINT_CLASSES[name]
            # Points of unknown depth are small: they say nothing about the pose, and are many.
            area = 6 if name == "depth unknown" else 14
            axis.scatter(
                *places[point_classes == index].T,
                s=area,
                c=colour,
                marker=marker,
                edgecolors="black",
                linewidths=0.4,
                label=name,
            )
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=len(POINT_CLASSES),
        fontsize=9,
        handletextpad=0.1,
    )
    return figure
