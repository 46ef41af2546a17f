"""The commands of the benchmark: `benchmark`, `tables`, `compare`."""

import logging
from pathlib import Path

import click

from zsp_lite.cli.common import (
    COUNT,
    PATH,
    backbone_config,
    backbone_options,
    examples,
    names,
    out_option,
    seed_option,
)
from zsp_lite.errors import InputError

_ROWS_SHOWN = 4  # rows of the table by category that fit in a terminal


@click.command(
    epilog=examples(
        "benchmark",
        "benchmark --data outputs/eval --pairs 30 --methods ours,rootsift --out outputs/compared",
        "benchmark --data outputs/eval --layer last --facet token --out outputs/tokens",
        "benchmark --data outputs/paper --methods paper --pairs 100 --workers 2",
        "benchmark --list",
    )
)
@click.option(
    "--data", type=PATH, metavar="DIR", show_default="$ZSP_LITE_DATA, else data_samples",
    help="Folder in CO3D's layout.",
)  # fmt: skip
@backbone_options
@click.option("--categories", type=names, metavar="A,B", show_default="all with pose labels", help="Categories.")
@click.option("--pairs", type=COUNT, metavar="N", default=30, help="Pairs per category.")
@click.option(
    "--targets", type=COUNT, metavar="N", default=5, help="Target views per pair, for methods that do not fix them."
)
@click.option(
    "--methods", type=names, metavar="A,B", default="default", show_default="ours,ours-bv,rootsift",
    help="Rows of the tables: methods, groups of methods, or your own as module:name. --list prints all.",
)  # fmt: skip
@click.option("--list", "list_only", is_flag=True, help="Print every method and group, and exit.")
@seed_option
@out_option("outputs/benchmark", "Folder for the results. An existing run is continued.")
@click.option("--workers", type=COUNT, metavar="N", default=1, help="Worker processes on this machine.")
@click.option(
    "--executor", metavar="WHERE",
    help="dask://HOST:PORT, or module:Class of an executor, called with the number of workers.",
)  # fmt: skip
@click.option(
    "--threads", type=COUNT, metavar="N", show_default="cores divided by workers",
    help="Threads per worker during feature extraction.",
)  # fmt: skip
@click.option("--cache", type=PATH, metavar="DIR", help="Folder that keeps features for other runs.")
@click.option(
    "--keep-hypotheses",
    is_flag=True,
    help="Store the ranked candidate poses of the verified solver, with their scores, terms and errors.",
)
@click.option(
    "--allow-other-version", is_flag=True, help="Continue a run of another version of zsp-lite; run.json lists both."
)
@click.option("--quiet", is_flag=True, help="Print no progress bar and no tables.")
def benchmark(
    data: Path | None, categories: list[str] | None, pairs: int, targets: int, methods: list[str], list_only: bool,
    seed: int, out: Path, workers: int, executor: str | None, threads: int | None, cache: Path | None,
    keep_hypotheses: bool, allow_other_version: bool, quiet: bool, **backbone,
) -> None:  # fmt: skip
    """Measure rotation errors over many pairs, and write tables, figures and results."""
    if list_only:
        return _list_methods()
    import matplotlib

    matplotlib.use("Agg")  # figures are written to files, without a display
    from rich.console import Console
    from tqdm import tqdm

    from zsp_lite.benchmark.reports import write_reports
    from zsp_lite.benchmark.run import evaluate
    from zsp_lite.benchmark.tables import all_rows, best_two_tables, by_category, paper_tables
    from zsp_lite.cli.terminal import print_tables
    from zsp_lite.data.samples import data_folders, sample_data

    origin, root = data_folders(data)[0]
    root = sample_data() if origin == "data_samples" else root
    config = backbone_config(**backbone)
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

        summary = evaluate(
            root, config, methods, pairs, targets, seed, out, categories, progress, executor=executor, workers=workers,
            threads=threads, cache=cache, keep_hypotheses=keep_hypotheses, allow_other_version=allow_other_version,
        )  # fmt: skip
    write_reports(out)
    if quiet:
        return None
    console = Console(markup=False)  # names may hold brackets
    title = f"{root}, backbone {summary['backbone']}, {targets} target views"
    console.print(title, soft_wrap=True, highlight=False)
    shown = [all_rows(summary), *best_two_tables(summary)]
    shown += paper_tables(summary) if len(summary["methods"]) > 3 else []
    print_tables([*shown, by_category(summary, list(summary["methods"])[:_ROWS_SHOWN])])
    if cost := summary.get("cost"):
        console.print(
            f"Compute: {cost['all_rows']:.0f} s for all rows, {cost['ratio']:.2f} times the {cost['ours_alone']:.0f} s "
            'of "ours" alone: all rows share the features of a frame.',
            highlight=False,
        )
    console.print(f"Written: {out / 'summary.json'}, tables/, figures/, results.json.gz", soft_wrap=True)
    return None


