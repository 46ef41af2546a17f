"""Errors of an estimated pose, and what to say about many of them (paper sec. 5.1, supplement "evaluation metrics")."""

from collections.abc import Callable
from math import comb

import numpy as np
from numpy.typing import ArrayLike

from zsp_lite.errors import InputError


def rotation_error(first: ArrayLike, second: ArrayLike) -> np.ndarray | float:
    """Geodesic angle between rotations, in degrees, in [0, 180].

    first, second: (..., 3, 3), broadcast against each other; numpy or torch.  Returns (...), a float for one
    pair. atan2 of the relative rotation's sine (its antisymmetric part) and cosine (its trace): unlike an
    arccos of the trace, exact near 0 and near 180.
    Raises InputError for other shapes and non-finite values.
    """
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if first.shape[-2:] != (3, 3) or second.shape[-2:] != (3, 3):
        raise InputError(f"rotation_error: shapes {first.shape} and {second.shape}, expected (..., 3, 3)")
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise InputError("rotation_error: non-finite rotation, expected finite values")
    relative = np.swapaxes(first, -1, -2) @ second
    twice_sine = np.sqrt(
        np.square(relative[..., 2, 1] - relative[..., 1, 2])
        + np.square(relative[..., 0, 2] - relative[..., 2, 0])
        + np.square(relative[..., 1, 0] - relative[..., 0, 1])
    )
    twice_cosine = np.trace(relative, axis1=-2, axis2=-1) - 1
    return np.degrees(np.arctan2(twice_sine, twice_cosine))[()]


def translation_error(first: ArrayLike, second: ArrayLike) -> np.ndarray | float:
    """Euclidean distance between translations (..., 3), in their unit.  Raises InputError for other shapes."""
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    if first.shape[-1:] != (3,) or second.shape[-1:] != (3,):
        raise InputError(f"translation_error: shapes {first.shape} and {second.shape}, expected (..., 3)")
    return np.linalg.norm(first - second, axis=-1)[()]


def accuracy(errors: ArrayLike, threshold: float) -> np.ndarray | float:
    """Percentage of errors (..., n) strictly below the threshold, over the last axis: Acc30 is threshold=30."""
    return 100 * np.mean(_errors(errors) < threshold, axis=-1)


def median(errors: ArrayLike) -> np.ndarray | float:
    """Median of the errors (..., n) over the last axis."""
    return np.median(_errors(errors), axis=-1)


def bootstrap_ci(
    errors: ArrayLike,
    statistic: Callable[[np.ndarray], np.ndarray],
    level: float = 0.95,
    resamples: int = 2000,
    seed: int | np.random.Generator = 0,
) -> tuple[float, float]:
    """Percentile bootstrap interval of a statistic of the errors (n,).

    statistic: maps (resamples, n) to (resamples,), as `median` does, or `lambda e: accuracy(e, 30)`.
    """
    errors = _errors(errors)
    draws = np.random.default_rng(seed).integers(errors.shape[-1], size=(resamples, errors.shape[-1]))
    tail = 50 * (1 - level)
    low, high = np.percentile(statistic(errors[draws]), [tail, 100 - tail])
    return float(low), float(high)


def summarise(errors: ArrayLike, seed: int | np.random.Generator = 0) -> dict:
    """The paper's figures for rotation errors (n,) in degrees, with 95 % bootstrap intervals.

    Returns {"n", "median" (degrees), "acc30", "acc15" (percent), for each of the three NAME_ci: [low, high], and
    "above150": the percentage of errors above 150 degrees, mostly front taken for back}.
    Raises InputError where there is nothing to summarise.
    """
    errors = _errors(errors)
    rng = np.random.default_rng(seed)
    figures = {"median": median, "acc30": lambda e: accuracy(e, 30), "acc15": lambda e: accuracy(e, 15)}
    summary = {"n": int(errors.size)} | {name: float(figure(errors)) for name, figure in figures.items()}
    for name, figure in figures.items():
        summary[f"{name}_ci"] = list(bootstrap_ci(errors, figure, seed=rng))
    return summary | {"above150": float(100 * np.mean(errors > 150))}


def paired_test(
    first: ArrayLike,
    second: ArrayLike,
    threshold: float = 30.0,
    resamples: int = 10_000,
    seed: int | np.random.Generator = 0,
) -> dict:
    """Is the second method better than the first on the same pairs?  Two-sided tests.

    first, second: (n,) errors of the same pairs in the same order.
    Returns {"accuracy_gain": second - first, percentage points, "accuracy_p": exact sign test over the pairs
    that only one of them solves (McNemar), "error_drop": mean of first - second, in the errors' unit,
    "error_p": its permutation test by flipping the sign of each difference}.
    Raises InputError where the two differ in length.
    """
    first, second = _errors(first), _errors(second)
    if first.shape != second.shape or first.ndim != 1:
        raise InputError(f"paired_test: shapes {first.shape} and {second.shape}, expected equal (n,)")
    only_first = int(np.sum((first < threshold) & ~(second < threshold)))
    only_second = int(np.sum((second < threshold) & ~(first < threshold)))
    discordant = only_first + only_second
    tail = sum(comb(discordant, k) for k in range(min(only_first, only_second) + 1)) / 2**discordant
    difference = first - second
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(resamples, difference.size))
    as_far = np.abs(signs @ difference) >= abs(difference.sum()) * (1 - 1e-12)
    return {
        "accuracy_gain": float(accuracy(second, threshold) - accuracy(first, threshold)),
        "accuracy_p": min(1.0, 2 * tail),
        "error_drop": float(difference.mean()),
        # The observed labelling counts as one of the permutations: p is never 0.
        "error_p": float((as_far.sum() + 1) / (resamples + 1)),
    }


def _errors(errors: ArrayLike) -> np.ndarray:
    errors = np.asarray(errors, dtype=np.float64)
    if errors.ndim == 0 or errors.shape[-1] == 0:
        raise InputError(f"errors of shape {errors.shape}, expected at least one along the last axis")
    if np.isnan(errors).any():
        raise InputError("errors hold NaN, expected numbers")
    return errors
