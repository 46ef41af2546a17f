"""One picture of an estimated pose: the reference in the target views, and where the cameras are, seen from above."""

from collections.abc import Mapping
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Wedge

from zsp_lite.data.cameras import Camera, azimuths, ground_axes, view_span
from zsp_lite.data.frames import ON_OBJECT
from zsp_lite.errors import InputError
from zsp_lite.estimates import PairResult
from zsp_lite.points import world_cloud
from zsp_lite.viz.plots import BLUE, CHOSEN, VERMILLION, coordinate_colours, draw_image, draw_points

_OTHERS = 5  # target views that are shown beside the chosen one
_POINTS = 1500
_WIDTH = 10.0  # of the picture, inches
_OBJECT = 0.45  # reach of the object in the drawing from above; the cameras are on or inside a circle of radius 1


@dataclass(frozen=True, eq=False)
class Coverage:
    """Directions from the target object to the cameras, seen from above with the reference camera below."""

    targets: Float[np.ndarray, "n 2"]  # unit vectors towards the target cameras, without their vertical part
    numbers: tuple[int, ...]  # number of each of these target views, counted from 1
    reference: Float[np.ndarray, "2"]  # the same of the reference camera under the estimated pose
    span: float  # angle that the target views span around the object in degrees (see `view_span`)
    gap: tuple[float, float]  # no target camera is between these angles (degrees, counter-clockwise from the right)
    nearest: int  # number of the target view closest to the reference viewpoint
    angle: float  # angle in degrees between the directions of that view and of the reference
    centre: Float[np.ndarray, "3"]  # middle of the target object in the world
    axes: Float[np.ndarray, "2 3"]  # the drawing's axes to the right and up in the world


def coverage(
    cameras: Mapping[int, Camera], reference: Float[np.ndarray, "3"], centre: Float[np.ndarray, "3"]
) -> Coverage:
    """Compute where the target cameras, by number, and the centre of the reference camera are around an object."""
    numbers, cameras = tuple(cameras), list(cameras.values())
    places = np.stack([*(camera.centre for camera in cameras), reference])
    directions = (places - centre) / np.linalg.norm(places - centre, axis=1, keepdims=True)
    axes = ground_axes(cameras)
    x, y = axes @ directions[-1]
    turn = -np.pi / 2 - np.arctan2(y, x)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ axes
    around = azimuths(cameras, centre)
    around = np.sort(around[~np.isnan(around)] + np.degrees(turn))
    gap = (0.0, 360.0)
    if len(around):
        ends = np.append(around[1:], around[0] + 360)
        widest = int((ends - around).argmax())
        gap = float(around[widest]), float(ends[widest])
    angles = np.degrees(np.arccos((directions[:-1] @ directions[-1]).clip(-1, 1)))
    return Coverage(
        directions[:-1] @ axes.T, numbers, directions[-1] @ axes.T, view_span(cameras, centre), gap,
        numbers[int(angles.argmin())], float(angles.min()), centre, axes,
    )  # fmt: skip


