"""Put the tables of the stored runs into the pages: python -m tools.results_page.

A table of a page stands between the lines <!-- table RUN NAME --> and <!-- end of table -->,
without its notes: the figures of the paper, over all categories.
"""

import re

from zsp_lite.benchmark.runs import read_run
from zsp_lite.benchmark.tables import PAPER, Table, as_markdown, every_table
from zsp_lite.choices import METRICS
from zsp_lite.io.files import REPOSITORY, write_atomic

RUNS = REPOSITORY / "notebooks" / "results" / "paper_run"
PAGE = REPOSITORY / "docs" / "results.md"
_FIGURES = [METRICS[name] for name in PAPER]
_MARKED = re.compile(r"(<!-- table (\w+) (\w+) -->\n)(.*?)(<!-- end of table -->)", re.DOTALL)


def updated(text: str) -> str:
    """Replace the marked tables of a page."""

    def render(found: re.Match[str]) -> str:
        start, run, name, _, end = found.groups()
        summary = read_run(RUNS / run).summary
        (table,) = [table for table in every_table(summary) if table.name == name]
        # A column is called FIGURE, or PART: FIGURE.
        columns = [column for column in table.cells if column.rpartition(": ")[2] in _FIGURES]
        pairs = max(method["n"] for method in summary["methods"].values())
        shown = Table(name, f"{table.title} ({pairs:,} pairs)", table.cells[columns])
        return f"{start}{as_markdown(shown)}\n{end}"

    return _MARKED.sub(render, text)


def main() -> None:
    """Update the page of results."""
    write_atomic(PAGE, updated(PAGE.read_text(encoding="utf-8")).encode())
    print(f"Written: {PAGE}")


if __name__ == "__main__":
    main()
