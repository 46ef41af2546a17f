"""Self-distillation: its loss, its two averages, and what happens without centring or sharpening."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.training import distillation
from zsp_lite.training.distillation import (
    CENTRE_MOMENTUM,
    TEACHER_MOMENTUM,
    Distillation,
    DistillationConfig,
    distillation_loss,
    multi_crop,
)

pytestmark = pytest.mark.slow

TINY = DistillationConfig(steps=45, images=8, local_crops=2, global_side=32, local_side=16, outputs=64)


@pytest.fixture(scope="module")
def pictures() -> np.ndarray:
    """Eight objects, two views each, (8, 2, 48, 48, 3): stripes of each object's own colour and direction."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:48, :48]
    rgb = np.empty((8, 2, 48, 48, 3), np.uint8)
    for k in range(8):
        colour, angle = rng.uniform(60, 255, 3), k * np.pi / 8
        for view in range(2):
            phase = 0.6 * (x * np.cos(angle) + y * np.sin(angle)) + rng.uniform(0, 6)
            rgb[k, view] = (0.5 + 0.5 * np.sin(phase))[..., None] * colour
    return rgb


@pytest.fixture(scope="module")
def backbone() -> VisionTransformer:
    """Small, with weights large enough that its output depends on the picture from the start."""
    torch.manual_seed(1)
    model = VisionTransformer(32, 8, embed_dim=24, depth=2, num_heads=2)
    for module in model.modules():
        if isinstance(module, torch.nn.Linear):
            torch.nn.init.xavier_uniform_(module.weight)
    return model


def weights(run: Distillation) -> list[torch.Tensor]:
    return [run.centre, *run.student.state_dict().values(), *run.teacher.state_dict().values()]


def test_the_loss_is_the_cross_entropy_of_every_global_crop_with_every_other_crop():
    rng = np.random.default_rng(0)
    student, teacher, centre = rng.normal(size=(4, 3, 5)), rng.normal(size=(2, 3, 5)), rng.normal(size=5)
    terms, entropies = [], []
    for picture in range(3):
        for g in range(2):
            p = np.exp((teacher[g, picture] - centre) / 0.5)
            p /= p.sum()
            entropies.append(-sum(p * np.log(p)))
            for c in range(4):
                if c != g:
                    q = np.exp(student[c, picture] / 0.8)
                    terms.append(-sum(p * np.log(q / q.sum())))
    arrays = (torch.from_numpy(x) for x in (student, teacher, centre))
    loss, figures = distillation_loss(*arrays, student_temperature=0.8, teacher_temperature=0.5)
    assert len(terms) == 18 and float(loss) == pytest.approx(np.mean(terms))
    assert figures["teacher_entropy"] == pytest.approx(np.mean(entropies))
    assert figures["kl"] == pytest.approx(np.mean(terms) - np.mean(entropies))


def test_crops_come_from_their_own_image_and_differ(pictures):
    rng = np.random.default_rng
    large, small = multi_crop(pictures[:3, 0], rng(5), TINY)
    assert large.shape == (2, 3, 3, 32, 32) and small.shape == (2, 3, 3, 16, 16)
    assert not torch.equal(large[0], large[1])
    other = pictures[:3, 0].copy()
    other[2] = 255 - other[2]
    for crops, changed in zip((large, small), multi_crop(other, rng(5), TINY), strict=True):
        assert torch.equal(crops[:, :2], changed[:, :2])
        assert not torch.equal(crops[:, 2], changed[:, 2])


def test_centre_and_teacher_are_running_averages(pictures, backbone):
    run = Distillation(TINY, backbone, pictures)
    run.step()  # the first has no learning rate yet
    centre, before = run.centre.clone(), copy.deepcopy(run.teacher)
    rng = np.random.default_rng([TINY.seed, 3, 1])
    chosen = pictures[rng.integers(8, size=8), rng.integers(2, size=8)]
    large, _ = multi_crop(chosen, rng, TINY)
    with torch.no_grad():
        said = before(large)
    run.step()
    torch.testing.assert_close(run.centre, centre.lerp(said.mean((0, 1)), 1 - CENTRE_MOMENTUM))
    start, end = TEACHER_MOMENTUM
    momentum = end + (start - end) * (1 + math.cos(math.pi / 45)) / 2
    triples = zip(before.parameters(), run.student.parameters(), run.teacher.parameters(), strict=True)
    for slow, fast, after in triples:
        torch.testing.assert_close(after, momentum * slow + (1 - momentum) * fast.detach())
    assert any(not torch.equal(a, b) for a, b in zip(before.parameters(), run.teacher.parameters(), strict=True))


def test_it_collapses_without_centring_and_without_sharpening(pictures, backbone, monkeypatch):
    """DINO, section 5.3: without centring one output for all images, without sharpening a uniform distribution."""
    monkeypatch.setattr(distillation, "HIDDEN", 64)
    monkeypatch.setattr(distillation, "TEACHER_MOMENTUM", (0.97, 1.0))
    last = {}
    settings = {"both": {}, "no centring": dict(centring=False), "no sharpening": dict(sharpening=False)}
    for name, changes in settings.items():
        run = Distillation(replace(TINY, **changes), backbone, pictures)
        rows = [run.step() for _ in range(TINY.steps)]
        last[name] = {key: np.mean([row[key] for row in rows[-8:]]) for key in rows[0]}
    top = math.log(TINY.outputs)
    assert last["no centring"]["teacher_entropy"] < 0.15 * top
    assert last["no sharpening"]["teacher_entropy"] > 0.97 * top
    assert 0.3 * top < last["both"]["teacher_entropy"] < 0.95 * top
    assert last["both"]["information"] > 3 * last["no centring"]["information"]
    assert last["both"]["information"] > 3 * last["no sharpening"]["information"]


def test_a_run_depends_on_its_seed_alone_and_leaves_the_given_backbone_as_it_was(pictures, backbone):
    before = copy.deepcopy(backbone.state_dict())
    runs = [Distillation(replace(TINY, seed=seed), backbone, pictures) for seed in (0, 0, 1)]
    figures = [[run.step() for _ in range(3)] for run in runs]
    assert figures[0] == figures[1] != figures[2]
    assert all(torch.equal(a, b) for a, b in zip(weights(runs[0]), weights(runs[1]), strict=True))
    assert all(torch.equal(before[name], value) for name, value in backbone.state_dict().items())
