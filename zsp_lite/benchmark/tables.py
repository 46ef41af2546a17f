"""The paper's tables from the summary of a run, with intervals, and the published results in columns of their own.

Medians are means of the categories' medians, as in the paper. Accuracies are over all pairs, which is the same average
if every category has as many. `paper_tables.json` says which rows stand in which table, and holds what the paper
published for CO3D (20 categories with 100 pairs each) with DINO ViT-S/8: other data than the synthetic ones. "ROW-n5"
there is also the row ROW of a run with 5 target views.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd

from zsp_lite.benchmark.methods import METHODS
from zsp_lite.choices import METRICS, METRICS_SHOWN
from zsp_lite.io.files import write_atomic

PAPER = METRICS_SHOWN[:3]
PUBLISHED = "published on CO3D (other data)"
NOTE = "Med. err.: mean of the categories' medians. Intervals: 95 %, bootstrap over objects."
_PUBLISHED_NOTE = (
    "Published figures are the paper's, on CO3D with DINO ViT-S/8: other data, and another backbone unless the run "
    "says otherwise."
)
_LOWEST_IS_BEST = ("mean_category_median", "median", "above150", "translation")
_FEATURED = ("bicycle", "hydrant", "motorcycle", "teddybear", "toaster")  # with their Acc30 in Table 1


@dataclass(frozen=True)
class Cell:
    """A figure of a table, with its interval if it has one."""

    value: float
    low: float | None = None
    high: float | None = None
    decimals: int = 1

    def __str__(self) -> str:
        value, low, high = ("" if x is None else f"{x:.{self.decimals}f}" for x in (self.value, self.low, self.high))
        if self.decimals == 3 and self.value < 0.001:  # a p value
            return "< 0.001"
        return f"{value} [{low}, {high}]" if low else value


@dataclass(frozen=True, eq=False)
class Table:
    """A table to print or write."""

    name: str  # stem of its files
    title: str
    columns: Sequence[tuple[str, str]]  # group, which may be "", and title
    rows: Mapping[str, Sequence[Any]]  # a `Cell` or None for each column, by the row's label
    note: str = ""  # how to read it
    compact: Sequence[tuple[str, str]] = ()  # at most three columns that a LaTeX table shows

    @property
    def cells(self) -> pd.DataFrame:
        """The cells as a pandas table."""
        index = pd.MultiIndex.from_tuples(self.columns, names=["group", "title"])
        return pd.DataFrame(list(self.rows.values()), list(self.rows), index, dtype=object)

    @property
    def text(self) -> pd.DataFrame:
        """The cells as text, "–" where there is none."""
        return self.cells.map(lambda cell: "–" if cell is None else str(cell))


def every_table(summary: Mapping[str, Any], metrics: Sequence[str] = METRICS_SHOWN) -> list[Table]:
    """Return all tables of a run; `metrics` are the figures of the table of all rows (see `METRICS`).

    Rows that see other objects of the category have a table of their own and stand in no other.
    """
    seeing = [name for name in summary["methods"] if re.fullmatch(r"category(-n\d+)?", name)]
    kinds = [
        {name: row for name, row in summary["methods"].items() if (name in seeing) == yes} for yes in (False, True)
    ]
    alone, others = (summary | {"methods": kind} for kind in kinds)
    tables = []
    if alone["methods"]:
        tables = [all_rows(alone, metrics), *paper_tables(alone), *(by_category(alone, metric) for metric in PAPER)]
    if seeing:
        found = all_rows(others, metrics)
        tables.append(replace(found, name="with_others", title="With other unlabelled objects of the category"))
    return tables


def all_rows(summary: Mapping[str, Any], metrics: Sequence[str] = METRICS_SHOWN) -> Table:
    """Return every row of the run: its figures, failed pairs, and its difference to "ours"."""
    rows = {}
    for name, row in summary["methods"].items():
        counts = (Cell(row[count], decimals=0) for count in ("n", "failed"))
        rows[name] = [next(counts), *(_cell(row, metric) for metric in metrics), next(counts), None, None]
        if test := summary.get("against", {}).get(name):
            difference = Cell(test["accuracy_gain"], *test["accuracy_gain_ci"])
            rows[name][-2:] = [difference, Cell(test["accuracy_gain_p"], decimals=3)]
    titles = ["pairs", *(METRICS[name] for name in metrics), "failed", "Acc30 − ours", "p"]
    note = (
        f'{NOTE} Acc30 − ours: the row\'s Acc30 minus that of "ours" on the same pairs, in points, and its p value by '
        "the same bootstrap."
    )
    columns = [("", title) for title in titles]
    return Table("all_rows", "All rows", columns, rows, note, columns[1:4])


def read_paper_tables() -> list[dict[str, Any]]:
    """Read which rows stand in which table of the paper, with its published figures."""
    return json.loads(Path(__file__).with_name("paper_tables.json").read_text(encoding="utf-8"))


def paper_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return tables 1 to 3 and those of the supplement, where the run has two of their rows, and what goes beyond."""
    found = [(spec, _rows_of_run(spec, summary)) for spec in read_paper_tables()]
    shown = {name for spec, names in found if not spec["prefix"] for name in names}
    beyond = [{"label": name, "rows": [name], "published": []} for name in summary["methods"] if name not in shown]
    if beyond and "ours" in summary["methods"]:
        beyond.insert(0, {"label": "ours", "rows": ["ours"], "published": []})
    spec = {"name": "beyond", "title": "Beyond the paper", "groups": [""], "figures": PAPER, "published": []}
    found.append((spec | {"rows": beyond}, {line["label"] for line in beyond}))
    return [_paper_table(spec, summary) for spec, names in found if len(names) > 1]


