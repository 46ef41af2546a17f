"""Tables as CSV, Markdown, LaTeX and HTML, and inside a Markdown document."""

import html
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from zsp_lite.benchmark.tables import THIS_RUN, Cell, Table
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

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
    for title, cells in zip(_titles(table), table.cells.T.values, strict=True):
        columns[title] = [cell.value if isinstance(cell, Cell) else cell for cell in cells]
        for bound in ("low", "high"):
            values = [getattr(cell, bound, None) for cell in cells]
            if any(value is not None for value in values):
                columns[f"{title} {bound}"] = values
    return pd.DataFrame(columns, table.cells.index, dtype=object).to_csv(index_label="row")


def as_markdown(table: Table) -> str:
    """Format as a pipe table under its title."""
    lines = [["", *_titles(table)], *([label, *cells] for label, *cells in table.text.itertuples())]
    first, *others = ("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)
    rule = "|---|" + "---:|" * len(table.cells.columns)
    note = ["", table.note] if table.note else []
    return "\n".join([f"**{table.title}**", "", first, rule, *others, *note]) + "\n"


def as_latex(table: Table) -> str:
    """Format as a booktabs table."""
    caption = re.sub(r"([%_&#$])", r"\\\1", f"{table.title}. {table.note}".strip())
    layout = "l" + "r" * len(table.cells.columns)
    return _frame(table).to_latex(escape=True, caption=caption, column_format=layout, multicolumn_format="c")


def as_html(table: Table) -> str:
    """Format as an HTML table with its title and note."""
    title, note = (html.escape(text) for text in (table.title, table.note))
    return f"<h3>{title}</h3>\n{_frame(table).to_html(border=0, table_id=table.name)}\n<p>{note}</p>\n"


def write_tables(tables: Iterable[Table], folder: str | Path) -> list[Path]:
    """Write each table as NAME.csv, .md, .tex and .html, and all of them as tables.html. Returns the files."""
    folder, written, pages = Path(folder), [], []
    for table in tables:
        for suffix, render in ((".csv", as_csv), (".md", as_markdown), (".tex", as_latex), (".html", as_html)):
            written.append(folder / f"{table.name}{suffix}")
            write_atomic(written[-1], render(table).encode())
        pages.append(as_html(table))
    page = f'<!doctype html>\n<meta charset="utf-8">\n<title>zsp-lite benchmark</title>\n<style>{_STYLE}</style>\n'
    write_atomic(folder / "tables.html", (page + "\n".join(pages)).encode())
    return [*written, folder / "tables.html"]


def insert_tables(text: str, tables: Sequence[Table], pairs: int) -> str:
    """Replace the marked tables of a Markdown text, without notes and columns of single categories.

    A table stands between the lines <!-- table NAME --> and <!-- end of table -->.
    """
    by_name = {table.name: table for table in tables}
    marks, marked = _MARK.findall(text), [name for _, name, _, _ in _MARKED.findall(text)]
    if not marks or 2 * len(marked) != len(marks) or not set(marked) <= by_name.keys():
        expected = "<!-- table NAME --> and <!-- end of table --> for each table, with names out of"
        found = ", ".join(marks) or "of no table"
        raise InputError(f"document has the marks {found}, expected {expected} {', '.join(by_name)}")

    def render(found: re.Match[str]) -> str:
        start, name, _, end = found.groups()
        table = by_name[name]
        cells = table.cells.loc[:, [not re.fullmatch(r"\w+ Acc30", title) for _, title in table.cells.columns]]
        short = Table(name, f"{table.title} ({pairs:,} pairs)", cells.rename(columns=short_group, level="group"))
        return f"{start}{as_markdown(short)}\n{end}"

    return _MARKED.sub(render, text)


def update_document(path: str | Path, tables: Sequence[Table], pairs: int) -> None:
    """Replace the marked tables of a Markdown file (see `insert_tables`)."""
    try:
        text = read_bytes(Path(path), "document").decode()
    except UnicodeDecodeError as error:
        raise InputError(f"document {path} is not UTF-8 text ({error})") from error
    write_atomic(path, insert_tables(text, tables, pairs).encode())


def short_group(group: str) -> str:
    """Return the heading of a group of columns without "this run"."""
    return group.removeprefix(THIS_RUN).removeprefix(": ")


def _titles(table: Table) -> list[str]:
    return [f"{group}: {title}" if group else title for group, title in table.cells.columns]


def _frame(table: Table) -> pd.DataFrame:
    """The table's text, without the level of groups where there are none."""
    text = table.text
    text.columns = text.columns if any(text.columns.get_level_values("group")) else text.columns.droplevel("group")
    return text.rename_axis(columns=[None] * text.columns.nlevels)
