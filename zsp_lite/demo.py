"""One pair of each sample category, from data folder to pose error: the computation of `zsp-lite demo`."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import read_labels, relative_pose
from zsp_lite.data.pairs import Pair, labelled_categories, sample_pairs, shipped_pairs
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate
from zsp_lite.features import FeatureExtractor
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose

N_TARGETS = 5
_SEQUENCE_FRAMES = 6


@dataclass(frozen=True, eq=False)
class DemoResult:
    """Pose estimate of one pair, compared with its labels.

    Attributes:
        pair: The evaluation pair.
        estimate: Its pose estimate.
        error: Rotation error in degrees.
        seconds: Run time of the estimate, from frames in memory.
        sequence: At most six whole frames, evenly spaced over the target sequence, for displaying the propagated pose.
    """

    pair: Pair
    estimate: PoseEstimate
    error: float
    seconds: float
    sequence: tuple[Frame, ...]


def demo_pairs(dataset: Co3D, n_targets: int = N_TARGETS) -> list[Pair]:
    """Select one pair of every category with pose labels, independently of its result.

    This is the first evaluation pair in the data folder, or, for a category without pairs of `n_targets` target views,
    the first of a sample with seed 0.

    Raises:
        InputError: No category has pose labels.
    """
    pairs = []
    for category in labelled_categories(dataset):
        shipped = shipped_pairs(dataset, category, n_targets)
        pairs.append((shipped or sample_pairs(dataset, category, 1, n_targets, seed=0))[0])
    return pairs


def run_demo(dataset: Co3D, backbone: FeatureExtractor) -> Iterator[DemoResult]:
    """Estimate the poses of `demo_pairs` with the paper's settings, one at a time."""
    method = ZeroShotPose(backbone)
    for pair in demo_pairs(dataset):
        yield run_pair(dataset, pair, method)


def run_pair(dataset: Co3D, pair: Pair, method: ZeroShotPose) -> DemoResult:
    """Load a pair's frames, estimate its pose, and compare it with the ground truth of the labels.

    Raises:
        InputError: A frame or a label of the pair is missing, or the pose cannot be estimated.
    """
    reference, targets = dataset.load_pair(pair)

    start = time.perf_counter()
    estimate = method.estimate(reference, targets)
    seconds = time.perf_counter() - start

    labels = read_labels(dataset.root, pair.category)
    for sequence in (pair.reference_sequence, pair.target_sequence):
        if sequence not in labels:
            raise InputError(f"{pair.category}/{sequence}: no pose label, expected one to compare the estimate with")
    truth = relative_pose(
        labels[pair.reference_sequence], reference.camera,
        labels[pair.target_sequence], targets[estimate.view].camera,
    )  # fmt: skip
    error = float(rotation_error(estimate.sim3.R, truth[:3, :3]))
    sequence = dataset.frames(pair.category, pair.target_sequence)
    chosen = np.linspace(0, len(sequence), _SEQUENCE_FRAMES, endpoint=False).astype(int)
    return DemoResult(pair, estimate, error, seconds, tuple(dataset.load(sequence[i]) for i in np.unique(chosen)))
