"""Widgets on features: where a patch attends, what layer, facet and context change, where the object begins."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from zsp_lite.backbones.backbone import Backbone, normalize, prepare_images
from zsp_lite.backbones.facets import FACETS
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.best_view import mask_iou
from zsp_lite.errors import InputError
from zsp_lite.matching import key_similarities, similarity
from zsp_lite.synthetic.ground_truth import correct_matches
from zsp_lite.views import View, patch_mask
from zsp_lite.viz import plots
from zsp_lite.widgets.common import (
    choice,
    example_pair,
    example_truth,
    explorer,
    patch_box,
    patch_map,
    patch_slider,
    slider,
)

if TYPE_CHECKING:
    from ipywidgets import VBox

Image = UInt8[np.ndarray, "height width 3"]


def all_facets(backbone: Backbone, images: Sequence[Image]) -> dict[tuple[int, str], Float[Tensor, "batch tokens dim"]]:
    """Query, key, value and output token of every token (CLS first) in every layer, by (layer, facet), in one pass.

    Raises InputError for a backbone in Hugging Face's format, whose blocks are built otherwise.
    """
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
) -> "VBox":
    """Choose a patch, a layer and a head; see the softmax weights with which that patch attends to all patches.

    queries, keys: of all tokens, CLS first, heads concatenated.
    """
    layers, _, dim = queries.shape
    size = image.shape[:2]
    figure, axes = plots.show_images([image, image], ["query: the framed patch", "attention weights"], size=3.2)
    box = patch_box(axes[0], grid, size, "query")
    weights = patch_map(axes[1], grid, size, alpha=0.8, label="weight, share of the largest")
    figure.set_figheight(4)  # room for the colour bar
    axes[0].set_anchor("N")

    def update(row: int, col: int, layer: int, head: int) -> str:
        part = slice(head * dim // heads, (head + 1) * dim // heads)
        query = queries[layer, 1 + row * grid[1] + col, part]
        found = (keys[layer, :, part] @ query * (dim // heads) ** -0.5).softmax(0)
        patches = found[1:].view(grid).numpy()
        top = np.unravel_index(patches.argmax(), grid)
        weights.set_data(patches / patches.max())
        box(row, col)
        return (
            f"Patch ({row}, {col}), layer {layer}, head {head}: most weight on patch ({top[0]}, {top[1]}), "
            f"{patches.max():.1%}, where even attention would give {1 / len(found):.1%}; CLS gets {found[0]:.1%}."
        )

    controls = {
        "row": patch_slider("row", grid[0], grid[0] // 2), "col": patch_slider("column", grid[1], grid[1] // 2),
        "layer": slider("layer", 0, layers - 1, layers * 3 // 4), "head": slider("head", 0, heads - 1, 0),
    }  # fmt: skip
    return explorer(figure, controls, update, "An image with one patch framed, and where that patch attends.")


def facets(
    reference: Image,
    target: Image,
    features: Mapping[tuple[int, str], tuple[Float[Tensor, "h w d"], Float[Tensor, "h w d"]]],
    partners: Int[np.ndarray, "h w 2"],
    found: Bool[np.ndarray, "h w"],
) -> "VBox":
    """Choose a patch, and by which layer and facet it is described; see its nearest neighbour and its true partner.

    features: of both images by (layer, facet).  partners, found: as `ground_truth_matches` returns them.
    """
    layers, names = sorted({layer for layer, _ in features}), list(dict.fromkeys(facet for _, facet in features))
    grid = found.shape

    @cache
    def compared(layer: int, facet: str) -> tuple[np.ndarray, np.ndarray, float]:
        sim = similarity(*features[layer, facet])
        nearest = np.stack(np.divmod(sim.argmax(1).numpy(), grid[1]), -1).reshape(*grid, 2)
        return sim.numpy(), nearest, correct_matches(nearest, partners)[found].mean()

    panels = _SimilarityPanels(reference, [target], grid, ["similarity to the framed patch"])

    def update(row: int, col: int, layer: int, facet: str) -> str:
        sim, nearest, share = compared(layer, facet)
        panels.place(row, col, partners[row, col] if found[row, col] else None)
        said = panels.fill(0, sim[row * grid[1] + col].reshape(grid), nearest[row, col])
        return (
            f"Layer {layer}, {facet}: {said} Of all {found.sum()} patches with a true partner here, {share:.0%} have "
            f"their nearest neighbour within one patch of it."
        )

    row, col = _first_patch(found)
    controls = {
        "row": patch_slider("row", grid[0], row), "col": patch_slider("column", grid[1], col),
        "layer": slider("layer", layers[0], layers[-1], layers[len(layers) * 3 // 4]),
        "facet": choice("facet", names, "key" if "key" in names else None),
    }  # fmt: skip
    alt = "A framed patch of the reference; in the target its similarities, nearest neighbour and true partner."
    return explorer(panels.figure, controls, update, alt)


def context(
    reference: Image,
    target: Image,
    keys: tuple[Float[Tensor, "h w d"], Float[Tensor, "h w d"]],
    partners: Int[np.ndarray, "h w 2"],
    found: Bool[np.ndarray, "h w"],
) -> "VBox":
    """Choose a patch; see its similarities by bare keys and by log-binned descriptors side by side."""
    grid = found.shape
    kinds = {"bare keys": key_similarities(keys[0], [keys[1]])[0], "log-binned": similarity(*keys)}
    sims = [sim.numpy() for sim in kinds.values()]
    panels = _SimilarityPanels(reference, [target, target], grid, list(kinds))

    def update(row: int, col: int) -> str:
        panels.place(row, col, partners[row, col] if found[row, col] else None)
        said = []
        for panel, (kind, sim) in enumerate(zip(kinds, sims)):
            similar = sim[row * grid[1] + col].reshape(grid)
            said.append(f"{kind}: {panels.fill(panel, similar, np.array(np.unravel_index(similar.argmax(), grid)))}")
        return "<br>".join(said)

    row, col = _first_patch(found)
    controls = {"row": patch_slider("row", grid[0], row), "col": patch_slider("column", grid[1], col)}
    alt = "A framed patch of the reference; in the target its similarities without and with context."
    return explorer(panels.figure, controls, update, alt)


def saliency(view: View) -> "VBox":
    """Choose the saliency's threshold; see which patches are foreground, and how well they fit the object's mask."""
    grid, size, values = view.features.grid, view.frame.camera.size, view.features.saliency.cpu().numpy()
    truth = patch_mask(view.frame, grid)
    thresholds = np.linspace(0, 1, 101)
    overlaps = [mask_iou(torch.from_numpy(values > threshold), truth) for threshold in thresholds]
    figure, axes = plots.show_images(
        [view.frame.rgb, view.frame.rgb], ["foreground", "overlap with the true mask"], size=3.2
    )
    shown = patch_map(axes[0], grid, size, label="saliency")
    figure.set_figheight(4)  # room for the colour bar
    axes[1].clear()
    axes[1].set_axis_on()
    axes[1].plot(thresholds, overlaps, color=plots.BLUE, linewidth=2)
    axes[1].set(xlabel="threshold", ylabel="IoU", xlim=(0, 1), ylim=(0, 1))
    axes[1].set_title("overlap with the true mask", fontsize=10)
    line = axes[1].axvline(0.05, color="black", linestyle="--")

    def update(threshold: float) -> str:
        on = values > threshold
        shown.set_data(np.where(on, values, np.nan))
        line.set_xdata([threshold, threshold])
        beside, missed = on & ~truth.numpy(), truth.numpy() & ~on
        return (
            f"Above {threshold:.2f}: {on.sum()} of {on.size} patches are foreground. {beside.sum()} of them lie beside "
            f"the object, {missed.sum()} of the object's {int(truth.sum())} are missed: "
            f"IoU {mask_iou(torch.from_numpy(on), truth):.2f}."
        )

    controls = {"threshold": slider("threshold", 0.0, 1.0, 0.05, 0.01)}
    return explorer(figure, controls, update, "Patches above the threshold, and a curve of IoU against the threshold.")


class _SimilarityPanels:
    """The reference with a framed patch, and pictures of the target with a map, a nearest neighbour, a true partner."""

    def __init__(self, reference: Image, targets: list[Image], grid: tuple[int, int], titles: list[str]):
        self.grid, self.size, self._true = grid, targets[0].shape[:2], None
        self.figure, axes = plots.show_images([reference, *targets], ["reference", *titles], size=3.0)
        self.figure.set_figheight(3.9)  # room for colour bars
        self._box = patch_box(axes[0], grid, reference.shape[:2], "u")
        self._maps = [patch_map(axis, grid, self.size, (0, 1), label="cosine") for axis in axes[1:]]
        look = {"markeredgecolor": "black", "linestyle": "none", "zorder": 8}
        star = {"marker": "*", "color": plots.ORANGE, "markersize": 19, "label": "true partner"} | look
        dot = {"marker": "o", "color": "white", "markersize": 9, "label": "nearest neighbour"} | look
        self._stars = [axis.plot([], [], **star)[0] for axis in axes[1:]]
        self._dots = [axis.plot([], [], **dot)[0] for axis in axes[1:]]
        handles = [self._stars[0], self._dots[0]]
        axes[0].legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.04), fontsize=9, frameon=False)

    def place(self, row: int, col: int, true: Int[np.ndarray, "2"] | None) -> None:
        """Frame the patch, and star its true partner where it is known."""
        self._box(row, col)
        self._true = true
        for star in self._stars:
            star.set_data(*([[], []] if true is None else plots.patch_centres(true[None], self.grid, self.size).T))

    def fill(self, panel: int, similar: Float[np.ndarray, "rows cols"], nearest: Int[np.ndarray, "2"]) -> str:
        """Draw the map and its nearest neighbour; the sentence about them."""
        self._maps[panel].set_data(similar)
        self._dots[panel].set_data(*plots.patch_centres(nearest[None], self.grid, self.size).T)
        said = f"nearest neighbour ({nearest[0]}, {nearest[1]}), cosine {similar[tuple(nearest)]:.2f}; "
        if self._true is None:
            return said + "the true partner is not in sight."
        off = np.abs(np.subtract(nearest, self._true)).max()
        return said + f"the true partner is ({self._true[0]}, {self._true[1]}), off by {off}."


def _first_patch(found: Bool[np.ndarray, "rows cols"]) -> tuple[int, int]:
    """A patch with a known partner, near the middle of all that have one.  Raises InputError where none has."""
    cells = np.argwhere(found)
    if not len(cells):
        raise InputError("no patch of the reference has a true partner in the target, expected at least one")
    row, col = cells[np.abs(cells - np.median(cells, axis=0)).sum(axis=1).argmin()]
    return int(row), int(col)


def example_attention() -> "VBox":
    """`attention` on a sample object."""
    image, backbone = example_truth().reference.rgb, load_backbone("zsp-tiny", "cpu")
    found = all_facets(backbone, [image])
    queries, keys = (
        torch.cat([found[layer, facet] for layer in range(backbone.model.depth)]) for facet in ("query", "key")
    )
    return attention(image, queries, keys, (28, 28), backbone.model.num_heads)


def example_facets() -> "VBox":
    """`facets` on a sample pair."""
    truth = example_truth()
    found = all_facets(load_backbone("zsp-tiny", "cpu"), [truth.reference.rgb, truth.target.rgb])
    features = {name: tuple(values[:, 1:].unflatten(1, (28, 28))) for name, values in found.items()}
    return facets(truth.reference.rgb, truth.target.rgb, features, truth.cells, truth.valid)


def example_context() -> "VBox":
    """`context` on a sample pair."""
    truth, views = example_truth(), example_pair()
    keys = tuple(view.features.keys for view in views)
    return context(truth.reference.rgb, truth.target.rgb, keys, truth.cells, truth.valid)


def example_saliency() -> "VBox":
    """`saliency` on a sample object."""
    return saliency(example_pair()[0])
