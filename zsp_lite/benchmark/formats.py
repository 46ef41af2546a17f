"""A table as rich text, CSV, Markdown, LaTeX and HTML."""

import csv
import html
import io
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable

from zsp_lite.benchmark.tables import OTHER_DATA, THIS_RUN, Cell, Table
from zsp_lite.io.files import write_atomic

_NOTHING = "–"
_LATEX = str.maketrans(
    {sign: f"\\{sign}" for sign in "%_&#{}$"}
    | {"\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}"}
    | {"°": "$^\\circ$", "–": "--"}
)


def as_rich(table: Table) -> RichTable:
    """Return the table for a terminal: intervals on a second line, published results dimmed."""
    made = RichTable(
        title=table.title, caption=table.note or None, caption_justify="left", box=SIMPLE_HEAD, pad_edge=False
    )
    longest = max((len(label) for label, _ in table.rows), default=0)
    made.add_column("", justify="left", min_width=min(longest, 14), overflow="fold")  # names of rows are not truncated
    for column in table.columns:
        group = column.group.removeprefix(THIS_RUN).removeprefix(": ")
        title = column.title.replace(" (", "\n(").replace(" Acc30", "\nAcc30")
        group = group.replace(" on ", "\non ").replace(" (", "\n(")
        style = "dim" if column.group == OTHER_DATA else None
        made.add_column(f"{group}\n{title}" if group else title, justify="right", style=style, header_style=style)
    for label, cells in table.rows:
        made.add_row(label, *(_text(cell).replace(" [", "\n[") for cell in cells))
    return made


def print_tables(tables: Iterable[Table]) -> None:
    """Print tables to the terminal. Lines that are wider than the terminal are wrapped and not truncated."""
    console = Console()
    for table in tables:
        made = as_rich(table)
        needed = console.measure(made, options=console.options.update(max_width=1000)).maximum
        Console(width=max(console.width, needed)).print(made)


