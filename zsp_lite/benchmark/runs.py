"""A run: its folder, to which results are only ever added, and what it found as one table.

run.json holds what decides the results, and every call of `evaluate`. A line of run.jsonl, or of
run.jsonl.gz, is the `ResultLine` of a pair. One process writes to a folder; others can read it
meanwhile.
"""

import dataclasses
import functools
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import pandas as pd
import scipy
import torch
from jaxtyping import Float, Int

from zsp_lite import __version__
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.benchmark.summary import summarise
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError
from zsp_lite.io.files import (
    REPOSITORY,
    decode_json,
    decompress,
    digest,
    read_bytes,
    read_json,
    write_atomic,
)
from zsp_lite.io.locks import writing

SETTINGS = "run.json"
LINES = "run.jsonl"
_KEY = r"^[^/]+/[^/]+:\d+/[^/]+:\d+(,\d+)*$"  # as of `Pair.key`
_Degrees = Annotated[float, msgspec.Meta(ge=0, le=180)]


class Call(msgspec.Struct):
    """A call of `evaluate`."""

    time: str
    command: list[str]
    versions: dict[str, str]
    rows: list[str]
    pairs: dict[str, int]  # by category
    seeds: int = 1  # evaluations of each pair
    finished: bool = True
    remarks: dict[str, str] = {}  # on poses from a file, by row


class Settings(msgspec.Struct):
    """What decides the results of a run; a later call may add to methods, objects, and versions."""

    data: str
    backbone: str  # fingerprint
    targets: int
    library: list[dict[str, str | None]]  # version and commit
    methods: dict[str, str]  # description by row
    calls: Annotated[list[Call], msgspec.Meta(min_length=1)]
    folder: str = ""  # absolute path of the data, without links
    objects: dict[str, str] = {}  # hash of an image and the label by CATEGORY/SEQUENCE


class Result(msgspec.Struct, omit_defaults=True):
    """What a row found for a pair."""

    error: _Degrees
    confidence: Annotated[float, msgspec.Meta(ge=0, le=1)] | None = None
    symmetric_error: _Degrees | None = None  # up to turns after which both objects look the same
    translation: float | None = None  # error of the object's centre in diameters of the target
    scale: float | None = None  # estimated over labelled, which is 1
    view: int | None = None
    rotation: list[float] | None = None  # row by row
    position: list[float] | None = None  # the pose's translation
    inliers: int | None = None
    seconds: float | None = None
    note: str = ""
    failed: str = ""


class ResultLine(msgspec.Struct, omit_defaults=True):
    """A line of run.jsonl: what the rows found for a pair."""

    pair: Annotated[str, msgspec.Meta(pattern=_KEY)]
    results: dict[str, Result]
    repeat: int = 0  # number of the seed
    timings: dict[str, float] = {}  # median seconds by stage


def described(value: Any) -> str:
    """Describe a setting as text: an object by "module:name", whatever its code; a dataclass with
    its public fields."""
    if value is None or isinstance(value, bool | int | float | str | list | tuple):
        return str(value)
    named = value if hasattr(value, "__qualname__") else type(value)
    name = f"{named.__module__}:{named.__qualname__}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        texts = [
            f"{field.name}={described(getattr(value, field.name))}"
            for field in dataclasses.fields(value)
            if not field.name.startswith("_")
        ]
        return f"{name}({', '.join(texts)})"
    return name


def fingerprint(extractor: Any) -> str:
    """Return the name of an extractor (by default "module:name"), and a hash of its `state_dict`
    and settings."""
    name = getattr(extractor, "name", None) or described(extractor)
    network = extractor
    settings = ""
    if isinstance(extractor, Backbone):
        network = extractor.model
        fields = ("layer", "facet", "saliency_heads", "image_size", "mean", "std")
        settings = repr(tuple(getattr(extractor, field) for field in fields))
    if not callable(getattr(network, "state_dict", None)):
        return name
    parts: list[str | bytes] = []  # the name and the bytes of each weight
    for key, weight in sorted(network.state_dict().items()):
        content = weight.detach().cpu().contiguous().reshape(-1).view(torch.uint8)
        parts += [key, content.numpy().tobytes()]
    return f"{name} {digest(settings, *parts)}" if parts else name


