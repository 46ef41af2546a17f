"""Run the benchmark: rotation errors of rows over many pairs of a CO3D-format folder (sec. 5).

The way of a pair: `evaluate` samples it, `evaluate_pairs` hands it to this process or a worker,
`evaluate_pair` reads frames and features, asks each row (`ask`) and measures its answer;
`runs.add_lines` adds the line to run.jsonl, from which `write_reports` makes tables.

`rows` are the `Method`s by name, `names` are names of rows; only in `write_reports`, `rows` are
names, too.
"""

import json
import logging
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.named import BackboneLike, as_backbone
from zsp_lite.baselines.geometry import essential_rotation
from zsp_lite.benchmark.execution import Evaluator, check_workers, evaluate_pairs
from zsp_lite.benchmark.methods import (
    GROUPS,
    Method,
    description,
    is_own,
    make_extractors,
    read_paper_tables,
    resolve,
)
from zsp_lite.benchmark.own import StoredPoses, fails_alone, problem_of_own
from zsp_lite.benchmark.problem import (
    Answer,
    FrameStore,
    PairProblem,
    Problem,
    as_answer,
    seeded,
)
from zsp_lite.benchmark.runs import (
    Result,
    ResultLine,
    open_run,
    printable,
    read_run,
)
from zsp_lite.choices import METRICS_SHOWN
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.evaluation import common_turns, true_pose
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import category_pairs, labelled_categories
from zsp_lite.errors import InputError, check_integer
from zsp_lite.io.files import digest, path_inside, read_bytes, write_atomic
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose, view_alignment

logger = logging.getLogger(__name__)
_LONGEST_NOTE = 1000  # characters, as of an error message


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
    metrics: Sequence[str] = (),
) -> dict[str, Any]:
    """Evaluate rows on pairs of every category, and store every finished pair in the folder of the
    run at once.

    A run in the folder is continued: pairs and rows that it has are not evaluated again. Results do
    not depend on the order of pairs, on the executor or on the number of workers.

    Args:
        data: Folder in CO3D's layout, with pose labels.
        backbone: Backbone, or what `load_backbone` takes.
        methods: Rows of the tables, by name or of one's own (see `methods.resolve`).
        pairs: Number of pairs of every category with pose labels, by default the paper's 100 (the
            command's default is 30, for a first try); or the number by category.
        targets: Number of target views per pair, for rows that do not fix it.
        out: Folder of the run.
        executor: Number of processes, or any `Executor`, which gets chunks of pairs.
        row_seconds: Time limit of a row of one's own for a pair, which fails beyond it.
        seeds: Number of evaluations of each pair, with other random draws of k-means and RANSAC.
        sweep: RANSAC thresholds V; each row is evaluated with each, as NAME@threshold=V.
        metrics: Figures of the table of all rows, if tables and figures are to be written, too
            (see `write_reports`).

    Returns:
        The summary (see `summary.summarise`).

    Raises:
        InputError: For unknown rows or categories, missing labels or files, and an OUT that holds
            another run.
        FatalError: The backbone is broken, or a frame cannot be read.
    """
    check_integer("targets", targets, 1)
    check_integer("row_seconds", row_seconds, 1, 1_000_000)
    check_integer("seeds", seeds, 1, 1000)
    check_workers(executor)

    # The rows, and the pairs with the names of the rows that are evaluated on each.
    rows = resolve(methods, sweep)
    dataset = Co3D(data)
    if not isinstance(pairs, Mapping):
        pairs = dict.fromkeys(labelled_categories(dataset), pairs)
    work = pairs_of_rows(dataset, rows, pairs, targets)
    loaded = as_backbone(backbone)
    # Wrong settings of a row are refused before anything is computed.
    extractors = make_extractors(loaded, rows)
    for row in rows.values():
        if row.solve is None:
            ZeroShotPose(extractors[row.features], **row.settings)
    # Each pair once for each seed.
    repeated = {
        replace(pair, repeat=seed): names for seed in range(seeds) for pair, names in work.items()
    }
    # On poses that another program computed. An empty remark replaces that of an earlier call.
    remarks = {
        name: row.solve.remark(name, dataset, work)
        for name, row in rows.items()
        if isinstance(row.solve, StoredPoses)
    }
    # Workers load a named backbone themselves; an object travels to them.
    sent = loaded if executor == 1 else backbone
    opener = partial(open_evaluator, str(Path(data).resolve()), rows, sent, row_seconds)
    with open_run(
        out,
        data,
        loaded,
        targets,
        {name: description(row) for name, row in rows.items()},
        _hashes(dataset, work),
        pairs=dict(pairs),
        seeds=seeds,
        remarks=remarks,
    ) as lines:
        evaluate_pairs(out, opener, repeated, executor, lines)

    summary = write_reports(out, metrics=metrics) if metrics else read_run(out).summary
    if "note" in summary:
        logger.warning("%s", summary["note"])
    return summary


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

    results = read_run(run)
    shown = results.summary
    if rows:
        for name in rows:
            results.row(name)  # InputError for an unknown one
        methods = {name: shown["methods"][name] for name in rows}
        shown = shown | {"methods": methods, "chosen": list(rows)}
    out = Path(out or run)
    of_paper = [spec["name"] for spec in read_paper_tables()]
    for name in (*tables.ROW_TABLES, *of_paper):
        for path in (out / "tables").glob(f"{name}.*"):
            path.unlink()
    for table in tables.every_table(shown, metrics):
        path = out / "tables" / table.name
        write_atomic(f"{path}.csv", tables.as_csv(table).encode())
        write_atomic(f"{path}.md", tables.as_markdown(table).encode())
        write_atomic(f"{path}.tex", tables.as_latex(table, intervals).encode())
    tables.write_figures(results, out / "figures", rows, size)
    write_atomic(out / "summary.json", json.dumps(results.summary, indent=1).encode())
    return shown


