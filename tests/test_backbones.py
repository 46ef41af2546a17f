"""What every backbone must do, checkpoints in all their wrappings, names, downloads, images good
and bad."""

import hashlib
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from loopback import Server
from numpy.random import default_rng
from refusals import refused
from safetensors.torch import save_file
from small_backbones import ARCHITECTURES, MEAN, PICTURES, STD, close, save_all, small_vit
from torch import nn
from torch.testing import assert_close

from zsp_lite import Backbone, InputError, load_backbone
from zsp_lite.backbones import load, released
from zsp_lite.backbones.load import BackboneConfig
from zsp_lite.backbones.named import as_backbone, named_backbone
from zsp_lite.backbones.released import PretrainedWeights, available_backbones, how_to_obtain
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.benchmark.runs import fingerprint
from zsp_lite.choices import FACETS
from zsp_lite.io.download import fetch

VIT = small_vit()


def assert_same_features(first, second):
    close([*map(vars, first)], [*map(vars, second)])


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """What `load_backbone` takes for the embedded backbone, for a checkpoint in DINO's layout, and
    for each architecture of Hugging Face's format."""
    root = tmp_path_factory.mktemp("backbones")
    torch.save(VIT.state_dict(), root / "checkpoint.pth")
    models = {kind: f"hf:{folder}" for kind, folder in save_all(root).items()}
    return models | {"zsp-tiny": "zsp-tiny", "checkpoint": str(root / "checkpoint.pth")}


@pytest.fixture(params=["zsp-tiny", "checkpoint", *ARCHITECTURES])
def place(request, places) -> str:
    """What `load_backbone` takes for one backbone after the other."""
    return places[request.param]


@pytest.fixture
def backbone(place):
    """One backbone after the other, with 4 x 4 patches."""
    return load_backbone(place, "cpu", image_size=4 * load_backbone(place, "cpu").patch_size)


def test_features_depend_on_nothing_but_the_image(backbone):
    features = backbone(PICTURES)
    frozen = PICTURES[2].copy()
    frozen.flags.writeable = False
    assert_same_features(
        backbone([torch.from_numpy(PICTURES[0]), PICTURES[1] / 255, frozen]), features
    )
    # Rows in reverse order in memory.
    assert_same_features(backbone([PICTURES[1][::-1].copy()[::-1]]), features[1:2])
    assert backbone([]) == []


def test_a_backbone_loaded_twice_has_one_fingerprint(backbone, place):
    again = load_backbone(place, "cpu", image_size=backbone.image_size)
    assert fingerprint(again) == fingerprint(backbone)


def test_keys_are_tensors_of_their_own_that_can_enter_a_graph_with_gradients(backbone):
    keys = backbone(PICTURES)[0].keys
    # They do not keep the batch in memory.
    assert keys.untyped_storage().nbytes() == keys.numel() * 4
    layer = nn.Linear(backbone.embed_dim, 2)
    layer(keys).sum().backward()
    assert layer.weight.grad is not None


def test_layer_and_facet_change_the_keys_alone_and_stand_in_the_name(place):
    plain = load_backbone(place, "cpu")
    size = 3 * plain.patch_size
    found = []
    last = plain.model.depth - 1
    for layer, index, facet in [("last", last, "key"), *((0, 0, facet) for facet in FACETS)]:
        # The size is rounded to whole patches; the name keeps the one that was asked for.
        backbone = load_backbone(place, "cpu", layer=layer, facet=facet, image_size=size + 1)
        assert (backbone.layer, backbone.facet, backbone.image_size) == (index, facet, size)
        chosen = f"block{index}" + (f", {facet}" if facet != "key" else "")
        assert backbone.name == f"{plain.name} ({chosen}, {size + 1} px)"
        found += backbone(PICTURES[:1])
    first, *others = found
    for other in others:
        assert not torch.allclose(other.keys, first.keys)
        close(
            (other.saliency, other.global_feature),
            (first.saliency, first.global_feature),
        )


