"""The fits recover what outcomes were drawn from, leave out what they are judged on, and refuse evaluation data."""

from dataclasses import astuple

import numpy as np
import pytest
from synthetic_views import CoordinateBackbone

from zsp_lite.benchmark import tuning
from zsp_lite.benchmark.tuning import (
    Outcome,
    calibrate,
    check_training,
    collect,
    equally_good_shares,
    fit_weights,
    leave_one_out,
    report,
)
from zsp_lite.errors import InputError
from zsp_lite.verified.confidence import reliability
from zsp_lite.verified.verification import TERMS, Weights

TRUE = Weights(6, 0, -4, -2, 0, 3, 0, -1, 0)


def drawn(n: int, rng: np.random.Generator, m: int = 6) -> list[Outcome]:
    """Pairs of which one hypothesis is right, with a chance in proportion to e^score under TRUE."""
    found = []
    for index in range(n):
        terms = rng.normal(size=(m, len(TERMS)))
        score = terms @ np.array(astuple(TRUE))
        chance = np.exp(score - score.max())
        right = rng.choice(m, p=chance / chance.sum())
        errors = np.full(m, 120.0)
        errors[right] = 0
        found.append(Outcome(f"category {index % 4}", terms, errors, 90 * (1 - np.eye(m))))
    return found


def test_the_weights_that_outcomes_were_drawn_with_are_found_again():
    fitted = fit_weights(drawn(1200, np.random.default_rng(0)), ridge=0)
    np.testing.assert_allclose(astuple(fitted), astuple(TRUE), atol=1)


def test_a_ridge_shrinks_and_pairs_without_a_right_hypothesis_teach_nothing():
    rng = np.random.default_rng(1)
    some = drawn(200, rng)
    hopeless = [
        Outcome("x", rng.normal(size=(6, len(TERMS))), np.full(6, 90.0), 90 * (1 - np.eye(6))) for _ in range(50)
    ]
    free, held = fit_weights(some, ridge=1e-3), fit_weights(some, ridge=1)
    assert np.linalg.norm(astuple(held)) < np.linalg.norm(astuple(free))
    np.testing.assert_allclose(astuple(fit_weights(some + hopeless)), astuple(fit_weights(some)), rtol=0.1, atol=0.1)
    with pytest.raises(InputError, match="50 pairs, none with a right hypothesis"):
        fit_weights(hopeless)


def test_the_calibration_says_how_often_the_preferred_one_is_right():
    outcomes = drawn(700, np.random.default_rng(2))
    calibration = calibrate(outcomes, TRUE)
    score, margin, error = np.array([one.best(TRUE) for one in drawn(700, np.random.default_rng(3))]).T
    trust = calibration.confidence(margin, np.zeros(700))
    assert reliability(trust, error < 30, 5).calibration_error < 0.08
    assert trust.mean() == pytest.approx((error < 30).mean(), abs=0.05)


def test_nothing_is_fitted_to_the_category_it_is_judged_on():
    outcomes = drawn(12, np.random.default_rng(4))
    seen = leave_one_out(outcomes, lambda some: {one.category for one in some})
    assert all(one.category not in others and len(others) == 3 for one, others in zip(outcomes, seen))


def test_rivals_within_a_bound_are_counted():
    def pair(margin, error):
        terms = np.zeros((2, len(TERMS)))
        terms[0, 0] = margin
        return Outcome("x", terms, np.array([error, 100.0]), np.array([[0.0, 90], [90, 0]]))

    plain = Weights(1, 0, 0, 0, 0, 0, 0, 0, 0)
    shares = equally_good_shares([pair(0.2, 5.0), pair(0.8, 170.0), pair(3.0, 5.0)], plain, (0.5, 1.0))
    assert shares == [(0.5, 1, 1.0), (1.0, 2, 0.5)]


def test_outcomes_of_a_folder_hold_the_solvers_hypotheses(ellipsoids):
    said = []
    outcomes = collect(str(ellipsoids.root), 2, CoordinateBackbone(), n_targets=3, said=said.append)
    right = sum(one.errors[0] < 30 for one in outcomes)
    assert len(outcomes) == 2 and said == [f"ellipsoid: 2 pairs, {50 * right} % within 30 degrees"]
    assert min(one.errors[0] for one in outcomes) < 5
    for one in outcomes:
        assert one.terms.shape == (len(one.errors), len(TERMS)) and one.apart.shape == (len(one.errors),) * 2
        assert one.best(Weights())[2] == one.errors[0]  # ranked by the present weights
        np.testing.assert_allclose(np.diag(one.apart), 0, atol=1e-3)
        assert one.apart[~np.eye(len(one.errors), dtype=bool)].min() > 14.9


def test_the_report_says_what_was_learnt():
    text = "\n".join(report(drawn(60, np.random.default_rng(5))))
    assert "60 pairs of 4 categories" in text and "AUROC" in text
    assert all(name in text for name in TERMS) and "left-out category" in text


def test_validation_and_evaluation_categories_are_refused_by_name(tmp_path, capsys):
    check_training(["camera", "ellipsoid"])
    with pytest.raises(InputError, match="category drill is for validation"):
        check_training(["camera", "drill"])
    with pytest.raises(InputError, match="category toyplane is for evaluation"):
        check_training(["camera", "toyplane"])
    folder = tmp_path / "toyplane"
    folder.mkdir()
    (folder / "frame_annotations.jgz").write_bytes(b"")
    with pytest.raises(InputError, match="category toyplane is for evaluation"):
        collect(str(tmp_path), 2, None)
    with pytest.raises(SystemExit) as stopped:
        tuning.main([str(tmp_path), "--pairs", "2"])
    assert stopped.value.code == 2 and "category toyplane is for evaluation" in capsys.readouterr().err
