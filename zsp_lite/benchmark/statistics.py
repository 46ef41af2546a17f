"""Figures of a run with their intervals and tests (paper sec. 5.1).

Pairs that share an object are not independent: `object_draws` resamples objects, and its draws give
the intervals of this project. Draws are weights: a row for each bootstrap replicate, a column for
each pair.
"""

from collections.abc import Callable
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


def summarise(table: pd.DataFrame) -> dict[str, Any]:
    """Summarise the results of a run (see `runs.Run`).

    "methods" has by row, over all pairs and "per_category", what `figures_of` returns, and where
    they are known "symmetric_acc30" and the medians "translation" and "scale" of the pairs that
    have them. "against" has the `paired_difference` of each row of the same problems to "ours".
    "milliseconds" are medians, too, apart because they differ from run to run. All draws resample
    objects.
    """
    rows = {str(name): row for name, row in table.groupby("row", sort=False)}
    methods, against, ours = {}, {}, rows.get("ours")
    for name, row in rows.items():
        errors, drawn, categories = (
            row["error"].to_numpy(),
            draws_of(row),
            row["category"].to_numpy(str),
        )
        seeds = row["repeat"].nunique()
        methods[name] = figures_of(errors, drawn, categories) | {
            "failed": row.loc[row["failed"] != "", "pair"].nunique(),
            "per_category": {
                category: figures_of(errors[members], drawn[:, members])
                for category in dict.fromkeys(categories)
                for members in [categories == category]
            },
        }
        for found in (methods[name], *methods[name]["per_category"].values()):
            found["n"] //= seeds
        if seeds > 1:
            by_seed = row.groupby("repeat")["error"].apply(
                lambda errors: 100 * (errors < 30).mean()
            )
            methods[name]["acc30_sd_of_seeds"] = float(by_seed.std())
        methods[name] |= row[["translation", "scale"]].astype(float).median().dropna().to_dict()
        if row["symmetric_error"].notna().any():
            known = row["symmetric_error"].fillna(row["error"]).to_numpy(np.float64)
            methods[name]["symmetric_acc30"] = float(accuracy(known, 30))
        if ours is not None and name != "ours":
            common = ours[ours["repeat"].isin(row["repeat"])]
            if row["problem"].tolist() == common["problem"].tolist():
                against[name] = paired_difference(common["error"], errors, weights=drawn)
    times = table.groupby("row", sort=False)["milliseconds"].median().dropna().to_dict()
    return {"methods": methods, "milliseconds": times} | (
        {} if ours is None else {"against": against}
    )


def draws_of(row: pd.DataFrame) -> Draws:
    """Draw bootstrap weights of a row's pairs from resampled objects, and from resampled seeds if
    there are several."""
    drawn = object_draws(row[["reference", "target"]].to_numpy(), row["category"].to_numpy())
    seeds, repeat = np.unique(row["repeat"], return_inverse=True)
    if len(seeds) == 1:
        return drawn
    return (
        drawn
        * _multiplicities(len(seeds), RESAMPLES, np.random.default_rng([0, len(seeds)]))[:, repeat]
    )


def object_draws(
    objects: ArrayLike, categories: ArrayLike | None = None, resamples: int = RESAMPLES
) -> Draws:
    """Draw bootstrap weights (resamples, n) of pairs by resampling the objects (n, 2) that the
    pairs are made of.

    In each replicate the objects of a category are drawn with replacement, and the weight of a pair
    is the product of its two objects' multiplicities: the pigeonhole bootstrap (Owen 2007) with one
    set of objects on both sides. If the errors depend little on the objects, the intervals are too
    wide: the estimated variance is then up to three times the true one. Every category keeps its
    total weight. Pairs of fewer than three objects are resampled themselves.
    """
    objects = np.asarray(objects, dtype=str)
    categories = (
        np.full(len(objects), "") if categories is None else np.asarray(categories, dtype=str)
    )
    weights = np.empty((resamples, len(objects)))
    for category in np.unique(categories):
        rng = np.random.default_rng([0, stable_hash(category)])
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


def pair_draws(n: int) -> Draws:
    """Draw bootstrap weights of n independent pairs: how often each is drawn, with replacement."""
    return _multiplicities(n, RESAMPLES, np.random.default_rng(0)).astype(np.float64)


