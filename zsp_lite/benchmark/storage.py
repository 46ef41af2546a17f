"""A run's folder: what it is a run of, every finished pair, who worked on it when. Safe against a kill at any moment.

    run.json           what decides the results: settings, rows, pose labels; a folder with others is refused
    invocations.jsonl  one line per call: command, versions, git revision, machine, threads, seconds
    pairs.jsonl        one line per finished pair (or more: rows added later have lines of their own)
    parts/             lines of workers of other processes, until they stand in pairs.jsonl
    summary.json, tables/, figures/   made of the above, any time again

Lines are only ever appended, each in one write, so that a killed run leaves at most its last line incomplete.
"""

import errno
import io
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from zsp_lite.errors import InputError
from zsp_lite.io.files import write_atomic

SETTINGS, INVOCATIONS, PAIRS, PARTS = "run.json", "invocations.jsonl", "pairs.jsonl", "parts"
# Parts of the settings that a later call may add to, and what to do where one of their members has changed.
_GROWING = {
    "methods": "the method has changed since; choose another folder or another name",
    "labels": "the pose label has changed since; choose another folder",
}
_PACKAGES = ("zsp-lite", "torch", "numpy", "opencv-python-headless", "scikit-learn", "scipy", "open3d-cpu", "open3d")


class RunFolder:
    """An open run: `records` are its finished pairs by key, `add` appends one. Use it as a context manager.

    Raises InputError where the folder holds a run of something else, a damaged one, or one that is being written to.
    """

    def __init__(self, out: str | Path, settings: Mapping[str, Any]):
        self.out = Path(out)
        self.out.mkdir(parents=True, exist_ok=True)
        self._lock = _lock(self.out / ".lock")
        try:
            known = json.dumps(same_run(self.out, settings), indent=1).encode()
            path = self.out / SETTINGS
            if not path.is_file() or path.read_bytes() != known:
                write_atomic(path, known)
            self.records = read_records(self.out / PAIRS)
            self._lines = (self.out / PAIRS).open("ab", buffering=0)
            for part in sorted((self.out / PARTS).glob("*.jsonl")):
                for record in PartReader(part).read():
                    self.add(record)
                part.unlink()
        except BaseException:
            self._lock.close()
            raise

    def __enter__(self) -> "RunFolder":
        return self

    def __exit__(self, *_) -> None:
        self._lines.close()
        self._lock.close()

    @property
    def parts(self) -> Path:
        """Where workers of other processes leave their lines."""
        folder = self.out / PARTS
        folder.mkdir(exist_ok=True)
        return folder

    def wanted(self, key: str, names: list[str]) -> list[str]:
        """Which of the rows a pair still lacks."""
        known = self.records.get(key, {}).get("methods", {})
        return [name for name in names if name not in known]

    def add(self, record: Mapping[str, Any]) -> bool:
        """Keep a finished pair; False where all of its rows were known already."""
        if not self.wanted(record["key"], list(record["methods"])):
            return False
        _append(self._lines, record)
        merge(self.records.setdefault(record["key"], {}), record)
        return True

    def note(self, **facts: Any) -> None:
        """Append a line to the invocations."""
        path = self.out / INVOCATIONS
        torn = path.is_file() and not path.read_bytes().endswith(b"\n")
        with path.open("a") as file:
            file.write("\n" * torn + json.dumps(facts) + "\n")


def read_records(path: Path, mend: bool = True) -> dict[str, dict]:
    """The finished pairs of a run by key; a last line that a crash cut short is dropped, with `mend` from the file too.

    Raises InputError for any other line that is no record.
    """
    records: dict[str, dict] = {}
    if not path.is_file():
        return records
    lines = path.read_bytes().splitlines(keepends=True)
    if lines and not lines[-1].endswith(b"\n"):
        if mend:
            write_atomic(path, b"".join(lines[:-1]))
        lines = lines[:-1]
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            merge(records.setdefault(record["key"], {}), record)
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}, line {number}: not a record of a pair ({error})") from error
    return records


def read_invocations(out: Path) -> list[dict]:
    """Who worked on a run when; a line that a crash cut short is passed over."""
    path = out / INVOCATIONS
    return list(_whole_lines(path.read_bytes())) if path.is_file() else []


