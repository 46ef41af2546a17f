"""The paper's tables from the summary of a run, with intervals, and the published results in columns of their own.

Medians are means of the categories' medians, as in the paper. Accuracies are over all pairs, which is the same average
if every category has as many. `paper_tables.json` says which rows stand in which table, and holds what the paper
published for CO3D (20 categories with 100 pairs each) with DINO ViT-S/8: other data than the synthetic ones. "ROW-n5"
there is also the row ROW of a run with 5 target views.
"""

import html
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from zsp_lite.benchmark.methods import METHODS
from zsp_lite.choices import METRICS, METRICS_SHOWN
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.files import read_bytes, write_atomic

PAPER = METRICS_SHOWN[:3]
PUBLISHED = "published on CO3D (other data)"
NOTE = (
    "Med. err.: mean of the categories' medians. Intervals: 95 %, bootstrap over objects. Published figures are the "
    "paper's, on CO3D with DINO ViT-S/8: other data, and another backbone unless the run says otherwise."
)
NOTES = {
    "table_1": "ICP, ICP+BV, SIFT and SWaV use the true object mask, the other rows do not. SWaV and PoseContrast need "
    "their published checkpoints. The paper trained PoseContrast on ObjectNet3D, without its evaluation categories.",
    "table_a_targets": "There are published pairs for N = 1, 3, 5, 20 and 50; those for N = 10 are sampled.",
}
_DECIMALS = {"scale": 2, "translation": 2}
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
    cells: pd.DataFrame  # a `Cell` or None for each row's label and each column's (group, title); group may be ""
    note: str = ""  # how to read it
    compact: tuple[tuple[str, str], ...] = ()  # at most three columns that a LaTeX table shows

    @property
    def text(self) -> pd.DataFrame:
        """The cells as text, "–" where there is none."""
        return self.cells.map(lambda cell: "–" if cell is None else str(cell))


def make_table(
    name: str, title: str, columns: Sequence[tuple[str, str]], rows: Mapping[str, Sequence[Any]], note: str = "",
    compact: Sequence[tuple[str, str]] = (),
) -> Table:  # fmt: skip
    """Make a table from its rows."""
    index = pd.MultiIndex.from_tuples(columns, names=["group", "title"])
    return Table(name, title, pd.DataFrame(list(rows.values()), list(rows), index, dtype=object), note, tuple(compact))


def every_table(summary: Mapping[str, Any], metrics: Sequence[str] = METRICS_SHOWN) -> list[Table]:
    """Return all tables of a run; `metrics` are the figures of the table of all rows (see `METRICS`)."""
    return [all_rows(summary, metrics), *best_two_tables(summary), *paper_tables(summary), *category_tables(summary)]


def all_rows(summary: Mapping[str, Any], metrics: Sequence[str] = METRICS_SHOWN) -> Table:
    """Return every row of the run: its figures, failed pairs, and its difference to "ours"."""
    for name in metrics:
        check_choice("metrics: name", name, METRICS)
    columns = ["pairs", *(METRICS[name] for name in metrics), "failed", "Acc30 − ours", "p"]
    rows = {}
    for name, row in summary["methods"].items():
        cells = [
            Cell(row["n"], decimals=0),
            *(_cell(row, metric) for metric in metrics),
            Cell(row["failed"], decimals=0),
        ]
        if test := summary.get("against", {}).get(name):
            cells += [Cell(test["accuracy_gain"], *test["accuracy_gain_ci"]), Cell(test["accuracy_gain_p"], decimals=3)]
        rows[name] = cells + [None] * (len(columns) - len(cells))
    note = (
        f'{NOTE.partition(" Published")[0]} Acc30 − ours: the row\'s Acc30 minus that of "ours" on the same pairs, in '
        "points, and its p value by the same bootstrap."
    )
    compact = [("", METRICS[name]) for name in metrics[:3]]
    return make_table("all_rows", "All rows", [("", title) for title in columns], rows, note, compact)


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
    title, columns = "Right if one of the two best poses is right", [("", column) for column in columns]
    return [make_table("one_of_two", title, columns, rows, note, columns[:2])] if rows else []


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


