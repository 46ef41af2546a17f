"""The transformer against an independent one built from torch.nn.MultiheadAttention with the same
weights."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn
from torch.testing import assert_close

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.choices import FACETS

DEPTH, DIM, HEADS, PATCH = 3, 48, 6, 8


@pytest.fixture(scope="module")
def model() -> VisionTransformer:
    torch.manual_seed(0)
    vit = VisionTransformer(32, PATCH, DIM, DEPTH, HEADS)
    for parameter in vit.parameters():  # attention far from uniform, biases and norms that matter
        nn.init.normal_(parameter, std=0.3)
    return vit.eval()


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.randn(2, 3, 32, 32, generator=torch.Generator().manual_seed(1))


def oracle(vit: VisionTransformer, images: torch.Tensor):
    """Output tokens, the facets of every block, attention of every block, by Conv2d and
    MultiheadAttention."""
    weights = vit.state_dict()
    kernel, bias = weights["patch_embed.proj.weight"], weights["patch_embed.proj.bias"]
    patches = F.conv2d(images, kernel, bias, stride=PATCH)
    x = torch.cat(
        [weights["cls_token"].expand(len(images), 1, DIM), patches.flatten(2).transpose(1, 2)], 1
    )
    x = x + weights["pos_embed"]
    facets, attentions = [], []
    for index in range(DEPTH):
        w = {key.removeprefix(f"blocks.{index}."): value for key, value in weights.items()}
        attention = nn.MultiheadAttention(DIM, HEADS, batch_first=True)
        names = {"in_proj_": "attn.qkv.", "out_proj.": "attn.proj."}
        attention.load_state_dict(
            {f"{a}{kind}": w[b + kind] for a, b in names.items() for kind in ("weight", "bias")}
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
    return (
        F.layer_norm(x, (DIM,), weights["norm.weight"], weights["norm.bias"], 1e-6),
        facets,
        attentions,
    )


@pytest.mark.parametrize("gradients", [False, True])
def test_forward_equals_an_independent_transformer(model, images, gradients):
    with torch.set_grad_enabled(gradients):  # both implementations of attention
        assert_close(model(images), oracle(model, images)[0], atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("facet", FACETS)
@pytest.mark.parametrize("layer", range(DEPTH))
def test_extract_gives_the_facet_cls_attention_and_cls_output(model, images, layer, facet):
    with torch.no_grad():
        tokens = model.extract(images, layer, facet)
        output, facets, attentions = oracle(model, images)
    assert_close(tokens.keys, facets[layer][facet][:, 1:], atol=2e-5, rtol=1e-4)
    assert_close(tokens.attention, attentions[-1][:, :, 0, 1:], atol=1e-5, rtol=1e-4)
    assert_close(tokens.cls, output[:, 0], atol=2e-5, rtol=1e-4)
    assert tokens.grid == (4, 4)


@pytest.mark.parametrize("layer", range(DEPTH))
def test_training_forward_agrees_with_inference_and_reaches_every_weight(model, images, layer):
    training = model.forward_training(images, layer)
    with torch.no_grad():
        tokens, output = model.extract(images, layer), model(images)
    assert_close(training.tokens, output, atol=2e-5, rtol=1e-4)
    assert_close(training.keys, tokens.keys, atol=2e-5, rtol=1e-4)
    attention = training.cls_logits.softmax(-1)[:, :, 1:]
    assert_close(attention, tokens.attention, atol=1e-5, rtol=1e-4)
    weight, bias = (x.chunk(3)[1] for x in model.blocks[layer].attn.qkv.parameters())
    keys = F.linear(training.key_input, weight, bias)
    assert_close(keys, training.keys, atol=2e-5, rtol=1e-4)
    loss = training.tokens.square().sum() + training.keys.sum() + training.cls_logits.square().sum()
    gradients = torch.autograd.grad(loss, list(model.parameters()))
    assert all(bool(gradient.isfinite().all()) and bool(gradient.any()) for gradient in gradients)


def test_state_dict_has_the_keys_and_shapes_of_dino_vits8():
    shapes = {"cls_token": (1, 1, 384), "pos_embed": (1, 785, 384)}
    shapes |= {"patch_embed.proj.weight": (384, 3, 8, 8), "patch_embed.proj.bias": (384,)}
    layers = {"norm1": (384,), "attn.qkv": (1152, 384), "attn.proj": (384, 384), "norm2": (384,)}
    layers |= {"mlp.fc1": (1536, 384), "mlp.fc2": (384, 1536)}
    for name, shape in [
        (f"blocks.{i}.{name}", shape) for i in range(12) for name, shape in layers.items()
    ]:
        shapes |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
    shapes |= {"norm.weight": (384,), "norm.bias": (384,)}
    with torch.device("meta"):
        vit = VisionTransformer()
    assert {key: tuple(x.shape) for key, x in vit.state_dict().items()} == shapes
    vit.load_state_dict(
        {key: torch.empty(shape) for key, shape in shapes.items()}, strict=True, assign=True
    )
    assert all(m.eps == 1e-6 for m in vit.modules() if isinstance(m, nn.LayerNorm))


def test_position_embedding_is_itself_on_its_own_grid_and_interpolated_on_others(model):
    assert model.position_embedding((4, 4)) is model.pos_embed
    resized = model.position_embedding((3, 6))
    assert resized.shape == (1, 19, DIM)
    assert_close(resized[:, 0], model.pos_embed[:, 0])
    # DINO's own expression for an image of 24 x 48 pixels.
    stored = model.pos_embed[:, 1:].reshape(1, 4, 4, DIM).permute(0, 3, 1, 2)
    expected = F.interpolate(
        stored, scale_factor=((24 // 8 + 0.1) / 4, (48 // 8 + 0.1) / 4), mode="bicubic"
    )
    assert_close(resized[:, 1:], expected.permute(0, 2, 3, 1).reshape(1, -1, DIM))
    with torch.no_grad():
        assert model.extract(torch.zeros(1, 3, 24, 48), 0).grid == (3, 6)