class PartReader:
    """A worker's file while it grows; what a killed worker left of a line is passed over."""

    def __init__(self, path: Path):
        self.path, self._offset = path, 0

    def read(self) -> list[dict]:
        """The records completed since the last call; [] where there is no file (yet)."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._offset)
                data = file.read()
        except OSError:
            return []
        data = data[: data.rfind(b"\n") + 1]
        self._offset += len(data)
        parts = {"key", "methods", "saliency_iou", "seconds_per_frame"}
        return [record for record in _whole_lines(data) if parts <= record.keys()]


def _whole_lines(data: bytes) -> Iterator[dict]:
    """The objects of the lines that hold one."""
    for line in data.splitlines():
        try:
            found = json.loads(line)
        except ValueError:
            continue
        if isinstance(found, dict):
            yield found


def merge(record: dict, line: Mapping[str, Any]) -> None:
    """Take a later line of a pair into its record."""
    methods = record.get("methods", {}) | line["methods"]
    iou = record.get("saliency_iou", {}) | line["saliency_iou"]
    # A later line, for other methods, need not have described its frames again.
    seconds = line["seconds_per_frame"] or record.get("seconds_per_frame")
    spent = dict(record.get("spent", {}))
    for name, (times, took) in line.get("spent", {}).items():
        known = spent.get(name, (0, 0.0))
        spent[name] = [known[0] + times, round(known[1] + took, 5)]
    total = round(record.get("seconds", 0.0) + line.get("seconds", 0.0), 5)
    record.update(line, methods=methods, saliency_iou=iou, seconds_per_frame=seconds, spent=spent, seconds=total)


def surroundings() -> dict[str, Any]:
    """What a run's results may one day have to be explained by: versions, revision, machine, command."""
    program = Path(sys.argv[0]).name  # `python -m zsp_lite` is the same command under another name
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": ["zsp-lite" if program == "__main__.py" else program, *sys.argv[1:]],
        "versions": versions,
        "git": git_revision(),
        "machine": {"system": platform.platform(), "processor": platform.machine(), "cores": os.cpu_count()},
    }


def git_revision() -> str | None:
    """The checkout's revision, with "+" where files differ from it; None outside a checkout."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed copy may lie inside someone else's repository: then the revision is not this code's.
        if not git("ls-files", Path(__file__).name):
            return None
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def same_run(out: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """What run.json shall say: the settings, with all rows and labels that OUT has met. Writes nothing.

    In `settings`, "methods" are fingerprints of rows and "labels" of pose labels, by name; the rest decides all
    results alike. Raises InputError where OUT is a run of something else, or one of the names stood for something
    else in it.
    """
    path = out / SETTINGS
    if not path.is_file():
        if (out / PAIRS).exists():
            raise InputError(f"{out} holds {PAIRS} without {SETTINGS}; choose another folder")
        return dict(settings)
    before = _read_settings(path)
    if differing := [key for key in settings if key not in _GROWING and before.get(key) != settings[key]]:
        raise InputError(f"{out} holds a run with other settings ({', '.join(differing)}); choose another folder")
    merged = dict(settings)
    for group, remedy in _GROWING.items():
        known, asked = before.get(group, {}), settings.get(group, {})
        if changed := sorted(name for name, value in asked.items() if known.get(name, value) != value):
            if "labels" not in before:
                remedy = "it is of an earlier version of zsp-lite; choose another folder"
            raise InputError(f"{out} holds other results of {', '.join(changed)}: {remedy}")
        merged[group] = known | asked
    return merged


def _read_settings(path: Path) -> dict:
    try:
        settings = json.loads(path.read_bytes())
    except ValueError as error:
        raise InputError(f"{path}: not the settings of a run ({error}); choose another folder") from error
    return settings if isinstance(settings, dict) else {}


def _lock(path: Path):
    """Hold the folder for this process; the system lets go of it when the process ends, however it ends."""
    file = path.open("w")
    try:
        if os.name == "nt":
            import msvcrt

            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError) as error:
        file.close()
        raise InputError(
            f"{path.parent}: another run is writing to it; wait for it or choose another folder"
        ) from error
    except OSError:  # a file system without locks
        return file
    return file


def _append(file: io.FileIO, record: Mapping[str, Any]) -> None:
    """A line with one record; OSError where not all of it found room."""
    line = json.dumps(record).encode() + b"\n"
    if file.write(line) != len(line):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), file.name)


@contextmanager
def part_writer(path: Path) -> Iterator[Any]:
    """A function that appends a record to a worker's own file; it does nothing where that cannot be opened.

    (A worker of another machine may not see the run's folder; its records then come back with its result alone.)
    """
    try:
        file = path.open("ab", buffering=0)
    except OSError:
        yield lambda record: None
        return
    with file:
        if file.tell() and not path.read_bytes().endswith(b"\n"):
            file.write(b"\n")  # closes what a killed predecessor left of a line

        def write(record: Mapping[str, Any]) -> None:
            _append(file, record)

        yield write