@functools.cache
def library_version() -> dict[str, str | None]:
    """Return the version of zsp_lite, and the commit of its checkout, "-dirty" if files differ;
    None if installed."""
    commit = None
    # An installed copy may lie inside the repository of another project, whose commit says nothing.
    if (REPOSITORY / ".git").exists():
        # Without tags, git describes by the commit alone.
        words = "describe --always --abbrev=40 --dirty --exclude *".split()
        describe = ["git", "-C", str(REPOSITORY), *words]
        with suppress(OSError):  # git is not installed
            commit = subprocess.run(describe, capture_output=True, text=True).stdout.strip() or None
    return {"version": __version__, "commit": commit}


def printable(text: object) -> str:
    """Return a text, such as a file name of any bytes, with "?" for what is not Unicode."""
    return str(text).encode(errors="replace").decode()


@dataclass(frozen=True, eq=False)
class Run:
    """Results of a run on the pairs that the rows of the last call have finished (see
    `read_run`)."""

    folder: str
    settings: Settings
    # A line for each row, pair and seed, in this order: "row", "category", "pair" (its key),
    # "repeat" (of the seed), "problem" (the key without target frames), "reference" and "target"
    # (the objects, CATEGORY/SEQUENCE), "views" (number of target views), and the members of
    # `Result`.
    table: pd.DataFrame
    timings: dict[str, float]  # median seconds by stage
    note: str = ""  # what is missing

    @functools.cached_property
    def summary(self) -> dict[str, Any]:
        """The content of summary.json."""
        # A backbone's fingerprint is its name, and a hash if it has weights.
        backbone = re.sub(" [0-9a-f]{16}$", "", self.settings.backbone)
        data = {
            "root": self.settings.data,
            "categories": list(self.table["category"].unique()),
            "pairs": int(self.table.groupby("row")["pair"].nunique().max()),
            "targets": self.settings.targets,
        }
        summary = {"data": data, "backbone": backbone}
        note = " ".join(filter(None, [self.note, *self._failures()]))
        if note:
            summary["note"] = note
        return summary | summarise(self.table) | {"timings": self.timings}

    def _failures(self) -> Iterator[str]:
        """Say of each row on how many pairs it failed, or answered without a fit, and the reason of
        the first."""
        for name, row in self.table.groupby("row", sort=False):
            pairs = row["pair"].nunique()
            # "." is any text. Every note on a pose without a fit says "not a fit".
            for column, pattern, what in (
                ("failed", ".", "failed on {} of {} pairs, counted as 180°"),
                ("note", "not a fit", "has no fit on {} of {} pairs"),
            ):
                found = row[row[column].str.contains(pattern)]
                if len(found):
                    text = what.format(found["pair"].nunique(), pairs)
                    first = found.iloc[0]
                    yield f"{name} {text}; the first, {first['pair']}: {first[column]}."

    def row(self, name: str) -> pd.DataFrame:
        """Return the table's lines of a row by pair key; InputError for an unknown row."""
        found = self.table[self.table["row"] == name]
        if found.empty:
            raise InputError(
                f"row {name!r} is not in the run, expected one of "
                f"{', '.join(self.table['row'].unique())}"
            )
        return found.set_index("pair")

    def poses(
        self, name: str
    ) -> tuple[
        list[Pair], Int[np.ndarray, " n"], Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]
    ]:
        """Return the pairs for which a row has a pose, the target views, the rotations, and the
        translations, which are NaN where there is none."""
        found = self.row(name).dropna(subset=["rotation", "view"])
        pairs = [Pair.from_key(key) for key in found.index]
        rotations = np.array(found["rotation"].tolist()).reshape(-1, 3, 3)
        positions = np.array([position or [np.nan] * 3 for position in found["position"]])
        return pairs, found["view"].to_numpy(int), rotations, positions


