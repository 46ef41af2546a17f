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
_FEWEST_OBJECTS = 3  # two objects have one pair in each direction: nothing to resample


def summarise(table: pd.DataFrame) -> dict[str, Any]:
    """Summarise the results of a run (see `runs.Run`).

    "methods" has by row, over all pairs and "per_category", what `figures_of` returns; over all
    pairs also the paper's average of the categories' medians, and where they are known
    "symmetric_acc30" and the medians "translation" and "scale" of the pairs that have them.
    "against" has the `paired_difference` of each row of the same problems to "ours".
    "milliseconds" are medians, too, apart because they differ from run to run. All draws resample
    objects.
    """
    ours = table[table["row"] == "ours"]
    methods = {}
    against = {}
    for name, row in table.groupby("row", sort=False):
        drawn = draws_of(row)
        methods[name] = _summarise_row(row, drawn)
        common = ours[ours["repeat"].isin(row["repeat"])]
        if name != "ours" and row["problem"].tolist() == common["problem"].tolist():
            against[name] = paired_difference(common["error"], row["error"], weights=drawn)
    times = (1000 * table["seconds"].astype(float)).groupby(table["row"], sort=False).median()
    return {
        "methods": methods,
        "milliseconds": times.dropna().to_dict(),
        "against": against,
    }


def _summarise_row(row: pd.DataFrame, drawn: Draws) -> dict[str, Any]:
    """Summarise the results of one row, for all pairs and by category (see `summarise`)."""
    errors = row["error"].to_numpy()
    categories = row["category"].to_numpy(str)
    summary = figures_of(errors, drawn)
    summary["failed"] = row.loc[row["failed"] != "", "pair"].nunique()
    summary["per_category"] = {}
    medians = []  # of each category by draw
    for category in np.unique(categories).tolist():
        members = categories == category
        summary["per_category"][category] = figures_of(errors[members], drawn[:, members])
        medians.append(median(errors[members], drawn[:, members]))
    known = [figures["median"] for figures in summary["per_category"].values()]
    summary["mean_category_median"] = float(np.mean(known))
    summary["mean_category_median_ci"] = _interval(np.mean(medians, axis=0))
    seeds = row["repeat"].nunique()
    for figures in (summary, *summary["per_category"].values()):
        figures["n"] //= seeds
    if seeds > 1:
        by_seed = (row["error"] < 30).groupby(row["repeat"]).mean()
        summary["acc30_sd_of_seeds"] = float((100 * by_seed).std())
    summary |= row[["translation", "scale"]].astype(float).median().dropna().to_dict()
    if row["symmetric_error"].notna().any():
        known = row["symmetric_error"].fillna(row["error"]).astype(float)
        summary["symmetric_acc30"] = float(accuracy(known, 30))
    return summary


def draws_of(row: pd.DataFrame) -> Draws:
    """Draw bootstrap weights of a row's pairs from resampled objects, and from resampled seeds if
    there are several."""
    drawn = object_draws(row[["reference", "target"]].to_numpy(), row["category"].to_numpy())
    seeds, repeat = np.unique(row["repeat"], return_inverse=True)
    if len(seeds) == 1:
        return drawn
    of_seeds = _multiplicities(len(seeds), RESAMPLES, np.random.default_rng([0, len(seeds)]))
    return drawn * of_seeds[:, repeat]


def object_draws(objects: ArrayLike, categories: ArrayLike = "") -> Draws:
    """Draw bootstrap weights (resamples, n) of pairs by resampling the objects (n, 2) that the
    pairs are made of. Categories (n,) are those of the pairs, by default one.

    In each replicate the objects of a category are drawn with replacement, and the weight of a pair
    is the product of its two objects' multiplicities: the pigeonhole bootstrap (Owen 2007) with one
    set of objects on both sides. If the errors depend little on the objects, the intervals are too
    wide: the estimated variance is then up to three times the true one. Every category keeps its
    total weight. Pairs of fewer than three objects are resampled themselves.
    """
    objects = np.asarray(objects, dtype=str)
    categories = np.broadcast_to(np.asarray(categories, dtype=str), len(objects))
    weights = np.empty((RESAMPLES, len(objects)))  # a column for each pair
    for category in np.unique(categories):
        rng = np.random.default_rng([0, stable_hash(category)])
        members = np.nonzero(categories == category)[0]
        names, sides = np.unique(objects[members], return_inverse=True)
        first, second = sides.reshape(-1, 2).T
        drawn = np.zeros((RESAMPLES, len(members)))
        # A draw without both objects of any pair has no weight at all and is repeated.
        empty = np.arange(RESAMPLES)
        while len(empty):
            if len(names) < _FEWEST_OBJECTS:
                drawn[empty] = _multiplicities(len(members), len(empty), rng)
            else:
                counts = _multiplicities(len(names), len(empty), rng)
                drawn[empty] = counts[:, first] * counts[:, second]
            empty = np.flatnonzero(drawn.sum(axis=1) == 0)
        weights[:, members] = drawn * (len(members) / drawn.sum(axis=1, keepdims=True))
    return weights


