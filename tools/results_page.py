"""Put the tables of the stored runs into the pages: python -m tools.results_page.

A table of a page stands between the lines <!-- table RUN NAME --> and <!-- end of table -->. It has
the columns with the measures of the paper, over all categories, and no notes. The gains of the
parts stand after <!-- gains -->.
"""

import re

import numpy as np

from zsp_lite.benchmark.runs import read_run
from zsp_lite.benchmark.tables import PAPER, Table, as_markdown, every_table
from zsp_lite.choices import METRICS
from zsp_lite.course.gains import gains
from zsp_lite.io.files import REPOSITORY, write_atomic

RUNS = REPOSITORY / "notebooks" / "results" / "paper_run"
PAGE = REPOSITORY / "docs" / "results.md"
_MEASURES = [METRICS[name] for name in PAPER]  # as they are called in the heads of tables
_GAINS = re.compile(r"(<!-- gains -->\n)(.*?)(<!-- end of table -->)", re.DOTALL)
_MARKED = re.compile(r"(<!-- table (\w+) (\w+) -->\n)(.*?)(<!-- end of table -->)", re.DOTALL)


def updated(text: str) -> str:
    """Replace the marked tables of a page."""

    def render(marked: re.Match[str]) -> str:
        start, run, name, _, end = marked.groups()
        summary = read_run(RUNS / run).summary
        (table,) = [table for table in every_table(summary) if table.name == name]
        # A column is called MEASURE, or PART: MEASURE.
        columns = [column for column in table.cells if column.rpartition(": ")[2] in _MEASURES]
        # Some methods may be evaluated on a part of the pairs only.
        pairs = max(method["n"] for method in summary["methods"].values())
        shown = Table(name, f"{table.title} ({pairs:,} pairs)", table.cells[columns])
        return f"{start}{as_markdown(shown)}\n{end}"

    runs = {name: read_run(RUNS / name).table for name in ("procedural", "artists")}
    lines = ["|part|procedural|artist-made|paper, CO3D|", "|---|---:|---:|---:|"]
    for (_, part), (*ours, paper) in gains(runs).iterrows():
        cells = [f"{gain:+.1f} [{low:.1f}, {high:.1f}]" for gain, low, high in ours]
        cells.append("–" if np.isnan(paper) else f"{paper:+.1f}")
        lines.append(f"|{part}|{'|'.join(cells)}|")
    # chr(10) is the line break: an f-string of Python 3.11 has no backslash in braces.
    text = _GAINS.sub(lambda found: f"{found[1]}{chr(10).join(lines)}\n{found[3]}", text)
    return _MARKED.sub(render, text)


def main() -> None:
    """Update the page of results."""
    write_atomic(PAGE, updated(PAGE.read_text(encoding="utf-8")).encode())
    print(f"Written: {PAGE}")


if __name__ == "__main__":
    main()