@pytest.mark.parametrize(
    "options", [{"layer": 12}, {"facet": "keys"}, {"image_size": 0}, {"image_size": 2049}]
)
def test_options_out_of_range_are_refused_by_every_backbone(place, options):
    (name,) = options
    refused(f"{name} is .*expected [^\n]+$", load_backbone, place, **options)


def test_features_are_the_models_keys_saliency_and_cls():
    vit = small_vit(num_heads=4)
    features = Backbone(vit, "small", layer=1, saliency_heads=(0, 3), device="cpu", batch_size=2)(
        PICTURES
    )
    pixels = torch.from_numpy(PICTURES[0]).permute(2, 0, 1)[None] / 255
    with torch.no_grad():
        tokens = vit.extract((pixels - MEAN) / STD, 1)
    assert_close(features[0].keys, tokens.keys[0].view(4, 4, 64))
    assert_close(features[0].global_feature, tokens.cls[0])
    raw = tokens.attention[0, [0, 3]].mean(0).view(4, 4)
    assert_close(features[0].saliency, (raw - raw.min()) / (raw.max() - raw.min()))
    assert_same_features(Backbone(vit, "small", 1, (0, 3), "cpu", batch_size=1)(PICTURES), features)


def test_uniform_attention_is_no_foreground():
    vit = small_vit()
    vit.blocks[-1].attn.qkv.weight.data.zero_()
    vit.blocks[-1].attn.qkv.bias.data.zero_()
    features = Backbone(vit, "small", device="cpu")([np.zeros((32, 32, 3), np.uint8)])
    assert not features[0].saliency.any()


def test_of_dino_vits_four_heads_are_salient_and_of_others_all():
    vits = Backbone(VisionTransformer(32, 8), "x", device="cpu")
    other = Backbone(small_vit(num_heads=4), "x", device="cpu")
    assert (vits.saliency_heads, vits.layer) == ((0, 2, 4, 5), 9)
    assert (other.saliency_heads, other.layer) == ((0, 1, 2, 3), 2)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((8, 8), np.uint8),
        np.zeros((0, 8, 3), np.uint8),
        np.zeros((8, 8, 3), np.int64),
        np.full((8, 8, 3), 1.5),
        np.full((8, 8, 3), np.nan),
    ],
)
def test_bad_images_are_refused_by_number(image):
    with pytest.raises(InputError, match="^image 1 is .*, expected [^\n]+$"):
        Backbone(VIT, "small", device="cpu", batch_size=1)([np.zeros((8, 8, 3), np.uint8), image])


@pytest.mark.parametrize("wrapping", ["plain", "teacher", "state_dict", "prefixed"])
def test_torch_checkpoints_load_however_they_are_wrapped(tmp_path, wrapping):
    weights = VIT.state_dict()
    teacher = {f"module.backbone.{k}": v for k, v in weights.items()}
    content = {
        "plain": weights,
        "teacher": {"student": {}, "epoch": 3, "teacher": teacher},
        "state_dict": {"state_dict": {f"module.{k}": v for k, v in weights.items()}},
        "prefixed": {f"backbone.{k}": v for k, v in weights.items()}
        | {"head.mlp.weight": torch.zeros(2, 2)},
    }[wrapping]
    torch.save(content, tmp_path / "mine.pth")
    loaded = load_backbone(tmp_path / "mine.pth", "cpu")
    assert (loaded.name, loaded.patch_size, loaded.image_size, loaded.embed_dim) == (
        "mine",
        8,
        32,
        64,
    )
    assert_same_features(loaded(PICTURES), Backbone(VIT, "small", device="cpu")(PICTURES))


