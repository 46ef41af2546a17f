"""Comparison of two runs, or of two rows, on the same pairs, with intervals and significance tests."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zsp_lite.benchmark.results import Results
from zsp_lite.benchmark.summary import weights_of_pairs
from zsp_lite.benchmark.tables import Cell, Column, Table
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy, median, paired_test


@dataclass(frozen=True)
class Difference:
    """Difference between row `first` of run A and row `second` of run B on their `n` common pairs.

    Attributes:
        acc30: Acc30 of A and of B in percent.
        median: Median error of A and of B in degrees.
        test: Result of `metrics.paired_test`, with bootstrap intervals and p values over objects.
    """

    first: str
    second: str
    n: int
    acc30: tuple[float, float]
    median: tuple[float, float]
    test: dict


def compare(first: Results, second: Results, rows: Sequence[tuple[str, str]] | None = None) -> list[Difference]:
    """Compare rows of two runs on the pairs that both have evaluated.

    Args:
        first: Run A.
        second: Run B.
        rows: (row of A, row of B); by default every row that both runs have, with itself.

    Raises:
        InputError: If there is no common row or pair.
    """
    if rows is None:
        rows = [(name, name) for name in first.rows if name in second.rows]
        if not rows:
            raise InputError(f"runs have no row in common: {', '.join(first.rows)} and {', '.join(second.rows)}")
    found = []
    for one, other in rows:
        a, b = first.errors(one), second.errors(other)
        keys = sorted(key for key in a if key in b)
        if not keys:
            raise InputError(f"rows {one} and {other} have no pair in common: other data, seed or number of views")
        before, after = np.array([a[key] for key in keys]), np.array([b[key] for key in keys])
        test = paired_test(before, after, weights=weights_of_pairs(keys))
        acc30 = float(accuracy(before, 30)), float(accuracy(after, 30))
        found.append(Difference(one, other, len(keys), acc30, (float(median(before)), float(median(after))), test))
    return found


def split_rows(text: str, first: Results, second: Results) -> tuple[str, str]:
    """Split "A:B" into a row of each run; "A" stands for the row A of both. Names of rows may hold colons themselves.

    Raises:
        InputError: If the text names no rows of the runs, or can be read in several ways.
    """
    if text in first.rows and text in second.rows:
        return text, text
    ends = [i for i, sign in enumerate(text) if sign == ":"]
    found = [(text[:i], text[i + 1 :]) for i in ends if text[:i] in first.rows and text[i + 1 :] in second.rows]
    if len(found) != 1:
        raise InputError(
            f"rows {text!r}: {'ambiguous' if found else 'not in the runs'}, expected A:B or A with A one of "
            f"{', '.join(first.rows)} and B one of {', '.join(second.rows)}"
        )
    return found[0]


def comparison_table(differences: list[Difference], first: str, second: str) -> Table:
    """Tabulate differences; `first` and `second` name the runs."""
    columns = [Column("pairs")]
    for group, gain, test in (("Acc30 (%)", "B - A", "sign test"), ("error (°)", "mean of A - B", "permutation test")):
        columns += [Column(title, group) for title in ("A", "B", gain, "p", f"p, {test}")]
    rows = []
    for one in differences:
        cells = [Cell(one.n, decimals=0)]
        for values, name, test in (
            (one.acc30, "accuracy_gain", "sign_test_p"),
            (one.median, "error_drop", "permutation_test_p"),
        ):
            cells += [*map(Cell, values), Cell(one.test[name], *one.test[f"{name}_ci"])]
            cells += [Cell(one.test[p], p_value=True) for p in (f"{name}_p", test)]
        label = one.first if one.first == one.second else f"{one.first}:{one.second}"
        rows.append((label, tuple(cells)))
    note = (
        "On the common pairs; errors of A and B are medians. Intervals (95 %) and p: bootstrap over objects. The sign "
        "test (pairs that only one of the two solves) and the permutation test (mean difference) treat pairs as "
        "independent; pairs share objects, so their p values are too small. Of twenty rows without a difference, one "
        "has p < 0.05 by chance."
    )
    return Table("compare", f"A = {first}, B = {second}", tuple(columns), tuple(rows), note)
