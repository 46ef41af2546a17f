"""The paper's tables from the summary of a run, with intervals, and with the published results in separate columns.

As in the paper, medians are averaged over the categories. Accuracies are over all pairs, which is the same average if
all categories have equally many pairs. Tables without a row in the run are left out.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from zsp_lite.benchmark import published
from zsp_lite.benchmark.published import PublishedTable
from zsp_lite.errors import InputError

THIS_RUN = "this run"
OTHER_DATA = "published on CO3D (other data)"
NOTE = (
    "Med. err.: mean of the categories' medians. Intervals: 95 %, bootstrap over objects. Published figures are the "
    "paper's, on CO3D with DINO ViT-S/8: other data, and another backbone unless the run says otherwise."
)
_TITLES = {"med": "Med. err. (°)", "acc30": "Acc30 (%)", "acc15": "Acc15 (%)"}
_FEATURED = {
    "bike": "bicycle", "hydrant": "hydrant", "mcycle": "motorcycle", "teddy": "teddybear", "toaster": "toaster",
}  # fmt: skip
_FIGURES = ("med", "acc30", "acc15")


@dataclass(frozen=True)
class Cell:
    """A value, optionally with its interval."""

    value: float
    low: float | None = None
    high: float | None = None
    decimals: int = 1
    p_value: bool = False


@dataclass(frozen=True)
class Column:
    """A column; `group` is the common heading of several columns."""

    title: str
    group: str = ""


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        name: Stem of the file name.
        title: Title.
        columns: Columns.
        rows: Label and one cell per column; None for a missing value.
        note: Text below the table.
    """

    name: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, tuple[Cell | str | None, ...]], ...]
    note: str = ""


@dataclass(frozen=True)
class _Block:
    """Columns with a common heading: `figures` of the benchmark row (None if it has none) of each label."""

    group: str
    rows: Mapping[str, str | None]
    figures: Sequence[str]


