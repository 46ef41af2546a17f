"""Read finished and interrupted runs, export them to one small file, and pool several of them."""

import gzip
import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from zsp_lite.benchmark.database import SETTINGS, Records, read_records, read_settings
from zsp_lite.benchmark.summary import category_of, summarise_rows, summarise_run
from zsp_lite.errors import InputError
from zsp_lite.io.files import decompress, read_bytes, write_atomic

logger = logging.getLogger(__name__)

RESULTS = "results.json.gz"
_NEEDED = ("data", "backbone", "targets", "seed")  # of run.json, for the summary
_DECIMALS = 4  # of degrees and lengths in an export
_KEY = re.compile(r"[^/]+/[^/]+:\d+/[^/]+:\d+(,\d+)*")
_EXPORTED = (
    "error", "translation_error", "scale", "view", "inliers", "confidence", "failed", "note", "second_error",
    "one_of_two",
)  # fmt: skip

# Of each row in a summary.
_FIGURES = ("n", "median", "acc30", "acc15", "above150", "mean_category_median", "failed", "flagged")
_INTERVALS = ("median_ci", "acc30_ci", "acc15_ci", "mean_category_median_ci")


@dataclass(frozen=True)
class Results:
    """Results of a run.

    Attributes:
        summary: The content of summary.json.
        settings: What decided the results (see `database.check_settings`).
        invocations: Calls of `evaluate`.
        rows: By row and pair key, what the row found: "error" in degrees, and where it has them "translation_error",
            "scale", "view", "inliers", "confidence", "failed", "note", "second_error", "one_of_two".
    """

    summary: dict[str, Any]
    settings: dict[str, Any]
    invocations: list[dict[str, Any]]
    rows: dict[str, dict[str, dict[str, Any]]]

    def errors(self, row: str) -> dict[str, float]:
        """Return rotation errors in degrees by pair key. Raises InputError for an unknown row."""
        if row not in self.rows:
            raise InputError(f"row {row!r} is not in the run, expected one of {', '.join(self.rows)}")
        return {key: found["error"] for key, found in self.rows[row].items()}

    def confidences(self, row: str) -> dict[str, float]:
        """Return the estimated probabilities of an error below 30 degrees by pair key, where the row has them."""
        return {key: one["confidence"] for key, one in self.rows.get(row, {}).items() if "confidence" in one}


def results_of(settings: Mapping[str, Any], records: Records) -> Results:
    """Summarise the rows and categories of the last call of `evaluate`, as far as they are finished."""
    call = records.invocations[-1] if records.invocations else {"rows": [], "categories": []}
    place = {category: index for index, category in enumerate(call["categories"])}
    rows = {}
    for name in call["rows"]:
        found = records.rows.get(name, {})
        keys = sorted((place[category_of(key)], key) for key in found if category_of(key) in place)
        if keys:
            rows[name] = {key: found[key] for _, key in keys}
    if not rows:
        raise InputError(f"{settings['data']}: the run has no finished pair yet")
    _check_rows(rows, f"of {settings['data']}")
    data = {
        "root": settings["data"], "categories": call["categories"], "pairs": max(map(len, rows.values())),
        "targets": settings["targets"], "seed": settings["seed"],
    }  # fmt: skip
    # A backbone's fingerprint is its name and a hash.
    backbone = settings["backbone"].rpartition(" ")[0] or settings["backbone"]
    summary = summarise_run(rows, records.evaluations, data, backbone)
    return Results(summary, dict(settings), records.invocations, rows)


def read_results(path: str | Path) -> Results:
    """Read a run from its folder, also where it was interrupted, or from its exported `results.json.gz`.

    Raises:
        InputError: If it is neither, or no pair is finished.
    """
    path = Path(path)
    if path.is_dir():
        records, settings = read_records(path), read_settings(path)
        if missing := [name for name in _NEEDED if name not in settings]:
            raise InputError(f"{path / SETTINGS}: no {', '.join(missing)}, expected the settings of a run")
        return results_of(settings, records)
    try:
        content = json.loads(decompress(read_bytes(path, "results"), "data"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"results {path}: not a gzip file with JSON, or damaged ({error})") from error
    try:
        file = msgspec.convert(content, _File)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"results {path}: not a run's results ({error})") from error
    rows = {name: _row(name, columns, file.pairs, path) for name, columns in file.rows.items()}
    _check_rows(rows, str(path))
    _check_summary(file.summary, rows, path)
    return Results(file.summary, file.settings, file.invocations, rows)


def _row(name: str, columns: Mapping[str, list], keys: Sequence[str], path: Path) -> dict[str, dict[str, Any]]:
    """Convert the columns of a row to what it found for each pair."""
    indices = columns.get("pair", [])
    if {len(columns[part]) for part in _EXPORTED if part in columns} - {len(indices)} or not indices:
        raise InputError(f"results {path}: columns of row {name} differ in length, expected one entry per pair")
    known = all(isinstance(index, int) and 0 <= index < len(keys) for index in indices)
    if not known or len(set(indices)) < len(indices):
        raise InputError(f"results {path}: pairs of row {name} are not different ones from 0 to {len(keys) - 1}")
    parts = [part for part in _EXPORTED if part in columns]
    return {
        keys[index]: {part: columns[part][i] for part in parts if columns[part][i] is not None}
        for i, index in enumerate(indices)
    }


