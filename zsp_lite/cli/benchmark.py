"""The commands of the benchmark: `benchmark`, `tables`, `compare`."""

import logging

import click

from zsp_lite.cli.common import COUNT, NAMES, PATH, backbone_options, examples, refuse_options, seed_option

_ROWS_SHOWN = 4  # rows of the table by category that fit in a terminal


@click.command(
    epilog=examples(
        "benchmark",
        "benchmark --data outputs/paper17 --pairs 15 --methods ours,rootsift --out outputs/compared",
        "benchmark --list",
    )
)
@click.option(
    "--data",
    type=PATH,
    envvar="ZSP_LITE_DATA",
    show_default="$ZSP_LITE_DATA, else data_samples",
    help="Folder in CO3D's layout.",
)
@backbone_options
@click.option("--categories", type=NAMES, show_default="all with pose labels", help="Categories.")
@click.option("--pairs", type=COUNT, default=30, help="Pairs per category.")
@click.option("--targets", type=COUNT, default=5, help="Target views per pair, for methods that do not fix them.")
@click.option("--methods", type=NAMES, default="default", help="Rows or groups of rows, see --list, or module:name.")
@click.option("--list", "list_only", is_flag=True, help="Print every method and group, and exit.")
@seed_option
@click.option("--out", type=PATH, default="outputs/benchmark", help="Folder; an existing run is continued.")
@click.option("--workers", type=COUNT, default=1, help="Worker processes on this machine.")
@click.option(
    "--executor", metavar="WHERE", help="dask://HOST:PORT, or module:Class, called with the number of workers."
)
@click.option("--threads", type=COUNT, show_default="cores divided by workers", help="Threads per worker for features.")
@click.option("--keep-hypotheses", is_flag=True, help="Store the candidate poses of the verified solver with scores.")
@click.option("--allow-other-version", is_flag=True, help="Continue a run of another version; run.json lists both.")
@click.option("--quiet", is_flag=True, help="Print no progress bar and no tables.")
def benchmark(data, backbone, categories, pairs, targets, methods, list_only, seed, out, quiet, **execution) -> None:
    """Measure rotation errors over many pairs, and write tables, figures and results."""
    if list_only:
        return _list_methods()
    from tqdm import tqdm

    from zsp_lite.benchmark.reports import write_reports
    from zsp_lite.benchmark.run import evaluate
    from zsp_lite.samples import sample_data

    root = data or sample_data()
    if quiet:
        logging.getLogger("zsp_lite").setLevel(logging.WARNING)
    # `delay` keeps the terminal empty where the input is refused; `disable=None` hides the bar outside a terminal.
    with tqdm(unit="pair", delay=1, disable=True if quiet else None) as bar:

        def progress(done: int, total: int) -> None:
            if bar.total is None:
                # Pairs of an earlier run do not count towards the rate.
                bar.total, bar.initial, bar.n = total, done - 1, done - 1
                bar.unpause()
            bar.update(done - bar.n)

        summary = evaluate(root, backbone, methods, pairs, targets, seed, out, categories, progress, **execution)
    write_reports(out)
    if not quiet:
        print(f"{root}, backbone {summary['backbone']}, {targets} target views")
        _print_summary(summary, with_paper=len(summary["methods"]) > 3)
        print(f"Written: {out / 'summary.json'}, tables/, figures/, results.json.gz")
    return None


def _list_methods() -> None:
    from zsp_lite.benchmark.methods import GROUPS, METHODS

    for name, method in METHODS.items():
        settings = "".join(f", {key}={value}" for key, value in method.settings.items())
        views = f", {method.targets} target views" if method.targets else ""
        print(f"{name:20} features: {method.features}, answer: {method.answer}{settings}{views}")
    print("\nGroups:")
    for name, members in GROUPS.items():
        print(f"{name:20} {', '.join(members)}")


def _print_summary(summary: dict, with_paper: bool) -> None:
    """Print the tables of a summary, with those of the paper or without."""
    from zsp_lite.benchmark import tables
    from zsp_lite.cli.terminal import print_tables

    paper = tables.paper_tables(summary) if with_paper else []
    by_category = tables.by_category(summary, list(summary["methods"])[:_ROWS_SHOWN])
    print_tables([tables.all_rows(summary), *tables.best_two_tables(summary), *paper, by_category])


@click.command(
    epilog=examples(
        "tables outputs/benchmark",
        "tables outputs/seed0 outputs/seed1 --out outputs/tables",
        "tables notebooks/results/paper_run/procedural.json.gz --into docs/results.md",
    )
)
@click.argument("runs", type=PATH, nargs=-1, required=True)
@click.option("--out", type=PATH, show_default="the run's folder; none for several runs", help="Folder to write.")
@click.option("--into", type=PATH, help="Only update the marked tables of this Markdown file.")
def tables(runs, out, into) -> None:
    """Write tables and figures of a benchmark run, or of several runs on different objects, pooled.

    A run is its folder or its results.json.gz.
    """
    from zsp_lite.benchmark.formats import update_document
    from zsp_lite.benchmark.reports import write_reports
    from zsp_lite.benchmark.results import read_runs
    from zsp_lite.benchmark.tables import every_table

    if into:
        refuse_options({"out": out}, (), "--into")
        summary = read_runs(runs).summary
        update_document(into, every_table(summary), max(row["n"] for row in summary["methods"].values()))
        print(f"Written: {into}")
    else:
        found = write_reports(runs, out) if len(runs) == 1 or out else read_runs(runs)
        _print_summary(found.summary, with_paper=True)


@click.command(epilog=examples("compare outputs/a outputs/b", "compare outputs/a outputs/a --rows ours:rootsift"))
@click.argument("run_a", type=PATH)
@click.argument("run_b", type=PATH)
@click.option("--rows", type=NAMES, show_default="all common rows", help="A:B for row A of RUN_A and B of RUN_B, or A.")
@click.option("--out", type=PATH, help="Folder to write the table to.")
def compare(run_a, run_b, rows, out) -> None:
    """Compare two benchmark runs on their common pairs, with intervals over objects and tests of significance.

    RUN_A and RUN_B are folders of runs or files results.json.gz.
    """
    from zsp_lite.benchmark.compare import compare as compare_runs
    from zsp_lite.benchmark.compare import comparison_table, split_rows
    from zsp_lite.benchmark.formats import write_tables
    from zsp_lite.benchmark.results import read_results
    from zsp_lite.cli.terminal import print_tables

    results = read_results(run_a), read_results(run_b)
    found = compare_runs(*results, [split_rows(text, *results) for text in rows] if rows else None)
    table = comparison_table(found, str(run_a), str(run_b))
    print_tables([table])
    if out:
        write_tables([table], out)
