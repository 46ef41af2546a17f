"""Plots of every stage of the method, as pieces to combine.

`show_...` makes a figure: images in a grid, maps over images, matches between two, curves, points,
intervals, dots by category, histograms. `draw_...`, `overlay_map` and the marks add to axes, so
that a figure is a few calls. A patch is a cell (row, col) of a grid (rows, columns). Titles and
names are no TeX.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import cycle
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float, Integer, Real, UInt8
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.legend import Legend
from matplotlib.patches import ConnectionPatch, Rectangle
from matplotlib.patheffects import Normal, Stroke
from matplotlib.transforms import offset_copy
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate
from zsp_lite.matching import Matches
from zsp_lite.points import axis_deviation, near_median
from zsp_lite.views import View

Cell = Sequence[int] | np.ndarray  # (row, col)

# The palette of Okabe and Ito: distinguishable with the common colour-vision deficiencies.
BLUE = "#0072B2"
ORANGE = "#E69F00"
GREEN = "#009E73"
VERMILLION = "#D55E00"
CHOSEN = ORANGE  # marks what is chosen: a view, a patch, an image
# Several curves or groups of points of a figure have these, in this order and then again.
COLOURS = (BLUE, ORANGE, GREEN, VERMILLION, "#56B4E9", "#CC79A7", "#000000")
_LINES = ("-", "--", "-.", ":")
_MARKERS = "os^DvP*X"
_CLOUD_MARKERS = "oxs^"  # the discs of the first cloud are visible below crosses
_AXIS_COLOURS = (VERMILLION, GREEN, BLUE)  # of the axes x, y and z
_FONT = 10  # size of the text, in points
_TITLE_LINE = 0.2  # height of a line of a title at this font, in inches
_MARKED = 20  # a curve with more points has no markers, which would cover it
_JOINED = 15  # number of matches with a line: more lines would cover the images
_INSIDE = 0.9  # a soft mask above this leaves out the border of the object
_RESIDUAL = 0.2  # an inlier has a smaller residual: the default threshold of RANSAC
_OUTLIER = 2.5  # median distances; points farther out are background (see `near_median`)
# A white outline lets lines and texts stand out from dark images, a black one white lines from
# light images.
_OUTLINE = [Stroke(linewidth=3, foreground="white"), Normal()]
BORDER = [Stroke(linewidth=4, foreground="black"), Normal()]
_WHITE_BOX = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}


def show_images(
    images: Sequence[np.ndarray],
    titles: Sequence[str] = (),
    columns: int | None = None,
    size: float = 2.4,
    cmap: str = "gray",
) -> tuple[Figure, list[Axes]]:
    """Show images (H, W, 3) or (H, W) in a grid, each `size` inches wide; returns the figure and
    one axis per image.

    Pixel (x, y) of an image is at (x, y) of its axes, [0, W] x [0, H].
    """
    aspect = max(np.shape(image)[0] / np.shape(image)[1] for image in images)
    height = size * aspect + 0.1 + _TITLE_LINE * _lines_of(titles)  # 0.1: space between the rows
    figure, axes = _panels(len(images), columns, size, height)
    for axis, image in zip(axes, images):
        axis.set_axis_off()
        draw_image(axis, image, cmap)
    for axis, title in zip(axes, titles):
        # Without `y`, the ticks, which are off, would be measured to find the height.
        axis.set_title(title, fontsize=_FONT, parse_math=False, y=1)
    return figure, axes


def draw_image(axis: Axes, image: np.ndarray, cmap: str = "gray") -> None:
    """Draw an image, with pixel (x, y) at (x, y) of the axes; what is drawn over it does not move
    their limits."""
    height, width = np.shape(image)[:2]
    axis.imshow(image, cmap=cmap, extent=(0, width, height, 0), interpolation="nearest")
    axis.autoscale(False)


def pale(image: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """Mix an image with white, so that what is drawn over it stands out."""
    return 255 - (255 - image) // 2


def overlay_map(
    axis: Axes,
    values: Real[np.ndarray, "rows cols"],
    alpha: float = 0.65,
    cmap: str = "viridis",
    limits: tuple[float, float] | None = None,
    label: str | None = None,
) -> AxesImage:
    """Draw a map on the patch grid over the image of an axis, transparent where it is not finite.

    `limits` are the values at the ends of the colour map; `label` adds a colour bar with this
    label. `set_data` of the returned image shows other values.
    """
    drawn = axis.imshow(
        np.asarray(values, np.float64),
        cmap=cmap,
        alpha=alpha,
        interpolation="nearest",
        clim=limits,
        extent=(*axis.get_xlim(), *axis.get_ylim()),
    )
    if label is not None:
        bar = axis.figure.colorbar(drawn, ax=axis, location="bottom", shrink=0.85, pad=0.02)
        bar.set_label(label, fontsize=_FONT - 1)
        bar.ax.tick_params(labelsize=_FONT - 2)
    return drawn


def mark(axis: Axes, text: str, colour: str = CHOSEN, size: float = _FONT) -> None:
    """Draw a coloured frame around the image of an axis and write `text` in its corner, `size`
    points high."""
    whole = axis.transAxes  # the coordinates below are fractions of the axis's width and height
    frame = Rectangle(
        (0, 0), 1, 1, fill=False, edgecolor=colour, linewidth=5, transform=whole, zorder=10
    )
    axis.add_patch(frame)
    axis.text(
        0.04,
        0.95,
        text,
        fontsize=size,
        weight="bold",
        va="top",
        parse_math=False,
        bbox=_WHITE_BOX,
        transform=whole,
        zorder=11,
    )


def patch_centres(
    cells: Integer[np.ndarray, "n 2"], grid: tuple[int, int], size: tuple[int, int]
) -> Float[np.ndarray, "n 2"]:
    """Return the pixels (x, y) of the centres of patches (row, col) of a grid over an image of
    `size` (H, W)."""
    scale = np.array([size[1] / grid[1], size[0] / grid[0]])  # pixels per patch in x and y
    return (np.asarray(cells)[:, ::-1] + 0.5) * scale


def match_pixels(views: Sequence[View], matches: Matches) -> list[Float[np.ndarray, "n 2"]]:
    """Return the pixels (x, y) of matched patches in the images of the reference and of the
    target."""
    return [
        patch_centres(cells, view.features.grid, view.frame.rgb.shape[:2])
        for cells, view in zip((matches.reference, matches.target), views)
    ]


def circle_patch(axis: Axes, cell: Cell, grid: tuple[int, int], marker: str = "o") -> list[Artist]:
    """Mark a patch of the image of an axis by a white circle, or by an orange star
    (`marker` "*")."""
    style = {"color": "white", "markersize": 7}
    if marker == "*":
        style = {"color": ORANGE, "markersize": 18}
    centre = patch_centres(np.array([cell]), grid, _size(axis))[0]
    return axis.plot(*centre, marker, markeredgecolor="black", zorder=8, **style)


def outline_patch(
    axis: Axes,
    cell: Cell,
    grid: tuple[int, int],
    reach: int = 0,
    colour: str = "white",
    label: str = "",
    **style: Any,
) -> list[Artist]:
    """Outline a patch of the image of an axis, or the block of patches up to `reach` around it,
    with a label beside it.

    The block is cut at the border of the image.
    """
    # The corners at the upper left and the lower right as (row, col), then in pixels (x, y).
    corners = np.clip([np.subtract(cell, reach), np.add(cell, reach + 1)], 0, grid)
    (left, top), (right, bottom) = corners[:, ::-1] * np.divide(_size(axis), grid)[::-1]
    box = Rectangle((left, top), right - left, bottom - top, fill=False, edgecolor=colour, **style)
    # The label is at the right of the block, in the last fifth of the columns at its left.
    near_border = cell[1] >= 0.8 * grid[1]
    text = axis.text(
        left if near_border else right,
        (top + bottom) / 2,
        f" {label} ",
        ha="right" if near_border else "left",
        va="center",
        weight="bold",
        path_effects=_OUTLINE,
    )
    return [axis.add_patch(box), text]


def draw_cycle(
    axes: Sequence[Axes],
    cells: Sequence[Cell] | np.ndarray,
    grid: tuple[int, int],
    colour: str = "white",
    names: Sequence[str] = ("u", "v", "u'"),
) -> list[Artist]:
    """Draw a cycle between the images of two axes: a solid arrow from u to v, a dashed one from v
    back to u', with `names` or without any."""
    # A closed cycle has both names of its start beside each other.
    if names and tuple(cells[0]) == tuple(cells[2]):
        names = (f"{names[0]} = {names[2]}", names[1], "")
    stops = (axes[0], axes[1], axes[0])  # the axes of u, v and u'
    pixels = [
        patch_centres(np.array([cell]), grid, _size(axis))[0] for cell, axis in zip(cells, stops)
    ]
    drawn = axes[0].plot(*pixels[0], "o", color=colour, markeredgecolor="black", markersize=8)
    for start, line in enumerate(("-", "--")):
        arrow = ConnectionPatch(
            pixels[start],
            pixels[start + 1],
            "data",
            axesA=stops[start],
            axesB=stops[start + 1],
            arrowstyle="-|>",
            mutation_scale=14,
            connectionstyle="arc3,rad=-0.1",
            linestyle=line,
            linewidth=2,
            color=colour,
            path_effects=BORDER,
        )
        drawn.append(axes[0].figure.add_artist(arrow))
    # The name of u' is at its left: u, which is often near, has its own at its right.
    for axis, pixel, name, side in zip(stops, pixels, names, ("left", "left", "right")):
        text = axis.text(
            *pixel, name, fontsize=11, weight="bold", va="bottom", ha=side, path_effects=_OUTLINE
        )
        drawn.append(text)
    return drawn


