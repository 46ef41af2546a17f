"""A run's folder: settings in run.json, results in an SQLite database. A process killed at any moment loses no commit.

Tables of run.sqlite; the last column of each holds JSON:

    results      what a row found for a pair; primary key (pair, row)
    evaluations  what each evaluation of a pair cost, and the IoU of its foregrounds with the masks
    invocations  each call of `evaluate`: command, versions, machine, rows, categories, seconds

The process that started the run is the only one that writes. It holds SQLite's exclusive lock on the empty database
run.lock, which the operating system releases when the process ends. Other processes can read run.sqlite meanwhile.
"""

import json
import os
import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zsp_lite.errors import InputError
from zsp_lite.io.files import make_folder, read_bytes, write_atomic

SETTINGS, DATABASE, LOCK = "run.json", "run.sqlite", "run.lock"
_TIMEOUT = 60  # seconds to wait for the end of a read or of a transaction
_TABLES = (
    "CREATE TABLE IF NOT EXISTS invocations (id INTEGER PRIMARY KEY, facts TEXT)",
    "CREATE TABLE IF NOT EXISTS results"
    " (pair TEXT, row TEXT, invocation INTEGER, result TEXT, PRIMARY KEY (pair, row))",
    "CREATE TABLE IF NOT EXISTS evaluations (pair TEXT, invocation INTEGER, cost TEXT)",
)
# Parts of the settings that a later call may extend, and what to do where a known entry differs.
_GROWING = {
    "methods": "the method has changed since; choose another folder or another name",
    "labels": "the pose label has changed since; choose another folder",
}


@dataclass(frozen=True)
class Records:
    """Contents of a run's database.

    Attributes:
        rows: By row and pair key, what the row found.
        evaluations: By pair key, {"seconds", "timings", "saliency_iou"} of every evaluation (see `evaluate_pair`).
        invocations: Calls of `evaluate`, the latest last.
    """

    rows: dict[str, dict[str, dict[str, Any]]]
    evaluations: dict[str, list[dict[str, Any]]]
    invocations: list[dict[str, Any]]


class RunFolder:
    """A run's folder, open for writing; a context manager."""

    def __init__(self, out: str | Path, settings: Mapping[str, Any], allow_other_version: bool = False):
        self._out = out = make_folder(out, "folder of the run")
        check_settings(out, settings, allow_other_version)  # a refused folder gets no lock and no database
        try:
            with ExitStack() as opened:
                lock = opened.enter_context(closing(sqlite3.connect(out / LOCK, timeout=0.5)))
                lock.execute("BEGIN EXCLUSIVE")
                merged = check_settings(out, settings, allow_other_version)
                write_atomic(out / SETTINGS, json.dumps(merged, indent=1).encode())
                self._database = opened.enter_context(closing(sqlite3.connect(out / DATABASE, timeout=_TIMEOUT)))
                with self._database:
                    for table in _TABLES:
                        self._database.execute(table)
                self._opened = opened.pop_all()
        except sqlite3.Error as error:
            raise _unusable(out, error) from error
        self._invocation: int | None = None

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(self, *_) -> None:
        self._opened.close()

    def begin(self, facts: Mapping[str, Any]) -> None:
        """Record a call of `evaluate`; the results that follow are its own."""
        with self._database:
            insert = "INSERT INTO invocations (facts) VALUES (?)"
            self._invocation = self._database.execute(insert, [json.dumps(facts)]).lastrowid

    def finish(self, seconds: float) -> None:
        """Record how long the call took."""
        with self._database:
            update = "UPDATE invocations SET facts = json_set(facts, '$.seconds', ?) WHERE id = ?"
            self._database.execute(update, [seconds, self._invocation])

    def add(self, records: Iterable[Mapping[str, Any]]) -> None:
        """Store evaluated pairs (see `evaluate_pair`) in one transaction."""
        try:
            self._add(records)
        except sqlite3.OperationalError as error:
            raise InputError(f"{self._out / DATABASE} cannot be written: {error}") from error

    def _add(self, records: Iterable[Mapping[str, Any]]) -> None:
        with self._database:
            for record in records:
                cost = {name: record[name] for name in ("seconds", "timings", "saliency_iou")}
                self._database.execute(
                    "INSERT INTO evaluations VALUES (?, ?, ?)", (record["pair"], self._invocation, json.dumps(cost))
                )
                self._database.executemany(
                    "INSERT INTO results VALUES (?, ?, ?, ?)",
                    [(record["pair"], row, self._invocation, json.dumps(found))
                     for row, found in record["results"].items()],
                )  # fmt: skip

    def finished(self) -> set[tuple[str, str]]:
        """Return the (pair, row) of all results."""
        return _finished(self._database)

    def read(self) -> Records:
        """Return all records."""
        return _read(self._database)


