"""Small backbones with random weights: a DINO transformer, and one of each architecture in Hugging
Face's format."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import torch
import transformers
from numpy.random import default_rng
from torch import nn
from torch.testing import assert_close
from transformers import AutoModel

from zsp_lite.backbones.vit import VisionTransformer

# Sizes of the models in Hugging Face's format: small, for speed, with more than one block and head.
DEPTH, HEADS, DIM = 3, 4, 32
# Mean and standard deviation of the colours of ImageNet, (3, 1, 1).
MEAN = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)
STD = torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)
# A square picture, and others that become square images.
SHAPES = (32, 32, 3), (50, 40, 3), (9, 64, 3)
PICTURES = [default_rng(0).integers(0, 256, shape, dtype=np.uint8) for shape in SHAPES]
# Two implementations in single precision agree up to these tolerances.
close = partial(assert_close, atol=2e-5, rtol=1e-4)


def small_vit(seed: int = 0, **sizes) -> VisionTransformer:
    """A DINO transformer with random weights; options replace its sizes."""
    torch.manual_seed(seed)
    # A grid of 4 x 4 patches; one head has the 64 dimensions of a head of every DINO model.
    standard = {"image_size": 32, "patch_size": 8, "embed_dim": 64, "depth": 3, "num_heads": 1}
    return with_large_weights(VisionTransformer(**(standard | sizes)))


def with_large_weights(model: nn.Module) -> nn.Module:
    """Replace the usual initial weights, which are too small to tell tokens apart."""
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=0.2)
    return model


@dataclass(frozen=True)
class Architecture:
    """What the tests know of an architecture of Hugging Face."""

    patch: int  # pixels along a patch
    special: int  # tokens before the patches
    norm: str = "layernorm_before"  # name of the norm before attention
    settings: dict = field(default_factory=dict)  # of its configuration
    # Whether it interpolates positions only if called with interpolate_pos_encoding=True; the
    # others always do.
    interpolates: bool = True


_REGISTERS = {"num_register_tokens": 4}
ARCHITECTURES = {
    "vit": Architecture(16, 1),
    "deit": Architecture(16, 2),
    "dinov2": Architecture(14, 1, "norm1", interpolates=False),
    "dinov2_with_registers": Architecture(14, 5, "norm1", settings=_REGISTERS, interpolates=False),
    "dinov3_vit": Architecture(16, 5, "norm1", settings=_REGISTERS, interpolates=False),
    "vit_mae": Architecture(16, 1),
    "clip": Architecture(14, 1, "layer_norm1"),
}


def configuration(kind: str, patch: int = 16, **settings):
    """Return a configuration; positions are stored for 3 x 3 patches, so every other image size
    interpolates them."""
    sizes = {
        "hidden_size": DIM,
        "num_hidden_layers": DEPTH,
        "num_attention_heads": HEADS,
        "intermediate_size": 64,
    }
    vision = sizes | {"patch_size": patch, "image_size": 3 * patch} | settings
    # The last two are refused by the library.
    if kind in ("clip", "siglip", "blip"):
        # Its text model is never run: any small vocabulary with three special tokens serves.
        text = sizes | {"vocab_size": 99, "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
        return transformers.CONFIG_MAPPING[kind](vision_config=vision, text_config=text)
    return transformers.CONFIG_MAPPING[kind](**vision)


def save_model(folder: Path, config) -> Path:
    """Save a model with random weights."""
    torch.manual_seed(0)
    with_large_weights(AutoModel.from_config(config)).save_pretrained(folder)
    return folder


def save_all(root: Path) -> dict[str, Path]:
    """Save a small model of each architecture; returns their folders."""
    configurations = {
        kind: configuration(kind, architecture.patch, **architecture.settings)
        for kind, architecture in ARCHITECTURES.items()
    }
    return {kind: save_model(root / kind, config) for kind, config in configurations.items()}
