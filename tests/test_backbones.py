"""Checkpoints in all their wrappings, downloads over loopback with every mishap, images good and bad."""

import hashlib

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from loopback import Server
from safetensors.torch import save_file
from torch import nn

from zsp_lite.backbones import pretrained
from zsp_lite.backbones.backbone import Backbone, prepare_images
from zsp_lite.backbones.facets import block_index
from zsp_lite.backbones.load import BackboneConfig, load_backbone, verify
from zsp_lite.backbones.pretrained import PretrainedWeights, available_backbones
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError
from zsp_lite.io.download import fetch


def small_vit(seed: int = 0, **sizes) -> VisionTransformer:
    torch.manual_seed(seed)
    standard = {"image_size": 32, "patch_size": 8, "embed_dim": 64, "depth": 3, "num_heads": 4}
    vit = VisionTransformer(**(standard | sizes))
    for parameter in vit.parameters():
        nn.init.normal_(parameter, std=0.2)
    return vit


@pytest.fixture(scope="module")
def vit() -> VisionTransformer:
    return small_vit()


@pytest.fixture()
def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, shape, dtype=np.uint8) for shape in ((32, 32, 3), (50, 40, 3), (9, 64, 3))]


def assert_same_features(first, second):
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a.keys, b.keys)
        torch.testing.assert_close(a.saliency, b.saliency)


# what a backbone computes


def test_features_are_the_models_keys_saliency_and_cls(vit, pictures):
    model = Backbone(vit, "small", layer=1, saliency_heads=(0, 3), device="cpu", batch_size=2)
    features = model(pictures)
    assert len(features) == 3
    pixels = torch.from_numpy(pictures[0]).permute(2, 0, 1)[None] / 255
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    with torch.no_grad():
        tokens = vit.extract((pixels - mean.view(3, 1, 1)) / std.view(3, 1, 1), 1)
    first = features[0]
    torch.testing.assert_close(first.keys, tokens.keys[0].view(4, 4, 64))
    torch.testing.assert_close(first.global_feature, tokens.cls[0])
    raw = tokens.attention[0, [0, 3]].mean(0).view(4, 4)
    torch.testing.assert_close(first.saliency, (raw - raw.min()) / (raw.max() - raw.min()))
    assert all(f.saliency.min() == 0 and f.saliency.max() == 1 for f in features)


def test_features_depend_neither_on_batch_size_nor_on_the_images_type(vit, pictures):
    expected = Backbone(vit, "small", device="cpu", batch_size=1)(pictures)
    model = Backbone(vit, "small", device="cpu", batch_size=8)
    assert_same_features(model(pictures), expected)
    assert_same_features(model([p / 255 for p in pictures]), expected)
    assert_same_features(model([torch.from_numpy(p) for p in pictures]), expected)
    frozen = pictures[0].copy()
    frozen.flags.writeable = False
    assert_same_features(model([frozen, pictures[1][::-1][::-1]]), expected[:2])
    assert model([]) == []


def test_features_are_ordinary_tensors_of_their_own(vit, pictures):
    keys = Backbone(vit, "small", device="cpu")(pictures)[0].keys
    assert keys.untyped_storage().nbytes() == keys.numel() * 4
    layer = nn.Linear(64, 2)
    layer(keys).sum().backward()  # a tensor born in inference mode would refuse
    assert layer.weight.grad is not None


def test_uniform_attention_is_no_foreground():
    vit = small_vit()
    vit.blocks[-1].attn.qkv.weight.data.zero_()
    vit.blocks[-1].attn.qkv.bias.data.zero_()
    features = Backbone(vit, "small", device="cpu")([np.zeros((32, 32, 3), np.uint8)])
    assert bool((features[0].saliency == 0).all())


def test_of_dino_vits_four_heads_are_salient_and_of_others_all():
    vits = VisionTransformer(32, 8, 384, 12, 6)
    assert Backbone(vits, "s", device="cpu").saliency_heads == (0, 2, 4, 5)
    assert Backbone(vits, "s", device="cpu").layer == 9
    assert Backbone(small_vit(), "x", device="cpu").saliency_heads == (0, 1, 2, 3)
    assert Backbone(small_vit(), "x", device="cpu").layer == 2


