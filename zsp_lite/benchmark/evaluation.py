"""Evaluate rows on one pair: estimates, their errors and their cost (paper sec. 5.1)."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.baselines.essential_matrix import essential_rotation
from zsp_lite.benchmark.methods import METHODS, Method, make_extractors
from zsp_lite.benchmark.own import describe_failure
from zsp_lite.benchmark.problem import Answer, FrameStore, Problem, as_answer
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.errors import FatalError, InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import view_alignment
from zsp_lite.synthetic.recording import read_poses

FAILED = 180.0  # error of a failed pair: without these pairs, methods that fail often would look better
Poses = Float[np.ndarray, "n 4 4"]


class Evaluator:
    """Evaluates chunks in one process; frames and features are kept from chunk to chunk."""

    def __init__(self, root: str, methods: Mapping[str, Method], backbone: Any, threads: int | None = None):
        """Make the extractors; `threads` are those of feature extraction."""
        loaded = load_backbone(backbone) if isinstance(backbone, str | BackboneConfig) else backbone
        self._dataset, self._methods, self._threads = Co3D(root), methods, threads
        self._extractors, self._store = make_extractors(loaded, methods), None

    def lines(self, chunk: Sequence[tuple[Pair, list[str]]]) -> Iterator[dict[str, Any]]:
        """Evaluate the pairs of a chunk, all of one category (see `evaluate_pair`)."""
        category = chunk[0][0].category
        if self._store is None or self._store.category != category:
            self._store = FrameStore(self._dataset, category, self._extractors, self._threads)
            self._labels = read_labels(self._dataset.root, category)
        for pair, names in chunk:
            yield evaluate_pair(pair, {name: self._methods[name] for name in names}, self._store, self._labels)


def evaluate_pair(
    pair: Pair, methods: Mapping[str, Method], store: FrameStore, labels: Mapping[str, PoseLabel]
) -> dict[str, Any]:
    """Evaluate rows on a pair: a line of the run's results (see `runs.ResultLine`), with median seconds by stage."""
    store.timings.clear()
    problem = Problem(pair, store)
    first, second = labels[pair.reference_sequence], labels[pair.target_sequence]
    reference, *targets = problem.frames()
    # Ground truth from the reference's camera to each target's.
    truths = np.stack([relative_pose(first, reference.camera, second, target.camera) for target in targets])
    results = {name: _evaluate(name, method, problem, truths) for name, method in methods.items()}
    timings = {stage: round(float(np.median(seconds)), 5) for stage, seconds in store.timings.items()}
    return {"pair": pair.key, "results": results, "timings": timings}


def _evaluate(name: str, method: Method, problem: Problem, truths: Poses) -> dict[str, Any]:
    start = time.perf_counter()
    try:
        answer = as_answer(method.solve(problem)) if method.solve else _answer(method, problem, truths)
        if not 0 <= answer.view < len(truths):
            raise InputError(f"answer is for view {answer.view}, expected 0 to {len(truths) - 1}")
    except FatalError:
        raise
    except InputError as error:  # there is no pose
        return {"error": FAILED, "failed": str(error)}
    except Exception as error:  # a row of one's own may raise anything; a mistake of the library keeps its traceback
        if replace(method, targets=None) in METHODS.values():
            raise
        raise FatalError(f"method {name!r} failed: {describe_failure(error)}") from error
    result = {"seconds": time.perf_counter() - start} | _measure(answer, problem, truths[answer.view])
    return {name: round(value, 4) if isinstance(value, float) else value for name, value in result.items()}


def _measure(answer: Answer, problem: Problem, truth: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Measure an answer: "error" in degrees, and what is known of the others.

    "symmetric_error" is up to turns after which both objects look the same, "translation" the error of the object's
    centre in diameters of the target, "scale" estimated over labelled, which is 1.
    """
    known = {name: getattr(answer, name) for name in ("view", "note", "scale", "inliers", "confidence")}
    known["error"] = rotation_error(answer.rotation, truth[:3, :3])
    reference, *targets = (frame.camera for frame in problem.frames())
    if (symmetries := _symmetries(problem)) is not None:
        to_camera = targets[answer.view].R
        turned = to_camera @ symmetries @ to_camera.T @ truth[:3, :3]
        known["symmetric_error"] = np.min(rotation_error(answer.rotation, turned))
    ends = [problem.store.extent(name) for name in (problem.pair.reference_sequence, problem.pair.target_sequence)]
    if answer.translation is not None and None not in ends:
        (first, _), (_, diameter) = ends
        centre, scale = reference.to_camera(first), 1.0 if answer.scale is None else answer.scale
        found = scale * answer.rotation @ centre + answer.translation
        known["translation"] = np.linalg.norm(found - truth[:3, :3] @ centre - truth[:3, 3]) / diameter
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in known.items()}
    return {name: value for name, value in plain.items() if value is not None}


def _symmetries(problem: Problem) -> Float[np.ndarray, "s 3 3"] | None:
    """Turns in the world of the target after which both objects look the same; None where no renderer knows them."""
    pair, poses = problem.pair, read_poses(problem.store.dataset.root, problem.pair.category)
    if not {pair.reference_sequence, pair.target_sequence} <= poses.keys():
        return None
    first, second = poses[pair.reference_sequence], poses[pair.target_sequence]
    turns = [Rotation.from_euler("z", turn, degrees=True).as_matrix() for turn in first.turns if turn in second.turns]
    return np.stack([np.eye(3), *(second.R @ turn @ second.R.T for turn in turns)])


def _answer(method: Method, problem: Problem, truths: Poses) -> Answer:
    """Answer of a row that is the paper's method with other settings."""
    if method.answer == "true view":
        nearest = int(rotation_error(np.eye(3), truths[:, :3, :3]).argmin())
        return replace(as_answer(problem.estimate(method.features, method.settings, nearest)), view=nearest)
    estimate = problem.estimate(method.features, method.settings)
    answer = as_answer(estimate)
    reference, target = estimate.reference_view, estimate.target_views[estimate.view]
    if method.answer == "best view":
        sim3 = view_alignment(reference, target)
        return replace(answer, rotation=sim3.R, translation=sim3.t, scale=sim3.scale, note="")
    if method.answer == "essential matrix":
        frames, grid = (reference.frame, target.frame), reference.features.grid
        rotation, inliers, note = essential_rotation(*frames, estimate.matches, grid)
        return Answer(rotation, answer.view, note=note, inliers=inliers)
    return answer
