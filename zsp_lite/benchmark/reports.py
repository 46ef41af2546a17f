"""Reports of a run: tables, figures, and an export of its results."""

from collections.abc import Sequence
from pathlib import Path

from zsp_lite.benchmark.formats import write_tables
from zsp_lite.benchmark.results import RESULTS, Results, export_results, read_runs
from zsp_lite.benchmark.tables import every_table


def write_reports(run: str | Path | Sequence[str | Path], out: str | Path | None = None) -> Results:
    """Write tables, figures and `results.json.gz` of a run, or of several that are pooled; by default to its folder."""
    # Imported here, because matplotlib takes a second to import.
    from zsp_lite.benchmark.figures import write_figures

    paths = [Path(run)] if isinstance(run, str | Path) else list(map(Path, run))
    results = read_runs(paths)
    folder = paths[0] if paths[0].is_dir() else paths[0].parent
    out = folder if out is None else Path(out)
    if len(paths) > 1 or paths[0].is_dir():
        export_results(results, out / RESULTS)
    write_tables(every_table(results.summary), out / "tables")
    write_figures(results, out / "figures")
    return results
