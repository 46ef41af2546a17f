"""Figures of results: estimated poses and their failures, benchmark runs, pose labels, and one's own captures.

Angles are in degrees, lengths in scene units, accuracies in per cent; `size` is the width of a panel in inches.
"""

from collections.abc import Mapping, Sequence
from itertools import cycle

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float, Real, UInt8
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from zsp_lite.data.frames import Frame, mask_to_bbox
from zsp_lite.estimates import PoseEstimate
from zsp_lite.views import View
from zsp_lite.viz import plots
from zsp_lite.viz.plots import BLUE, ORANGE, VERMILLION

_HALF_WIDTH, _TOP = 3.7, 2.3  # limits of panels with objects of about unit standard deviation


def crop_steps(frame: Frame, crop: Frame, size: float = 3.0) -> Figure:
    """Draw a frame with the box around its object, the object mask, and the crop."""
    top, left, height, width = mask_to_bbox(frame.mask)
    titles = ["frame and box", "object mask", "crop, resized to a square"]
    figure, axes = plots.show_images([frame.rgb, frame.mask, crop.rgb], titles, size=size)
    axes[0].add_patch(Rectangle((left, top), width, height, fill=False, edgecolor=ORANGE, linewidth=3))
    return figure


def stage_sheet(
    views: Sequence[View],
    maps: Sequence[Real[np.ndarray, "rows cols"]],
    captions: Sequence[str],
    chosen: int,
    size: float = 2.0,
) -> Figure:
    """Draw the stages of all views of a pair, a row each: crop, features, foreground, and cyclical distances.

    The features are coloured by principal components that all views share; the foreground shows the saliency; the maps
    of (negated) cyclical distances lie on the reference, one for each target; -inf is off the foreground.
    """
    crops = [view.frame.rgb for view in views]
    keys = [np.asarray(view.features.keys) for view in views]
    colours = plots.pca_colours(keys, [np.asarray(view.foreground) for view in views])
    under_maps = [np.ones_like(crops[0]) * 255, *crops[:1] * len(maps)]
    names = "crop", "features", "saliency", "cyclical distance"
    figure, axes = plots.show_images(
        [image for row in zip(crops, colours, crops, under_maps) for image in row],
        [*names, *[""] * (4 * len(maps))], columns=4, size=size,
    )  # fmt: skip
    figure.set_size_inches(4 * size + 1.1, size * len(views) + 0.3)
    rows = np.reshape(np.array(axes, dtype=object), (len(views), 4))
    for axis, view in zip(rows[:, 2], views):
        plots.overlay_map(axis, np.where(view.foreground, view.features.saliency, np.nan), limits=(0, 1))
    for axis, distances in zip(rows[1:, 3], maps):
        plots.overlay_map(axis, distances, limits=(-10, 0), cmap="cividis", alpha=0.85)
    for axis, caption in zip(rows[:, 0], captions):
        axis.text(-0.06, 0.5, caption, transform=axis.transAxes, ha="right", va="center")
    for axis in rows[1 + chosen]:
        plots.mark(axis, "")
    bar = figure.colorbar(rows[1, 3].images[-1], cax=rows[0, 3].inset_axes([0.1, 0.45, 0.8, 0.08]),
                          orientation="horizontal", ticks=[-10, -5, 0])  # fmt: skip
    bar.set_label("− distance (patches)")
    return figure


