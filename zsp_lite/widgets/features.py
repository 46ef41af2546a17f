"""Widgets on features: attention, layers and facets, descriptors with context, and the saliency threshold."""

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from zsp_lite.backbones.backbone import Backbone, normalize, prepare_images
from zsp_lite.backbones.facets import FACETS
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.best_view import mask_iou
from zsp_lite.errors import InputError
from zsp_lite.matching import key_similarities, similarity
from zsp_lite.synthetic.ground_truth import correct_matches
from zsp_lite.views import View, patch_mask
from zsp_lite.viz import plots
from zsp_lite.widgets.common import Widget, choice, interactive_figure, patch_outline, patch_sliders, slider

Image = UInt8[np.ndarray, "height width 3"]


def all_facets(backbone: Backbone, images: Sequence[Image]) -> dict[tuple[int, str], Float[Tensor, "batch tokens dim"]]:
    """Compute the query, key, value and output of every token (CLS first) in every layer, in one forward pass."""
    model = backbone.model
    if not isinstance(model, VisionTransformer):
        raise InputError(f"{backbone.name}: not in DINO's layout, expected zsp-tiny, a DINO model or a checkpoint file")
    batch = normalize(prepare_images(images, backbone.image_size), backbone.mean, backbone.std)
    found = {}
    with torch.no_grad():
        x, _ = model.embed(batch.to(backbone.device))
        for layer, activations in enumerate(model.run_blocks(x)):
            found |= {(layer, facet): getattr(activations, facet).cpu() for facet in FACETS}
    return found


