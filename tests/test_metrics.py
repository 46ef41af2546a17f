"""Pose errors against analytic angles, and the statistics against values worked out by hand."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from zsp_lite.errors import InputError
from zsp_lite.metrics import (
    accuracy,
    bootstrap_ci,
    median,
    paired_test,
    rotation_error,
    summarise,
    translation_error,
)


def about(axis, degrees: float) -> np.ndarray:
    """Rodrigues' formula; 1 - cos is taken as 2 sin^2(half) so that small angles keep all their digits."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + 2 * np.sin(angle / 2) ** 2 * cross @ cross


axes = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1)


@settings(deadline=None)
@given(axes, axes, st.floats(0, 180))
def test_the_error_is_the_angle_between_the_rotations(axis, other, degrees):
    base = about(other, 77)
    assert rotation_error(base, about(axis, degrees) @ base) == pytest.approx(degrees, abs=1e-11)
    assert rotation_error(base, base @ about(axis, degrees)) == pytest.approx(degrees, abs=1e-11)


def test_tiny_angles_and_angles_next_to_180_keep_their_digits():
    axis = (0, 0, 1)
    tiny = np.degrees(1e-9)
    assert rotation_error(np.eye(3), about(axis, tiny)) == pytest.approx(tiny, rel=1e-9)
    # cos(pi - e) rounds to -1 for e = 1e-9, and an arccos of the trace would say 180 exactly.
    nearly = np.array([[-1, -1e-9, 0], [1e-9, -1, 0], [0, 0, 1]])
    assert 180 - rotation_error(np.eye(3), nearly) == pytest.approx(np.degrees(1e-9), rel=1e-5)
    assert 180 - rotation_error(np.eye(3), about((1, 2, 3), 180 - 1e-7)) == pytest.approx(1e-7, rel=1e-5)
    assert rotation_error(np.eye(3), np.eye(3)) == 0
    assert rotation_error(np.eye(3), np.diag([1.0, -1, -1])) == 180


@settings(deadline=None)
@given(axes, axes, st.floats(0, 180))
def test_the_error_is_symmetric_and_unchanged_by_a_common_rotation(axis, other, degrees):
    a, b, common = np.eye(3), about(axis, degrees), about(other, 123)
    assert rotation_error(a, b) == pytest.approx(rotation_error(b, a), abs=1e-11)
    assert rotation_error(common @ a, common @ b) == pytest.approx(rotation_error(a, b), abs=1e-11)


def test_batches_broadcast_and_tensors_are_taken():
    batch = np.stack([about((1, 0, 0), d) for d in (0, 10, 90)])
    np.testing.assert_allclose(rotation_error(np.eye(3), batch), [0, 10, 90], atol=1e-12)
    np.testing.assert_allclose(rotation_error(torch.as_tensor(batch), torch.eye(3)), [0, 10, 90], atol=1e-6)
    assert rotation_error(batch[:, None], batch[None]).shape == (3, 3)
    assert translation_error([[0, 0, 0], [1, 0, 0]], [3, 0, 4]) == pytest.approx([5, np.sqrt(20)])


@pytest.mark.parametrize("bad", [np.eye(4), np.zeros(3), np.full((3, 3), np.nan)])
def test_what_is_no_rotation_is_refused(bad):
    with pytest.raises(InputError):
        rotation_error(np.eye(3), bad)


def test_a_translation_of_another_shape_is_refused():
    with pytest.raises(InputError):
        translation_error([0, 0], [0, 0])


def test_accuracy_counts_errors_strictly_below_the_threshold():
    assert accuracy([10, 29.9, 30, 170], 30) == 50
    np.testing.assert_allclose(accuracy([[1, 40], [1, 2]], 30), [50, 100])
    assert median([1, 2, 100]) == 2


def test_the_interval_of_an_accuracy_matches_the_binomial():
    # 40 of 100 solved: the normal approximation gives 40 +- 1.96 * sqrt(.4 * .6 / 100) = 40 +- 9.6.
    errors = np.r_[np.zeros(40), np.full(60, 90.0)]
    low, high = bootstrap_ci(errors, lambda e: accuracy(e, 30), seed=1)
    assert low == pytest.approx(30.4, abs=1.5) and high == pytest.approx(49.6, abs=1.5)
    assert bootstrap_ci(errors, median, seed=1) == bootstrap_ci(errors, median, seed=1)


def test_equal_errors_have_no_spread():
    summary = summarise([20.0] * 5)
    assert summary == {
        "n": 5, "median": 20, "acc30": 100, "acc15": 0,
        "median_ci": [20, 20], "acc30_ci": [100, 100], "acc15_ci": [0, 0], "above150": 0,
    }  # fmt: skip


@pytest.mark.parametrize("errors", [[], 3.0, [1.0, np.nan]])
def test_nothing_or_nan_is_not_summarised(errors):
    with pytest.raises(InputError):
        summarise(errors)


def test_half_turns_are_counted():
    assert summarise([10.0, 149.0, 150.0, 151.0, 180.0])["above150"] == pytest.approx(40)


def test_the_sign_test_counts_the_pairs_that_only_one_method_solves():
    # 6 pairs only the second solves, 1 only the first: p = 2 * (C(7,0) + C(7,1)) / 2^7 = 0.125.
    first, second = np.r_[[90.0] * 6, 10.0, [5.0] * 3], np.r_[[10.0] * 6, 90.0, [5.0] * 3]
    result = paired_test(first, second)
    assert result["accuracy_gain"] == pytest.approx(50)
    assert result["accuracy_p"] == pytest.approx(0.125)
    assert result["error_drop"] == pytest.approx(40)
    # Sums of +-80 over 7 signs at least as far as 5 * 80: |plus - minus| >= 5, that is 2 * (1 + 7) of 128.
    assert result["error_p"] == pytest.approx(16 / 128, abs=0.015)


def test_a_method_does_not_differ_from_itself():
    errors = np.linspace(0, 180, 30)
    result = paired_test(errors, errors)
    assert result["accuracy_p"] == 1 and result["error_p"] == 1 and result["error_drop"] == 0
    with pytest.raises(InputError):
        paired_test(errors, errors[:-1])
