"""Choice of block and facet, on the project's vision transformer."""

import numpy as np
import pytest
import torch
from test_backbones import small_vit

from zsp_lite import load_backbone
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.facets import FACETS, block_index
from zsp_lite.backbones.load import BackboneConfig
from zsp_lite.errors import InputError


@pytest.mark.parametrize(
    "layer, index",
    [("last", 11), ("block0", 0), ("block9", 9), (9, 9), ("9", 9), (-1, 11), (-12, 0), (" -2 ", 10)],
)
def test_a_block_is_chosen_by_its_number_from_either_end(layer, index):
    assert block_index(layer, 12) == index


@pytest.mark.parametrize("layer", ["block12", 12, -13, "first", "", "block", "block-1", 1.5, True, "blocks9", "9x"])
def test_a_block_that_does_not_exist_is_refused_with_the_valid_ones(layer):
    with pytest.raises(InputError, match="^vit: layer is .*'last', 'block0' to 'block11', or a number from -12 to 11$"):
        block_index(layer, 12, "vit")


@pytest.mark.parametrize("block", range(3))
@pytest.mark.parametrize("facet", FACETS)
def test_facets_equal_the_activations_of_a_plain_forward_pass(block, facet):
    vit = small_vit()
    images = torch.rand(2, 3, 40, 32, generator=torch.Generator().manual_seed(0))
    recorded = {}
    following = [*vit.blocks, vit.norm][block + 1]
    vit.blocks[block].register_forward_pre_hook(lambda module, inputs: recorded.setdefault("input", inputs[0]))
    following.register_forward_pre_hook(lambda module, inputs: recorded.setdefault("output", inputs[0]))
    with torch.no_grad():
        cls = vit(images)[:, 0]
        q, k, v = vit.blocks[block].attn.qkv(vit.blocks[block].norm1(recorded["input"])).chunk(3, dim=-1)
        tokens, by_keys = vit.extract(images, block, facet), vit.extract(images, block)
    expected = {"query": q, "key": k, "value": v, "token": recorded["output"]}[facet]
    torch.testing.assert_close(tokens.keys, expected[:, 1:], atol=2e-5, rtol=1e-4)
    # The other outputs do not depend on the facet.
    torch.testing.assert_close(tokens.cls, cls, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(tokens.attention, by_keys.attention, atol=2e-6, rtol=1e-4)
    assert tokens.grid == by_keys.grid == (5, 4)


def test_for_keys_the_patches_of_the_last_block_are_not_computed():
    tokens, vit = [], small_vit()
    for block in vit.blocks:
        block.mlp.register_forward_hook(lambda module, inputs, output: tokens.append(output.shape[1]))
    Backbone(vit, "small", device="cpu")([np.zeros((32, 32, 3), np.uint8)])
    assert tokens == [17, 17, 1]


def test_backbones_take_layer_facet_and_size():
    images = [np.random.default_rng(0).integers(0, 256, (50, 60, 3), dtype=np.uint8)]
    backbone = load_backbone("zsp-tiny", "cpu", layer="last", facet="value", image_size=60)
    assert (backbone.layer, backbone.facet, backbone.image_size) == (backbone.model.depth - 1, "value", 64)
    assert backbone.name == "zsp-tiny (block11, value, 60 px)"
    assert backbone(images)[0].grid == (8, 8)
    assert load_backbone("zsp-tiny", "cpu").layer == load_backbone("zsp-tiny", "cpu", layer=None).layer
    for options in ({"facet": "keys"}, {"layer": "block99"}, {"image_size": -8}):
        with pytest.raises(InputError):
            load_backbone("zsp-tiny", "cpu", **options)


@pytest.mark.parametrize("options", [{"layer": 0}, {"facet": "key"}, {"facet": "token"}, {"image_size": 64}])
def test_options_beside_a_configuration_that_has_them_are_refused(options):
    with pytest.raises(InputError, match=f"zsp-tiny: got {next(iter(options))} .* expected them in the config only"):
        load_backbone(BackboneConfig("zsp-tiny", facet="value"), "cpu", **options)


def test_a_configuration_gives_the_same_backbone_as_its_options():
    options = {"layer": 3, "facet": "value", "image_size": 448}
    by_config = load_backbone(BackboneConfig("zsp-tiny", **options), "cpu")
    assert by_config.name == load_backbone("zsp-tiny", "cpu", **options).name
    assert (by_config.layer, by_config.facet, by_config.image_size) == (3, "value", 448)