def show_matches(
    images: Sequence[np.ndarray],
    cells: Sequence[Integer[np.ndarray, "n 2"]],
    grid: tuple[int, int],
    inliers: Bool[np.ndarray, " n"] | None = None,
    titles: Sequence[str] = ("reference", "target"),
    size: float = 3.4,
) -> Figure:
    """Show two images and matches of their patches (row, col), as `draw_matches` draws them."""
    figure, axes = show_images(images, titles, size=size)
    pixels = [
        patch_centres(matched, grid, image.shape[:2]) for matched, image in zip(cells, images)
    ]
    draw_matches(axes, pixels, inliers)
    return figure


def draw_matches(
    axes: Sequence[Axes],
    pixels: Sequence[Real[np.ndarray, "n 2"]],
    inliers: Bool[np.ndarray, " n"] | None = None,
) -> list[Artist]:
    """Mark matches, at pixels (x, y) of two images, and join some: inliers solid, blue; others
    dashed, vermillion.

    Of more than 15 matches, 15 have a line, with the same share of inliers.
    """
    count = len(pixels[0])
    inliers = np.ones(count, bool) if inliers is None else inliers
    # Inliers come last, so that their lines are above the others. Matches at equal steps of this
    # order have the same share of inliers as all.
    order = np.argsort(inliers, kind="stable")
    steps = np.linspace(0, count - 1, min(count, _JOINED)).astype(int)
    drawn = []
    for index in order[steps]:
        style = {"color": VERMILLION, "linewidth": 1.2, "linestyle": (0, (4, 2))}
        if inliers[index]:  # with a white outline, to be visible on dark images
            style = {"color": BLUE, "linewidth": 1.8, "path_effects": _OUTLINE}
        line = ConnectionPatch(
            pixels[0][index],
            pixels[1][index],
            "data",
            axesA=axes[0],
            axesB=axes[1],
            zorder=5,
            **style,
        )
        drawn.append(axes[0].figure.add_artist(line))
    for axis, places in zip(axes, pixels):
        # Inliers by discs, others by crosses; `.T` are the x and the y of the pixels.
        style = {"s": 25, "zorder": 6}
        drawn += [
            axis.scatter(*places[~inliers].T, c=VERMILLION, marker="x", linewidths=1.2, **style),
            axis.scatter(*places[inliers].T, c=BLUE, edgecolors="white", linewidths=0.7, **style),
        ]
    return drawn


