"""One pair of every sample category, from folder to pose: what `zsp-lite demo` shows and the notebooks reuse."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import read_labels, relative_pose
from zsp_lite.data.pairs import Pair, labelled_categories, sample_pairs, shipped_pairs
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import PoseEstimate, View, ZeroShotPose

N_TARGETS = 5
_SEQUENCE_FRAMES = 6


@dataclass(frozen=True, eq=False)
class DemoResult:
    """One pair and its estimate. `error`: rotation error in degrees; `seconds`: for the whole estimate, from
    frames in memory; `sequence`: whole frames spread over the target sequence, which the pose is propagated to.
    """

    pair: Pair
    estimate: PoseEstimate
    error: float
    seconds: float
    sequence: tuple[Frame, ...]


def demo_pairs(dataset: Co3D, n_targets: int = N_TARGETS) -> list[Pair]:
    """The first evaluation pair of every category with pose labels: fixed beforehand, not picked for its result.

    Categories without evaluation pairs for `n_targets` get the first pair of a sample with seed 0. Raises
    InputError where the folder holds no such category.
    """
    pairs = []
    for category in labelled_categories(dataset):
        shipped = shipped_pairs(dataset, category, n_targets)
        pairs.append((shipped or sample_pairs(dataset, category, 1, n_targets, seed=0))[0])
    return pairs


def run_demo(dataset: Co3D, backbone: Callable[[Sequence[np.ndarray]], list[FeatureMap]]) -> Iterator[DemoResult]:
    """The estimates for `demo_pairs`, one after the other, with the paper's settings."""
    method = ZeroShotPose(backbone)
    for pair in demo_pairs(dataset):
        yield run_pair(dataset, pair, method)


def run_pair(dataset: Co3D, pair: Pair, method: ZeroShotPose) -> DemoResult:
    """Load a pair's frames, estimate its pose, and compare it with the pose that the labels give.

    Raises InputError where a frame or a label of the pair is missing.
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
    spread = np.linspace(0, len(sequence), _SEQUENCE_FRAMES, endpoint=False).astype(int)
    return DemoResult(pair, estimate, error, seconds, tuple(dataset.load(sequence[i]) for i in np.unique(spread)))


def object_cloud(view: View, most: int = 2000, seed: int = 0) -> Float[np.ndarray, "n 3"]:
    """Camera-frame points of the pixels of the object with a measured depth, strays left out, at most `most` of them.

    The object is where the mask is above 0.9; without a mask, the patches of the foreground. Raises
    InputError where none of its pixels has a depth.
    """
    frame = view.frame
    if frame.depth is None:
        raise InputError(f"{frame.name or 'frame'}: no depth map, expected one for the point cloud")
    if frame.mask is not None:
        inside = frame.mask > 0.9
    else:
        rows, cols = (np.arange(n) * m // n for n, m in zip(frame.depth.shape, view.foreground.shape))
        inside = view.foreground.cpu().numpy()[np.ix_(rows, cols)]
    points = unproject_depth(frame.depth, frame.camera)[inside & (frame.depth > 0)]
    if len(points) == 0:
        raise InputError(f"{frame.name or 'frame'}: no pixel of the object has a known depth")
    # A mask that is a pixel too wide lets points of the background through, far behind the object.
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    points = points[distance <= 2.5 * np.median(distance)]
    if len(points) > most:
        points = points[np.sort(np.random.default_rng(seed).choice(len(points), most, replace=False))]
    return points