def test_safetensors_bring_their_settings_and_options_override_them(tmp_path):
    vit = small_vit(num_heads=4)
    half = {key: x.half() for key, x in vit.state_dict().items()}
    metadata = {"num_heads": "4", "key_block": "1", "saliency_heads": "0,2"}
    save_file(half, tmp_path / "tiny.safetensors", metadata=metadata)
    loaded = load_backbone(str(tmp_path / "tiny.safetensors"), "cpu")
    assert (loaded.model.num_heads, loaded.layer, loaded.saliency_heads) == (4, 1, (0, 2))
    for a, b in zip(loaded(PICTURES), Backbone(vit, "small", layer=1, device="cpu")(PICTURES)):
        assert a.keys.dtype == torch.float32
        assert F.cosine_similarity(a.keys, b.keys, dim=-1).min() > 0.999
    assert load_backbone(tmp_path / "tiny.safetensors", "cpu", layer=0).layer == 0


def test_the_embedded_backbone_is_found_by_its_name(tmp_path, monkeypatch):
    path = tmp_path / "zsp-tiny.safetensors"
    for module in (load, released):
        monkeypatch.setattr(module, "TINY", path)
    refused(
        "checkpoint .*zsp-tiny.safetensors cannot be read: no such file", load_backbone, "zsp-tiny"
    )
    save_file(VIT.state_dict(), path, metadata={"num_heads": "1"})
    assert load_backbone("zsp-tiny").name == "zsp-tiny"
    assert available_backbones()["zsp-tiny"] == path
    assert as_backbone(path).embed_dim == as_backbone(str(path)).embed_dim == VIT.embed_dim


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda w: {k: x for k, x in w.items() if k != "pos_embed"}, "DINO layout"),
        (
            lambda w: w | {"blocks.100000000.norm1.bias": torch.zeros(1)},
            "not fit: .* Missing .*blocks.3.norm1.weight",
        ),
        (
            lambda w: w | {"norm.weight": torch.full((64,), torch.nan)},
            "norm.weight holds values that are not finite",
        ),
        (lambda w: w | {"extra": torch.zeros(1)}, "not fit: .* Unexpected .*extra"),
        (lambda w: {"epoch": 3}, "state dict"),
    ],
)
def test_other_models_weights_are_refused_naming_what_differs(tmp_path, change, message):
    torch.save(change(dict(VIT.state_dict())), tmp_path / "other.pth")
    refused(message, load_backbone, tmp_path / "other.pth")


@pytest.mark.parametrize(
    "key, value", [("num_heads", "four"), ("num_heads", "0"), ("saliency_heads", "7")]
)
def test_metadata_that_does_not_fit_is_refused(tmp_path, key, value):
    save_file(VIT.state_dict(), tmp_path / "x.safetensors", metadata={key: value})
    refused(f"{key} .*expected", load_backbone, tmp_path / "x.safetensors")


@pytest.mark.parametrize(
    "key, told",
    [
        ("blocks.0.ls1.gamma", "DINOv2, expected hf:facebook/dinov2-small or its like"),
        ("rope_embed.periods", "DINOv3, expected hf:facebook/dinov3-vits16-pretrain-lvd1689m or"),
    ],
)
def test_files_of_later_dino_models_are_refused_naming_the_ones_to_take(tmp_path, key, told):
    # Both models have layer scale, and DINOv3 has rotations in place of position embeddings.
    weights = VIT.state_dict() | {"blocks.0.ls1.gamma": torch.ones(4), key: torch.ones(4)}
    if "rope" in key:
        weights.pop("pos_embed")
    torch.save(weights, tmp_path / "meta.pth")
    refused(f"meta.pth is Meta's own file of {told}", load_backbone, tmp_path / "meta.pth")


def test_an_unknown_name_or_device_is_refused():
    refused("'resnet'.*zsp-tiny, .*dino_vits8", load_backbone, "resnet")
    refused("device", load_backbone, device="nowhere")


