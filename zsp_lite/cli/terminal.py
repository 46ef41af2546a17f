"""Tables of a benchmark run in the terminal."""

from collections.abc import Iterable

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table as RichTable

from zsp_lite.benchmark.formats import short_group
from zsp_lite.benchmark.tables import PUBLISHED, Table


def as_rich(table: Table) -> RichTable:
    """Format for a terminal: intervals below their figures, published figures dim."""
    made = RichTable(
        title=table.title, caption=table.note or None, caption_justify="left", box=SIMPLE_HEAD, pad_edge=False
    )
    longest = max(map(len, table.text.index), default=0)
    made.add_column("", justify="left", min_width=min(longest, 14), overflow="fold")  # a row's name is never cut off
    for group, title in table.text.columns:
        style = "dim" if group == PUBLISHED else None
        group = short_group(group).replace(" on ", "\non ").replace(" (", "\n(")
        title = title.replace(" (", "\n(").replace(" Acc30", "\nAcc30")
        made.add_column(f"{group}\n{title}" if group else title, justify="right", style=style, header_style=style)
    for label, *cells in table.text.itertuples():
        made.add_row(label, *(cell.replace(" [", "\n[") for cell in cells))
    return made


def print_tables(tables: Iterable[Table]) -> None:
    """Print to the terminal; lines that are wider continue in the next one, and no figure is cut."""
    console = Console(markup=False)  # names may hold brackets
    for table in tables:
        made = as_rich(table)
        needed = console.measure(made, options=console.options.update(max_width=1000)).maximum
        Console(width=max(console.width, needed), markup=False).print(made)