def paper_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return Tables 1 to 3, those of the supplement and those beyond the paper, if the run has rows for them."""
    names = {"icp": "ICP", "sift": "SIFT", "swav": "SWaV", "icp-bv": "ICP+BV", "posecontrast": "PoseContrast"}
    table1 = {label: name for name, label in names.items()}
    table1 |= {"swav-tiny (stand-in)": "swav-tiny", "posecontrast-tiny (stand-in)": "posecontrast-tiny"}
    table1 |= {"Ours (K=30)": "ours-k30", "Ours (K=50)": "ours"}
    table1 = {
        label: name for label, name in table1.items() if name in summary["methods"] or label in published.TABLE_1.rows
    }
    categories = [name for name in _FEATURED.values() if name in summary["data"]["categories"]]
    views = summary["data"]["targets"]

    def at(row: str, n: int) -> str:
        """Return the name in the run of a row with n target views."""
        named = f"{row}-n{n}"
        return row if n == views and named not in summary["methods"] else named

    numbers = (1, 3, 5, 10, 20)
    kinds = (("Best view only", "ours-bv"), ("Full method", "ours"))
    table2 = {f"{label} (N={n})": at(row, n) for label, row in (("Ours-BV", "ours-bv"), ("Ours", "ours"))
              for n in (1, 3, 5)}  # fmt: skip
    build = _builder(summary)
    found = [
        build("table_1", f"Table 1. Baselines and our method, N = {views}",
              [_Block(THIS_RUN, table1, (*_FIGURES, *categories))], published.TABLE_1),
        build("table_2", "Table 2. Number of target views", [_Block(THIS_RUN, table2, _FIGURES)], published.TABLE_2),
        build("table_3", "Table 3. How to choose the view", [_Block(THIS_RUN, {
            "CyclicalDistIoU": "ours-cyclicaliou", "GlobalSim": "ours-globalsim", "SaliencyIoU": "ours-saliencyiou",
            "CorrespondSim": "ours"}, _FIGURES)], published.TABLE_3),
        build("table_a_targets", "Supplement. More target views",
              [_Block(f"{THIS_RUN}: {kind.lower()}", {str(n): at(row, n) for n in numbers}, ("acc30", "acc15"))
               for kind, row in kinds], published.TARGETS, "views"),
        build("table_a_matchers", "Supplement. Correspondence method", [_Block(THIS_RUN, {
            "Optimal transport": "ours-transport", "Dual softmax": "ours-dualsoftmax", "Cyclical distances": "ours"},
            _FIGURES)], published.MATCHERS),
        build("table_a_correspondences", "Supplement. Number and diversity of correspondences", [
            _Block(f"{THIS_RUN}: without k-means", {str(k): f"ours-k{k}-nokmeans" for k in (30, 50, 70)},
                   ("acc30", "acc15")),
            _Block(f"{THIS_RUN}: with k-means", {"30": "ours-k30", "50": "ours", "70": "ours-k70"},
                   ("acc30", "acc15"))], published.CORRESPONDENCES, "K"),
        build("table_a_trials", "Supplement. RANSAC trials", [_Block(THIS_RUN, {
            "500": "ours-trials500", "1000": "ours", "2000": "ours-trials2000"}, _FIGURES)],
            published.TRIALS, "trials"),
        build("table_a_depth", "Supplement. Without depth", [_Block(THIS_RUN, {
            "No depth (essential matrix)": "ours-nodepth", "Ours-BV": "ours-bv", "Ours": "ours"}, _FIGURES)],
            published.DEPTH),
        build("published_code", "Start and mask of the cycles", [_Block(THIS_RUN, {
            "Cycle from the reference (paper)": "ours", "Cycle from the target (published code)": "ours-published"},
            _FIGURES)]),
    ]  # fmt: skip
    tables = [table for table, used in found if len(used) > 1]
    shown = {name for _, used in found for name in used}
    solvers = {"the paper's": "ours", "verified": "verified", "verified, true mask": "verified-mask"}
    table, used = build("verified_targets", "Beyond the paper. All views tested: the verified solver",
                        [_Block(f"{THIS_RUN}: {label}", {str(n): at(row, n) for n in (1, 3, 5, 10)}, ("acc30", "acc15"))
                         for label, row in solvers.items()], unit="views")  # fmt: skip
    if sum(name.startswith("verified") for name in used) > 1:
        tables.append(table)
    beyond = {name: name for name in summary["methods"] if name not in shown or name == "ours"}
    table, used = build("beyond", "Beyond the paper", [_Block(THIS_RUN, beyond, _FIGURES)])
    return tables + [table] * (len(used) > 1)


def all_rows(summary: Mapping[str, Any]) -> Table:
    """Return a table with all rows of the run: results, numbers of flagged estimates, and tests against ours."""
    columns = (
        "pairs", "Med. err. (°)", "Acc30 (%)", "Acc15 (%)", "above 150° (%)", "flagged", "failed", "ours - row (%)",
        "p", "p, sign test",
    )  # fmt: skip
    rows = []
    for name, row in summary["methods"].items():
        test = summary.get("against_ours", {}).get(name)
        cells = [Cell(row["n"], decimals=0), *(_figure(row, figure) for figure in _FIGURES), Cell(row["above150"]),
                 Cell(row["flagged"], decimals=0), Cell(row["failed"], decimals=0),
                 None if test is None else Cell(test["accuracy_gain"], *test["accuracy_gain_ci"]),
                 None if test is None else Cell(test["accuracy_gain_p"], p_value=True),
                 None if test is None else Cell(test["sign_test_p"], p_value=True)]  # fmt: skip
        rows.append((name, tuple(cells)))
    note = (
        "Med. err.: mean of the categories' medians. flagged: estimates with a warning of the method, included "
        'in all values. ours - row: difference in Acc30 to "ours" on the same pairs. Intervals (95 %) and p: bootstrap '
        "over objects. The sign test treats pairs as independent; pairs share objects, so its p values are too small."
    )
    return Table("all_rows", "All rows", tuple(map(Column, columns)), tuple(rows), note)


def category_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return tables of all rows by category: median error, Acc30 and Acc15."""
    categories = list(dict.fromkeys(c for row in summary["methods"].values() for c in row["per_category"]))
    columns = tuple(Column(category) for category in (*categories, "all"))
    tables = []
    for figure, stem in (("med", "median"), ("acc30", "acc30"), ("acc15", "acc15")):
        rows = tuple(
            (name, (*(_figure(row["per_category"].get(c), figure) for c in categories), _figure(row, figure)))
            for name, row in summary["methods"].items()
        )
        tables.append(Table(f"categories_{stem}", f"By category: {_TITLES[figure]}", columns, rows, NOTE))
    return tables