def show_curves(x: ArrayLike, curves: Mapping[str, ArrayLike], **labels: Any) -> Figure:
    """Show curves over x; `labels` is what `Axes.set` takes, such as xlabel, ylabel and ylim."""
    return show_panels({"": {name: (x, y) for name, y in curves.items()}}, size=(7, 3.5), **labels)


def show_panels(
    panels: Mapping[str, Mapping[str, tuple[ArrayLike, ArrayLike]]],
    joined: bool = True,
    size: tuple[float, float] = (10, 3.4),
    **labels: Any,
) -> Figure:
    """Show curves (x, y), or points that are not `joined`, in each panel, by its title, with one
    legend of those with a name.

    Curves differ in colour, line and marker. `size` is that of the figure in inches; `labels` is
    what `Axes.set` takes.
    """
    figure, axes = _panels(len(panels), None, size[0] / len(panels), size[1])
    for axis, (title, curves) in zip(axes, panels.items()):
        styles = zip(curves.items(), cycle(COLOURS), cycle(_LINES), cycle(_MARKERS))
        for (name, (x, y)), colour, line, marker in styles:
            if joined:
                marker = marker if len(x) <= _MARKED else None
                axis.plot(x, y, line, color=colour, label=name, marker=marker, markersize=5)
            else:
                axis.scatter(
                    x,
                    y,
                    s=50,
                    c=colour,
                    marker=marker,
                    edgecolors="black",
                    linewidths=0.4,
                    label=name,
                )
        axis.set(title=title, **labels)
    if axes[0].get_legend_handles_labels()[1]:
        _legend(figure, axes[0])
    return figure


