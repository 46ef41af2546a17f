"""Which block of a vision transformer, and which of the things it computes, describes a patch: both by name.

Amir et al. (2021) call these the layer and the facet and compare them; the paper takes the keys of one block.
"""

import re
from typing import TYPE_CHECKING, Literal, get_args

from jaxtyping import Float
from torch import Tensor

from zsp_lite.backbones.vit import Tokens, VisionTransformer
from zsp_lite.errors import InputError

if TYPE_CHECKING:
    from zsp_lite.backbones.huggingface import HuggingFaceViT

# What a block makes of its normalised input for its attention, or ("token") its output as it is, not normalised.
Facet = Literal["key", "query", "value", "token"]
FACETS: tuple[str, ...] = get_args(Facet)


def block_index(layer: int | str, depth: int, name: str = "backbone") -> int:
    """The block, counted from 0, that `layer` names: "last", "block9", or a number, negative ones from the end.

    Raises InputError, listing what there is.
    """
    text = str(layer).strip()
    if text == "last":
        return depth - 1
    if found := re.fullmatch(r"block(\d+)|(-?\d+)", text):
        index = int(found[1] or found[2])
        if -depth <= index < depth:
            return index % depth
    raise InputError(
        f"{name}: layer is {layer!r}, expected 'last', 'block0' to 'block{depth - 1}', or a number from {-depth} to "
        f"{depth - 1}"
    )


def check_facet(facet: str, name: str = "backbone") -> str:
    """The facet. Raises InputError where there is none of that name."""
    if facet not in FACETS:
        raise InputError(f"{name}: facet is {facet!r}, expected one of {', '.join(FACETS)}")
    return facet


def extract(
    model: "VisionTransformer | HuggingFaceViT", images: Float[Tensor, "batch 3 height width"], block: int, facet: str
) -> Tokens:
    """As the model's own `extract`, with the chosen facet of block `block` (from 0) in place of the keys."""
    if facet == "key":
        return model.extract(images, block)
    if not isinstance(model, VisionTransformer):
        return model.extract(images, block, facet)
    x, grid = model.embed(images)
    for index, layer in enumerate(model.blocks):
        _, q, k, v = layer.project(x)
        x = layer.finish(x, layer.attn(q, k, v))
        if index == block:
            chosen = {"query": q, "value": v, "token": x}[facet]
    attention = layer.attn.cls_logits(q, k).softmax(-1)
    return Tokens(chosen[:, 1:], attention[:, :, 1:], model.norm(x[:, 0]), grid)
