"""The paper's tables from the summary of a run, with intervals, and with the published results in separate columns.

Medians are means of the categories' medians, as in the paper. Accuracies are over all pairs, which is the same average
if every category has as many. A table of which the run has fewer than two rows is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from zsp_lite.benchmark.published import CATEGORIES, FIGURES, PAPER_TABLES, VERIFIED_TARGETS, PaperTable
from zsp_lite.errors import InputError

THIS_RUN = "this run"
PUBLISHED = "published on CO3D (other data)"
NOTE = (
    "Med. err.: mean of the categories' medians. Intervals: 95 %, bootstrap over objects. Published figures are the "
    "paper's, on CO3D with DINO ViT-S/8: other data, and another backbone unless the run says otherwise."
)
TABLE_1_NOTE = (
    "ICP, ICP+BV, SIFT and SWaV use the true object mask, the other rows do not. SWaV and PoseContrast need their "
    "published checkpoints. The paper trained PoseContrast on ObjectNet3D, without its evaluation categories."
)
_NAMES = dict(zip(FIGURES, ("median", "acc30", "acc15")))  # of the figures in a summary


@dataclass(frozen=True)
class Cell:
    """A figure of a table, with its interval if it has one."""

    value: float
    low: float | None = None
    high: float | None = None
    decimals: int = 1

    def __str__(self) -> str:
        value, low, high = ("" if x is None else f"{x:.{self.decimals}f}" for x in (self.value, self.low, self.high))
        return f"{value} [{low}, {high}]" if low else value


class PValue(Cell):
    """A p value; small ones are not printed as zero."""

    def __str__(self) -> str:
        return "< 0.001" if self.value < 0.001 else f"{self.value:.3f}"


@dataclass(frozen=True, eq=False)
class Table:
    """A table to print or write."""

    name: str  # stem of its files
    title: str
    cells: pd.DataFrame  # a `Cell`, text or None for each row's label and each column's (group, title); group may be ""
    note: str = ""  # how to read it

    @property
    def text(self) -> pd.DataFrame:
        """The cells as text, "–" where there is none."""
        return self.cells.map(lambda cell: "–" if cell is None else str(cell))


def make_table(
    name: str, title: str, columns: Sequence[tuple[str, str]], rows: Mapping[str, Sequence[Any]], note: str = ""
) -> Table:
    """Make a table from its rows."""
    index = pd.MultiIndex.from_tuples(columns, names=["group", "title"])
    return Table(name, title, pd.DataFrame(list(rows.values()), list(rows), index, dtype=object), note)


def paper_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return tables 1 to 3 and those of the supplement, where the run has rows for them, and what goes beyond them."""
    found = {spec: _rows_of_run(spec, summary) for spec in PAPER_TABLES}
    shown = {row for rows in found.values() for row in rows}
    beyond = {name: (name,) for name in summary["methods"] if name == "ours" or name not in shown}
    for spec in (VERIFIED_TARGETS, PaperTable("beyond", "Beyond the paper", beyond, ())):
        found[spec] = _rows_of_run(spec, summary)
    return [_paper_table(spec, summary) for spec, rows in found.items() if rows]


def _row_name(name: str, summary: Mapping[str, Any]) -> str:
    """The name in the run of "ROW-nN": ROW, if N is the run's number of target views and no row has this name."""
    return name if name in summary["methods"] else name.removesuffix(f"-n{summary['data']['targets']}")


def _rows_of_run(spec: PaperTable, summary: Mapping[str, Any]) -> set[str]:
    """The rows of the run in a table; none if the run has fewer than two."""
    names = {_row_name(name, summary) for line in spec.rows.values() for name in line[: len(spec.groups)]}
    names &= summary["methods"].keys()
    return names if sum(name.startswith(spec.prefix) for name in names) > 1 else set()


def _paper_table(spec: PaperTable, summary: Mapping[str, Any]) -> Table:
    table_1, groups = spec.name == "table_1", len(spec.groups)
    featured = [name for name in CATEGORIES if table_1 and name in summary["data"]["categories"]]
    figures = (*spec.figures, *(f"{name} Acc30" for name in featured))
    columns = [(f"{THIS_RUN}: {group}" if group else THIS_RUN, figure) for group in spec.groups for figure in figures]
    columns += [(PUBLISHED, figure) for figure in spec.published]
    rows = {}
    for label, line in spec.rows.items():
        methods = [summary["methods"].get(_row_name(name, summary)) for name in line[:groups]]
        cells = [_cell(row, figure) for row in methods for figure in figures]
        rows[f"{spec.unit} = {label}" if spec.unit else label] = [*cells, *map(Cell, line[groups:])]
    title = f"{spec.title}, N = {summary['data']['targets']}" if table_1 else spec.title
    return make_table(spec.name, title, columns, rows, f"{NOTE} {TABLE_1_NOTE}" if table_1 else NOTE)


