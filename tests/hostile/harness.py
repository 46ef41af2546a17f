"""Cases, and the files that they damage."""

import gzip
import io
import json
import os
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from co3d_folders import sequence_data

from zsp_lite.cli.main import main
from zsp_lite.data.co3d import write_co3d
from zsp_lite.data.labels import PoseLabel, write_label

CASES: list["Case"] = []


class Wrong(Exception):
    """An answer without an error to an input that has none, or another answer than expected."""


@dataclass(frozen=True)
class Case:
    """A call with hostile input.

    Attributes:
        group: Its class, a line of the table.
        name: What is hostile.
        call: Called with the case's own copy of the folder of `prepare`. Checks of an answer raise `Wrong`.
        answers: The call may return. Otherwise it must raise InputError.
        says: Part of the message, where another defect of the input would be refused as well.
    """

    group: str
    name: str
    call: Callable[[Path], object]
    answers: bool = False
    says: str = ""

    def outcome(self, folder: Path) -> tuple[str, str]:
        found = self.call(folder)
        if isinstance(found, tuple) and isinstance(found[0], str) and found[0] == "refused":
            return found
        return ("right" if self.answers else "wrong"), " ".join(repr(found).split())[:300]

    def refused(self, error: Exception) -> tuple[str, str]:
        text = str(error)
        if "\n" in text or len(text) > 1500:
            return "wrong", f"error of {len(text)} characters in {text.count(chr(10)) + 1} lines: {text}"
        if self.says not in text:
            return "wrong", f"refused for another reason than {self.says!r}: {text}"
        return "refused", text


def case(group: str, name: str, call: Callable[[Path], object], answers: bool = False, says: str = "") -> None:
    """Register a case."""
    CASES.append(Case(group, name, call, answers, says))


def command(group: str, name: str, *argv: str, change: Callable[[Path], object] | None = None, codes=(2,)) -> None:
    """Register a command line that must end with one of the exit codes: with 2, one line on stderr."""

    def call(folder: Path):
        if change is not None:
            change(folder)
        stderr = io.TextIOWrapper(io.BytesIO(), "utf-8", errors="backslashreplace")
        with redirect_stderr(stderr):
            code = main([text.replace("ROOT", str(folder)) for text in argv])
        stderr.flush()
        text = stderr.buffer.getvalue().decode()
        if code not in codes:
            raise Wrong(f"exit code {code}, expected {codes}: {text}")
        if code == 2 and len(text.strip().splitlines()) != 1:
            raise Wrong(f"{len(text.splitlines())} lines on stderr: {text}")
        return "refused" if code == 2 else "right", text

    CASES.append(Case(group, name, lambda folder: _keep(call(folder)), answers=True))


def _keep(found: tuple[str, str]) -> object:
    return found if found[0] == "refused" else found[1]


def prepare(folder: Path) -> Path:
    """Write a data set of two labelled sequences of one category, and pictures; every case gets a copy."""
    data = folder / "data"
    write_co3d(data, "cup", [sequence_data("a", 6), sequence_data("b", 6, seed=1)])
    for name in ("a", "b"):
        write_label(data, "cup", PoseLabel(np.eye(4), name, "a"))
    return folder


def edit_frames(folder: Path, change: Callable[[list], object]) -> None:
    """Change the frame annotations of the category."""
    edit(folder / "data/cup/frame_annotations.jgz", change)


def edit(path: Path, change: Callable[[object], object]) -> None:
    content = json.loads(gzip.decompress(path.read_bytes()))
    changed = change(content)
    path.write_bytes(gzip.compress(json.dumps(content if changed is None else changed).encode()))


def gzip_bomb(gigabytes: int = 8, start: bytes = b"") -> bytes:
    """Compressed zeros."""
    step = gzip.compress(b" " * (1 << 26))
    return gzip.compress(start) + step * (16 * gigabytes)


# What is not an ordinary file, or not of ordinary size.
def strange_files() -> dict[str, Callable[[Path], object]]:
    def replaced(make):
        def write(path: Path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)
            make(path)

        return write

    def sparse(path: Path):
        with open(path, "wb") as file:
            file.truncate(20 << 30)

    return {
        "empty": replaced(lambda path: path.write_bytes(b"")),
        "text": replaced(lambda path: path.write_text("hello")),
        "random bytes": replaced(lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000))),
        "pipe": replaced(os.mkfifo),
        "link to /dev/zero": replaced(lambda path: path.symlink_to("/dev/zero")),
        "link to a terminal": replaced(lambda path: path.symlink_to("/dev/tty")),
        "folder": replaced(lambda path: path.mkdir()),
        "20 GB of nothing": replaced(sparse),
        "link to itself": replaced(lambda path: path.symlink_to(path)),
        "missing": replaced(lambda path: None),
    }
