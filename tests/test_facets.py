"""Blocks and facets by name, on the project's own vision transformer."""

import numpy as np
import pytest
import torch
from test_backbones import small_vit

from zsp_lite import load_backbone
from zsp_lite.backbones.facets import FACETS, block_index, extract
from zsp_lite.backbones.load import Backbone
from zsp_lite.errors import InputError


@pytest.mark.parametrize(
    "layer, index",
    [("last", 11), ("block0", 0), ("block9", 9), (9, 9), ("9", 9), (-1, 11), (-12, 0), (" -2 ", 10)],
)
def test_a_block_is_named_by_its_number_from_either_end(layer, index):
    assert block_index(layer, 12) == index


@pytest.mark.parametrize("layer", ["block12", 12, -13, "first", "", "block", "block-1", 1.5, True, "blocks9", "9x"])
def test_a_block_that_is_not_there_is_refused_with_what_is(layer):
    with pytest.raises(InputError, match="^vit: layer is .*'last', 'block0' to 'block11', or a number from -12 to 11$"):
        block_index(layer, 12, "vit")


@pytest.mark.parametrize("block", range(3))
@pytest.mark.parametrize("facet", FACETS)
def test_a_facet_is_what_its_name_says_in_a_plain_forward_pass(block, facet):
    vit = small_vit()
    images = torch.rand(2, 3, 40, 32, generator=torch.Generator().manual_seed(0))
    seen = {}
    vit.blocks[block].register_forward_hook(lambda module, inputs, output: seen.update(inputs=inputs[0], output=output))
    with torch.no_grad():
        cls = vit(images)[:, 0]
        q, k, v = vit.blocks[block].attn.qkv(vit.blocks[block].norm1(seen["inputs"])).chunk(3, dim=-1)
        tokens, by_keys = extract(vit, images, block, facet), vit.extract(images, block)
    expected = {"query": q, "key": k, "value": v, "token": seen["output"]}[facet]
    torch.testing.assert_close(tokens.keys, expected[:, 1:], atol=2e-5, rtol=1e-4)
    # The rest does not depend on the choice.
    torch.testing.assert_close(tokens.cls, cls, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(tokens.attention, by_keys.attention, atol=2e-6, rtol=1e-4)
    assert tokens.grid == by_keys.grid == (5, 4)


def test_by_default_nothing_but_the_models_own_extract_runs(monkeypatch):
    vit, asked = small_vit(), []
    own = type(vit).extract
    monkeypatch.setattr(type(vit), "extract", lambda self, *args: asked.append(args[1:]) or own(self, *args))
    monkeypatch.setattr(type(vit.blocks[-1]), "forward", None)  # whoever computes the last block in full, fails
    Backbone(vit, "small", device="cpu")([np.zeros((32, 32, 3), np.uint8)])
    assert asked == [(2,)]


def test_backbones_take_layer_facet_and_size():
    images = [np.random.default_rng(0).integers(0, 256, (50, 60, 3), dtype=np.uint8)]
    backbone = load_backbone("zsp-tiny", "cpu", layer="last", facet="value", image_size=60)
    assert (backbone.key_block, backbone.facet, backbone.image_size) == (backbone.model.depth - 1, "value", 64)
    assert backbone.name == "zsp-tiny (block11, value, 60 px)"
    assert backbone(images)[0].grid == (8, 8)
    assert load_backbone("zsp-tiny", "cpu").key_block == load_backbone("zsp-tiny", "cpu", layer=None).key_block
    for options in ({"facet": "keys"}, {"layer": "block99"}, {"layer": 1, "key_block": 1}, {"image_size": -8}):
        with pytest.raises(InputError):
            load_backbone("zsp-tiny", "cpu", **options)