def as_csv(table: Table) -> str:
    """Return the table as CSV; the ends of an interval are two further columns."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    intervals = [any(isinstance(cells[i], Cell) and cells[i].low is not None for _, cells in table.rows)
                 for i in range(len(table.columns))]  # fmt: skip
    header = ["row"]
    for title, interval in zip(_flat_titles(table, ": "), intervals, strict=True):
        header += [title, f"{title} low", f"{title} high"] if interval else [title]
    writer.writerow(header)
    for label, cells in table.rows:
        line: list[object] = [label]
        for cell, interval in zip(cells, intervals, strict=True):
            values = (cell.value, cell.low, cell.high) if isinstance(cell, Cell) else (cell, None, None)
            line += ["" if value is None else value for value in (values if interval else values[:1])]
        writer.writerow(line)
    return stream.getvalue()


def as_markdown(table: Table) -> str:
    """Return the table as a Markdown table below its title."""
    titles = _flat_titles(table, ": ")
    lines = [f"**{table.title}**", "", _piped(["", *titles]), "|---|" + "---:|" * len(titles)]
    lines += [_piped([label, *map(_text, cells)]) for label, cells in table.rows]
    return "\n".join([*lines, *(["", table.note] if table.note else [])]) + "\n"


def _piped(cells: Sequence[str]) -> str:
    """Return one line of a Markdown table."""
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def as_latex(table: Table) -> str:
    """Return the table as LaTeX; it needs the package booktabs."""
    groups = _groups(table)
    lines = ["\\begin{table}", "\\centering", f"\\caption{{{_latex(table.title)}. {_latex(table.note)}}}",
             f"\\begin{{tabular}}{{l{'r' * len(table.columns)}}}", "\\toprule"]  # fmt: skip
    if any(group for group, _ in groups):
        lines.append("".join(f" & \\multicolumn{{{n}}}{{c}}{{{_latex(group)}}}" for group, n in groups) + " \\\\")
        start = 2
        for group, n in groups:
            lines.append(f"\\cmidrule(lr){{{start}-{start + n - 1}}}" if group else "")
            start += n
    lines += [" & ".join(["", *(_latex(column.title) for column in table.columns)]) + " \\\\", "\\midrule"]
    lines += [" & ".join([_latex(label), *(_latex(_text(cell)) for cell in cells)]) + " \\\\"
              for label, cells in table.rows]  # fmt: skip
    lines += ["\\bottomrule", "\\end{tabular}", "\\end{table}"]
    return "\n".join(line for line in lines if line) + "\n"


def as_html(table: Table) -> str:
    """Return the table as an HTML element; cells with published results have the class "published"."""

    def cell(tag: str, text: str, group: str, span: int = 1) -> str:
        kind = ' class="published"' if group.startswith("published") else ""
        wide = f' colspan="{span}"' if span > 1 else ""
        return f"<{tag}{kind}{wide}>{html.escape(text)}</{tag}>"

    head = ["<tr><th></th>" + "".join(cell("th", group, group, n) for group, n in _groups(table)) + "</tr>"]
    head.append("<tr><th></th>" + "".join(cell("th", c.title, c.group) for c in table.columns) + "</tr>")
    body = ["<tr><th>" + html.escape(label) + "</th>"
            + "".join(cell("td", _text(one), column.group) for one, column in zip(cells, table.columns, strict=True))
            + "</tr>" for label, cells in table.rows]  # fmt: skip
    note = f"\n<p>{html.escape(table.note)}</p>" if table.note else ""
    return (
        f'<table id="{html.escape(table.name)}">\n<caption>{html.escape(table.title)}</caption>\n<thead>\n'
        + "\n".join(head)
        + "\n</thead>\n<tbody>\n"
        + "\n".join(body)
        + "\n</tbody>\n</table>"
        + note
        + "\n"
    )


def write_tables(tables: Iterable[Table], folder: str | Path) -> list[Path]:
    """Write each table as NAME.csv, .md, .tex and .html to the folder, and all of them to tables.html."""
    folder, written, pages = Path(folder), [], []
    for table in tables:
        for suffix, render in ((".csv", as_csv), (".md", as_markdown), (".tex", as_latex), (".html", as_html)):
            path = folder / f"{table.name}{suffix}"
            write_atomic(path, render(table).encode())
            written.append(path)
        pages.append(as_html(table))
    page = f'<!doctype html>\n<meta charset="utf-8">\n<title>zsp-lite benchmark</title>\n<style>{_STYLE}</style>\n'
    write_atomic(folder / "tables.html", (page + "\n".join(pages)).encode())
    return [*written, folder / "tables.html"]


_STYLE = """
body { font-family: sans-serif; margin: 2em; } table { border-collapse: collapse; margin: 2em 0 0.5em; }
caption { font-weight: bold; text-align: left; padding: 0.3em 0; } th, td { padding: 0.2em 0.7em; text-align: right; }
tbody th { text-align: left; font-weight: normal; } thead { border-bottom: 1px solid; }
.published { color: #666; font-style: italic; border-left: 1px dotted #bbb; } p { color: #444; max-width: 60em; }
"""


def _flat_titles(table: Table, joint: str) -> list[str]:
    return [f"{column.group}{joint}{column.title}" if column.group else column.title for column in table.columns]


def _groups(table: Table) -> list[tuple[str, int]]:
    return [(group, len(list(columns))) for group, columns in groupby(column.group for column in table.columns)]


def _text(cell: Cell | str | None) -> str:
    if cell is None:
        return _NOTHING
    if isinstance(cell, str):
        return cell
    if cell.p_value:
        return "< 0.001" if cell.value < 0.001 else f"{cell.value:.3f}"
    text = f"{cell.value:.{cell.decimals}f}"
    if cell.low is None or cell.high is None:
        return text
    return f"{text} [{cell.low:.{cell.decimals}f}, {cell.high:.{cell.decimals}f}]"


def _latex(text: str) -> str:
    return text.translate(_LATEX)