def test_resizing_averages_over_what_it_shrinks():
    # A fine checkerboard shrinks to grey; without antialiasing it would stay black and white.
    board = (np.indices((128, 128)).sum(0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, 2)
    shrunk = prepare_images([board], 32)
    assert shrunk.shape == (1, 3, 32, 32)
    torch.testing.assert_close(shrunk, torch.full_like(shrunk, 0.5), atol=0.02, rtol=0)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((8, 8), np.uint8),
        np.zeros((8, 8, 4), np.uint8),
        np.zeros((0, 8, 3), np.uint8),
        np.zeros((8, 8, 3), np.int64),
        np.full((8, 8, 3), 1.5),
        np.full((8, 8, 3), np.nan),
        np.full((8, 8, 3), -0.1, np.float32),
    ],
)
def test_bad_images_are_refused_by_number(vit, image):
    with pytest.raises(InputError, match="^image 1: [^\n]+$"):
        Backbone(vit, "small", device="cpu")([np.zeros((8, 8, 3), np.uint8), image])


@pytest.mark.parametrize(
    "options",
    [
        {"layer": 3},
        {"saliency_heads": (4,)},
        {"saliency_heads": ()},
        {"batch_size": 0},
        {"image_size": 0},
        {"facet": "keys"},
        {"device": "nowhere"},
    ],
)
def test_options_out_of_range_are_refused(vit, options):
    with pytest.raises(InputError):
        Backbone(vit, "small", **({"device": "cpu"} | options))


@pytest.mark.parametrize(
    "layer, index", [("last", 11), ("block0", 0), ("block9", 9), (9, 9), (-1, 11), (-12, 0), (" -2 ", 10)]
)
def test_a_block_is_chosen_by_its_number_from_either_end(layer, index):
    assert block_index(layer, 12) == index


@pytest.mark.parametrize("layer", ["block12", 12, -13, "first", "", "block", "block-1", "blocks9", "9x"])
def test_a_block_that_does_not_exist_is_refused_with_the_valid_ones(layer):
    with pytest.raises(InputError, match="^vit: layer is .*'last', 'block0' to 'block11', or a number from -12 to 11$"):
        block_index(layer, 12, "vit")


def test_backbones_take_layer_facet_and_size():
    images = [np.random.default_rng(0).integers(0, 256, (50, 60, 3), dtype=np.uint8)]
    backbone = load_backbone("zsp-tiny", "cpu", layer="last", facet="value", image_size=60)
    assert (backbone.layer, backbone.facet, backbone.image_size) == (backbone.model.depth - 1, "value", 64)
    assert backbone.name == "zsp-tiny (block11, value, 60 px)"
    assert backbone(images)[0].grid == (8, 8)
    assert load_backbone("zsp-tiny", "cpu").layer == load_backbone("zsp-tiny", "cpu", layer=None).layer


@pytest.mark.parametrize("options", [{"layer": 0}, {"facet": "key"}, {"facet": "token"}, {"image_size": 64}])
def test_options_beside_a_configuration_that_has_them_are_refused(options):
    with pytest.raises(InputError, match=f"zsp-tiny: got {next(iter(options))} .* expected them in the config only"):
        load_backbone(BackboneConfig("zsp-tiny", facet="value"), "cpu", **options)


def test_a_configuration_gives_the_same_backbone_as_its_options():
    options = {"layer": 3, "facet": "value", "image_size": 448}
    by_config = load_backbone(BackboneConfig("zsp-tiny", **options), "cpu")
    assert by_config.name == load_backbone("zsp-tiny", "cpu", **options).name
    assert (by_config.layer, by_config.facet, by_config.image_size) == (3, "value", 448)


# checkpoints


@pytest.mark.parametrize("wrapping", ["plain", "teacher", "state_dict", "prefixed"])
def test_torch_checkpoints_load_however_they_are_wrapped(vit, pictures, tmp_path, wrapping):
    weights = vit.state_dict()
    teacher = {f"module.backbone.{k}": v for k, v in weights.items()}
    content = {
        "plain": weights,
        "teacher": {"student": {}, "epoch": 3, "teacher": teacher},
        "state_dict": {"state_dict": {f"module.{k}": v for k, v in weights.items()}},
        "prefixed": {f"backbone.{k}": v for k, v in weights.items()} | {"head.mlp.weight": torch.zeros(2, 2)},
    }[wrapping]
    torch.save(content, tmp_path / "mine.pth")
    loaded = load_backbone(tmp_path / "mine.pth", "cpu", num_heads=4)
    assert (loaded.name, loaded.patch_size, loaded.image_size, loaded.embed_dim) == ("mine", 8, 32, 64)
    assert_same_features(loaded(pictures), Backbone(vit, "small", device="cpu")(pictures))


