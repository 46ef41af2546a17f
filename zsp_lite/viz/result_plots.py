"""Figures of results: moved points, matches, the views around their object, and a table of accuracies.

`size` is the width of a panel in inches.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Real
from matplotlib.figure import Figure

from zsp_lite.estimates import PoseEstimate
from zsp_lite.viz import plots

_POINTS = 1500  # drawn of a cloud
_RING, _PICTURE = 1.22, 0.26  # of `view_ring`: distance of the pictures' centres, and half their width


def moved_points(estimates: Mapping[str, PoseEstimate], size: float = 3.4) -> Figure:
    """Show the reference under its own points, and for each estimate its target view under the moved points.

    The colour of a point is its position along the reference object.
    """
    reference = next(iter(estimates.values())).reference_view
    cloud = plots.object_cloud(reference, most=_POINTS)
    colours = plots.coordinate_colours(cloud)
    chosen = [estimate.target_views[estimate.view].frame for estimate in estimates.values()]
    pictures = [reference.frame.rgb, *(frame.rgb for frame in chosen)]
    figure, axes = plots.show_images(pictures, ["reference, its own points", *estimates], size=size)
    plots.draw_points(axes[0], reference.frame.camera, cloud, colours)
    for axis, frame, estimate in zip(axes[1:], chosen, estimates.values()):
        plots.draw_points(axis, frame.camera, estimate.sim3.apply(cloud), colours)
    return figure


def matches_of_estimate(estimate: PoseEstimate, size: float = 3.6) -> Figure:
    """Show the matches between the reference and the chosen target view; see `plots.draw_matches` for the lines."""
    views = estimate.reference_view, estimate.target_views[estimate.view]
    pictures, titles = [view.frame.rgb for view in views], ("reference", "chosen target")
    figure, axes = plots.show_images(pictures, titles, size=size)
    plots.draw_matches(axes, plots.match_pixels(views, estimate.matches), estimate.inliers)
    return figure


def view_ring(
    reference: np.ndarray,
    targets: Sequence[np.ndarray],
    places: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "1 2"]],
    scores: Real[np.ndarray, " n"],
    angles: Real[np.ndarray, " n"],
) -> Figure:
    """Show target views around their object as seen from above, each with its score and its angle to the reference.

    The ring is turned so that the side of the reference is below. The view of highest score has a thick frame. `places`
    are the directions of the target cameras and of the reference camera, from `viewpoints_from_above`.
    """
    side = places[1][0]
    turned = places[0] @ np.stack([side[[1, 0]] * [-1, 1], -side], axis=1)
    middles = np.vstack([_RING * turned, [0, 0]])
    low, high = middles.min(axis=0) - _PICTURE - 0.1, middles.max(axis=0) + _PICTURE + [0.1, 0.22]  # titles above
    figure = plt.figure(figsize=(6.6, 6.6 * (high - low)[1] / (high - low)[0]))
    axis = figure.add_axes([0, 0, 1, 1], xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axis.set_axis_off()
    colours = plt.get_cmap("cividis")((scores - scores.min()) / max(np.ptp(scores), 1e-9))
    axis.text(0, 0.05, "object", ha="center", va="center", color="0.3")
    pictures = [((0, -0.56), 0.2, reference, "reference", plots.BLUE, 3)]
    for i, (place, image) in enumerate(zip(turned, targets)):
        axis.plot(*np.transpose([0.2 * place, place]), color=colours[i], linewidth=5, zorder=0)
        title = f"{i + 1}: {scores[i]:.1f}, {angles[i]:.0f}°"
        if i == np.argmax(scores):
            pictures.append((_RING * place, _PICTURE, image, f"{title} chosen", plots.CHOSEN, 6))
        else:
            pictures.append((_RING * place, _PICTURE, image, title, colours[i], 4))
    for (x, y), half, image, title, colour, width in pictures:
        picture = axis.inset_axes([x - half, y - half, 2 * half, 2 * half], transform=axis.transData)
        picture.imshow(image)
        picture.set_title(title, fontsize=10, pad=5)
        picture.set(xticks=[], yticks=[])
        picture.spines[:].set(color=colour, linewidth=width)
    return figure


def category_heatmap(
    cells: Real[np.ndarray, "rows categories"], rows: Sequence[str], categories: Sequence[str], label: str
) -> Figure:
    """Draw percentages of rows by category as numbers on a colour map from 0 to 100."""
    size = 1.6 + 0.47 * len(categories), 0.9 + 0.5 * len(rows)
    figure, axis = plt.subplots(figsize=size, layout="constrained")
    image = axis.imshow(cells, cmap="cividis", vmin=0, vmax=100, aspect="auto")
    for (i, j), value in np.ndenumerate(cells):
        colour = "white" if value < 55 else "black"
        axis.text(j, i, f"{value:.0f}", ha="center", va="center", fontsize=9, color=colour)
    axis.set_xticks(range(len(categories)), categories, rotation=55, ha="right", fontsize=9)
    axis.set_yticks(range(len(rows)), rows, fontsize=9)
    figure.colorbar(image, label=label)
    return figure