def read_records(out: str | Path) -> Records:
    """Read the records of a run's folder, finished or interrupted."""
    return _query(Path(out), _read)


def finished_results(out: str | Path) -> set[tuple[str, str]]:
    """Return the (pair, row) of all results in a folder; none where it holds no run."""
    return _query(Path(out), _finished) if (Path(out) / DATABASE).is_file() else set()


def read_settings(out: str | Path) -> dict[str, Any]:
    """Read run.json."""
    path = Path(out) / SETTINGS
    try:
        settings = json.loads(read_bytes(path, "settings"))
        if not isinstance(settings, dict):
            raise ValueError("no object")
    except ValueError as error:
        raise InputError(f"{path}: not the settings of a run ({error}); choose another folder") from error
    return settings


def check_settings(out: str | Path, settings: Mapping[str, Any], allow_other_version: bool = False) -> dict[str, Any]:
    """Check that a run can be continued with these settings, and merge them with its own. Writes nothing.

    Returns:
        The settings to write, with all rows, labels and library versions of the run.
    """
    out = Path(out)
    if not os.path.lexists(out / SETTINGS):  # a pipe or a broken link is no new run
        if finished_results(out):
            raise InputError(f"{out} holds results in {DATABASE} without {SETTINGS}; choose another folder")
        return dict(settings) | {"library": [settings["library"]]}
    before = read_settings(out)
    if "library" not in before:
        raise InputError(f"{out / SETTINGS}: no library, expected the settings of a run; choose another folder")
    for key, value in settings.items():
        if key not in (*_GROWING, "library") and before.get(key) != value:
            raise InputError(f"{out} holds a run with other settings ({key}); choose another folder")
    merged = dict(settings)
    for group, remedy in _GROWING.items():
        known, wanted = before.get(group, {}), settings.get(group, {})
        if changed := sorted(name for name, value in wanted.items() if known.get(name, value) != value):
            raise InputError(f"{out} holds other results of {', '.join(changed)}: {remedy}")
        merged[group] = known | wanted
    merged["library"] = list(before["library"])
    if settings["library"] not in merged["library"]:
        if not allow_other_version:
            raise InputError(
                f"{out} was measured with zsp-lite {_version(merged['library'][-1])}, this is "
                f"{_version(settings['library'])}; choose another folder, or continue with --allow-other-version"
            )
        merged["library"].append(settings["library"])
    return merged


def _version(library: Mapping[str, str | None]) -> str:
    return f"{library['version']} ({library['revision'] or 'no git revision'})"


def _query(out: Path, read: Any) -> Any:
    if not (out / DATABASE).is_file():
        raise InputError(f"{out} holds no benchmark run")
    try:
        # Not read-only: after a crash, SQLite first has to roll back the unfinished transaction.
        with closing(sqlite3.connect(out / DATABASE, timeout=_TIMEOUT)) as database:
            database.execute("BEGIN")  # all queries see one state of a run that goes on
            return read(database)
    except (sqlite3.Error, ValueError) as error:
        raise _unusable(out, error) from error


def _finished(database: sqlite3.Connection) -> set[tuple[str, str]]:
    return set(database.execute("SELECT pair, row FROM results"))


def _read(database: sqlite3.Connection) -> Records:
    rows: dict[str, dict[str, dict]] = {}
    for pair, row, result in database.execute("SELECT pair, row, result FROM results ORDER BY rowid"):
        rows.setdefault(row, {})[pair] = json.loads(result)
    evaluations: dict[str, list[dict]] = {}
    for pair, cost in database.execute("SELECT pair, cost FROM evaluations ORDER BY rowid"):
        evaluations.setdefault(pair, []).append(json.loads(cost))
    invocations = [json.loads(facts) for (facts,) in database.execute("SELECT facts FROM invocations ORDER BY id")]
    return Records(rows, evaluations, invocations)


def _unusable(out: Path, error: Exception) -> InputError:
    if "locked" in str(error):
        return InputError(f"{out}: another run is writing to it; wait for it or choose another folder")
    if "unable to open" in str(error):
        return InputError(f"{out / DATABASE} cannot be opened for writing; choose another folder")
    return InputError(f"{out / DATABASE}: not the database of a run, or damaged ({error})")