def test_heads_have_64_channels_unless_told(tmp_path):
    torch.save(small_vit(embed_dim=128, num_heads=2).state_dict(), tmp_path / "a.pth")
    assert load_backbone(tmp_path / "a.pth", "cpu").model.num_heads == 2
    torch.save(small_vit(embed_dim=48, num_heads=6).state_dict(), tmp_path / "b.pth")
    with pytest.raises(InputError, match="num_heads"):
        load_backbone(tmp_path / "b.pth", "cpu")


def test_safetensors_bring_their_settings_and_arguments_override_them(vit, pictures, tmp_path):
    half = {key: x.half() for key, x in vit.state_dict().items()}
    metadata = {"num_heads": "4", "key_block": "1", "saliency_heads": "0,2"}
    save_file(half, tmp_path / "tiny.safetensors", metadata=metadata)
    loaded = load_backbone(str(tmp_path / "tiny.safetensors"), "cpu")
    assert (loaded.model.num_heads, loaded.layer, loaded.saliency_heads) == (4, 1, (0, 2))
    expected = Backbone(vit, "small", layer=1, device="cpu")(pictures)
    for a, b in zip(loaded(pictures), expected):
        assert a.keys.dtype == torch.float32
        assert F.cosine_similarity(a.keys, b.keys, dim=-1).min() > 0.999
    other = load_backbone(tmp_path / "tiny.safetensors", "cpu", layer=0, saliency_heads=[3])
    assert (other.layer, other.saliency_heads) == (0, (3,))


def test_an_embedded_backbone_is_found_by_its_name_and_checked(vit, tmp_path, monkeypatch):
    path = tmp_path / "zsp-tiny.safetensors"
    monkeypatch.setattr(pretrained, "WEIGHTS", tmp_path)
    monkeypatch.setitem(pretrained.EMBEDDED, "zsp-tiny", path)
    with pytest.raises(InputError, match="zsp-tiny.safetensors is missing; reinstall zsp-lite"):
        load_backbone("zsp-tiny")
    save_file(vit.state_dict(), path, metadata={"num_heads": "4"})
    (tmp_path / "SHA256SUMS").write_text(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  zsp-tiny.safetensors\n")
    assert load_backbone("zsp-tiny").name == "zsp-tiny"
    assert available_backbones()["zsp-tiny"] == path
    save_file(vit.state_dict(), path, metadata={"num_heads": "2"})
    with pytest.raises(InputError, match="zsp-tiny.safetensors is damaged: its SHA-256 is .*, expected .* as in SHA25"):
        load_backbone("zsp-tiny")


def without(weights, key):
    return {k: v for k, v in weights.items() if k != key}


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda w: without(w, "pos_embed"), "DINO layout"),
        (lambda w: without(w, "blocks.1.norm1.bias"), "blocks.1.norm1.bias: expected .64,., got none"),
        (lambda w: w | {"extra": torch.zeros(1)}, "extra: expected none"),
        (lambda w: w | {"norm.weight": torch.zeros(3)}, "norm.weight"),
        (lambda w: w | {"norm.weight": torch.full((64,), torch.nan)}, "norm.weight contains"),
        (lambda w: {"fc.weight": torch.zeros(2, 2)}, "DINO layout"),
        (lambda w: [1, 2], "state dict"),
        (lambda w: {"epoch": 3}, "state dict"),
    ],
)
def test_other_models_weights_are_refused_naming_what_differs(vit, tmp_path, change, message):
    torch.save(change(dict(vit.state_dict())), tmp_path / "other.pth")
    with pytest.raises(InputError, match=message):
        load_backbone(tmp_path / "other.pth", "cpu", num_heads=4)