@contextmanager
def open_run(
    out: str | Path,
    data: str | Path,
    backbone: Any,
    targets: int,
    methods: dict[str, str],
    objects: dict[str, str],
    kind: type = ResultLine,
    **call: Any,
) -> Iterator[list[Any]]:
    """Be the only writer of a run's folder, which is new or holds a run with these settings.

    Yields its lines, of a `kind`, to which `add_lines` adds. `call` has the members of this `Call`
    that the other arguments do not give.
    """
    words = [Path(sys.argv[0]).name.replace("__main__.py", "zsp-lite"), *sys.argv[1:]]
    versions = {one.__name__: str(one.__version__) for one in (torch, np, scipy, cv2)}
    versions |= {"python": platform.python_version(), "machine": platform.platform()}
    this_call = Call(
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        command=[printable(word) for word in words],
        versions=versions,
        rows=list(methods),
        finished=False,
        **call,
    )
    settings = Settings(
        data=printable(data),
        folder=printable(os.path.realpath(data)),
        backbone=fingerprint(backbone),
        targets=targets,
        library=[library_version()],
        methods=methods,
        objects=objects,
        calls=[this_call],
    )
    with writing(out):
        out = Path(out)
        lines = _finished_lines(out)
        if lines or (out / SETTINGS).exists():
            settings = _continued(out, settings)
        write_atomic(out / LINES, lines)
        (out / f"{LINES}.gz").unlink(missing_ok=True)
        _write_settings(out, settings)
        yield read_lines(out, kind)
        this_call.finished = True
        _write_settings(out, settings)


def _write_settings(out: Path, settings: Settings) -> None:
    """Write run.json."""
    write_atomic(out / SETTINGS, msgspec.json.format(msgspec.json.encode(settings), indent=1))


def _continued(out: Path, now: Settings) -> Settings:
    """Merge settings with those of the run that a folder holds; InputError if they do not go
    together."""
    before = read_json(out / SETTINGS, Settings, "settings of a run")
    held = _decisive(before)
    asked = _decisive(now)
    if before.objects.keys() & now.objects.keys():
        del held["data"]  # the same data may lie at another path
    for name, value in asked.items():
        if held.get(name, value) != value:
            raise InputError(
                f"{out} holds a run with {name} {held[name]}, this is {value}; choose another "
                "folder"
            )
    return msgspec.structs.replace(
        now,
        library=[old for old in before.library if old not in now.library] + now.library,
        methods=before.methods | now.methods,
        objects=before.objects | now.objects,
        calls=before.calls + now.calls,
    )


def _decisive(settings: Settings) -> dict[str, Any]:
    """Return by name what must be equal in two calls of one run, if both calls have it."""
    return {
        "command": "align" if "alignment" in settings.methods else "benchmark",
        "backbone": settings.backbone,
        "targets": settings.targets,
        "data": settings.folder or os.path.realpath(settings.data),
        **{f"methods of {row}": text for row, text in settings.methods.items()},
        **{f"images or labels of {name}": code for name, code in settings.objects.items()},
    }


def add_lines(out: str | Path, lines: Iterable[Any]) -> None:
    """Add the results of pairs to run.jsonl; InputError if they cannot be written."""
    path = Path(out) / LINES
    try:
        with path.open("ab") as file:
            file.write(msgspec.json.Encoder().encode_lines(lines))
    except (OSError, ValueError) as error:  # ValueError: a text that is not Unicode
        raise InputError(f"{path} cannot be written: {error}") from error


def read_lines(out: str | Path, kind: type = ResultLine) -> list[Any]:
    """Read the results of the finished pairs of a run's folder, lines of a `kind`."""
    lines = enumerate(_finished_lines(Path(out)).splitlines(), 1)
    return [
        decode_json(text, kind, f"results of a run in {out}, line {number}")
        for number, text in lines
    ]


def _finished_lines(out: Path) -> bytes:
    """Read run.jsonl, or run.jsonl.gz, up to its last line that was written to the end; b"" without
    these."""
    path = out / LINES
    packed = out / f"{LINES}.gz"
    what = "results of a run"
    data = read_bytes(path, what) if path.exists() else b""
    # A process that was killed in `open_run` may have left both, with the same lines.
    if packed.exists():
        data = decompress(read_bytes(packed, what), f"{what} {packed}")
    return data[: data.rfind(b"\n") + 1]