def pairs_of_rows(
    dataset: Co3D, rows: Mapping[str, Method], pairs_per_category: Mapping[str, int], targets: int
) -> dict[Pair, list[str]]:
    """Return the pairs, each with the names of the rows that are evaluated on it.

    All rows of one number of target views get the same pairs.
    """
    sampled = cache(partial(category_pairs, dataset))
    work: dict[Pair, list[str]] = {}
    for name, row in rows.items():
        for category, count in pairs_per_category.items():
            check_integer(f"pairs of {category}", count, 1)
            for pair in sampled(category, count, row.targets or targets):
                work.setdefault(pair, []).append(name)
    return work


def _hashes(dataset: Co3D, pairs: Iterable[Pair]) -> dict[str, str]:
    """Hash the first image of each object of the pairs, and the rotation of its label."""
    labels = cache(partial(read_labels, dataset.root))
    names = {(pair.category, name) for pair in pairs for name, _ in pair.frames}
    hashes = {}
    for category, name in sorted(names):
        label = labels(category)[name]
        # Translations are left out: the same scene, rendered on another processor, has a unit of
        # length that differs by some 3e-5. Adding 0.0 turns negative zeros into zeros.
        rotation = np.round(label.trans[:3, :3], 6) + 0.0
        image = dataset.frames(category, name)[0].image
        pixels = read_bytes(path_inside(dataset.root, image.path), "image")
        hashes[f"{category}/{name}"] = digest(label.reference_seq, rotation.tobytes(), pixels)
    return hashes


def open_evaluator(
    root: str, rows: Mapping[str, Method], backbone: BackboneLike, row_seconds: int, threads: int
) -> Evaluator:
    """Load the backbone and the extractors; the evaluator keeps frames and features from pair to
    pair."""
    extractors = make_extractors(as_backbone(backbone), rows)
    store = FrameStore(Co3D(root), extractors, threads)
    return partial(evaluate_pair, store, rows, row_seconds)


