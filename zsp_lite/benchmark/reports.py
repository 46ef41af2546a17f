"""All that is made of a finished run: tables, figures, and the one file to keep."""

from pathlib import Path

from zsp_lite.benchmark.formats import write_tables
from zsp_lite.benchmark.results import RESULTS, Results, read_results, write_results
from zsp_lite.benchmark.tables import every_table


def write_reports(run: str | Path, out: str | Path | None = None) -> Results:
    """Tables, figures and `results.json.gz` of a run (its folder, or such a file), into `out` or its own folder.

    Raises InputError where it is no finished run.
    """
    # matplotlib takes a second to import, which a benchmark with nothing to draw need not wait for.
    from zsp_lite.benchmark.figures import write_figures

    results = read_results(run)
    out = Path(out) if out is not None else Path(run) if Path(run).is_dir() else Path(run).parent
    if Path(run).is_dir():
        write_results(results, out / RESULTS)
    write_tables(every_table(results.summary), out / "tables")
    write_figures(results, out / "figures")
    return results