def all_rows(summary: Mapping[str, Any]) -> Table:
    """Return every row of the run: its figures, flagged and failed estimates, and its difference to "ours"."""
    columns = ["pairs", *FIGURES, "above 150° (%)", "flagged", "failed", "ours - row (%)", "p", "p, sign test"]
    rows = {}
    for name, row in summary["methods"].items():
        cells: list[Cell | None] = [Cell(row["n"], decimals=0), *(_cell(row, figure) for figure in FIGURES)]
        cells += [Cell(row["above150"]), *(Cell(row[count], decimals=0) for count in ("flagged", "failed"))]
        if test := summary.get("against_ours", {}).get(name):
            cells += [Cell(test["accuracy_gain"], *test["accuracy_gain_ci"])]
            cells += [PValue(test["accuracy_gain_p"]), PValue(test["sign_test_p"])]
        rows[name] = cells + [None] * (len(columns) - len(cells))
    note = (
        "Med. err.: mean of the categories' medians. flagged: estimates with a warning of the method, included "
        'in all values. ours - row: difference in Acc30 to "ours" on the same pairs. Intervals (95 %) and p: bootstrap '
        "over objects. The sign test treats pairs as independent; pairs share objects, so its p values are too small."
    )
    return make_table("all_rows", "All rows", [("", title) for title in columns], rows, note)


def best_two_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return the table "one of two", of the rows whose estimates have alternatives; none without such rows."""
    columns = ["pairs", "one of the two best right (%)", 'flagged "one of two"']
    columns += ["of these, one right (%)", "of these, the first right (%)"]
    rows = {}
    for name, row in summary["methods"].items():
        if (found := row.get("best_two")) is not None:
            shares = [found["one_of_two_acc30"], found["one_of_two_first_acc30"]]
            rows[name] = [Cell(row["n"], decimals=0), Cell(found["acc30"], *found["acc30_ci"])]
            rows[name] += [Cell(found["one_of_two"], decimals=0)]
            rows[name] += [None if share is None else Cell(share) for share in shares]
    note = (
        "Right: a rotation error below 30°. The two best: the estimate and its first alternative, of every pair. Two "
        "answers are right more often than one: these values are not comparable with Acc30."
    )
    title = "Right if one of the two best poses is right"
    return [make_table("one_of_two", title, [("", column) for column in columns], rows, note)] if rows else []


def category_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return every row by category: median error, Acc30 and Acc15, a table each."""
    methods = summary["methods"]
    categories = list(dict.fromkeys(c for row in methods.values() for c in row["per_category"]))
    columns = [("", category) for category in (*categories, "all")]
    tables = []
    for figure, name in _NAMES.items():
        rows = {
            label: [*(_cell(row["per_category"].get(c), figure) for c in categories), _cell(row, figure)]
            for label, row in methods.items()
        }
        tables.append(make_table(f"categories_{name}", f"By category: {figure}", columns, rows, NOTE))
    return tables


def by_category(summary: Mapping[str, Any], names: Sequence[str]) -> Table:
    """Return Acc30 of some rows with a line for each category, narrow enough for a terminal."""
    methods = summary["methods"]
    if missing := [name for name in names if name not in methods]:
        raise InputError(f"the run has no row {', '.join(missing)}, expected some of {', '.join(methods)}")
    categories = dict.fromkeys(c for name in names for c in methods[name]["per_category"])
    rows = {c: [_cell(methods[name]["per_category"].get(c), "Acc30 (%)") for name in names] for c in categories}
    columns = [("", name) for name in names]
    return make_table("by_category", "By category: Acc30 (%)", columns, rows, NOTE)


def every_table(summary: Mapping[str, Any]) -> list[Table]:
    """Return all tables of a run."""
    return [all_rows(summary), *best_two_tables(summary), *paper_tables(summary), *category_tables(summary)]


def _cell(row: Mapping[str, Any] | None, figure: str) -> Cell | None:
    """A figure of a row or of a row's category, by its title; "CATEGORY Acc30" is a figure of a row, too."""
    if row is not None and figure not in _NAMES:
        row, figure = row["per_category"].get(figure.removesuffix(" Acc30")), "Acc30 (%)"
    if row is None:
        return None
    name = _NAMES[figure]
    if name == "median" and "mean_category_median" in row:
        name = "mean_category_median"
    return Cell(row[name], *row.get(f"{name}_ci", ()))