def category_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return every row by category: median error, Acc30 and Acc15, a table each."""
    methods = summary["methods"]
    categories = list(dict.fromkeys(c for row in methods.values() for c in row["per_category"]))
    columns = [("", category) for category in (*categories, "all")]
    tables = []
    for name, metric in zip(("median", "acc30", "acc15"), PAPER):
        rows = {
            label: [*(_cell(row["per_category"].get(c), metric) for c in categories), _cell(row, metric)]
            for label, row in methods.items()
        }
        tables.append(
            make_table(f"categories_{name}", f"By category: {METRICS[metric]}", columns, rows, NOTE, columns[-1:])
        )
    return tables


def by_category(summary: Mapping[str, Any], names: Sequence[str]) -> Table:
    """Return Acc30 of some rows with a line for each category, narrow enough for a terminal."""
    found = [summary["methods"][name]["per_category"] for name in names]
    categories = dict.fromkeys(category for one in found for category in one)
    rows = {category: [_cell(one.get(category), "acc30") for one in found] for category in categories}
    return make_table("by_category", "By category: Acc30 (%)", [("", name) for name in names], rows, NOTE)


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
    this_run = "" if not spec["published"] else "this run"
    groups = [": ".join(filter(None, (this_run, group))) for group in spec["groups"]]
    columns = [
        (group, title) for group in groups
        for title in (*(METRICS[one] for one in spec["figures"]), *(f"{one} Acc30" for one in featured))
    ]  # fmt: skip
    rows = {}
    for line in lines:
        cells: list[Cell | None] = []
        for name in line["rows"]:
            row = methods.get(_row_name(name, summary))
            cells += [_cell(row, metric) for metric in spec["figures"]]
            cells += [_cell(row and row["per_category"].get(one), "acc30") for one in featured]
        published = [Cell(value) for value in line["published"]] or [None] * len(spec["published"])
        rows[line["label"]] = cells + published
    compact = [one for one in columns if len(groups) == 1 or one[1] == METRICS["acc30"]][:3]
    columns += [(PUBLISHED, title) for title in spec["published"]]
    note = " ".join(filter(None, (NOTE, NOTES.get(spec["name"]))))
    return make_table(spec["name"], spec["title"], columns, rows, note, compact)


def _cell(row: Mapping[str, Any] | None, metric: str) -> Cell | None:
    """A figure of a row, or of a category, which has no mean of categories."""
    if row is not None and metric not in row and metric == "mean_category_median":
        metric = "median"
    if row is None or row.get(metric) is None:
        return None
    return Cell(row[metric], *row.get(f"{metric}_ci", ()), decimals=_DECIMALS.get(metric, 1))


_STYLE = """
body { font-family: sans-serif; margin: 2em; } table { border-collapse: collapse; margin: 1em 0 0.5em; }
th, td { padding: 0.2em 0.7em; text-align: right; } tbody th { text-align: left; font-weight: normal; }
thead { border-bottom: 1px solid; } p { color: #444; max-width: 60em; }
"""
_MARKED = re.compile(r"(<!-- table (\S+) -->[ \t]*\r?\n)(.*?)(<!-- end of table -->)", re.DOTALL)
_MARK = re.compile(r"<!-- (table \S+|end of table) -->")


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
    """Format the compact columns as a booktabs table: no intervals, the best value of a column in bold."""
    compact = list(table.compact) or list(table.cells.columns[:3])
    shown = table.cells[compact].dropna(how="all")
    text = shown.map(lambda cell: "--" if cell is None else str(Cell(cell.value, decimals=cell.decimals)))
    text = text.map(lambda cell: f"${cell}$" if cell.startswith("-") and cell != "--" else cell)
    for column in compact:
        values = [None if cell is None else round(cell.value, cell.decimals) for cell in shown[column]]
        known = [value for value in values if value is not None]
        lowest = any(METRICS[name] == column[1] for name in _LOWEST_IS_BEST)
        for place, value in enumerate(values):
            if column[1] in METRICS.values() and len(known) > 1 and value == (min if lowest else max)(known):
                text.iloc[place, text.columns.get_loc(column)] = f"\\textbf{{{text.iloc[place][column]}}}"
    text.columns = [_tex(": ".join(filter(None, (group.removeprefix("this run"), title)))) for group, title in compact]
    text.index = [_tex(str(label)) for label in text.index]
    layout = {"caption": _tex(table.title), "label": f"tab:{table.name}", "position": "tb"}
    return text.to_latex(escape=False, column_format="l" + "r" * len(compact), **layout)


def as_html(table: Table) -> str:
    """Format as an HTML table with its title and note."""
    text, (title, note) = table.text, (html.escape(text) for text in (table.title, table.note))
    text.columns = text.columns if any(text.columns.get_level_values("group")) else text.columns.droplevel("group")
    page = text.rename_axis(columns=[None] * text.columns.nlevels).to_html(border=0, table_id=table.name)
    return f"<h3>{title}</h3>\n{page}\n<p>{note}</p>\n"


def write_tables(tables: Iterable[Table], folder: str | Path) -> list[Path]:
    """Write each table as NAME.csv, .md and .tex, and all of them as tables.html. Returns the files."""
    folder, written, page = Path(folder), [], f'<!doctype html>\n<meta charset="utf-8">\n<style>{_STYLE}</style>\n'
    for table in tables:
        for suffix, render in ((".csv", as_csv), (".md", as_markdown), (".tex", as_latex)):
            written.append(folder / f"{table.name}{suffix}")
            write_atomic(written[-1], render(table).encode())
        page += as_html(table)
    write_atomic(folder / "tables.html", page.encode())
    return [*written, folder / "tables.html"]


def update_document(path: str | Path, tables: Sequence[Table], pairs: int) -> None:
    """Replace the marked tables of a Markdown file, without notes and columns of single categories.

    A table stands between the lines <!-- table NAME --> and <!-- end of table -->.
    """
    try:
        text = read_bytes(Path(path), "document").decode()
    except UnicodeDecodeError as error:
        raise InputError(f"document {path} is not UTF-8 text ({error})") from error
    by_name = {table.name: table for table in tables}
    marks, marked = _MARK.findall(text), [name for _, name, _, _ in _MARKED.findall(text)]
    if not marks or 2 * len(marked) != len(marks) or not set(marked) <= by_name.keys():
        expected = "<!-- table NAME --> and <!-- end of table --> for each table, with names out of"
        found = ", ".join(marks) or "of no table"
        raise InputError(f"document {path} has the marks {found}, expected {expected} {', '.join(by_name)}")

    def render(found: re.Match[str]) -> str:
        start, name, _, end = found.groups()
        cells = by_name[name].cells
        cells = cells.loc[:, [not re.fullmatch(r"\w+ Acc30", title) for _, title in cells.columns]]
        cells = cells.rename(columns=lambda group: group.removeprefix("this run").removeprefix(": "), level="group")
        return f"{start}{as_markdown(Table(name, f'{by_name[name].title} ({pairs:,} pairs)', cells))}\n{end}"

    write_atomic(path, _MARKED.sub(render, text).encode())


def _tex(text: str) -> str:
    """Escape text for LaTeX, with real minus signs and degrees."""
    text = re.sub(r"([%_&#$])", r"\\\1", text).replace("°", "$^\\circ$").replace("−", "$-$")
    return text