def bootstrap_ci(
    errors: ArrayLike, statistic: Callable[..., np.ndarray], weights: Draws | None = None
) -> list[float]:
    """Compute the 95 % percentile bootstrap interval of a statistic, such as `median`.

    It maps errors (n,) and weights (resamples, n) to (resamples,). Weights are those of
    `object_draws`; by default pairs are drawn as if they were independent.
    """
    errors = np.asarray(errors, np.float64)
    if weights is None:
        weights = _multiplicities(len(errors), RESAMPLES, np.random.default_rng(0))
    return _interval(statistic(errors, weights))


def _interval(replicates: Float[np.ndarray, " resamples"]) -> list[float]:
    """Return the ends of the interval that holds 95 % of the replicates."""
    return np.percentile(replicates, [2.5, 97.5]).tolist()


def figures_of(errors: ArrayLike, weights: Draws | None = None) -> dict:
    """Compute the paper's figures of rotation errors (n,) in degrees, with 95 % intervals (see
    `bootstrap_ci`).

    "above150" is the percentage of errors above 150 degrees, mostly confusions of front and back;
    "auc30" the area under the curve of accuracy against the threshold from 0 to 30 degrees, in
    percent.
    """
    errors = np.asarray(errors, np.float64)
    values: dict[str, Any] = {"n": int(errors.size)}
    for name, figure in _FIGURES.items():
        values[name] = float(figure(errors, None))
        values[f"{name}_ci"] = bootstrap_ci(errors, figure, weights)
    return values


# Statistics of errors (n,) with weights (resamples, n) or None.
_FIGURES: dict[str, Callable[..., Any]] = {
    "median": median,
    "acc30": lambda errors, weights: accuracy(errors, 30, weights),
    "acc15": lambda errors, weights: accuracy(errors, 15, weights),
    "above150": lambda errors, weights: 100 * weighted_mean(errors > 150, weights),
    "auc30": lambda errors, weights: 100 * weighted_mean((1 - errors / 30).clip(0), weights),
}


def paired_difference(
    first: ArrayLike, second: ArrayLike, threshold: float = 30, weights: Draws | None = None
) -> dict:
    """Measure by how much the second method is more accurate than the first on the same pairs.

    "accuracy_gain" is second - first in percentage points, with its 95 % interval and its p value
    by the bootstrap.
    """
    first = np.asarray(first, np.float64)
    second = np.asarray(second, np.float64)
    gain = 100.0 * (second < threshold) - 100.0 * (first < threshold)
    if weights is None:
        weights = _multiplicities(len(gain), RESAMPLES, np.random.default_rng(0))
    # Rounding errors must not hide a difference of 0.
    replicates = weighted_mean(gain, weights).round(9)
    # Two-sided: twice the share of replicates on the rarer side, the data themselves counted in.
    rarer = min((replicates <= 0).sum(), (replicates >= 0).sum())
    p = 2 * (1 + rarer) / (1 + len(replicates))
    return {
        "accuracy_gain": float(gain.mean()),
        "accuracy_gain_ci": _interval(replicates),
        "accuracy_gain_p": min(1.0, float(p)),
    }


def paired_test(first: ArrayLike, second: ArrayLike) -> dict:
    """Test whether the second method is better than the first on the same pairs. All p values are
    two-sided.

    Errors (n,) are in degrees; a pair is solved below 30. To what `paired_difference`
    returns is added "sign_test_p", of McNemar's exact test. It treats pairs as independent: where
    pairs share objects, this p value is too small.
    """
    from scipy.stats import binomtest

    first = np.asarray(first, np.float64)
    second = np.asarray(second, np.float64)
    # McNemar's test is the sign test of the pairs that one method alone solves.
    solved = first < 30
    solved_by_second = second < 30
    alone = np.count_nonzero(solved != solved_by_second)
    sign = 1.0
    if alone:
        sign = binomtest(np.count_nonzero(solved_by_second & ~solved), alone).pvalue
    return paired_difference(first, second) | {"sign_test_p": float(sign)}


def _multiplicities(
    n: int, resamples: int, rng: np.random.Generator
) -> Int[np.ndarray, "resamples n"]:
    """Count how often each of n items is drawn if n are drawn with replacement."""
    # The items of replicate r are counted from r * n on.
    draws = rng.integers(n, size=(resamples, n)) + n * np.arange(resamples)[:, None]
    return np.bincount(draws.ravel(), minlength=resamples * n).reshape(resamples, n)
