"""tools/tuning.py: the fits recover known parameters, are evaluated on held-out categories, and refuse other splits."""

import logging
from dataclasses import astuple, replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from synthetic_views import CoordinateBackbone

from tools import tuning
from tools.concepts import check_sides
from tools.tuning import (
    Outcome,
    collect_outcomes,
    fit_beside,
    fit_calibration,
    fit_weights,
    leave_out,
    orientation_column,
    report_beside,
    report_calibration,
    report_weights,
    unseen_categories,
    use_head,
)
from zsp_lite.backbones.load import load_backbone
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.verified import VerifiedSolver
from zsp_lite.verified.confidence import Calibration, reliability
from zsp_lite.verified.verification import TERM_NAMES, ScoreWeights

TRUE_WEIGHTS = ScoreWeights(6, 0, -4, -2, 0, 3, 0, -1, 0, 2)


def sample_outcomes(n: int, rng: np.random.Generator, m: int = 6) -> list[Outcome]:
    """Pairs with one correct hypothesis each, drawn with probability proportional to exp(score) under TRUE_WEIGHTS."""
    outcomes = []
    for index in range(n):
        terms = rng.normal(size=(m, len(TERM_NAMES)))
        score = terms @ np.array(astuple(TRUE_WEIGHTS))
        probability = np.exp(score - score.max())
        errors = np.full(m, 120.0)
        errors[rng.choice(m, p=probability / probability.sum())] = 0
        outcomes.append(Outcome(f"category {index % 4}", terms, errors, 90 * (1 - np.eye(m))))
    return outcomes


def test_the_weights_of_the_sampling_distribution_are_recovered():
    fitted = fit_weights(sample_outcomes(1200, np.random.default_rng(0)), ridge=0)
    np.testing.assert_allclose(astuple(fitted), astuple(TRUE_WEIGHTS), atol=1)


def test_a_larger_ridge_gives_smaller_weights():
    outcomes = sample_outcomes(200, np.random.default_rng(1))
    small, large = fit_weights(outcomes, ridge=1e-3), fit_weights(outcomes, ridge=1)
    assert np.linalg.norm(astuple(large)) < np.linalg.norm(astuple(small))


def test_pairs_without_a_correct_hypothesis_do_not_change_the_weights():
    rng = np.random.default_rng(1)
    outcomes = sample_outcomes(200, rng)
    shape = (6, len(TERM_NAMES))
    wrong = [Outcome("x", rng.normal(size=shape), np.full(6, 90.0), 90 * (1 - np.eye(6))) for _ in range(50)]
    np.testing.assert_allclose(astuple(fit_weights(outcomes + wrong)), astuple(fit_weights(outcomes)), atol=1e-4)
    with pytest.raises(InputError, match="50 pairs, none with a correct hypothesis"):
        fit_weights(wrong)


def sample_ranked(n: int, true: Calibration, rng: np.random.Generator) -> list[Outcome]:
    """Pairs of three different poses, scored by the first two terms, of which one or none is right as `true` says."""
    outcomes = []
    for index in range(n):
        n_views, view_std, terms = int(rng.integers(1, 11)), float(rng.uniform(0, 0.2)), np.zeros((3, len(TERM_NAMES)))
        terms[:, 0] = np.sort(rng.uniform(0, 6, 3))[::-1]
        terms[:, 1] = rng.uniform(-2, 2)  # the shape term, equal for all poses
        p = true.probabilities(terms[0, 0] - terms[:, 0], n_views, view_std, terms[0, 1])
        errors = np.full(4, 120.0)
        errors[rng.choice(4, p=[*p, 1 - p.sum()])] = 5
        outcomes.append(Outcome(f"category {index % 4}", terms, errors[:3], 90 * (1 - np.eye(3)), view_std, n_views))
    return outcomes


FIRST_TERMS = ScoreWeights(*[1.0, 1.0, *[0.0] * (len(TERM_NAMES) - 2)])
TRUE_CALIBRATION = Calibration(-0.4, 0.2, 0.5, -0.4, -6.0, -0.6)