def matched_points(views: Sequence[View], points: Sequence[Float[np.ndarray, "k 3"]], names: Sequence[str]) -> Figure:
    """Draw the 3D points of matches on the measured surfaces of both objects, seen from the front.

    Both points of a match have the same colour, by their height on the first object. Points far off the object are
    outside the panels.
    """
    clouds = [plots.object_cloud(view)[:, :2] for view in views]
    middles = [(cloud.min(axis=0) + cloud.max(axis=0)) / 2 for cloud in clouds]
    half = 1.2 * np.max([np.ptp(cloud, axis=0) for cloud in clouds], axis=0) / 2
    half = np.maximum(half, 0.75 * half.max())  # panels at least three quarters as high as wide, and the reverse
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 4.5 * half[1] / half[0] + 0.9), layout="constrained")
    order = np.argsort(np.argsort(points[0][:, 1]))
    for axis, cloud, (x, y), matched, name in zip(axes, clouds, middles, points, names):
        inside = (np.abs(matched[:, :2] - (x, y)) < half).all(axis=1)
        axis.scatter(*cloud.T, s=2, color="0.75", label="measured surface")
        style = {"cmap": "viridis", "vmin": 0, "vmax": len(matched) - 1, "edgecolors": "black"}
        axis.scatter(*matched[inside, :2].T, s=50, c=order[inside], label="matches", **style)
        axis.set(title=f"{name}: {inside.sum()} of {len(matched)} matches", aspect="equal")
        axis.set(xlabel="x, to the right (scene units)", ylabel="y, down (scene units)")
        axis.set(xlim=(x - half[0], x + half[0]), ylim=(y + half[1], y - half[1]))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def residual_histogram(residuals: Real[np.ndarray, " k"], inliers: Bool[np.ndarray, " k"], threshold: float) -> Figure:
    """Draw the distribution of the residuals of a fit, inliers and outliers apart; a line marks RANSAC's threshold."""
    figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
    capped = np.minimum(residuals, 1.99)  # the last bar holds everything beyond
    labels = [f"{inliers.sum()} inliers", f"{(~inliers).sum()} outliers"]
    bins = np.arange(0, 2.05, 0.1)
    axis.hist([capped[inliers], capped[~inliers]], bins, stacked=True, color=[BLUE, "0.75"], edgecolor="white",
              label=labels)  # fmt: skip
    axis.axvline(threshold, color=VERMILLION, linestyle="--", label="threshold")
    axis.set(xlabel="distance of the moved point from its match (scene units; last bar: 1.9 and more)")
    axis.set(ylabel="matches")
    axis.legend()
    return figure


def aligned_from_two_sides(reference: Real[np.ndarray, "n 3"], target: Real[np.ndarray, "m 3"]) -> Figure:
    """Draw both clouds in the target camera's frame, from the front and from above."""
    low, high = np.percentile(np.concatenate([reference, target]), [0.5, 99.5], axis=0)
    middle, half = (low + high) / 2, 0.55 * np.max(high - low)
    figure, axes = plt.subplots(1, 2, figsize=(9, 4.9), layout="constrained")
    for axis, title, down, flip in zip(axes, ("from the front", "from above"), (1, 2), (-1, 1)):
        for cloud, name, marker, colour in (
            (target, "target", "D", ORANGE),
            (reference, "reference, moved", "o", BLUE),
        ):
            style = {"s": 7, "linewidths": 0, "marker": marker, "color": colour, "alpha": 0.8}
            axis.scatter(*cloud[:, [0, down]].T, label=name, **style)
        axis.set(title=title, xlabel="x, to the right", ylabel=("y, down", "z, away")[down - 1], aspect="equal")
        axis.set_xlim(middle[0] - half, middle[0] + half)
        axis.set_ylim(middle[down] - flip * half, middle[down] + flip * half)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, markerscale=2.5)
    return figure


def pose_over_sequence(
    estimate: PoseEstimate,
    frames: Sequence[Frame],
    titles: Sequence[str],
    columns: int = 3,
    size: float = 2.7,
    show_axes: bool = True,
) -> Figure:
    """Draw the reference's points in frames of the target sequence after the estimated pose."""
    figure, axes = plots.show_images([frame.rgb for frame in frames], titles, columns=columns, size=size)
    cloud, cameras = plots.object_cloud(estimate.reference_view, most=1400), [frame.camera for frame in frames]
    names = ("", "", "") if show_axes else None
    plots.draw_moved_cloud(axes, cameras, cloud, estimate.propagate(cameras), names)
    return figure


def points_on_images(
    frames: Sequence[Frame],
    clouds: Sequence[Real[np.ndarray, "_ 3"]],
    colours: Sequence[Real[np.ndarray, "_ 3"]],
    titles: Sequence[str],
    columns: int | None = None,
    size: float = 2.6,
    zoom: bool = False,
) -> Figure:
    """Draw coloured points, in the frame of each camera, over images; `zoom` shows only a square around each object."""
    figure, axes = plots.show_images([frame.rgb for frame in frames], titles, columns=columns, size=size)
    for axis, frame, cloud, own in zip(axes, frames, clouds, colours):
        plots.draw_points(axis, frame.camera, cloud, own, size=4)
        if zoom:
            top, left, height, width = mask_to_bbox(frame.mask, padding=0)
            middle, half = np.array([left + width / 2, top + height / 2]), 2 / 3 * max(height, width)
            axis.set(xlim=middle[0] + np.array([-half, half]), ylim=middle[1] + np.array([half, -half]))
    if zoom:
        figure.set_figheight((size + 0.3) * len(frames) / (columns or len(frames)))
    return figure


