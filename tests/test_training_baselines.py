"""Training of the small baseline networks: poses of the training images, losses, resumption, shipped weights."""

import json
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

import zsp_lite
from zsp_lite.baselines.posecontrast import euler_to_rotation, load_posecontrast_tiny, rotation_to_euler
from zsp_lite.baselines.swav import load_swav_tiny
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.synthetic.evaluation_categories import EVALUATION
from zsp_lite.synthetic.training_categories import TRAINING
from zsp_lite.training import posecontrast, swav
from zsp_lite.training.object_crops import SIZE, VIEWS, object_crops, render_object
from zsp_lite.training.posecontrast import PoseContrastConfig, pose_contrast, sample, viewpoint_loss
from zsp_lite.training.swav import SwavConfig, multi_crop, swapped_prediction

pytestmark = pytest.mark.slow

WEIGHTS = Path(zsp_lite.__file__).parent / "weights"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with crops of two objects."""
    folder = tmp_path_factory.mktemp("crops")
    object_crops(folder / "crops", 2)
    return folder


@pytest.fixture(scope="module")
def crops(folder):
    return object_crops(folder / "crops", 2)


def test_an_object_is_seen_from_all_sides_and_fills_its_crops(crops):
    assert crops.rgb.shape == (2 * VIEWS, SIZE, SIZE, 3)
    assert (crops.aspect > 0.2).all() and (crops.aspect < 5).all()
    ahead = crops.rotation[:VIEWS, 2]  # the camera's axis in the object's frame
    directions = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0])) % 360
    assert np.diff(np.sort(directions)).max() < 180
    again = render_object(0)
    for array, rows in zip(again, (crops.rgb, crops.aspect, crops.rotation), strict=True):
        np.testing.assert_array_equal(array, rows[:VIEWS])


def test_finished_crops_are_used_again(folder, crops):
    (path,) = (folder / "crops").iterdir()
    written = path.stat().st_mtime_ns
    assert (object_crops(folder / "crops", 2).rgb == crops.rgb).all() and path.stat().st_mtime_ns == written
    first, last = crops.split(VIEWS)
    assert len(first) == len(last) == VIEWS and (last.rgb == crops.rgb[VIEWS:]).all()


def test_a_rotated_image_has_a_rotated_pose(crops):
    """A rotation by 90 degrees equals `rot90` of the image and rotates its label."""
    config = PoseContrastConfig(batch=4, tilt=7)

    class Right(np.random.Generator):
        def normal(self, *args):  # the tilt, then nothing else that turns
            return np.full(config.batch, 90.0)

    rng = Right(np.random.PCG64(0))
    first, second, labels = sample(crops, rng, config)
    index = np.random.default_rng(0).integers(len(crops), size=config.batch)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert rotation_error(euler_to_rotation(labels.numpy()), quarter @ crops.rotation[index]).max() < 0.01
    plain = posecontrast._square_images(crops, index).mean(1).flatten(1)
    for images in (first, second):
        # x to the right becomes y downwards: clockwise on the screen.
        back = torch.rot90(images, 1, (2, 3)).mean(1).flatten(1)
        alike = torch.nn.functional.cosine_similarity(back - back.mean(1, True), plain - plain.mean(1, True))
        assert alike.min() > 0.9


def test_the_viewpoint_loss_is_least_for_the_true_bins_and_offsets():
    rotation = euler_to_rotation(np.array([[100.0, 70.0, 200.0], [10.0, 150.0, 359.0]]))
    labels = torch.from_numpy(rotation_to_euler(rotation).astype(np.float32))
    bins = [(labels[:, i] / 15).long() for i in range(3)]
    logits = [20 * torch.nn.functional.one_hot(b, n).float() for b, n in zip(bins, (24, 12, 24), strict=True)]
    offsets = [(labels[:, i] / 15 - b)[:, None].expand(-1, n) for i, (b, n) in enumerate(zip(bins, (24, 12, 24)))]
    assert viewpoint_loss(logits, offsets, labels) < 1e-4
    assert viewpoint_loss(logits, [offset + 0.3 for offset in offsets], labels) > 0.5
    assert viewpoint_loss([logit.roll(1, 1) for logit in logits], offsets, labels) > 30


def test_images_with_the_same_pose_are_no_negatives_of_each_other():
    feature = torch.eye(3)[:2]
    same = torch.tensor([[30.0, 90.0, 180.0]] * 2)
    opposite = torch.tensor([[30.0, 90.0, 180.0], [210.0, 90.0, 180.0]])
    assert pose_contrast(feature, feature, same, 0.5) == pytest.approx(0, abs=1e-6)
    expected = np.log1p(np.exp((0 - 1) / 0.5))
    assert float(pose_contrast(feature, feature, opposite, 0.5)) == pytest.approx(expected, rel=1e-4)


def test_swapped_predictions_of_agreeing_crops_cost_least():
    config = SwavConfig()
    scores = torch.eye(8)
    agree, evenness = swapped_prediction(torch.stack([scores] * 4), config.temperature, config.regularisation)
    differ, _ = swapped_prediction(
        torch.stack([scores, scores, scores.roll(1, 0), scores.roll(2, 0)]), config.temperature, config.regularisation
    )
    assert agree < 0.05 < 3 < differ and evenness == pytest.approx(1, abs=1e-3)
    # Even if all images prefer one prototype, assignments are spread over all of them.
    one = torch.eye(8)[:1].repeat(8, 1) + 0.01 * torch.rand(8, 8, generator=torch.Generator().manual_seed(0))
    assert swapped_prediction(torch.stack([one] * 2), 0.1, 0.05)[1] > 0.9


def test_crops_are_two_large_and_two_small_ones():
    images = torch.rand(3, 3, SIZE, SIZE)
    config = SwavConfig()
    large, small = multi_crop(images, np.random.default_rng(0), config)
    assert large.shape == (6, 3, config.large, config.large) and small.shape == (6, 3, config.small, config.small)


def train_both(crops_folder, folder, log=lambda line: None):
    """Runs of three steps on the crops; the folders of the two runs."""
    for name in ("swav", "posecontrast"):
        shutil.copytree(crops_folder / "crops", folder / name / "crops", dirs_exist_ok=True)
    swav.train(SwavConfig(objects=2, steps=3, batch=4, prototypes=3), folder / "swav", log)
    posecontrast.train(PoseContrastConfig(objects=2, steps=3, batch=4), folder / "posecontrast", log)


def test_both_trainings_write_what_the_loaders_read(folder, tmp_path):
    lines = []
    train_both(folder, tmp_path, lines.append)
    model = load_swav_tiny(tmp_path / "swav" / "swav-tiny.safetensors")
    assert model([np.zeros((224, 224, 3), np.uint8)])[0].keys.shape[:2] == (28, 28)
    load_posecontrast_tiny(tmp_path / "posecontrast" / "posecontrast-tiny.safetensors")
    row = json.loads((tmp_path / "posecontrast" / "log.jsonl").read_text().splitlines()[-1])
    assert row["step"] == 3 and 0 <= row["held_out_median"] <= 180 and len(lines) == 2
    config = json.loads((tmp_path / "swav" / "config.json").read_text())
    assert config["steps"] == 3 and config["categories"] == list(TRAINING)


def test_killed_trainings_resume_to_the_same_weights(folder, tmp_path, monkeypatch):
    train_both(folder, tmp_path / "whole")

    def kill_after_two(task, *args, **options):
        for _ in range(2):
            task.step()
        task.save(args[0] / "checkpoint.pt")

    with monkeypatch.context() as patch:
        patch.setattr(swav, "run", kill_after_two)
        patch.setattr(posecontrast, "run", kill_after_two)
        train_both(folder, tmp_path / "killed")
    train_both(folder, tmp_path / "killed")
    for file in ("swav/swav-tiny.safetensors", "posecontrast/posecontrast-tiny.safetensors"):
        expected, got = load_file(tmp_path / "whole" / file), load_file(tmp_path / "killed" / file)
        assert expected.keys() == got.keys() and all(torch.equal(expected[name], got[name]) for name in expected)


@pytest.mark.parametrize(
    "name, load, recipe",
    [
        ("swav-tiny", load_swav_tiny, SwavConfig()),
        ("posecontrast-tiny", load_posecontrast_tiny, PoseContrastConfig()),
    ],
)
def test_a_shipped_network_loads_and_was_trained_on_no_evaluation_category(name, load, recipe):
    config = json.loads((WEIGHTS / f"{name}.json").read_text())
    assert config == json.loads(json.dumps(asdict(recipe))) | {"categories": list(TRAINING)}
    assert config["categories"] and not set(config["categories"]) & set(EVALUATION)
    assert (WEIGHTS / f"{name}.safetensors").stat().st_size < 3e6
    log = [json.loads(line) for line in (WEIGHTS / f"{name}.jsonl").read_text().splitlines()]
    assert log[-1]["step"] == config["steps"] and log[-1]["loss"] < log[0]["loss"]
    weights = load().state_dict()
    assert all(x.dtype == torch.float32 and x.isfinite().all() for x in weights.values() if x.is_floating_point())


def test_settings_without_a_meaning_are_refused(tmp_path):
    with pytest.raises(InputError, match="batch=1"):
        SwavConfig(batch=1)
    with pytest.raises(InputError, match="steps=0"):
        PoseContrastConfig(steps=0)
    with pytest.raises(InputError, match="objects=1, .* expected at least 2"):
        PoseContrastConfig(objects=1)
    with pytest.raises(InputError, match="objects is 0"):
        object_crops(tmp_path, 0)
