"""The transformer against an independent one, built from PyTorch's blocks with the same weights."""

import pytest
import torch
import torch.nn.functional as F
from small_backbones import close, small_vit
from torch import nn
from torch.testing import assert_close

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.choices import FACETS

DEPTH, DIM, HEADS = 3, 48, 6
PATCH = 8  # pixels
# The parts of a block, in the order in which PyTorch keeps them.
PARTS = "attn.qkv attn.proj mlp.fc1 mlp.fc2 norm1 norm2".split()

# A small network for images of 32 x 32 pixels, a grid of 4 x 4 patches, and two images of noise.
MODEL = small_vit(embed_dim=DIM, depth=DEPTH, num_heads=HEADS, patch_size=PATCH)
IMAGES = torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))


def oracle():
    """Compute output tokens, and facets and attention of every block, by modules of PyTorch."""
    weights = MODEL.state_dict()
    kernel, bias = weights["patch_embed.proj.weight"], weights["patch_embed.proj.bias"]
    patches = F.conv2d(IMAGES, kernel, bias, stride=PATCH).flatten(2).mT
    x = torch.cat([weights["cls_token"].expand(len(IMAGES), 1, DIM), patches], dim=1)
    x = x + weights["pos_embed"]
    facets = []
    attentions = []
    for index in range(DEPTH):
        parts = [
            weights[f"blocks.{index}.{part}.{kind}"]
            for part in PARTS
            for kind in ("weight", "bias")
        ]
        # Four times as wide inside, without dropout, with GELU and DINO's epsilon.
        block = nn.TransformerEncoderLayer(
            DIM, HEADS, 4 * DIM, 0.0, F.gelu, 1e-6, batch_first=True, norm_first=True
        )
        block.load_state_dict(dict(zip(block.state_dict(), parts)))
        normed = block.norm1(x)
        projections = F.linear(normed, *parts[:2])
        _, probabilities = block.self_attn(normed, normed, normed, average_attn_weights=False)
        attentions.append(probabilities)
        x = block(x)
        facets.append(
            dict(zip(("query", "key", "value", "token"), (*projections.chunk(3, dim=-1), x)))
        )
    output = F.layer_norm(x, (DIM,), weights["norm.weight"], weights["norm.bias"], 1e-6)
    return output, facets, attentions


@pytest.mark.parametrize("gradients", [False, True])
def test_forward_equals_an_independent_transformer(gradients):
    # Attention has one implementation with gradients, and a faster one without.
    with torch.set_grad_enabled(gradients):
        output, _, _ = oracle()
        close(MODEL(IMAGES), output)


@pytest.mark.parametrize("facet", FACETS)
@pytest.mark.parametrize("layer", range(DEPTH))
def test_extract_gives_the_facet_cls_attention_and_cls_output(layer, facet):
    with torch.no_grad():
        tokens = MODEL.extract(IMAGES, layer, facet)
        output, facets, attentions = oracle()
    # Token 0 is CLS, the others are the patches.
    close(tokens.keys, facets[layer][facet][:, 1:])
    close(tokens.attention, attentions[-1][:, :, 0, 1:])
    close(tokens.cls, output[:, 0])
    assert tokens.grid == (4, 4)


@pytest.mark.parametrize("layer", range(DEPTH))
def test_training_forward_agrees_with_inference(layer):
    with torch.no_grad():
        training = MODEL.forward_training(IMAGES, layer)
        tokens = MODEL.extract(IMAGES, layer)
        close(training.tokens, MODEL(IMAGES))
    close(training.keys, tokens.keys)
    # Keys are the projection of their input; rows of the layer are queries, keys, values.
    qkv = MODEL.blocks[layer].attn.qkv
    close(F.linear(training.key_input, qkv.weight.chunk(3)[1], qkv.bias.chunk(3)[1]), tokens.keys)
    close(training.cls_logits.softmax(-1)[:, :, 1:], tokens.attention)


def test_state_dict_has_the_keys_and_shapes_of_dino_vits8():
    # 785 positions: CLS and 28 x 28 patches of 8 x 8 pixels.
    shapes = {"cls_token": (1, 1, 384), "pos_embed": (1, 785, 384)}
    layers = {"patch_embed.proj": (384, 3, 8, 8), "norm": (384,)}
    for block in range(12):
        layers[f"blocks.{block}.norm1"] = layers[f"blocks.{block}.norm2"] = (384,)
        layers[f"blocks.{block}.attn.qkv"] = (3 * 384, 384)
        layers[f"blocks.{block}.attn.proj"] = (384, 384)
        layers[f"blocks.{block}.mlp.fc1"] = (4 * 384, 384)
        layers[f"blocks.{block}.mlp.fc2"] = (384, 4 * 384)
    for name, shape in layers.items():
        shapes[f"{name}.weight"] = shape
        shapes[f"{name}.bias"] = shape[:1]
    with torch.device("meta"):  # shapes without memory
        vit = VisionTransformer()
    assert {name: tuple(x.shape) for name, x in vit.state_dict().items()} == shapes


def test_layer_norms_have_the_epsilon_of_dino():
    norms = [module for module in MODEL.modules() if isinstance(module, nn.LayerNorm)]
    assert {norm.eps for norm in norms} == {1e-6}


def test_the_position_embedding_of_another_grid_is_interpolated_as_by_dino():
    resized = MODEL.position_embedding((3, 6))
    assert_close(resized[:, 0], MODEL.pos_embed[:, 0])
    # DINO's own expression for an image of 24 x 48 pixels: it adds 0.1 against rounding.
    stored = MODEL.pos_embed[:, 1:].reshape(1, 4, 4, DIM).permute(0, 3, 1, 2)
    scale = ((24 // PATCH + 0.1) / 4, (48 // PATCH + 0.1) / 4)
    expected = F.interpolate(stored, scale_factor=scale, mode="bicubic")
    assert_close(resized[:, 1:], expected.permute(0, 2, 3, 1).reshape(1, 18, DIM))