def _list_methods() -> None:
    from zsp_lite.benchmark.methods import GROUPS, METHODS

    for name, method in METHODS.items():
        parts = [f"features {method.features}"] if method.features != "backbone" else []
        parts += [method.answer] if method.answer != "pose" else []
        parts += [f"{key}={value}" for key, value in method.settings.items()]
        parts += [f"{method.targets} target views"] if method.targets else []
        if method.solve:
            kind = method.solve if hasattr(method.solve, "__name__") else type(method.solve)
            parts.append(f"{kind.__module__}:{kind.__name__}")
        print(f"{name:20} {', '.join(parts) or 'the paper, K = 50 with k-means'}")
    print("\nGroups:")
    for name, members in GROUPS.items():
        print(f"{name:20} {', '.join(members)}")


@click.command(
    epilog=examples(
        "tables outputs/benchmark",
        "tables outputs/seed0 outputs/seed1 outputs/seed2",
        "tables results.json.gz --out outputs/tables",
        "tables notebooks/results/paper_run/procedural.json.gz --into docs/results.md",
    )
)
@click.argument("sources", type=PATH, nargs=-1, required=True, metavar="RUN...")
@click.option(
    "--out", type=PATH, metavar="DIR", show_default="the run's folder; none for several runs", help="Folder to write."
)
@click.option(
    "--by-category", type=names, metavar="ROW,...", show_default=f"the first {_ROWS_SHOWN}",
    help="Rows of the table by category in the terminal; the files have all.",
)  # fmt: skip
@click.option("--into", type=PATH, metavar="FILE", help="Only update the marked tables of this Markdown file.")
def tables(sources: tuple[Path, ...], out: Path | None, by_category: list[str] | None, into: Path | None) -> None:
    """Write tables and figures of a benchmark run, or of several runs on different objects, pooled.

    RUN is a run's folder or its results.json.gz.
    """
    if into:
        if out:
            raise InputError("tables: --into writes no folder; expected it without --out")
        return _update_document(sources, into)
    import matplotlib

    matplotlib.use("Agg")
    from zsp_lite.benchmark import tables as build
    from zsp_lite.benchmark.reports import write_reports
    from zsp_lite.benchmark.results import read_runs
    from zsp_lite.cli.terminal import print_tables

    write = len(sources) == 1 or out
    summary = (write_reports(sources, out) if write else read_runs(sources)).summary
    rows = by_category or list(summary["methods"])[:_ROWS_SHOWN]
    shown = [build.all_rows(summary), *build.best_two_tables(summary), *build.paper_tables(summary)]
    print_tables([*shown, build.by_category(summary, rows)])
    return None


def _update_document(sources: tuple[Path, ...], document: Path) -> None:
    from zsp_lite.benchmark.formats import update_document
    from zsp_lite.benchmark.results import read_runs
    from zsp_lite.benchmark.tables import every_table

    summary = read_runs(sources).summary
    update_document(document, every_table(summary), max(row["n"] for row in summary["methods"].values()))
    print(f"Written: {document}")


@click.command(
    epilog=examples(
        "compare outputs/a outputs/b",
        "compare outputs/a outputs/a --rows ours:rootsift,ours:ours-mask",
    )
)
@click.argument("first", type=PATH, metavar="RUN_A")
@click.argument("second", type=PATH, metavar="RUN_B")
@click.option(
    "--rows", type=names, metavar="A:B,...", show_default="all rows that both runs have",
    help="Rows of RUN_A against rows of RUN_B; A alone stands for A:A.",
)  # fmt: skip
@click.option("--out", type=PATH, metavar="DIR", help="Folder to write the table to.")
def compare(first: Path, second: Path, rows: list[str] | None, out: Path | None) -> None:
    """Compare two benchmark runs on their common pairs, with intervals over objects and tests of significance.

    RUN_A and RUN_B are folders of runs or files results.json.gz.
    """
    from zsp_lite.benchmark.compare import compare as compare_runs
    from zsp_lite.benchmark.compare import comparison_table, split_rows
    from zsp_lite.benchmark.formats import write_tables
    from zsp_lite.benchmark.results import read_results
    from zsp_lite.cli.terminal import print_tables

    runs = read_results(first), read_results(second)
    found = compare_runs(*runs, [split_rows(text, *runs) for text in rows] if rows else None)
    table = comparison_table(found, str(first), str(second))
    print_tables([table])
    if out:
        write_tables([table], out)
