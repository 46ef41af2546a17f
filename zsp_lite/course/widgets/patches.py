"""Widgets on features: attention, similarities of one patch, and the saliency threshold."""

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib.artist import Artist
from torch import Tensor

from zsp_lite.backbones.backbone import Backbone, normalize, prepare_images
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.best_view import mask_iou
from zsp_lite.choices import FACETS
from zsp_lite.course.true_matches import correct_matches
from zsp_lite.course.widgets.common import (
    Widget,
    interactive_figure,
    load_package,
    patch_sliders,
    redrawing,
    slider,
)
from zsp_lite.errors import InputError
from zsp_lite.views import View, patch_mask
from zsp_lite.viz import plots

Image = UInt8[np.ndarray, "height width 3"]


def all_facets(
    backbone: Backbone, images: Sequence[Image]
) -> dict[tuple[int, str], Float[Tensor, "batch tokens dim"]]:
    """Compute the query, key, value and output of every token (CLS first) in every layer, in one
    forward pass."""
    model = backbone.model
    if not isinstance(model, VisionTransformer):
        raise InputError(
            f"{backbone.name}: not in DINO's layout, expected zsp-tiny, a DINO model or a "
            "checkpoint file"
        )
    batch = normalize(prepare_images(images, backbone.image_size), backbone.mean, backbone.std)
    facets = {}
    with torch.no_grad():
        x, _ = model.embed(batch.to(backbone.device))
        for layer, block in enumerate(model.blocks):
            activations = block(x)
            x = activations.token
            for facet in FACETS:
                facets[layer, facet] = getattr(activations, facet).cpu()
    return facets


