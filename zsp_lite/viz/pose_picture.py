"""One picture of an estimated pose: the reference in the target views, and where the cameras are,
seen from above."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Wedge

from zsp_lite.alignment import Sim3
from zsp_lite.data.azimuths import azimuths, ground_axes
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import ON_OBJECT
from zsp_lite.errors import InputError
from zsp_lite.metrics import vector_angle
from zsp_lite.points import world_cloud
from zsp_lite.scans.pair_result import PairResult
from zsp_lite.viz import plots

_OTHERS = 4  # number of target views beside the chosen one
_POINTS = 3000  # largest number of the target's points in the drawing from above
# Reach of the object in the drawing from above; the cameras are on or inside a circle of radius 1.
_OBJECT = 0.45


def pose_picture(result: PairResult, solver: str) -> Figure:
    """Show the reference, the target and the reference's points in the target views, and the
    cameras from above.

    The colour of a point is its position along the reference object.
    """
    estimate = result.estimates[solver]
    chosen = estimate.view
    frames = [view.frame for view in estimate.target_views]
    reference = estimate.reference_view

    # The views and their titles.
    used = np.flatnonzero(np.isfinite(estimate.view_scores))  # unusable views have no score
    others = used[used != chosen]
    spaced = np.linspace(0, len(others), min(_OTHERS, len(others)), endpoint=False)
    shown = [chosen, *others[spaced.astype(int)]]
    names = [f"view {number + 1}" for number in range(len(frames))]
    if solver == "paper":
        names = [f"{name}, score {score:.1f}" for name, score in zip(names, estimate.view_scores)]
    titles = ["reference", f"target {names[chosen]}", f"reference in view {chosen + 1}"]
    titles += [f"in {names[view]}" for view in shown[1:]]
    titles.append("seen from above")
    images = [reference.frame.rgb, frames[chosen].rgb]
    images += [plots.pale(frames[view].rgb) for view in shown]
    # A white image holds the place of the drawing from above, which removes it.
    images.append(np.full_like(images[0], 255))
    figure, axes = plots.show_images(images, titles, columns=4, size=2.5)
    figure.set_figheight(figure.get_figheight() + 0.4)  # inches, for the legend

    # The outline of the mask at the centres of pixels, and the reference's points in each view.
    mask = frames[chosen].mask
    if mask is not None:
        rows = np.arange(mask.shape[0]) + 0.5
        columns = np.arange(mask.shape[1]) + 0.5
        axes[1].contour(columns, rows, mask, [ON_OBJECT], colors=["white"], linewidths=1.5)
    # Dense, and without axes, which have `names`.
    cloud = plots.object_cloud(reference, most=20000)
    cameras = [frames[view].camera for view in shown]
    plots.draw_moved_cloud(axes[:1], [reference.frame.camera], cloud, [Sim3.identity()], names=None)
    plots.draw_moved_cloud(axes[2:], cameras, cloud, estimate.propagate(cameras), names=None)

    # Seen from above.
    target_cloud = world_cloud(result.targets)[0]
    if not len(target_cloud):
        raise InputError(
            "no depth is known on the target object, expected some for a picture of the pose"
        )
    target_cameras = {int(view) + 1: frames[view].camera for view in used}
    # The reference camera is the origin of its own frame.
    viewpoint = estimate.target_camera.to_world(estimate.sim3.t)
    moved_cloud = estimate.target_camera.to_world(estimate.sim3.apply(cloud))
    _draw_from_above(axes[-1], target_cameras, chosen + 1, viewpoint, target_cloud, moved_cloud)
    figure.legend(
        *axes[-1].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False
    )
    return figure


def _draw_from_above(
    axis: Axes,
    cameras: Mapping[int, Camera],
    chosen: int,
    viewpoint: Float[np.ndarray, "3"],
    target: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
) -> None:
    """Draw world points of the target (grey) and of the reference, the arc of the target cameras
    and its gap, these cameras by their numbers, and below a star for the reference camera, which is
    at the `viewpoint`."""
    centre = np.median(target, axis=0)
    # Unit vectors (n + 1, 3) from the target to the cameras, to that of the reference last.
    offsets = np.stack([*(camera.centre for camera in cameras.values()), viewpoint]) - centre
    directions = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    angles = vector_angle(directions[:-1], directions[-1])
    nearest = list(cameras)[angles.argmin()]

    # The axes of the ground, turned so that the reference camera is below.
    axes = ground_axes([*cameras.values()])
    x, y = axes @ directions[-1]
    turn = -np.pi / 2 - np.arctan2(y, x)
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ axes
    *places, reference_place = directions @ axes.T  # (x, y) in the drawing

    # The widest gap between neighbours on the circle, in degrees. The azimuth of a camera right
    # above the object is NaN.
    around = azimuths([*cameras.values()], centre)
    around = np.sort(around[~np.isnan(around)] + np.degrees(turn))
    begin = 0.0
    end = 360.0
    if len(around):
        following = np.append(around[1:], around[0] + 360)
        widest = (following - around).argmax()
        begin = around[widest]
        end = following[widest]
    axis.images[0].remove()  # the white image that held the place
    gap = f"no target view in these {end - begin:.0f}°"
    axis.add_patch(Wedge((0, 0), 1, begin, end, color="0.5", alpha=0.25, linewidth=0, label=gap))
    arc = np.radians(np.linspace(end, begin + 360, 100))
    span = f"the target views span {360 - end + begin:.0f}°"
    axis.plot(np.cos(arc), np.sin(arc), color=plots.BLUE, linewidth=4, label=span)
    step = -(-len(target) // _POINTS)  # rounded up
    flat = [(points - centre) @ axes.T for points in (target[::step], reference)]
    # Nine tenths of the target's points are within `_OBJECT`.
    scale = _OBJECT / np.quantile(np.linalg.norm(flat[0], axis=1), 0.9)
    for points, colours in zip(flat, ("0.6", plots.coordinate_colours(reference))):
        # Points beyond nine tenths of the cameras' circle would cover their marks.
        inside = np.linalg.norm(scale * points, axis=1, keepdims=True) < 0.9
        axis.scatter(*np.where(inside, scale * points, np.nan).T, s=4, c=colours, linewidths=0)

    # The cameras are on a circle of radius 1, their numbers outside.
    axis.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), aspect="equal")
    for number, place in zip(cameras, places):
        colour = plots.CHOSEN if number == chosen else plots.BLUE
        axis.plot(*place, "o", color=colour, markersize=11, markeredgecolor="white")
        axis.text(
            *(1.23 * place),
            str(number),
            color=colour,
            ha="center",
            va="center",
            fontsize=11,
            weight="bold",
            zorder=4,
        )
    axis.plot(
        *reference_place,
        "*",
        color=plots.VERMILLION,
        markersize=20,
        markeredgecolor="white",
        label=f"reference under this pose, {angles.min():.0f}° from view {nearest}",
    )
