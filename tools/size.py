"""Print the size of every room of the project, with its limit.

    python -m tools.size

`tests/size_limits.csv` names the rooms, the pattern of their files and the limits; a test holds
them. Lines are all lines of files of code; words are those of Markdown files and of the text cells
of notebooks.
"""

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
LIMITS = ROOT / "tests" / "size_limits.csv"


class Room(NamedTuple):
    """Size of the files of one room."""

    name: str
    unit: str
    size: int
    limit: int


def rooms() -> Iterator[Room]:
    """Measure all rooms."""
    with LIMITS.open(newline="") as table:
        for row in csv.DictReader(table):
            files = {file for pattern in row["files"].split() for file in ROOT.glob(pattern)}
            count = _words if row["unit"] == "words" else _lines
            yield Room(row["room"], row["unit"], sum(map(count, files)), int(row["limit"]))


def _lines(file: Path) -> int:
    return file.read_text(encoding="utf-8").count("\n")


def _words(file: Path) -> int:
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".ipynb":
        text = "\n".join(
            "".join(one["source"])
            for one in json.loads(text)["cells"]
            if one["cell_type"] == "markdown"
        )
    return len(text.split())


if __name__ == "__main__":
    print(f"{'room':28s}{'size':>8s}{'limit':>8s}")
    for room in rooms():
        print(f"{room.name:28s}{room.size:8,d}{room.limit:8,d} {room.unit}")