def by_category(summary: Mapping[str, Any], metric: str = "acc30", most: int | None = None) -> Table:
    """Return a figure of the first `most` rows, or of all, with a line for each category and one for all pairs."""
    rows = list(summary["methods"].items())[:most]
    categories = dict.fromkeys(category for _, row in rows for category in row["per_category"])
    lines = {category: [_cell(row["per_category"].get(category), metric) for _, row in rows] for category in categories}
    lines["all"] = [_cell(row, metric) for _, row in rows]
    columns = [("", name) for name, _ in rows]
    name = f"categories_{metric.rpartition('_')[2]}"
    return Table(name, f"By category: {METRICS[metric]}", columns, lines, NOTE, columns[:3])


def comparison_table(differences: dict[str, dict[str, Any]], first: str, second: str) -> Table:
    """Tabulate differences; `first` and `second` name the runs."""
    columns = [("", "pairs"), *(("Acc30 (%)", title) for title in ("A", "B", "B − A", "p"))]
    columns += [("median error (°)", title) for title in ("A", "B")]
    rows = {
        name: [
            Cell(one["n"], decimals=0), *map(Cell, one["acc30"]), Cell(one["accuracy_gain"], *one["accuracy_gain_ci"]),
            Cell(one["accuracy_gain_p"], decimals=3), *map(Cell, one["median"]),
        ]
        for name, one in differences.items()
    }  # fmt: skip
    note = (
        "On the common pairs. Intervals (95 %) and p: bootstrap over objects. Of twenty rows without a difference, one "
        "has p < 0.05 by chance."
    )
    return Table("compare", f"A = {first}, B = {second}", columns, rows, note, columns[1:4])


def own_rows(summary: Mapping[str, Any]) -> list[str]:
    """List the rows of a run that are not the library's."""
    return [name for name in summary["methods"] if re.sub(r"-n\d+$", "", name) not in METHODS]


def _row_name(name: str, summary: Mapping[str, Any]) -> str:
    """The name in the run of "ROW-nN": ROW, if N is the run's number of target views and no row has this name."""
    return name if name in summary["methods"] else name.removesuffix(f"-n{summary['data']['targets']}")


def _rows_of_run(spec: Mapping[str, Any], summary: Mapping[str, Any]) -> set[str]:
    """The rows of the run in a table; none if the run has fewer than two of those with the table's prefix."""
    names = {_row_name(name, summary) for line in spec["rows"] for name in line["rows"]} & summary["methods"].keys()
    names |= set(own_rows(summary) if spec["name"] == "table_1" else ())
    return names if sum(name.startswith(spec["prefix"]) for name in names) > 1 else set()


