"""Plots of every stage of the method, as primitives to combine.

`show_images` shows images side by side; `overlay_map`, `mark`, `circle_patch`, `draw_points` and `draw_axes` add to its
axes. `show_maps` shows maps over images, `show_matches` lines between two images, `show_curves`, `show_panels` and
`show_intervals` values over x. Colours are distinguishable with colour-vision deficiencies.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float, Integer, Real, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import ConnectionPatch, Rectangle
from matplotlib.patheffects import Normal, Stroke
from matplotlib.transforms import offset_copy
from numpy.typing import ArrayLike

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import unproject_depth
from zsp_lite.errors import InputError
from zsp_lite.points import axis_deviation, near_median, object_pixels
from zsp_lite.views import View

# The palette of Okabe and Ito: distinguishable with the common colour-vision deficiencies.
BLUE, ORANGE, GREEN, VERMILLION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
CHOSEN = ORANGE
# Of several curves or groups of points in one figure, in this order.
COLOURS = BLUE, ORANGE, GREEN, VERMILLION
LINES = "-", "--", "-.", ":"
MARKERS = "o", "s", "^", "D"
_AXIS_COLOURS = VERMILLION, GREEN, BLUE
_FONT = 10
_MARKED = 20  # points of a curve; more have no markers
_WHITE_BOX = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
_INTERIOR = 0.9  # a pixel is on the object and not at its border if its mask probability is above this


def plain_text(text: str) -> str:
    """Escape a text for matplotlib, which reads what is between two dollar signs as TeX."""
    return text.encode(errors="replace").decode().replace("$", r"\$")


def show_images(
    images: Sequence[np.ndarray], titles: Sequence[str] | None = None, columns: int | None = None, size: float = 2.4
) -> tuple[Figure, list[Axes]]:
    """Show images (H, W, 3) or (H, W) in a grid, each `size` inches wide; returns the figure and one axis per image.

    Pixel (x, y) of an image is at (x, y) of its axes, [0, W] x [0, H].
    """
    columns = min(columns or len(images), len(images))
    rows = -(-len(images) // columns)
    aspect = max(np.shape(image)[0] / np.shape(image)[1] for image in images)
    title_height = 0.1 + 0.2 * max((title.count("\n") + 1 for title in titles or []), default=0)
    height = (size * aspect + title_height) * rows
    figure, grid = plt.subplots(rows, columns, figsize=(size * columns, height), squeeze=False, layout="constrained")
    axes = list(grid.flat)
    for axis in axes:
        axis.set_axis_off()
    for axis, image in zip(axes, images):
        _draw_image(axis, image)
    for axis, title in zip(axes, titles or []):
        axis.set_title(plain_text(title), fontsize=_FONT)
    return figure, axes[: len(images)]


def overlay_map(
    axis: Axes,
    values: Real[np.ndarray, "rows cols"],
    alpha: float = 0.65,
    cmap: str = "viridis",
    limits: tuple[float, float] | None = None,
    label: str | None = None,
) -> AxesImage:
    """Draw a map on the patch grid over the image of an axis, transparent where it is not finite.

    `limits` are the values at the ends of the colour map, `label` is that of a colour bar. `set_data` fills it anew.
    """
    left, right = axis.get_xlim()
    bottom, top = axis.get_ylim()
    values = np.ma.masked_invalid(np.asarray(values, dtype=np.float64))
    low, high = limits or (None, None)
    drawn = axis.imshow(
        values, cmap=cmap, alpha=alpha, extent=(left, right, bottom, top), interpolation="nearest", vmin=low, vmax=high
    )
    if label is not None:
        bar = axis.figure.colorbar(drawn, ax=axis, location="bottom", shrink=0.85, pad=0.02)
        bar.set_label(label, fontsize=_FONT - 1)
        bar.ax.tick_params(labelsize=_FONT - 2)
    return drawn


def mark(axis: Axes, text: str, colour: str = CHOSEN) -> None:
    """Draw a coloured frame around the image of an axis and write `text` in its corner."""
    axis.add_patch(
        Rectangle((0, 0), 1, 1, transform=axis.transAxes, fill=False, edgecolor=colour, linewidth=5, zorder=10)
    )
    axis.text(0.04, 0.95, text, transform=axis.transAxes, va="top", fontsize=_FONT, weight="bold", bbox=_WHITE_BOX)


def patch_centres(
    cells: Integer[np.ndarray, "n 2"], grid: tuple[int, int], size: tuple[int, int]
) -> Float[np.ndarray, "n 2"]:
    """Return the pixels (x, y) of the centres of patches (row, col) of a grid over an image of `size` (H, W)."""
    scale = np.array([size[1] / grid[1], size[0] / grid[0]])
    return (np.asarray(cells)[:, ::-1] + 0.5) * scale


def circle_patch(axis: Axes, cell: tuple[int, int], grid: tuple[int, int], image: np.ndarray, size: float = 7) -> None:
    """Mark a patch (row, col) of the image of an axis by a white circle."""
    (centre,) = patch_centres(np.array([cell]), grid, image.shape[:2])
    axis.plot(*centre, "o", color="white", markersize=size, markeredgecolor="black")


def show_matches(
    images: Sequence[np.ndarray],
    cells: Sequence[Integer[np.ndarray, "n 2"]],
    grid: tuple[int, int],
    inliers: Bool[np.ndarray, " n"] | None = None,
    titles: Sequence[str] = ("reference", "target"),
    size: float = 3.4,
) -> Figure:
    """Show two images with a line for each match of patches (row, col); outliers are thin, dashed and grey.

    The colour of an inlier depends on its row in the first image, so that lines can be told apart.
    """
    first, second = (patch_centres(own, grid, image.shape[:2]) for own, image in zip(cells, images))
    inliers = np.ones(len(first), bool) if inliers is None else inliers
    figure, (left, right) = show_images(images, titles, size=size)
    # plasma without its brightest end, which is not visible on light images.
    colours = plt.get_cmap("plasma")(0.85 * first[:, 1] / len(images[0]))
    for a, b, good, colour in sorted(zip(first, second, inliers, colours, strict=True), key=lambda match: match[2]):
        style = {"color": "0.35", "linewidth": 0.7, "linestyle": (0, (4, 3)), "alpha": 0.7}
        if good:  # with a white outline, to be visible on dark images
            style = {
                "color": colour,
                "linewidth": 1.8,
                "path_effects": [Stroke(linewidth=3, foreground="white"), Normal()],
            }
        figure.add_artist(ConnectionPatch(a, b, "data", "data", axesA=left, axesB=right, zorder=5, **style))
        for axis, pixel in ((left, a), (right, b)):
            axis.plot(
                *pixel,
                marker="o" if good else "x",
                markersize=5 if good else 4,
                color=style["color"],
                markeredgecolor="white" if good else style["color"],
                markeredgewidth=0.7,
            )
    return figure


def draw_curves(axis: Axes, curves: Mapping[str, tuple[ArrayLike, ArrayLike]]) -> None:
    """Draw up to four curves (x, y) that differ in colour, line and marker, each with its name for the legend."""
    for (name, (x, y)), colour, line, marker in zip(curves.items(), COLOURS, LINES, MARKERS):
        marker = marker if len(x) <= _MARKED else None
        axis.plot(x, y, line, marker=marker, color=colour, label=name, markersize=5)


def show_curves(x: ArrayLike, curves: Mapping[str, ArrayLike], **labels: Any) -> Figure:
    """Show up to four curves over x; `labels` is what `Axes.set` takes, such as xlabel, ylabel and ylim."""
    figure, axis = plt.subplots(figsize=(7, 3.5), layout="constrained")
    draw_curves(axis, {name: (x, y) for name, y in curves.items()})
    axis.set(**labels)
    figure.legend(ncols=len(curves), fontsize=9, loc="outside upper center")
    return figure


def show_panels(
    panels: Mapping[str, Mapping[str, tuple[ArrayLike, ArrayLike]]], columns: int | None = None, **labels: Any
) -> Figure:
    """Show up to four curves (x, y) in each panel, by its title, with one legend; `labels` is what `Axes.set` takes."""
    columns = min(columns or len(panels), len(panels))
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(10, 3.4 * rows), layout="constrained", squeeze=False)
    for axis, (title, curves) in zip(axes.flat, panels.items()):
        draw_curves(axis, curves)
        axis.set(title=title, **labels)
    names = axes[0, 0].get_legend_handles_labels()
    figure.legend(*names, ncols=len(names[0]), fontsize=9, loc="outside upper center")
    return figure


def show_intervals(
    x: ArrayLike, intervals: Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]], joined: bool = True, **labels: Any
) -> Figure:
    """Show up to four rows of values over x, each value with a bar from its lower to its upper end.

    A row is (values, lower ends, upper ends) by its name; bars at one x stand beside each other. A line joins the
    values of a row if they are `joined`; `labels` is what `Axes.set` takes.
    """
    figure, axis = plt.subplots(figsize=(7, 3.8), layout="constrained")
    styles = zip(intervals.items(), COLOURS, LINES, MARKERS)
    for place, ((name, (values, low, high)), colour, line, marker) in enumerate(styles):
        beside = offset_copy(axis.transData, figure, x=5 * (place - (len(intervals) - 1) / 2), units="points")
        line = line if joined else "none"
        (row,) = axis.plot(x, values, linestyle=line, marker=marker, color=colour, label=name)
        for artist in (row, axis.vlines(x, low, high, color=colour, alpha=0.5, linewidth=3)):
            artist.set_transform(beside)  # after the limits of the axis are known
    axis.set(**labels)
    axis.minorticks_off()
    figure.legend(ncols=len(intervals), fontsize=9, loc="outside upper center")
    return figure


def show_maps(
    images: Sequence[np.ndarray],
    maps: Mapping[str, Real[np.ndarray, "rows cols"]],
    columns: int | None = None,
    size: float = 3.0,
    circles: Sequence[tuple[int, int]] = (),
    **style: Any,
) -> Figure:
    """Show each map, by its title, over its image, with a circle around one of its patches (row, col) where given.

    `style` is what `overlay_map` takes.
    """
    figure, axes = show_images(images, list(maps), columns, size)
    for axis, values in zip(axes, maps.values()):
        overlay_map(axis, values, **style)
    for axis, cell, values, image in zip(axes, circles, maps.values(), images):
        circle_patch(axis, cell, values.shape, image)
    return figure


def pca_colours(
    maps: Sequence[Real[np.ndarray, "rows cols d"]], foreground: Sequence[Bool[np.ndarray, "rows cols"]] | None = None
) -> list[Float[np.ndarray, "rows cols 3"]]:
    """Map features to colours by their first three principal components, which all maps share.

    Each component is scaled to its range from the 2nd to the 98th percentile, which is robust to outliers. Similar
    colours mean similar features, also between images. The components are fitted to the `foreground` patches; others
    are white. The result has an RGB image in [0, 1] for each map, with one pixel per patch.
    """
    features = [np.asarray(features, dtype=np.float64) for features in maps]
    if foreground is None:
        foreground = [np.ones(features.shape[:2], bool) for features in features]
    inside = np.concatenate([feature[np.asarray(where, bool)] for feature, where in zip(features, foreground)])
    mean = inside.mean(axis=0)
    axes = np.linalg.eigh((inside - mean).T @ (inside - mean))[1][:, :-4:-1]
    low, high = np.percentile((inside - mean) @ axes, [2, 98], axis=0)
    span = np.where(high > low, high - low, 1.0)
    return [
        np.where(np.asarray(where, bool)[..., None], (((feature - mean) @ axes - low) / span).clip(0, 1), 1.0)
        for feature, where in zip(features, foreground)
    ]


def draw_points(
    axis: Axes, camera: Camera, points: Real[np.ndarray, "n 3"], colours: np.ndarray | str = BLUE, size: float = 5.0
) -> None:
    """Draw points of a camera's frame in its image, far ones first; those behind the camera are left out."""
    points = np.asarray(points, dtype=np.float64)
    order = np.argsort(-points[:, 2])
    order = order[points[order, 2] > 0]
    pixels, _ = camera.project(camera.to_world(points[order]))
    colours = colours if isinstance(colours, str) else np.asarray(colours)[order]
    axis.scatter(*pixels.T, s=size, c=colours, linewidths=0, alpha=0.85, zorder=3)
    _keep_limits(axis, camera.size)


