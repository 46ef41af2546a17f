"""The term `agreement`: photo features at the points of a scene, compared under a pose, with fitted channel weights."""

import re
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from model_files import write_wedge
from synthetic_views import ELSEWHERE, CoordinateBackbone, matched_scene, reference_and_targets, true_pose

from tools.concepts import check_sides
from tools.tuning import Outcome, channel_columns, fit_agreement, main, report_beside
from tools.variants import render_variants
from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import load_backbone
from zsp_lite.best_view import ViewPair
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.matching import match, similarities
from zsp_lite.verified import VerifiedSolver
from zsp_lite.verified.agreement import agreement_term, channel_agreement, channel_weights
from zsp_lite.verified.poses import Poses, concatenate
from zsp_lite.verified.scene import build_scene, photo_features
from zsp_lite.verified.verification import TERM_NAMES, ScoreWeights
from zsp_lite.views import extract_views, object_crop, turn_view

CHANNELS = 6


@pytest.fixture(scope="module")
def frames():
    return reference_and_targets()


@pytest.fixture(scope="module")
def views(frames):
    """Views whose photo features are a fixed function of the object's coordinates, at half the patches' resolution."""
    mixing = torch.from_numpy(np.random.default_rng(0).normal(size=(3, CHANNELS))).float()
    found = []
    for view in extract_views(CoordinateBackbone(), [object_crop(frame) for frame in frames]):
        coordinates = view.features.keys[::2, ::2, :3]
        found.append(replace(view, features=replace(view.features, photo=(coordinates @ mixing).sin())))
    return found


@pytest.fixture(scope="module")
def scene(views):
    return matched_scene(views)


@pytest.fixture(scope="module")
def poses(frames, scene):
    """The true pose, and three others."""
    truth = scene.from_sim3([true_pose(frames[0].camera, Sim3.identity(), frames[1].camera, ELSEWHERE)], 0)
    turns = torch.diag_embed(torch.tensor([[-1.0, -1, 1], [1, -1, -1], [-1, 1, -1]]))
    others = Poses(truth.scale.expand(3), truth.rotation @ turns, truth.translation.expand(3, -1))
    return concatenate([truth, others])


def test_the_agreement_of_channels_by_hand(scene, poses):
    def descriptors(photo):
        x = photo.double().numpy()
        x = (x - x.mean(1, keepdims=True)) / np.sqrt(x.var(1, keepdims=True) + 1e-5)
        x = x - x.mean(0)
        return x / np.linalg.norm(x, axis=1, keepdims=True)

    # At most 160 points of the reference and 320 of the targets, evenly spaced.
    rows = torch.linspace(0, len(scene.reference_points) - 1, 160).long()
    columns = torch.linspace(0, len(scene.target_points) - 1, 320).long()
    e, f = descriptors(scene.reference_photo)[rows], descriptors(scene.target_photo)[columns]
    x, y = scene.reference_points[rows].double().numpy(), scene.target_points[columns].double().numpy()
    found = channel_agreement(scene, poses)
    assert found.shape == (4, 2 * CHANNELS)
    for k in range(4):
        scale, rotation, t = (part[k].double().numpy() for part in (poses.scale, poses.rotation, poses.translation))
        moved = (y - t) @ rotation / scale
        forward, reverse = np.zeros(CHANNELS), np.zeros(CHANNELS)
        kernel = np.array([[np.exp(-((p - q) ** 2).sum() / (2 * 0.25**2)) for q in moved] for p in x])
        for i in range(len(x)):
            forward += e[i] * (kernel[i] @ f) / (kernel[i].sum() + 0.3) / len(x)
        for j in range(len(y)):
            reverse += f[j] * (kernel[:, j] @ e) / (kernel[:, j].sum() + 0.3) / len(y)
        np.testing.assert_allclose(found[k], [*forward, *reverse], atol=1e-4)


def test_the_true_pose_agrees_most(scene, poses):
    total = channel_agreement(scene, poses).sum(dim=1)
    assert total[0] > 1.5 * total[1:].max()


def test_photo_features_are_read_at_the_centres_of_patches(views):
    view = views[0]
    rows, columns = view.features.grid
    chosen = np.zeros(rows * columns, bool)
    chosen[[0, 5 * columns + 8, rows * columns - 1]] = True
    photo = view.features.photo
    torch.testing.assert_close(photo_features(view, chosen), torch.stack([photo[0, 0], photo[2, 4], photo[-1, -1]]))
    turned = turn_view(view, 1)
    torch.testing.assert_close(turned.features.photo[-1, 0], photo[0, 0])


def test_without_fitting_photo_features_the_term_is_zero(scene, poses, views):
    assert len(channel_weights()) == 640
    assert (agreement_term(replace(scene, reference_photo=None, target_photo=None), poses) == 0).all()
    assert (agreement_term(scene, poses) == 0).all()  # another number of channels
    bare = replace(views[1], features=replace(views[1].features, photo=None))
    sims = similarities(views[0].features, [bare.features, views[2].features])
    assert build_scene(views[0], [bare, views[2]], sims).target_photo is None