def attention(
    image: Image,
    queries: Float[Tensor, "layers tokens dim"],
    keys: Float[Tensor, "layers tokens dim"],
    grid: tuple[int, int],
    heads: int,
) -> Widget:
    """Show the attention weights of one patch; queries and keys are of all tokens, CLS first, heads concatenated."""
    layers, _, dim = queries.shape
    size = image.shape[:2]
    figure, axes = plots.show_images([image, image], ["query patch", "attention weights"], size=3.2)
    outline = patch_outline(axes[0], grid, size, "query")
    weights = plots.overlay_map(
        axes[1], np.zeros(grid), alpha=0.8, limits=(0, 1), label="weight relative to the largest"
    )
    figure.set_figheight(4)  # space for the colour bar
    axes[0].set_anchor("N")

    def update(row: int, col: int, layer: int, head: int) -> str:
        part = slice(head * dim // heads, (head + 1) * dim // heads)
        query = queries[layer, 1 + row * grid[1] + col, part]
        found = (keys[layer, :, part] @ query * (dim // heads) ** -0.5).softmax(0)
        patches = found[1:].view(grid).numpy()
        top = np.unravel_index(patches.argmax(), grid)
        weights.set_data(patches / patches.max())
        outline(row, col)
        return (
            f"Patch ({row}, {col}), layer {layer}, head {head}: the largest weight is {patches.max():.1%} on patch "
            f"({top[0]}, {top[1]}); uniform attention would give {1 / len(found):.1%}. CLS has {found[0]:.1%}."
        )

    controls = {
        **patch_sliders(grid, (grid[0] // 2, grid[1] // 2)),
        "layer": slider("layer", 0, layers - 1, layers * 3 // 4), "head": slider("head", 0, heads - 1, 0),
    }  # fmt: skip
    return interactive_figure(
        figure, controls, update, "An image with one patch outlined, and the attention weights of that patch."
    )


def facets(
    reference: Image,
    target: Image,
    features: Mapping[tuple[int, str], tuple[Float[Tensor, "h w d"], Float[Tensor, "h w d"]]],
    cells: Int[np.ndarray, "h w 2"],
    valid: Bool[np.ndarray, "h w"],
) -> Widget:
    """Show the similarities of one patch by each (layer, facet), its nearest neighbour and its true match.

    `cells` and `valid` are the true matches of the reference patches, from `ground_truth_matches`.
    """
    layers, names = sorted({layer for layer, _ in features}), list(dict.fromkeys(facet for _, facet in features))
    grid = valid.shape

    @cache
    def compared(layer: int, facet: str) -> tuple[np.ndarray, float]:
        sim = similarity(*features[layer, facet])
        nearest = np.stack(np.divmod(sim.argmax(1).numpy(), grid[1]), -1).reshape(*grid, 2)
        return sim.numpy(), correct_matches(nearest, cells)[valid].mean()

    panels = _SimilarityPanels(reference, [target], grid, ["similarity to the patch u"])

    def update(row: int, col: int, layer: int, facet: str) -> str:
        sim, share = compared(layer, facet)
        panels.place(row, col, cells[row, col] if valid[row, col] else None)
        text = panels.fill(0, sim[row * grid[1] + col].reshape(grid))
        return (
            f"Layer {layer}, {facet}: {text} Of the {valid.sum()} patches with a true match, {share:.0%} have their "
            "nearest neighbour within one patch of it."
        )

    controls = {
        **patch_sliders(grid, _first_patch(valid)),
        "layer": slider("layer", layers[0], layers[-1], layers[len(layers) * 3 // 4]),
        "facet": choice("facet", names, "key" if "key" in names else None),
    }  # fmt: skip
    alt = "A patch of the reference; its similarities, nearest neighbour and true match in the target."
    return interactive_figure(panels.figure, controls, update, alt)


def context(
    reference: Image,
    target: Image,
    keys: tuple[Float[Tensor, "h w d"], Float[Tensor, "h w d"]],
    cells: Int[np.ndarray, "h w 2"],
    valid: Bool[np.ndarray, "h w"],
) -> Widget:
    """Show the similarities of one patch by keys alone and by log-binned descriptors."""
    grid = valid.shape
    sims = {"keys": key_similarities(keys[0], [keys[1]])[0].numpy(), "log-binned": similarity(*keys).numpy()}
    panels = _SimilarityPanels(reference, [target, target], grid, list(sims))

    def update(row: int, col: int) -> str:
        panels.place(row, col, cells[row, col] if valid[row, col] else None)
        texts = [panels.fill(panel, sim[row * grid[1] + col].reshape(grid)) for panel, sim in enumerate(sims.values())]
        return "<br>".join(f"{kind}: {text}" for kind, text in zip(sims, texts))

    alt = "A patch of the reference; its similarities in the target without and with context."
    return interactive_figure(panels.figure, patch_sliders(grid, _first_patch(valid)), update, alt)


def saliency(view: View) -> Widget:
    """Show the foreground patches above a saliency threshold, and their overlap with the object mask."""
    grid, values = view.features.grid, view.features.saliency.cpu().numpy()
    truth = patch_mask(view.frame, grid)
    thresholds = np.linspace(0, 1, 101)
    overlaps = [mask_iou(torch.from_numpy(values > threshold), truth) for threshold in thresholds]
    figure, axes = plots.show_images(
        [view.frame.rgb, view.frame.rgb], ["foreground", "overlap with the mask"], size=3.2
    )
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
        wrong, missed = on & ~truth.numpy(), truth.numpy() & ~on
        return (
            f"Above {threshold:.2f}: {on.sum()} of {on.size} patches are foreground. {wrong.sum()} of them are not on "
            f"the object; {missed.sum()} of the {int(truth.sum())} object patches are missing. "
            f"IoU {mask_iou(torch.from_numpy(on), truth):.2f}."
        )

    controls = {"threshold": slider("threshold", 0.0, 1.0, 0.05, 0.01)}
    return interactive_figure(
        figure, controls, update, "Patches above the threshold, and a curve of IoU against the threshold."
    )


class _SimilarityPanels:
    """The reference with an outlined patch, and the target with its similarities, nearest neighbour and true match."""

    def __init__(self, reference: Image, targets: list[Image], grid: tuple[int, int], titles: list[str]):
        self.grid, self.size, self._true = grid, targets[0].shape[:2], None
        self.figure, axes = plots.show_images([reference, *targets], ["reference", *titles], size=3.0)
        self.figure.set_figheight(3.9)  # space for the colour bars
        self._outline = patch_outline(axes[0], grid, reference.shape[:2], "u")
        self._maps = [plots.overlay_map(axis, np.zeros(grid), limits=(0, 1), label="cosine") for axis in axes[1:]]
        style = {"markeredgecolor": "black", "linestyle": "none", "zorder": 8}
        star = {"marker": "*", "color": plots.ORANGE, "markersize": 19, "label": "true match"} | style
        dot = {"marker": "o", "color": "white", "markersize": 9, "label": "nearest neighbour"} | style
        self._stars = [axis.plot([], [], **star)[0] for axis in axes[1:]]
        self._dots = [axis.plot([], [], **dot)[0] for axis in axes[1:]]
        handles = [self._stars[0], self._dots[0]]
        axes[0].legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.04), fontsize=9, frameon=False)

    def place(self, row: int, col: int, true: Int[np.ndarray, "2"] | None) -> None:
        """Outline a patch and mark its true match, if there is one."""
        self._outline(row, col)
        self._true = true
        for star in self._stars:
            star.set_data(*([[], []] if true is None else plots.patch_centres(true[None], self.grid, self.size).T))

    def fill(self, panel: int, similar: Float[np.ndarray, "rows cols"]) -> str:
        """Draw the similarities and the nearest neighbour of the patch; returns the text about them."""
        nearest = np.array(np.unravel_index(similar.argmax(), similar.shape))
        self._maps[panel].set_data(similar)
        self._dots[panel].set_data(*plots.patch_centres(nearest[None], self.grid, self.size).T)
        text = f"nearest neighbour ({nearest[0]}, {nearest[1]}), cosine {similar[tuple(nearest)]:.2f}; "
        if self._true is None:
            return text + "the true match is not visible."
        error = np.abs(np.subtract(nearest, self._true)).max()
        return text + f"true match ({self._true[0]}, {self._true[1]}), distance {error} patches."


def _first_patch(valid: Bool[np.ndarray, "rows cols"]) -> tuple[int, int]:
    """Return the patch with a true match that is closest to the median of all such patches."""
    cells = np.argwhere(valid)
    row, col = cells[np.abs(cells - np.median(cells, axis=0)).sum(axis=1).argmin()]
    return int(row), int(col)