@pytest.fixture
def server(monkeypatch):
    """A server of one file, with the content and its first digits of MD5 as attributes."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    content = default_rng(0).bytes(10_000)
    server = Server({"/file": content})
    server.content = content
    server.md5 = hashlib.md5(content).hexdigest()[:6]
    yield server
    server.close()


@pytest.mark.parametrize("size", [10_000, None])
@pytest.mark.parametrize("received", [2_000, 10_000])
@pytest.mark.parametrize("knows_ranges", [True, False])
def test_whatever_part_is_there_the_file_is_complete_afterwards(
    server, tmp_path, size, received, knows_ranges
):
    (tmp_path / "file.part").write_bytes(server.content[:received])
    server.knows_ranges = knows_ranges
    fetch(f"{server.url}/file", tmp_path / "file", size, server.md5)
    assert (tmp_path / "file").read_bytes() == server.content


def test_downloads_of_one_file_at_once_take_turns(server, tmp_path):
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda _: fetch(f"{server.url}/file", tmp_path / "file"), range(4)))
    assert server.ranges == [None]
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


@pytest.mark.parametrize("chunked", [False, True])  # whether the server announces no size
@pytest.mark.parametrize(
    "expected",
    [{"size": 10_001}, {"size": 9_000}, {"most": 9_000}, {"size": 10_000, "md5_prefix": "000000"}],
)
def test_a_file_of_another_size_or_hash_is_refused_and_removed(server, tmp_path, expected, chunked):
    server.chunked = chunked
    refused("expected .*; removed", fetch, f"{server.url}/file", tmp_path / "file", **expected)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of downloaded models, which does not exist yet."""
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_dino_models_come_from_the_server(server, tmp_path, cache, monkeypatch):
    torch.save(VIT.state_dict(), tmp_path / "made.pth")
    content = (tmp_path / "made.pth").read_bytes()
    server.files["/dino/some/vit.pth"] = content
    monkeypatch.setenv("ZSP_LITE_DINO_URL", f"{server.url}/dino")
    made = PretrainedWeights("some/vit.pth", hashlib.md5(content).hexdigest()[:6], len(content))
    monkeypatch.setitem(released.PRETRAINED, "dino_vits8", made)
    assert how_to_obtain("dino_vits8") == "not downloaded: zsp-lite weights fetch dino_vits8"
    assert available_backbones()["dino_vits8"] is None
    loaded = load_backbone("dino_vits8", "cpu")
    assert loaded.name == "dino_vits8"
    assert available_backbones()["dino_vits8"] == cache / "vit.pth"
    assert_same_features(loaded(PICTURES), Backbone(VIT, "small", device="cpu")(PICTURES))


def test_a_file_that_is_not_the_released_one_is_refused(cache):
    cache.mkdir()
    torch.save(VIT.state_dict(), cache / "dino_deitsmall16_pretrain.pth")
    refused(
        "dino_vits16: .*not the released file.*weights fetch dino_vits16",
        load_backbone,
        "dino_vits16",
    )


@pytest.mark.parametrize("address", ["{url}/missing", "http://127.0.0.1:9/"])  # no server there
def test_without_the_server_one_line_says_what_to_do(server, cache, monkeypatch, address):
    monkeypatch.setenv("ZSP_LITE_DINO_URL", address.format(url=server.url))
    message = refused(".", load_backbone, "dino_vits8")
    for part in (
        released.PRETRAINED["dino_vits8"].url,
        str(cache / "dino_deitsmall8_pretrain.pth"),
        "zsp-tiny",
    ):
        assert part in message


def test_a_backbone_of_ones_own_is_named_by_its_module_and_takes_no_options(tmp_path, monkeypatch):
    text = "class Maps:\n    def __call__(self, images): ...\n\nmaps, size = Maps(), 3"
    (tmp_path / "my_backbone_file.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    # A console script has no "" in its path, which stands for the current folder.
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    # After the name: layer, facet and image size.
    assert type(named_backbone("my_backbone_file:maps", None, "key", None)).__name__ == "Maps"
    for thing, layer, told in (
        ("Maps", None, "is of type type, expected"),
        ("size", None, "is of type int, expected"),
        ("no", None, "imported"),
        ("maps", "last", "is your own, expected no layer, facet or image size"),
    ):
        refused(told, named_backbone, f"my_backbone_file:{thing}", layer, "key", None)
    assert named_backbone("hf:gpt2", None, "key", None) == "hf:gpt2"
    assert named_backbone("hf:gpt2", None, "key", 96) == BackboneConfig("hf:gpt2", image_size=96)
