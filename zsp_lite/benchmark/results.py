"""Read finished runs again, from a folder or from one small file to commit, and pool several of them."""

import gzip
import json
import logging
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zsp_lite.benchmark.storage import PAIRS, SETTINGS, read_invocations, read_records
from zsp_lite.benchmark.summary import INTERVALS, summarise_rows
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

logger = logging.getLogger(__name__)

RESULTS = "results.json.gz"
# Beyond these decimals an error in degrees, or a length, says nothing.
_DECIMALS = 4
_KEPT = ("error", "translation_error", "scale", "view", "inliers", "confidence", "failed", "note")


@dataclass(frozen=True)
class Results:
    """summary: what OUT/summary.json says.  settings, invocations: of the run.  rows: by name and pair key, what each
    row found: "error" in degrees, and where it has them "translation_error", "scale", "view", "inliers", "confidence".
    """

    summary: dict[str, Any]
    settings: dict[str, Any]
    invocations: list[dict[str, Any]]
    rows: dict[str, dict[str, dict[str, Any]]]

    def errors(self, row: str) -> dict[str, float]:
        """Rotation errors in degrees by pair key. Raises InputError for a row that the run has not."""
        if row not in self.rows:
            raise InputError(f"row {row!r} is not in the run, expected one of {', '.join(self.rows)}")
        return {key: found["error"] for key, found in self.rows[row].items()}

    def confidences(self, row: str) -> dict[str, float]:
        """What the row's method thinks its chances are to be within 30 degrees, by pair key, where it says so."""
        return {key: one["confidence"] for key, one in self.rows.get(row, {}).items() if "confidence" in one}


def read_results(path: str | Path) -> Results:
    """A run's folder or its `results.json.gz`. Raises InputError where it is neither, or has not been summed up yet."""
    path = Path(path)
    if path.is_dir():
        if not (path / "summary.json").is_file():
            raise InputError(f"{path} holds no summary.json; run the benchmark to its end first")
        summary = _decode(read_bytes(path / "summary.json", "summary"), path / "summary.json")
        settings = _decode(read_bytes(path / SETTINGS, "settings"), path / SETTINGS)
        # What the summary is of: earlier calls may have left other rows, and other categories, in the folder.
        try:
            asked, categories = summary["methods"], summary["data"]["categories"]
        except (KeyError, TypeError) as error:
            raise InputError(f"{path / 'summary.json'}: not a run's summary ({error})") from error
        rows: dict[str, dict[str, dict]] = {}
        for key, record in read_records(path / PAIRS, mend=False).items():
            for name, found in record["methods"].items():
                if name in asked and record["category"] in categories:
                    rows.setdefault(name, {})[key] = {part: found[part] for part in _KEPT if found.get(part, "") != ""}
        return Results(_with_object_intervals(summary, rows), settings, read_invocations(path), rows)
    content = _decode(_inflate(read_bytes(path, "results"), path), path)
    try:
        keys = content["pairs"]
        rows = {
            name: {
                keys[index]: {part: row[part][i] for part in _KEPT if row.get(part) and row[part][i] is not None}
                for i, index in enumerate(row["pair"])
            }
            for name, row in content["rows"].items()
        }
        return Results(
            _with_object_intervals(content["summary"], rows), content["settings"], content["invocations"], rows
        )
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise InputError(f"results {path}: not a run's results ({error})") from error


def read_runs(paths: Sequence[str | Path]) -> Results:
    """Read one run, or several to be pooled (see `pool`)."""
    runs = [read_results(path) for path in paths]
    return runs[0] if len(runs) == 1 else pool(runs)


def pool(runs: Sequence[Results]) -> Results:
    """Pool runs of one benchmark on different objects, such as exports with different seeds, into one.

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
    for what in ("backbone", "targets", *(("methods", name) for name in names)):
        found = {str(_setting(run, what)) for run in runs}
        if len(found) > 1:
            label = what if isinstance(what, str) else f"row {what[1]}"
            raise InputError(f"runs to pool differ in {label}: {', '.join(sorted(found))}")
    rows: dict[str, dict[str, dict]] = {}
    for name in names:
        rows[name] = {key: found for run in runs for key, found in run.rows[name].items()}
        if (total := sum(len(run.rows[name]) for run in runs)) > len(rows[name]):
            raise InputError(
                f"runs to pool share {total - len(rows[name])} pairs of row {name}, expected other objects"
            )
    categories = list(dict.fromkeys(category for run in runs for category in run.summary["data"]["categories"]))
    data = {
        "root": ", ".join(str(run.summary["data"]["root"]) for run in runs),
        "categories": categories,
        "pairs": sum(run.summary["data"]["pairs"] for run in runs),
        "targets": runs[0].summary["data"]["targets"],
        "runs": len(runs),
    }
    summary = {"data": data, "backbone": runs[0].summary["backbone"], **summarise_rows(rows)}
    for name, row in summary["methods"].items():
        row |= {part: sum(run.summary["methods"][name][part] for run in runs) for part in ("failed", "flagged")}
    return Results(summary, runs[0].settings, [one for run in runs for one in run.invocations], rows)


def _setting(run: Results, what: str | tuple[str, str]) -> Any:
    if isinstance(what, str):
        return run.settings.get(what)
    group, name = what
    return run.settings.get(group, {}).get(name)


def _with_object_intervals(summary: Mapping[str, Any], rows: Mapping[str, Mapping[str, dict]]) -> dict[str, Any]:
    """The summary; one of an earlier version, which took pairs for independent, with its intervals computed again."""
    if summary.get("intervals") == INTERVALS or not summary.get("methods"):
        return dict(summary)
    fresh = summarise_rows({name: rows[name] for name in summary["methods"]})
    for name, row in fresh["methods"].items():  # earlier versions did not keep these by pair
        row |= {part: summary["methods"][name][part] for part in ("failed", "flagged")}
    return {**summary, **fresh}


def write_results(results: Results, path: str | Path) -> Path:
    """Write a run into one file, rounded to what means something; the same run gives the same bytes."""
    keys = list(dict.fromkeys(key for row in results.rows.values() for key in row))
    index = {key: i for i, key in enumerate(keys)}
    rows = {}
    for name, row in results.rows.items():
        columns: dict[str, list] = {"pair": [index[key] for key in row]}
        for part in _KEPT:
            column = [_rounded(found.get(part)) for found in row.values()]
            if any(value is not None for value in column):
                columns[part] = column
        rows[name] = columns
    content = {
        "summary": results.summary, "settings": results.settings, "invocations": results.invocations,
        "pairs": keys, "rows": rows,
    }  # fmt: skip
    data = json.dumps(content, separators=(",", ":")).encode()
    write_atomic(path, gzip.compress(data, mtime=0))
    return Path(path)


def _rounded(value: Any) -> Any:
    return round(value, _DECIMALS) if isinstance(value, float) else value


def _inflate(data: bytes, path: Path) -> bytes:
    try:
        return gzip.decompress(data)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"results {path}: not a gzip file, or cut off ({error})") from error


def _decode(data: bytes, path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(data)
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds a {type(content).__name__}, expected an object")
    return content
