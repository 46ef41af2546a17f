"""Two runs, or two rows, on the same pairs: is the difference more than chance?"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zsp_lite.benchmark.results import Results
from zsp_lite.benchmark.tables import Cell, Column, Table
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy, median, paired_test


@dataclass(frozen=True)
class Difference:
    """Row `first` of run A against row `second` of run B on the `n` pairs that both have; errors in degrees.

    acc30, median: of A and B.  accuracy_gain: B - A in percentage points, accuracy_p its sign test over the pairs that
    only one of them has within 30 degrees.  error_drop: mean of A - B, error_p its permutation test (signs flipped).
    """

    first: str
    second: str
    n: int
    acc30: tuple[float, float]
    median: tuple[float, float]
    accuracy_gain: float
    accuracy_p: float
    error_drop: float
    error_p: float


def compare(first: Results, second: Results, rows: Sequence[tuple[str, str]] | None = None) -> list[Difference]:
    """Every row that both runs have against its namesake, or the given (row of A, row of B).

    Only pairs that both have evaluated count. Raises InputError where there is no common row or pair.
    """
    if rows is None:
        rows = [(name, name) for name in first.rows if name in second.rows]
        if not rows:
            raise InputError(f"runs have no row in common: {', '.join(first.rows)} and {', '.join(second.rows)}")
    found = []
    for one, other in rows:
        a, b = first.errors(one), second.errors(other)
        keys = [key for key in a if key in b]
        if not keys:
            raise InputError(f"rows {one} and {other} have no pair in common: other data, seed or number of views")
        before, after = np.array([a[key] for key in keys]), np.array([b[key] for key in keys])
        test = paired_test(before, after)
        found.append(
            Difference(
                one,
                other,
                len(keys),
                (float(accuracy(before, 30)), float(accuracy(after, 30))),
                (float(median(before)), float(median(after))),
                **test,
            )  # fmt: skip
        )
    return found


def comparison_table(differences: list[Difference], first: str, second: str) -> Table:
    """For people to read; `first` and `second` name the runs."""
    columns = [Column("pairs"), Column("A", "Acc30 (%)"), Column("B", "Acc30 (%)"), Column("B - A", "Acc30 (%)"),
               Column("p", "Acc30 (%)"), Column("A", "error (°)"), Column("B", "error (°)"),
               Column("B less by, mean", "error (°)"), Column("p", "error (°)")]  # fmt: skip
    rows = []
    for one in differences:
        cells = [Cell(one.n, decimals=0), *map(Cell, one.acc30), Cell(one.accuracy_gain),
                 Cell(one.accuracy_p, decimals=4), *map(Cell, one.median), Cell(one.error_drop),
                 Cell(one.error_p, decimals=4)]  # fmt: skip
        label = one.first if one.first == one.second else f"{one.first}:{one.second}"
        rows.append((label, tuple(cells)))
    note = (
        "On the pairs that both have. Acc30: sign test over the pairs that only one of them solves; error: medians "
        "over all pairs, and a permutation test of the mean difference. Of twenty rows that do not differ, one has "
        "p < 0.05 by chance."
    )
    return Table("compare", f"A = {first}, B = {second}", tuple(columns), tuple(rows), note)
