"""Figures of a run: every row over all pairs and by category (paper sec. 5.1), with intervals over objects."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from zsp_lite.benchmark import statistics
from zsp_lite.benchmark.statistics import Draws, object_draws
from zsp_lite.metrics import accuracy

Rows = Mapping[str, Mapping[str, Mapping[str, Any]]]  # by row and pair key, what the row found
_TIMED = {"backbone": "features_per_frame", "reading": "reading_each", "similarity": "similarity_each"}


def summarise_run(
    rows: Rows, evaluations: Mapping[str, Sequence[Mapping[str, Any]]], data: Mapping[str, Any], backbone: str
) -> dict[str, Any]:
    """Summarise rows and evaluations (see `records.Records`): the content of summary.json.

    Its "methods", "against_ours" and "intervals" are those of `summarise_rows`; "saliency_iou" is the mean over the
    frames, by category and "mean"; "timings" are median seconds per stage of the first row, per frame and per
    comparison of two frames.
    """
    keys = dict.fromkeys(key for row in rows.values() for key in row)
    used = {key: evaluations[key] for key in keys if key in evaluations}
    first = [found["timings"] for found in next(iter(rows.values()), {}).values() if "timings" in found]
    timings = {stage: float(np.median([one.get(stage, 0.0) for one in first])) for stage in (first[0] if first else ())}
    for stage, name in _TIMED.items():
        seconds = [one for found in used.values() for once in found for one in once["timings"].get(stage, ())]
        if seconds:
            timings[name] = float(np.median(seconds))
    summary = {"data": dict(data), "backbone": backbone, **summarise_rows(rows)}
    return summary | {"saliency_iou": _saliency_iou(used), "timings": timings}


def summarise_rows(rows: Rows) -> dict[str, Any]:
    """Summarise what rows found, by row and pair key.

    "methods" has by row, over all pairs and "per_category", the figures of `statistics.summarise`, the paper's
    "mean_category_median", and of solvers with hypotheses "best_two" (see `best_two_figures`). "against_ours" compares
    "ours" with every row of the same problems (see `statistics.paired_difference`). Intervals and p values come from
    resampled objects, except for "sign_test_p".
    """
    rows = {name: _ordered(row) for name, row in rows.items()}
    draws: dict[tuple, np.ndarray] = {}  # rows with the same objects share them
    methods, errors = {}, {}
    for name, row in rows.items():
        errors[name] = np.array([one["error"] for one in row.values()])
        objects = tuple(map(objects_of, row))
        drawn = draws[objects] = draws[objects] if objects in draws else draws_of_pairs(row)
        categories = np.array([category_of(key) for key in row])
        average, interval = statistics.mean_category_median(errors[name], categories, drawn)
        methods[name] = statistics.summarise(errors[name], drawn) | {
            "mean_category_median": average,
            "mean_category_median_ci": list(interval),
            "failed": sum("failed" in one for one in row.values()),
            "flagged": sum(one.get("note", "") != "" for one in row.values()),
            "per_category": {
                category: statistics.summarise(errors[name][members], drawn[:, members])
                for category in dict.fromkeys(categories.tolist())
                for members in [categories == category]
            },
        }
        if any("one_of_two" in one for one in row.values()):
            methods[name]["best_two"] = best_two_figures(row, drawn)
    summary: dict[str, Any] = {"methods": methods, "intervals": {"level": 0.95, "resampled": "objects"}}
    if "ours" in rows:
        problems, drawn = list(map(_problem, rows["ours"])), draws[tuple(map(objects_of, rows["ours"]))]
        summary["against_ours"] = {
            name: statistics.paired_difference(found, errors["ours"], weights=drawn)
            | {"sign_test_p": statistics.sign_test(found < 30, errors["ours"] < 30)}
            for name, found in errors.items()
            if name != "ours" and list(map(_problem, rows[name])) == problems
        }
    return summary


def best_two_figures(row: Mapping[str, Mapping[str, Any]], drawn: Draws) -> dict[str, Any]:
    """Compute how often the estimate or its first alternative is right. These figures are not comparable with Acc30.

    "one_of_two" is the number of estimates for which the solver cannot decide between the two; the figures whose names
    begin with it are percentages of these, None without any.
    """
    first = np.array([one["error"] for one in row.values()])
    either = np.array([min(one["error"], one.get("second_error", 180.0)) for one in row.values()])
    flagged = np.array([one.get("one_of_two", False) for one in row.values()], dtype=bool)
    return {
        "acc30": float(accuracy(either, 30)),
        "acc30_ci": list(statistics.bootstrap_ci(either, lambda errors, weights: accuracy(errors, 30, weights), drawn)),
        "one_of_two": int(flagged.sum()),
        "one_of_two_acc30": float(accuracy(either[flagged], 30)) if flagged.any() else None,
        "one_of_two_first_acc30": float(accuracy(first[flagged], 30)) if flagged.any() else None,  # of the estimate
    }


def category_of(key: str) -> str:
    """Return the category in a pair's key."""
    return key.split("/")[0]


def objects_of(key: str) -> tuple[str, str]:
    """Return the two objects in a pair's key, CATEGORY/SEQUENCE of the reference and of the target."""
    category, reference, target = key.split("/")
    return f"{category}/{reference.rpartition(':')[0]}", f"{category}/{target.rpartition(':')[0]}"


def draws_of_pairs(keys: Iterable[str]) -> Draws:
    """Draw bootstrap weights of the pairs with these keys, from resampled objects."""
    keys = list(keys)
    return object_draws([objects_of(key) for key in keys], [category_of(key) for key in keys])


def _ordered(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row's pairs by category and problem, the same order for all numbers of target views."""
    categories = list(dict.fromkeys(map(category_of, row)))
    return dict(sorted(row.items(), key=lambda item: (categories.index(category_of(item[0])), _problem(item[0]))))


def _problem(key: str) -> str:
    """A pair's key without its target frames."""
    return key.rpartition(":")[0]


def _saliency_iou(evaluations: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, float]:
    """Mean IoU of the frames' foregrounds, by category and over categories."""
    by_category: dict[str, dict[str, float]] = {}
    for key, found in evaluations.items():
        for one in found:
            by_category.setdefault(category_of(key), {}).update(one["saliency_iou"])
    means = {category: float(np.mean(list(frames.values()))) for category, frames in by_category.items() if frames}
    return means | {"mean": float(np.mean(list(means.values())))} if means else {}