def by_category(summary: Mapping[str, Any], names: Sequence[str]) -> Table:
    """Return the Acc30 of some rows with one line per category, narrow enough for a terminal.

    Raises:
        InputError: The run does not have one of the rows.
    """
    methods = summary["methods"]
    if lacking := [name for name in names if name not in methods]:
        raise InputError(f"the run has no row {', '.join(lacking)}, expected some of {', '.join(methods)}")
    categories = list(dict.fromkeys(c for name in names for c in methods[name]["per_category"]))
    rows = tuple(
        (category, tuple(_figure(methods[name]["per_category"].get(category), "acc30") for name in names))
        for category in categories
    )
    columns = tuple(Column(name) for name in names)
    return Table("by_category", f"By category: {_TITLES['acc30']}", columns, rows, NOTE)


def every_table(summary: Mapping[str, Any]) -> list[Table]:
    """Return all tables of a run."""
    return [all_rows(summary), *paper_tables(summary), *category_tables(summary)]


def _builder(summary: Mapping[str, Any]) -> Callable[..., tuple[Table, list[str]]]:
    methods = summary["methods"]

    def build(
        name: str, title: str, blocks: Sequence[_Block], printed: PublishedTable | None = None, unit: str = ""
    ) -> tuple[Table, list[str]]:
        """Return a table and the names of the benchmark rows in it."""
        columns = [Column(_TITLES.get(figure, f"{figure} Acc30"), block.group) for block in blocks
                   for figure in block.figures]  # fmt: skip
        if printed is not None:
            columns += [Column(_printed_title(title), OTHER_DATA) for title in printed.columns]
        rows = []
        for row in dict.fromkeys(label for block in blocks for label in block.rows):
            cells: list[Cell | str | None] = []
            for block in blocks:
                found = methods.get(block.rows.get(row))
                cells += [_named_figure(found, figure) for figure in block.figures]
            if printed is not None:
                cells += map(Cell, printed.rows[row]) if row in printed.rows else [None] * len(printed.columns)
            rows.append((f"{unit} = {row}" if unit else row, tuple(cells)))
        used = [found for block in blocks for found in block.rows.values() if found in methods]
        return Table(name, title, tuple(columns), tuple(rows), NOTE), list(dict.fromkeys(used))

    return build


def _named_figure(row: Mapping[str, Any] | None, figure: str) -> Cell | None:
    if row is None or figure in _FIGURES:
        return _figure(row, figure)
    return _figure(row["per_category"].get(figure), "acc30")


def _figure(row: Mapping[str, Any] | None, figure: str) -> Cell | None:
    """Return a value of a row, or of one category of a row, with its interval."""
    if row is None:
        return None
    name = figure
    if figure == "med":
        name = "mean_category_median" if "mean_category_median" in row else "median"
    interval = row.get(f"{name}_ci", (None, None))
    return Cell(row[name], *interval)


def _printed_title(column: str) -> str:
    if column in _FEATURED:
        return f"{_FEATURED[column]} Acc30"
    for short, long in (("no_kmeans_", "without k-means: "), ("kmeans_", "with k-means: "), ("bv_", "best view: "),
                        ("full_", "full: ")):  # fmt: skip
        if column.startswith(short):
            return long + _TITLES[column.removeprefix(short)]
    return _TITLES[column]
