"""A finished run to read again, from its folder or from one small file that can be kept, sent and committed."""

import gzip
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zsp_lite.benchmark.storage import PAIRS, SETTINGS, read_invocations, read_records
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

RESULTS = "results.json.gz"
# Beyond these decimals an error in degrees, or a length, says nothing.
_DECIMALS = 4
_KEPT = ("error", "translation_error", "scale", "view", "inliers", "confidence")


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
                    rows.setdefault(name, {})[key] = {part: found[part] for part in _KEPT if part in found}
        return Results(summary, settings, read_invocations(path), rows)
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
        return Results(content["summary"], content["settings"], content["invocations"], rows)
    except (KeyError, TypeError, IndexError, AttributeError) as error:
        raise InputError(f"results {path}: not a run's results ({error})") from error


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
