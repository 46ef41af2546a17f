"""Figures of the notebooks on the best view, the alignment of points, and metrics (03 to 05).

Each function draws one complete figure from computed data; its name says what is shown. Angles and rotation errors are
in degrees, lengths in scene units, accuracies in per cent. Mappings go from the title of a panel, or the name in the
legend, to what is drawn there.
"""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float, Real
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from zsp_lite.data.cameras import Camera
from zsp_lite.viz.plots import (
    BLUE,
    CHOSEN,
    COLOURS,
    GREEN,
    LINES,
    MARKERS,
    ORANGE,
    VERMILLION,
    coordinate_colours,
    draw_points,
    overlay_map,
    show_images,
)

_RING, _PICTURE = 1.22, 0.26  # of `view_ring`: distance of the pictures' centres, and half their width


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
    best = int(np.argmax(scores))
    for i, (place, image) in enumerate(zip(turned, targets)):
        axis.plot(*np.transpose([0.2 * place, place]), color=colours[i], linewidth=5, zorder=0)
        corner = _RING * place - _PICTURE
        picture = axis.inset_axes([*corner, 2 * _PICTURE, 2 * _PICTURE], transform=axis.transData)
        title = f"{i + 1}: {scores[i]:.1f}, {angles[i]:.0f}°" + (" chosen" if i == best else "")
        picture.set_title(title, fontsize=10, weight="bold" if i == best else "normal", pad=5)
        _framed(picture, image, CHOSEN if i == best else colours[i], 6 if i == best else 4)
    picture = axis.inset_axes([-0.2, -0.76, 0.4, 0.4], transform=axis.transData)
    picture.set_title("reference", fontsize=10, pad=4)
    _framed(picture, reference, BLUE, 3)
    return figure


