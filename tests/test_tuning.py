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

# Setting, span, number of views, angles to the nearest view and deviation of the view similarities,
# of no importance to the weights of the score.
ALL_AROUND_TARGET = ("5 views all around", 288.0, 5, np.zeros(6), 0.1)
TRUE_WEIGHTS = ScoreCoefficients(6, 0, -4, -2, 0, 3, 0, -1, 2)


def sample_outcomes(n: int, rng: np.random.Generator) -> list[Outcome]:
    """Pairs with one correct hypothesis each, drawn with probability proportional to exp(score)
    under TRUE_WEIGHTS."""
    outcomes = []
    for index in range(n):
        terms = rng.normal(size=(6, len(TERM_NAMES)))
        score = terms @ np.array(astuple(TRUE_WEIGHTS))
        probability = np.exp(score - score.max())
        errors = np.full(6, 120.0)
        errors[rng.choice(6, p=probability / probability.sum())] = 0
        outcomes.append(
            Outcome(
                f"category {index % 4}", terms, errors, 90 * (1 - np.eye(6)), *ALL_AROUND_TARGET
            )
        )
    return outcomes


def test_the_weights_of_the_sampling_distribution_are_recovered():
    fitted = fit_weights(sample_outcomes(1200, default_rng(0)), ridge=0)
    assert_allclose(astuple(fitted), astuple(TRUE_WEIGHTS), atol=1)


def sample_ranked(n: int, true: Calibration, rng: np.random.Generator) -> list[Outcome]:
    """Pairs of three different poses, scored by the first two terms, of which one or none is right
    as `true` says."""
    outcomes = []
    for index in range(n):
        terms = np.zeros((3, len(TERM_NAMES)))
        terms[:, 0] = np.sort(rng.uniform(0, 6, 3))[::-1]
        terms[:, 1] = rng.uniform(-2, 2)  # the shape term, equal for all poses
        views = int(rng.integers(1, 11))
        seen = rng.uniform(0, 360), views, rng.uniform(0, 90, 3), rng.uniform(0, 0.2)
        one = Outcome(
            f"category {index % 4}",
            terms,
            np.zeros(3),
            90 * (1 - np.eye(3)),
            f"{views} views",
            *seen,
        )
        p = true.probabilities(terms[0, 0] - terms[:, 0], one.evidence(FIRST_TERMS))
        errors = np.full(4, 120.0)
        errors[rng.choice(4, p=[*p, 1 - p.sum()])] = 5
        outcomes.append(replace(one, errors=errors[:3]))
    return outcomes


FIRST_TERMS = ScoreCoefficients(*[1.0, 1.0, *[0.0] * (len(TERM_NAMES) - 2)])
TRUE_CALIBRATION = Calibration(
    (-0.4, 0.4, 0.2, 0.3, -1.0, 0.1), (0.5, -1.0, -0.4, -0.8, -6.0, -0.6), 0.2
)


def test_the_coefficients_of_the_calibration_are_recovered():
    outcomes = sample_ranked(6000, TRUE_CALIBRATION, default_rng(0))
    found = fit_calibration(outcomes, FIRST_TERMS, ridge=0)
    for name in ("scale", "none"):
        true, measured = (np.delete(getattr(one, name), 4) for one in (TRUE_CALIBRATION, found))
        assert_allclose(measured, true, atol=0.6)
        # of view_std
        assert_allclose(getattr(found, name)[4], getattr(TRUE_CALIBRATION, name)[4], atol=2)
    assert_allclose(found.unseen, 0.2, atol=0.1)
    right = [one for one in outcomes if one.errors.min() < 30]
    refused("all have a right pose or none has", fit_calibration, right, FIRST_TERMS)


def test_no_fit_sees_the_category_it_is_evaluated_on():
    outcomes = sample_outcomes(12, default_rng(4))
    seen = leave_out(outcomes, lambda some: {one.category for one in some})
    assert all(
        one.category not in others and len(others) == 3 for one, others in zip(outcomes, seen)
    )


def test_categories_of_another_side_are_refused(tmp_path, capsys):
    for name in ("camera", "drill"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "frame_annotations.jgz").write_bytes(b"")
    refused(
        "category drill is for validation, expected training", check_sides, [tmp_path], "training"
    )
    refused(
        "category camera is for training, expected validation",
        check_sides,
        [tmp_path],
        "validation",
    )
    assert tuning.main(["weights", f"{tmp_path}:2"]) == 2
    assert "category drill is for validation" in capsys.readouterr().err
