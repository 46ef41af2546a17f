"""Figures of a run (paper sec. 5.1) with their intervals, and tests of differences."""

from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy.typing import ArrayLike

from zsp_lite.benchmark.statistics import Draws, interval_of, multiplicities, object_draws
from zsp_lite.metrics import accuracy, median, weighted_mean


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
    draws = {}  # of the rows with the same problems, which share them
    for name, row in table.groupby("row", sort=False):
        problems = tuple(row["problem"])
        if problems not in draws:
            draws[problems] = draws_of(row)
        drawn = draws[problems]
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
    drawn_medians = []  # of each category by draw
    for category in np.unique(categories).tolist():
        members = categories == category
        summary["per_category"][category] = figures_of(errors[members], drawn[:, members])
        drawn_medians.append(median(errors[members], drawn[:, members]))
    medians = [figures["median"] for figures in summary["per_category"].values()]
    summary["mean_category_median"] = float(np.mean(medians))
    summary["mean_category_median_ci"] = interval_of(np.mean(drawn_medians, axis=0))
    # `figures_of` has counted each pair once for each seed.
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
    # The same draws of seeds for every row with so many.
    of_seeds = multiplicities(len(seeds), np.random.default_rng([0, len(seeds)]))
    return drawn * of_seeds[:, repeat]


def figures_of(errors: ArrayLike, weights: Draws) -> dict:
    """Compute the paper's figures of rotation errors (n,) in degrees, with 95 % intervals.

    "above150" is the percentage of errors above 150 degrees, mostly confusions of front and back;
    "auc30" the area under the curve of accuracy against the threshold from 0 to 30 degrees, in
    percent.
    """
    errors = np.asarray(errors, np.float64)
    values = _statistics(errors, np.ones((1, len(errors))))[:, 0].tolist()
    intervals = interval_of(_statistics(errors, weights))
    figures: dict[str, Any] = {"n": len(errors)}
    for name, value, interval in zip(_FIGURES, values, intervals):
        figures |= {name: value, f"{name}_ci": interval}
    return figures


_FIGURES = "median", "acc30", "acc15", "above150", "auc30"


def _statistics(
    errors: Float[np.ndarray, " n"], weights: Draws
) -> Float[np.ndarray, "figures resamples"]:
    """Return the figures of weighted errors, in the order of `_FIGURES`."""
    shares = np.stack([errors < 30, errors < 15, errors > 150, (1 - errors / 30).clip(0)])
    means = 100 * shares @ weights.T / weights.sum(axis=1)
    return np.vstack([median(errors, weights), means])


def paired_difference(first: ArrayLike, second: ArrayLike, weights: Draws) -> dict:
    """Measure by how much the second method is more accurate than the first on the same pairs.

    Errors (n,) are in degrees; a pair is solved below 30.

    "accuracy_gain" is second - first in percentage points, with its 95 % interval and its p value
    by the bootstrap.
    """
    first = np.asarray(first, np.float64)
    second = np.asarray(second, np.float64)
    gain = 100.0 * (second < 30) - 100.0 * (first < 30)
    # Rounding errors must not hide a difference of 0.
    replicates = weighted_mean(gain, weights).round(9)
    # Two-sided: twice the share of replicates on the rarer side, the data themselves counted in.
    rarer = min((replicates <= 0).sum(), (replicates >= 0).sum())
    p = 2 * (1 + rarer) / (1 + len(replicates))
    return {
        "accuracy_gain": float(gain.mean()),
        "accuracy_gain_ci": interval_of(replicates),
        "accuracy_gain_p": min(1.0, float(p)),
    }
