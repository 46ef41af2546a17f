"""Run the benchmark: rotation errors of rows over many pairs of a CO3D-format folder (sec. 5).

The way of a pair: `evaluate` samples it, `execution.evaluate_pairs` hands it to this process or a
worker, `evaluate_pair` reads frames and features, asks each row (`_ask`) and measures its answer;
`write_reports` makes tables of what is stored.
"""

import json
import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.backbones.load import BackboneLike, as_backbone
from zsp_lite.baselines.geometry import essential_rotation
from zsp_lite.benchmark import execution
from zsp_lite.benchmark.methods import (
    GROUPS,
    Method,
    description,
    is_own,
    make_extractors,
    read_paper_tables,
    resolve,
)
from zsp_lite.benchmark.own import StoredPoses, fails_alone, given
from zsp_lite.benchmark.problem import (
    Answer,
    FrameStore,
    PairProblem,
    Problem,
    as_answer,
    seeded,
)
from zsp_lite.benchmark.runs import Result, Run, open_run, read_run, run_settings
from zsp_lite.choices import METRICS_SHOWN
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.ground_truth import common_turns
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import category_pairs, labelled_categories, true_pose
from zsp_lite.errors import InputError, check_integer
from zsp_lite.io.files import digest, write_atomic
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose, view_alignment

logger = logging.getLogger(__name__)


def evaluate(
    data: str | Path,
    backbone: BackboneLike,
    methods: str | Sequence[str] | Mapping[str, Any] = GROUPS["default"],
    pairs: int | Mapping[str, int] = 100,
    targets: int = 5,
    out: str | Path = "outputs/benchmark",
    executor: Executor | int = 1,
    row_seconds: int = 60,
    seeds: int = 1,
    sweep: Sequence[float] = (),
) -> dict[str, Any]:
    """Evaluate rows on pairs of every category, and store every finished pair in the folder of the
    run at once.

    A run in the folder is continued: pairs and rows that it has are not evaluated again. Results do
    not depend on the order of pairs, on the executor or on the number of workers.

    Args:
        data: Folder in CO3D's layout, with pose labels.
        backbone: Backbone, or what `load_backbone` takes.
        methods: Rows of the tables, by name or of one's own (see `methods.resolve`).
        pairs: Number of pairs per category, of all with pose labels; or by category.
        targets: Number of target views per pair, for rows that do not fix it.
        out: Folder of the run.
        executor: Number of processes, or any `Executor`, which gets chunks of pairs.
        row_seconds: Time limit of a row of one's own for a pair, which fails beyond it.
        seeds: Number of evaluations of each pair, with other random draws of k-means and RANSAC.
        sweep: RANSAC thresholds V; each row is evaluated with each, as NAME@threshold=V.

    Returns:
        The content of OUT/summary.json (see `statistics.summarise`); `write_reports` writes tables
        and figures.

    Raises:
        InputError: For unknown rows or categories, missing labels or files, and an OUT that holds
            another run.
        FatalError: The backbone is broken, or a frame cannot be read.
    """
    check_integer("targets", targets, 1)
    check_integer("row_seconds", row_seconds, 1, 1_000_000)
    check_integer("seeds", seeds, 1, 1000)

    # Rows, pairs, and the rows of each pair, by seed.
    rows = resolve(methods, sweep)
    dataset = Co3D(data)
    numbers = pairs
    if not isinstance(pairs, Mapping):
        numbers = dict.fromkeys(labelled_categories(dataset), pairs)
    work = pairs_of_rows(dataset, rows, numbers, targets)
    loaded = as_backbone(backbone)
    remarks = _check_rows(rows, make_extractors(loaded, rows), dataset, work)
    repeated = {
        replace(pair, repeat=k): names for k in range(seeds) for pair, names in work.items()
    }

    # Lines of the run, pair by pair (see `evaluate_pair`).
    with execution.open_workers(executor) as (pool, workers):
        settings = run_settings(
            data,
            loaded,
            targets,
            {name: description(row) for name, row in rows.items()},
            {category: _labels(dataset, category) for category in numbers},
            workers=workers,
            pairs=dict(numbers),
            seeds=seeds,
            remarks=remarks,
        )
        # Workers load a named backbone themselves; an object travels to them.
        travels = backbone if pool else loaded
        make = partial(
            pair_evaluator, str(Path(data).resolve()), rows, travels, row_seconds=row_seconds
        )
        with open_run(out, settings):
            execution.evaluate_pairs(out, make, repeated, pool, workers)

    # The lines as one table, and its summary.
    found = read_run(out)
    for remark in filter(None, [*remarks.values(), *found.failures]):
        logger.warning("%s", remark)
    return _write_summary(found, out)


