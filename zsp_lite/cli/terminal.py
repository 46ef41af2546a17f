"""Tables in the terminal: a table that is wider continues in the next line, and no figure is cut."""

from collections.abc import Iterable, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable


def print_rows(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> None:
    """Print rows below their title; the first `texts` columns are aligned left, the others, with numbers, right."""
    table = RichTable(title=title)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number < texts else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    _print_whole(table)


def print_tables(tables: Iterable[Any]) -> None:
    """Print every `Table` of a benchmark run."""
    for table in tables:
        _print_whole(as_rich(table))


def as_rich(table: Any) -> RichTable:
    """Format a `Table` of a benchmark run: intervals below their figures, published figures dim."""
    from zsp_lite.benchmark.tables import PUBLISHED

    made = RichTable(
        title=table.title, caption=table.note or None, caption_justify="left", box=SIMPLE_HEAD, pad_edge=False
    )
    longest = max(map(len, table.text.index), default=0)
    made.add_column("", justify="left", min_width=min(longest, 14), overflow="fold")  # a row's name is never cut off
    for group, title in table.text.columns:
        style = "dim" if group == PUBLISHED else None
        group = group.replace("this run: ", "").replace("this run", "").replace(" on ", "\non ").replace(" (", "\n(")
        title = title.replace(" (", "\n(").replace(" Acc30", "\nAcc30")
        made.add_column(f"{group}\n{title}" if group else title, justify="right", style=style, header_style=style)
    for label, *cells in table.text.itertuples():
        made.add_row(label, *(cell.replace(" [", "\n[") for cell in cells))
    return made


def _print_whole(table: RichTable) -> None:
    console = Console(markup=False)  # names may hold brackets
    needed = console.measure(table, options=console.options.update(max_width=1000)).maximum
    Console(width=max(console.width, needed), markup=False).print(table)
