"""A run: its folder, to which lines are only ever added, and what it found as one table.

run.json holds the settings. A line of run.jsonl is one of

    {"call": command, versions, machine, rows, categories and pairs of a call of `evaluate`}
    what `evaluate_pair` returns for a pair
    {"seconds": what the last call took}

One process writes to a folder; others can read it meanwhile. A killed process loses only the line it was writing.
`results.jsonl.gz` is a whole run in one file: the settings, then the lines without what only concerns their cost.
"""

import gzip
import json
import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import msgspec
import pandas as pd

from zsp_lite.benchmark.summary import summarise
from zsp_lite.errors import InputError
from zsp_lite.io.files import decompress, read_bytes, write_atomic
from zsp_lite.io.locks import writing

logger = logging.getLogger(__name__)

SETTINGS, LINES, EXPORT = "run.json", "run.jsonl", "results.jsonl.gz"
# Parts of the settings that a later call may extend; "origins" are those of the pairs.
_GROWING = {"methods": "method", "labels": "pose label", "origins": "evaluation set"}
_DECIMALS = 4  # of degrees and lengths in an export
_Degrees = Annotated[float, msgspec.Meta(ge=0, le=180)]
_Key = Annotated[str, msgspec.Meta(pattern=r"^[^/]+/[^/]+:\d+/[^/]+:\d+(,\d+)*$")]


class _Found(msgspec.Struct):
    """What a row found for a pair, as `evaluate_pair` describes it; other members are not part of the table."""

    error: _Degrees
    second_error: _Degrees | None = None
    one_of_two: bool | None = None
    confidence: Annotated[float, msgspec.Meta(ge=0, le=1)] | None = None
    symmetric_error: _Degrees | None = None
    translation: float | None = None
    scale: float | None = None
    view: int | None = None
    inliers: int | None = None
    note: str = ""
    failed: str = ""


class _Call(msgspec.Struct):
    rows: list[str]
    categories: list[str]


class _Line(msgspec.Struct):
    call: _Call | msgspec.UnsetType = msgspec.UNSET
    pair: _Key | msgspec.UnsetType = msgspec.UNSET
    results: dict[str, _Found] | msgspec.UnsetType = msgspec.UNSET
    seconds: float = 0.0
    timings: dict[str, list[float]] = {}
    saliency_iou: dict[str, float] = {}

    def __post_init__(self):
        if (self.pair is msgspec.UNSET) != (self.results is msgspec.UNSET):
            raise ValueError("a pair without results, or results without a pair")


class _Settings(msgspec.Struct):
    data: str
    backbone: str
    targets: int
    library: Annotated[list[dict[str, str | None]], msgspec.Meta(min_length=1)]
    methods: dict[str, str] = {}
    labels: dict[str, str] = {}
    origins: dict[str, str] = {}


@dataclass(frozen=True, eq=False)
class Run:
    """Results of the rows and categories of the last call, as far as they are finished."""

    settings: dict[str, Any]  # what decided the results
    calls: list[dict[str, Any]]  # of `evaluate`, the last one last
    # A line for each row and pair, by row, category and pair: "row", "category", "pair" (its key), "reference" and
    # "target" (the objects, CATEGORY/SEQUENCE), "problem" (the key without target frames), and the members of `_Found`.
    table: pd.DataFrame
    costs: list[dict[str, Any]]  # "pair", "seconds", "timings" and "saliency_iou" of each evaluation of a pair

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json."""
        return summarise(self.table, self.costs, self.settings)

    def row(self, name: str) -> pd.DataFrame:
        """Return the table's lines of a row by pair key; InputError for an unknown row."""
        found = self.table[self.table["row"] == name]
        if found.empty:
            raise InputError(f"row {name!r} is not in the run, expected one of {', '.join(self.table['row'].unique())}")
        return found.set_index("pair")


@contextmanager
def open_run(out: str | Path, settings: Mapping[str, Any], allow_other_version: bool = False) -> Iterator[None]:
    """Be the only writer of a run's folder, which is new or holds a run with these settings; then `add_lines` adds."""
    with writing(out):
        out = Path(out)
        merged, lines = _merged_settings(out, settings, allow_other_version), out / LINES
        if lines.exists():
            complete = read_bytes(lines, "results of a run").rfind(b"\n") + 1
            os.truncate(lines, complete)  # the rest is a line that a killed process was writing
        write_atomic(out / SETTINGS, json.dumps(merged, indent=1).encode())
        add_lines(out, [])  # make the file
        yield


