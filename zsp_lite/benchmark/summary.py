"""Figures of a run: every row over all pairs and by category (paper sec. 5.1), with intervals over objects."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from zsp_lite.data.pairs import Pair
from zsp_lite.metrics import (
    mean_category_median,
    median,
    object_weights,
    paired_difference,
    sign_test,
    summarise,
)

# What the intervals of a summary are of; summaries of earlier versions have no such member, or another one.
INTERVALS = {"level": 0.95, "resampled": "objects"}


def summarise_run(
    records: Mapping[str, dict], pairs: Mapping[str, Sequence[Pair]], data: Mapping[str, Any], backbone: str
) -> dict:
    """Summarise finished pairs: figures per row and category, saliency, and median seconds per stage.

    Args:
        records: By the pairs' keys.
        pairs: The pairs of each row, in one order for all rows of as many target views.
        data: What the run was of.
        backbone: Its name.

    Returns:
        {"methods": see `summarise_rows`, "against_ours": see `against_ours`, "saliency_iou": mean over the frames used,
        "timings": median seconds, "cost": seconds of the whole run, and of "ours" by itself}.
    """
    results = {name: {pair.key: records[pair.key]["methods"][name] for pair in found} for name, found in pairs.items()}
    used = [records[pair.key] for pair in dict.fromkeys(pair for found in pairs.values() for pair in found)]
    summary = {"data": dict(data), "backbone": backbone, **summarise_rows(results), "saliency_iou": _saliency(used)}
    summary["timings"] = _timings(used, list(next(iter(results.values())).values()))
    if cost := _cost(records, used, pairs):
        summary["cost"] = cost
    return summary


def summarise_rows(rows: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Summarise the errors of rows.

    Args:
        rows: By row and pair key, {"error": degrees, "failed": present where the row failed, "note": not "" where the
            method flagged its estimate}.

    Returns:
        {"methods": by row, over all pairs and "per_category", the figures of `metrics.summarise`, and
        "mean_category_median": the paper's way of averaging medians; "against_ours": every other row that has the same
        problems in the same order against "ours", see `metrics.paired_difference`; "intervals": what they are of}.
        Intervals and p values come from resampled objects, except for "sign_test_p".
    """
    rows = {name: _ordered(row) for name, row in rows.items()}
    weights: dict[tuple, np.ndarray] = {}
    methods, errors = {}, {}
    for name, row in rows.items():
        errors[name] = np.array([one["error"] for one in row.values()])
        objects = tuple(map(objects_of, row))
        if objects not in weights:
            weights[objects] = weights_of_pairs(row)
        drawn, categories = weights[objects], np.array([category_of(key) for key in row])
        average, interval = mean_category_median(errors[name], categories, drawn)
        methods[name] = summarise(errors[name], drawn) | {
            "mean_category_median": average,
            "mean_category_median_ci": list(interval),
            "failed": sum("failed" in one for one in row.values()),
            "flagged": sum(one.get("note", "") != "" for one in row.values()),
            "per_category": {
                category: summarise(errors[name][members], drawn[:, members])
                for category in dict.fromkeys(categories.tolist())
                for members in [categories == category]
            },
        }
    summary: dict[str, Any] = {"methods": methods, "intervals": dict(INTERVALS)}
    if "ours" in rows:
        problems, drawn = list(map(_problem, rows["ours"])), weights_of_pairs(rows["ours"])
        summary["against_ours"] = {
            name: paired_difference(found, errors["ours"], weights=drawn)
            | {"sign_test_p": sign_test(found < 30, errors["ours"] < 30)}
            for name, found in errors.items()
            if name != "ours" and list(map(_problem, rows[name])) == problems
        }
    return summary


def category_of(key: str) -> str:
    """The category that a pair's key names."""
    return key.split("/")[0]


def objects_of(key: str) -> tuple[str, str]:
    """The two objects, CATEGORY/SEQUENCE of the reference and of the target, that a pair's key names."""
    category, reference, target = key.split("/")
    return f"{category}/{reference.rpartition(':')[0]}", f"{category}/{target.rpartition(':')[0]}"


def weights_of_pairs(keys: Iterable[str]) -> Float[np.ndarray, "resamples n"]:
    """Bootstrap weights of the pairs with these keys, from resampled objects."""
    keys = list(keys)
    return object_weights([objects_of(key) for key in keys], [category_of(key) for key in keys])


def _ordered(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row's pairs by category and problem, the same order for all numbers of target views."""
    categories = list(dict.fromkeys(map(category_of, row)))
    return dict(sorted(row.items(), key=lambda item: (categories.index(category_of(item[0])), _problem(item[0]))))


def _problem(key: str) -> str:
    """A pair's key without its target frames."""
    return key.rpartition(":")[0]


def _saliency(records: Sequence[dict]) -> dict[str, float]:
    by_category: dict[str, dict[str, float]] = {}
    for record in records:
        by_category.setdefault(record["category"], {}).update(record["saliency_iou"])
    saliency = {category: float(np.mean(list(frames.values()))) for category, frames in by_category.items() if frames}
    return saliency | {"mean": float(np.mean(list(saliency.values())))} if saliency else {}


def _timings(records: Sequence[dict], first: Sequence[dict]) -> dict[str, float]:
    """Median seconds of each stage of the first row, of describing a frame, and of comparing two."""
    timed = [one["timings"] for one in first if "timings" in one]
    stages = [stage for stage in (timed[0] if timed else ()) if all(stage in timing for timing in timed)]
    timings = {stage: float(median([timing[stage] for timing in timed])) for stage in stages}
    frame_seconds = [record["seconds_per_frame"] for record in records if record.get("seconds_per_frame")]
    if frame_seconds:
        timings["features_per_frame"] = float(median(frame_seconds))
    for name in ("reading", "similarity"):
        if (each := _seconds_each(records, name)) is not None:
            timings[f"{name}_each"] = each
    return timings


def _cost(records: Mapping[str, dict], used: Sequence[dict], pairs: Mapping[str, Sequence[Pair]]) -> dict[str, float]:
    """Seconds of work in all rows, and of "ours" alone, from what reading, describing, comparing and it have cost."""
    whole = sum(record.get("seconds", 0.0) for record in used)
    each = {name: _seconds_each(used, name) for name in ("reading", "backbone", "similarity")}
    if "ours" not in pairs or whole == 0 or None in each.values():
        return {}
    ours = [records[pair.key]["methods"]["ours"] for pair in pairs["ours"]]
    frames = {
        (pair.category, *key)
        for pair in pairs["ours"]
        for key in [
            (pair.reference_sequence, pair.reference_frame),
            *((pair.target_sequence, number) for number in pair.target_frames),
        ]
    }
    views = sum(len(pair.target_frames) for pair in pairs["ours"])
    alone = len(frames) * (each["reading"] + each["backbone"]) + views * each["similarity"]
    alone += sum(sum(one.get("timings", {}).values()) for one in ours)
    return {"all_rows": round(whole, 3), "ours_alone": round(alone, 3), "ratio": round(whole / alone, 3)}


def _seconds_each(records: Sequence[dict], name: str) -> float | None:
    spent = [record["spent"][name] for record in records if name in record.get("spent", {})]
    times = sum(one[0] for one in spent)
    return sum(one[1] for one in spent) / times if times else None
