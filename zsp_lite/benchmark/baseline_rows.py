"""What the library's own rows consist of: functions of a `PairProblem` for the paper's baselines
(sec. 5.2 and supplement), for the fit without RANSAC and for poses that several pairs of frames or
objects agree on, and the matcher without cycles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.baselines.geometry import align
from zsp_lite.baselines.sift import mutual_matches
from zsp_lite.benchmark.own import fit_keypoints
from zsp_lite.benchmark.problem import Answer, PairProblem
from zsp_lite.best_view import score_from_cosines
from zsp_lite.category import object_pairs, scan_pairs, synchronise
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate

_K = 50  # number of matches, as in "Ours"


def icp(problem: PairProblem, view: int = 0) -> Answer:
    """Run "ICP" in one target view."""
    reference, *targets = problem.frames(depth=True)
    # ICP starts where the first cameras of both sequences coincide.
    dataset = problem.store.dataset
    pair = problem.pair
    first_cameras = tuple(
        dataset.camera(dataset.frames(pair.category, sequence)[0])
        for sequence in (pair.reference_sequence, pair.target_sequence)
    )
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
    reference, *targets = [crop.described["sift"] for crop in problem.crops]
    matches = [mutual_matches(reference, target, _K) for target in targets]
    scores = [score_from_cosines(torch.from_numpy(cosines), _K) for _, _, cosines in matches]
    view = int(np.argmax(scores))
    in_reference, in_target, _ = matches[view]
    return fit_keypoints(
        problem, view, reference.pixels[in_reference], targets[view].pixels[in_target]
    )


def least_squares(problem: PairProblem) -> PoseEstimate | tuple[Sim3, int]:
    """Run "ours-least-squares": fit the pose to all matches of the best view, without RANSAC."""
    estimate = problem.estimate()
    try:
        return umeyama(*estimate.points), estimate.view
    except InputError:
        return estimate  # where RANSAC fits no pose either: that of the best view


def nearest_patches(
    similarity: Float[Tensor, "n1 n2"],
    foreground1: Bool[Tensor, " n1"],
    foreground2: Bool[Tensor, " n2"],
) -> tuple[Int[Tensor, " n1"], Float[Tensor, " n1"]]:
    """Match each patch with its nearest neighbour, as the cycles do, without the way back; the
    score is their similarity."""
    score, partner = similarity.max(dim=1)
    return partner, score.masked_fill(~(foreground1 & foreground2[partner]), -torch.inf)


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
    to_reference, to_target = [
        Sim3(1.0, frame.camera.R, frame.camera.t) for frame in problem.frames()[:2]
    ]
    between = alignment.between(of_problem.reference, of_problem.target)
    sim3 = to_target @ between @ to_reference.inverse()
    probability = alignment.objects[of_problem.target].probability
    return Answer(sim3.R, 0, sim3.t, sim3.scale, confidence=probability)
