"""Figures of a run with their intervals and tests (paper sec. 5.1).

Pairs that share an object are not independent: `object_draws` resamples objects, and its draws give the intervals of
this project. Draws are weights: a row for each bootstrap replicate, a column for each pair.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from zsp_lite.io.files import stable_hash
from zsp_lite.metrics import accuracy, median, weighted_mean

Draws = Float[np.ndarray, "resamples n"]
RESAMPLES = 2000
_FEWEST_OBJECTS = 3
_REFERENCE = "ours"  # the row that all others are compared with


def summarise(table: pd.DataFrame) -> dict[str, Any]:
    """Summarise the results of a run (see `runs.Run`).

    "methods" has by row, over all pairs and "per_category", what `figures_of` returns, and where they are known
    "symmetric_acc30" and the medians "translation" and "scale" of the pairs that have them. "against" has the
    `paired_difference` of each row of the same problems to "ours". All draws resample objects.
    """
    rows = {str(name): row for name, row in table.groupby("row", sort=False)}
    methods, against, ours = {}, {}, rows.get(_REFERENCE)
    for name, row in rows.items():
        errors, drawn, categories = row["error"].to_numpy(), draws_of(row), row["category"].to_numpy(str)
        methods[name] = figures_of(errors, drawn, categories) | {
            "failed": int((row["failed"] != "").sum()),
            "per_category": {
                category: figures_of(errors[members], drawn[:, members])
                for category in dict.fromkeys(categories) for members in [categories == category]
            },
        }  # fmt: skip
        for part in ("translation", "scale"):
            if row[part].notna().any():
                methods[name][part] = float(row[part].median())
        if row["symmetric_error"].notna().any():
            known = row["symmetric_error"].fillna(row["error"]).to_numpy(np.float64)
            methods[name]["symmetric_acc30"] = float(accuracy(known, 30))
        if ours is not None and name != _REFERENCE and row["problem"].tolist() == ours["problem"].tolist():
            against[name] = paired_difference(ours["error"], errors, weights=drawn)
    return {"methods": methods} | ({} if ours is None else {"against": against})


def draws_of(row: pd.DataFrame) -> Draws:
    """Draw bootstrap weights of a row's pairs from resampled objects."""
    return object_draws(row[["reference", "target"]].to_numpy(), row["category"].to_numpy())


