"""Figures of a run: every row over all pairs and by category (paper sec. 5.1), with intervals over objects."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from zsp_lite.benchmark import statistics
from zsp_lite.benchmark.statistics import Draws, object_draws
from zsp_lite.metrics import accuracy

REFERENCE = "ours"  # the row that all others are compared with
_TIMED = {"backbone": "features_per_frame", "reading": "reading_each", "similarity": "similarity_each"}


def summarise(table: pd.DataFrame, costs: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> dict[str, Any]:
    """Summarise a run (see `runs.Run`): the content of summary.json.

    "methods" has by row, over all pairs and "per_category", the figures of `statistics.summarise`, the paper's
    "mean_category_median", and of solvers with hypotheses "best_two" (see `best_two_figures`). "against" compares every
    row of the same problems with "ours": the row's figure minus that of "ours" (see `statistics.paired_difference`).
    Intervals and p values come from resampled objects. "saliency_iou" is the mean over frames, by category and "mean";
    "timings" are median seconds per stage of the first row, per frame and per comparison of two frames.
    """
    rows = {str(name): row for name, row in table.groupby("row", sort=False)}
    draws: dict[tuple, Draws] = {}  # rows with the same objects share them
    methods = {}
    for name, row in rows.items():
        errors, drawn = row["error"].to_numpy(), draws_of(row, draws)
        average, interval = statistics.mean_category_median(errors, row["category"].to_numpy(), drawn)
        methods[name] = statistics.summarise(errors, drawn) | {
            "mean_category_median": average,
            "mean_category_median_ci": list(interval),
            "failed": int((row["failed"] != "").sum()),
            "flagged": int((row["note"] != "").sum()),
            "per_category": {
                category: statistics.summarise(errors[members], drawn[:, members])
                for category in row["category"].unique()
                for members in [(row["category"] == category).to_numpy()]
            },
        }
        for part in ("translation", "scale"):
            if row[part].notna().any():
                methods[name][part] = float(row[part].median())
        if row["symmetric_error"].notna().any():
            known = row["symmetric_error"].fillna(row["error"]).to_numpy()
            methods[name]["symmetric_acc30"] = float(accuracy(known, 30))
        if row["one_of_two"].notna().any():
            methods[name]["best_two"] = best_two_figures(row, drawn)
    # A backbone's fingerprint is its name and a hash.
    backbone = settings["backbone"].rpartition(" ")[0] or settings["backbone"]
    data = {"root": settings["data"], "categories": list(table["category"].unique())}
    data |= {"pairs": max(len(row) for row in rows.values()), "targets": settings["targets"]}
    summary = {"data": data, "backbone": backbone, "methods": methods}
    if REFERENCE in rows:
        ours = rows[REFERENCE]
        summary["against"] = {
            name: statistics.paired_difference(ours["error"], row["error"], weights=draws_of(ours, draws))
            for name, row in rows.items()
            if name != REFERENCE and row["problem"].tolist() == ours["problem"].tolist()
        }
    return summary | {"saliency_iou": _saliency_iou(costs), "timings": _timings(next(iter(rows.values())), costs)}


def draws_of(row: pd.DataFrame, known: dict[tuple, np.ndarray] | None = None) -> Draws:
    """Draw bootstrap weights of a row's pairs from resampled objects."""
    objects = list(zip(row["reference"], row["target"]))
    found = (known or {}).get(tuple(objects))
    if found is None:
        found = object_draws(objects, row["category"].to_numpy())
        if known is not None:
            known[tuple(objects)] = found
    return found


def best_two_figures(row: pd.DataFrame, drawn: Draws) -> dict[str, Any]:
    """Compute how often the estimate or its first alternative is right. These figures are not comparable with Acc30.

    "one_of_two" is the number of estimates for which the solver cannot decide between the two; the figures whose names
    begin with it are percentages of these, None without any.
    """
    first = row["error"].to_numpy()
    either = np.minimum(first, row["second_error"].fillna(180.0).to_numpy())
    flagged = row["one_of_two"].fillna(False).to_numpy(dtype=bool)
    return {
        "acc30": float(accuracy(either, 30)),
        "acc30_ci": list(statistics.bootstrap_ci(either, lambda errors, weights: accuracy(errors, 30, weights), drawn)),
        "one_of_two": int(flagged.sum()),
        "one_of_two_acc30": float(accuracy(either[flagged], 30)) if flagged.any() else None,
        "one_of_two_first_acc30": float(accuracy(first[flagged], 30)) if flagged.any() else None,  # of the estimate
    }


def _timings(first: pd.DataFrame, costs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    stages = pd.DataFrame([one for one in first["timings"] if isinstance(one, dict)])
    timings = {str(stage): float(seconds) for stage, seconds in stages.fillna(0.0).median().items()}
    for stage, name in _TIMED.items():
        if seconds := [one for cost in costs for one in cost["timings"].get(stage, ())]:
            timings[name] = float(np.median(seconds))
    return timings


def _saliency_iou(costs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Mean IoU of the frames' foregrounds, by category and over categories."""
    by_category: dict[str, dict[str, float]] = {}
    for cost in costs:
        by_category.setdefault(cost["pair"].split("/")[0], {}).update(cost["saliency_iou"])
    means = {category: float(np.mean(list(frames.values()))) for category, frames in by_category.items() if frames}
    return means | {"mean": float(np.mean(list(means.values())))} if means else {}
