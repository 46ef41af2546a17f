"""Read finished and interrupted runs, export them to one small file, and pool several of them."""

import gzip
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from zsp_lite.benchmark.records import Records, checked_json, read_records, read_settings
from zsp_lite.benchmark.summary import category_of, summarise_rows, summarise_run
from zsp_lite.errors import InputError
from zsp_lite.io.files import decompress, read_bytes, write_atomic

logger = logging.getLogger(__name__)

RESULTS = "results.json.gz"
_DECIMALS = 4  # of degrees and lengths in an export
_EXPORTED = ("error", "translation_error", "scale", "view", "inliers", "confidence", "failed", "note")
_EXPORTED += ("second_error", "one_of_two")


@dataclass(frozen=True)
class Results:
    """Results of a run."""

    summary: dict[str, Any]  # the content of summary.json
    settings: dict[str, Any]  # what decided the results (see `records.merged_settings`)
    invocations: list[dict[str, Any]]  # calls of `evaluate`
    # By row and pair key, what the row found: "error" in degrees, and those of `_EXPORTED` that it has.
    rows: dict[str, dict[str, dict[str, Any]]]

    def errors(self, row: str) -> dict[str, float]:
        """Return rotation errors in degrees by pair key. Raises InputError for an unknown row."""
        if row not in self.rows:
            raise InputError(f"row {row!r} is not in the run, expected one of {', '.join(self.rows)}")
        return {key: found["error"] for key, found in self.rows[row].items()}

    def confidences(self, row: str) -> dict[str, float]:
        """Return the estimated probabilities of an error below 30 degrees by pair key, where the row has them."""
        return {key: one["confidence"] for key, one in self.rows.get(row, {}).items() if "confidence" in one}


# What figures and tables are made of, in what a row found for a pair, and in a summary.
_Key = Annotated[str, msgspec.Meta(pattern=r"^[^/]+/[^/]+:\d+/[^/]+:\d+(,\d+)*$")]
_Degrees = Annotated[float, msgspec.Meta(ge=0, le=180)]
_Interval = tuple[float, float]


class _Found(msgspec.Struct):
    error: _Degrees
    second_error: _Degrees = 0
    confidence: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0
    one_of_two: bool = False
    note: str = ""


_Rows = dict[str, dict[_Key, _Found]]


class _Figures(msgspec.Struct):
    n: int
    median: float
    acc30: float
    acc15: float
    above150: float
    median_ci: _Interval
    acc30_ci: _Interval
    acc15_ci: _Interval


class _BestTwo(msgspec.Struct):
    acc30: float
    acc30_ci: _Interval
    one_of_two: int
    one_of_two_acc30: float | None
    one_of_two_first_acc30: float | None


class _Test(msgspec.Struct):
    accuracy_gain: float
    accuracy_gain_ci: _Interval
    accuracy_gain_p: float
    sign_test_p: float


class _RowFigures(_Figures):
    mean_category_median: float
    mean_category_median_ci: _Interval
    failed: int
    flagged: int
    per_category: dict[str, _Figures]
    best_two: _BestTwo | None = None


class _Data(msgspec.Struct):
    root: str
    categories: list[str]
    pairs: int
    targets: int


class _Summary(msgspec.Struct):
    data: _Data
    backbone: str
    methods: dict[str, _RowFigures]
    against_ours: dict[str, _Test] = {}


class _File(msgspec.Struct):
    summary: _Summary
    settings: dict[str, Any]
    invocations: list[dict[str, Any]]
    pairs: list[str]
    rows: dict[str, dict[str, list[Any]]]  # by row, columns; the column "pair" holds indices into `pairs`


def read_results(path: str | Path) -> Results:
    """Read a run from its folder, also where it was interrupted, or from its exported `results.json.gz`.

    Raises:
        InputError: If it is neither, or no pair is finished.
    """
    path = Path(path)
    if path.is_dir():
        return results_of(read_settings(path), read_records(path))
    what = f"results {path}"
    content = checked_json(decompress(read_bytes(path, "results"), what), _File, what)
    summary, keys = content["summary"], content["pairs"]
    rows = {name: _row(columns, keys) for name, columns in content["rows"].items()}
    if not rows or {name: len(row) for name, row in rows.items()} != {n: r["n"] for n, r in summary["methods"].items()}:
        raise InputError(f"{what}: summary and rows do not fit, expected the rows {', '.join(rows)}, each pair once")
    return Results(summary, content["settings"], content["invocations"], checked_json(rows, _Rows, what))


