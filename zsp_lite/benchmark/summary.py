"""What a run's records say: the figures of every row, over all pairs and by category (paper sec. 5.1)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from zsp_lite.data.pairs import Pair
from zsp_lite.metrics import median, paired_test, summarise

_RESAMPLES = 2000


def summarise_run(
    records: Mapping[str, dict], pairs: Mapping[str, Sequence[Pair]], data: Mapping[str, Any], backbone: str
) -> dict:
    """The summary of finished pairs: figures per row and category, saliency, and median seconds per stage.

    records: by the pairs' keys.  pairs: those of each row, in one order for all rows of as many target views.
    "median", "acc30" and "acc15" are over all pairs; "mean_category_median" is the paper's way of averaging
    medians. "against_ours": paired tests of "ours" against each other row. "saliency_iou": mean over the frames used.
    "cost": seconds of the whole run, and what "ours" by itself would have taken.
    """
    results = {name: [records[pair.key]["methods"][name] for pair in found] for name, found in pairs.items()}
    errors = {name: np.array([one["error"] for one in found]) for name, found in results.items()}
    rows = {}
    for name, found in results.items():
        category_of = np.array([pair.category for pair in pairs[name]])
        categories = list(dict.fromkeys(category_of.tolist()))
        grouped = [errors[name][category_of == category] for category in categories]
        per_category = {category: summarise(group) for category, group in zip(categories, grouped)}
        rows[name] = summarise(errors[name]) | {
            "mean_category_median": float(np.mean([row["median"] for row in per_category.values()])),
            "mean_category_median_ci": _mean_of_medians_ci(grouped),
            "failed": sum("failed" in one for one in found),
            "flagged": sum(one.get("note", "") != "" for one in found),
            "per_category": per_category,
        }
    used = [records[pair.key] for pair in dict.fromkeys(pair for found in pairs.values() for pair in found)]
    summary = {"data": dict(data), "backbone": backbone, "methods": rows, "saliency_iou": _saliency(used)}
    summary["timings"] = _timings(used, next(iter(results.values())))
    if "ours" in errors:
        ours = pairs["ours"]
        summary["against_ours"] = {
            name: paired_test(found, errors["ours"])
            for name, found in errors.items()
            if name != "ours" and same_problems(pairs[name], ours)
        }
    if cost := _cost(records, used, pairs):
        summary["cost"] = cost
    return summary


def same_problems(first: Sequence[Pair], second: Sequence[Pair]) -> bool:
    """Whether two lists of pairs ask for the same poses in the same order, if from different numbers of views."""
    return [_question(pair) for pair in first] == [_question(pair) for pair in second]


def _question(pair: Pair) -> tuple:
    return pair.category, pair.reference_sequence, pair.reference_frame, pair.target_sequence


def _mean_of_medians_ci(groups: Sequence[np.ndarray]) -> list[float]:
    """95 % bootstrap interval of the categories' mean median; pairs are drawn anew within each category."""
    rng = np.random.default_rng(0)
    drawn = [median(group[rng.integers(len(group), size=(_RESAMPLES, len(group)))]) for group in groups]
    return [float(bound) for bound in np.percentile(np.mean(drawn, axis=0), [2.5, 97.5])]


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
