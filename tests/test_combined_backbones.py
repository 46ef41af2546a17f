"""Convolutional backbones, and backbones side by side."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from benchmark_folder import small_folder
from synthetic_views import CoordinateBackbone
from test_backbones import small_vit

from zsp_lite import Co3D, ZeroShotPose, load_backbone
from zsp_lite.backbones import pretrained
from zsp_lite.backbones.backbone import Backbone, prepare_images
from zsp_lite.backbones.combined import CombinedBackbone, parse_combination
from zsp_lite.backbones.convolutional import ConvolutionalBackbone
from zsp_lite.backbones.efficientnet import EfficientNetLite0
from zsp_lite.backbones.load import BackboneConfig, verify
from zsp_lite.backbones.pretrained import available_backbones, download
from zsp_lite.baselines.rootsift import RootSift
from zsp_lite.benchmark.cache import FeatureCache
from zsp_lite.benchmark.extractors import fingerprint
from zsp_lite.benchmark.run import evaluate, plan_run
from zsp_lite.cli import main as cli_main
from zsp_lite.data.samples import sample_data
from zsp_lite.demo import demo_pairs
from zsp_lite.errors import InputError

pytestmark = pytest.mark.slow

SPEC = "zsp-tiny+0.5*effnet-lite0"


@pytest.fixture(scope="module")
def photo_network() -> ConvolutionalBackbone:
    return load_backbone("effnet-lite0", "cpu")


@pytest.fixture(scope="module")
def both() -> CombinedBackbone:
    return load_backbone(SPEC, "cpu")


@pytest.fixture()
def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, shape, dtype=np.uint8) for shape in ((64, 64, 3), (50, 70, 3), (96, 64, 3))]


@functools.cache
def network() -> EfficientNetLite0:
    return EfficientNetLite0()


def small_photo_network(**options) -> ConvolutionalBackbone:
    """The pretrained network for small images."""
    return ConvolutionalBackbone(network(), "small", device="cpu", **({"image_size": 64} | options))


# convolutional backbones


def test_keys_are_the_map_of_the_chosen_block(pictures):
    for layer, channels, stride in ((None, 112, 16), ("block4", 40, 8), (-1, 320, 32)):
        backbone = small_photo_network(layer=layer, batch_size=2)
        with torch.inference_mode():
            maps = network().features(prepare_images(pictures, 64), backbone.layer)
        found = backbone(pictures)
        assert all(one.keys.shape == (64 // stride, 64 // stride, channels) for one in found)
        torch.testing.assert_close(
            torch.stack([one.keys for one in found]), maps.permute(0, 2, 3, 1), atol=1e-4, rtol=1e-4
        )
        torch.testing.assert_close(found[2].global_feature, maps[2].mean((1, 2)), atol=1e-4, rtol=1e-4)


def test_the_loaded_network_has_the_papers_grid_and_no_saliency(photo_network):
    (found,) = photo_network([np.zeros((30, 40, 3), np.uint8)])
    assert found.keys.shape == (28, 28, 112) and photo_network.image_size == 448
    assert not photo_network.has_saliency and bool((found.saliency == 1).all())
    assert not found.keys.is_inference() and not found.keys.requires_grad
    assert (photo_network.name, str(photo_network.device)) == ("effnet-lite0", "cpu")


def test_options_choose_the_block_and_round_the_size_to_the_stride():
    backbone = load_backbone(BackboneConfig("effnet-lite0", "block7", image_size=100), "cpu")
    assert (backbone.name, backbone.layer, backbone.image_size) == ("effnet-lite0 (block7, 100 px)", 7, 96)


def test_bfloat16_changes_keys_by_rounding_only(pictures, monkeypatch):
    monkeypatch.setattr("zsp_lite.backbones.precision.bfloat16_is_fast", lambda device_type: True)
    full, half = (small_photo_network(precision=one)(pictures) for one in ("float32", "bfloat16"))
    for one, other in zip(full, half):
        assert other.keys.dtype == torch.float32 and not torch.equal(one.keys, other.keys)
        assert F.cosine_similarity(one.keys.flatten(), other.keys.flatten(), dim=0) > 0.99


# combinations


def test_combined_keys_are_the_normalised_keys_of_the_parts_with_their_weights(both, photo_network, pictures):
    tiny = load_backbone("zsp-tiny", "cpu")
    for found, first, second in zip(both(pictures), tiny(pictures), photo_network(pictures), strict=True):
        normalised = [F.normalize(one.keys, dim=-1) for one in (first, second)]
        assert torch.equal(found.keys, torch.cat([normalised[0], 0.5 * normalised[1]], dim=-1))
        assert torch.equal(found.saliency, first.saliency)
        assert torch.equal(found.global_feature, first.global_feature)
    assert (both.name, both.image_size, both.has_saliency) == (SPEC, 448, True)


def test_cosines_are_the_mean_of_the_parts_with_squared_weights(pictures):
    parts = [Backbone(small_vit(), "vit", device="cpu", image_size=64), small_photo_network(layer=4)]
    cosines = []
    for backbone in (*parts, CombinedBackbone(parts, (2, 0.5))):
        keys = F.normalize(backbone(pictures[:1])[0].keys.flatten(0, 1), dim=1)
        cosines.append(keys @ keys.T)
    torch.testing.assert_close(cosines[2], (4 * cosines[0] + 0.25 * cosines[1]) / 4.25)


def test_maps_take_the_grid_of_the_first_part(pictures):
    coarse, fine = small_photo_network(), Backbone(small_vit(), "vit", device="cpu", image_size=64)
    (found,), (keys,), (salient,) = (one(pictures[:1]) for one in (CombinedBackbone([coarse, fine]), coarse, fine))
    assert found.grid == (4, 4) and found.keys.shape[-1] == 112 + 64
    torch.testing.assert_close(found.keys[..., :112], F.normalize(keys.keys, dim=-1))
    # The part with a saliency of its own gives saliency and global feature, wherever it stands.
    assert torch.equal(found.global_feature, salient.global_feature)
    assert 0 <= found.saliency.min() < found.saliency.max() <= 1
    torch.testing.assert_close(found.saliency.mean(), salient.saliency.mean(), atol=0.05, rtol=0)
    # A map that is constant stays constant, so interpolation is exact there.
    flat = lambda images: [replace(one, keys=torch.ones_like(one.keys)) for one in fine(images)]  # noqa: E731
    torch.testing.assert_close(
        CombinedBackbone([coarse, flat])(pictures)[0].keys[..., 112:], torch.full((4, 4, 64), 0.125)
    )


def test_without_any_saliency_the_combination_has_none(pictures):
    combined = CombinedBackbone([small_photo_network(), RootSift()])
    assert not combined.has_saliency and combined.name == "small+rootsift"
    (found,), (first,) = combined(pictures[:1]), small_photo_network()(pictures[:1])
    assert torch.equal(found.global_feature, first.global_feature)


@pytest.mark.parametrize(
    "name, parts, weights",
    [
        ("a+b", ["a", "b"], [1, 1]),
        (" 2 * a + 1e-2*hf:some/model ", ["a", "hf:some/model"], [2, 0.01]),
        ("a+.5*b+3*c.pth", ["a", "b", "c.pth"], [1, 0.5, 3]),
    ],
)
def test_a_combination_is_read_as_names_with_weights(name, parts, weights):
    assert parse_combination(name) == (parts, weights)


@pytest.mark.parametrize(
    "name, message",
    [
        ("zsp-tiny+", "expected names joined by"),
        ("+", "expected names joined by"),
        ("*", "weight is nan"),
        ("zsp-tiny++effnet-lite0", "expected names joined by"),
        ("0.5*effnet-lite0", "expected names joined by"),
        ("zsp-tiny+-1*effnet-lite0", "'-1[*]effnet-lite0': weight is -1.0, expected a number from 0.001 to 1000"),
        ("zsp-tiny+0*effnet-lite0", "weight is 0.0"),
        ("zsp-tiny+nan*effnet-lite0", "weight is nan"),
        ("zsp-tiny+inf*effnet-lite0", "weight is inf"),
        ("zsp-tiny+half*effnet-lite0", "weight is nan"),
        ("2*zsp-tiny*effnet-lite0+zsp-tiny", "weight is nan"),
        ("zsp-tiny+resnet", "^backbone 'resnet': neither a file nor one of .*effnet-lite0"),
        ("x+" * 5000, "expected names joined by|neither a file"),
        ("a\0+b", "neither a file"),
    ],
)
def test_a_wrong_combination_is_one_line_that_names_the_part(name, message):
    with pytest.raises(InputError, match=message) as caught:
        load_backbone(name, "cpu")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("parts, weights", [(0, None), (1, None), (2, (1,)), (2, (1, "2")), (2, (1, float("nan")))])
def test_wrong_parts_and_weights_are_refused(parts, weights):
    with pytest.raises(InputError, match="^combination: "):
        CombinedBackbone([CoordinateBackbone()] * parts, weights)


@pytest.mark.parametrize(
    "name, options",
    [
        ("effnet-lite0", {"facet": "token"}),
        ("effnet-lite0", {"num_heads": 2}),
        ("effnet-lite0", {"saliency_heads": (0,)}),
        ("effnet-lite0", {"layer": "block16"}),
        ("effnet-lite0", {"image_size": 0}),
        ("effnet-lite0", {"precision": "float16"}),
        ("effnet-lite0", {"batch_size": 0}),
        (SPEC, {"layer": 3}),
        (SPEC, {"image_size": 64}),
        (BackboneConfig(SPEC, facet="value"), {}),
    ],
)
def test_options_that_a_backbone_does_not_have_are_refused(name, options):
    with pytest.raises(InputError, match="layer|facet|image_size|num_heads|saliency_heads|precision|batch_size"):
        load_backbone(name, "cpu", **options)


def test_a_file_whose_name_has_a_plus_is_a_checkpoint(tmp_path):
    torch.save(small_vit(num_heads=1).state_dict(), tmp_path / "one+2*two.pth")
    assert load_backbone(tmp_path / "one+2*two.pth", "cpu").name == "one+2*two"


# names: files, download, verification


def test_the_packaged_weights_are_listed_found_and_verified(monkeypatch):
    path = available_backbones()["effnet-lite0"]
    assert path.is_file() and download("effnet-lite0") == path
    verify("effnet-lite0")
    verify(SPEC)

    def missing():
        raise InputError("effnet-lite0: not installed")

    monkeypatch.setitem(pretrained.PACKAGED, "effnet-lite0", missing)
    assert available_backbones()["effnet-lite0"] is None


def test_each_part_of_a_combination_is_verified(tmp_path, monkeypatch):
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path))
    with pytest.raises(InputError, match="^dino_vits8 is not downloaded"):
        verify("zsp-tiny+dino_vits8")


# the pipeline and the benchmark


def test_without_saliency_one_line_asks_for_the_mask(photo_network):
    with pytest.raises(
        InputError, match="^foreground is 'saliency', which effnet-lite0 does not have; expected 'mask'"
    ):
        ZeroShotPose(photo_network)
    assert ZeroShotPose(photo_network, foreground="mask").backbone is photo_network


def test_the_pipeline_runs_on_a_sample_pair_with_both(both, photo_network):
    dataset = Co3D(sample_data())
    reference, targets = dataset.load_pair(demo_pairs(dataset, n_targets=3)[0])
    estimate = ZeroShotPose(both, k=30, trials=200).estimate(reference, targets)
    assert len(estimate.matches) > 20 and estimate.inliers.sum() >= 4 and not estimate.flags
    assert estimate.reference_view.features.keys.shape == (28, 28, 192 + 112)
    masked = ZeroShotPose(photo_network, k=30, trials=200, foreground="mask").estimate(reference, targets[:1])
    assert len(masked.matches) > 20


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--methods", "ours", "--backbone", "effnet-lite0"], "method ours: foreground is 'saliency'"),
        (["--methods", "ours", "--backbone", "zsp-tiny+"], "'zsp-tiny+'"),
        (["--methods", "ours", "--backbone", SPEC, "--layer", "3"], "layer '3'"),
    ],
)
def test_the_command_line_refuses_wrong_backbones_in_one_line(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli_main.main(["benchmark", "--data", str(small_folder()), *arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and captured.out == ""
    assert list(tmp_path.iterdir()) == []


def test_the_demo_refuses_a_backbone_without_saliency_before_it_writes(photo_network, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("zsp_lite.backbones.load.load_backbone", lambda name: photo_network)
    assert cli_main.main(["demo", "--data", str(small_folder()), "--out", str(tmp_path / "demo")]) == 2
    assert "which effnet-lite0 does not have" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


def test_the_benchmark_names_the_combination(tmp_path):
    rows, options = ["ours", "ours-mask", "rootsift"], {"out": tmp_path, "categories": ["lump"]}
    summary = evaluate(small_folder(), SPEC, rows, 1, 2, **options)
    assert summary["backbone"].startswith(SPEC) and {one["n"] for one in summary["methods"].values()} == {1}
    with pytest.raises(InputError, match="backbone"):  # another weight is another run
        evaluate(small_folder(), "zsp-tiny+0.6*effnet-lite0", rows, 1, 2, **options)
    with pytest.raises(InputError, match="^method 'random' needs a Backbone"):
        plan_run(small_folder(), SPEC, ["random"], 1, 2)


def test_rows_without_saliency_are_refused_before_anything_runs(tmp_path):
    backbone = small_photo_network()
    for row in ("ours", "verified-holes"):
        with pytest.raises(InputError, match=f"^method {row}: foreground is 'saliency'"):
            evaluate(small_folder(), backbone, [row], 1, 2, out=tmp_path / "run")
        with pytest.raises(InputError, match=f"^method {row}: foreground is 'saliency'"):
            plan_run(small_folder(), backbone, [row], 1, 2, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    summary = evaluate(small_folder(), backbone, ["ours-mask"], 1, 2, out=tmp_path / "run", categories=["lump"])
    assert summary["methods"]["ours-mask"]["n"] == 1 and summary["saliency_iou"] == {}


def test_the_cache_tells_combinations_apart_but_not_devices_and_batches(ellipsoids, tmp_path):
    frame = ellipsoids.load(ellipsoids.frames("ellipsoid", "a")[0])
    vit, photo = Backbone(small_vit(), "vit", device="cpu"), small_photo_network()
    backbones = [
        vit, photo, small_photo_network(layer=7), small_photo_network(image_size=96),
        CombinedBackbone([vit, photo]), CombinedBackbone([photo, vit]), CombinedBackbone([vit, photo], (1, 0.5)),
        CombinedBackbone([vit, small_photo_network(layer=7)]),
    ]  # fmt: skip
    paths = {FeatureCache(tmp_path, {"backbone": one}).path("backbone", frame) for one in backbones}
    assert len(paths) == len(backbones)
    assert fingerprint(small_photo_network(batch_size=1)) == fingerprint(photo)
    again = CombinedBackbone([vit, small_photo_network(batch_size=1)])
    assert fingerprint(again) == fingerprint(backbones[4])
    cache = FeatureCache(tmp_path, {"backbone": again})
    (found,) = again([frame.rgb])
    cache.write("backbone", frame, found)
    assert torch.equal(cache.read("backbone", frame).keys, found.keys)