def show_points(
    panels: Mapping[str, Mapping[str, Real[np.ndarray, "_ _"]]],
    columns: int | None = None,
    size: float = 4.5,
    colours: Sequence[str] = COLOURS,
    **labels: Any,
) -> Figure:
    """Show sets of points (x, y, ...), by their names, in each panel, by its title, with equal
    scales and one legend.

    A panel has at most four sets, of the `colours` in turn. All panels have the same extent, around
    the first set of each; points far off it are cut. `labels` is what `Axes.set` takes.
    """
    # The range of each panel's first set, without outliers: (panels, low and high, x and y).
    firsts = [next(iter(sets.values()))[:, :2] for sets in panels.values()]
    ranges = np.array([np.percentile(points, [1, 99], axis=0) for points in firsts])
    extent = (ranges[:, 1] - ranges[:, 0]).max(axis=0)
    half = extent / 2 + 0.2 * extent.max()  # with a margin of a fifth on each side
    height = size * half[1] / half[0] + 0.6 + _TITLE_LINE * _lines_of(panels)  # 0.6: the legend
    figure, axes = _panels(len(panels), columns, size, height)
    for axis, (title, sets), centre in zip(axes, panels.items(), ranges.mean(axis=1)):
        for (name, points), colour, marker in zip(sets.items(), colours, _CLOUD_MARKERS):
            # More points have smaller marks (square points) and thinner lines, chosen by eye.
            area = np.clip(6000 / max(len(points), 1), 3, 40)
            thick = 0.3 + 0.03 * area
            axis.scatter(*points.T[:2], area, colour, marker=marker, linewidths=thick, label=name)
        axis.set_title(title, fontsize=_FONT, parse_math=False)
        left, bottom = centre - half
        right, top = centre + half
        axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
        axis.set(**labels)  # may have other limits
    for handle in _legend(figure, axes[0], "outside lower center").legend_handles:
        handle.set(sizes=[40], linewidths=[1.5])  # small marks would be pale
    return figure


def show_dots(rows: Mapping[str, ArrayLike], median: bool = True, **labels: Any) -> Figure:
    """Show the values of each row, by its name, as dots, with a bar at the `median`.

    `labels` is what `Axes.set` takes.
    """
    figure, axis = plt.subplots(figsize=(8, 1.1 + 0.42 * len(rows)), layout="constrained")
    rng = np.random.default_rng(0)
    for row, values in enumerate(rows.values()):
        # Dots are scattered over a band, so that equal values can be told apart.
        height = row + rng.uniform(-0.2, 0.2, len(values))
        axis.scatter(values, height, s=40, c=BLUE, edgecolors="white", linewidths=0.4)
        if median and len(values):
            axis.vlines(np.median(values), row - 0.4, row + 0.4, color=VERMILLION, linewidth=2.5)
    axis.set_yticks(range(len(rows)), rows)
    axis.set(ylim=(len(rows) - 0.4, -0.6), **labels)  # the first row is at the top
    return figure