def object_draws(
    objects: Sequence[tuple[str, str]] | np.ndarray,
    categories: Sequence[str] | np.ndarray | None = None,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Draws:
    """Draw bootstrap weights (resamples, n) of pairs by resampling the objects (n, 2) that the pairs are made of.

    In each replicate the objects of a category are drawn with replacement, and the weight of a pair is the product of
    its two objects' multiplicities: the pigeonhole bootstrap (Owen 2007) with one set of objects on both sides, as in
    the vertex bootstrap of a network (Snijders & Borgatti 1999). If the errors depend little on the objects, the
    intervals are too wide: the estimated variance is then up to three times the true one. Every category keeps its
    total weight. With fewer than three objects, which do not tell the spread, pairs are resampled as independent.
    """
    objects = np.asarray(objects, dtype=str)
    categories = np.full(len(objects), "") if categories is None else np.asarray(categories, dtype=str)
    weights = np.empty((resamples, len(objects)))
    for category in np.unique(categories):
        rng = np.random.default_rng([seed, stable_hash(category)])
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


def pair_draws(n: int, resamples: int = RESAMPLES, seed: int = 0) -> Draws:
    """Draw bootstrap weights of n independent pairs: how often each is drawn, with replacement."""
    return _multiplicities(n, resamples, np.random.default_rng(seed)).astype(np.float64)


def bootstrap_ci(
    errors: ArrayLike, statistic: Callable[..., np.ndarray], weights: Draws | None = None
) -> tuple[float, float]:
    """Compute the 95 % percentile bootstrap interval of a statistic, such as `median`.

    It maps errors (n,) and weights (resamples, n) to (resamples,). Weights are those of `object_draws`; by default of
    `pair_draws(n)`, which treats pairs as independent.
    """
    errors = np.asarray(errors, np.float64)
    return _interval(statistic(errors, pair_draws(len(errors)) if weights is None else weights))


def figures_of(errors: ArrayLike, weights: Draws | None = None, categories: np.ndarray | None = None) -> dict:
    """Compute the paper's figures of rotation errors (n,) in degrees, with 95 % intervals (see `bootstrap_ci`).

    "above150" is the percentage of errors above 150 degrees, mostly confusions of front and back; "auc30" the area
    under the curve of accuracy against the threshold from 0 to 30 degrees, in percent; "mean_category_median", if
    categories (n,) are given, the paper's average of medians.
    """
    errors = np.asarray(errors, np.float64)

    def mean_category_median(errors: np.ndarray, weights: Draws | None = None) -> np.ndarray | float:
        members = [categories == category for category in np.unique(categories)]
        medians = [median(errors[one], None if weights is None else weights[:, one]) for one in members]
        return np.mean(medians, axis=0)

    figures = {
        "median": median,
        "acc30": lambda errors, weights=None: accuracy(errors, 30, weights),
        "acc15": lambda errors, weights=None: accuracy(errors, 15, weights),
    } | ({} if categories is None else {"mean_category_median": mean_category_median})
    found = {"n": int(errors.size)} | {name: float(figure(errors)) for name, figure in figures.items()}
    found |= {f"{name}_ci": list(bootstrap_ci(errors, figure, weights)) for name, figure in figures.items()}
    above150, auc30 = 100 * np.mean(errors > 150), 100 * np.mean(np.clip(1 - errors / 30, 0, None))
    return found | {"above150": float(above150), "auc30": float(auc30)}


def paired_difference(
    first: ArrayLike, second: ArrayLike, threshold: float = 30.0, weights: Draws | None = None
) -> dict[str, float]:
    """Measure by how much the second method is more accurate than the first on the same pairs (see `paired_test`)."""
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    gain = 100.0 * (second < threshold) - 100.0 * (first < threshold)
    # Rounding errors must not hide a difference of 0.
    replicates = weighted_mean(gain, pair_draws(len(gain)) if weights is None else weights).round(9)
    p = 2 * (1 + min((replicates <= 0).sum(), (replicates >= 0).sum())) / (1 + len(replicates))
    interval = list(_interval(replicates))
    return {"accuracy_gain": float(gain.mean()), "accuracy_gain_ci": interval, "accuracy_gain_p": min(1.0, float(p))}


def paired_test(
    first: ArrayLike, second: ArrayLike, threshold: float = 30.0, weights: Draws | None = None
) -> dict[str, float]:
    """Test whether the second method is better than the first on the same pairs. All p values are two-sided.

    Errors (n,) are in degrees, of the same pairs in the same order; a pair is solved below the threshold. The sign test
    and the permutation test, which is exact for up to 13 pairs, treat pairs as independent. Where pairs share objects,
    their p values are too small: report the interval and the p value of `paired_difference` with `object_draws`.

    Returns:
        {"accuracy_gain": second - first in percentage points, "accuracy_gain_ci": its 95 % bootstrap interval,
        "accuracy_gain_p": the p value that the same bootstrap gives, "sign_test_p": McNemar's exact test over the pairs
        that only one of the two solves, "permutation_test_p": of the mean difference of the errors, by 10,000 flips of
        the differences' signs}.
    """
    from scipy.stats import binomtest, permutation_test

    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    solved = first < threshold, second < threshold
    only_first, only_second = int((solved[0] & ~solved[1]).sum()), int((solved[1] & ~solved[0]).sum())
    sign = float(binomtest(only_first, only_first + only_second).pvalue) if only_first + only_second else 1.0
    p = 1.0  # of one pair: both signs give the same absolute difference, and scipy refuses one pair
    if len(first) > 1:
        how = {"permutation_type": "samples", "n_resamples": 10_000, "batch": 500, "vectorized": True}
        p = permutation_test((first - second,), np.mean, rng=0, **how).pvalue
    tests = {"sign_test_p": sign, "permutation_test_p": float(p)}
    return paired_difference(first, second, threshold, weights) | tests


def _interval(replicates: np.ndarray) -> tuple[float, float]:
    """Compute the 95 % percentile interval of bootstrap replicates (resamples,)."""
    low, high = np.percentile(replicates, [2.5, 97.5])
    return float(low), float(high)


def _multiplicities(n: int, resamples: int, rng: np.random.Generator) -> Int[np.ndarray, "resamples n"]:
    """Count how often each of n items is drawn if n are drawn with replacement."""
    draws = rng.integers(n, size=(resamples, n)) + n * np.arange(resamples)[:, None]
    return np.bincount(draws.ravel(), minlength=resamples * n).reshape(resamples, n)