def bootstrap_ci(
    errors: ArrayLike, statistic: Callable[..., np.ndarray], weights: Draws | None = None
) -> list[float]:
    """Compute the 95 % percentile bootstrap interval of a statistic, such as `median`.

    It maps errors (n,) and weights (resamples, n) to (resamples,). Weights are those of
    `object_draws`; by default of `pair_draws(n)`, which treats pairs as independent.
    """
    errors = np.asarray(errors, np.float64)
    replicates = statistic(errors, pair_draws(len(errors)) if weights is None else weights)
    return np.percentile(replicates, [2.5, 97.5]).tolist()


def figures_of(
    errors: ArrayLike, weights: Draws | None = None, categories: np.ndarray | None = None
) -> dict:
    """Compute the paper's figures of rotation errors (n,) in degrees, with 95 % intervals (see
    `bootstrap_ci`).

    "above150" is the percentage of errors above 150 degrees, mostly confusions of front and back;
    "auc30" the area under the curve of accuracy against the threshold from 0 to 30 degrees, in
    percent; "mean_category_median", if categories (n,) are given, the paper's average of medians.
    """
    errors = np.asarray(errors, np.float64)

    def mean_category_median(
        errors: np.ndarray, weights: Draws | None = None
    ) -> np.ndarray | float:
        members = [categories == category for category in np.unique(categories)]
        medians = [
            median(errors[one], None if weights is None else weights[:, one]) for one in members
        ]
        return np.mean(medians, axis=0)

    figures = {
        "median": median,
        "acc30": lambda errors, weights=None: accuracy(errors, 30, weights),
        "acc15": lambda errors, weights=None: accuracy(errors, 15, weights),
        "above150": lambda errors, weights=None: 100 * weighted_mean(errors > 150, weights),
        "auc30": lambda errors, weights=None: (
            100 * weighted_mean(np.clip(1 - errors / 30, 0, None), weights)
        ),
    } | ({} if categories is None else {"mean_category_median": mean_category_median})
    found = {"n": int(errors.size)} | {
        name: float(figure(errors)) for name, figure in figures.items()
    }
    return found | {
        f"{name}_ci": bootstrap_ci(errors, figure, weights) for name, figure in figures.items()
    }


def paired_difference(
    first: ArrayLike, second: ArrayLike, threshold: float = 30, weights: Draws | None = None
) -> dict:
    """Measure by how much the second method is more accurate than the first on the same pairs.

    "accuracy_gain" is second - first in percentage points, with its 95 % interval and its p value
    by the bootstrap.
    """
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    gain = 100.0 * (second < threshold) - 100.0 * (first < threshold)
    # Rounding errors must not hide a difference of 0.
    replicates = weighted_mean(gain, pair_draws(len(gain)) if weights is None else weights).round(9)
    p = 2 * (1 + min((replicates <= 0).sum(), (replicates >= 0).sum())) / (1 + len(replicates))
    interval = np.percentile(replicates, [2.5, 97.5]).tolist()
    return {
        "accuracy_gain": float(gain.mean()),
        "accuracy_gain_ci": interval,
        "accuracy_gain_p": min(1.0, float(p)),
    }


def paired_test(
    first: ArrayLike, second: ArrayLike, threshold: float = 30, weights: Draws | None = None
) -> dict:
    """Test whether the second method is better than the first on the same pairs. All p values are
    two-sided.

    Errors (n,) are in degrees; a pair is solved below the threshold. To what `paired_difference`
    returns are added "sign_test_p", of McNemar's exact test, and "permutation_test_p", of the mean
    difference, by 10,000 flips of signs. Both treat pairs as independent: where pairs share
    objects, these p values are too small.
    """
    from scipy.stats import binomtest, permutation_test

    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    # 1 for a pair that the second alone solves
    change = (second < threshold) * 1 - (first < threshold)
    sign = binomtest((change > 0).sum(), np.count_nonzero(change)).pvalue if change.any() else 1.0
    how = {"permutation_type": "samples", "n_resamples": 10_000, "batch": 500, "vectorized": True}
    # scipy refuses one pair, whose difference has the same size with both signs.
    flips = (
        permutation_test((first - second,), np.mean, rng=0, **how).pvalue if len(first) > 1 else 1.0
    )
    tests = {"sign_test_p": float(sign), "permutation_test_p": float(flips)}
    return paired_difference(first, second, threshold, weights) | tests


def _multiplicities(
    n: int, resamples: int, rng: np.random.Generator
) -> Int[np.ndarray, "resamples n"]:
    """Count how often each of n items is drawn if n are drawn with replacement."""
    draws = rng.integers(n, size=(resamples, n)) + n * np.arange(resamples)[:, None]
    return np.bincount(draws.ravel(), minlength=resamples * n).reshape(resamples, n)