def show_intervals(
    x: ArrayLike,
    intervals: Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]],
    **labels: Any,
) -> Figure:
    """Show up to four rows of values over x, each value with a bar from its lower to its upper end.

    A row is (values, lower ends, upper ends) by its name; bars at one x stand beside each other. A
    line joins the values of a row; `labels` is what `Axes.set` takes.
    """
    figure, axis = plt.subplots(figsize=(7, 3.8), layout="constrained")
    styles = zip(intervals.items(), COLOURS, _LINES, _MARKERS)
    for index, ((name, (values, low, high)), colour, line, marker) in enumerate(styles):
        (row,) = axis.plot(x, values, linestyle=line, marker=marker, color=colour, label=name)
        bars = axis.vlines(x, low, high, color=colour, alpha=0.5, linewidth=3)
        # Rows are 5 points apart. They are moved after the axis has got its limits from them.
        shift = 5 * (index - (len(intervals) - 1) / 2)
        beside = offset_copy(axis.transData, figure, x=shift, units="points")
        row.set_transform(beside)
        bars.set_transform(beside)
    axis.set(**labels)
    axis.minorticks_off()
    _legend(figure, axis)
    return figure


def show_maps(
    images: Sequence[np.ndarray],
    maps: Mapping[str, Real[np.ndarray, "rows cols"] | None],
    size: float = 3.0,
    **style: Any,
) -> Figure:
    """Show each map, by its title, over its image; None is an image without a map. `style` is what
    `overlay_map` takes."""
    figure, axes = show_images(images, list(maps), size=size)
    for axis, values in zip(axes, maps.values()):
        if values is not None:
            overlay_map(axis, values, **style)
    return figure


def pca_colours(
    maps: Sequence[Real[np.ndarray, "rows cols d"]],
    foreground: Sequence[Bool[np.ndarray, "rows cols"]] | None = None,
) -> list[Float[np.ndarray, "rows cols 3"]]:
    """Map features to colours by their first three principal components, which all maps share.

    Each component is scaled to its range from the 2nd to the 98th percentile. The components are
    fitted to the `foreground` patches; others are white. Each map gives an RGB image in [0, 1],
    with one pixel per patch.
    """
    features = [np.asarray(values, dtype=np.float64) for values in maps]
    inside = foreground or [np.ones(values.shape[:2], bool) for values in features]
    fitted = np.concatenate([values[mask] for values, mask in zip(features, inside)])
    centred = fitted - fitted.mean(axis=0)
    # The last three eigenvectors (d, 3), those of the largest eigenvalues, in falling order.
    axes = np.linalg.eigh(centred.T @ centred)[1][:, :-4:-1]
    low, high = np.percentile(fitted @ axes, [2, 98], axis=0)
    colours = []
    for values, mask in zip(features, inside):
        scaled = (values @ axes - low) / np.maximum(high - low, 1e-12)
        colours.append(np.where(mask[..., None], scaled.clip(0, 1), 1.0))
    return colours


def draw_points(
    axis: Axes,
    camera: Camera,
    points: Real[np.ndarray, "n 3"],
    colours: np.ndarray,
    size: float = 5.0,
) -> None:
    """Draw points of a camera's frame in its image, far ones first; those behind the camera are
    left out."""
    points = np.asarray(points, dtype=np.float64)
    order = np.argsort(-points[:, 2])  # far points first
    order = order[points[order, 2] > 0]
    pixels, _ = camera.project(camera.to_world(points[order]))
    axis.scatter(*pixels.T, s=size, c=colours[order], linewidths=0, alpha=0.85, zorder=3)


