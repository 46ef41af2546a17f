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
from zsp_lite.estimates import PairResult, PoseEstimate, label_error
from zsp_lite.features import FeatureExtractor
from zsp_lite.pipeline import ZeroShotPose, solve_pair
from zsp_lite.synthetic.ground_truth import object_poses
from zsp_lite.synthetic.recording import POSES_FILE

N_TARGETS = 5


def demo_pairs(dataset: Co3D, n_targets: int = N_TARGETS) -> list[Pair]:
    """Select, independently of results, the first evaluation pair of every category with pose labels.

    For a category without pairs of `n_targets` target views, it is the first of a sample with seed 0.
    """
    pairs = []
    for category in labelled_categories(dataset):
        shipped = shipped_pairs(dataset, category, n_targets)
        pairs.append((shipped or sample_pairs(dataset, category, 1, n_targets, seed=0))[0])
    return pairs


def example_pair(dataset: Co3D) -> Pair:
    """Return a pair for a first try: a stored pair of cars in `data_samples/`, else the first of the first category.

    The pair of cars is chosen by its result: both solvers are within 5 degrees with zsp-tiny.
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
    """Estimate the pose of a pair by each solver, by default the method's own, and its error by the pose labels."""
    reference, targets = dataset.load_pair(pair)
    estimates = solve_pair(method, reference, targets, solvers)
    labels, sequences = read_labels(dataset.root, pair.category), (pair.reference_sequence, pair.target_sequence)
    if missing := [name for name in sequences if name not in labels]:
        raise InputError(f"{pair.category}/{missing[0]}: no pose label, expected one to compare the estimate with")
    first, second = (labels[name] for name in sequences)
    errors = {name: label_error(one, first, reference, second, targets) for name, one in estimates.items()}
    sources = (
        f"sequence {pair.reference_sequence}, frame {pair.reference_frame}",
        f"sequence {pair.target_sequence}, frames {', '.join(map(str, pair.target_frames))}",
    )
    name = getattr(method.backbone, "name", "")
    return PairResult(pair.category, sources, reference, tuple(targets), estimates, errors, pair, backbone=name)


@dataclass(frozen=True, eq=False)
class PhotographResult:
    """Pose of the motorcycle of `motorcycle_photograph`, estimated from views of a synthetic one.

    All points and directions are in the frame of the photograph's camera.
    """

    photograph: Frame  # the photograph
    sequence: str  # sequence of the synthetic motorcycle
    foreground: str  # setting of `ZeroShotPose`
    solver: str  # setting of `ZeroShotPose`
    estimate: PoseEstimate  # the photograph is the reference
    axes: Float[np.ndarray, "3 3"]  # columns: front, left and up of the photographed motorcycle, as estimated
    cloud: Float[np.ndarray, "n 3"]  # point cloud of the synthetic motorcycle, aligned with the photographed one
    along: Float[np.ndarray, " n"]  # position of each point of the cloud, from the rear (0) to the front (1)

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
    foregrounds: Sequence[str] = ("mask", "saliency"),
    solvers: Sequence[str] = ("paper", "verified"),
) -> Iterator[PhotographResult]:
    """Estimate how the motorcycle in a real photograph stands, from a synthetic motorcycle whose front is known.

    There is one result for each of the settings `foreground` and `solver` of `ZeroShotPose`, and none without a
    category of synthetic motorcycles. By default the sequence is `PHOTOGRAPH_TARGET`, or the first of other data; both
    are independent of the results.
    """
    if not (dataset.root / PHOTOGRAPH_CATEGORY / POSES_FILE).is_file():
        return
    poses = object_poses(dataset, PHOTOGRAPH_CATEGORY)
    sequence = sequence or (PHOTOGRAPH_TARGET if PHOTOGRAPH_TARGET in poses else min(poses))
    frames = dataset.frames(PHOTOGRAPH_CATEGORY, sequence)
    targets = [dataset.load(frames[k * len(frames) // N_TARGETS]) for k in range(N_TARGETS)]
    photograph, pose = motorcycle_photograph(), poses[sequence]
    points, _ = dataset.point_cloud(PHOTOGRAPH_CATEGORY, sequence)
    for foreground in foregrounds:
        method = ZeroShotPose(backbone, foreground=foreground)
        reference, *views = method.views([photograph, *targets])
        for solver in solvers:
            estimate = replace(method, solver=solver).estimate_from_views(reference, views)
            camera, to_photograph = estimate.target_camera, estimate.sim3.inverse()
            axes = to_photograph.R @ camera.R @ pose.R
            cloud, along = to_photograph.apply(camera.to_camera(points)), pose.to_box(points)[:, 0]
            yield PhotographResult(photograph, sequence, foreground, solver, estimate, axes, cloud, along)


def _angle(first: np.ndarray, second: np.ndarray | tuple[float, ...]) -> float:
    """Return the angle between two vectors in degrees."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))
