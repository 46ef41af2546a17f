"""A run's folder: its settings in run.json, its results in run.jsonl, whose lines are only ever added.

A line of run.jsonl is one of

    {"call": command, versions, machine, rows and categories of a call of `evaluate`}
    what `evaluate_pair` returns for a pair
    {"seconds": what the last call took}

One process writes to a folder; others can read it meanwhile. A killed process loses only the line it was writing.
"""

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec

from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic
from zsp_lite.io.locks import writing

SETTINGS, RECORDS = "run.json", "run.jsonl"
_GROWING = {"methods": "method", "labels": "pose label"}  # parts of the settings that a later call may extend


@dataclass(frozen=True)
class Records:
    """Lines of a run, by what they are about."""

    rows: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)  # by row and pair key, what the row found
    # By pair key, what each evaluation cost: "seconds", "timings", "saliency_iou" (see `evaluate_pair`).
    evaluations: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    invocations: list[dict[str, Any]] = field(default_factory=list)  # calls of `evaluate`, the latest last


class _Line(msgspec.Struct):
    """A line of run.jsonl; `checked_json` keeps what else it holds."""

    call: dict[str, Any] = {}
    pair: str = ""
    results: dict[str, dict[str, Any]] = {}
    seconds: float = 0.0
    timings: dict[str, list[float]] = {}
    saliency_iou: dict[str, float] = {}


class _Settings(msgspec.Struct):
    """What every run.json has."""

    data: str
    backbone: str
    targets: int
    seed: int
    library: Annotated[list[dict[str, str | None]], msgspec.Meta(min_length=1)]
    methods: dict[str, str] = {}
    labels: dict[str, str] = {}


@contextmanager
def open_run(out: str | Path, settings: Mapping[str, Any], allow_other_version: bool = False) -> Iterator[None]:
    """Be the only writer of a run's folder, which is new or holds a run with these settings; then `add_lines` adds."""
    with writing(out):
        out = Path(out)
        merged, records = merged_settings(out, settings, allow_other_version), out / RECORDS
        if records.exists():
            complete = read_bytes(records, "results of a run").rfind(b"\n") + 1
            os.truncate(records, complete)  # the rest is a line that a killed process was writing
        write_atomic(out / SETTINGS, json.dumps(merged, indent=1).encode())
        add_lines(out, [])  # make the file
        yield


def add_lines(out: str | Path, lines: Iterable[Mapping[str, Any]]) -> None:
    """Add lines to run.jsonl."""
    text = "".join(f"{json.dumps(line, separators=(',', ':'))}\n" for line in lines)
    try:
        with open(Path(out) / RECORDS, "ab") as file:
            file.write(text.encode())
    except OSError as error:
        raise InputError(f"{Path(out) / RECORDS} cannot be written: {error}") from error


def checked_json(data: bytes | Any, kind: Any, what: str) -> Any:
    """Check that JSON that Python wrote (with NaN), or its content, is of a `kind`; else InputError(`what`: ...)."""
    try:
        content = json.loads(data) if isinstance(data, bytes) else data
        msgspec.convert(content, kind)
        return content
    except (ValueError, RecursionError, msgspec.ValidationError) as error:
        raise InputError(f"{what}: {error}") from error


def read_records(out: str | Path) -> Records:
    """Read what a run has found, finished or interrupted."""
    path, found = Path(out) / RECORDS, Records()
    for number, text in enumerate(read_bytes(path, "results of a run").split(b"\n")[:-1], 1):
        line = checked_json(text, _Line, f"results of a run {path}, line {number}")
        if "call" in line:
            found.invocations.append(line["call"])
        elif "pair" in line:
            for row, result in line.pop("results", {}).items():
                found.rows.setdefault(row, {})[line["pair"]] = result
            found.evaluations.setdefault(line["pair"], []).append({"timings": {}, "saliency_iou": {}} | line)
        elif found.invocations:
            found.invocations[-1] |= line
    return found


def read_settings(out: str | Path) -> dict[str, Any]:
    """Read run.json."""
    path = Path(out) / SETTINGS
    return checked_json(read_bytes(path, "settings of a run"), _Settings, f"settings of a run {path}")


def merged_settings(out: str | Path, settings: Mapping[str, Any], allow_other_version: bool) -> dict[str, Any]:
    """Return the settings to write: with all rows, labels and library versions of the run that the folder holds."""
    out, library = Path(out), settings["library"]
    if not os.path.lexists(out / SETTINGS):  # a broken link is no new run
        if (out / RECORDS).exists():
            raise InputError(f"{out} holds results in {RECORDS} without {SETTINGS}; choose another folder")
        return dict(settings) | {"library": [library]}
    before = read_settings(out)
    if problem := _cannot_continue(before, settings, allow_other_version):
        raise InputError(f"{out} {problem}")
    grown = {group: before.get(group, {}) | settings.get(group, {}) for group in _GROWING}
    versions = before["library"] + [library] * (library not in before["library"])
    return dict(settings) | grown | {"library": versions}


def _cannot_continue(before: Mapping[str, Any], settings: Mapping[str, Any], allow_other_version: bool) -> str:
    """Say what keeps a run from being continued; "" for nothing."""
    for key, value in settings.items():
        if key not in (*_GROWING, "library") and before.get(key) != value:
            return f"holds a run with other settings ({key}); choose another folder"
    for group, what in _GROWING.items():
        known, wanted = before.get(group, {}), settings.get(group, {})
        if changed := sorted(name for name, value in wanted.items() if known.get(name, value) != value):
            names = ", ".join(changed)
            return f"holds other results of {names}: the {what} has changed since; choose another folder"
    if settings["library"] in before["library"] or allow_other_version:
        return ""
    versions = before["library"][-1], settings["library"]
    older, this = (f"zsp-lite {one.get('version')} (source {one.get('source')})" for one in versions)
    other = "choose another folder, or continue with --allow-other-version"
    return f"was measured with {older}, this is {this}; {other}"
