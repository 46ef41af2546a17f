"""The commands about the benchmark: `benchmark`, `tables`, `compare`, `train-baseline`."""

import argparse
from pathlib import Path

from zsp_lite.cli.main import _add_backbone, _add_data, _backbone, _command, _count, _names, _seed
from zsp_lite.errors import InputError

_SHOWN = 4  # rows of the table by category that a terminal has room for


def add_benchmark(commands) -> None:
    parser = _command(
        commands, "benchmark", _benchmark, "rotation errors over many pairs: tables, and files to go on with",
        [
            "benchmark",
            "benchmark --data outputs/eval --pairs 30 --methods ours,rootsift --out outputs/compared",
            "benchmark --data outputs/eval --layer last --facet token --out outputs/tokens",
            "benchmark --data outputs/paper --methods paper --pairs 100 --workers 2 --plan",
            "benchmark --list",
        ],
    )  # fmt: skip
    _add_data(parser)
    _add_backbone(parser)
    parser.add_argument("--categories", type=_names, metavar="A,B", help="default: all that have pose labels")
    parser.add_argument("--pairs", type=_count, default=30, metavar="N", help="pairs per category (default: 30)")
    parser.add_argument(
        "--targets", type=_count, default=5, metavar="N",
        help="target views per pair, for rows that do not fix them (default: 5)",
    )  # fmt: skip
    parser.add_argument(
        "--methods", type=_names, default=["default"], metavar="A,B",
        help="rows of the tables: names, groups of them, or your own as module:name; --list has all (default: "
        "ours,ours-bv,rootsift)",
    )  # fmt: skip
    parser.add_argument("--list", action="store_true", help="print every row and group that has a name, and stop")
    parser.add_argument("--seed", type=_seed, default=0, help="of the pairs drawn (default: 0)")
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/benchmark"), metavar="DIR",
        help="a run found there is continued (default: outputs/benchmark)",
    )  # fmt: skip
    parser.add_argument("--workers", type=_count, default=1, metavar="N", help="processes of this machine (default: 1)")
    parser.add_argument(
        "--executor", metavar="WHERE",
        help="dask://HOST:PORT, or module:Class of an executor, made with the number of workers",
    )  # fmt: skip
    parser.add_argument(
        "--threads", type=_count, metavar="N",
        help="threads per worker while it describes a picture (default: the cores shared out)",
    )  # fmt: skip
    parser.add_argument("--cache", type=Path, metavar="DIR", help="keep features there for other runs")
    parser.add_argument("--plan", action="store_true", help="print what it would take, and stop")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, no tables on the terminal")


def _benchmark(arguments: argparse.Namespace) -> None:
    if arguments.list:
        return _list_rows()
    import matplotlib

    matplotlib.use("Agg")  # draws files, needs no display
    from rich.console import Console
    from tqdm import tqdm

    from zsp_lite.benchmark.formats import print_tables
    from zsp_lite.benchmark.reports import write_reports
    from zsp_lite.benchmark.run import evaluate
    from zsp_lite.benchmark.tables import all_rows, by_category, paper_tables
    from zsp_lite.data.samples import data_folders

    root = data_folders(arguments.data)[0][1]
    if arguments.plan:
        return _plan(arguments, root)
    # Silent where the input is refused, and in logs.
    with tqdm(unit="pair", delay=1, disable=True if arguments.quiet else None) as bar:

        def progress(done: int, total: int) -> None:
            if bar.total is None:
                # What was there before is no work of ours: it shall not flatter the rate.
                bar.total, bar.initial, bar.n = total, done - 1, done - 1
                bar.unpause()
            bar.update(done - bar.n)

        summary = evaluate(
            root, _backbone(arguments), arguments.methods, arguments.pairs, arguments.targets, arguments.seed,
            arguments.out, arguments.categories, progress, executor=arguments.executor, workers=arguments.workers,
            threads=arguments.threads, cache=arguments.cache,
        )  # fmt: skip
    write_reports(arguments.out)
    if arguments.quiet:
        return None
    console = Console()
    title = f"{root}, backbone {summary['backbone']}, {arguments.targets} target views"
    console.print(title, soft_wrap=True, highlight=False)
    tables = paper_tables(summary)
    shown = [all_rows(summary), *(tables if len(summary["methods"]) > 3 else [])]
    print_tables([*shown, by_category(summary, list(summary["methods"])[:_SHOWN])])
    if cost := summary.get("cost"):
        console.print(
            f'Work: {cost["all_rows"]:.0f} s for all rows, {cost["ratio"]:.2f} times what "ours" alone would take '
            f"({cost['ours_alone']:.0f} s): frames are described once for all of them.",
            highlight=False,
        )
    console.print(f"Written: {arguments.out / 'summary.json'}, tables/, figures/, results.json.gz", soft_wrap=True)
    return None


def _plan(arguments: argparse.Namespace, root: Path) -> None:
    from zsp_lite.benchmark.run import plan_run

    made = plan_run(
        root, _backbone(arguments), arguments.methods, arguments.pairs, arguments.targets, arguments.seed,
        arguments.out, arguments.categories,
    )  # fmt: skip
    for line in made.lines(arguments.workers):
        print(line)