def draw_axes(
    axis: Axes,
    camera: Camera,
    origin: Real[np.ndarray, "3"],
    ends: Real[np.ndarray, "3 3"],
    names: Sequence[str],
    size: float = _FONT,
) -> None:
    """Draw arrows from an origin to three ends (rows), points of a camera's frame, in its image,
    with their names, `size` points high.

    Arrows with an end behind the camera are left out; names stay inside the image.
    """
    pixels, depth = camera.project(camera.to_world(np.vstack([origin, ends])))
    shape = np.array(camera.size[::-1])  # (W, H)
    for name, colour, end, end_depth in zip(names, _AXIS_COLOURS, pixels[1:], depth[1:]):
        if min(end_depth, depth[0]) <= 0:
            continue
        style = {"arrowstyle": "-|>", "color": colour, "linewidth": 2, "shrinkA": 0, "shrinkB": 0}
        arrow = axis.annotate("", end, pixels[0], zorder=6, annotation_clip=False, arrowprops=style)
        # What is outside the image is cut off, and takes no space in the figure.
        arrow.set_in_layout(False)
        arrow.arrow_patch.set_clip_path(axis.patch)
        axis.text(
            *np.clip(end, 0.08 * shape, 0.92 * shape),
            name,
            color=colour,
            zorder=7,
            fontsize=size,
            weight="bold",
            ha="center",
            va="center",
            path_effects=_OUTLINE,
        )


def draw_moved_cloud(
    axes: Iterable[Axes],
    cameras: Sequence[Camera],
    cloud: Real[np.ndarray, "n 3"],
    poses: Sequence[Sim3],
    names: Sequence[str] | None = ("", "", ""),
    size: float = 3,
) -> None:
    """Draw points of the reference camera's frame, and its axes, over the images of cameras, each
    with its own pose.

    The colour of a point is its position along the object. `names` are the labels of the axes; None
    draws no axes.
    """
    colours = coordinate_colours(cloud)
    middle = cloud.mean(axis=0)
    ends = middle + 2 * axis_deviation(cloud) * np.eye(3)  # arrows of two standard deviations
    for axis, camera, pose in zip(axes, cameras, poses):
        draw_points(axis, camera, pose.apply(cloud), colours, size)
        if names is not None:
            draw_axes(axis, camera, pose.apply(middle), pose.apply(ends), names)


def show_residuals(
    views: Sequence[View],
    points: Sequence[Real[np.ndarray, "n 3"]],
    fits: Mapping[str, Sim3],
) -> Figure:
    """Show below each title the target with the reference's points, moved by a fit.

    `views` are those of the reference and of the target, and `points` the points of their matches.
    A disc marks the partner in the target of a moved point that is less than 0.2 from it; every
    third of the other matches has a line from its moved point to the partner.
    """
    camera = views[1].frame.camera
    figure, axes = show_images([pale(views[1].frame.rgb)] * len(fits), list(fits), size=4)
    cloud = object_cloud(views[0], most=900)
    draw_moved_cloud(axes, [camera] * len(fits), cloud, list(fits.values()), names=None, size=5)
    for axis, fit in zip(axes, fits.values()):
        fitted = fit.apply(points[0])
        inliers = np.linalg.norm(fitted - points[1], axis=1) < _RESIDUAL
        starts, partners = (camera.project(camera.to_world(p))[0] for p in (fitted, points[1]))
        lines = np.stack([starts, partners], axis=1)[~inliers][::3]
        style = {"linewidths": 1.5, "label": "moved point to partner, far apart (every third)"}
        axis.add_collection(LineCollection(lines, colors=VERMILLION, zorder=5, **style))
        style = {"edgecolors": "white", "label": "partner that the moved point meets"}
        axis.scatter(*partners[inliers].T, s=45, c=BLUE, zorder=6, **style)
    _legend(figure, axes[0], "outside lower center")
    return figure


def moved_points(
    estimates: Mapping[str, PoseEstimate], size: float = 3.4, columns: int | None = None
) -> Figure:
    """Show the reference under its own points, and for each estimate its target view under the
    moved points."""
    views = chosen_views(estimates.values())
    titles = ["reference, its own points", *estimates]
    figure, axes = show_images([pale(view.frame.rgb) for view in views], titles, columns, size)
    draw_estimates(axes, estimates.values(), most=1500, size=5)
    return figure