def test_metadata_that_is_not_a_number_is_refused(vit, tmp_path):
    save_file(vit.state_dict(), tmp_path / "x.safetensors", metadata={"num_heads": "four"})
    with pytest.raises(InputError, match="num_heads"):
        load_backbone(tmp_path / "x.safetensors")


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match="'resnet'.*zsp-tiny, .*dino_vits8"):
        load_backbone("resnet")


# downloads


@pytest.fixture()
def server(monkeypatch):
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    content = np.random.default_rng(0).bytes(10_000)
    server = Server({"/file": content})
    server.content, server.md5 = content, hashlib.md5(content).hexdigest()[:6]
    yield server
    server.close()


def test_a_file_is_fetched_checked_and_not_fetched_twice(server, tmp_path):
    path = tmp_path / "folder" / "file"
    for _ in range(2):
        assert fetch(f"{server.url}/file", path, 10_000, server.md5) == path
    assert path.read_bytes() == server.content
    assert server.ranges == [None]
    assert [p.name for p in path.parent.iterdir()] == ["file"]


def test_a_transfer_that_breaks_off_is_resumed_where_it_stopped(server, tmp_path):
    server.break_after = 4_000
    fetch(f"{server.url}/file", tmp_path / "file", 10_000, server.md5)
    assert server.ranges == [None, "bytes=4000-", "bytes=8000-"]
    assert (tmp_path / "file").read_bytes() == server.content


def test_a_transfer_that_keeps_breaking_off_is_kept_for_the_next_call(server, tmp_path):
    server.break_after = 1_000
    with pytest.raises(InputError, match="3000 bytes; call again to resume"):
        fetch(f"{server.url}/file", tmp_path / "file", 10_000, server.md5)
    assert not (tmp_path / "file").exists() and (tmp_path / "file.part").stat().st_size == 3_000
    server.break_after = None
    fetch(f"{server.url}/file", tmp_path / "file", 10_000, server.md5)
    assert server.ranges[-1] == "bytes=3000-"
    assert (tmp_path / "file").read_bytes() == server.content


@pytest.mark.parametrize("size, md5", [(10_001, ""), (10_000, "000000"), (None, "000000")])
def test_a_file_of_another_size_or_hash_is_refused_and_removed(server, tmp_path, size, md5):
    with pytest.raises(InputError, match="expected"):
        fetch(f"{server.url}/file", tmp_path / "file", size, md5)
    assert list(tmp_path.iterdir()) == []


def test_dino_models_come_from_the_server_into_the_cache(server, vit, pictures, tmp_path, monkeypatch):
    torch.save(vit.state_dict(), tmp_path / "made.pth")
    content = (tmp_path / "made.pth").read_bytes()
    server.files["/dino/some/vit.pth"] = content
    monkeypatch.setenv("ZSP_LITE_DINO_URL", f"{server.url}/dino")
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path / "cache"))
    release = PretrainedWeights("some/vit.pth", hashlib.md5(content).hexdigest()[:6], len(content), (32, 8, 64, 3))
    monkeypatch.setitem(pretrained.PRETRAINED, "dino_vits8", release)
    assert available_backbones()["dino_vits8"] is None
    loaded = load_backbone("dino_vits8", "cpu", num_heads=4)
    assert loaded.name == "dino_vits8"
    assert available_backbones()["dino_vits8"] == tmp_path / "cache" / "vit.pth"
    assert_same_features(loaded(pictures), Backbone(vit, "small", device="cpu")(pictures))
    # A file that was used once is never replaced by another one unnoticed.
    pin = tmp_path / "cache" / "vit.pth.sha256"
    assert pin.read_text() == f"{hashlib.sha256(content).hexdigest()}  vit.pth\n"
    torch.save(small_vit(seed=5).state_dict(), tmp_path / "cache" / "vit.pth")
    with pytest.raises(
        InputError, match="vit.pth has changed since its first use: its SHA-256 is .*, expected .*remove"
    ):
        load_backbone("dino_vits8", "cpu", num_heads=4)


