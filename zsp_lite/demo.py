"""The computation of `zsp-lite demo`: a real photograph posed by a synthetic object, and one pair of each category."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import labelled_categories, sample_pairs, shipped_pairs
from zsp_lite.data.photograph import (
    PHOTOGRAPH_CATEGORY,
    PHOTOGRAPH_FRONT,
    PHOTOGRAPH_TARGET,
    PHOTOGRAPH_UP,
    motorcycle_photograph,
)
from zsp_lite.errors import InputError
from zsp_lite.estimates import SEQUENCE_FRAMES, PairResult, PoseEstimate, label_error
from zsp_lite.features import FeatureExtractor
from zsp_lite.pipeline import ZeroShotPose, solve_pair
from zsp_lite.synthetic.ground_truth import object_poses
from zsp_lite.synthetic.recording import POSES_FILE

N_TARGETS = 5
# Settings of `ZeroShotPose` on the photograph.
PHOTOGRAPH_FOREGROUNDS, PHOTOGRAPH_SOLVERS = ("mask", "saliency"), ("paper", "verified")


def demo_pairs(dataset: Co3D, n_targets: int = N_TARGETS) -> list[Pair]:
    """Select one pair of every category with pose labels, independently of its result.

    This is the first evaluation pair in the data folder, or, for a category without pairs of `n_targets` target views,
    the first of a sample with seed 0.
    """
    pairs = []
    for category in labelled_categories(dataset):
        shipped = shipped_pairs(dataset, category, n_targets)
        pairs.append((shipped or sample_pairs(dataset, category, 1, n_targets, seed=0))[0])
    return pairs


def example_pair(dataset: Co3D) -> Pair:
    """Return a pair of the sample data for a first try.

    Of `data_samples/`, this is a pair of cars that is chosen by its result: a stored pair with five targets on which
    both solvers are within 5 degrees with zsp-tiny. Of other data, it is the first pair of the first category.
    """
    chosen = Pair("car", "peugeot_308", 11, "suv", (18, 22, 3, 8, 13))
    folders = (dataset.root / chosen.category / name for name in (chosen.reference_sequence, chosen.target_sequence))
    return chosen if all(folder.is_dir() for folder in folders) else demo_pairs(dataset)[0]


def run_demo(dataset: Co3D, backbone: FeatureExtractor, solvers: Sequence[str] = ("paper",)) -> Iterator[PairResult]:
    """Estimate the poses of `demo_pairs` with the paper's settings, one at a time, by each solver."""
    method = ZeroShotPose(backbone)
    for pair in demo_pairs(dataset):
        yield run_pair(dataset, pair, method, solvers)


