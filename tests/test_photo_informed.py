"""The transformer that receives the features of a photo network: its input, its training, export and loading."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file

from zsp_lite.backbones import pretrained
from zsp_lite.backbones.backbone import normalize
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.photo_informed import DETAIL, PhotoInformedViT
from zsp_lite.backbones.pretrained import EMBEDDED, SUMS, TINY, WEIGHTS
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError
from zsp_lite.training.batches import MEAN, STD, sample_batch
from zsp_lite.training.export import export_checkpoint, export_photo_input, starting_weights
from zsp_lite.training.recipe import Stage, TrainingConfig
from zsp_lite.training.train import BackboneTraining
from zsp_lite.training.trainee import Trainee

pytestmark = pytest.mark.slow

SMALL = TrainingConfig(
    embed_dim=48, depth=2, num_heads=2, layer=1, photo_share=0.5, stages=(Stage(4, 64, 1, 8, (0.6, 1.0), view=1.0),)
)  # fmt: skip


@pytest.fixture(scope="module")
def exported(renders, tmp_path_factory):
    """A small network with a photo input that is not zero, as files."""
    torch.manual_seed(0)
    model, folder = Trainee(SMALL), tmp_path_factory.mktemp("weights")
    torch.nn.init.normal_(model.photo_projection.linear.weight, std=0.1)
    backbone = export_checkpoint(model, renders, SMALL, folder / "zsp-tiny.safetensors")
    return export_photo_input(model, renders, backbone, folder / "zsp-tiny-photo.safetensors")


def test_without_a_projection_it_is_the_transformer_alone():
    network = PhotoInformedViT(VisionTransformer(64, 8, 48, 2, 2)).eval()
    images = torch.rand(2, 3, 128, 128)
    with torch.no_grad():
        found, alone = network.extract(images, 1), network.vit.extract(normalize(F.avg_pool2d(images, DETAIL)), 1)
    for name in ("keys", "attention", "cls"):
        torch.testing.assert_close(getattr(found, name), getattr(alone, name))
    assert found.grid == (8, 8)


def test_each_patch_receives_the_features_of_its_place():
    network = PhotoInformedViT(VisionTransformer(64, 8, 48, 2, 2)).eval()
    torch.nn.init.normal_(network.photo_input.projection.linear.weight)
    images = torch.rand(1, 3, 128, 128)
    small, added, _ = network.inputs(images)
    features = network.photo_network.features(images)  # (1, 112, 8, 8)
    assert small.shape == (1, 3, 64, 64) and features.shape[2:] == (8, 8)
    expected = network.photo_input.projection.linear(F.layer_norm(features[0, :, 3, 5], (112,)))
    torch.testing.assert_close(added[0, 3 * 8 + 5], expected)


def test_the_exported_files_give_the_features_of_training(exported, renders):
    """Up to the rounding to float16 and a constant in the keys."""
    backbone = load_backbone(exported, "cpu")
    assert (backbone.name, backbone.image_size, backbone.patch_size) == ("zsp-tiny-photo", 448, 16)
    torch.manual_seed(0)
    model = Trainee(SMALL)
    torch.nn.init.normal_(model.photo_projection.linear.weight, std=0.1)
    image = F.interpolate(torch.from_numpy(renders.rgb[0, :1]).permute(0, 3, 1, 2) / 255.0, (448, 448), mode="bilinear")
    with torch.no_grad():
        out = model.eval()((image - MEAN) / STD, photo=True)
    found = backbone([image[0].permute(1, 2, 0).clamp(0, 1).numpy()])[0]
    attention = out.cls_logits.softmax(-1)[0, :, 1:].mean(0)
    attention = (attention - attention.min()) / (attention.max() - attention.min())
    torch.testing.assert_close(found.saliency.flatten(), attention, atol=0.02, rtol=0)
    centred = (x - x.mean(0) for x in (found.keys.flatten(0, 1), out.keys[0]))
    assert F.cosine_similarity(*centred).mean() > 0.999


def test_a_further_run_starts_from_the_exported_photo_input(exported, renders):
    model = Trainee(SMALL)
    missing = model.load_state_dict(starting_weights(SMALL, exported), strict=False).missing_keys
    assert missing and all(name.startswith("geometry") for name in missing)
    images = torch.rand(2, 3, 448, 448)
    with torch.no_grad():
        found = model.centred(model.eval()((images - MEAN) / STD, photo=True).keys, photo=True)
        expected = load_backbone(exported, "cpu").model.extract(images, SMALL.layer).keys
    torch.testing.assert_close(found, expected, atol=5e-3, rtol=1e-2)  # float16 in the file
    with pytest.raises(InputError, match="zsp-tiny-photo.safetensors: has a photo input, expected a transformer alone"):
        starting_weights(replace(SMALL, photo_share=0.0), exported)


def test_the_mean_key_of_every_block_is_subtracted(exported, renders):
    means = [
        load_backbone(exported, "cpu", layer=layer)(list(renders.rgb[0, ::3]))[0].keys.mean((0, 1)) for layer in (0, 1)
    ]
    raw = load_file(exported)["key_mean"].float()
    assert all(mean.norm() < 0.6 * shift.norm() for mean, shift in zip(means, raw, strict=True))


def test_a_photo_input_without_its_transformer_is_refused(exported, tmp_path):
    alone = tmp_path / "alone.safetensors"
    alone.write_bytes(exported.read_bytes())
    with pytest.raises(InputError, match="alone.safetensors is the photo input of zsp-tiny.safetensors, expected"):
        load_backbone(alone, "cpu")
    weights = load_file(exported) | {"key_mean": torch.zeros(3, 48)}
    save_file(weights, exported.with_name("other.safetensors"), metadata={"transformer": "zsp-tiny.safetensors"})
    with pytest.raises(InputError, match="other.safetensors: 1 weights do not fit .* key_mean: expected .2, 48."):
        load_backbone(exported.with_name("other.safetensors"), "cpu")


def test_image_sizes_are_those_of_both_networks():
    """Multiples of 32, which EfficientNet needs, not of the patches of 16 pixels."""
    backbone = load_backbone("zsp-tiny-photo", "cpu", image_size=240)
    assert backbone.image_size == 256
    assert backbone([np.zeros((60, 60, 3), np.uint8)])[0].grid == (16, 16)


def test_the_shipped_transformer_behind_a_photo_input_is_checked(monkeypatch, tmp_path):
    for path in [EMBEDDED["zsp-tiny-photo"], TINY, WEIGHTS / SUMS]:
        shutil.copy(path, tmp_path)
    monkeypatch.setattr(pretrained, "WEIGHTS", tmp_path)
    for name in ("zsp-tiny-photo", "zsp-tiny"):
        monkeypatch.setitem(EMBEDDED, name, tmp_path / EMBEDDED[name].name)
    load_backbone("zsp-tiny-photo", "cpu")
    data = bytearray(EMBEDDED["zsp-tiny"].read_bytes())
    data[-1000] ^= 1
    EMBEDDED["zsp-tiny"].write_bytes(data)
    with pytest.raises(InputError, match="^[^\n]*zsp-tiny.safetensors is damaged: its SHA-256 is [^\n]*$"):
        load_backbone("zsp-tiny-photo", "cpu")


def test_training_moves_the_photo_input_and_leaves_the_photo_network(renders):
    task = BackboneTraining(SMALL, renders, renders, None, np.full((2, 24, 36, 3), 200, np.uint8))
    before = {name: value.clone() for name, value in task.model._photo_network[0].state_dict().items()}
    figures = [task.step() for _ in range(4)]
    assert task.model.photo_projection.linear.weight.abs().sum() > 0
    assert task.model.photo_key_mean.any() and task.model.key_mean.any()  # steps of both kinds
    assert all(np.isfinite(list(row.values())).all() for row in figures)
    assert all(torch.equal(value, before[name]) for name, value in task.model._photo_network[0].state_dict().items())
    assert not any("photo_network" in name for name in task.state_dict())
    evaluated = task.evaluate()
    assert {"held_out_iou", "photo_held_out_iou", "photo_held_out_view_accuracy"} <= evaluated.keys()


def test_another_batch_seed_gives_other_batches_of_the_same_objects(renders):
    figures = [
        BackboneTraining(replace(SMALL, photo_share=0.0, batch_seed=seed), renders, renders).step()
        for seed in (0, 0, 1)
    ]
    assert figures[0] == figures[1] != figures[2]


def test_crops_for_the_photo_network_show_the_same_in_more_detail(renders):
    """The transformer's crop is the mean of 2 x 2 pixels of the larger one."""
    one, two = (
        sample_batch(renders, np.random.default_rng(5), 1, 2, 64, (0.9, 1.0), detail=detail) for detail in (1, DETAIL)
    )
    assert two.images.shape[-1] == 2 * one.images.shape[-1]
    assert (F.avg_pool2d(two.images, 2) - one.images).abs().mean() < 0.15
    torch.testing.assert_close(one.coverage, two.coverage, atol=0.3, rtol=0)