def test_the_coefficients_of_the_calibration_are_recovered():
    outcomes = sample_ranked(6000, TRUE_CALIBRATION, np.random.default_rng(0))
    found = fit_calibration(outcomes, FIRST_TERMS, ridge=0)
    assert astuple(found)[:4] == pytest.approx(astuple(TRUE_CALIBRATION)[:4], abs=0.2)
    assert found.none_std == pytest.approx(TRUE_CALIBRATION.none_std, abs=1.5)
    assert found.none_shape == pytest.approx(TRUE_CALIBRATION.none_shape, abs=0.1)
    right = [one for one in outcomes if one.errors.min() < 30]
    with pytest.raises(InputError, match="all have a right pose or none has"):
        fit_calibration(right, FIRST_TERMS)


def test_every_category_counts_the_same_in_the_calibration():
    outcomes = sample_ranked(400, TRUE_CALIBRATION, np.random.default_rng(1))
    more = outcomes + 3 * [one for one in outcomes if one.category == "category 0"]
    once, again = (fit_calibration(some, FIRST_TERMS, ridge=0) for some in (outcomes, more))
    assert astuple(again) == pytest.approx(astuple(once), rel=0.01, abs=0.01)


def test_calibrated_probabilities_are_frequencies_on_new_pairs():
    fitted = fit_calibration(sample_ranked(1500, TRUE_CALIBRATION, np.random.default_rng(2)), FIRST_TERMS)
    new = sample_ranked(1500, TRUE_CALIBRATION, np.random.default_rng(3))
    ranked = [one.ranked(FIRST_TERMS) for one in new]
    found = [fitted.probabilities(deficit, *one.circumstances(FIRST_TERMS)) for one, (deficit, _) in zip(new, ranked)]
    for k in range(3):
        confidence, right = np.array([p[k] for p in found]), np.array([error[k] < 30 for _, error in ranked])
        assert reliability(confidence, right, 5).calibration_error < 0.05


def test_no_fit_sees_the_category_it_is_evaluated_on():
    outcomes = sample_outcomes(12, np.random.default_rng(4))
    seen = leave_out(outcomes, lambda some: {one.category for one in some})
    assert all(one.category not in others and len(others) == 3 for one, others in zip(outcomes, seen))


class CountingBackbone(CoordinateBackbone):
    """Remembers the images whose features it has computed."""

    seen: list[bytes] = []

    def features(self, image: np.ndarray) -> FeatureMap:
        self.seen.append(image.tobytes())
        return super().features(image)


@pytest.mark.slow
def test_outcomes_hold_the_solvers_hypotheses(ellipsoids, caplog):
    backbone = CountingBackbone()
    backbone.seen.clear()
    with caplog.at_level(logging.INFO):
        outcomes = collect_outcomes(str(ellipsoids.root), 2, backbone, VerifiedSolver(), (3, 2))
    correct = sum(one.errors[0] < 30 for one in outcomes[:2])
    assert [one.n_views for one in outcomes] == [3, 3, 2, 2]
    assert len(backbone.seen) == len(set(backbone.seen))  # features of an image are extracted once
    assert f"ellipsoid: 2 pairs of 3 views, Acc30 {50 * correct} %" in caplog.messages
    assert min(one.errors[0] for one in outcomes[:2]) < 5
    nothing, (again, _) = (
        collect_outcomes(ellipsoids.root, 2, backbone, VerifiedSolver(), (3,), categories=[name])
        for name in ("ellipsoid", f"{ellipsoids.root.name}/ellipsoid")
    )
    assert nothing == []
    np.testing.assert_array_equal(again.errors, outcomes[0].errors)
    for one in outcomes:
        m = len(one.errors)
        assert one.terms.shape == (m, len(TERM_NAMES)) and one.angles.shape == (m, m)
        assert one.ranked(ScoreWeights())[1][0] == one.errors[0]  # the solver ranks by the default weights
        np.testing.assert_allclose(np.diag(one.angles), 0, atol=1e-3)
        assert one.angles[~np.eye(m, dtype=bool)].min() > 14.9


def test_the_reports_have_all_fits():
    text = "\n".join(report_weights(sample_outcomes(60, np.random.default_rng(5))))
    assert "60 pairs of 4 categories" in text and "held-out category" in text and "best 2 different poses" in text
    assert all(name in text for name in TERM_NAMES)
    text = "\n".join(report_calibration(sample_ranked(200, TRUE_CALIBRATION, np.random.default_rng(5)), FIRST_TERMS))
    assert "AUROC" in text and "10 views:" in text and "probabilities of the other poses" in text