def add_lines(out: str | Path, lines: Iterable[Mapping[str, Any]]) -> None:
    """Add lines to run.jsonl."""
    text = "".join(f"{json.dumps(line, separators=(',', ':'))}\n" for line in lines)
    try:
        with open(Path(out) / LINES, "ab") as file:
            file.write(text.encode())
    except OSError as error:
        raise InputError(f"{Path(out) / LINES} cannot be written: {error}") from error


def read_lines(out: str | Path) -> list[dict[str, Any]]:
    """Read the finished lines of a run's folder."""
    path = Path(out) / LINES
    texts = read_bytes(path, "results of a run").split(b"\n")[:-1]
    return [_checked(text, _Line, f"results of a run {path}, line {number}") for number, text in enumerate(texts, 1)]


def read_run(path: str | Path) -> Run:
    """Read a run from its folder, also where it was interrupted, or from its exported `results.jsonl.gz`."""
    path = Path(path)
    if path.is_dir():
        settings = _checked(read_bytes(path / SETTINGS, "settings of a run"), _Settings, f"settings {path / SETTINGS}")
        return _run(settings, read_lines(path), str(path))
    what = f"results {path}"
    first, *texts = decompress(read_bytes(path, "results"), what).splitlines() or [b""]
    lines = [_checked(text, _Line, f"{what}, line {number}") for number, text in enumerate(texts, 2)]
    return _run(_checked(first, _Settings, f"{what}, line 1"), lines, str(path))


def _run(settings: dict[str, Any], lines: Sequence[Mapping[str, Any]], where: str) -> Run:
    """Put the finished results of the last call's rows and categories into a table."""
    calls: list[dict[str, Any]] = []
    costs, found = [], []
    for line in lines:
        if "call" in line:
            calls.append(line["call"])
        elif "pair" in line:
            costs.append({"timings": {}, "saliency_iou": {}} | {k: v for k, v in line.items() if k != "results"})
            found += [{"row": row, "pair": line["pair"], **one} for row, one in line["results"].items()]
        elif calls:
            calls[-1] |= line
    call = calls[-1] if calls else {"rows": [], "categories": []}
    found = [one for one in found if one["row"] in call["rows"] and one["pair"].split("/")[0] in call["categories"]]
    if not found:
        raise InputError(f"{where}: the run has no finished pair yet")
    table = pd.DataFrame(found, columns=["row", "pair", *_Found.__struct_fields__, "timings"])
    table = table.astype({"note": object, "failed": object}).fillna({"note": "", "failed": ""})
    # A pair that an interrupted call of another version evaluated again counts once.
    table = table.drop_duplicates(["row", "pair"], keep="last")
    return Run(settings, calls, _sorted(table, call["rows"], call["categories"]), costs)


def _sorted(table: pd.DataFrame, rows: Sequence[str], categories: Sequence[str]) -> pd.DataFrame:
    """Add what a pair's key says, and keep and sort some rows and categories."""
    parts = table["pair"].str.split("/", expand=True).reindex(columns=range(3))
    table = table.assign(
        category=parts[0],
        reference=parts[0] + "/" + parts[1].str.rpartition(":").reindex(columns=range(3))[0],
        target=parts[0] + "/" + parts[2].str.rpartition(":").reindex(columns=range(3))[0],
        problem=table["pair"].str.rpartition(":").reindex(columns=range(3))[0],
    )
    table = table[table["row"].isin(rows) & table["category"].isin(categories)]
    places = {name: place for place, name in enumerate(rows)}, {name: place for place, name in enumerate(categories)}
    order = table.assign(first=table["row"].map(places[0]), second=table["category"].map(places[1]))
    order = order.sort_values(["first", "second", "problem", "pair"], kind="stable").index
    return table.loc[order].reset_index(drop=True)


