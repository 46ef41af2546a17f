"""Rows of the library that are functions of a `PairProblem`: the paper's baselines (sec. 5.2 and
supplement), and poses that several pairs of frames or objects agree on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from zsp_lite.alignment import Sim3
from zsp_lite.baselines.geometry import align
from zsp_lite.baselines.sift import Keypoints, mutual_matches
from zsp_lite.benchmark.own import fit_keypoints
from zsp_lite.benchmark.problem import Answer, PairProblem
from zsp_lite.best_view import score_from_cosines
from zsp_lite.category import object_pairs, scan_pairs, synchronise
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError

_K = 50  # number of matches, as in "Ours"


def icp(problem: PairProblem, view: int = 0) -> Answer:
    """Run "ICP" in one target view."""
    reference, *targets = problem.frames(depth=True)
    # ICP starts where the first cameras of both sequences coincide.
    dataset = problem.store.dataset
    pair = problem.pair
    reference_frames = dataset.frames(pair.category, pair.reference_sequence)
    target_frames = dataset.frames(pair.category, pair.target_sequence)
    first_cameras = (dataset.camera(reference_frames[0]), dataset.camera(target_frames[0]))
    try:
        sim3 = align(reference, targets, view, first_cameras, problem.seed)
    except InputError as error:
        return Answer(np.eye(3), view, note=f"pose is the initial one, not a fit: {error}")
    return Answer(sim3.R, view, sim3.t, sim3.scale)


def icp_best_view(problem: PairProblem) -> Answer:
    """Run "ICP + BV": ICP in the best view of the paper's method."""
    return icp(problem, problem.estimate().view)


def sift(problem: PairProblem) -> Answer:
    """Run "SIFT": select the view by the similarity of its mutual nearest neighbours, and fit the
    pose by RANSAC."""
    keypoints: list[Keypoints] = [crop.described["sift"] for crop in problem.crops]
    reference, *targets = keypoints
    matches = [mutual_matches(reference, target, _K) for target in targets]
    scores = [score_from_cosines(torch.from_numpy(cosines), _K) for _, _, cosines in matches]
    view = int(np.argmax(scores))
    in_reference, in_target, _ = matches[view]
    return fit_keypoints(
        problem, view, reference.pixels[in_reference], targets[view].pixels[in_target]
    )


def category(problem: PairProblem) -> Answer:
    """Run "category": the pose by the alignment of all objects of the category, without labels."""
    pair = problem.pair
    pairs = object_pairs(
        problem.store.dataset,
        pair.category,
        sequences=None,
        per_object=None,
        targets=len(pair.target_frames),
    )
    return _agreed(problem, pairs)


@dataclass(frozen=True)
class Scans:
    """Run "scans-R": the pose that `references` frames of each object, in views of the other, agree
    on."""

    references: int

    def __call__(self, problem: PairProblem) -> Answer:
        return _agreed(problem, scan_pairs(problem.store.dataset, problem.pair, self.references))


def _agreed(problem: PairProblem, pairs: Sequence[Pair]) -> Answer:
    """Return the pose that the hypotheses of the problem's pair and of other pairs agree on."""
    of_problem = problem.hypotheses()
    hypotheses = [of_problem]
    for pair in pairs:
        # With the random draws of the same evaluation (see `seeds` of `run.evaluate`).
        pair = replace(pair, repeat=problem.pair.repeat)
        if pair != problem.pair:
            of_pair = problem.store.hypotheses(pair)
            if of_pair is not None:
                hypotheses.append(of_pair)
    alignment = synchronise(hypotheses)

    # From the worlds of both objects to the cameras of the reference and the first target view.
    reference, target = [frame.camera for frame in problem.frames()[:2]]
    to_reference = Sim3(1.0, reference.R, reference.t)
    to_target = Sim3(1.0, target.R, target.t)
    between = alignment.between(of_problem.reference, of_problem.target)
    sim3 = to_target @ between @ to_reference.inverse()
    probability = alignment.objects[of_problem.target].probability
    return Answer(sim3.R, 0, sim3.t, sim3.scale, confidence=probability)
