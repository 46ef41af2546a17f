"""One pair through every row that is still wanted: estimates, their errors, and what they cost (paper sec. 5.1)."""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from zsp_lite.benchmark.essential import essential_rotation
from zsp_lite.benchmark.methods import Method
from zsp_lite.benchmark.problem import Answer, Problem, as_answer
from zsp_lite.benchmark.store import FrameStore, Spent
from zsp_lite.best_view import mask_iou
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import PoseLabel, relative_pose
from zsp_lite.data.pairs import Pair
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error, translation_error
from zsp_lite.pipeline import view_alignment
from zsp_lite.views import patch_mask

# A pair whose frames cannot be used counts as wrong as can be: leaving it out would reward failing.
FAILED = 180.0


def evaluate_pair(
    pair: Pair, methods: Mapping[str, Method], store: FrameStore, labels: Mapping[str, PoseLabel]
) -> dict[str, Any]:
    """A record of the pair: each row's errors, and what they cost.

    Rows that raise InputError count as failed. Raises InputError for missing labels and files.
    """
    for sequence in (pair.reference_sequence, pair.target_sequence):
        if sequence not in labels:
            raise InputError(f"{pair.category}/{sequence}: no pose label, expected one for each of a pair")
    start = time.perf_counter()
    before = {name: Spent(spent.times, spent.seconds) for name, spent in store.spent.items()}
    problem = Problem(pair, store)
    store.load(problem.keys)
    results: dict[str, dict] = {}
    try:
        truths = _truths(problem, labels)
    except InputError as error:
        results = {name: {"error": FAILED, "failed": str(error)} for name in methods}
    for name, method in methods.items():
        if name not in results:
            results[name] = _evaluate(method, problem, truths)
    spent = {
        name: Spent(now.times - then.times, now.seconds - then.seconds)
        for name, now in store.spent.items()
        for then in [before.get(name, Spent())]
    }
    described = spent.get("backbone", Spent())
    return {
        "key": pair.key,
        "category": pair.category,
        "seed": pair.seed,
        "methods": results,
        "saliency_iou": _saliency_iou(problem, store),
        # None where nothing was left to compute.
        "seconds_per_frame": described.seconds / described.times if described.times else None,
        "seconds": round(time.perf_counter() - start, 5),
        "spent": {name: [one.times, round(one.seconds, 5)] for name, one in spent.items() if one.times},
    }


def _truths(problem: Problem, labels: Mapping[str, PoseLabel]) -> Float[np.ndarray, "n 4 4"]:
    """Ground truth from the reference's camera to each target's."""
    first, second = (labels[name] for name in (problem.pair.reference_sequence, problem.pair.target_sequence))
    reference, *targets = problem.frames()
    return np.stack([relative_pose(first, reference.camera, second, target.camera) for target in targets])


def _evaluate(method: Method, problem: Problem, truths: Float[np.ndarray, "n 4 4"]) -> dict[str, Any]:
    start = time.perf_counter()
    try:
        answer = as_answer(method.solve(problem)) if method.solve else _answer(method, problem, truths)
        if not 0 <= answer.view < len(truths):
            raise InputError(f"answer is for view {answer.view}, expected 0 to {len(truths) - 1}")
        return _result(answer, truths[answer.view], time.perf_counter() - start)
    except InputError as error:
        return {"error": FAILED, "failed": str(error)}


def _result(answer: Answer, truth: Float[np.ndarray, "4 4"], seconds: float) -> dict[str, Any]:
    result = {"error": float(rotation_error(answer.rotation, truth[:3, :3]))}
    if answer.translation is not None:
        result["translation_error"] = float(translation_error(answer.translation, truth[:3, 3]))
    if answer.scale is not None:
        result["scale"] = float(answer.scale)
    details = dict(answer.details)
    timings = details.pop("timings", None) or {"total": seconds}
    timings = {stage: round(spent, 5) for stage, spent in timings.items()}
    return result | {"view": int(answer.view)} | details | {"note": answer.note, "timings": timings}


def _answer(method: Method, problem: Problem, truths: Float[np.ndarray, "n 4 4"]) -> Answer:
    """A row that is the paper's method with some of its settings changed."""
    first = None
    if method.answer == "true view":
        first = int(rotation_error(np.eye(3), truths[:, :3, :3]).argmin())
    estimate = problem.estimate(method.features, method.settings, first)
    answer = as_answer(estimate)
    if first is not None:
        return Answer(answer.rotation, first, answer.translation, answer.scale, answer.note, answer.details)
    if method.answer == "best view":
        sim3 = view_alignment(estimate.reference_view, estimate.target_views[estimate.view])
        return Answer(sim3.R, answer.view, sim3.t, sim3.scale, "", answer.details)
    if method.answer == "essential matrix":
        views = estimate.reference_view.frame, estimate.target_views[estimate.view].frame
        rotation, inliers, note = essential_rotation(*views, estimate.matches, estimate.reference_view.features.grid)
        return Answer(rotation, answer.view, note=note, details=dict(answer.details) | {"inliers": inliers})
    return answer


def _saliency_iou(problem: Problem, store: FrameStore) -> dict[str, float]:
    """IoU of the backbone's foreground (the paper's threshold) with the mask's patches, by frame."""
    found = {}
    for key in problem.keys:
        features = store.described("backbone", key)
        if features is None:
            continue
        frame: Frame = store.frame(key)
        if frame.mask is not None:
            iou = mask_iou(features.foreground().cpu(), patch_mask(frame, features.grid))
            found[f"{key[0]}/{key[1]}"] = round(iou, 4)
    return found
