"""Pose errors, and statistics of many of them (paper sec. 5.1, supplement, "Choice of evaluation metrics").

Statistics take optional weights per pair, so that a bootstrap replicate is a row of weights. Pairs that share an
object are not independent: `object_draws` resamples objects, and its weights give the intervals of this project.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from zsp_lite.errors import InputError, check_magnitude, real_array

RESAMPLES = 2000
_FEWEST_OBJECTS = 3
_ROTATION_TOLERANCE = 1e-2  # largest entry of |R @ R.T - I|


def rotation_error(first: ArrayLike, second: ArrayLike) -> np.ndarray | float:
    """Compute the geodesic angle between rotations, exact near 0 and 180 degrees.

    The angle is the atan2 of the relative rotation's sine (its antisymmetric part) and cosine (its trace). An arccos of
    the trace loses all digits near 0 and 180.

    Args:
        first: Rotations (..., 3, 3), numpy or torch.
        second: Rotations (..., 3, 3), broadcast against `first`.

    Returns:
        Angles (...) in degrees in [0, 180]; a float for a single pair.

    Raises:
        InputError: For other shapes and matrices that are no rotations.
    """
    first, second = _rotations("first", first), _rotations("second", second)
    _check_broadcast("rotation_error", first.shape[:-2], second.shape[:-2])
    return rotation_angle(first, second)


def rotation_angle(first: Float[np.ndarray, "*a 3 3"], second: Float[np.ndarray, "*b 3 3"]) -> np.ndarray | float:
    """Compute the angles of `rotation_error` without checks."""
    relative = np.swapaxes(first, -1, -2) @ second
    twice_sine = np.sqrt(
        np.square(relative[..., 2, 1] - relative[..., 1, 2])
        + np.square(relative[..., 0, 2] - relative[..., 2, 0])
        + np.square(relative[..., 1, 0] - relative[..., 0, 1])
    )
    twice_cosine = np.trace(relative, axis1=-2, axis2=-1) - 1
    return np.degrees(np.arctan2(twice_sine, twice_cosine))[()]


def translation_error(first: ArrayLike, second: ArrayLike) -> np.ndarray | float:
    """Compute the Euclidean distance between translations (..., 3), in their unit.

    Raises:
        InputError: For other shapes, and values above 1e9 or not finite.
    """
    first, second = real_array("translation_error: first", first), real_array("translation_error: second", second)
    if first.shape[-1:] != (3,) or second.shape[-1:] != (3,):
        raise InputError(f"translation_error: shapes {first.shape} and {second.shape}, expected (..., 3)")
    _check_broadcast("translation_error", first.shape, second.shape)
    for name, values in (("first", first), ("second", second)):
        check_magnitude(f"translation_error: {name}", values)
    return np.linalg.norm(first - second, axis=-1)[()]


def accuracy(errors: ArrayLike, threshold: float, weights: ArrayLike | None = None) -> np.ndarray | float:
    """Compute the percentage of errors strictly below the threshold; Acc30 is threshold=30.

    Args:
        errors: (..., n) in degrees.
        threshold: In degrees.
        weights: None, or (..., n) non-negative weights, broadcast against `errors`.

    Returns:
        Percentages (...), over the last axis.
    """
    return 100 * _mean(_errors(errors) < threshold, weights)


def median(errors: ArrayLike, weights: ArrayLike | None = None) -> np.ndarray | float:
    """Compute the median of errors, optionally weighted.

    The weighted median halves the total weight. Where the half falls between two errors it is their mean, so that
    equal weights give the ordinary median.

    Args:
        errors: (..., n); (n,) where weights are given.
        weights: None, or (..., n) non-negative weights of a positive sum.

    Returns:
        Medians (...), over the last axis.
    """
    errors = _errors(errors)
    if weights is None:
        return np.median(errors, axis=-1)
    order = np.argsort(errors)
    cumulative = np.cumsum(np.take(weights, order, axis=-1), axis=-1)
    half = cumulative[..., -1:] / 2
    lower, upper = (cumulative < half).sum(axis=-1), (cumulative <= half).sum(axis=-1)
    ordered = errors[order]
    return ((ordered[lower] + ordered[upper]) / 2)[()]


def object_draws(
    objects: Sequence[tuple[str, str]] | np.ndarray,
    categories: Sequence[str] | np.ndarray | None = None,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Float[np.ndarray, "resamples n"]:
    """Draw bootstrap weights of pairs by resampling the objects that the pairs are made of.

    In each replicate the objects of a category are drawn with replacement, and the weight of a pair is the product of
    its two objects' multiplicities: the pigeonhole bootstrap (Owen, "The pigeonhole bootstrap", 2007) with one set of
    objects on both sides, as in the vertex bootstrap of a network (Snijders & Borgatti, 1999). It accounts for pairs
    that share an object. If the errors depend little on the objects, the intervals are too wide: the estimated
    variance is then up to three times the true one. Every category keeps its total weight. Pairs of a category with
    fewer than three objects are resampled as if they were independent: the spread between objects cannot be estimated
    from two.

    Args:
        objects: The two objects (reference, target) of each of the n pairs.
        categories: The category of each pair; the draws of one do not depend on the others. None for one category.
        resamples: Number of replicates.
        seed: Seed of the draws; equal pairs and seeds give equal weights.

    Returns:
        Weights of the pairs, a row for each replicate; for `bootstrap_ci`, `summarise` and `paired_test`.

    Raises:
        InputError: For lists of different lengths, or no pairs.
    """
    objects = np.asarray(objects, dtype=str)
    categories = np.full(len(objects), "") if categories is None else np.asarray(categories, dtype=str)
    if objects.ndim != 2 or objects.shape[1] != 2 or len(objects) != len(categories) or not len(objects):
        raise InputError(
            f"object_draws: objects of shape {objects.shape} and {len(categories)} categories, expected (n, 2) and n"
        )
    weights = np.empty((resamples, len(objects)))
    for category in np.unique(categories):
        digest = hashlib.sha256(category.encode(errors="surrogateescape")).digest()
        rng = np.random.default_rng([seed, int.from_bytes(digest[:8], "big")])
        members = np.nonzero(categories == category)[0]
        names, sides = np.unique(objects[members], return_inverse=True)
        first, second = sides.reshape(-1, 2).T
        drawn = np.zeros((resamples, len(members)))
        # A draw without both objects of any pair has no weight at all and is repeated.
        while len(empty := np.nonzero(drawn.sum(axis=1) == 0)[0]):
            if len(names) < _FEWEST_OBJECTS:
                drawn[empty] = _multiplicities(len(members), len(empty), rng)
            else:
                counts = _multiplicities(len(names), len(empty), rng)
                drawn[empty] = counts[:, first] * counts[:, second]
        weights[:, members] = drawn * (len(members) / drawn.sum(axis=1, keepdims=True))
    return weights


def pair_draws(n: int, resamples: int = RESAMPLES, seed: int = 0) -> Float[np.ndarray, "resamples n"]:
    """Draw bootstrap weights of n independent pairs: how often each is drawn, with replacement."""
    return _multiplicities(n, resamples, np.random.default_rng(seed)).astype(np.float64)


def bootstrap_ci(
    errors: ArrayLike,
    statistic: Callable[[np.ndarray, np.ndarray], np.ndarray],
    weights: Float[np.ndarray, "resamples n"] | None = None,
    level: float = 0.95,
) -> tuple[float, float]:
    """Compute the percentile bootstrap interval of a statistic.

    Args:
        errors: (n,).
        statistic: Maps errors (n,) and weights (resamples, n) to (resamples,), as `median` and
            `lambda errors, weights: accuracy(errors, 30, weights)` do.
        weights: From `object_draws`; None for `pair_draws(n)`, which treats pairs as independent.
        level: Confidence level.

    Returns:
        The lower and the upper end of the interval.
    """
    errors = _errors(errors, -np.inf, np.inf)
    return _interval(statistic(errors, pair_draws(len(errors)) if weights is None else weights), level)


def summarise(errors: ArrayLike, weights: Float[np.ndarray, "resamples n"] | None = None) -> dict:
    """Compute the paper's figures of rotation errors, with 95 % bootstrap intervals.

    Args:
        errors: (n,) in degrees.
        weights: From `object_draws`; None treats pairs as independent.

    Returns:
        {"n", "median" (degrees), "acc30", "acc15" (percent), for each of the three NAME_ci: [low, high], and
        "above150": the percentage of errors above 150 degrees, mostly confusions of front and back}.

    Raises:
        InputError: If there are no errors.
    """
    errors = _errors(errors)
    weights = pair_draws(len(errors)) if weights is None else weights
    figures = {
        "median": median,
        "acc30": lambda errors, weights=None: accuracy(errors, 30, weights),
        "acc15": lambda errors, weights=None: accuracy(errors, 15, weights),
    }
    summary = {"n": int(errors.size)} | {name: float(figure(errors)) for name, figure in figures.items()}
    for name, figure in figures.items():
        summary[f"{name}_ci"] = list(bootstrap_ci(errors, figure, weights))
    return summary | {"above150": float(100 * np.mean(errors > 150))}


def mean_category_median(
    errors: ArrayLike, categories: Sequence[str] | np.ndarray, weights: Float[np.ndarray, "resamples n"]
) -> tuple[float, tuple[float, float]]:
    """Compute the mean of the categories' medians, the paper's average of medians, with its 95 % interval.

    Args:
        errors: (n,) in degrees.
        categories: The category of each pair.
        weights: From `object_draws` with these categories.
    """
    errors, categories = _errors(errors), np.asarray(categories, dtype=str)
    members = [categories == category for category in np.unique(categories)]
    replicates = np.mean([median(errors[one], weights[:, one]) for one in members], axis=0)
    return float(np.mean([median(errors[one]) for one in members])), _interval(replicates)


def paired_difference(
    first: ArrayLike,
    second: ArrayLike,
    threshold: float = 30.0,
    weights: Float[np.ndarray, "resamples n"] | None = None,
) -> dict:
    """Measure by how much the second method is better than the first on the same pairs.

    Args:
        first: (n,) errors in degrees.
        second: (n,) errors of the same pairs in the same order.
        threshold: A pair is solved if its error is below it, in degrees.
        weights: From `object_draws`; None treats pairs as independent.

    Returns:
        {"accuracy_gain": second - first in percentage points, "error_drop": mean of first - second in degrees, and for
        both NAME_ci: the 95 % bootstrap interval, and NAME_p: the two-sided p value that the same bootstrap gives}.

    Raises:
        InputError: If the two differ in length.
    """
    first, second = _errors(first), _errors(second)
    if first.shape != second.shape or first.ndim != 1:
        raise InputError(f"paired_difference: shapes {first.shape} and {second.shape}, expected equal (n,)")
    weights = pair_draws(len(first)) if weights is None else weights
    differences = {
        "accuracy_gain": 100.0 * (second < threshold) - 100.0 * (first < threshold),
        "error_drop": first - second,
    }
    result = {}
    for name, values in differences.items():
        replicates = _mean(values, weights).round(9)  # rounding errors must not hide a difference of 0
        p = 2 * (1 + min((replicates <= 0).sum(), (replicates >= 0).sum())) / (1 + len(replicates))
        result |= {
            name: float(values.mean()),
            f"{name}_ci": list(_interval(replicates)),
            f"{name}_p": min(1.0, float(p)),
        }
    return result


def paired_test(
    first: ArrayLike,
    second: ArrayLike,
    threshold: float = 30.0,
    weights: Float[np.ndarray, "resamples n"] | None = None,
    seed: int = 0,
) -> dict:
    """Test whether the second method is better than the first on the same pairs. All p values are two-sided.

    The sign test and the permutation test treat pairs as independent. Where pairs share objects, their p values are too
    small; the interval and the p value of `paired_difference` with `object_draws` are the ones to report.

    Args:
        first, second, threshold, weights: As in `paired_difference`.
        seed: Seed of the permutation test, which is exact for up to 13 pairs.

    Returns:
        The entries of `paired_difference`, and {"sign_test_p": McNemar's exact test over the pairs that only one of the
        two solves, "permutation_test_p": of the mean difference, by 10,000 flips of the differences' signs}.

    Raises:
        InputError: If the two differ in length.
    """
    from scipy.stats import permutation_test

    result = paired_difference(first, second, threshold, weights)
    first, second = _errors(first), _errors(second)
    p = 1.0  # of one pair: both signs give the same absolute difference, and scipy refuses one pair
    if len(first) > 1:
        p = permutation_test(
            (first - second,), np.mean, permutation_type="samples", n_resamples=10_000, batch=500, vectorized=True,
            rng=seed,
        ).pvalue  # fmt: skip
    return result | {
        "sign_test_p": sign_test(first < threshold, second < threshold),
        "permutation_test_p": float(p),
    }


def sign_test(first: ArrayLike, second: ArrayLike) -> float:
    """Compute the exact two-sided p value of McNemar's test.

    Args:
        first: (n,) bool, the pairs that one method solves.
        second: (n,) bool, the pairs that the other solves.
    """
    from scipy.stats import binomtest

    first, second = np.asarray(first), np.asarray(second)
    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    return float(binomtest(only_first, only_first + only_second).pvalue) if only_first + only_second else 1.0


def _mean(values: np.ndarray, weights: ArrayLike | None) -> np.ndarray | float:
    """Compute the weighted mean over the last axis."""
    if weights is None:
        return np.mean(values, axis=-1)
    weights = np.asarray(weights)
    return (weights * values).sum(axis=-1) / weights.sum(axis=-1)


def _interval(replicates: np.ndarray, level: float = 0.95) -> tuple[float, float]:
    """Compute the percentile interval of bootstrap replicates (resamples,)."""
    tail = 50 * (1 - level)
    low, high = np.percentile(replicates, [tail, 100 - tail])
    return float(low), float(high)


def _multiplicities(n: int, resamples: int, rng: np.random.Generator) -> Int[np.ndarray, "resamples n"]:
    """Count how often each of n items is drawn if n are drawn with replacement."""
    draws = rng.integers(n, size=(resamples, n)) + n * np.arange(resamples)[:, None]
    return np.bincount(draws.ravel(), minlength=resamples * n).reshape(resamples, n)


def _rotations(name: str, values: ArrayLike) -> Float[np.ndarray, "*batch 3 3"]:
    matrices = real_array(f"rotation_error: {name}", values)
    if matrices.shape[-2:] != (3, 3):
        raise InputError(f"rotation_error: {name} has shape {matrices.shape}, expected (..., 3, 3)")
    check_magnitude(f"rotation_error: {name}", matrices)
    deviation = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max(initial=0)
    if deviation > _ROTATION_TOLERANCE or (np.linalg.det(matrices) < 0).any():
        raise InputError(f"rotation_error: {name} is no rotation, expected R @ R.T = identity, det R = 1")
    return matrices


def _check_broadcast(function: str, first: tuple[int, ...], second: tuple[int, ...]) -> None:
    try:
        np.broadcast_shapes(first, second)
    except ValueError as error:
        raise InputError(f"{function}: shapes {first} and {second} do not fit together") from error


def _errors(errors: ArrayLike, low: float = 0.0, high: float = 180.0) -> np.ndarray:
    """Convert rotation errors to an array of at least one number from `low` to `high` degrees."""
    errors = real_array("errors", errors)
    if errors.ndim == 0 or errors.shape[-1] == 0:
        raise InputError(f"errors of shape {errors.shape}, expected at least one along the last axis")
    if not ((errors >= low) & (errors <= high)).all():  # False for NaN too
        raise InputError(f"errors hold {errors.min()} to {errors.max()}, expected {low:g} to {high:g} degrees")
    return errors


@dataclass(frozen=True, eq=False)
class Reliability:
    """How well confidences are calibrated and how well they rank estimates. `print` shows it as a table.

    Bins hold equal numbers of estimates, in order of confidence.

    Attributes:
        auroc: Area under the ROC curve (see `auroc`).
        calibration_error: Expected calibration error, in [0, 1].
        top_half_accuracy: Fraction of correct estimates among the more confident half.
        count: (bins,) number of estimates.
        confidence: (bins,) mean confidence.
        accuracy: (bins,) fraction of correct estimates.
    """

    auroc: float
    calibration_error: float
    top_half_accuracy: float
    count: np.ndarray
    confidence: Float[np.ndarray, " bins"]
    accuracy: Float[np.ndarray, " bins"]

    def __str__(self) -> str:
        lines = [f"{'n':>5} {'confidence':>11} {'correct':>8}"]
        lines += [
            f"{n:5d} {100 * c:10.1f}% {100 * a:7.1f}%" for n, c, a in zip(self.count, self.confidence, self.accuracy)
        ]
        lines.append(
            f"AUROC {self.auroc:.3f}, expected calibration error {100 * self.calibration_error:.1f} points, "
            f"accuracy of the more confident half {100 * self.top_half_accuracy:.1f} %"
        )
        return "\n".join(lines)


def reliability(confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"], bins: int = 10) -> Reliability:
    """Measure the reliability of confidences.

    Args:
        confidence: Confidences of n estimates, in [0, 1].
        correct: Which of the estimates were correct.
        bins: Number of bins of equal count.

    Raises:
        InputError: If the lengths differ or there are fewer estimates than bins.
    """
    confidence, correct = np.asarray(confidence, dtype=np.float64), np.asarray(correct, dtype=bool)
    if confidence.shape != correct.shape or confidence.ndim != 1 or len(correct) < bins:
        raise InputError(
            f"{len(correct)} outcomes and {len(confidence)} confidences, expected equal numbers of at least {bins}"
        )
    order = np.argsort(confidence, kind="stable")
    parts = np.array_split(order, bins)
    mean = np.array([confidence[part].mean() for part in parts])
    accuracy = np.array([correct[part].mean() for part in parts])
    count = np.array([len(part) for part in parts])
    upper_half = order[len(order) // 2 :]
    error = float((count * np.abs(mean - accuracy)).sum() / count.sum())
    return Reliability(auroc(confidence, correct), error, float(correct[upper_half].mean()), count, mean, accuracy)


def auroc(confidence: Float[np.ndarray, " n"], correct: Bool[np.ndarray, " n"]) -> float:
    """Estimate the probability that a correct estimate has a higher confidence than a wrong one, ties counting half."""
    correct = np.asarray(correct, dtype=bool)
    positive, negative = np.asarray(confidence)[correct], np.asarray(confidence)[~correct]
    if not len(positive) or not len(negative):
        return float("nan")
    difference = positive[:, None] - negative
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())