def _list_rows() -> None:
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
    for name, rows in GROUPS.items():
        print(f"{name:20} {', '.join(rows)}")


def add_tables(commands) -> None:
    parser = _command(
        commands, "tables", _tables, "tables and figures of a finished benchmark run",
        ["tables outputs/benchmark", "tables results.json.gz --out outputs/tables",
         "tables notebooks/results/paper_run/results.json.gz --into README.md"],
    )  # fmt: skip
    parser.add_argument("source", type=Path, help="a run's folder, or its results.json.gz")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: where the run is")
    parser.add_argument(
        "--by-category", type=_names, metavar="ROW,...",
        help=f"rows of the table by category in the terminal (default: the first {_SHOWN}; files have all)",
    )  # fmt: skip
    parser.add_argument(
        "--into", type=Path, metavar="FILE",
        help="do nothing but put the tables that a Markdown document has marks for in their places",
    )  # fmt: skip


def _tables(arguments: argparse.Namespace) -> None:
    if arguments.into:
        if arguments.out:
            raise InputError("tables: --into writes no folder; give it or --out")
        return _tables_into(arguments)
    import matplotlib

    matplotlib.use("Agg")
    from zsp_lite.benchmark.formats import print_tables
    from zsp_lite.benchmark.reports import write_reports
    from zsp_lite.benchmark.tables import all_rows, by_category, paper_tables

    results = write_reports(arguments.source, arguments.out)
    summary = results.summary
    rows = arguments.by_category or list(summary["methods"])[:_SHOWN]
    print_tables([all_rows(summary), *paper_tables(summary), by_category(summary, rows)])
    return None


def _tables_into(arguments: argparse.Namespace) -> None:
    from zsp_lite.benchmark.document import update_document
    from zsp_lite.benchmark.results import read_results
    from zsp_lite.benchmark.tables import every_table

    summary = read_results(arguments.source).summary
    update_document(arguments.into, every_table(summary), max(row["n"] for row in summary["methods"].values()))
    print(f"Written: {arguments.into}")


def add_compare(commands) -> None:
    parser = _command(
        commands, "compare", _compare, "two benchmark runs on the pairs that both have, and how sure a difference is",
        ["compare outputs/a outputs/b", "compare outputs/a outputs/a --rows ours:rootsift,ours:ours-mask"],
    )  # fmt: skip
    parser.add_argument("first", type=Path, metavar="RUN_A", help="a run's folder, or its results.json.gz")
    parser.add_argument("second", type=Path, metavar="RUN_B")
    parser.add_argument(
        "--rows", type=_names, metavar="A:B,...",
        help="rows of RUN_A against rows of RUN_B (default: every row that both have against its namesake)",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="DIR", help="write the table there, too")


def _compare(arguments: argparse.Namespace) -> None:
    from zsp_lite.benchmark.compare import compare, comparison_table
    from zsp_lite.benchmark.formats import print_tables, write_tables
    from zsp_lite.benchmark.results import read_results

    rows = None
    if arguments.rows:
        split = [name.split(":") for name in arguments.rows]
        if any(len(parts) > 2 or not all(parts) for parts in split):
            raise InputError(f"--rows is {','.join(arguments.rows)}, expected A:B or A, separated by commas")
        rows = [(parts[0], parts[-1]) for parts in split]
    found = compare(read_results(arguments.first), read_results(arguments.second), rows)
    table = comparison_table(found, str(arguments.first), str(arguments.second))
    print_tables([table])
    if arguments.out:
        write_tables([table], arguments.out)


def add_train_baseline(commands) -> None:
    parser = _command(
        commands, "train-baseline", _train_baseline, "train a small stand-in for a baseline's network",
        [
            "train-baseline swav-tiny --out outputs/swav-tiny",
            "train-baseline posecontrast-tiny --out outputs/posecontrast-tiny",
        ],
    )  # fmt: skip
    parser.add_argument("name", choices=("swav-tiny", "posecontrast-tiny"))
    parser.add_argument("--out", type=Path, metavar="DIR", help="pictures, log and weights (default: outputs/NAME)")
    parser.add_argument("--objects", type=_count, metavar="N", help="default: the configuration's")
    parser.add_argument("--steps", type=_count, metavar="N", help="default: the configuration's")
    parser.add_argument("--seed", type=_seed, default=0, help="default: 0")


def _train_baseline(arguments: argparse.Namespace) -> None:
    from tqdm import tqdm

    if arguments.name == "swav-tiny":
        from zsp_lite.training.swav import SwavConfig as Config
        from zsp_lite.training.swav import train
    else:
        from zsp_lite.training.posecontrast import PoseContrastConfig as Config
        from zsp_lite.training.posecontrast import train
    given = {name: getattr(arguments, name) for name in ("objects", "steps") if getattr(arguments, name)}

    def bar(shards, total):
        return tqdm(shards, "rendering", total, unit="shard", disable=None)

    out = arguments.out or Path("outputs") / arguments.name
    print(f"Written: {train(Config(seed=arguments.seed, **given), out, progress=bar)}")
