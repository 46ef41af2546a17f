"""The paper's tables from the summary of a run, with intervals, and with the published results in separate columns.

Medians are means of the categories' medians, as in the paper. Accuracies are over all pairs, which is the same average
if every category has as many. A table of which the run has fewer than two rows is left out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from zsp_lite.benchmark import published
from zsp_lite.benchmark.published import PublishedTable
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
_FIGURES = ("med", "acc30", "acc15")
_TITLES = dict(zip(_FIGURES, published.FIGURES))


@dataclass(frozen=True)
class Cell:
    """A figure of a table, with its interval if it has one."""

    value: float
    low: float | None = None
    high: float | None = None
    decimals: int = 1

    def __str__(self) -> str:
        text = f"{self.value:.{self.decimals}f}"
        if self.low is None or self.high is None:
            return text
        return f"{text} [{self.low:.{self.decimals}f}, {self.high:.{self.decimals}f}]"


class PValue(Cell):
    """A p value; small ones are not printed as zero."""

    def __str__(self) -> str:
        return "< 0.001" if self.value < 0.001 else f"{self.value:.3f}"


@dataclass(frozen=True, eq=False)
class Table:
    """A table to print or write.

    Attributes:
        name: Stem of its files.
        title: Its caption.
        cells: A `Cell`, text or None for each row's label and each column's (group, title); group may be "".
        note: How to read it.
    """

    name: str
    title: str
    cells: pd.DataFrame
    note: str = ""

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
    methods, views = summary["methods"], summary["data"]["targets"]
    tables: list[Table] = []
    shown: dict[str, None] = {}

    def add(
        name: str,
        title: str,
        blocks: Mapping[str, Mapping[str, str]],
        figures: Sequence[str] = _FIGURES,
        printed: PublishedTable | None = None,
        unit: str = "",
        note: str = NOTE,
    ) -> None:
        """Add a table with a group of columns for each block: by label of the table, a row of the run."""
        used = dict.fromkeys(row for block in blocks.values() for row in block.values() if row in methods)
        if len(used) < 2:
            return
        shown.update(used)
        columns = [(group, _TITLES.get(figure, f"{figure} Acc30")) for group in blocks for figure in figures]
        columns += [(PUBLISHED, title) for title in (printed.columns if printed else ())]
        rows = {}
        for label in dict.fromkeys(label for block in blocks.values() for label in block):
            found = [methods.get(block.get(label)) for block in blocks.values()]
            cells = [_cell(row, figure) for row in found for figure in figures]
            if printed:
                cells += map(Cell, printed.rows[label]) if label in printed.rows else [None] * len(printed.columns)
            rows[f"{unit} = {label}" if unit else label] = cells
        tables.append(make_table(name, title, columns, rows, note))

    def at(row: str, n: int) -> str:
        """Name of a row at n target views."""
        named = f"{row}-n{n}"
        return row if n == views and named not in methods else named

    def by_views(row: str, numbers: Sequence[int]) -> dict[str, str]:
        return {str(n): at(row, n) for n in numbers}

    table_1 = {"ICP": "icp", "SIFT": "sift", "SWaV": "swav", "ICP+BV": "icp-bv", "PoseContrast": "posecontrast"}
    table_1 |= {"Ours (K=30)": "ours-k30", "Ours (K=50)": "ours"}
    featured = [name for name in published.CATEGORIES if name in summary["data"]["categories"]]
    add("table_1", f"Table 1. Baselines and our method, N = {views}", {THIS_RUN: table_1}, (*_FIGURES, *featured),
        published.TABLE_1, note=f"{NOTE} {TABLE_1_NOTE}")  # fmt: skip
    table_2 = {f"{label} (N={n})": at(row, n) for label, row in (("Ours-BV", "ours-bv"), ("Ours", "ours"))
               for n in (1, 3, 5)}  # fmt: skip
    add("table_2", "Table 2. Number of target views", {THIS_RUN: table_2}, printed=published.TABLE_2)
    add("table_3", "Table 3. How to choose the view",
        {THIS_RUN: {"CyclicalDistIoU": "ours-cyclicaliou", "GlobalSim": "ours-globalsim",
                    "SaliencyIoU": "ours-saliencyiou", "CorrespondSim": "ours"}},
        printed=published.TABLE_3)  # fmt: skip
    numbers, accuracies = (1, 3, 5, 10, 20), ("acc30", "acc15")
    add("table_a_targets", "Supplement. More target views",
        {f"{THIS_RUN}: best view only": by_views("ours-bv", numbers),
         f"{THIS_RUN}: full method": by_views("ours", numbers)}, accuracies, published.TARGETS, "views")  # fmt: skip
    add("table_a_matchers", "Supplement. Correspondence method",
        {THIS_RUN: {"Optimal transport": "ours-transport", "Dual softmax": "ours-dualsoftmax",
                    "Cyclical distances": "ours"}}, printed=published.MATCHERS)  # fmt: skip
    add("table_a_correspondences", "Supplement. Number and diversity of correspondences",
        {f"{THIS_RUN}: without k-means": {str(k): f"ours-k{k}-nokmeans" for k in (30, 50, 70)},
         f"{THIS_RUN}: with k-means": {"30": "ours-k30", "50": "ours", "70": "ours-k70"}},
        accuracies, published.CORRESPONDENCES, "K")  # fmt: skip
    add("table_a_trials", "Supplement. RANSAC trials",
        {THIS_RUN: {"500": "ours-trials500", "1000": "ours", "2000": "ours-trials2000"}},
        printed=published.TRIALS, unit="trials")  # fmt: skip
    add("table_a_depth", "Supplement. Without depth",
        {THIS_RUN: {"No depth (essential matrix)": "ours-nodepth", "Ours-BV": "ours-bv", "Ours": "ours"}},
        printed=published.DEPTH)  # fmt: skip
    add("published_code", "Start and mask of the cycles",
        {THIS_RUN: {"Cycle from the reference (paper)": "ours", "Cycle from the target (published code)":
                    "ours-published"}})  # fmt: skip
    beyond = {name: name for name in methods if name == "ours" or name not in shown}
    solvers = {"the paper's": "ours", "verified": "verified", "verified, true mask": "verified-mask"}
    if sum(at(row, n) in methods for row in ("verified", "verified-mask") for n in (1, 3, 5, 10)) > 1:
        add("verified_targets", "Beyond the paper. All views tested: the verified solver",
            {f"{THIS_RUN}: {label}": by_views(row, (1, 3, 5, 10)) for label, row in solvers.items()}, accuracies,
            unit="views")  # fmt: skip
    add("beyond", "Beyond the paper", {THIS_RUN: beyond})
    return tables


def all_rows(summary: Mapping[str, Any]) -> Table:
    """Return every row of the run: its figures, flagged and failed estimates, and its difference to "ours"."""
    columns = (
        "pairs", *_TITLES.values(), "above 150° (%)", "flagged", "failed", "ours - row (%)", "p", "p, sign test",
    )  # fmt: skip
    rows = {}
    for name, row in summary["methods"].items():
        cells: list[Cell | None] = [Cell(row["n"], decimals=0), *(_cell(row, figure) for figure in _FIGURES)]
        cells += [Cell(row["above150"]), *(Cell(row[count], decimals=0) for count in ("flagged", "failed"))]
        if test := summary.get("against_ours", {}).get(name):
            cells += [Cell(test["accuracy_gain"], *test["accuracy_gain_ci"]), PValue(test["accuracy_gain_p"]),
                      PValue(test["sign_test_p"])]  # fmt: skip
        rows[name] = cells + [None] * (len(columns) - len(cells))
    note = (
        "Med. err.: mean of the categories' medians. flagged: estimates with a warning of the method, included "
        'in all values. ours - row: difference in Acc30 to "ours" on the same pairs. Intervals (95 %) and p: bootstrap '
        "over objects. The sign test treats pairs as independent; pairs share objects, so its p values are too small."
    )
    return make_table("all_rows", "All rows", [("", title) for title in columns], rows, note)


def best_two_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return the table "one of two", of the rows whose estimates have alternatives; none without such rows."""
    columns = (
        "pairs", "one of the two best right (%)", 'flagged "one of two"', "of these, one right (%)",
        "of these, the first right (%)",
    )  # fmt: skip
    rows = {}
    for name, row in summary["methods"].items():
        if (found := row.get("best_two")) is not None:
            shares = [found["one_of_two_acc30"], found["one_of_two_first_acc30"]]
            rows[name] = [
                Cell(row["n"], decimals=0), Cell(found["acc30"], *found["acc30_ci"]),
                Cell(found["one_of_two"], decimals=0), *(None if share is None else Cell(share) for share in shares),
            ]  # fmt: skip
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
    for figure, stem in (("med", "median"), ("acc30", "acc30"), ("acc15", "acc15")):
        rows = {name: [*(_cell(row["per_category"].get(c), figure) for c in categories), _cell(row, figure)]
                for name, row in methods.items()}  # fmt: skip
        tables.append(make_table(f"categories_{stem}", f"By category: {_TITLES[figure]}", columns, rows, NOTE))
    return tables