def read_run(out: str | Path) -> Run:
    """Read a run from its folder, also where it was interrupted.

    Shown are the pairs that all rows of the last call have finished, and all rows of the folder
    that have these pairs. Pairs of different numbers of target views are the same if they are the
    same "problem".
    """
    settings = read_json(Path(out) / SETTINGS, Settings, "settings of a run")
    lines = read_lines(out)
    last = settings.calls[-1]
    table = _table(lines, settings)
    if not table.empty:
        table = _finished(table, last)
    if table.empty:
        raise InputError(f"{out}: the run has no pair that all its rows have finished")
    timings = pd.DataFrame([line.timings for line in lines]).median().to_dict()
    rows = table["row"].unique()
    notes = []
    if not last.finished:
        most = table.groupby("row")["pair"].nunique().max()
        notes.append(f"Not finished: {most} of {sum(last.pairs.values())} pairs.")
    if len(settings.library) > 1:
        notes.append("Evaluated by several versions of zsp-lite (run.json lists them).")
    hidden = [name for name in settings.methods if name not in rows]
    if hidden:
        notes.append(f"Without {', '.join(hidden)}, which lack pairs of the last call.")
    stored = sum(len(line.results.keys() & set(rows)) for line in lines)
    if last.finished and stored > len(table):
        notes.append(
            f"Without {stored - len(table)} of {stored} results, which are of other pairs, "
            "categories or seeds than the last call."
        )
    remarks: dict[str, str] = {}
    for call in settings.calls:
        remarks |= call.remarks
    notes += [remark for name, remark in remarks.items() if name in rows]
    return Run(str(out), settings, table, timings, " ".join(filter(None, notes)))


def _table(lines: Sequence[ResultLine], settings: Settings) -> pd.DataFrame:
    """Tabulate the results in the categories of the last call, by row, category and pair."""
    last = settings.calls[-1]
    categories = list(last.pairs)
    found = []
    for line in lines:
        pair = Pair.from_key(line.pair)
        if pair.category not in categories or line.repeat >= last.seeds:
            continue
        problem = line.pair.rpartition(":")[0]
        of_pair = {
            "pair": line.pair,
            "repeat": line.repeat,
            "problem": problem,
            "category": pair.category,
            "reference": f"{pair.category}/{pair.reference_sequence}",
            "target": f"{pair.category}/{pair.target_sequence}",
            "views": len(pair.target_frames),
        }
        place = categories.index(pair.category), problem, line.pair, line.repeat
        found.append((place, of_pair, line.results))
    found.sort(key=itemgetter(0))
    return pd.DataFrame(
        {"row": row} | of_pair | msgspec.structs.asdict(results[row])
        for row in settings.methods
        for _, of_pair, results in found
        if row in results
    )


def _finished(table: pd.DataFrame, last: Call) -> pd.DataFrame:
    """Keep the pairs that all rows of the last call have finished, and the rows, by seed, that have
    all of these pairs."""
    # A finished pair has a line for each seed and each row of the last call with as many views.
    of_call = table[table["row"].isin(last.rows)]
    expected = last.seeds * of_call.groupby("views")["row"].transform("nunique")
    finished = of_call[of_call.groupby("pair")["row"].transform("size") == expected]
    pairs = {views: set(lines["pair"]) for views, lines in finished.groupby("views")}
    problems = set(finished["problem"])

    # A row at a number of target views that the last call does not have needs the same problems.
    complete = [table[:0]]
    for (_, _, views), lines in table.groupby(["row", "repeat", "views"]):
        column = "pair" if views in pairs else "problem"
        wanted = pairs.get(views, problems)
        lines = lines[lines[column].isin(wanted)]
        if wanted <= set(lines[column]):
            complete.append(lines)
    return pd.concat(complete).sort_index(ignore_index=True)
