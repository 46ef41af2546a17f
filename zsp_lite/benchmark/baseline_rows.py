"""Rows of the library that are functions of a `PairProblem`: the paper's baselines (sec. 5.2 and
supplement), the fit without RANSAC, and poses that several pairs of frames or objects agree on; and
the matcher without cycles."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.baselines.geometry import align
from zsp_lite.baselines.sift import mutual_matches
from zsp_lite.benchmark.own import fit_keypoints
from zsp_lite.benchmark.problem import Answer, PairProblem, evenly_spaced
from zsp_lite.best_view import score_from_cosines
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate
from zsp_lite.scans.category import CategoryAlignment, synchronise
from zsp_lite.scans.shapes import compare_headings

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
    return _between_worlds(problem, problem.store.aligned(pair.category, len(pair.target_frames)))


@dataclass(frozen=True)
class Scans:
    """Run "scans-R": the pose by all that frames of both objects show, of which at most
    `references` of each are solved against views of the other."""

    references: int

    def __call__(self, problem: PairProblem) -> Answer:
        # Frames of both objects, evenly spaced over their sequences. They start at the reference
        # frame and at the first target frame; there are as many as the pair has target views, or
        # `references` if that is more.
        pair = problem.pair
        numbers = problem.store.dataset.frame_numbers(pair.category)
        ordered = {}
        for name, start in pair.frames[:2]:
            first = numbers[name].index(start)
            ordered[name] = numbers[name][first:] + numbers[name][:first]
        frames = evenly_spaced(ordered, max(self.references, len(pair.target_frames)))
        judged = problem.store.judged(pair.category, frames, self.references, repeat=pair.repeat)
        if not judged:
            raise InputError("neither frames nor shapes determine a pose")
        return _between_worlds(problem, synchronise(judged))


def shape_upright(problem: PairProblem) -> Answer:
    """Run "shape-upright": the heading at which the shapes of both objects fit best, without
    features."""
    pair = problem.pair
    numbers = problem.store.dataset.frame_numbers(pair.category)
    first, second = (
        problem.store.shape(pair.category, name, tuple(numbers[name]))
        for name in (pair.reference_sequence, pair.target_sequence)
    )
    if not (first.upright and second.upright):
        raise InputError("no vertical: neither the floor nor the cameras tell it")
    poses, distance = compare_headings(first, second)
    best = Sim3.from_matrix(poses[distance.argmin()])
    return _answer(problem, second.from_world.inverse() @ best @ first.from_world)


def _between_worlds(problem: PairProblem, alignment: CategoryAlignment) -> Answer:
    """Return the pose of an alignment."""
    pair = problem.pair
    between = alignment.between(pair.reference_sequence, pair.target_sequence)
    return _answer(problem, between, alignment.objects[pair.target_sequence].probability)


def _answer(problem: PairProblem, between: Sim3, confidence: float | None = None) -> Answer:
    """Return a pose from world to world as one in the first target view."""
    reference, target = (frame.camera.sim3 for frame in problem.frames()[:2])
    sim3 = target @ between @ reference.inverse()
    return Answer(sim3.R, 0, sim3.t, sim3.scale, confidence=confidence)