def test_categories_of_another_side_are_refused(tmp_path, capsys):
    for name in ("camera", "drill"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "frame_annotations.jgz").write_bytes(b"")
    with pytest.raises(InputError, match="category drill is for validation, expected training"):
        check_sides([tmp_path], "training")
    with pytest.raises(InputError, match="category camera is for training, expected validation"):
        check_sides([tmp_path], "validation")
    assert tuning.main(["weights", f"{tmp_path}:2"]) == 2
    assert "category drill is for validation" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        tuning.main(["weights", str(tmp_path)])
    assert f"{tmp_path}: expected FOLDER:PAIRS" in capsys.readouterr().err


def test_the_weight_of_a_term_beside_the_score_is_recovered():
    outcomes = sample_outcomes(1200, np.random.default_rng(6))
    base = replace(TRUE_WEIGHTS, orientation=0.0)
    for one in outcomes:
        one.terms[:, -1] = 0  # no agreement
    found = fit_beside(outcomes, orientation_column, base, ridge=0)
    assert found == pytest.approx([TRUE_WEIGHTS.orientation], abs=0.3)
    half = fit_beside(outcomes, orientation_column, ScoreWeights(*np.array(astuple(base)) / 2), ridge=0)
    assert half == pytest.approx(found / 2, rel=1e-3)  # in nats of the score

    def fit(some):
        return fit_beside(some, orientation_column, base, ridge=0)

    text = "\n".join(report_beside(outcomes, orientation_column, base, found, fit))
    assert "1200 pairs of 4 categories" in text and f"weight {found[0]:.2f}" in text


def test_a_head_is_used_on_categories_it_was_trained_without(tmp_path, capsys):
    backbone = load_backbone("zsp-tiny-photo")
    weights = {name: torch.zeros_like(value) for name, value in backbone.position_head.state_dict().items()}
    save_file(weights, tmp_path / "part.safetensors", {"without": "data/desk data/shoe"})
    assert unseen_categories([tmp_path / "part.safetensors"]) == [["data/desk", "data/shoe"]]
    use_head(backbone, tmp_path / "part.safetensors")
    assert not any(value.any() for value in backbone.position_head.state_dict().values())
    save_file(weights, tmp_path / "all.safetensors", {"without": ""})
    with pytest.raises(InputError, match="all.safetensors: trained on all categories, expected"):
        unseen_categories([tmp_path / "all.safetensors"])
    with pytest.raises(InputError, match="part.safetensors: trained without data/desk, as an earlier head"):
        unseen_categories([tmp_path / "part.safetensors"] * 2)
    with pytest.raises(InputError, match="zsp-tiny has no position head"):
        use_head(load_backbone("zsp-tiny"), tmp_path / "part.safetensors")
    assert tuning.main(["orientation", f"{tmp_path}:2"]) == 2
    assert "--head FILE is required for `orientation`" in capsys.readouterr().err


def test_every_head_is_used_on_its_own_categories(tmp_path, monkeypatch, capsys):
    state = load_backbone("zsp-tiny-photo").position_head.state_dict()
    heads = [tmp_path / "first.safetensors", tmp_path / "second.safetensors"]
    for value, (file, left_out) in enumerate(zip(heads, ("data/desk data/tv", "data/shoe"))):
        save_file({name: torch.full_like(one, value) for name, one in state.items()}, file, {"without": left_out})
    used = []

    def collect(root, pairs, backbone, solver, views, categories):
        used.append((next(backbone.position_head.parameters()).mean().item(), categories))
        return sample_outcomes(300, np.random.default_rng(len(used)))

    monkeypatch.setattr(tuning, "collect_outcomes", collect)
    monkeypatch.setattr(tuning, "check_sides", lambda folders, side: None)
    assert tuning.main(["orientation", f"{tmp_path}:2", "--head", *map(str, heads)]) == 0
    assert used == [(0, ["data/desk", "data/tv"]), (1, ["data/shoe"])]
    assert "600 pairs of 4 categories" in capsys.readouterr().out
