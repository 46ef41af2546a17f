"""The data of the tools: folders with numbers of pairs, and the side of every category name (`concepts.csv`)."""

import csv
from argparse import ArgumentTypeError
from collections.abc import Iterable
from pathlib import Path

from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError

CONCEPTS = Path(__file__).with_suffix(".csv")
DATA_HELP = "folder of categories in CO3D's layout with pose labels, and number of pairs of each category"


def folder_and_pairs(text: str) -> tuple[Path, int]:
    """Parse a tool's argument FOLDER:PAIRS, a data folder and the number of pairs of each of its categories."""
    folder, _, pairs = text.rpartition(":")
    if not folder or not pairs.isdecimal() or int(pairs) < 1:
        raise ArgumentTypeError(f"{text}: expected FOLDER:PAIRS, PAIRS at least 1")
    return Path(folder), int(pairs)


def check_sides(folders: Iterable[str | Path], side: str) -> None:
    """Raise InputError if a data folder has a category that `concepts.csv` does not list for a side."""
    with CONCEPTS.open(newline="") as file:
        sides = {row["name"]: row["side"] for row in csv.DictReader(file)}
    for folder in folders:
        for category in Co3D(folder).categories():
            if (found := sides.get(category.partition("-")[0], "no side")) != side:
                raise InputError(f"{folder}: category {category} is for {found}, expected {side}")
