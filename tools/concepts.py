"""`concepts.csv`: which side, training, validation or evaluation, every category name belongs to."""

import csv
from collections.abc import Iterable
from pathlib import Path

from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError

CONCEPTS = Path(__file__).with_suffix(".csv")


def check_sides(folders: Iterable[str | Path], side: str) -> None:
    """Raise InputError if a data folder has a category that `concepts.csv` does not list for a side.

    A category CATEGORY-MODEL, as `tools/variants.py` makes it, is on the side of CATEGORY.
    """
    with CONCEPTS.open(newline="") as file:
        sides = {row["name"]: row["side"] for row in csv.DictReader(file)}
    for folder in folders:
        for category in Co3D(folder).categories():
            if (found := sides.get(category.partition("-")[0], "no side")) != side:
                raise InputError(f"{folder}: category {category} is for {found}, expected {side}")