def _row(columns: Mapping[str, list[Any]], pairs: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What a row found for each pair; empty where its columns do not fit the pairs or each other."""
    keys, parts = dict(enumerate(pairs)), [part for part in _EXPORTED if part in columns]
    try:
        return {
            keys[pair]: {part: value for part, value in zip(parts, values) if value is not None}
            for pair, *values in zip(columns["pair"], *(columns[part] for part in parts), strict=True)
        }
    except (KeyError, TypeError, ValueError):
        return {}


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
    checked_json(rows, _Rows, f"results of {settings['data']}")
    data = {"root": settings["data"], "categories": call["categories"], "pairs": max(map(len, rows.values()))}
    data |= {"targets": settings["targets"], "seed": settings["seed"]}
    # A backbone's fingerprint is its name and a hash.
    backbone = settings["backbone"].rpartition(" ")[0] or settings["backbone"]
    summary = summarise_run(rows, records.evaluations, data, backbone)
    return Results(summary, dict(settings), records.invocations, rows)


def read_runs(paths: Sequence[str | Path]) -> Results:
    """Read one run, or several to be pooled (see `pool`)."""
    runs = [read_results(path) for path in paths]
    return runs[0] if len(runs) == 1 else pool(runs)


def pool(runs: Sequence[Results]) -> Results:
    """Pool runs of one benchmark on different objects, such as folders of different seeds, into one without timings.

    Rows that not all of the runs have are left out. Sequences of one category and name are one object.

    Raises:
        InputError: If the runs share no row or share a pair, or differ in the backbone, the views or a row's settings.
    """
    names = [name for name in runs[0].rows if all(name in run.rows for run in runs)]
    if missing := sorted({name for run in runs for name in run.rows} - set(names)):
        logger.warning("not in all runs, left out: %s", ", ".join(missing))
    rows = {name: {key: found for run in runs for key, found in run.rows[name].items()} for name in names}
    if problem := _not_one_benchmark(runs, rows):
        raise InputError(f"runs to pool {problem}")
    parts = [run.summary["data"] for run in runs]
    data = {
        "root": ", ".join(one["root"] for one in parts),
        "categories": list(dict.fromkeys(category for one in parts for category in one["categories"])),
    }
    data |= {"pairs": sum(one["pairs"] for one in parts), "targets": parts[0]["targets"], "runs": len(runs)}
    summary = {"data": data, "backbone": runs[0].summary["backbone"], **summarise_rows(rows)}
    return Results(summary, runs[0].settings, [one for run in runs for one in run.invocations], rows)


def _not_one_benchmark(runs: Sequence[Results], rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Say why runs cannot be pooled; "" if they can."""
    if not rows:
        return f"have no row in common: {'; '.join(', '.join(run.rows) for run in runs)}"
    compared = {name: [run.settings.get(name) for run in runs] for name in ("backbone", "targets")}
    compared |= {f"row {name}": [run.settings.get("methods", {}).get(name) for run in runs] for name in rows}
    for what, values in compared.items():
        if len(found := sorted(set(map(str, values)))) > 1:
            return f"differ in {what}: {', '.join(found)}"
    for name, row in rows.items():
        if shared := sum(len(run.rows[name]) for run in runs) - len(row):
            return f"share {shared} pairs of row {name}, expected other objects"
    return ""


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
    content = {"summary": results.summary, "settings": results.settings, "invocations": results.invocations}
    content |= {"pairs": keys, "rows": rows}
    write_atomic(path, gzip.compress(json.dumps(content, separators=(",", ":")).encode(), mtime=0))
    return Path(path)


def _rounded(value: Any) -> Any:
    return round(value, _DECIMALS) if isinstance(value, float) else value