def _paper_table(spec: Mapping[str, Any], summary: Mapping[str, Any]) -> Table:
    """A table with the run's rows, the published figures, and in Table 1, rows of one's own below the paper's."""
    methods, lines, table_1 = summary["methods"], list(spec["rows"]), spec["name"] == "table_1"
    if table_1:
        lines += [{"label": name, "rows": [name], "published": []} for name in own_rows(summary)]
    featured = [name for name in _FEATURED if table_1 and name in summary["data"]["categories"]]
    groups = [": ".join(filter(None, ("this run" if spec["published"] else "", group))) for group in spec["groups"]]
    titles = [*(METRICS[one] for one in spec["figures"]), *(f"{one} Acc30" for one in featured)]
    columns = [(group, title) for group in groups for title in titles]
    rows = {}
    for line in lines:
        cells: list[Cell | None] = []
        for row in (methods.get(_row_name(name, summary)) for name in line["rows"]):
            cells += [_cell(row, metric) for metric in spec["figures"]]
            cells += [_cell(row and row["per_category"].get(one), "acc30") for one in featured]
        rows[line["label"]] = cells + ([Cell(one) for one in line["published"]] or [None] * len(spec["published"]))
    compact = [one for one in columns if len(groups) == 1 or one[1] == METRICS["acc30"]][:3]
    columns += [(PUBLISHED, title) for title in spec["published"]]
    note = [NOTE, _PUBLISHED_NOTE if spec["published"] else "", spec.get("note", "")]
    return Table(spec["name"], spec["title"], columns, rows, " ".join(filter(None, note)), compact)


def _cell(row: Mapping[str, Any] | None, metric: str) -> Cell | None:
    """A figure of a row, or of a category, which has no mean of categories."""
    if row is not None and metric not in row and metric == "mean_category_median":
        metric = "median"
    if row is None or row.get(metric) is None:
        return None
    return Cell(row[metric], *row.get(f"{metric}_ci", ()), decimals=2 if metric in ("scale", "translation") else 1)


def as_csv(table: Table) -> str:
    """Format as plain numbers, an interval in two columns of its own."""
    columns = {}
    for (group, title), cells in table.cells.items():
        for part in ("value", "low", "high"):
            values = [getattr(cell, part, None) for cell in cells]
            if part == "value" or any(value is not None for value in values):
                columns[" ".join(filter(None, (group, title, part.replace("value", ""))))] = values
    return pd.DataFrame(columns, table.cells.index).to_csv(index_label="row")


def as_markdown(table: Table) -> str:
    """Format as a pipe table under its title."""
    text = table.text.set_axis([str(label).replace("|", "\\|") for label in table.text.index])
    text.columns = [": ".join(filter(None, column)).replace("|", "\\|") for column in text.columns]
    lines = text.to_markdown(disable_numparse=True, colalign=("left", *["right"] * len(text.columns)))
    return "\n\n".join(filter(None, [f"**{table.title}**", lines, table.note])) + "\n"


def as_latex(table: Table) -> str:
    """Format the compact columns as a booktabs table: no intervals, the best value of a metric in bold."""
    compact = list(table.compact)
    shown = table.cells[compact].dropna(how="all")
    text = shown.map(lambda cell: "--" if cell is None else f"{cell.value:.{cell.decimals}f}".replace("-", "$-$"))
    names = {title: name for name, title in METRICS.items()}
    for place, column in enumerate(compact):
        values = pd.Series([None if cell is None else round(cell.value, cell.decimals) for cell in shown[column]])
        if column[1] in names and values.notna().sum() > 1:
            best = values.min() if names[column[1]] in _LOWEST_IS_BEST else values.max()
            bold = values == best
            text.iloc[bold.to_numpy(), place] = text.iloc[bold.to_numpy(), place].map("\\textbf{{{}}}".format)
    text.columns = [
        _tex(": ".join(filter(None, (group.removeprefix("this run").removeprefix(": "), title))))
        for group, title in compact
    ]
    text.index = [_tex(str(label)) for label in text.index]
    layout = {"caption": _tex(table.title), "label": f"tab:{table.name}", "position": "tb"}
    return text.to_latex(escape=False, column_format="l" + "r" * len(compact), **layout)


def _tex(text: str) -> str:
    """Escape text for LaTeX, with real minus signs and degrees."""
    return re.sub(r"([%_&#$])", r"\\\1", text).replace("°", "$^\\circ$").replace("−", "$-$")


def write_tables(tables: Iterable[Table], folder: str | Path) -> None:
    """Write each table as NAME.csv, NAME.md and NAME.tex."""
    for table in tables:
        for suffix, render in ((".csv", as_csv), (".md", as_markdown), (".tex", as_latex)):
            write_atomic(Path(folder) / f"{table.name}{suffix}", render(table).encode())