def by_category(summary: Mapping[str, Any], names: Sequence[str]) -> Table:
    """Return Acc30 of some rows with a line for each category, narrow enough for a terminal."""
    methods = summary["methods"]
    if missing := [name for name in names if name not in methods]:
        raise InputError(f"the run has no row {', '.join(missing)}, expected some of {', '.join(methods)}")
    categories = dict.fromkeys(c for name in names for c in methods[name]["per_category"])
    rows = {c: [_cell(methods[name]["per_category"].get(c), "acc30") for name in names] for c in categories}
    columns = [("", name) for name in names]
    return make_table("by_category", f"By category: {_TITLES['acc30']}", columns, rows, NOTE)


def every_table(summary: Mapping[str, Any]) -> list[Table]:
    """Return all tables of a run."""
    return [all_rows(summary), *best_two_tables(summary), *paper_tables(summary), *category_tables(summary)]


def _cell(row: Mapping[str, Any] | None, figure: str) -> Cell | None:
    """A figure of a row or of a row's category; a category's name stands for its Acc30."""
    if row is not None and figure not in _FIGURES:
        row, figure = row["per_category"].get(figure), "acc30"
    if row is None:
        return None
    name = figure
    if figure == "med":
        name = "mean_category_median" if "mean_category_median" in row else "median"
    return Cell(row[name], *row.get(f"{name}_ci", ()))