def evaluate_pair(
    store: FrameStore,
    rows: Mapping[str, Method],
    row_seconds: int,
    pair: Pair,
    names: Collection[str],
) -> ResultLine:
    """Evaluate the named rows on a pair: a line of the run. `row_seconds` is the time limit of a
    row of one's own."""
    store.timings.clear()
    features = {rows[name].features for name in names} - {"none"}
    problem = PairProblem(pair, store, features)
    # Read here, since an unreadable point cloud is no failure of a row.
    objects = (pair.reference_sequence, pair.target_sequence)
    extents = [store.extent(pair.category, name) for name in objects]
    # The ground truth from the reference's camera to each target's.
    labels = store.labels(pair.category)
    truths = [
        true_pose(store.dataset, labels, pair, view) for view in range(len(pair.target_frames))
    ]
    nearest = int(np.argmin([rotation_error(np.eye(3), truth[:3, :3]) for truth in truths]))

    # The answers of the rows, measured.
    results = {}
    for name in names:
        method = rows[name]
        own = is_own(name)
        seen = problem_of_own(method.solve, problem) if own else problem
        try:
            with fails_alone(row_seconds) if own else nullcontext():
                start = time.perf_counter()
                answer = ask(method, seen, nearest)
                seconds = time.perf_counter() - start
                results[name] = _measure(answer, problem, truths, extents, seconds)
        except InputError as error:
            # 180 degrees: without these pairs, methods that fail often would look better.
            results[name] = Result(180.0, failed=printable(error))

    # The store and the problem have added the seconds of each stage.
    timings = {
        stage: round(float(np.median(seconds)), 5) for stage, seconds in store.timings.items()
    }
    return ResultLine(pair.key, results, pair.repeat, timings)


def ask(method: Method, problem: Problem, nearest: int | None = None) -> Answer:
    """Ask a row for its pose of a pair; rows that are given the view get the truly nearest one."""
    if method.solve is not None:
        return as_answer(seeded(method.solve, problem.seed)(problem))
    given = nearest if method.answer == "true view" else None
    estimate = problem.estimate(method.features, method.settings, given)
    answer = as_answer(estimate)
    reference = estimate.reference_view
    target = estimate.target_views[estimate.view]
    if given is not None:  # the only view of this estimate
        return replace(answer, view=given)
    if method.answer == "best view":
        return as_answer((view_alignment(reference, target), answer.view))
    if method.answer == "essential matrix":
        rotation, inliers, note = essential_rotation(
            reference.frame, target.frame, estimate.matches, reference.features.grid
        )
        return Answer(rotation, answer.view, note=note, inliers=inliers)
    return answer  # "pose"


def _measure(
    answer: Answer,
    problem: PairProblem,
    truths: Sequence[Float[np.ndarray, "4 4"]],
    extents: Sequence[tuple | None],
    seconds: float,
) -> Result:
    """Compare an answer with the truth; InputError for what cannot be stored."""
    if not 0 <= answer.view < len(truths):
        raise InputError(f"answer is for view {answer.view}, expected 0 to {len(truths) - 1}")
    truth = truths[answer.view]
    found: dict[str, Any] = {
        "error": rotation_error(answer.rotation, truth[:3, :3]),
        "rotation": answer.rotation.ravel().round(6).tolist(),
        "view": answer.view,
        "scale": answer.scale,
        "inliers": answer.inliers,
        "confidence": answer.confidence,
        "seconds": seconds,
        "note": printable(answer.note)[:_LONGEST_NOTE],
    }
    reference, *targets = [frame.camera for frame in problem.frames()]

    # The symmetric error is the smallest over the turns after which both objects look the same.
    pair = problem.pair
    root = problem.store.dataset.root
    turns = common_turns(root, pair.category, pair.reference_sequence, pair.target_sequence)
    if turns is not None:
        to_camera = targets[answer.view].R
        turned = to_camera @ turns @ to_camera.T @ truth[:3, :3]
        found["symmetric_error"] = np.min(rotation_error(answer.rotation, turned))

    # Where the reference object's centre comes to lie, in diameters of the target object; an extent
    # is the centre and the diameter.
    reference_extent, target_extent = extents
    if answer.translation is not None:
        found["position"] = answer.translation.round(6).tolist()
        if reference_extent and target_extent:
            centre = reference.to_camera(reference_extent[0])
            sim3 = Sim3(answer.scale or 1.0, answer.rotation, answer.translation)
            distance = np.linalg.norm(sim3.apply(centre) - Sim3.from_matrix(truth).apply(centre))
            found["translation"] = distance / target_extent[1]

    plain = msgspec.to_builtins(found, enc_hook=np.generic.item)
    for name, value in plain.items():
        if isinstance(value, float):
            plain[name] = round(value, 4)
    return msgspec.convert(plain, Result)