def run_pair(dataset: Co3D, pair: Pair, method: ZeroShotPose, solvers: Sequence[str] | None = None) -> PairResult:
    """Load a pair's frames, estimate its pose, and compare it with the ground truth of the labels.

    Args:
        dataset: Data folder.
        pair: Evaluation pair.
        method: The method.
        solvers: Names of solvers; by default the method's own.

    Raises:
        InputError: A frame or a label of the pair is missing, or the pose cannot be estimated.
    """
    reference, targets = dataset.load_pair(pair)
    estimates = solve_pair(method, reference, targets, solvers)
    labels = read_labels(dataset.root, pair.category)
    for sequence in (pair.reference_sequence, pair.target_sequence):
        if sequence not in labels:
            raise InputError(f"{pair.category}/{sequence}: no pose label, expected one to compare the estimate with")
    errors = {
        solver: label_error(estimate, labels[pair.reference_sequence], reference, labels[pair.target_sequence], targets)
        for solver, estimate in estimates.items()
    }
    annotations = dataset.frames(pair.category, pair.target_sequence)
    chosen = np.linspace(0, len(annotations), SEQUENCE_FRAMES, endpoint=False).astype(int)
    return PairResult(
        pair.category,
        (
            f"sequence {pair.reference_sequence}, frame {pair.reference_frame}",
            f"sequence {pair.target_sequence}, frames {', '.join(map(str, pair.target_frames))}",
        ),
        reference, tuple(targets), estimates, errors, tuple(dataset.load(annotations[i]) for i in np.unique(chosen)),
        pair, backbone=getattr(method.backbone, "name", ""),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class PhotographResult:
    """Pose of the motorcycle of `motorcycle_photograph`, estimated from views of a synthetic one.

    All points and directions are in the frame of the photograph's camera.
    """

    photograph: Frame  # the photograph
    sequence: str  # sequence of the synthetic motorcycle
    foreground: str  # setting of `ZeroShotPose`
    solver: str  # setting of `ZeroShotPose`
    estimate: PoseEstimate  # pose estimate with the photograph as the reference
    axes: Float[np.ndarray, "3 3"]  # columns: front, left and up of the photographed motorcycle, as estimated
    cloud: Float[np.ndarray, "n 3"]  # point cloud of the synthetic motorcycle, aligned with the photographed one
    # position of each point of the cloud, from the rear (0) to the front (1) of the synthetic motorcycle
    along: Float[np.ndarray, " n"]

    @property
    def front_error(self) -> float:
        """Angle in degrees between the estimated front and the front judged by eye, which may be wrong by 10."""
        return _angle(self.axes[:, 0], PHOTOGRAPH_FRONT)

    @property
    def up_error(self) -> float:
        """Angle in degrees between the estimated top and the normal of the floor."""
        return _angle(self.axes[:, 2], PHOTOGRAPH_UP)


def run_photograph(
    dataset: Co3D,
    backbone: FeatureExtractor,
    sequence: str | None = None,
    foregrounds: Sequence[str] = PHOTOGRAPH_FOREGROUNDS,
    solvers: Sequence[str] = PHOTOGRAPH_SOLVERS,
) -> Iterator[PhotographResult]:
    """Estimate how the motorcycle in a real photograph stands, from a synthetic motorcycle whose front is known.

    Args:
        dataset: Data folder. Without a category of synthetic motorcycles there is no result.
        backbone: Computes the features.
        sequence: Sequence of the synthetic motorcycle; by default `PHOTOGRAPH_TARGET`, or the first of other
            data. Both are independent of the results.
        foregrounds: Settings `foreground` of `ZeroShotPose`.
        solvers: Settings `solver` of `ZeroShotPose`.

    Yields:
        One result for each foreground and solver.

    Raises:
        InputError: The category has no such sequence, or a setting is unknown.
    """
    methods = {foreground: ZeroShotPose(backbone, foreground=foreground) for foreground in foregrounds}
    if not (dataset.root / PHOTOGRAPH_CATEGORY / POSES_FILE).is_file():
        return
    poses = object_poses(dataset, PHOTOGRAPH_CATEGORY)
    sequence = sequence or (PHOTOGRAPH_TARGET if PHOTOGRAPH_TARGET in poses else min(poses))
    frames = dataset.frames(PHOTOGRAPH_CATEGORY, sequence)
    targets = [dataset.load(frames[k * len(frames) // N_TARGETS]) for k in range(N_TARGETS)]
    photograph, pose = motorcycle_photograph(), poses[sequence]
    points, _ = dataset.point_cloud(PHOTOGRAPH_CATEGORY, sequence)
    for foreground, method in methods.items():
        reference, *views = method.views([photograph, *targets])
        for solver in solvers:
            estimate = replace(method, solver=solver).estimate_from_views(reference, views)
            camera, to_photograph = estimate.target_camera, estimate.sim3.inverse()
            axes = to_photograph.R @ camera.R @ pose.R
            cloud, along = to_photograph.apply(camera.to_camera(points)), pose.to_box(points)[:, 0]
            yield PhotographResult(photograph, sequence, foreground, solver, estimate, axes, cloud, along)


def _angle(first: np.ndarray, second: np.ndarray | tuple[float, ...]) -> float:
    """Return the angle between two vectors in degrees."""
    second = np.asarray(second)
    cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