def errors_against_viewpoint(angles: Sequence[float], errors: Sequence[float], groups: Sequence[str]) -> Figure:
    """Draw rotation errors over the angle between the reference and the chosen view, a marker for each group.

    Lines mark an angle of 45 degrees (near views), an error of 30 (correct poses), and errors equal to the angle.
    """
    figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
    styles = zip(dict.fromkeys(groups), cycle("osD^vP*X"), cycle(plots.COLOURS))
    for group, marker, colour in styles:
        at = [(angle, error) for angle, error, own in zip(angles, errors, groups) if own == group]
        axis.scatter(*np.transpose(at), marker=marker, color=colour, s=60, edgecolors="black", label=group)
    axis.axhline(30, color="0.4", linestyle="--")
    axis.axvline(45, color="0.4", linestyle=":")
    axis.plot([0, 180], [0, 180], color="0.8", zorder=0)
    axis.set(xlabel="angle between reference and chosen view (degrees)", ylabel="rotation error (degrees)")
    axis.set(xlim=(-6, 186), ylim=(-6, 186), xticks=range(0, 181, 45), yticks=(0, 30, 90, 150, 180))
    axis.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def cloud_overlays(
    overlays: Sequence[tuple[Real[np.ndarray, "n 3"], Real[np.ndarray, "m 3"]]],
    titles: Sequence[str],
    seen: Sequence[tuple[int, int]],
    columns: int,
    low: float = -1.9,
) -> Figure:
    """Draw pairs of clouds over each other: the first as orange discs, the second as blue crosses.

    The clouds are in the axes of the object (front +x, left +y, up +z). `seen` are the axes to the right and up of each
    panel: (0, 2) from the right side, (0, 1) from above; `low` is the lower end of the vertical axis.
    """
    rows = -(-len(overlays) // columns)
    size = 9, rows * (0.5 + 9 / columns * (_TOP - low) / (2 * _HALF_WIDTH))
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axis, (own, moved), title, shown in zip(axes.flat, overlays, titles, seen, strict=True):
        axis.scatter(*own[:, shown].T, s=4, c=ORANGE, marker="o", linewidths=0.5)
        axis.scatter(*moved[:, shown].T, s=6, c=BLUE, marker="x", linewidths=0.5)
        axis.set(aspect="equal", xticks=[], yticks=[], xlim=(-_HALF_WIDTH, _HALF_WIDTH), ylim=(low, _TOP))
        axis.set_title(plots.plain_text(title), fontsize=9)
    return figure


def landing_points(
    picture: UInt8[np.ndarray, "h w 3"],
    other: UInt8[np.ndarray, "h w 3"],
    pixels: Real[np.ndarray, "n 2"],
    cases: Mapping[str, Real[np.ndarray, "n 2"]],
    columns: int = 3,
    size: float = 3.0,
) -> tuple[Figure, dict[str, float]]:
    """Draw pixels of a picture, and where they land in another picture under several readings of its pose and depth.

    A point keeps its colour, which runs from left to right in the first picture. The second result is the share of
    points inside the other picture for each reading.
    """
    titles = ["where the points are taken", *cases]
    figure, axes = plots.show_images([picture] + [other] * len(cases), titles, columns=columns, size=size)
    colours = plt.get_cmap("viridis")((pixels[:, 0] - pixels[:, 0].min()) / max(np.ptp(pixels[:, 0]), 1e-9))
    height, width = other.shape[:2]
    inside = {name: ((0 < at) & (at < (width, height))).all(axis=1) for name, at in cases.items()}
    shown = [np.ones(len(pixels), bool), *inside.values()]
    for axis, at, here in zip(axes, [pixels, *cases.values()], shown):
        axis.scatter(*at[here].T, c=colours[here], s=16, edgecolors="black", linewidths=0.4)
        if not here.any():
            box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8}
            axis.text(0.5, 0.06, "no point in this picture", transform=axis.transAxes, ha="center", bbox=box)
    return figure, {name: float(here.mean()) for name, here in inside.items()}


def fused_clouds(
    clouds: Mapping[str, tuple[Real[np.ndarray, "_ 3"], UInt8[np.ndarray, "_ 3"]]], points: int = 3000
) -> Figure:
    """Draw at most `points` points of coloured clouds in 3D, with +y of the camera's frame downwards."""
    figure = plt.figure(figsize=(4.5 * len(clouds), 3.6))
    for place, (title, (cloud, colours)) in enumerate(clouds.items()):
        keep = np.random.default_rng(0).permutation(len(cloud))[:points]
        axis = figure.add_subplot(1, len(clouds), 1 + place, projection="3d")
        x, y, z = cloud[keep].T
        axis.scatter(x, z, -y, c=colours[keep] / 255, s=3)
        axis.set(title=title, xlabel="x", ylabel="z", zlabel="-y", aspect="equal")
        axis.locator_params(nbins=3)
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
