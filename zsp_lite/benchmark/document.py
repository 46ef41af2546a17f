"""Update of the tables in a Markdown document, for example docs/results.md. A table stands between two marks:

<!-- table table_1 -->
(anything)
<!-- end of table -->
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from zsp_lite.benchmark.formats import as_markdown
from zsp_lite.benchmark.tables import THIS_RUN, Table
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

_MARKED = re.compile(r"(<!-- table (\S+) -->[ \t]*\r?\n)(.*?)(<!-- end of table -->)", re.DOTALL)
_MARK = re.compile(r"<!-- (table \S+|end of table) -->")
_CATEGORY = re.compile(r"\w+ Acc30")


def with_tables(text: str, tables: Sequence[Table], pairs: int) -> str:
    """Return the text with its marked tables replaced, without notes and columns of single categories.

    Args:
        text: Markdown text.
        tables: Tables of a run.
        pairs: Number of pairs, for the titles.

    Raises:
        InputError: There are no marks, a mark has no counterpart, or the run has no such table.
    """
    by_name = {table.name: table for table in tables}
    marks = _MARK.findall(text)
    if not marks:
        raise InputError("document has no marked table, expected <!-- table NAME --> and <!-- end of table -->")
    if 2 * len(_MARKED.findall(text)) != len(marks):
        raise InputError(f"document has the marks {', '.join(marks)}, expected a start and an end for each table")

    def fresh(found: re.Match[str]) -> str:
        start, name, _, end = found.groups()
        if name not in by_name:
            raise InputError(f"document has a mark for table {name}, the run has tables {', '.join(by_name)}")
        return f"{start}{as_markdown(_narrow(by_name[name], pairs))}\n{end}"

    return _MARKED.sub(fresh, text)


def update_document(path: str | Path, tables: Sequence[Table], pairs: int) -> None:
    """Update the tables in a Markdown file (see `with_tables`).

    Raises:
        InputError: The file is not UTF-8 text, or as for `with_tables`.
    """
    try:
        text = read_bytes(Path(path), "document").decode()
    except UnicodeDecodeError as error:
        raise InputError(f"document {path} is not UTF-8 text ({error})") from error
    write_atomic(path, with_tables(text, tables, pairs).encode())


def _narrow(table: Table, pairs: int) -> Table:
    kept = [i for i, column in enumerate(table.columns) if not _CATEGORY.fullmatch(column.title)]
    rows = tuple((label, tuple(cells[i] for i in kept)) for label, cells in table.rows)
    columns = [replace(table.columns[i], group=table.columns[i].group.removeprefix(THIS_RUN).removeprefix(": "))
               for i in kept]  # fmt: skip
    return Table(table.name, f"{table.title} ({pairs:,} pairs)", tuple(columns), rows)
