"""Figures of results: moved points and matches.

`size` is the width of a panel in inches.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from zsp_lite.alignment import Sim3
from zsp_lite.estimates import PoseEstimate
from zsp_lite.viz import plots

_POINTS = 1500  # drawn of a cloud


def moved_points(
    estimates: Mapping[str, PoseEstimate],
    size: float = 3.4,
    columns: int | None = None,
    names: Sequence[str] | None = None,
) -> Figure:
    """Show the reference under its own points, and for each estimate its target view under the moved points.

    The colour of a point is its position along the reference object. With `names`, the axes of the reference camera are
    drawn as well.
    """
    reference = next(iter(estimates.values())).reference_view
    cloud = plots.object_cloud(reference, most=_POINTS)
    frames = [reference.frame, *(estimate.target_views[estimate.view].frame for estimate in estimates.values())]
    titles = ["reference, its own points", *estimates]
    figure, panels = plots.show_images([frame.rgb for frame in frames], titles, columns, size)
    moves = [Sim3(1.0, np.eye(3), np.zeros(3)), *(estimate.sim3 for estimate in estimates.values())]
    plots.draw_moved_cloud(panels, [frame.camera for frame in frames], cloud, moves, names, size=5)
    return figure


def matches_of_estimate(estimate: PoseEstimate, size: float = 3.6) -> Figure:
    """Show the matches between the reference and the chosen target view; see `plots.draw_matches` for the lines."""
    views = estimate.reference_view, estimate.target_views[estimate.view]
    titles = "reference", "chosen target"
    figure, axes = plots.show_images([view.frame.rgb for view in views], titles, size=size)
    plots.draw_matches(axes, plots.match_pixels(views, estimate.matches), estimate.inliers)
    return figure
