"""The paper's baselines (sec. 5.2 and supplement) as rows of the benchmark."""

import numpy as np
import torch
import torch.nn.functional as F

from zsp_lite.baselines.icp import align
from zsp_lite.baselines.posecontrast import Viewpoint
from zsp_lite.baselines.sift import Keypoints, mutual_matches
from zsp_lite.benchmark.own import fit_keypoints
from zsp_lite.benchmark.problem import Answer, Problem
from zsp_lite.best_view import score_from_cosines
from zsp_lite.errors import InputError

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
    first: Viewpoint
    first, *others = (problem.store.describe("posecontrast", key) for key in problem.keys)
    similarity = [float(F.cosine_similarity(first.feature, other.feature, dim=0)) for other in others]
    view = int(np.argmax(similarity))
    return Answer(others[view].rotation @ first.rotation.T, view)
