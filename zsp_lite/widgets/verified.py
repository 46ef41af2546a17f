"""Widget on the verified solver: its ranked hypotheses in 3D and in the target views, with the terms of their score."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from zsp_lite.verified import Solution
from zsp_lite.verified.poses import rotation_angles
from zsp_lite.verified.verification import ScoreCoefficients, forward_terms
from zsp_lite.viz.plots import BLUE, ORANGE, draw_image
from zsp_lite.viz.verified import POINT_CLASSES, classify_points, draw_score_contributions, score_contributions
from zsp_lite.widgets.common import Widget, interactive_figure, slider, small_text

if TYPE_CHECKING:
    from zsp_lite.views import View

_MAX_POINTS = 350  # per point cloud in 3D
_LIMIT = 2.2  # of the 3D axes, in standard deviations of the object


def ranked_hypotheses(
    solution: Solution, targets: Sequence["View"], weights: ScoreCoefficients = ScoreCoefficients()
) -> Widget:
    """Show one hypothesis: point clouds in 3D, points in a target view, and the terms of the score."""
    used = sorted(solution.view_order)
    found, scene = solution.hypotheses, solution.scene
    point_terms = forward_terms(scene, solution.poses)
    classes = [classify_points(point_terms, rank) for rank in range(len(found))]
    pixels = (point_terms.projection.pixels * scene.target_maps.pixel_scale[:, None]).numpy()
    clouds = [
        _upright(cloud.numpy())
        for cloud in solution.poses.apply(scene.reference_points[:: max(len(scene.reference_points) // _MAX_POINTS, 1)])
    ]
    differences = rotation_angles(solution.poses.rotation, solution.poses.rotation[:1])[:, 0].numpy()

    figure = plt.figure(figsize=(9, 3.4), dpi=85)
    # The third column is empty: room for the labels of the bars.
    grid = figure.add_gridspec(
        1, 4, width_ratios=(1.15, 1, 0.42, 0.75), left=0.01, right=0.98, bottom=0.16, top=0.9, wspace=0.03
    )
    space, cloud = _clouds(figure, grid[0], solution, clouds[0])
    image_axis = figure.add_subplot(grid[1])
    image_axis.set_axis_off()
    draw_image(image_axis, targets[used[0]].frame.rgb)
    marks = [
        image_axis.scatter([], [], s=14, c=colour, marker=marker, edgecolors="black", linewidths=0.4, label=name)
        for name, (colour, marker) in POINT_CLASSES.items()
    ]
    image_axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=2, fontsize=6.5, frameon=False)
    bar_axis = figure.add_subplot(grid[3])
    parts = [part for one in found for part in score_contributions(one.terms, weights).values()]
    limits = min(0.0, *parts) * 1.1 - 0.1, max(0.0, *parts) * 1.1 + 0.1

    def update(rank: int, view: int, azimuth: int) -> str:
        index, position = rank - 1, solution.view_order.index(used[view - 1])
        one = found[index]
        cloud._offsets3d = tuple(clouds[index].T)
        space.view_init(elev=15, azim=azimuth)
        frame = targets[used[view - 1]].frame
        image_axis.images[0].set_data(frame.rgb)
        corner, shown = np.array(frame.camera.size[::-1]), classes[index][position]
        for point_class, mark in enumerate(marks):
            mark.set_offsets(np.clip(pixels[index, position][shown == point_class], 0, corner))
        counts = np.bincount(shown, minlength=len(marks))
        image_axis.set_title(f"target {used[view - 1] + 1}", fontsize=9)
        bar_axis.clear()
        draw_score_contributions(bar_axis, {f"rank {rank}": one.terms}, weights)
        bar_axis.set(xlim=limits, title=f"score {one.score:.1f}")
        bar_axis.get_legend().remove()
        bar_axis.xaxis.set_major_locator(MaxNLocator(4, integer=True))
        small_text(bar_axis)
        difference = f"{found[0].score - one.score:.1f} nats below the best, {differences[index]:.0f} degrees from it"
        points = ", ".join(f"{count} {name}" for count, name in zip(counts, POINT_CLASSES))
        return (
            f"Hypothesis {rank} of {len(found)}: {difference if index else 'the best'}; score {one.score:.1f}, "
            f"probability {one.confidence:.0%}. Points in target view {used[view - 1] + 1}: {points}."
        )

    controls = {
        "rank": slider("hypothesis", 1, len(found), 1),
        "view": slider("target view", 1, len(used), 1),
        "azimuth": slider("azimuth", -180, 180, -60, 5),
    }
    return interactive_figure(
        figure, controls, update,
        "Left: the points of the reference under a hypothesis and the points of the targets, in 3D. Middle: the same "
        "points in a target view, marked by their visibility. Right: the contribution of each term to the score.",
    )  # fmt: skip


def _clouds(figure: Figure, cell, solution: Solution, moved: np.ndarray):
    """Draw the points of the targets and of the reference; returns the 3D axes and the artist of the reference."""
    space = figure.add_subplot(cell, projection="3d")
    target = solution.scene.target_points.numpy()
    shown = _upright(target[:: max(len(target) // _MAX_POINTS, 1)])
    space.scatter(*shown.T, s=5, c=ORANGE, marker="D", linewidths=0, depthshade=False, label="targets, all views")
    cloud = space.scatter(
        *moved.T, s=7, c=BLUE, marker="o", linewidths=0, depthshade=False, label="reference, transformed"
    )
    span = (-_LIMIT, _LIMIT)
    space.set(xlim=span, ylim=span, zlim=span, xticks=[], yticks=[], zticks=[])
    for axis, name in ((space.xaxis, "right"), (space.yaxis, "forward"), (space.zaxis, "up")):
        axis.set_label_text(name, fontsize=8)
        axis.labelpad = -14
    space.set_box_aspect((1, 1, 1), zoom=1.2)
    space.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=2, fontsize=7, frameon=False, markerscale=2)
    return space, cloud


def _upright(points: np.ndarray) -> np.ndarray:
    """Convert camera axes (right, down, forward) to (right, forward, up)."""
    return points[:, [0, 2, 1]] * [1, 1, -1]
