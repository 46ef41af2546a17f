"""Tables in the terminal: a table that is wider continues in the next line, and no figure
is cut."""

from collections.abc import Iterable, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable


def print_rows(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1
) -> None:
    """Print rows below their title; the first `texts` columns are aligned left, the others, with
    numbers, right."""
    table = RichTable(title=title)
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number < texts else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    _print_whole(table)


def print_table(table: Any) -> None:
    """Print a `Table` of a benchmark run: intervals below their figures, published figures dim."""
    from zsp_lite.benchmark.tables import PUBLISHED

    printed = RichTable(
        title=table.title,
        caption=table.note or None,
        box=SIMPLE_HEAD,
        pad_edge=False,
        caption_justify="left",
    )
    longest = max(map(len, table.text.index), default=0)
    # A row's name is folded, never cut off; up to 14 characters stay in one line.
    printed.add_column("", justify="left", min_width=min(longest, 14), overflow="fold")
    for title in table.text.columns:
        style = "dim" if title.startswith(PUBLISHED) else None
        # Titles of several lines keep columns narrow.
        title = title.replace(": ", "\n").replace(" (", "\n(").replace(" Acc30", "\nAcc30")
        printed.add_column(title, justify="right", style=style, header_style=style)
    for label, *cells in table.text.itertuples():
        printed.add_row(label, *(cell.replace(" [", "\n[") for cell in cells))
    _print_whole(printed)


def _print_whole(table: RichTable) -> None:
    """Print a table in its full width, also where the terminal is narrower."""
    console = Console(markup=False)  # names may hold brackets
    # 1000 characters are wider than any table.
    needed = console.measure(table, options=console.options.update(max_width=1000)).maximum
    Console(width=max(console.width, needed), markup=False).print(table)
