"""Figures of a run: every row over all pairs and by category (paper sec. 5.1), with intervals over objects."""

from typing import Any

import numpy as np
import pandas as pd

from zsp_lite.benchmark import statistics
from zsp_lite.benchmark.statistics import Draws, object_draws
from zsp_lite.metrics import accuracy

REFERENCE = "ours"  # the row that all others are compared with


def summarise(table: pd.DataFrame) -> dict[str, Any]:
    """Summarise the results of a run (see `runs.Run`).

    "methods" has by row, over all pairs and "per_category", what `statistics.figures_of` returns, and where they are
    known "symmetric_acc30" and the medians "translation" and "scale" of the pairs that have them. "against" has the
    `statistics.paired_difference` of each row of the same problems to "ours". All draws resample objects.
    """
    rows = {str(name): row for name, row in table.groupby("row", sort=False)}
    draws: dict[tuple, Draws] = {}  # rows with the same objects share them
    methods = {}
    for name, row in rows.items():
        objects = (*row["reference"], *row["target"])
        if objects not in draws:
            draws[objects] = draws_of(row)
        errors, drawn, categories = row["error"].to_numpy(), draws[objects], row["category"].to_numpy(str)
        methods[name] = statistics.figures_of(errors, drawn, categories) | {
            "failed": int((row["failed"] != "").sum()),
            "per_category": {
                category: statistics.figures_of(errors[members], drawn[:, members])
                for category in dict.fromkeys(categories) for members in [categories == category]
            },
        }  # fmt: skip
        for part in ("translation", "scale"):
            if row[part].notna().any():
                methods[name][part] = float(row[part].median())
        if row["symmetric_error"].notna().any():
            known = row["symmetric_error"].fillna(row["error"]).to_numpy(np.float64)
            methods[name]["symmetric_acc30"] = float(accuracy(known, 30))
    if REFERENCE not in rows:
        return {"methods": methods}
    ours = rows[REFERENCE]
    drawn = draws[(*ours["reference"], *ours["target"])]
    against = {
        name: statistics.paired_difference(ours["error"], row["error"], weights=drawn)
        for name, row in rows.items() if name != REFERENCE and row["problem"].tolist() == ours["problem"].tolist()
    }  # fmt: skip
    return {"methods": methods, "against": against}


def draws_of(row: pd.DataFrame) -> Draws:
    """Draw bootstrap weights of a row's pairs from resampled objects."""
    return object_draws(row[["reference", "target"]].to_numpy(), row["category"].to_numpy())