def _check_rows(
    rows: Mapping[str, Method],
    extractors: Mapping[str, Any],
    dataset: Co3D,
    work: Mapping[Pair, list[str]],
) -> dict[str, str]:
    """Refuse wrong settings before anything is computed; return remarks on stored poses by row."""
    remarks = {}
    for name, row in rows.items():
        if row.solve is None:
            ZeroShotPose(extractors[row.features], **row.settings)
        elif isinstance(row.solve, StoredPoses):
            asked = [pair for pair, names in work.items() if name in names]
            remark = row.solve.remark(dataset, asked)
            # Empty, too: it replaces that of an earlier call.
            remarks[name] = f"{name}: {remark}." if remark else ""
    return remarks


def write_reports(
    run: str | Path,
    out: str | Path | None = None,
    metrics: Sequence[str] = METRICS_SHOWN,
    rows: Sequence[str] | None = None,
    intervals: bool = False,
    size: tuple[float, float] | None = None,
) -> dict[str, Any]:
    """Write summary.json, tables/ and figures/ of a run, by default into its folder, and return
    what tables show.

    `metrics` are the figures of the table of all rows, `rows` those of tables and figures, in
    order, by default all; `intervals` puts intervals into LaTeX, `size` is that of figures (W, H)
    in inches. Tables of an earlier call which have no rows now are removed.
    """
    from zsp_lite.benchmark import tables  # workers need no matplotlib

    found = read_run(run)
    out = Path(out or run)
    shown = tables.choose(found, rows) if rows else found.summary
    for name in ("all_rows", *tables.SEE_MORE, *(spec["name"] for spec in read_paper_tables())):
        for path in (out / "tables").glob(f"{name}.*"):
            path.unlink()
    tables.write_tables(tables.every_table(shown, metrics), out / "tables", intervals)
    tables.write_figures(found, out / "figures", rows, size)
    _write_summary(found, out)
    return shown


def _write_summary(run: Run, out: str | Path) -> dict[str, Any]:
    write_atomic(Path(out) / "summary.json", json.dumps(run.summary, indent=1).encode())
    return run.summary


def pairs_of_rows(
    dataset: Co3D, rows: Mapping[str, Method], numbers: Mapping[str, int], targets: int
) -> dict[Pair, list[str]]:
    """Return the pairs, each with the rows that are evaluated on it: the same for all rows of as
    many target views."""
    work: dict[Pair, list[str]] = {}
    for n_targets in {row.targets or targets for row in rows.values()}:
        names = [name for name, row in rows.items() if (row.targets or targets) == n_targets]
        for category, n in numbers.items():
            check_integer(f"pairs of {category}", n, 1)
            for pair in category_pairs(dataset, category, n, n_targets):
                work[pair] = names
    return work


def _labels(dataset: Co3D, category: str) -> str:
    """Hash of the pose labels of a category."""
    parts: list[str | bytes] = []
    for name, label in read_labels(dataset.root, category).items():
        parts += [name, label.trans.tobytes(), label.reference_seq]
    return digest(*parts)


def pair_evaluator(
    root: str, methods: Mapping[str, Method], backbone: Any, threads: int, row_seconds: int = 60
) -> execution.Evaluate:
    """Make what evaluates pairs in one process; frames, and features by some `threads`, are kept
    from pair to pair."""
    store = FrameStore(Co3D(root), make_extractors(as_backbone(backbone), methods), threads)
    return partial(evaluate_pair, methods=methods, store=store, row_seconds=row_seconds)


