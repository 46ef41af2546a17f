"""The transformer against an independent one built from torch.nn.MultiheadAttention with the same
weights."""

import pytest
import torch
import torch.nn.functional as F
from small_backbones import close
from torch import nn
from torch.testing import assert_close

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.choices import FACETS

DEPTH, DIM, HEADS = 3, 48, 6
PATCH = 8  # pixels


@pytest.fixture(scope="module")
def model() -> VisionTransformer:
    """A small network for images of 32 x 32 pixels, a grid of 4 x 4 patches."""
    torch.manual_seed(0)
    vit = VisionTransformer(32, PATCH, DIM, DEPTH, HEADS)
    # Weights so large that attention is far from uniform, and biases and norms matter.
    for parameter in vit.parameters():
        nn.init.normal_(parameter, std=0.3)
    return vit.eval()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """Two images of noise."""
    return torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))


def oracle(vit: VisionTransformer, images: torch.Tensor):
    """Compute output tokens, and facets and attention of every block, by modules of PyTorch."""
    weights = vit.state_dict()
    kernel, bias = weights["patch_embed.proj.weight"], weights["patch_embed.proj.bias"]
    patches = F.conv2d(images, kernel, bias, stride=PATCH).flatten(2).mT
    x = torch.cat([weights["cls_token"].expand(len(images), 1, DIM), patches], dim=1)
    x = x + weights["pos_embed"]
    facets = []
    attentions = []
    for index in range(DEPTH):
        w = {name.removeprefix(f"blocks.{index}."): weight for name, weight in weights.items()}
        attention = nn.MultiheadAttention(DIM, HEADS, batch_first=True)
        attention.load_state_dict(
            {
                "in_proj_weight": w["attn.qkv.weight"],
                "in_proj_bias": w["attn.qkv.bias"],
                "out_proj.weight": w["attn.proj.weight"],
                "out_proj.bias": w["attn.proj.bias"],
            }
        )
        normed = F.layer_norm(x, (DIM,), w["norm1.weight"], w["norm1.bias"], 1e-6)
        projections = F.linear(normed, w["attn.qkv.weight"], w["attn.qkv.bias"]).chunk(3, dim=-1)
        attended, probabilities = attention(normed, normed, normed, average_attn_weights=False)
        attentions.append(probabilities)
        x = x + attended
        hidden = F.layer_norm(x, (DIM,), w["norm2.weight"], w["norm2.bias"], 1e-6)
        hidden = F.gelu(F.linear(hidden, w["mlp.fc1.weight"], w["mlp.fc1.bias"]))
        x = x + F.linear(hidden, w["mlp.fc2.weight"], w["mlp.fc2.bias"])
        facets.append(dict(zip(("query", "key", "value", "token"), (*projections, x))))
    output = F.layer_norm(x, (DIM,), weights["norm.weight"], weights["norm.bias"], 1e-6)
    return output, facets, attentions


@pytest.mark.parametrize("gradients", [False, True])
def test_forward_equals_an_independent_transformer(model, images, gradients):
    # Attention has one implementation with gradients, and a faster one without.
    with torch.set_grad_enabled(gradients):
        output, _, _ = oracle(model, images)
        close(model(images), output)


@pytest.mark.parametrize("facet", FACETS)
@pytest.mark.parametrize("layer", range(DEPTH))
def test_extract_gives_the_facet_cls_attention_and_cls_output(model, images, layer, facet):
    with torch.no_grad():
        tokens = model.extract(images, layer, facet)
        output, facets, attentions = oracle(model, images)
    # Token 0 is CLS, the others are the patches.
    close(tokens.keys, facets[layer][facet][:, 1:])
    close(tokens.attention, attentions[-1][:, :, 0, 1:])
    close(tokens.cls, output[:, 0])
    assert tokens.grid == (4, 4)


@pytest.mark.parametrize("layer", range(DEPTH))
def test_training_forward_agrees_with_inference(model, images, layer):
    with torch.no_grad():
        training = model.forward_training(images, layer)
        tokens = model.extract(images, layer)
        close(training.tokens, model(images))
    close(training.keys, tokens.keys)
    # Keys are the projection of their input; rows of the layer are queries, keys, values.
    qkv = model.blocks[layer].attn.qkv
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


def test_layer_norms_have_the_epsilon_of_dino(model):
    norms = [module for module in model.modules() if isinstance(module, nn.LayerNorm)]
    assert {norm.eps for norm in norms} == {1e-6}


def test_the_position_embedding_of_another_grid_is_interpolated_as_by_dino(model):
    resized = model.position_embedding((3, 6))
    assert_close(resized[:, 0], model.pos_embed[:, 0])
    # DINO's own expression for an image of 24 x 48 pixels: it adds 0.1 against rounding.
    stored = model.pos_embed[:, 1:].reshape(1, 4, 4, DIM).permute(0, 3, 1, 2)
    scale = ((24 // PATCH + 0.1) / 4, (48 // PATCH + 0.1) / 4)
    expected = F.interpolate(stored, scale_factor=scale, mode="bicubic")
    assert_close(resized[:, 1:], expected.permute(0, 2, 3, 1).reshape(1, 18, DIM))