def draw_axes(
    axis: Axes,
    camera: Camera,
    to_camera: Callable[[np.ndarray], np.ndarray],
    origin: Real[np.ndarray, "3"],
    length: float,
    names: Sequence[str] = ("x", "y", "z"),
) -> None:
    """Draw the three axes of a coordinate frame in the image of a camera; `to_camera` maps the frame to the camera's.

    Axes with an end behind the camera are left out.
    """
    ends = np.asarray(to_camera(np.asarray(origin) + length * np.vstack([np.zeros(3), np.eye(3)])))
    pixels, depth = camera.project(camera.to_world(ends))
    for name, colour, end, near in zip(names, _AXIS_COLOURS, pixels[1:], depth[1:]):
        if min(near, depth[0]) <= 0:
            continue
        axis.annotate(
            "",
            end,
            pixels[0],
            zorder=6,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 2, "shrinkA": 0, "shrinkB": 0},
        )
        axis.text(
            *end,
            name,
            color=colour,
            fontsize=_FONT,
            weight="bold",
            zorder=7,
            ha="center",
            va="center",
            path_effects=[Stroke(linewidth=3, foreground="white"), Normal()],
        )
    _keep_limits(axis, camera.size)


def draw_moved_cloud(
    axes: Iterable[Axes],
    cameras: Sequence[Camera],
    cloud: Real[np.ndarray, "n 3"],
    poses: Sequence[Sim3],
    names: Sequence[str] | None = ("", "", ""),
) -> None:
    """Draw points of the reference camera's frame, and its axes, over the images of cameras, each with its own pose.

    `names` are the labels of the axes; None draws no axes.
    """
    colours, length = coordinate_colours(cloud), 2 * axis_deviation(cloud)
    for axis, camera, pose in zip(axes, cameras, poses):
        draw_points(axis, camera, pose.apply(cloud), colours, size=3)
        if names is not None:
            draw_axes(axis, camera, pose.apply, cloud.mean(axis=0), length, names)


