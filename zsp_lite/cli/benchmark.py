"""The commands of the benchmark: `benchmark`, `tables`, `compare`."""

import logging
import textwrap

import click

from zsp_lite.choices import METRICS, METRICS_SHOWN
from zsp_lite.cli.common import (
    COUNT,
    NAMES,
    PATH,
    Parsed,
    backbone_options,
    examples,
    workers_option,
)

_ROWS_SHOWN = 4  # rows of the table by category that fit in a terminal
metrics_option = click.option(
    "--metrics",
    type=Parsed(
        "a,b",
        parse=lambda text: list(dict.fromkeys(text.split(","))),
        valid=set(METRICS).issuperset,
        expected=", ".join(METRICS),
    ),
    default=",".join(METRICS_SHOWN),
    help=f"Figures in the table of all rows: {', '.join(METRICS)}.",
)


@click.command(
    epilog=examples(
        "benchmark",
        "benchmark --data outputs/paper17 --pairs 15 --methods ours,rootsift --out "
        "outputs/compared",
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
@click.option("--categories", type=NAMES, show_default="all with pose labels", help="Their names.")
@click.option("--pairs", type=COUNT, default=30, help="Pairs per category.")
@click.option(
    "--targets",
    type=COUNT,
    default=5,
    help="Target views per pair, for methods that do not fix them.",
)
@click.option(
    "--methods",
    type=NAMES,
    default="default",
    help="Rows or groups of rows, see --list; NAME=module:thing or NAME=poses.csv for your own.",
)
@click.option(
    "--seeds", type=COUNT, default=1, help="Evaluations of each pair, with other random draws."
)
@click.option(
    "--sweep",
    # The text may begin with the name of the setting, as the rows of a sweep are named.
    type=Parsed(
        "threshold=V,V",
        parse=lambda text: [float(value) for value in text.removeprefix("threshold=").split(",")],
        expected="threshold=V,V",
    ),
    help="Evaluate each row with each of these thresholds of RANSAC.",
)
@click.option("--list", "list_only", is_flag=True, help="Print every method and group, and exit.")
@click.option(
    "--list-pairs", type=PATH, help="Only write the pairs to this CSV file, for another program."
)
@click.option(
    "--out", type=PATH, default="outputs/benchmark", help="Folder; an existing run is continued."
)
@workers_option
@click.option(
    "--row-seconds", type=COUNT, default=60, help="Time limit of a method of your own for a pair."
)
@metrics_option
@click.option("--quiet", is_flag=True, help="Print no progress bar and no tables.")
def benchmark(
    data, categories, pairs, list_only, list_pairs, workers, sweep, quiet, **options
) -> None:
    """Measure rotation errors over many pairs. OUT gets tables, figures and results."""
    if list_only:
        _list_methods()
        return
    from zsp_lite.benchmark.methods import resolve
    from zsp_lite.benchmark.run import evaluate, pairs_of_rows
    from zsp_lite.course.make_samples import make_sample_data
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.exchange import write_questions
    from zsp_lite.data.pairs import labelled_categories

    if quiet:
        logging.getLogger("zsp_lite").setLevel(logging.WARNING)
    dataset = Co3D(data or make_sample_data())
    pairs_per_category = dict.fromkeys(categories or labelled_categories(dataset), pairs)
    targets = options["targets"]
    if list_pairs:
        rows = resolve(options["methods"])
        asked = pairs_of_rows(dataset, rows, pairs_per_category, targets)
        print(f"Written: {write_questions(list_pairs, dataset, list(asked))}, {len(asked)} pairs")
        return
    summary = evaluate(
        dataset.root,
        pairs=pairs_per_category,
        executor=workers,
        sweep=sweep or (),
        **options,
    )
    if not quiet:
        print(f"{dataset.root}, backbone {summary['backbone']}, {targets} target views")
        # Who asks for more than the three default rows wants the paper's tables.
        _print_summary(summary, options["metrics"], with_paper=len(summary["methods"]) > 3)
        print(f"Written: {options['out'] / 'summary.json'}, tables/, figures/")


def _list_methods() -> None:
    """Print the rows, each with its description, then the groups."""
    from zsp_lite.benchmark.methods import GROUPS, METHODS, description

    print("Methods (NAME-n3 is the row NAME at 3 target views), then groups\n")
    for name, method in METHODS.items():
        print(f"{name:18} {description(method)}")
    for name, members in GROUPS.items():
        print(
            textwrap.fill(
                f"{name}: {', '.join(members)}",
                100,
                subsequent_indent="    ",
                break_on_hyphens=False,
            )
        )


def _print_summary(summary: dict, metrics: list[str], with_paper: bool) -> None:
    """Print the tables of a summary, with those of the paper or without.

    The table by category has only as many rows as fit.
    """
    from zsp_lite.benchmark import tables
    from zsp_lite.cli.terminal import print_table

    for table in tables.every_table(summary, metrics):
        by_category = table.name.startswith("categories")
        if not by_category and (with_paper or table.name in tables.ROW_TABLES):
            print_table(table)
    print_table(tables.by_category(summary, most=_ROWS_SHOWN))


@click.command(
    epilog=examples(
        "tables outputs/benchmark", "tables outputs/benchmark --metrics median,above150"
    )
)
@click.argument("run", type=PATH)
@click.option("--out", type=PATH, show_default="the run's folder", help="Folder to write.")
@metrics_option
@click.option(
    "--rows", type=NAMES, show_default="all", help="Rows of the tables and figures, in order."
)
@click.option(
    "--latex",
    type=Parsed(
        "intervals,time",
        parse=lambda text: text.split(","),
        valid={"", "intervals", "time"}.issuperset,  # "" is the default: neither of them
        expected="intervals, time",
    ),
    default="",
    show_default="none",
    help="Add these to LaTeX tables.",
)
@click.option(
    "--size",
    type=Parsed(
        "W,H",
        parse=lambda text: tuple(map(float, text.split(","))),
        valid=lambda size: len(size) == 2 and all(1 <= side <= 100 for side in size),
        expected="two numbers from 1 to 100",
    ),
    help="Width and height of the figures in inches.",
)
@click.option(
    "--pair", metavar="KEY", help="Only draw this pair of run.jsonl, with the pose of each row."
)
@click.option("--data", type=PATH, show_default="the run's", help="Data folder, for --pair.")
def tables(run, out, metrics, rows, latex, size, pair, data) -> None:
    """Write tables and figures of a benchmark run. The run may still go on."""
    from zsp_lite.benchmark.run import write_reports
    from zsp_lite.benchmark.runs import read_run
    from zsp_lite.benchmark.tables import pair_figure, save_figure
    from zsp_lite.data.co3d import Co3D

    if pair:
        results = read_run(run)
        # `folder` is absolute. A run without it has only `data`, the path as it was given.
        dataset = Co3D(data or results.settings.folder or results.settings.data)
        figure = pair_figure(results, pair, dataset, rows)
        print(f"Written: {save_figure(figure, (out or run) / 'figures', f'pair_{pair}', size)}")
        return
    if "time" in latex and "milliseconds" not in metrics:
        metrics = [*metrics, "milliseconds"]
    summary = write_reports(run, out, metrics, rows, intervals="intervals" in latex, size=size)
    _print_summary(summary, metrics, with_paper=True)


@click.command(
    epilog=examples(
        "compare outputs/a outputs/b", "compare outputs/a outputs/a --rows ours:rootsift"
    )
)
@click.argument("run_a", type=PATH)
@click.argument("run_b", type=PATH)
@click.option(
    "--rows",
    type=NAMES,
    show_default="all common rows",
    help="A:B for row A of RUN_A and B of RUN_B, or A.",
)
def compare(run_a, run_b, rows) -> None:
    """Compare two benchmark runs on their common pairs.

    RUN_A and RUN_B are folders of runs. The table has intervals over objects and tests of
    significance.
    """
    from zsp_lite.benchmark import tables
    from zsp_lite.benchmark.runs import read_run
    from zsp_lite.cli.terminal import print_table

    print_table(tables.compare(read_run(run_a), read_run(run_b), rows))
