"""Pictures of every stage, as primitives that are put on top of each other.

First `show_images` draws images side by side; then add to its axes: `overlay_map`, `mark`, `draw_points`,
`draw_axes`. `draw_matches` draws two images and the lines between them. Colours are safe for colour-blind readers.
"""

from collections.abc import Callable, Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Bool, Float, Integer, Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch, Rectangle
from matplotlib.patheffects import Normal, Stroke

from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError

# Okabe and Ito's palette: distinguishable with any of the common colour-vision deficiencies.
BLUE, ORANGE, GREEN, VERMILLION = "#0072B2", "#E69F00", "#009E73", "#D55E00"
CHOSEN = ORANGE
_AXIS_COLOURS = {"x": VERMILLION, "y": GREEN, "z": BLUE}
_FONT = 10
_WHITE_BOX = {"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}


def show_images(
    images: Sequence[np.ndarray],
    titles: Sequence[str] | None = None,
    columns: int | None = None,
    size: float = 2.4,
) -> tuple[Figure, list[Axes]]:
    """Images (H, W, 3) or (H, W) side by side, `columns` to a row, each `size` inches wide, without ticks.

    Pixel (x, y) of an image is (x, y) of its axes: the picture covers [0, W] x [0, H]. Raises InputError on
    no image, and where there is not one title to an image.
    """
    if len(images) == 0:
        raise InputError("images is empty, expected at least one (H, W, 3) array")
    if titles is not None and len(titles) != len(images):
        raise InputError(f"titles has {len(titles)} entries, expected one for each of the {len(images)} images")
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
        axis.set_title(title, fontsize=_FONT)
    return figure, axes[: len(images)]


def overlay_map(
    axis: Axes,
    values: Real[np.ndarray, "rows cols"],
    alpha: float = 0.65,
    cmap: str = "viridis",
    limits: tuple[float, float] | None = None,
    label: str | None = None,
) -> None:
    """A map on the patch grid (saliency, cyclical distances) over the image of `axis`, stretched to its size.

    Patches whose value is not finite (off the foreground) stay clear. `limits` are the values at the ends of
    the colour map; `label` adds a colour bar with that text.
    """
    left, right = axis.get_xlim()
    bottom, top = axis.get_ylim()
    values = np.ma.masked_invalid(np.asarray(values, dtype=np.float64))
    low, high = limits or (None, None)
    drawn = axis.imshow(
        values,
        cmap=cmap,
        alpha=alpha,
        extent=(left, right, bottom, top),
        interpolation="nearest",
        vmin=low,
        vmax=high,
    )
    if label is not None:
        bar = axis.figure.colorbar(drawn, ax=axis, location="bottom", shrink=0.85, pad=0.02)
        bar.set_label(label, fontsize=_FONT - 1)
        bar.ax.tick_params(labelsize=_FONT - 2)


def mark(axis: Axes, text: str, colour: str = CHOSEN) -> None:
    """Frame the image of `axis` and write `text` into its corner: the marked one differs by more than its colour."""
    axis.add_patch(
        Rectangle((0, 0), 1, 1, transform=axis.transAxes, fill=False, edgecolor=colour, linewidth=5, zorder=10)
    )
    axis.text(0.04, 0.95, text, transform=axis.transAxes, va="top", fontsize=_FONT, weight="bold", bbox=_WHITE_BOX)


def patch_centres(
    cells: Integer[np.ndarray, "n 2"], grid: tuple[int, int], size: tuple[int, int]
) -> Float[np.ndarray, "n 2"]:
    """Pixels (x, y) of the centres of patches (row, col) of a (rows, cols) grid over an image of size (H, W)."""
    scale = np.array([size[1] / grid[1], size[0] / grid[0]])
    return (np.asarray(cells)[:, ::-1] + 0.5) * scale


def draw_matches(
    reference: np.ndarray,
    target: np.ndarray,
    reference_pixels: Real[np.ndarray, "n 2"],
    target_pixels: Real[np.ndarray, "n 2"],
    inliers: Bool[np.ndarray, " n"] | None = None,
    titles: tuple[str, str] = ("reference", "target"),
    size: float = 3.4,
) -> Figure:
    """Two images and a line for each match between pixels (x, y); outliers are thin, dashed and grey.

    Inliers take their colour from their height in the reference, so that a line can be followed across.
    `inliers` None draws all of them so. Raises InputError where the lengths differ.
    """
    reference_pixels, target_pixels = np.asarray(reference_pixels, float), np.asarray(target_pixels, float)
    inliers = np.ones(len(reference_pixels), bool) if inliers is None else np.asarray(inliers, bool)
    if not len(reference_pixels) == len(target_pixels) == len(inliers):
        raise InputError(
            f"matches come as {len(reference_pixels)} reference pixels, {len(target_pixels)} target pixels, "
            f"{len(inliers)} inlier flags, expected as many of each"
        )
    figure, (left, right) = show_images([reference, target], list(titles), size=size)
    # cividis without its brightest end, which would vanish on light images.
    colours = plt.get_cmap("cividis")(0.05 + 0.9 * reference_pixels[:, 1] / np.shape(reference)[0])
    for a, b, good, colour in sorted(
        zip(reference_pixels, target_pixels, inliers, colours), key=lambda match: match[2]
    ):
        look = {"color": "0.35", "linewidth": 0.7, "linestyle": (0, (4, 3)), "alpha": 0.7}
        if good:  # the white border keeps it visible on dark images too
            look = {
                "color": colour,
                "linewidth": 1.8,
                "path_effects": [Stroke(linewidth=3, foreground="white"), Normal()],
            }
        figure.add_artist(ConnectionPatch(a, b, "data", "data", axesA=left, axesB=right, zorder=5, **look))
        for axis, pixel in ((left, a), (right, b)):
            axis.plot(
                *pixel,
                marker="o" if good else "x",
                markersize=5 if good else 4,
                color=look["color"],
                markeredgecolor="white" if good else look["color"],
                markeredgewidth=0.7,
            )
    return figure


def pca_colours(
    maps: Sequence[Real[np.ndarray, "rows cols d"]],
    foreground: Sequence[Bool[np.ndarray, "rows cols"]] | None = None,
) -> list[Float[np.ndarray, "rows cols 3"]]:
    """Feature maps as colours: their first three principal components, the same ones for all maps, in [0, 1].

    Like colours mean like features, across images too. The components and their range are those of the
    `foreground` where it is given; all else is white. Raises InputError where fewer than three patches are left.
    """
    features = [np.asarray(features, dtype=np.float64) for features in maps]
    if foreground is None:
        foreground = [np.ones(features.shape[:2], bool) for features in features]
    inside = np.concatenate([feature[np.asarray(where, bool)] for feature, where in zip(features, foreground)])
    if len(inside) < 3 or inside.shape[1] < 3:
        raise InputError(f"{inside.shape[0]} patches of {inside.shape[1]} features, expected at least 3 of each")
    mean = inside.mean(axis=0)
    axes = np.linalg.eigh((inside - mean).T @ (inside - mean))[1][:, :-4:-1]
    low, high = np.percentile((inside - mean) @ axes, [2, 98], axis=0)
    span = np.where(high > low, high - low, 1.0)
    return [
        np.where(np.asarray(where, bool)[..., None], (((feature - mean) @ axes - low) / span).clip(0, 1), 1.0)
        for feature, where in zip(features, foreground)
    ]


def draw_points(
    axis: Axes,
    camera: Camera,
    points: Real[np.ndarray, "n 3"],
    colours: np.ndarray | str = BLUE,
    size: float = 5.0,
) -> None:
    """Camera-frame points over the image of `axis`, as `camera` sees them; those behind it are left out.

    Far points are drawn first, so that near ones cover them. `colours` is one colour or an (n, 3) array in [0, 1].
    """
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
) -> None:
    """A frame's x, y and z axes, `length` long from `origin`, over the image of `axis`.

    `to_camera` maps (n, 3) points of that frame to the camera's (a `Sim3.apply`, say). Axes with an end
    behind the camera are left out.
    """
    ends = np.asarray(to_camera(np.asarray(origin) + length * np.vstack([np.zeros(3), np.eye(3)])))
    pixels, depth = camera.project(camera.to_world(ends))
    for name, end, near in zip("xyz", pixels[1:], depth[1:]):
        if min(near, depth[0]) <= 0:
            continue
        axis.annotate(
            "",
            end,
            pixels[0],
            zorder=6,
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-|>",
                "color": _AXIS_COLOURS[name],
                "linewidth": 2,
                "shrinkA": 0,
                "shrinkB": 0,
            },
        )
        axis.text(
            *end,
            name,
            color=_AXIS_COLOURS[name],
            fontsize=_FONT,
            weight="bold",
            zorder=7,
            ha="center",
            va="center",
            path_effects=[Stroke(linewidth=3, foreground="white"), Normal()],
        )
    _keep_limits(axis, camera.size)


def coordinate_colours(points: Real[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """A colour for each point from its place along the cloud's longest axis (viridis), in [0, 1].

    Drawn over another object's image, the gradient shows which way round the cloud was placed.
    """
    points = np.asarray(points, dtype=np.float64)
    centred = points - points.mean(axis=0)
    along = centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return plt.get_cmap("viridis")((along - along.min()) / max(np.ptp(along), 1e-12))[:, :3]


def _draw_image(axis: Axes, image: np.ndarray) -> None:
    height, width = np.shape(image)[:2]
    axis.imshow(image, cmap="gray", extent=(0, width, height, 0), interpolation="nearest")


def _keep_limits(axis: Axes, size: tuple[int, int]) -> None:
    axis.set_xlim(0, size[1])
    axis.set_ylim(size[0], 0)
