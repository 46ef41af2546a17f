"""Run the benchmark: rotation errors of methods over many pairs of a CO3D-format folder (paper sec. 5)."""

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from torch import get_num_threads
from tqdm import tqdm

from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.benchmark import execution
from zsp_lite.benchmark.evaluation import Evaluator
from zsp_lite.benchmark.figures import write_figures
from zsp_lite.benchmark.identity import digest, environment, fingerprint, library_version
from zsp_lite.benchmark.methods import GROUPS, Method, description, make_extractors, read_paper_tables, resolve
from zsp_lite.benchmark.own import StoredPoses
from zsp_lite.benchmark.runs import Call, ResultLine, Run, Settings, add_lines, open_run, read_lines, read_run
from zsp_lite.benchmark.tables import every_table, write_tables
from zsp_lite.choices import METRICS_SHOWN
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import labelled_categories, sample_pairs, shipped_pairs
from zsp_lite.errors import InputError, check_choice, check_integer
from zsp_lite.features import FeatureExtractor
from zsp_lite.io.files import write_atomic
from zsp_lite.pipeline import ZeroShotPose

logger = logging.getLogger(__name__)


def evaluate(
    data: str | Path,
    backbone: FeatureExtractor | str | BackboneConfig,
    methods: str | Sequence[str] | Mapping[str, Any] = GROUPS["default"],
    pairs: int | Mapping[str, int] = 100,
    targets: int = 5,
    out: str | Path = "outputs/benchmark",
    executor: Executor | str | int = 1,
    allow_other_version: bool = False,
) -> dict[str, Any]:
    """Evaluate rows on pairs of every category, and store every finished pair in the folder of the run at once.

    A run in the folder is continued: pairs and rows that it has are not evaluated again. Results do not depend on the
    order of pairs, on the executor or on the number of workers.

    Args:
        data: Folder in CO3D's layout, with pose labels.
        backbone: Backbone, or what `load_backbone` takes.
        methods: Rows of the tables, by name or of one's own (see `methods.resolve`).
        pairs: Number of pairs per category, of all with pose labels; or by category.
        targets: Number of target views per pair, for rows that do not fix it.
        out: Folder of the run.
        executor: Number of processes; "dask://HOST:PORT"; or any `Executor`, which gets chunks of pairs.
        allow_other_version: Continue a run of another version of the library; run.json then lists both.

    Returns:
        The content of OUT/summary.json (see `statistics.summarise`); `write_reports` writes tables and figures.

    Raises:
        InputError: For unknown rows or categories, missing labels or files, and an OUT that holds another run.
    """
    check_integer("targets", targets, 1)
    rows, dataset = resolve(methods), Co3D(data)
    numbers = pairs if isinstance(pairs, Mapping) else dict.fromkeys(labelled_categories(dataset), pairs)
    work = pairs_of_rows(dataset, rows, numbers, targets)
    loaded = load_backbone(backbone) if isinstance(backbone, str | BackboneConfig) else backbone
    extractors = make_extractors(loaded, rows)
    for row in rows.values():
        if row.solve is None:
            ZeroShotPose(extractors[row.features], **row.settings)  # refuses wrong settings
        elif isinstance(row.solve, StoredPoses) and not any(map(row.solve.of, work)):
            raise InputError(f"{row.solve.path} has no pose for any of the {len(work)} pairs of --list-pairs")
    others = {name: f"; {fingerprint(one)}" for name, one in extractors.items() if name != "backbone"}
    with execution.open_workers(executor) as (pool, workers):
        settings = Settings(
            data=str(data).encode(errors="replace").decode(), backbone=fingerprint(loaded), targets=targets,
            library=[library_version()], labels={category: _labels(dataset, category) for category in numbers},
            methods={name: description(row) + others.get(row.features, "") for name, row in rows.items()},
            origins={
                f"{category}, N = {n}": "evaluation set" if shipped_pairs(dataset, category, n, number) else "sampled"
                for category, number in numbers.items() for n in {row.targets or targets for row in rows.values()}
            },
            calls=[Call(**environment(), workers=workers, rows=list(rows), pairs=dict(numbers))],
        )  # fmt: skip
        with open_run(out, settings, allow_other_version):
            sent, threads = backbone if pool else loaded, max(1, get_num_threads() // workers)
            make = partial(Evaluator, str(Path(data).resolve()), rows, sent, threads)
            known = {(row, line.pair) for line in read_lines(out) for row in line.results}
            new = {pair: [name for name in names if (name, pair.key) not in known] for pair, names in work.items()}
            todo = {pair: names for pair, names in new.items() if names}
            evaluate_pairs(out, make, todo, len(work), pool, workers)
    return _write_summary(read_run(out), out)


def write_reports(run: str | Path, out: str | Path | None = None, metrics: Sequence[str] = METRICS_SHOWN) -> dict:
    """Write summary.json, tables/ and figures/ of a run, by default into its folder, and return the summary.

    `metrics` are the figures of the table of all rows. Tables of an earlier call which have no rows now are removed.
    """
    found, out = read_run(run), Path(out or run)
    for name in ("with_others", *(spec["name"] for spec in read_paper_tables())):
        for path in (out / "tables").glob(f"{name}.*"):
            path.unlink()
    write_tables(every_table(found.summary, metrics), out / "tables")
    write_figures(found, out / "figures")
    return _write_summary(found, out)


def _write_summary(run: Run, out: str | Path) -> dict[str, Any]:
    write_atomic(Path(out) / "summary.json", json.dumps(run.summary, indent=1).encode())
    return run.summary


def evaluate_pairs(
    out: str | Path, make: Callable[[], Any], todo: Mapping[Pair, list[str]], total: int, pool: Any, workers: int,
    kind: type = ResultLine,
) -> None:  # fmt: skip
    """Evaluate pairs, and add what is found, lines of a `kind`, to a run at once; a progress bar counts to `total`."""
    chunks = execution.make_chunks(todo, max(1, min(execution.CHUNK_SIZE, len(todo) // (4 * workers))))
    # Hidden outside a terminal, and where the user wants to hear warnings only.
    hidden = None if logger.isEnabledFor(logging.INFO) else True
    with (
        tqdm(total=total, initial=total - len(todo), unit="pair", delay=1, disable=hidden) as bar,
        closing(execution.evaluate_chunks(make, chunks, pool)) as found,
    ):
        for lines in found:
            add_lines(out, lines, kind)
            bar.update(len(lines))


def pairs_of_rows(
    dataset: Co3D, rows: Mapping[str, Method], numbers: Mapping[str, int], targets: int
) -> dict[Pair, list[str]]:
    """Return the pairs, each with the rows that are evaluated on it: the same for all rows of as many target views."""
    for category, number in numbers.items():
        check_choice("category", category, dataset.categories())
        check_integer(f"pairs of {category}", number, 1)
    work: dict[Pair, list[str]] = {}
    for n_targets in {row.targets or targets for row in rows.values()}:
        names = [name for name, row in rows.items() if (row.targets or targets) == n_targets]
        for category, n in numbers.items():
            work |= dict.fromkeys(category_pairs(dataset, category, n, n_targets), names)
    return work


def category_pairs(dataset: Co3D, category: str, n: int, n_targets: int) -> list[Pair]:
    """Return n pairs: the first of the folder's own evaluation set if it has so many, else sampled ones."""
    shipped = shipped_pairs(dataset, category, n_targets, at_least=n)
    return shipped[:n] or sample_pairs(dataset, category, n, n_targets)


def _labels(dataset: Co3D, category: str) -> str:
    """Hash of the pose labels of a category."""
    labels = read_labels(dataset.root, category).items()
    return digest(*(part for name, label in labels for part in (name, label.trans, label.reference_seq)))