def pose_picture(result: PairResult, solver: str) -> Figure:
    """Show the reference, the target and the reference's points in the target views, and the cameras from above.

    The colour of a point is its position along the reference object.
    """
    estimate = result.estimates[solver]
    views, chosen = estimate.target_views, estimate.view
    used = np.flatnonzero(np.isfinite(estimate.view_scores))  # others were left out
    target_cloud, reference_cloud = world_cloud(result.targets)[0], world_cloud([result.reference])[0]
    if not len(target_cloud) or not len(reference_cloud):
        raise InputError("no depth is known on the object, expected some for a picture of the pose")
    # The reference camera is the origin of its own frame.
    reference_place = estimate.target_camera.to_world(estimate.sim3.t)
    cameras = {int(view) + 1: result.targets[view].camera for view in used}
    seen = coverage(cameras, reference_place, np.median(target_cloud, axis=0))
    titles = [f"view {number + 1}" for number in range(len(views))]
    if solver == "paper":
        titles = [f"{title}, score {score:.1f}" for title, score in zip(titles, estimate.view_scores)]
    used = used[used != chosen]
    shown = min(_OTHERS, len(used))
    others = used[np.arange(shown) * len(used) // max(shown, 1)]
    figure, (reference, target, moved), small, drawing, key = _panels(shown)
    frame = views[chosen].frame
    _show(reference, estimate.reference_view.frame.rgb, "reference")
    _show(target, frame.rgb, f"target {titles[chosen]}")
    _show(moved, frame.rgb, f"reference in target view {chosen + 1}")
    if frame.mask is not None:
        target.set_title(f"target {titles[chosen]}, mask outlined", fontsize=10)
        columns, rows = (np.arange(size) + 0.5 for size in frame.mask.shape[::-1])
        target.contour(columns, rows, frame.mask, [ON_OBJECT], colors=["white"], linewidths=1.5)
    for view, axis in zip(others, small):
        _show(axis, views[view].frame.rgb, f"in {titles[view]}", 9)
    cloud = _some(result.reference.camera.to_camera(reference_cloud))
    colours = coordinate_colours(cloud)
    _draw_points(reference, estimate.reference_view.frame.camera, cloud, colours, 5)
    crops = [views[view].frame.camera for view in (chosen, *others)]
    for axis, camera, pose in zip((moved, *small), crops, estimate.propagate(crops)):
        _draw_points(axis, camera, pose.apply(cloud), colours, 5 if axis is moved else 3)
    drawing.set_title("seen from above: target grey, reference coloured", fontsize=10)
    _draw_gap(drawing, seen)
    nearest = f"reference under this pose, {seen.angle:.0f}° from view {seen.nearest}"
    draw_cameras(drawing, seen, chosen + 1, nearest)
    moved_cloud = estimate.target_camera.to_world(estimate.sim3.apply(cloud))
    _draw_from_above(drawing, seen, _some(target_cloud), moved_cloud, colours)
    key.legend(*drawing.get_legend_handles_labels(), loc="center left", fontsize=11, frameon=False, labelspacing=1)
    return figure


def _panels(others: int) -> tuple[Figure, list[Axes], list[Axes], Axes, Axes]:
    """Lay out three large panels, small ones for the other views, and the drawing from above with its key.

    A single other view is beside the drawing.
    """
    in_row = max(others, 4)
    heights = [_WIDTH / 3, _WIDTH / in_row, 0.3 * _WIDTH] if others > 1 else [_WIDTH / 3, 0.3 * _WIDTH]
    figure = plt.figure(figsize=(_WIDTH, sum(heights) + 0.25 * len(heights)), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.06)
    parts = figure.subfigures(len(heights), 1, height_ratios=heights)
    large = list(parts[0].subplots(1, 3))
    small = list(parts[1].subplots(1, in_row)) if others > 1 else []
    ratios = (3, 3, 4) if others == 1 else (2, 3)
    *beside, drawing, key = parts[-1].subplots(1, len(ratios), width_ratios=ratios)
    for axis in figure.axes:
        axis.set_axis_off()
    return figure, large, [*small, *beside], drawing, key


def draw_cameras(axis: Axes, seen: Coverage, chosen: int, reference: str = "reference") -> None:
    """Draw the target cameras with their numbers, and a star for the reference camera, around the object."""
    axis.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), aspect="equal")
    for number, place in zip(seen.numbers, seen.targets):
        style = {"color": CHOSEN if number == chosen else BLUE}
        axis.plot(*place, "o", markersize=11, markeredgecolor="white", **style)
        axis.text(*(1.23 * place), str(number), ha="center", va="center", fontsize=11, weight="bold", zorder=4, **style)
    axis.plot(*seen.reference, "*", color=VERMILLION, markersize=20, markeredgecolor="white", label=reference)


def _draw_gap(axis: Axes, seen: Coverage) -> None:
    """Shade the largest arc without a target camera, and draw the arc that the cameras span."""
    begin, end = seen.gap
    several = len(seen.numbers) > 1
    axis.add_patch(Wedge((0, 0), 1, begin, end, color="0.5", alpha=0.25, linewidth=0))
    empty = f"no target view in these {360 - seen.span:.0f}°" if several else "only one target view"
    axis.plot([], [], "s", color="0.5", alpha=0.25, markersize=14, label=empty)
    if several:
        axis.add_patch(Arc((0, 0), 2, 2, theta1=end, theta2=begin + 360, color=BLUE, linewidth=4))
        axis.plot([], [], color=BLUE, linewidth=4, label=f"the target views span {seen.span:.0f}°")


def _draw_from_above(axis: Axes, seen: Coverage, target: np.ndarray, moved: np.ndarray, colours: np.ndarray) -> None:
    """Draw the world points of the target, and of the reference under the pose, in the middle of the circle."""
    flat = [(points - seen.centre) @ seen.axes.T for points in (target, moved)]
    scale = _OBJECT / np.quantile(np.linalg.norm(flat[0], axis=1), 0.9)
    for points, colour in zip(flat, ("0.6", colours)):
        points, colour = points * scale, np.broadcast_to(colour, len(points)) if isinstance(colour, str) else colour
        inside = np.linalg.norm(points, axis=1) < 0.9
        axis.scatter(*points[inside].T, s=4, c=colour[inside], linewidths=0)


def _draw_points(axis: Axes, camera: Camera, points: np.ndarray, colours: np.ndarray, size: float) -> None:
    """Draw points with a white outline, to be visible on dark images."""
    draw_points(axis, camera, points, "white", size=3 * size)
    draw_points(axis, camera, points, colours, size=size)


def _some(points: np.ndarray) -> np.ndarray:
    """Draw a random subset of points."""
    return points[np.random.default_rng(0).permutation(len(points))[:_POINTS]]


def _show(axis: Axes, image: np.ndarray, title: str, font: float = 10) -> None:
    draw_image(axis, image)
    axis.set_title(title, fontsize=font)