def evaluate_pair(
    pair: Pair,
    names: Iterable[str],
    methods: Mapping[str, Method],
    store: FrameStore,
    row_seconds: int = 60,
) -> dict[str, Any]:
    """Evaluate the named rows on a pair: a line of the run's results (see `runs.ResultLine`)."""
    store.timings.clear()
    problem = PairProblem(pair, store, {methods[name].features for name in names} - {"none"})
    for sequence in (pair.reference_sequence, pair.target_sequence):
        store.extent(pair.category, sequence)  # an unreadable point cloud is no failure of a row
    # Ground truth from the reference's camera to each target's.
    labels = store.labels(pair.category)
    views = range(len(pair.target_frames))
    truths = np.stack([true_pose(store.dataset, labels, pair, view) for view in views])

    results = {}
    for name in names:
        method = methods[name]
        own = is_own(name) and type(method.solve) is not StoredPoses
        seen = given(method.solve, problem) if own and method.solve else problem
        try:
            with fails_alone(row_seconds) if own else nullcontext():
                start = time.perf_counter()
                answer = _ask(method, seen, truths)
                seconds = time.perf_counter() - start
                results[name] = _measure(answer, problem, truths, seconds)
        except InputError as error:
            # 180 degrees: without these pairs, methods that fail often would look better.
            reason = str(error).encode(errors="replace").decode()
            results[name] = {"error": 180.0, "failed": reason}
    timings = {
        stage: round(float(np.median(seconds)), 5) for stage, seconds in store.timings.items()
    }
    return {"pair": pair.key, "results": results, "repeat": pair.repeat, "timings": timings}


def _ask(method: Method, problem: Problem, truths: Float[np.ndarray, "n 4 4"]) -> Answer:
    """Ask a row for its pose of a pair."""
    if method.solve is not None:
        return as_answer(seeded(method.solve, problem.seed)(problem))
    nearest = None
    if method.answer == "true view":
        nearest = int(rotation_error(np.eye(3), truths[:, :3, :3]).argmin())
    estimate = problem.estimate(method.features, method.settings, nearest)
    answer = as_answer(estimate)
    reference, target = estimate.reference_view, estimate.target_views[estimate.view]
    if method.answer == "true view":  # the only view of this estimate
        return replace(answer, view=nearest)
    if method.answer == "best view":
        sim3 = view_alignment(reference, target)
        return replace(answer, rotation=sim3.R, translation=sim3.t, scale=sim3.scale, note="")
    if method.answer == "essential matrix":
        rotation, inliers, note = essential_rotation(
            reference.frame, target.frame, estimate.matches, reference.features.grid
        )
        return Answer(rotation, answer.view, note=note, inliers=inliers)
    return answer


def _measure(
    answer: Answer, problem: PairProblem, truths: Float[np.ndarray, "n 4 4"], seconds: float
) -> dict[str, Any]:
    """Measure an answer: the members of a stored result that are known, "error" among them."""
    if not 0 <= answer.view < len(truths):
        raise InputError(f"answer is for view {answer.view}, expected 0 to {len(truths) - 1}")
    truth = truths[answer.view]
    known = {
        "seconds": seconds,
        "view": answer.view,
        "note": answer.note[:1000],
        "scale": answer.scale,
        "inliers": answer.inliers,
        "confidence": answer.confidence,
        "error": rotation_error(answer.rotation, truth[:3, :3]),
        "rotation": answer.rotation.ravel().round(6).tolist(),
    }
    pair, store = problem.pair, problem.store
    reference, *targets = [frame.camera for frame in problem.frames()]
    names = pair.reference_sequence, pair.target_sequence

    # Turns of the target object that look the same are no errors of its symmetric error.
    turns = common_turns(store.dataset.root, pair.category, *names)
    if turns is not None:
        to_camera = targets[answer.view].R
        turned = to_camera @ turns @ to_camera.T @ truth[:3, :3]
        known["symmetric_error"] = np.min(rotation_error(answer.rotation, turned))

    # Where the reference object's centre comes to lie, in diameters of the target object.
    reference_extent, target_extent = [store.extent(pair.category, name) for name in names]
    if answer.translation is not None:
        known["position"] = answer.translation.round(6).tolist()
        if reference_extent and target_extent:
            centre = reference.to_camera(reference_extent[0])
            scale = 1.0 if answer.scale is None else answer.scale
            found = scale * answer.rotation @ centre + answer.translation
            distance = np.linalg.norm(found - truth[:3, :3] @ centre - truth[:3, 3])
            known["translation"] = distance / target_extent[1]

    result = {}
    for name, value in known.items():
        if isinstance(value, np.generic):
            value = value.item()
        if value is not None:
            result[name] = value
    # Refuses what could not be stored.
    msgspec.json.encode(msgspec.convert(result, Result))
    return {
        name: round(value, 4) if isinstance(value, float) else value
        for name, value in result.items()
    }
