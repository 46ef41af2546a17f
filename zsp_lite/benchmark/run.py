"""Rotation errors of methods over many pairs of a CO3D-format folder with pose labels (paper sec. 5).

`evaluate` puts the parts together: which rows (`methods`) on which pairs, handed out as jobs (`jobs`, `execution`),
kept in a folder that can be resumed (`storage`), and summed up (`summary`).
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from itertools import chain
from pathlib import Path
from typing import Any

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.benchmark.execution import default_threads, execute, open_crew
from zsp_lite.benchmark.extractors import Extractor, fingerprint, make_extractors, random_backbone
from zsp_lite.benchmark.identity import digest_of
from zsp_lite.benchmark.jobs import Job, split
from zsp_lite.benchmark.methods import GROUPS, METHODS, Method, resolve
from zsp_lite.benchmark.methods import fingerprint as method_fingerprint
from zsp_lite.benchmark.plan import Plan, plan
from zsp_lite.benchmark.storage import RunFolder, read_records, same_run, surroundings
from zsp_lite.benchmark.summary import summarise_run
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import Pair, labelled_categories, sample_pairs, shipped_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.files import write_atomic

__all__ = ["GROUPS", "METHODS", "Method", "category_pairs", "evaluate", "random_backbone", "read_records"]


def evaluate(
    root: str | Path,
    backbone: Backbone | Extractor | str | BackboneConfig,
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
) -> dict:
    """Run the benchmark and return what OUT/summary.json says.

    methods: rows, see `methods.resolve`.  pairs: per category; the folder's own evaluation set where it holds that
    many, else sampled with `seed` (see `category_pairs`).  targets: views per pair, for rows that do not fix them.
    categories: default all of the folder's that have pose labels.  progress(done, total): called after each pair.
    executor, workers: who does the work, see `execution.open_crew`; `root`, and `backbone` where it is a file, must be
    at the same place for all of them.  threads: of torch for each while it describes a frame; default: the cores
    shared out.  cache: a folder to keep feature maps in, for other runs.
    A pair's seed comes from its key, and a frame is always described by itself: results do not depend on order, on the
    executor or on the number of workers. Running again with the same arguments continues, with other rows adds them.
    Raises InputError for unknown rows or categories, missing labels or files, and an OUT that holds another run.
    """
    rows = resolve(methods)
    row_pairs = pairs_of_rows(root, rows, pairs, targets, seed, categories)
    work = work_of_categories(row_pairs)
    named = isinstance(backbone, str | BackboneConfig)
    name, backbone = backbone, load_backbone(backbone) if named else backbone
    made: dict[str, Any] = make_extractors(backbone, [row.features for row in rows.values()])
    settings = _settings(root, backbone, made, rows, row_pairs, pairs, targets, seed)
    with RunFolder(out, settings) as folder:
        todo = {
            category: [(pair, left) for pair, names in found.items() if (left := folder.wanted(pair.key, names))]
            for category, found in work.items()
        }
        remaining = sum(len(found) for found in todo.values())
        total = sum(len(found) for found in work.values())
        done = total - remaining

        def finished() -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(done, total)

        if remaining:
            with open_crew(executor, workers) as crew:
                each = threads or default_threads(crew.workers)
                about = {"executor": _label(executor, crew.workers), "workers": crew.workers, "threads": each}
                begun = surroundings() | about | {"rows": list(rows), "pairs": remaining}
                folder.note(**begun)
                start = time.perf_counter()
                pieces = 1 if crew.executor is None else max(1, -(-4 * crew.workers // len(todo)))
                jobs = [
                    Job(
                        str(Path(root).resolve()), category, chunk, rows, name if named else backbone,
                        None if cache is None else str(Path(cache).resolve()), each, fingerprint=settings["backbone"],
                    )
                    for category, found in todo.items() if found for chunk in split(found, pieces)
                ]  # fmt: skip
                execute(jobs, crew, folder, lambda: made, finished)
                folder.note(finished=begun["time"], seconds=round(time.perf_counter() - start, 2))
        data = {
            "root": str(root), "categories": list(work), "pairs": max(map(len, row_pairs.values())),
            "targets": targets, "seed": seed,
        }  # fmt: skip
        summary = summarise_run(folder.records, row_pairs, data, getattr(backbone, "name", type(backbone).__name__))
        write_atomic(Path(out) / "summary.json", json.dumps(summary, indent=1).encode())
    return summary


def plan_run(
    root: str | Path,
    backbone: Backbone | Extractor | str | BackboneConfig,
    methods: str | Sequence[str] | Mapping[str, Any] = GROUPS["default"],
    pairs: int = 100,
    targets: int = 5,
    seed: int = 0,
    out: str | Path = "outputs/benchmark",
    categories: Sequence[str] | None = None,
) -> Plan:
    """What `evaluate` with these arguments would take from here on; writes nothing. Raises what it would."""
    rows = resolve(methods)
    row_pairs = pairs_of_rows(root, rows, pairs, targets, seed, categories)
    work = work_of_categories(row_pairs)
    backbone = load_backbone(backbone) if isinstance(backbone, str | BackboneConfig) else backbone
    extractors = make_extractors(backbone, [row.features for row in rows.values()])
    same_run(Path(out), _settings(root, backbone, extractors, rows, row_pairs, pairs, targets, seed))
    path = Path(out) / "pairs.jsonl"
    known = {key: record["methods"] for key, record in read_records(path, mend=False).items()}
    todo = {}
    for category, found in work.items():
        left = {pair: [name for name in names if name not in known.get(pair.key, ())] for pair, names in found.items()}
        todo[category] = [(pair, names) for pair, names in left.items() if names]
    return plan(root, todo, rows, extractors)


def _settings(
    root: str | Path,
    backbone: Any,
    extractors: Mapping[str, Any],
    rows: Mapping[str, Method],
    row_pairs: Mapping[str, Sequence[Pair]],
    pairs: int,
    targets: int,
    seed: int,
) -> dict[str, Any]:
    """What decides a run's results: see `storage.same_run`."""
    used: dict[str, set[str]] = {}
    for pair in chain.from_iterable(row_pairs.values()):
        used.setdefault(pair.category, set()).update((pair.reference_sequence, pair.target_sequence))
    labels = {
        f"{category}/{name}": digest_of((label.trans, label.reference_seq))
        for category, names in used.items() for name, label in read_labels(root, category).items() if name in names
    }  # fmt: skip
    methods = {
        name: method_fingerprint(row)
        + ("" if row.features == "backbone" else f" {fingerprint(extractors[row.features])}")
        for name, row in rows.items()
    }
    return {
        "data": str(root), "backbone": fingerprint(backbone), "pairs": pairs, "targets": targets, "seed": seed,
        "methods": methods, "labels": labels,
    }  # fmt: skip