def _check_rows(rows: Mapping[str, Mapping[str, Mapping[str, Any]]], where: str) -> None:
    """Raise InputError if an error is not an angle from 0 to 180 degrees, or another value is out of range."""
    for name, row in rows.items():
        for key, found in row.items():
            if not _KEY.fullmatch(key):
                raise InputError(
                    f"results {where}: {key!r} is no key of a pair, expected CATEGORY/SEQUENCE:FRAME/SEQUENCE:FRAME,..."
                )
            for part, most in (("error", 180.0), ("second_error", 180.0), ("confidence", 1.0)):
                value = found.get(part, None if part == "error" else 0.0)
                if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value <= most:
                    raise InputError(f"results {where}: {part} of {name} on {key} is {value!r}, expected 0 to {most:g}")
            if not isinstance(flag := found.get("one_of_two", False), bool):
                raise InputError(f"results {where}: one_of_two of {name} on {key} is {flag!r}, expected true or false")


def _check_summary(summary: Mapping[str, Any], rows: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Raise InputError if the summary is of other rows than those of the file, or lacks what tables show."""
    try:
        methods, data = summary["methods"], summary["data"]
        fits = methods.keys() == rows.keys() and len(rows) > 0
        fits &= all(methods[name]["n"] == len(row) for name, row in rows.items())
        numbers = [float(one[figure]) for one in methods.values() for figure in _FIGURES]
        numbers += [float(end) for one in methods.values() for figure in _INTERVALS for end in one[figure]]
        numbers += [float(data["targets"]), float(data["pairs"])]
        numbers += [float(part["acc30"]) for one in methods.values() for part in one["per_category"].values()]
        fits &= bool(np.isfinite(numbers).all()) and isinstance(data["categories"], list)
        fits &= isinstance(summary["backbone"], str)
    except (KeyError, TypeError, ValueError, AttributeError):
        fits = False
    if not fits:
        raise InputError(f"results {path}: the summary is not that of the rows {', '.join(rows)} of the file")


class _File(msgspec.Struct):
    summary: dict[str, Any]
    settings: dict[str, Any]
    invocations: list[dict[str, Any]]
    pairs: list[str]
    rows: dict[str, dict[str, list[Any]]]


def read_runs(paths: Sequence[str | Path]) -> Results:
    """Read one run, or several to be pooled (see `pool`)."""
    runs = [read_results(path) for path in paths]
    return runs[0] if len(runs) == 1 else pool(runs)


def pool(runs: Sequence[Results]) -> Results:
    """Pool runs of one benchmark on different objects, such as folders of different seeds, into one.

    Rows that not all of the runs have are left out. Sequences of one category and name are one object.

    Returns:
        All pairs of the runs, summarised together. The summary has no timings.

    Raises:
        InputError: If the runs have no row in common, share a pair, or differ in the backbone, the number of target
            views or a row's settings.
    """
    names = [name for name in runs[0].rows if all(name in run.rows for run in runs)]
    if not names:
        raise InputError(f"runs to pool have no row in common: {'; '.join(', '.join(run.rows) for run in runs)}")
    if missing := sorted({name for run in runs for name in run.rows} - set(names)):
        logger.warning("not in all runs, left out: %s", ", ".join(missing))
    compared = {name: [run.settings.get(name) for run in runs] for name in ("backbone", "targets")}
    compared |= {f"row {name}": [run.settings.get("methods", {}).get(name) for run in runs] for name in names}
    for what, values in compared.items():
        if len(found := sorted(set(map(str, values)))) > 1:
            raise InputError(f"runs to pool differ in {what}: {', '.join(found)}")
    rows: dict[str, dict[str, dict]] = {}
    for name in names:
        rows[name] = {key: found for run in runs for key, found in run.rows[name].items()}
        if (total := sum(len(run.rows[name]) for run in runs)) > len(rows[name]):
            raise InputError(
                f"runs to pool share {total - len(rows[name])} pairs of row {name}, expected other objects"
            )
    data = {
        "root": ", ".join(str(run.summary["data"]["root"]) for run in runs),
        "categories": list(dict.fromkeys(category for run in runs for category in run.summary["data"]["categories"])),
        "pairs": sum(run.summary["data"]["pairs"] for run in runs),
        "targets": runs[0].summary["data"]["targets"],
        "runs": len(runs),
    }
    summary = {"data": data, "backbone": runs[0].summary["backbone"], **summarise_rows(rows)}
    return Results(summary, runs[0].settings, [one for run in runs for one in run.invocations], rows)


def export_results(results: Results, path: str | Path) -> Path:
    """Write a run to one compressed JSON file, rounded to four decimals; equal runs give equal bytes."""
    keys = list(dict.fromkeys(key for row in results.rows.values() for key in row))
    index = {key: i for i, key in enumerate(keys)}
    rows = {}
    for name, row in results.rows.items():
        columns: dict[str, list] = {"pair": [index[key] for key in row]}
        for part in _EXPORTED:
            # No column for parts that the row does not have; an empty note is none.
            column = [None if found.get(part) == "" else _rounded(found.get(part)) for found in row.values()]
            if any(value is not None for value in column):
                columns[part] = column
        rows[name] = columns
    content = {
        "summary": results.summary, "settings": results.settings, "invocations": results.invocations,
        "pairs": keys, "rows": rows,
    }  # fmt: skip
    write_atomic(path, gzip.compress(json.dumps(content, separators=(",", ":")).encode(), mtime=0))
    return Path(path)


def _rounded(value: Any) -> Any:
    return round(value, _DECIMALS) if isinstance(value, float) else value
