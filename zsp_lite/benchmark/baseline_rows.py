"""The paper's baselines (sec. 5.2 and supplement), and the alignment of a category, as rows of the benchmark."""

from contextlib import suppress

import numpy as np
import torch
import torch.nn.functional as F

from zsp_lite.alignment import Sim3
from zsp_lite.baselines.geometry import align
from zsp_lite.baselines.sift import Keypoints, mutual_matches
from zsp_lite.benchmark.own import fit_keypoints
from zsp_lite.benchmark.problem import Answer, FrameStore, Problem
from zsp_lite.best_view import score_from_cosines
from zsp_lite.category import PairHypotheses, object_pairs, synchronise, world_hypotheses
from zsp_lite.errors import InputError, NoPoseError

_K = 50  # number of matches, as in "Ours"


def icp(problem: Problem, view: int = 0) -> Answer:
    """Run "ICP", in the first target view; the worlds start where the first cameras of both sequences coincide."""
    reference, *targets = problem.frames(depth=True)
    sequences = problem.pair.reference_sequence, problem.pair.target_sequence
    dataset, category = problem.store.dataset, problem.store.category
    first = tuple(dataset.camera(dataset.frames(category, sequence)[0]) for sequence in sequences)
    try:
        sim3 = align(reference, targets, view, first, problem.seed)
    except InputError as error:
        return Answer(np.eye(3), view, note=f"pose is the initial one, not a fit: {error}")
    return Answer(sim3.R, view, sim3.t, sim3.scale)


def icp_best_view(problem: Problem) -> Answer:
    """Run "ICP + BV", the same in the best view of the paper's method."""
    return icp(problem, problem.estimate().view)


def sift(problem: Problem) -> Answer:
    """Run "SIFT": select the view by the similarity of its mutual nearest neighbours, and fit the pose by RANSAC."""
    first: Keypoints
    first, *others = (problem.store.describe("sift", key) for key in problem.keys)
    found = [mutual_matches(first, other, _K) for other in others]
    view = int(np.argmax([score_from_cosines(torch.from_numpy(similarity), _K) for *_, similarity in found]))
    one, two, _ = found[view]
    return fit_keypoints(problem, view, first.pixels[one], others[view].pixels[two])


def posecontrast(problem: Problem) -> Answer:
    """Run "PoseContrast": the relative rotation of the viewpoints of the reference and the most similar view."""
    (rotation, feature), *others = (problem.store.describe("posecontrast", key) for key in problem.keys)
    view = int(np.argmax([float(F.cosine_similarity(feature, other, dim=0)) for _, other in others]))
    return Answer(others[view][0] @ rotation.T, view)


def category(problem: Problem) -> Answer:
    """Run "category": the pose by the alignment of all objects of the category, which needs no label of any."""
    own = hypotheses(problem)
    alignment = synchronise([*_of_all_objects(problem.store, len(problem.pair.target_frames)), own])
    reference, target = (Sim3(1.0, one.camera.R, one.camera.t) for one in problem.frames()[:2])
    sim3 = target @ alignment.between(own.reference, own.target) @ reference.inverse()
    return Answer(sim3.R, 0, sim3.t, sim3.scale, confidence=alignment.objects[own.target].probability)


def _of_all_objects(store: FrameStore, views: int) -> list[PairHypotheses]:
    """Find the hypotheses between all objects of a category, once for all pairs of so many views."""
    if ("category", views) not in store.kept:
        found = []
        for pair in object_pairs(store.dataset, store.category, None, None, views):
            with suppress(NoPoseError):
                found.append(hypotheses(Problem(pair, store)))
        store.kept["category", views] = found
    return store.kept["category", views]


def hypotheses(problem: Problem) -> PairHypotheses:
    """Find the hypotheses of the verified solver between the worlds of both objects."""
    return world_hypotheses(problem.pair, problem.estimate(settings={"solver": "verified"}))
