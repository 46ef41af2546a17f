"""Run the benchmark: rotation errors of methods over many pairs of a CO3D-format folder (paper sec. 5)."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.benchmark import execution
from zsp_lite.benchmark.extractors import make_extractors
from zsp_lite.benchmark.identity import digest, environment, fingerprint, library_version
from zsp_lite.benchmark.methods import GROUPS, Method, description, resolve
from zsp_lite.benchmark.records import add_lines, open_run, read_records
from zsp_lite.benchmark.results import results_of
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import labelled_categories, sample_pairs, shipped_pairs
from zsp_lite.errors import InputError, check_integer
from zsp_lite.features import FeatureExtractor
from zsp_lite.io.files import make_folder, write_atomic
from zsp_lite.pipeline import ZeroShotPose


def evaluate(
    root: str | Path,
    backbone: FeatureExtractor | str | BackboneConfig,
    methods: str | Sequence[str] | Mapping[str, Any] = GROUPS["default"],
    pairs: int = 100,
    targets: int = 5,
    seed: int = 0,
    out: str | Path = "outputs/benchmark",
    categories: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    executor: Executor | str | None = None,
    workers: int = 1,
    threads: int | None = None,
    cache: str | Path | None = None,
    keep_hypotheses: bool = False,
    allow_other_version: bool = False,
) -> dict:
    """Run the benchmark, or continue a run.

    The seed of a pair comes from its key, and features are extracted frame by frame: results do not depend on the
    order of pairs, on the executor or on the number of workers.

    Args:
        root: Folder in CO3D's layout with pose labels.
        backbone: The backbone under test.
        methods: Rows of the tables (see `methods.resolve`).
        pairs: Number per category (see `category_pairs`).
        targets: Target views per pair, for rows that do not fix them.
        seed: Seed of the sampled pairs.
        out: Folder of the run; an existing run with the same settings is continued. Rows may be added.
        categories: Default: all that have pose labels.
        progress: Called with the numbers of finished and of all pairs.
        executor: Executor (see `execution.open_workers`); `root`, `cache` and a backbone's file must have the same
            path for all workers.
        workers: Number of workers.
        threads: Threads of torch per worker during feature extraction; default: the cores divided by the workers.
        cache: Folder that keeps feature maps for other runs.
        keep_hypotheses: Store the ranked candidate poses of solvers that have them, such as "verified", with their
            scores, terms and errors.
        allow_other_version: Continue a run of another version of the library; run.json then lists both.

    Returns:
        The content of OUT/summary.json (see `summary.summarise_run`).

    Raises:
        InputError: For unknown rows or categories, missing labels or files, and an OUT that holds another run.
    """
    check_integer("pairs", pairs, 1)
    check_integer("targets", targets, 1)
    rows = resolve(methods)
    row_pairs = pairs_of_rows(root, rows, pairs, targets, seed, categories)
    work = rows_of_pairs(row_pairs)
    named = isinstance(backbone, str | BackboneConfig)
    loaded = load_backbone(backbone) if named else backbone
    extractors = make_extractors(loaded, [row.features for row in rows.values()])
    for row in rows.values():
        if row.solve is None:
            ZeroShotPose(extractors[row.features], **row.settings)  # refuses wrong settings
    settings = {"data": str(root).encode(errors="replace").decode(), "backbone": fingerprint(loaded), "pairs": pairs}
    settings |= {"targets": targets, "seed": seed, "library": library_version()}
    others = {name: f"; {fingerprint(one)}" for name, one in extractors.items() if name != "backbone"}
    settings |= {"methods": {name: description(row) + others.get(row.features, "") for name, row in rows.items()}}
    settings |= {"labels": _labels(root, work)}
    if threads is not None:
        check_integer("threads", threads, 1, execution.MOST_WORKERS)
    if cache is not None:
        cache = make_folder(cache, "cache folder").resolve()  # before anything is written
    with open_run(out, settings, allow_other_version), execution.open_workers(executor, workers) as opened:
        threads = threads or max(1, execution.available_cores() // opened.number)
        folder, sent = str(Path(root).resolve()), backbone if named else loaded
        setup = execution.Setup(folder, rows, sent, settings["backbone"], cache, threads, keep_hypotheses)
        known = read_records(out).rows
        todo = rows_of_pairs(
            {name: [pair for pair in found if pair.key not in known.get(name, ())] for name, found in row_pairs.items()}
        )
        total, left = sum(map(len, work.values())), sum(map(len, todo.values()))
        where = executor if isinstance(executor, str) else type(opened.executor).__name__ if opened.executor else None
        call = {"executor": where, "workers": opened.number, "threads": threads, "rows": list(rows)}
        add_lines(out, [{"call": environment() | call | {"categories": list(work), "pairs": left}}])
        done = total - left

        def save(evaluated: list[dict[str, Any]]) -> None:
            nonlocal done
            add_lines(out, evaluated)
            done += len(evaluated)
            if progress is not None:
                progress(done, total)

        start = time.perf_counter()
        size = max(1, min(execution.CHUNK_SIZE, left // (4 * opened.number)))
        chunks = [chunk for found in todo.values() for chunk in execution.make_chunks(found, size)]
        execution.evaluate_chunks(setup, chunks, opened, save, extractors)
        add_lines(out, [{"seconds": round(time.perf_counter() - start, 2)}])
        summary = results_of(settings, read_records(out)).summary
        write_atomic(Path(out) / "summary.json", json.dumps(summary, indent=1).encode())
    return summary


def pairs_of_rows(
    root: str | Path,
    rows: Mapping[str, Method],
    pairs: int,
    targets: int,
    seed: int = 0,
    categories: Sequence[str] | None = None,
) -> dict[str, list[Pair]]:
    """Return the pairs that each row is evaluated on: the same for all rows of as many target views."""
    dataset = Co3D(root)
    categories = list(dict.fromkeys(categories or labelled_categories(dataset)))
    if missing := sorted(set(categories) - set(dataset.categories())) or not categories:
        found = ", ".join(dataset.categories()) or "none"
        raise InputError(f"{root}: no categories {missing or ''}, found {found}")
    numbers = dict.fromkeys(row.targets or targets for row in rows.values())
    by_number = {
        number: [pair for category in categories for pair in category_pairs(dataset, category, pairs, number, seed)]
        for number in numbers
    }
    return {name: by_number[row.targets or targets] for name, row in rows.items()}


def category_pairs(dataset: Co3D, category: str, n: int, n_targets: int, seed: int = 0) -> list[Pair]:
    """Return n pairs: the first of the folder's own evaluation set if it has so many, else sampled ones."""
    shipped = shipped_pairs(dataset, category, n_targets, at_least=n)
    return shipped[:n] or sample_pairs(dataset, category, n, n_targets, seed)


def rows_of_pairs(row_pairs: Mapping[str, Sequence[Pair]]) -> dict[str, dict[Pair, list[str]]]:
    """Return the rows that are evaluated on each pair, by category and pair."""
    work: dict[str, dict[Pair, list[str]]] = {}
    for name, pairs in row_pairs.items():
        for pair in dict.fromkeys(pairs):
            work.setdefault(pair.category, {}).setdefault(pair, []).append(name)
    return work


def _labels(root: str | Path, work: Mapping[str, Mapping[Pair, Any]]) -> dict[str, str]:
    """Hashes of the pose labels that the pairs need, by CATEGORY/SEQUENCE."""
    found = {}
    for category, pairs in work.items():
        labels = read_labels(root, category)
        for name in sorted({name for pair in pairs for name in (pair.reference_sequence, pair.target_sequence)}):
            if name not in labels:
                raise InputError(f"{category}/{name}: no pose label, expected one for each sequence of a pair")
            found[f"{category}/{name}"] = digest(labels[name].trans, labels[name].reference_seq)
    return found