def coordinate_colours(points: Real[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Colour points by their position along the first principal axis of the cloud.

    Drawn over the image of another object, the gradient shows the orientation of the cloud.
    """
    points = np.asarray(points, dtype=np.float64)
    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return plt.get_cmap("viridis")((along - along.min()) / max(np.ptp(along), 1e-12))[:, :3]


def object_cloud(view: View, most: int = 2000, seed: int = 0) -> Float[np.ndarray, "n 3"]:
    """Gather a view's object points for display, without outliers.

    The object is where the mask is above 0.9, which leaves out its border; without a mask, the foreground patches.
    """
    return coloured_cloud(view, most, seed)[0]


def coloured_cloud(
    view: View, most: int = 2000, seed: int = 0
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Gather the points of `object_cloud` with their RGB colours in the image."""
    frame = view.frame
    pixels = object_pixels(frame, _INTERIOR)
    if frame.mask is None:
        rows, cols = (np.arange(n) * m // n for n, m in zip(pixels.shape, view.foreground.shape))
        pixels &= view.foreground.cpu().numpy()[np.ix_(rows, cols)]
    points, colours = unproject_depth(frame.depth, frame.camera)[pixels], frame.rgb[pixels]
    if len(points) == 0:
        raise InputError(f"{frame.name or 'frame'}: no pixel of the object has a known depth")
    kept = np.flatnonzero(near_median(points, 2.5))
    if len(kept) > most:
        kept = kept[np.sort(np.random.default_rng(seed).choice(len(kept), most, replace=False))]
    return points[kept], colours[kept]


def _draw_image(axis: Axes, image: np.ndarray) -> None:
    height, width = np.shape(image)[:2]
    axis.imshow(image, cmap="gray", extent=(0, width, height, 0), interpolation="nearest")


def _keep_limits(axis: Axes, size: tuple[int, int]) -> None:
    axis.set_xlim(0, size[1])
    axis.set_ylim(size[0], 0)
