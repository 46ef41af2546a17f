"""tools/tuning.py: the fits recover known parameters, are evaluated on held-out categories, and refuse other splits."""

import logging
from dataclasses import astuple

import numpy as np
import pytest
from synthetic_views import CoordinateBackbone

from tools import tuning
from tools.tuning import (
    Outcome,
    calibrate,
    check_training_categories,
    collect_outcomes,
    fit_calibration,
    fit_weights,
    leave_one_out,
    report,
    tie_statistics,
)
from zsp_lite.errors import InputError
from zsp_lite.verified.confidence import Calibration, reliability
from zsp_lite.verified.verification import TERM_NAMES, ScoreWeights

TRUE_WEIGHTS = ScoreWeights(6, 0, -4, -2, 0, 3, 0, -1, 0)


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


def test_the_parameters_of_a_logistic_function_are_recovered():
    rng = np.random.default_rng(0)
    margin, view_std = rng.uniform(0, 6, 4000), rng.uniform(0, 2, 4000)
    true = Calibration(-1.0, 0.8, 0.6)
    correct = rng.random(4000) < true.confidence(margin, view_std)
    fitted = fit_calibration(margin, view_std, correct, ridge=1e-9)
    assert astuple(fitted) == pytest.approx(astuple(true), abs=0.2)
    with pytest.raises(InputError, match="all 4000 estimates are correct"):
        fit_calibration(margin, view_std, np.ones(4000, dtype=bool))


def test_the_logistic_regression_satisfies_its_optimality_conditions():
    """At the optimum the residuals sum to 0, and their products with each input balance the penalty."""
    rng = np.random.default_rng(7)
    margin, view_std = rng.uniform(0, 6, 300), rng.uniform(0, 0.1, 300)
    correct = rng.random(300) < 0.7
    fitted = fit_calibration(margin, view_std, correct, ridge=1e-3)
    residual = correct - fitted.confidence(margin, view_std)
    assert residual.sum() == pytest.approx(0, abs=1e-3)
    for x, coefficient in ((margin, fitted.margin), (view_std, fitted.view_std)):
        penalty = 1e-3 * 300 * coefficient * x.std()
        assert residual @ (x / x.std()) == pytest.approx(penalty, abs=1e-3)


def test_calibrated_confidences_are_frequencies_on_new_pairs():
    calibration = calibrate(sample_outcomes(700, np.random.default_rng(2)), TRUE_WEIGHTS)
    margin, error = np.array([one.best(TRUE_WEIGHTS) for one in sample_outcomes(700, np.random.default_rng(3))]).T
    confidence = calibration.confidence(margin, np.zeros(700))
    assert reliability(confidence, error < 30, 5).calibration_error < 0.08
    assert confidence.mean() == pytest.approx((error < 30).mean(), abs=0.05)


def test_no_fit_sees_the_category_it_is_evaluated_on():
    outcomes = sample_outcomes(12, np.random.default_rng(4))
    seen = leave_one_out(outcomes, lambda some: {one.category for one in some})
    assert all(one.category not in others and len(others) == 3 for one, others in zip(outcomes, seen))


def test_tie_statistics_count_pairs_with_a_rival_within_the_margin():
    def pair(margin, error):
        terms = np.zeros((2, len(TERM_NAMES)))
        terms[0, 0] = margin
        return Outcome("x", terms, np.array([error, 100.0]), np.array([[0.0, 90], [90, 0]]))

    first_term_only = ScoreWeights(1, 0, 0, 0, 0, 0, 0, 0, 0)
    rows = tie_statistics([pair(0.2, 5.0), pair(0.8, 170.0), pair(3.0, 5.0)], first_term_only, (0.5, 1.0))
    assert rows == [(0.5, 1, 1.0), (1.0, 2, 0.5)]


@pytest.mark.slow
def test_outcomes_hold_the_solvers_hypotheses(ellipsoids, caplog):
    with caplog.at_level(logging.INFO):
        outcomes = collect_outcomes(str(ellipsoids.root), 2, CoordinateBackbone(), n_targets=3)
    correct = sum(one.errors[0] < 30 for one in outcomes)
    assert len(outcomes) == 2 and f"ellipsoid: 2 pairs, Acc30 {50 * correct} %" in caplog.messages
    assert min(one.errors[0] for one in outcomes) < 5
    for one in outcomes:
        m = len(one.errors)
        assert one.terms.shape == (m, len(TERM_NAMES)) and one.angles.shape == (m, m)
        assert one.best(ScoreWeights())[1] == one.errors[0]  # the solver ranks by the default weights
        np.testing.assert_allclose(np.diag(one.angles), 0, atol=1e-3)
        assert one.angles[~np.eye(m, dtype=bool)].min() > 14.9


def test_the_report_has_all_fits():
    text = "\n".join(report(sample_outcomes(60, np.random.default_rng(5))))
    assert "60 pairs of 4 categories" in text and "AUROC" in text and "held-out category" in text
    assert all(name in text for name in TERM_NAMES)


def test_validation_and_evaluation_categories_are_refused(tmp_path, capsys):
    check_training_categories(["camera", "ellipsoid"])
    with pytest.raises(InputError, match="category drill is for validation"):
        check_training_categories(["camera", "drill"])
    folder = tmp_path / "toyplane"
    folder.mkdir()
    (folder / "frame_annotations.jgz").write_bytes(b"")
    with pytest.raises(InputError, match="category toyplane is for evaluation"):
        collect_outcomes(str(tmp_path), 2, None)
    assert tuning.main([str(tmp_path), "--pairs", "2"]) == 2
    assert "category toyplane is for evaluation" in capsys.readouterr().err