def chosen_views(estimates: Collection[PoseEstimate]) -> list[View]:
    """Return the reference of estimates, and for each its target view."""
    first, *_ = estimates
    targets = [estimate.target_views[estimate.view] for estimate in estimates]
    return [first.reference_view, *targets]


def draw_estimates(
    axes: Iterable[Axes], estimates: Collection[PoseEstimate], most: int = 20000, size: float = 3
) -> None:
    """Draw at most `most` points of the reference over the images of `chosen_views`, moved by each
    estimate."""
    views = chosen_views(estimates)
    cameras = [view.frame.camera for view in views]
    poses = [Sim3.identity(), *(_rounded(estimate.sim3) for estimate in estimates)]
    cloud = object_cloud(views[0], most)
    draw_moved_cloud(axes, cameras, cloud, poses, names=None, size=size)


def _rounded(pose: Sim3) -> Sim3:
    """Round a pose, so that pictures do not depend on its last digits, which the number of threads
    changes."""
    turn = Rotation.from_rotvec(Rotation.from_matrix(pose.R).as_rotvec().round(3))
    return Sim3(round(pose.scale, 3), turn.as_matrix(), pose.t.round(3))


def coordinate_colours(points: Real[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Colour points by their position along the cloud's first principal axis."""
    points = np.asarray(points, dtype=np.float64)
    centred = points - points.mean(axis=0)
    axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]  # of the largest eigenvalue
    along = centred @ axis
    shares = (along - along.min()) / max(np.ptp(along), 1e-12)
    return plt.get_cmap("viridis")(shares)[:, :3]


def object_cloud(view: View, most: int = 2000) -> Float[np.ndarray, "n 3"]:
    """Gather a view's object points for display, without outliers.

    The object is where the mask is above 0.9, which leaves out its border; without a mask, the
    foreground patches.
    """
    # A view without a mask has a soft one by saliency: 0.5 at the threshold of the foreground.
    return frame_cloud(view.frame, view.soft_mask > 0.5, most)


def frame_cloud(
    frame: Frame, inside: Bool[np.ndarray, "height width"] | bool = True, most: int = 2000
) -> Float[np.ndarray, "n 3"]:
    """Gather a frame's object points as `object_cloud` does; without a mask, the points of the
    pixels `inside`."""
    if frame.depth is None:
        raise InputError(f"{frame.name or 'frame'}: no depth map")
    inside = inside if frame.mask is None else frame.mask > _INSIDE
    points = unproject_depth(frame.depth, frame.camera)[inside & (frame.depth > 0)]
    if len(points) == 0:
        raise InputError(f"{frame.name or 'frame'}: no pixel of the object has a known depth")
    points = points[near_median(points, _OUTLIER)]
    if len(points) > most:
        chosen = np.random.default_rng(0).choice(len(points), most, replace=False)
        points = points[np.sort(chosen)]
    return points


def _panels(
    number: int, columns: int | None, width: float, height: float
) -> tuple[Figure, list[Axes]]:
    """Return panels of a size in inches in a grid, in one row if `columns` is None."""
    columns = min(columns or number, number)
    rows = -(-number // columns)  # rounded up
    size = (columns * width, rows * height)
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.flat[number:]:
        axis.remove()
    return figure, list(axes.flat[:number])


def _legend(figure: Figure, axis: Axes, place: str = "outside upper center") -> Legend:
    """Add a legend to a figure, with the names of one axis, in up to four columns."""
    handles, names = axis.get_legend_handles_labels()
    return figure.legend(handles, names, ncols=min(len(names), 4), fontsize=9, loc=place)


def _lines_of(titles: Iterable[str]) -> int:
    """Return the number of lines of the highest title."""
    return max((title.count("\n") + 1 for title in titles), default=0)


def _size(axis: Axes) -> tuple[int, int]:
    """Return the size (H, W) of the image that covers an axis (see `draw_image` for its limits)."""
    return round(axis.get_ylim()[0]), round(axis.get_xlim()[1])
