"""Comparison of two runs, or of two rows, on the same pairs, and the reports of a run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from zsp_lite.benchmark.runs import Run, export_run, read_runs
from zsp_lite.benchmark.statistics import paired_difference
from zsp_lite.benchmark.summary import draws_of
from zsp_lite.benchmark.tables import Cell, Table, every_table, make_table, write_tables
from zsp_lite.choices import METRICS_SHOWN
from zsp_lite.errors import InputError
from zsp_lite.metrics import accuracy, median


def compare(first: Run, second: Run, rows: Sequence[tuple[str, str]] | None = None) -> dict[str, dict[str, Any]]:
    """Compare rows of two runs on the pairs that both have evaluated.

    Args:
        first: Run A.
        second: Run B.
        rows: (row of A, row of B); by default every row that both runs have, with itself.

    Returns:
        By "A:B", the number of pairs "n", "acc30" and "median" of A and of B, and `statistics.paired_difference`: B
        minus A in Acc30, and by how much the mean error drops.

    Raises:
        InputError: If there is no common row or pair.
    """
    found = {}
    known = [run.table["row"].unique() for run in (first, second)]
    for one, other in [(name, name) for name in known[0] if name in known[1]] if rows is None else rows:
        both = first.row(one).join(second.row(other)["error"].rename("other"), how="inner").sort_index()
        if both.empty:
            raise InputError(f"rows {one} and {other} have no pair in common: other data or number of views")
        errors = both[["error", "other"]].to_numpy().T
        found[one if one == other else f"{one}:{other}"] = {
            "n": len(both), "acc30": accuracy(errors, 30).tolist(), "median": median(errors).tolist(),
            **paired_difference(*errors, weights=draws_of(both)),
        }  # fmt: skip
    if not found:
        raise InputError(f"runs have no row in common: {', '.join(known[0])} and {', '.join(known[1])}")
    return found


def split_rows(text: str, first: Run, second: Run) -> tuple[str, str]:
    """Split "A:B" into a row of each run; "A" stands for the row A of both. Names of rows may hold colons."""
    of_first, of_second = ([*run.table["row"].unique()] for run in (first, second))
    colons = [i for i, sign in enumerate(text) if sign == ":"]
    for one, other in ((text, text), *((text[:i], text[i + 1 :]) for i in colons)):
        if one in of_first and other in of_second:
            return one, other
    expected = f"A:B or A with A one of {', '.join(of_first)} and B one of {', '.join(of_second)}"
    raise InputError(f"rows {text!r}: not in the runs, expected {expected}")


def comparison_table(differences: dict[str, dict[str, Any]], first: str, second: str) -> Table:
    """Tabulate differences; `first` and `second` name the runs."""
    groups = "Acc30 (%)", "error (°)"
    columns = [("", "pairs"), *((groups[0], title) for title in ("A", "B", "B − A", "p"))]
    columns += [(groups[1], title) for title in ("median of A", "median of B", "mean of A − B", "p")]
    rows = {}
    for name, one in differences.items():
        cells = [Cell(one["n"], decimals=0)]
        for figures, gain in (("acc30", "accuracy_gain"), ("median", "error_drop")):
            cells += [*map(Cell, one[figures]), Cell(one[gain], *one[f"{gain}_ci"]), Cell(one[f"{gain}_p"], decimals=3)]
        rows[name] = cells
    note = (
        "On the common pairs. Intervals (95 %) and p: bootstrap over objects. Of twenty rows without a difference, one "
        "has p < 0.05 by chance."
    )
    return make_table("compare", f"A = {first}, B = {second}", columns, rows, note, columns[1:4])


def write_reports(
    runs: str | Path | Sequence[str | Path], out: str | Path | None = None, metrics: Sequence[str] = METRICS_SHOWN
) -> Run:
    """Write tables and figures of a run, or of several that are pooled, by default to its folder, and its export."""
    # Imported here, because matplotlib takes a second to import.
    from zsp_lite.benchmark.figures import write_figures

    paths = [Path(runs)] if isinstance(runs, str | Path) else list(map(Path, runs))
    run, folder = read_runs(paths), paths[0] if paths[0].is_dir() else paths[0].parent
    if len(paths) == 1 and paths[0].is_dir():
        export_run(paths[0])
    out = folder if out is None else Path(out)
    write_tables(every_table(run.summary, metrics), out / "tables")
    write_figures(run, out / "figures")
    return run