def test_constant_photo_features_agree_nowhere(scene, poses):
    flat = replace(
        scene,
        reference_photo=torch.full_like(scene.reference_photo, 0.3),
        target_photo=torch.ones_like(scene.target_photo),
    )
    assert channel_agreement(flat, poses).abs().max() < 1e-6


def test_the_default_backbone_has_photo_features_and_the_term_enters_the_score(views):
    image = np.random.default_rng(0).integers(0, 255, (60, 60, 3), np.uint8)
    assert load_backbone("zsp-tiny-photo", "cpu")([image])[0].photo.shape == (14, 14, 320)
    assert load_backbone("zsp-tiny", "cpu")([image])[0].photo is None
    assert load_backbone("effnet-lite0+zsp-tiny-photo", "cpu")([image])[0].photo.shape == (14, 14, 320)
    rng = torch.Generator().manual_seed(0)
    some = [
        replace(view, features=replace(view.features, photo=torch.rand(14, 14, 320, generator=rng))) for view in views
    ]
    found = similarities(some[0].features, [target.features for target in some[1:]])
    matches = [match(some[0].features, target.features, kmeans=False, sim=sim) for target, sim in zip(some[1:], found)]
    pairs = [
        ViewPair(some[0].features, one.features, some[0].foreground, one.foreground, sim, matched, 50)
        for one, sim, matched in zip(some[1:], found, matches)
    ]
    with_term = VerifiedSolver().solve(some[0], some[1:], pairs)
    assert with_term.scene.target_photo.shape == (len(with_term.scene.target_points), 320)
    best = with_term.hypotheses[0]
    assert best.terms["agreement"] != 0
    torch.testing.assert_close(
        agreement_term(with_term.scene, with_term.poses),
        channel_agreement(with_term.scene, with_term.poses) @ channel_weights(),
    )
    by_hand = sum(weight * best.terms[name] for name, weight in asdict(ScoreWeights()).items())
    assert best.score == pytest.approx(by_hand, abs=1e-3)


def test_photo_features_of_a_wrong_shape_are_refused():
    with pytest.raises(InputError, match=r"photo has shape \(2, 2\), expected \(h, w, C\)"):
        FeatureMap(torch.zeros(2, 3, 4), torch.zeros(2, 3), torch.zeros(4), photo=torch.zeros(2, 2))
    with pytest.raises(InputError, match="photo hold values that are not finite"):
        FeatureMap(torch.zeros(2, 3, 4), torch.zeros(2, 3), torch.zeros(4), photo=torch.full((1, 1, 2), torch.nan))


def made_up(n: int, rng: np.random.Generator) -> list[Outcome]:
    """Pairs of four hypotheses. The first channel tells the correct one, the other channels say nothing."""
    found = []
    for index in range(n):
        terms, channels = np.zeros((4, len(TERM_NAMES))), rng.normal(size=(4, 5))
        terms[:, 1] = rng.normal(0, 0.2, 4)
        correct = rng.integers(4)
        channels[correct, 0] += 2
        terms[correct, 1] += 0.3
        errors = np.where(np.arange(4) == correct, 3.0, 120.0)
        found.append(Outcome(f"category {index % 10}", terms, errors, 90 * (1 - np.eye(4)), channels=channels))
    return found


def test_the_channel_that_tells_is_found():
    outcomes = made_up(400, np.random.default_rng(0))
    fitted = fit_agreement(outcomes, ScoreWeights(), ridge=0.01)
    assert fitted[0] > 5 * np.abs(fitted[1:]).max()
    smaller = fit_agreement(outcomes, ScoreWeights(), ridge=1.0)
    assert 0 < smaller[0] < fitted[0]
    report = report_beside(
        outcomes, channel_columns, ScoreWeights(), fitted, lambda some: fit_agreement(some, ScoreWeights(), ridge=0.01)
    )
    won, lost = map(int, re.search(r"(\d+) pairs won, (\d+) lost", report[2]).groups())
    assert won > 50 and won > 10 * lost and report[3].startswith("5 weights")
    for one in outcomes:
        one.terms[:] *= -1
    with pytest.raises(InputError, match="score without the term has no positive weight"):
        fit_agreement(outcomes, ScoreWeights())
    with pytest.raises(InputError, match="none with the term"):
        fit_agreement([replace(one, channels=None) for one in outcomes], ScoreWeights())


def test_the_command_asks_for_a_file(tmp_path, capsys):
    assert main(["agreement", f"{tmp_path}:2"]) == 2
    assert "--out FILE is required" in capsys.readouterr().err


@pytest.mark.slow
def test_altered_copies_of_a_model_are_a_category(tmp_path):
    write_wedge(tmp_path / "models" / "clock" / "table_clock.obj")
    for name in ("hood", "kitchen_hood"):
        write_wedge(tmp_path / "models" / "hood" / f"{name}.obj")
    out = tmp_path / "out"
    render_variants(tmp_path / "models", out, frames=2, image_size=32)
    names = {category: sorted(read_labels(out, category)) for category in Co3D(out).categories()}
    assert names == {"clock-table_clock": ["table_clock_0", "table_clock_1"], "hood": ["hood_0", "kitchen_hood_0"]}
    check_sides([out], "training")
    with pytest.raises(InputError, match="category clock-table_clock is for training"):
        check_sides([out], "validation")
