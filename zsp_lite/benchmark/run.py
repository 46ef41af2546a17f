"""Run the benchmark: rotation errors of methods over many pairs of a CO3D-format folder (paper sec. 5)."""

import json
import logging
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

from torch import get_num_threads
from tqdm import tqdm

from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.benchmark import execution
from zsp_lite.benchmark.extractors import make_extractors
from zsp_lite.benchmark.identity import digest, environment, fingerprint, library_version
from zsp_lite.benchmark.methods import GROUPS, Method, description, resolve
from zsp_lite.benchmark.runs import add_lines, open_run, read_lines, read_run
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import labelled_categories, sample_pairs, shipped_pairs
from zsp_lite.errors import InputError, check_integer
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
        The content of OUT/summary.json (see `summary.summarise`).

    Raises:
        InputError: For unknown rows or categories, missing labels or files, and an OUT that holds another run.
    """
    check_integer("targets", targets, 1)
    rows, dataset = resolve(methods), Co3D(data)
    numbers = pairs if isinstance(pairs, Mapping) else dict.fromkeys(labelled_categories(dataset), pairs)
    row_pairs = pairs_of_rows(dataset, rows, numbers, targets)
    loaded = load_backbone(backbone) if isinstance(backbone, str | BackboneConfig) else backbone
    extractors = make_extractors(loaded, [row.features for row in rows.values()])
    for row in rows.values():
        if row.solve is None:
            ZeroShotPose(extractors[row.features], **row.settings)  # refuses wrong settings
    others = {name: f"; {fingerprint(one)}" for name, one in extractors.items() if name != "backbone"}
    settings = {
        "data": str(data).encode(errors="replace").decode(), "backbone": fingerprint(loaded), "targets": targets,
        "library": library_version(), "labels": _labels(dataset, row_pairs),
        "origins": {
            f"{name}, N = {n}": "evaluation set" if shipped_pairs(dataset, name, n, at_least=number) else "sampled"
            for name, number in numbers.items() for n in dict.fromkeys(row.targets or targets for row in rows.values())
        },
        "methods": {name: description(row) + others.get(row.features, "") for name, row in rows.items()},
    }  # fmt: skip
    with open_run(out, settings, allow_other_version), execution.open_workers(executor) as workers:
        threads = max(1, min(get_num_threads(), execution.available_cores() // workers.number))
        setup = execution.Setup(str(Path(data).resolve()), rows, backbone, settings["backbone"], threads)
        known = {(row, line["pair"]) for line in read_lines(out) for row in line.get("results", ())}
        todo = rows_of_pairs(
            {name: [pair for pair in found if (name, pair.key) not in known] for name, found in row_pairs.items()}
        )
        total, left = (sum(map(len, work.values())) for work in (rows_of_pairs(row_pairs), todo))
        call = {"workers": workers.number, "rows": list(rows), "categories": list(numbers), "pairs": dict(numbers)}
        add_lines(out, [{"call": environment() | call}])
        start = time.perf_counter()
        size = max(1, min(execution.CHUNK_SIZE, left // (4 * workers.number)))
        chunks = [chunk for found in todo.values() for chunk in execution.make_chunks(found, size)]
        # Hidden outside a terminal, and where the user wants to hear warnings only.
        hidden = None if logger.isEnabledFor(logging.INFO) else True
        with tqdm(total=total, initial=total - left, unit="pair", delay=1, disable=hidden) as bar:

            def save(evaluated: list[dict[str, Any]]) -> None:
                add_lines(out, evaluated)
                bar.update(len(evaluated))

            execution.evaluate_chunks(setup, chunks, workers, save, extractors)
        add_lines(out, [{"seconds": round(time.perf_counter() - start, 2)}])
        summary = read_run(out).summary
        write_atomic(Path(out) / "summary.json", json.dumps(summary, indent=1).encode())
    return summary


def pairs_of_rows(
    dataset: Co3D, rows: Mapping[str, Method], numbers: Mapping[str, int], targets: int
) -> dict[str, list[Pair]]:
    """Return the pairs that each row is evaluated on: the same for all rows of as many target views."""
    known = dataset.categories()
    if unknown := sorted(set(numbers) - set(known)) or not numbers:
        raise InputError(f"{dataset.root}: no categories {unknown or ''}, found {', '.join(known) or 'none'}")
    for category, number in numbers.items():
        check_integer(f"pairs of {category}", number, 1)
    found: dict[int, list[Pair]] = {}
    for n_targets in dict.fromkeys(row.targets or targets for row in rows.values()):
        found[n_targets] = [pair for name, n in numbers.items() for pair in category_pairs(dataset, name, n, n_targets)]
    return {name: found[row.targets or targets] for name, row in rows.items()}


def category_pairs(dataset: Co3D, category: str, n: int, n_targets: int) -> list[Pair]:
    """Return n pairs: the first of the folder's own evaluation set if it has so many, else sampled ones."""
    shipped = shipped_pairs(dataset, category, n_targets, at_least=n)
    return shipped[:n] or sample_pairs(dataset, category, n, n_targets)


def rows_of_pairs(row_pairs: Mapping[str, Sequence[Pair]]) -> dict[str, dict[Pair, list[str]]]:
    """Return the rows that are evaluated on each pair, by category and pair."""
    work: dict[str, dict[Pair, list[str]]] = {}
    for name, pairs in row_pairs.items():
        for pair in dict.fromkeys(pairs):
            work.setdefault(pair.category, {}).setdefault(pair, []).append(name)
    return work


def _labels(dataset: Co3D, row_pairs: Mapping[str, Sequence[Pair]]) -> dict[str, str]:
    """Hashes of the pose labels that the pairs need, by CATEGORY/SEQUENCE."""
    used = {
        (pair.category, name)
        for pairs in row_pairs.values() for pair in pairs
        for name in (pair.reference_sequence, pair.target_sequence)
    }  # fmt: skip
    found, labels = {}, {category: read_labels(dataset.root, category) for category, _ in used}
    for category, name in sorted(used):
        if name not in labels[category]:
            raise InputError(f"{category}/{name}: no pose label, expected one for each sequence of a pair")
        found[f"{category}/{name}"] = digest(labels[category][name].trans, labels[category][name].reference_seq)
    return found
