"""tools/tuning.py: the fits recover known parameters, are evaluated on held-out categories, and
refuse other splits."""

from dataclasses import astuple, replace

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from refusals import refused

from tools import tuning
from tools.tuning import Outcome, check_sides, fit_calibration, fit_weights, leave_out
from zsp_lite.verified.confidence import Calibration
from zsp_lite.verified.verification import TERM_NAMES, ScoreCoefficients

# Setting, span, number of views, angles to the nearest view and deviation of the view similarities.
# The fit of the weights uses none of them.
ALL_AROUND_TARGET = ("5 views all around", 288.0, 5, np.zeros(6), 0.1)
TRUE_WEIGHTS = ScoreCoefficients(6, 0, -4, -2, 0, 3, 0, -1, 2)
# Errors of poses in degrees: a pose is right below 30.
RIGHT, WRONG = 5.0, 120.0


def sample_outcomes(n: int, rng: np.random.Generator) -> list[Outcome]:
    """Draw pairs of four categories with six hypotheses, one of them right with a probability
    proportional to exp(score) under TRUE_WEIGHTS."""
    outcomes = []
    for index in range(n):
        terms = rng.normal(size=(6, len(TERM_NAMES)))
        score = terms @ np.array(astuple(TRUE_WEIGHTS))
        probability = np.exp(score - score.max())
        errors = np.full(6, WRONG)
        errors[rng.choice(6, p=probability / probability.sum())] = RIGHT
        apart = 90 * (1 - np.eye(6))  # all hypotheses differ by 90 degrees
        outcomes.append(Outcome(f"category {index % 4}", terms, errors, apart, *ALL_AROUND_TARGET))
    return outcomes


def test_the_weights_of_the_sampling_distribution_are_recovered(monkeypatch):
    monkeypatch.setattr("tools.tuning._WEIGHT_RIDGE", 0)
    # The error of the fit falls with the number of pairs: of 1200 it is below 1.
    fitted = fit_weights(sample_outcomes(1200, default_rng(0)))
    assert_allclose(astuple(fitted), astuple(TRUE_WEIGHTS), atol=1)


def sample_ranked(n: int, true: Calibration, rng: np.random.Generator) -> list[Outcome]:
    """Draw pairs of four categories with three different poses, scored by FIRST_TERMS; one or none
    is right, with the probabilities of `true`."""
    outcomes = []
    for index in range(n):
        terms = np.zeros((3, len(TERM_NAMES)))
        terms[:, 0] = np.sort(rng.uniform(0, 6, 3))[::-1]
        terms[:, 1] = rng.uniform(-2, 2)  # the shape term, equal for all poses
        views = int(rng.integers(1, 11))
        # Span, number of views, angles to the nearest view, deviation of the view similarities.
        evidence = rng.uniform(0, 360), views, rng.uniform(0, 90, 3), rng.uniform(0, 0.2)
        apart = 90 * (1 - np.eye(3))
        outcome = Outcome(
            f"category {index % 4}", terms, np.zeros(3), apart, f"{views} views", *evidence
        )
        p = true.probabilities(terms[0, 0] - terms[:, 0], outcome.evidence(FIRST_TERMS))
        errors = np.full(4, WRONG)
        # The fourth case: none of the three is right.
        errors[rng.choice(4, p=[*p, 1 - p.sum()])] = RIGHT
        outcomes.append(replace(outcome, errors=errors[:3]))
    return outcomes


FIRST_TERMS = ScoreCoefficients(*[1.0, 1.0, *[0.0] * (len(TERM_NAMES) - 2)])
TRUE_CALIBRATION = Calibration(
    (-0.4, 0.4, 0.2, 0.3, -1.0, 0.1), (0.5, -1.0, -0.4, -0.8, -6.0, -0.6), 0.2
)


def test_the_coefficients_of_the_calibration_are_recovered(monkeypatch):
    monkeypatch.setattr("tools.tuning._CALIBRATION_RIDGE", 0)
    fitted = fit_calibration(sample_ranked(6000, TRUE_CALIBRATION, default_rng(0)), FIRST_TERMS)
    # The fifth coefficient is that of the deviation of the view similarities, at most 0.2: it is
    # large, and known less precisely.
    atol = np.array([0.6, 0.6, 0.6, 0.6, 2.0, 0.6])
    assert (np.abs(np.subtract(fitted.scale, TRUE_CALIBRATION.scale)) < atol).all()
    assert (np.abs(np.subtract(fitted.none, TRUE_CALIBRATION.none)) < atol).all()
    assert_allclose(fitted.unseen, TRUE_CALIBRATION.unseen, atol=0.1)


def test_pairs_that_all_have_a_right_pose_are_refused():
    outcomes = sample_outcomes(12, default_rng(0))
    refused("all have a right pose or none has", fit_calibration, outcomes, FIRST_TERMS)


def test_no_fit_sees_the_category_it_is_evaluated_on():
    outcomes = sample_outcomes(12, default_rng(4))
    categories_of_fits = leave_out(outcomes, lambda others: {pair.category for pair in others})
    for pair, categories in zip(outcomes, categories_of_fits, strict=True):
        assert categories == {f"category {k}" for k in range(4)} - {pair.category}


def test_categories_of_another_side_are_refused(tmp_path, capsys):
    for name in ("camera", "drill"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "frame_annotations.jgz").write_bytes(b"")
    message = "category drill is for validation, expected training"
    refused(message, check_sides, [tmp_path], "training")
    message = "category camera is for training, expected validation"
    refused(message, check_sides, [tmp_path], "validation")
    assert tuning.main(["weights", f"{tmp_path}:2"]) == 2
    assert "category drill is for validation" in capsys.readouterr().err