def read_runs(paths: Sequence[str | Path]) -> Run:
    """Read a run, or several of one benchmark on different objects, such as folders of different seeds, as one.

    Rows that not all of the runs have are left out; sequences of one category and name are one object. InputError if
    the runs share no row or share a pair, or differ in the backbone, the number of target views or a row's settings.
    """
    runs = [read_run(path) for path in paths]
    if len(runs) == 1:
        return runs[0]
    rows = [name for name in runs[0].calls[-1]["rows"] if all(name in set(run.table["row"]) for run in runs)]
    every = list(dict.fromkeys(name for run in runs for name in run.table["row"].unique()))
    if missing := sorted(set(every) - set(rows)):
        logger.warning("not in all runs, left out: %s", ", ".join(missing))
    if not rows:
        raise InputError(f"runs to pool have no row in common, found {', '.join(every)}")
    compared = {part: [run.settings[part] for run in runs] for part in ("backbone", "targets")}
    compared |= {f"row {name}": [run.settings["methods"].get(name) for run in runs] for name in rows}
    for what, values in compared.items():
        if len(found := sorted(set(map(str, values)))) > 1:
            raise InputError(f"runs to pool differ in {what}: {', '.join(found)}")
    table = pd.concat([run.table for run in runs], ignore_index=True)
    categories = list(dict.fromkeys(name for run in runs for name in run.calls[-1]["categories"]))
    table = _sorted(table, rows, categories)
    if shared := table.duplicated(["row", "pair"]).sum():
        raise InputError(f"runs to pool share {shared} pairs, expected other objects")
    settings = runs[0].settings | {"data": ", ".join(run.settings["data"] for run in runs)}
    return Run(settings, [one for run in runs for one in run.calls], table, [])


def export_run(out: str | Path) -> Path:
    """Write the run of a folder to results.jsonl.gz in it, rounded to four decimals; equal runs give equal bytes."""
    out, lines = Path(out), []
    for line in read_lines(out):
        if "pair" in line:
            results = {
                row: {
                    k: round(v, _DECIMALS) if isinstance(v, float) else v
                    for k, v in one.items()
                    if k in _KEPT and v != ""
                }
                for row, one in line["results"].items()
            }
            line = {"pair": line["pair"], "results": results, "saliency_iou": line.get("saliency_iou", {})}
        lines.append(line)
    settings = json.loads(read_bytes(out / SETTINGS, "settings of a run"))
    text = "".join(f"{json.dumps(line, separators=(',', ':'))}\n" for line in [settings, *lines])
    write_atomic(out / EXPORT, gzip.compress(text.encode(), mtime=0))
    return out / EXPORT


_KEPT = frozenset(_Found.__struct_fields__)


def _checked(data: bytes, kind: Any, what: str) -> Any:
    """Decode JSON that Python wrote (with NaN) and check that it is of a `kind`; else InputError(`what`: ...)."""
    try:
        content = json.loads(data)
        msgspec.convert(content, kind)
        return content
    except (ValueError, RecursionError, msgspec.ValidationError) as error:
        raise InputError(f"{what}: {error}") from error


def _merged_settings(out: Path, settings: Mapping[str, Any], allow_other_version: bool) -> dict[str, Any]:
    """Return the settings to write: with all rows, labels and library versions of the run that the folder holds."""
    library = settings["library"]
    if not os.path.lexists(out / SETTINGS):  # a broken link is no new run
        if (out / LINES).exists():
            raise InputError(f"{out} holds results in {LINES} without {SETTINGS}; choose another folder")
        return dict(settings) | {"library": [library]}
    before = _checked(read_bytes(out / SETTINGS, "settings of a run"), _Settings, f"settings {out / SETTINGS}")
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
        known = before.get(group, {})
        if changed := sorted(
            name for name, value in settings.get(group, {}).items() if known.get(name, value) != value
        ):
            return f"holds other results of {', '.join(changed)}: the {what} has changed since; choose another folder"
    if settings["library"] in before["library"] or allow_other_version:
        return ""
    versions = before["library"][-1], settings["library"]
    older, this = (f"zsp-lite {one.get('version')} (commit {one.get('commit')})" for one in versions)
    other = "choose another folder, or continue with --allow-other-version"
    return f"was measured with {older}, this is {this}; {other}"