def test_a_network_of_another_size_than_the_release_is_refused_and_not_pinned(vit, tmp_path, monkeypatch):
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path))
    torch.save(vit.state_dict(), tmp_path / "dino_deitsmall8_pretrain.pth")
    with pytest.raises(
        InputError, match=r"dino_vits8: .*not the released network: .*\(32, 8, 64, 3\), expected \(224, 8"
    ):
        load_backbone("dino_vits8", "cpu")
    assert [path.name for path in tmp_path.iterdir()] == ["dino_deitsmall8_pretrain.pth"]


@pytest.mark.parametrize("size", [10_000, None])
@pytest.mark.parametrize("received", [2_000, 10_000])
@pytest.mark.parametrize("knows_ranges", [True, False])
def test_whatever_part_is_there_the_file_is_complete_afterwards(server, tmp_path, size, received, knows_ranges):
    (tmp_path / "file.part").write_bytes(server.content[:received])
    server.knows_ranges = knows_ranges
    fetch(f"{server.url}/file", tmp_path / "file", size, server.md5)
    assert (tmp_path / "file").read_bytes() == server.content


def test_a_download_is_stopped_when_it_exceeds_the_expected_size(server, tmp_path):
    for options in ({"most": 9_000}, {"size": 9_000}):
        with pytest.raises(InputError, match="has 10000 bytes, expected at most 9000"):
            fetch(f"{server.url}/file", tmp_path / "file", **options)
    server.chunked = True  # no size is announced
    server.files["/file"] = bytes(2_000_000)
    with pytest.raises(InputError, match="has more than 9000 bytes, expected no more; removed"):
        fetch(f"{server.url}/file", tmp_path / "file", most=9_000)
    assert list(tmp_path.iterdir()) == []


def test_weights_that_overflow_do_not_verify(tmp_path):
    vit = small_vit(num_heads=1)
    verify(_saved(vit, tmp_path / "fine.safetensors"))
    vit.blocks[1].mlp.fc2.weight.data.fill_(1e38)
    with pytest.raises(InputError, match="huge.safetensors: .*not finite"):
        verify(_saved(vit, tmp_path / "huge.safetensors"))


def _saved(vit, path):
    save_file(vit.state_dict(), path)
    return path


def test_a_cached_file_that_is_not_the_released_one_does_not_verify(tmp_path, monkeypatch):
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path))
    torch.save(small_vit(num_heads=1).state_dict(), tmp_path / "vit.pth")
    content = (tmp_path / "vit.pth").read_bytes()
    monkeypatch.setitem(
        pretrained.PRETRAINED,
        "dino_vits16",
        PretrainedWeights("vit.pth", hashlib.md5(content).hexdigest()[:6], len(content), (32, 8, 64, 3)),
    )
    verify("dino_vits16")
    torch.save(small_vit(num_heads=1, seed=1).state_dict(), tmp_path / "vit.pth")  # as long, and loads as well
    with pytest.raises(InputError, match="not the released file.*weights fetch dino_vits16"):
        verify("dino_vits16")
    (tmp_path / "vit.pth").unlink()
    with pytest.raises(InputError, match="not downloaded"):
        verify("dino_vits16")


@pytest.mark.parametrize("address", ["{url}/missing", "http://127.0.0.1:9/"])
def test_without_the_server_one_line_says_what_to_do(server, tmp_path, monkeypatch, address):
    monkeypatch.setenv("ZSP_LITE_DINO_URL", address.format(url=server.url))
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path))
    with pytest.raises(InputError) as caught:
        load_backbone("dino_vits8")
    message = str(caught.value)
    assert "\n" not in message
    place = tmp_path / "dino_deitsmall8_pretrain.pth"
    for part in (pretrained.PRETRAINED["dino_vits8"].url, str(place), "zsp-tiny"):
        assert part in message


def test_released_addresses_and_hashes_are_those_that_were_published():
    release = pretrained.PRETRAINED["dino_vits8"]
    folder = "https://dl.fbaipublicfiles.com/dino/dino_deitsmall8_pretrain/"
    assert release.url == folder + "dino_deitsmall8_pretrain.pth"
    assert (release.md5_prefix, release.size) == ("230cd5", 86_728_949)
    assert {name: r.md5_prefix for name, r in pretrained.PRETRAINED.items()} == {
        "dino_vits8": "230cd5", "dino_vits16": "cf0f22", "dino_vitb8": "556550", "dino_vitb16": "552daf"
    }  # fmt: skip
