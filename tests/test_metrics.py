"""Pose errors against analytic angles, and the statistics against values worked out by hand."""

from itertools import product

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation

from zsp_lite.benchmark.statistics import interval_of, multiplicities, object_draws
from zsp_lite.benchmark.summary import figures_of, paired_difference, summarise
from zsp_lite.metrics import accuracy, median, rotation_error


def about(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """A rotation about an axis."""
    unit = np.array(axis) / np.linalg.norm(axis)
    return Rotation.from_rotvec(degrees * unit, degrees=True).as_matrix()


axes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1)


@given(axes, axes, st.floats(0, 180))
def test_the_error_is_the_angle_between_the_rotations(axis, other, degrees):
    base = about(other, 77)
    assert_allclose(rotation_error(base, about(axis, degrees) @ base), degrees, atol=1e-11)
    assert_allclose(rotation_error(base @ about(axis, degrees), base), degrees, atol=1e-11)


def test_tiny_angles_and_angles_next_to_180_keep_their_digits():
    axis = (0, 0, 1)
    tiny = np.degrees(1e-9)
    assert_allclose(rotation_error(np.eye(3), about(axis, tiny)), tiny, rtol=1e-9)
    # An arccos of the trace would say 180 exactly.
    assert_allclose(180 - rotation_error(np.eye(3), about((1, 2, 3), 180 - 1e-7)), 1e-7, rtol=1e-5)
    assert rotation_error(np.eye(3), np.eye(3)) == 0
    assert rotation_error(np.eye(3), np.diag([1.0, -1, -1])) == 180


def test_batches_broadcast_and_tensors_are_taken():
    batch = np.stack([about((1, 0, 0), d) for d in (0, 10, 90)])
    assert_allclose(rotation_error(torch.as_tensor(batch), torch.eye(3)), [0, 10, 90], atol=1e-6)


@pytest.mark.parametrize("bad", [np.eye(4), np.zeros(3), np.full((3, 3), np.nan)])
def test_what_is_no_rotation_is_refused(bad):
    refused("second (has shape|holds nan)", rotation_error, np.eye(3), bad)


def test_accuracy_counts_errors_strictly_below_the_threshold():
    assert accuracy([10, 29.9, 30, 170], 30) == 50
    assert_allclose(accuracy([[1, 40], [1, 2]], 30), [50, 100])
    assert median([1, 2, 100]) == 2


def test_weights_count_errors_several_times():
    rng = default_rng(0)
    for n in (1, 2, 7, 8):
        errors = rng.uniform(0, 60, n)
        weights = rng.integers(0, 4, n)
        weights[0] += 1  # not all are 0
        repeated = np.repeat(errors, weights)
        assert median(errors, weights) == np.median(repeated)
        assert accuracy(errors, 30, weights) == pytest.approx(100 * np.mean(repeated < 30))
    assert_array_equal(median([3.0, 1.0], [[1, 1], [0, 5]]), [2, 1])


def test_the_interval_of_an_accuracy_matches_the_binomial():
    # 40 of 100 solved: the normal approximation gives 40 +- 1.96 * sqrt(.4 * .6 / 100) = 40 +- 9.6.
    errors = np.r_[np.zeros(40), np.full(60, 90.0)]
    drawn = multiplicities(100, default_rng(0))
    assert_allclose(interval_of(accuracy(errors, 30, drawn)), (30.4, 49.6), atol=1.5)


def test_equal_errors_have_no_spread():
    summary = figures_of([20.0] * 5, np.ones((3, 5)))
    assert summary["n"] == 5
    for name, value in {"median": 20, "acc30": 100, "acc15": 0, "above150": 0}.items():
        assert summary[name] == value
        assert summary[f"{name}_ci"] == [value, value]


def test_errors_at_a_threshold_count_on_neither_side_of_it():
    # At thresholds below 15 one of four is right, up to 30 two: (25 + 50) / 2. An error of 30
    # counts nowhere.
    assert figures_of([0.0, 15.0, 30.0, 60.0], np.ones((3, 4)))["auc30"] == pytest.approx(37.5)
    # Two of five are above 150.
    assert figures_of([10.0, 149.0, 150.0, 151.0, 180.0], np.ones((3, 5)))[
        "above150"
    ] == pytest.approx(40)


PAIRS = [("a", "b"), ("b", "c"), ("c", "d"), ("d", "a"), ("a", "c"), ("b", "d")]


def expected_weights(counts) -> np.ndarray:
    """The weights of PAIRS, up to a common factor, where a, b, c and d are drawn so often."""
    drawn = dict(zip("abcd", counts))
    return np.array([drawn[one] * drawn[other] for one, other in PAIRS])


def test_a_pairs_weight_is_the_product_of_how_often_its_two_objects_are_drawn():
    weights = object_draws(PAIRS)[:500]  # some of the draws, for speed
    assert_allclose(weights.sum(axis=1), len(PAIRS))
    # Four objects are drawn, with repetition.
    counts = [one for one in product(range(5), repeat=4) if sum(one) == 4]
    possible = [expected for expected in map(expected_weights, counts) if expected.any()]
    for row in weights:
        assert any(np.allclose(row * one.sum(), one * row.sum()) for one in possible)


def test_neither_the_order_of_pairs_nor_other_categories_change_a_draw():
    weights = object_draws(PAIRS, ["x"] * 6)
    assert_array_equal(object_draws(PAIRS[::-1], ["x"] * 6)[:, ::-1], weights)
    both = object_draws(PAIRS * 2, ["w"] * 6 + ["x"] * 6)
    assert_array_equal(both[:, 6:], weights)
    assert (both[:, :6] != weights).any()
    assert_allclose(both[:, :6].sum(axis=1), 6)
    # Pairs of two objects are resampled one by one.
    assert_array_equal(np.unique(object_draws([("a", "b"), ("b", "a")])), [0, 1, 2])


def test_the_mean_of_category_medians_is_over_categories():
    table = pd.DataFrame(PAIRS * 2, columns=["reference", "target"]).assign(
        category=np.repeat(["x", "y"], 6),
        error=np.r_[np.full(6, 10.0), np.linspace(20, 40, 6)],
        row="ours",
        problem=range(12),
        pair=range(12),
        **dict.fromkeys(["repeat", "seconds", "translation", "scale"], 0),
        failed="",
        symmetric_error=None,
    )
    # The median of x is 10 without spread; that of y is 30, and from 20 to 40 in every draw.
    found = summarise(table)["methods"]["ours"]
    assert found["mean_category_median"] == 20
    low, high = found["mean_category_median_ci"]
    assert 15 <= low < 20 < high <= 25


def test_a_gain_is_that_of_the_pairs_that_only_one_method_solves():
    # 6 pairs only the second solves, 1 only the first.
    first = np.r_[[90.0] * 6, 10.0, [5.0] * 3]
    second = np.r_[[10.0] * 6, 90.0, [5.0] * 3]
    result = paired_difference(first, second, 1.0 * multiplicities(10, np.random.default_rng(0)))
    assert result["accuracy_gain"] == pytest.approx(50)
    low, high = result["accuracy_gain_ci"]
    assert 0 < low < 50 < high < 100
    # Of ten pairs drawn from these, with probability 0.023 no more gain than lose; twice that.
    assert result["accuracy_gain_p"] == pytest.approx(0.046, abs=0.015)


def test_a_method_does_not_differ_from_itself():
    same = paired_difference(np.arange(60), np.arange(60), np.ones((9, 60)))
    assert same == {"accuracy_gain": 0, "accuracy_gain_ci": [0, 0], "accuracy_gain_p": 1}