def scores_over_angle(angles: Real[np.ndarray, " n"], scores: Mapping[str, Real[np.ndarray, " n"]]) -> Figure:
    """Show each kind of score of the views over their angle to the reference, a panel each; the best view is ringed."""
    rows = -(-len(scores) // 2)
    figure, axes = plt.subplots(rows, 2, figsize=(7.6, 3.5 * rows), layout="constrained", squeeze=False)
    for axis, (name, values) in zip(axes.flat, scores.items()):
        axis.scatter(angles, values, s=55, color=BLUE)
        best = int(np.argmax(values))
        axis.scatter(angles[best], values[best], s=220, facecolors="none", edgecolors=CHOSEN, linewidths=3)
        axis.set(title=name, xlabel="angle to the reference (degrees)", ylabel="score")
        axis.set(xlim=(-10, 190), xticks=range(0, 181, 45))
        axis.margins(y=0.15)
    return figure


def choices_and_scores_over_angle(
    categories: Sequence[str],
    chosen: Real[np.ndarray, " pairs"],
    angles: Real[np.ndarray, "pairs views"],
    scores: Real[np.ndarray, "pairs views"],
) -> Figure:
    """Show for each category at which angles the chosen views lie, and the mean score of all views over the angle."""
    categories, names = np.asarray(categories), list(dict.fromkeys(categories))
    relative = scores - scores.mean(axis=1, keepdims=True)
    part = (angles // 30).clip(max=5)
    scatter = np.random.default_rng(0).uniform(-0.25, 0.25, len(categories))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for place, (name, colour, marker, line) in enumerate(zip(names, COLOURS, MARKERS, LINES)):
        here = categories == name
        style = {"s": 40, "marker": marker, "color": colour, "edgecolors": "black", "linewidths": 0.3}
        left.scatter(chosen[here], place + scatter[here], **style)
        means = [relative[here][part[here] == k].mean() if (part[here] == k).any() else np.nan for k in range(6)]
        right.plot(np.arange(15, 180, 30), means, line, marker=marker, color=colour, label=name)
    left.set_yticks(range(len(names)), names)
    left.set(
        ylim=(-0.6, len(names) - 0.4), title="where the chosen view lies", xlim=(-5, 185), xticks=range(0, 181, 45)
    )
    right.set(xticks=range(0, 181, 45), ylabel="score minus the pair's mean", title="mean score of all views")
    right.legend(fontsize=9)
    for axis in (left, right):
        axis.set_xlabel("angle to the reference (degrees)")
    return figure


def winning_scores(near: Real[np.ndarray, " n"], far: Real[np.ndarray, " m"]) -> Figure:
    """Show histograms of the winning views' scores: of winners near the reference, and where only far views compete."""
    figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
    both = np.concatenate([near, far])
    bins = np.linspace(both.min() - 1, both.max() + 1, 19)
    axis.hist(near, bins, color=BLUE, alpha=0.8, label="winner near the reference")
    style = {"histtype": "step", "color": VERMILLION, "linewidth": 2, "hatch": "//"}
    axis.hist(far, bins, label="winner when near views are withheld", **style)
    axis.set(xlabel="score of the winning view", ylabel="pairs")
    figure.legend(fontsize=9, ncols=2, loc="outside upper center")
    return figure


def depth_with_holes(
    image: np.ndarray, depth: Real[np.ndarray, "h w"], filled: Real[np.ndarray, "h w"], limits: tuple[float, float]
) -> Figure:
    """Show an image, its depth map with the unknown pixels (0) in white, and the depth map after filling."""
    empty = np.ones_like(image)
    figure, axes = show_images([image, empty, empty], ["crop", "depth, unknown pixels white", "filled"], size=3.1)
    for axis, values in zip(axes[1:], (np.where(depth > 0, depth, np.nan), filled)):
        axis.images[0].set_alpha(0)
        overlay_map(axis, values, alpha=1, limits=limits, label="depth (scene units)")
    return figure


def filled_depth_errors(errors: Mapping[str, Real[np.ndarray, " n"]], tolerance: float) -> Figure:
    """Show histograms of the errors of filled depths, a panel per part of the image; a line marks the tolerance."""
    figure, axes = plt.subplots(1, len(errors), figsize=(9, 3.4), layout="constrained", sharex=True, squeeze=False)
    bins = np.geomspace(1e-3, max(1, *(np.max(values, initial=0) for values in errors.values())), 40)
    for axis, (name, values), colour in zip(axes.flat, errors.items(), COLOURS):
        axis.hist(np.clip(values, 1e-3, None), bins, color=colour, edgecolor="white")
        axis.axvline(tolerance, color=VERMILLION, linestyle="--", label=f"{tolerance:g} scene units")
        axis.set(xscale="log", title=name, ylabel="pixels")
        axis.set_xlabel("error (scene units; first bar: 0.001 and less)")
    axes[0, 0].legend(fontsize=9)
    return figure


def points_from_above(
    panels: Mapping[str, Float[np.ndarray, "n 3"]], beside: Mapping[str, Bool[np.ndarray, " n"]], tolerance: float
) -> Figure:
    """Show camera-frame points from above, a panel for each way to compute them; points off the object are crosses.

    The panels share their limits, which lie around the points on the object: crosses far off are cut.
    """
    low, high = _around(np.concatenate([points[~beside[title]] for title, points in panels.items()])[:, [0, 2]])
    figure, axes = _equal_panels(len(panels), low, high, extra=1.5)
    for axis, (title, points) in zip(axes, panels.items()):
        off = beside[title]
        axis.scatter(*points[~off][:, [0, 2]].T, s=10, color=BLUE, label="on the object")
        crosses = {"s": 24, "marker": "x", "color": VERMILLION}
        axis.scatter(*points[off][:, [0, 2]].T, label=f"off it by more than {tolerance:g}", **crosses)
        axis.set_title(f"{title}\n{off.sum()} of {len(off)} points are off the object")
        axis.set(xlabel="x, to the right (scene units)")
    axes[0].set_ylabel("z, away (scene units)")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def fits_with_one_outlier(
    fitted: Mapping[str, Float[np.ndarray, "n 3"]],
    targets: Mapping[str, Float[np.ndarray, "n 3"]],
    moves: Real[np.ndarray, " m"],
    turned: Real[np.ndarray, " m"],
) -> Figure:
    """Show fits with the last target point displaced, and the error `turned` of the rotation over the displacement."""
    low, high = _around(np.concatenate([*fitted.values(), *targets.values()])[:, :2], margin=0.1)
    names, ratio = [f"fit {number}" for number in range(len(fitted))], (high - low)[1] / (high - low)[0]
    figure = plt.figure(figsize=(10, len(fitted) * (5.2 * ratio + 0.7)), layout="constrained")
    axes = figure.subplot_mosaic([[name, "error"] for name in names], width_ratios=(1.5, 1))
    for axis, (title, points) in zip((axes[name] for name in names), fitted.items()):
        target = targets[title]
        axis.add_collection(LineCollection(np.stack([points, target], axis=1)[:, :, :2], colors="0.5", linewidths=0.8))
        axis.scatter(*target[:, :2].T, s=70, facecolors="none", edgecolors=ORANGE, linewidths=1.8, label="target")
        axis.scatter(*points[:, :2].T, s=25, marker="x", color=BLUE, label="source, fitted")
        axis.set(title=title, ylabel="y, down (scene units)", xlim=(low[0], high[0]), ylim=(high[1], low[1]))
        axis.set_aspect("equal")
    axis.set_xlabel("x (scene units)")
    axes[names[0]].legend(fontsize=9, loc="upper right")
    axes["error"].plot(moves, turned, color=BLUE)
    axes["error"].set(title="effect on the rotation", ylabel="rotation error (degrees)")
    axes["error"].set_xlabel("last point moved by (scene units)")
    return figure


def trials_over_good_share(
    shares: Real[np.ndarray, " n"], needed: Mapping[str, Sequence[float]], trials: int, marks: Mapping[str, float]
) -> Figure:
    """Show how many trials are needed over the share of good matches; lines mark a number of trials and some shares."""
    figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
    for (label, values), colour, style in zip(needed.items(), (GREEN, BLUE, ORANGE), (":", "-", "--")):
        axis.plot(shares, values, style, color=colour, label=label, linewidth=2)
    axis.axhline(trials, color="0.5", linewidth=1)
    axis.text(0.98, 1.1 * trials, f"{trials:,} trials", ha="right", color="0.3")
    for (label, share), style in zip(marks.items(), ("-.", (0, (1, 3)))):
        axis.axvline(share, color=VERMILLION, linestyle=style, label=label)
    axis.set(yscale="log", ylim=(1, 1e6), ylabel="trials for 99 %", xlabel="share w of good matches")
    axis.legend(fontsize=9)
    return figure


def matched_points_after_fits(
    fitted: Mapping[str, Float[np.ndarray, "n 3"]],
    target: Float[np.ndarray, "n 3"],
    inliers: Mapping[str, Bool[np.ndarray, " n"]],
    surface: Float[np.ndarray, "m 3"],
) -> Figure:
    """Show matched points in the target camera's frame after several fits, a panel each, seen from the camera.

    A line joins each moved reference point (cross) to its target point (circle): the residual. Residuals above the
    threshold are thin and grey. The limits lie around the object: points far off are cut.
    """
    low, high = _around(surface[:, :2])
    figure, axes = _equal_panels(len(fitted), low, high, extra=1.9)
    for axis, (title, points) in zip(axes, fitted.items()):
        good = inliers[title]
        axis.scatter(*surface[:, :2].T, s=2, color="0.85", label="target object")
        for where, colour, width, label in (
            (~good, "0.55", 0.7, "residual above the threshold"), (good, BLUE, 2, "residual below it"),
        ):  # fmt: skip
            lines = np.stack([points[where], target[where]], axis=1)[:, :, :2]
            axis.add_collection(LineCollection(lines, colors=colour, linewidths=width, label=label))
        axis.scatter(*target[:, :2].T, s=36, facecolors="none", edgecolors=ORANGE, linewidths=1.6, label="target point")
        axis.scatter(*points[:, :2].T, s=22, marker="x", color=BLUE, label="reference point, moved")
        axis.set_title(f"{title}\n{good.sum()} of {len(good)} residuals below the threshold")
        axis.set_xlabel("x, to the right (scene units)")
    axes[0].set_ylabel("y, down (scene units)")
    axes[0].invert_yaxis()
    figure.legend(
        *axes[0].get_legend_handles_labels(), fontsize=9, ncols=3, loc="outside lower center", markerscale=1.5
    )
    return figure


def ransac_sweeps(
    sweeps: Mapping[str, tuple[str, Mapping[float, tuple[Sequence[int], Sequence[float], int]]]], matches: int
) -> Figure:
    """Show inliers and rotation errors of several draws over a setting of RANSAC, a column for each sweep.

    `sweeps` maps a title to the name of the setting, and for each of its values to the inliers and the rotation errors
    of the draws, and the inliers for shuffled matches.
    """
    figure, axes = plt.subplots(2, len(sweeps), figsize=(10.4, 7.2), layout="constrained", sharex="col", sharey="row",
                                squeeze=False)  # fmt: skip
    largest = max(max(errors) for _, results in sweeps.values() for _, errors, _ in results.values())
    for (above, below), (title, (setting, results)) in zip(axes.T, sweeps.items()):
        step = (max(results) / min(results)) ** 0.012 if len(results) > 1 else 1.02  # of dots beside each other
        for value, (counts, errors, chance) in results.items():
            at = value * step ** (np.arange(len(counts)) - (len(counts) - 1) / 2)
            above.plot(at, counts, "o", color=BLUE, markersize=5, label="matches, one dot per draw")
            above.plot(value, chance, "s", color="0.6", label="shuffled matches")
            below.plot(at, errors, "o", color=VERMILLION, markersize=5)
        above.set(title=title, ylim=(-1, matches + 2))
        below.set(xlabel=setting, xscale="log", ylim=(-0.04 * largest, 1.06 * largest))
        below.margins(x=0.08)
        below.set_xticks([*results], [f"{value:g}" for value in results])
        below.minorticks_off()
    axes[0, 0].set_ylabel(f"inliers (of {matches})")
    axes[1, 0].set_ylabel("rotation error (degrees)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles[:2], labels[:2], ncols=2, loc="outside upper center")
    return figure


def angle_errors_of_formulas(
    offsets: Real[np.ndarray, " n"], errors: Mapping[str, tuple[Sequence[float], Sequence[float]]]
) -> Figure:
    """Show the largest error of formulas for a rotation angle near 0 and near 180 degrees, on logarithmic axes.

    Formulas with "arccos" in their name have one colour, and those with "single" have dashed lines.
    """
    figure, panels = plt.subplots(1, 2, figsize=(10, 4.8), layout="constrained", sharey=True)
    for end, (panel, middle) in enumerate(zip(panels, (0, 180))):
        for name, values in errors.items():
            colour, line = VERMILLION if "arccos" in name else BLUE, "--" if "single" in name else "-"
            panel.plot(offsets, values[end], line, color=colour, label=name)
        panel.plot(offsets, offsets, ":", color="0.6", label="as large as the distance itself")
        panel.set(xscale="log", yscale="log", ylim=(1e-17, 1), title=f"near {middle}°")
        panel.set(xlabel=f"distance from {middle}° (degrees)")
        panel.minorticks_off()
    panels[0].set_ylabel("largest error (degrees)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    return figure


def pose_chain(
    images: tuple[np.ndarray, np.ndarray],
    cameras: tuple[Camera, Camera],
    in_cameras: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]],
    in_worlds: Mapping[str, tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]],
) -> Figure:
    """Show points on their way from one camera to the other: over two images, and in the worlds between them.

    A point keeps its colour, its position along the first object. `in_worlds` maps the name of a world to the points in
    it and the cloud of the object whose world it is.
    """
    figure, axes = plt.subplots(2, 3, figsize=(10.2, 6.6), layout="constrained")
    panels, colours = list(axes.flat), coordinate_colours(in_cameras[0])
    panels[5].set_axis_off()
    for number, panel, image, camera, points in zip((1, 5), (panels[0], panels[4]), images, cameras, in_cameras):
        panel.imshow(image, extent=(0, image.shape[1], image.shape[0], 0))
        draw_points(panel, camera, points, colours, size=2)
        panel.set(title=f"{number}  camera of {'a' if number == 1 else 'b'}", xticks=[], yticks=[])
        panel.set_anchor("S")
    for number, panel, (name, (points, cloud)) in zip((2, 3, 4), panels[1:4], in_worlds.items()):
        panel.scatter(*cloud[:, :2].T, s=2, color="0.7", label="object of this world")
        panel.scatter(*points[:, :2].T, s=3, c=colours, label="points measured by camera a")
        panel.set(title=f"{number}  {name}", xlabel="x (scene units)", ylabel="y (scene units)")
        panel.invert_yaxis()
        panel.set_aspect("equal", adjustable="datalim")
    panels[5].legend(*panels[1].get_legend_handles_labels(), loc="center", markerscale=4)
    return figure


def errors_by_category(errors: Real[np.ndarray, " n"], categories: Sequence[str]) -> Figure:
    """Show all rotation errors, a row of dots for each category, with the median as a bar; a line marks 30 degrees."""
    categories, names = np.asarray(categories), list(dict.fromkeys(categories))
    scatter = np.random.default_rng(0).uniform(-0.28, 0.28, len(errors))
    figure, axis = plt.subplots(figsize=(9, 3.8), layout="constrained")
    for row, (name, marker) in enumerate(zip(names, MARKERS * len(names))):
        here = categories == name
        style = {"s": 40, "marker": marker, "color": BLUE, "edgecolors": "white", "linewidths": 0.4}
        axis.scatter(errors[here], row + scatter[here], **style)
        axis.plot([np.median(errors[here])] * 2, [row - 0.4, row + 0.4], color=VERMILLION, linewidth=2.5)
    axis.axvline(30, color="0.5", linestyle="--", linewidth=1)
    axis.set_yticks(range(len(names)), names)
    axis.set(xlim=(-3, 183), xticks=range(0, 181, 30))
    axis.set_xlabel("rotation error (degrees); bar: median; dashed: 30°")
    return figure


def distances_between_instances(
    angles: Real[np.ndarray, " n"], curves: Mapping[str, Real[np.ndarray, "pairs n"]]
) -> Figure:
    """Show closest-point distances of pairs over the angle from the true pose; a triangle marks each minimum."""
    figure, panels = plt.subplots(1, len(curves), figsize=(11, 3.8), layout="constrained", sharey=True, squeeze=False)
    for panel, (name, pairs) in zip(panels.flat, curves.items()):
        for distances in pairs:
            panel.plot(angles, distances, color="0.75", linewidth=1)
            panel.plot(angles[distances.argmin()], distances.min(), "v", color=VERMILLION, markersize=7)
        panel.axvline(0, color=BLUE)
        panel.set(title=name, xticks=range(0, 361, 90), xlabel="angle from the truth (degrees)", ylim=(0, None))
    panels[0, 0].set_ylabel("closest-point distance (scene units)")
    return figure


def paired_errors(errors: Mapping[str, Real[np.ndarray, " n"]]) -> Figure:
    """Show the rotation errors of two methods on the same pairs against each other; lines mark 30 degrees."""
    (first, x), (second, y) = errors.items()
    figure, axis = plt.subplots(figsize=(5.6, 5.4), layout="constrained")
    axis.scatter(x, y, s=36, color=BLUE, alpha=0.6, edgecolors="black", linewidths=0.5)
    axis.plot([0, 180], [0, 180], color="0.8", zorder=0)
    for draw in (axis.axvline, axis.axhline):
        draw(30, color="0.5", linestyle="--", linewidth=1)
    ticks = range(0, 181, 30)
    axis.set(xlabel=f"error, {first} (degrees)", ylabel=f"error, {second} (degrees)", xticks=ticks, yticks=ticks)
    axis.set_aspect("equal")
    return figure


def _around(points: Real[np.ndarray, "n 2"], margin: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper limits around points, with a margin on all sides as a share of the larger extent."""
    low, high = points.min(axis=0), points.max(axis=0)
    return low - margin * np.max(high - low), high + margin * np.max(high - low)


def _equal_panels(number: int, low: np.ndarray, high: np.ndarray, extra: float) -> tuple[Figure, np.ndarray]:
    """Panels in a row with the same limits and equal scales, at least 0.72 times as high as wide.

    `extra` inches above and below hold the titles and the legend.
    """
    wide, high_now = high - low
    missing = np.array([0, max(0, 0.72 * wide - high_now) / 2])
    low, high = low - missing, high + missing
    size = 4.8 * number, 4.2 * (high[1] - low[1]) / wide + extra
    figure, axes = plt.subplots(1, number, figsize=size, layout="constrained", sharex=True, sharey=True, squeeze=False)
    for axis in axes[0]:
        axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    return figure, axes[0]


def _framed(axis: Axes, image: np.ndarray, colour: object, width: float) -> None:
    axis.imshow(image)
    axis.set(xticks=[], yticks=[])
    axis.spines[:].set(color=colour, linewidth=width)