def attention(
    image: Image,
    queries: Float[Tensor, "layers tokens dim"],
    keys: Float[Tensor, "layers tokens dim"],
    grid: tuple[int, int],
    heads: int,
) -> Widget:
    """Show the attention weights of one patch.

    Queries and keys are of all tokens, CLS first, with heads concatenated.
    """
    layers, _, dim = queries.shape
    figure, axes = plots.show_images([image, image], ["query patch", "attention weights"], size=3.2)
    outline = redrawing(plots.outline_patch)
    label = "weight relative to the largest"
    weights = plots.overlay_map(axes[1], np.zeros(grid), alpha=0.8, limits=(0, 1), label=label)
    figure.set_figheight(4)  # space for the colour bar
    axes[0].set_anchor("N")

    def update(row: int, col: int, layer: int, head: int) -> str:
        part = slice(head * dim // heads, (head + 1) * dim // heads)  # dimensions of the head
        query = queries[layer, 1 + row * grid[1] + col, part]
        # Weights of all tokens: the softmax of q · k / √d.
        tokens = (keys[layer, :, part] @ query * (dim // heads) ** -0.5).softmax(0)
        patches = tokens[1:].view(grid).numpy()
        top = np.unravel_index(patches.argmax(), grid)
        weights.set_data(patches / patches.max())
        outline(axes[0], (row, col), grid, label="query", linewidth=2, path_effects=plots.BORDER)
        return (
            f"Patch ({row}, {col}), layer {layer}, head {head}: the largest weight is "
            f"{patches.max():.1%} on patch "
            f"({top[0]}, {top[1]}); uniform attention would give {1 / len(tokens):.1%}. CLS "
            f"has {tokens[0]:.1%}."
        )

    controls = {
        **patch_sliders(grid, (grid[0] // 2, grid[1] // 2)),
        "layer": slider("layer", 0, layers - 1, layers * 3 // 4),
        "head": slider("head", 0, heads - 1, 0),
    }
    alt = "An image with one patch outlined, and the attention weights of that patch."
    return interactive_figure(figure, controls, update, alt)


def patch_similarities(
    reference: Image,
    target: Image,
    sims: Mapping[str, Float[Tensor, "n n"]],
    cells: Int[np.ndarray, "h w 2"],
    valid: Bool[np.ndarray, "h w"],
    start: str | None = None,
) -> Widget:
    """Show how similar one patch is to all patches of the target, its nearest neighbour and its
    true match.

    Args:
        reference: Image of the reference.
        target: Image of the target.
        sims: Similarities of all pairs of patches, by the name of their kind.
        cells: True match (row, col) of each reference patch, as of `ground_truth_matches`.
        valid: Whether a reference patch has a true match.
        start: Kind of similarity that is shown first; by default the first of `sims`.
    """
    grid = valid.shape
    figure, axes = plots.show_images(
        [reference, target], ["reference", "similarity to the patch u"], size=3.2
    )
    figure.set_figheight(4)  # space for the colour bar
    axes[0].set_anchor("N")
    shown = plots.overlay_map(
        axes[1], np.zeros(grid), limits=(0, 1), label="cosine; star: true match"
    )

    @redrawing
    def mark(cell: tuple[int, int], nearest: tuple[int, int]) -> list[Artist]:
        drawn = plots.outline_patch(
            axes[0], cell, grid, label="u", linewidth=2, path_effects=plots.BORDER
        )
        drawn += plots.circle_patch(axes[1], nearest, grid)
        if valid[cell]:
            drawn += plots.circle_patch(axes[1], cells[cell], grid, "*")
        return drawn

    @cache
    def share_correct(kind: str) -> float:
        # Numbers of the nearest neighbours, and their cells (rows, cols, 2).
        numbers = sims[kind].argmax(1).numpy()
        nearest = np.stack(np.divmod(numbers, grid[1]), -1).reshape(*grid, 2)
        return correct_matches(nearest, cells)[valid].mean()

    def update(row: int, col: int, kind: str) -> str:
        similar = sims[kind][row * grid[1] + col].view(grid).numpy()
        nearest = divmod(int(similar.argmax()), grid[1])
        shown.set_data(similar)
        mark((row, col), nearest)
        true = "the true match is not visible"
        if valid[row, col]:
            true_row, true_col = cells[row, col]
            distance = np.abs(np.subtract(nearest, cells[row, col])).max()
            true = f"true match ({true_row}, {true_col}), distance {distance} patches"
        return (
            f"{kind}: nearest neighbour {nearest}, cosine {similar[nearest]:.2f}; {true}. Of "
            f"the {valid.sum()} patches "
            f"with a true match, {share_correct(kind):.0%} have their nearest neighbour "
            "within one patch of it."
        )

    # It begins at the patch with a true match that is nearest to the middle of all of them.
    known = np.argwhere(valid)
    off_middle = np.abs(known - np.median(known, axis=0)).sum(axis=1)
    middle = tuple(known[off_middle.argmin()].tolist())
    kinds = load_package().Dropdown(
        options=list(sims), value=start or next(iter(sims)), description="similarity"
    )
    controls = {**patch_sliders(grid, middle), "kind": kinds}
    alt = (
        "A patch of the reference; its similarities, nearest neighbour and true match in the "
        "target."
    )
    return interactive_figure(figure, controls, update, alt)


def saliency(view: View) -> Widget:
    """Show the foreground patches above a saliency threshold, and their overlap with the object
    mask."""
    grid = view.features.grid
    values = view.features.saliency.numpy()
    truth = patch_mask(view.frame, grid)
    thresholds = np.linspace(0, 1, 101)
    overlaps = [mask_iou(torch.from_numpy(values > threshold), truth) for threshold in thresholds]
    titles = ["foreground", "overlap with the mask"]
    figure, axes = plots.show_images([view.frame.rgb, view.frame.rgb], titles, size=3.2)
    shown = plots.overlay_map(axes[0], np.zeros(grid), limits=(0, 1), label="saliency")
    figure.set_figheight(4)  # space for the colour bar
    axes[1].clear()
    axes[1].set_axis_on()
    axes[1].plot(thresholds, overlaps, color=plots.BLUE, linewidth=2)
    axes[1].set(xlabel="threshold", ylabel="IoU", xlim=(0, 1), ylim=(0, 1))
    axes[1].set_title("overlap with the mask", fontsize=10)
    line = axes[1].axvline(0.05, color="black", linestyle="--")

    def update(threshold: float) -> str:
        on = values > threshold
        shown.set_data(np.where(on, values, np.nan))
        line.set_xdata([threshold, threshold])
        wrong = on & ~truth.numpy()
        missed = truth.numpy() & ~on
        return (
            f"Above {threshold:.2f}: {on.sum()} of {on.size} patches are foreground. "
            f"{wrong.sum()} of them are not on "
            f"the object; {missed.sum()} of the {int(truth.sum())} object patches are missing. "
            f"IoU {mask_iou(torch.from_numpy(on), truth):.2f}."
        )

    controls = {"threshold": slider("threshold", 0.0, 1.0, 0.05, 0.01)}
    alt = "Patches above the threshold, and a curve of IoU against the threshold."
    return interactive_figure(figure, controls, update, alt)
