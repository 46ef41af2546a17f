"""Comparison of two runs, or of two rows, on the same pairs, with intervals and significance tests."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zsp_lite.benchmark.results import Results
from zsp_lite.benchmark.statistics import paired_test
from zsp_lite.benchmark.summary import draws_of_pairs
from zsp_lite.benchmark.tables import Cell, PValue, Table, make_table
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy, median


@dataclass(frozen=True)
class Difference:
    """Difference between row `first` of run A and row `second` of run B on their `n` common pairs."""

    first: str
    second: str
    n: int
    acc30: tuple[float, float]  # Acc30 of A and of B in percent
    median: tuple[float, float]  # median error of A and of B in degrees
    test: dict  # result of `benchmark.statistics.paired_test`, with bootstrap intervals and p values over objects


def compare(first: Results, second: Results, rows: Sequence[tuple[str, str]] | None = None) -> list[Difference]:
    """Compare rows of two runs on the pairs that both have evaluated.

    Args:
        first: Run A.
        second: Run B.
        rows: (row of A, row of B); by default every row that both runs have, with itself.

    Raises:
        InputError: If there is no common row or pair.
    """
    found = []
    for one, other in [(name, name) for name in first.rows if name in second.rows] if rows is None else rows:
        a, b = first.errors(one), second.errors(other)
        keys = sorted(key for key in a if key in b)
        if not keys:
            raise InputError(f"rows {one} and {other} have no pair in common: other data, seed or number of views")
        errors = np.array([[run[key] for key in keys] for run in (a, b)])
        test = paired_test(*errors, weights=draws_of_pairs(keys))
        found.append(Difference(one, other, len(keys), tuple(accuracy(errors, 30)), tuple(median(errors)), test))
    if not found:
        raise InputError(f"runs have no row in common: {', '.join(first.rows)} and {', '.join(second.rows)}")
    return found


def split_rows(text: str, first: Results, second: Results) -> tuple[str, str]:
    """Split "A:B" into a row of each run; "A" stands for the row A of both. Names of rows may hold colons."""
    colons = [i for i, sign in enumerate(text) if sign == ":"]
    for one, other in ((text, text), *((text[:i], text[i + 1 :]) for i in colons)):
        if one in first.rows and other in second.rows:
            return one, other
    of_first, of_second = (", ".join(run.rows) for run in (first, second))
    raise InputError(
        f"rows {text!r}: not in the runs, expected A:B or A with A one of {of_first} and B one of {of_second}"
    )


def comparison_table(differences: Sequence[Difference], first: str, second: str) -> Table:
    """Tabulate differences; `first` and `second` name the runs."""
    groups = {"Acc30 (%)": ("B - A", "sign test"), "error (°)": ("mean of A - B", "permutation test")}
    columns = [("", "pairs")]
    for group, (gain, test) in groups.items():
        columns += [(group, title) for title in ("A", "B", gain, "p", f"p, {test}")]
    rows = {}
    for one in differences:
        cells: list[Cell] = [Cell(one.n, decimals=0)]
        parts = (one.acc30, "accuracy_gain", "sign_test_p"), (one.median, "error_drop", "permutation_test_p")
        for figures, gain, test in parts:
            cells += [*map(Cell, figures), Cell(one.test[gain], *one.test[f"{gain}_ci"])]
            cells += [PValue(one.test[f"{gain}_p"]), PValue(one.test[test])]
        rows[one.first if one.first == one.second else f"{one.first}:{one.second}"] = cells
    note = (
        "On the common pairs; errors of A and B are medians. Intervals (95 %) and p: bootstrap over objects. The sign "
        "test (pairs that only one of the two solves) and the permutation test (mean difference) treat pairs as "
        "independent; pairs share objects, so their p values are too small. Of twenty rows without a difference, one "
        "has p < 0.05 by chance."
    )
    return make_table("compare", f"A = {first}, B = {second}", columns, rows, note)