def pairs_of_rows(
    root: str | Path,
    rows: Mapping[str, Method],
    pairs: int,
    targets: int,
    seed: int = 0,
    categories: Sequence[str] | None = None,
) -> dict[str, list[Pair]]:
    """The pairs that each row is evaluated on: the same for all rows of as many target views.

    categories: default all that have pose labels.
    Raises InputError for unknown categories, and where these cannot give so many pairs or views.
    """
    dataset = Co3D(root)
    categories = list(dict.fromkeys(categories or labelled_categories(dataset)))
    if missing := sorted(set(categories) - set(dataset.categories())) or not categories:
        found = ", ".join(dataset.categories()) or "none"
        raise InputError(f"{root}: no categories {missing or ''}, found {found}")
    numbers = dict.fromkeys(row.targets or targets for row in rows.values())
    by_number: dict[int, list[Pair]] = {number: [] for number in numbers}
    for category in categories:
        for number in numbers:
            by_number[number] += category_pairs(dataset, category, pairs, number, seed)
    return {name: by_number[row.targets or targets] for name, row in rows.items()}


def work_of_categories(row_pairs: Mapping[str, Sequence[Pair]]) -> dict[str, dict[Pair, list[str]]]:
    """By category every pair, once, with the rows that are evaluated on it."""
    work: dict[str, dict[Pair, list[str]]] = {}
    for name, pairs in row_pairs.items():
        for pair in dict.fromkeys(pairs):
            work.setdefault(pair.category, {}).setdefault(pair, []).append(name)
    return work


def category_pairs(dataset: Co3D, category: str, n: int, n_targets: int, seed: int = 0) -> list[Pair]:
    """The first n pairs of the folder's own evaluation set for n_targets, where it holds so many; else n sampled."""
    shipped = shipped_pairs(dataset, category, n_targets, at_least=n)
    return shipped[:n] or sample_pairs(dataset, category, n, n_targets, seed)


def _label(executor: Executor | str | None, workers: int) -> str:
    if executor is None:
        return "this process" if workers == 1 else "process pool"
    return executor if isinstance(executor, str) else type(executor).__name__
