"""Evaluate rows on one pair: estimates, their errors and their cost (paper sec. 5.1)."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from zsp_lite.baselines.essential_matrix import essential_rotation
from zsp_lite.benchmark.methods import Method
from zsp_lite.benchmark.own import describe_failure
from zsp_lite.benchmark.problem import Answer, Problem, as_answer
from zsp_lite.benchmark.store import FrameStore
from zsp_lite.best_view import mask_iou
from zsp_lite.data.co3d import Pair
from zsp_lite.data.labels import PoseLabel, relative_pose
from zsp_lite.errors import FatalError, InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import view_alignment
from zsp_lite.synthetic.recording import read_poses
from zsp_lite.views import has_saliency, patch_mask

# Error in degrees of a failed pair. Without these pairs, methods that fail often would look better.
FAILED = 180.0
Poses = Float[np.ndarray, "n 4 4"]


def evaluate_pair(
    pair: Pair, methods: Mapping[str, Method], store: FrameStore, labels: Mapping[str, PoseLabel]
) -> dict[str, Any]:
    """Evaluate rows on a pair: a line of the run's results.

    Its "results" are by row {"error": degrees, and where they are known "symmetric_error" (up to turns after which both
    objects look the same), "translation" (error of the object's centre in diameters of the target),
    "scale" (estimated over labelled, which is 1), "view", "note", "timings" and the row's details, and of solvers with
    hypotheses "one_of_two" and the error of the second pose, "second_error"}, or {"error": 180, "failed": the reason}
    for a row that raises InputError.
    """
    start = time.perf_counter()
    store.timings.clear()
    problem = Problem(pair, store)
    truths, turns = _true_poses(problem, labels), _symmetries(problem)
    results = {name: _evaluate(method, problem, truths, turns) for name, method in methods.items()}
    saliency_iou = _saliency_iou(problem, store)
    seconds, timings = round(time.perf_counter() - start, 5), dict(store.timings)
    cost = {"seconds": seconds, "timings": timings, "saliency_iou": saliency_iou}
    return {"pair": pair.key, "results": results} | cost


def _true_poses(problem: Problem, labels: Mapping[str, PoseLabel]) -> Poses:
    """Ground truth from the reference's camera to each target's."""
    first, second = (labels[name] for name in (problem.pair.reference_sequence, problem.pair.target_sequence))
    reference, *targets = problem.frames()
    return np.stack([relative_pose(first, reference.camera, second, target.camera) for target in targets])


def _symmetries(problem: Problem) -> Float[np.ndarray, "s 3 3"] | None:
    """Turns in the world of the target after which both objects look the same; None where no renderer knows them."""
    pair, poses = problem.pair, read_poses(problem.store.dataset.root, problem.pair.category)
    if not {pair.reference_sequence, pair.target_sequence} <= poses.keys():
        return None
    first, second = poses[pair.reference_sequence], poses[pair.target_sequence]
    turns = [Rotation.from_euler("z", turn, degrees=True).as_matrix() for turn in first.turns if turn in second.turns]
    return np.stack([np.eye(3), *(second.R @ turn @ second.R.T for turn in turns)])


def _evaluate(
    method: Method, problem: Problem, truths: Poses, symmetries: Float[np.ndarray, "s 3 3"] | None
) -> dict[str, Any]:
    start = time.perf_counter()
    try:
        answer = _solve(method, problem) if method.solve else _answer(method, problem, truths)
        if not 0 <= answer.view < len(truths):
            raise InputError(f"answer is for view {answer.view}, expected 0 to {len(truths) - 1}")
    except FatalError:
        raise
    except InputError as error:
        return {"error": FAILED, "failed": str(error)}

    def error_of(rotation: Float[np.ndarray, "3 3"], view: int) -> float:
        return float(rotation_error(rotation, truths[view, :3, :3]))

    details = {"timings": {"total": time.perf_counter() - start}} | dict(answer.details)
    result = {"error": error_of(answer.rotation, answer.view), "view": int(answer.view)}
    reference, target = problem.frames()[0].camera, problem.frames()[1 + answer.view].camera
    if symmetries is not None:
        turned = target.R @ symmetries @ target.R.T @ truths[answer.view, :3, :3]
        result["symmetric_error"] = float(np.min(rotation_error(answer.rotation, turned)))
    ends = problem.store.extent(problem.pair.reference_sequence), problem.store.extent(problem.pair.target_sequence)
    if answer.translation is not None and None not in ends:
        centre = reference.to_camera(ends[0][0])
        found = (1.0 if answer.scale is None else answer.scale) * answer.rotation @ centre + answer.translation
        true = truths[answer.view, :3, :3] @ centre + truths[answer.view, :3, 3]
        result["translation"] = float(np.linalg.norm(found - true) / ends[1][1])
    if answer.scale is not None:
        result["scale"] = float(answer.scale)
    if answer.hypotheses:
        result["one_of_two"] = answer.one_of_two
        different = [one for index, one in enumerate(answer.hypotheses) if one.mode == index]
        result |= {"second_error": error_of(one.sim3.R, one.view) for one in different[1:2]}
    timings = {stage: round(seconds, 5) for stage, seconds in details.pop("timings").items()}
    return result | details | {"note": answer.note, "timings": timings}


def _solve(method: Method, problem: Problem) -> Answer:
    """Call the function of a row. Its exceptions other than InputError end the run, in one line if it is a user's."""
    try:
        return as_answer(method.solve(problem))
    except Exception as error:
        own = getattr(method.solve, "own", method.solve)
        module = getattr(own, "__module__", None) or type(own).__module__
        if isinstance(error, InputError) or module.startswith("zsp_lite."):
            raise
        raise FatalError(f"method {getattr(own, '__qualname__', own)!r} failed: {describe_failure(error)}") from error


def _answer(method: Method, problem: Problem, truths: Poses) -> Answer:
    """Answer of a row that is the paper's method with other settings."""
    nearest = None
    if method.answer == "true view":
        nearest = int(rotation_error(np.eye(3), truths[:, :3, :3]).argmin())
    estimate = problem.estimate(method.features, method.settings, nearest)
    answer = as_answer(estimate)
    if nearest is not None:
        return replace(answer, view=nearest, hypotheses=())
    if method.answer == "best view":
        sim3 = view_alignment(estimate.reference_view, estimate.target_views[estimate.view])
        return Answer(sim3.R, answer.view, sim3.t, sim3.scale, "", answer.details)
    if method.answer == "essential matrix":
        views = estimate.reference_view.frame, estimate.target_views[estimate.view].frame
        rotation, inliers, note = essential_rotation(*views, estimate.matches, estimate.reference_view.features.grid)
        return Answer(rotation, answer.view, note=note, details=dict(answer.details) | {"inliers": inliers})
    return answer


def _saliency_iou(problem: Problem, store: FrameStore) -> dict[str, float]:
    """IoU of the backbone's foreground (the paper's threshold) with the mask's patches, by SEQUENCE/FRAME."""
    found: dict[str, float] = {}
    for key in problem.keys if has_saliency(store.extractors.get("backbone")) else ():
        features = store.description("backbone", key)
        if features is not None and (frame := store.frame(key)).mask is not None:
            iou = mask_iou(features.foreground().cpu(), patch_mask(frame, features.grid))
            found[f"{key[0]}/{key[1]}"] = round(iou, 4)
    return found
