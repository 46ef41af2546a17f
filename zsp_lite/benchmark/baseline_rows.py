"""The paper's baselines (sec. 5.2 and supplement), and poses that many frames or objects agree on,
as rows."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch

from zsp_lite.alignment import Sim3
from zsp_lite.baselines.geometry import align
from zsp_lite.baselines.sift import Keypoints, mutual_matches
from zsp_lite.benchmark.own import fit_keypoints
from zsp_lite.benchmark.problem import Answer, PairProblem
from zsp_lite.best_view import score_from_cosines
from zsp_lite.category import (
    PairHypotheses,
    object_pairs,
    scan_pairs,
    synchronise,
    world_hypotheses,
)
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError, NoPoseError

_K = 50  # number of matches, as in "Ours"


def icp(problem: PairProblem, view: int = 0) -> Answer:
    """Run "ICP", in the first target view; the worlds start where the first cameras of both
    sequences coincide."""
    reference, *targets = problem.frames(depth=True)
    sequences = problem.pair.reference_sequence, problem.pair.target_sequence
    dataset, category = problem.store.dataset, problem.pair.category
    first = tuple(dataset.camera(dataset.frames(category, sequence)[0]) for sequence in sequences)
    try:
        sim3 = align(reference, targets, view, first, problem.seed)
    except InputError as error:
        return Answer(np.eye(3), view, note=f"pose is the initial one, not a fit: {error}")
    return Answer(sim3.R, view, sim3.t, sim3.scale)


def icp_best_view(problem: PairProblem) -> Answer:
    """Run "ICP + BV", the same in the best view of the paper's method."""
    return icp(problem, problem.estimate().view)


def sift(problem: PairProblem) -> Answer:
    """Run "SIFT": select the view by the similarity of its mutual nearest neighbours, and fit the
    pose by RANSAC."""
    keypoints: list[Keypoints] = [crop.described["sift"] for crop in problem.crops]
    first, *others = keypoints
    matches = [mutual_matches(first, other, _K) for other in others]
    scores = [score_from_cosines(torch.from_numpy(cosines), _K) for *_, cosines in matches]
    view = int(np.argmax(scores))
    one, two, _ = matches[view]
    return fit_keypoints(problem, view, first.pixels[one], others[view].pixels[two])


def category(problem: PairProblem) -> Answer:
    """Run "category": the pose by the alignment of all objects of the category, which needs no
    label of any."""
    pairs = object_pairs(
        problem.store.dataset, problem.pair.category, None, None, len(problem.pair.target_frames)
    )
    return _agreed(problem, [problem.pair, *pairs])


@dataclass(frozen=True)
class Scans:
    """Run "scans-R": the pose that `references` frames of each object agree on, solved against
    views of the other."""

    references: int

    def __call__(self, problem: PairProblem) -> Answer:
        return _agreed(problem, scan_pairs(problem.store.dataset, problem.pair, self.references))


def _agreed(problem: PairProblem, pairs: Sequence[Pair]) -> Answer:
    """Return the pose that the hypotheses of pairs of frames agree on, those of the problem's own
    pair among them."""
    own = hypotheses(problem)
    kept = problem.store.kept  # for other rows, and for other pairs of the same objects
    found = [own]
    for pair in (replace(pair, repeat=problem.pair.repeat) for pair in pairs):
        if pair == problem.pair:
            continue
        key = hypotheses, pair
        if key not in kept:
            kept[key] = None
            with suppress(NoPoseError):
                kept[key] = hypotheses(PairProblem(pair, problem.store))
        if kept[key] is not None:
            found.append(kept[key])
    alignment = synchronise(found)
    reference, target = [Sim3(1.0, one.camera.R, one.camera.t) for one in problem.frames()[:2]]
    sim3 = target @ alignment.between(own.reference, own.target) @ reference.inverse()
    probability = alignment.objects[own.target].probability
    return Answer(sim3.R, 0, sim3.t, sim3.scale, confidence=probability)


def hypotheses(problem: PairProblem) -> PairHypotheses:
    """Find the hypotheses of the verified solver between the worlds of both objects."""
    ends = problem.pair.reference_sequence, problem.pair.target_sequence
    return world_hypotheses(*ends, problem.estimate(settings={"solver": "verified"}))
