"""The pairs of `zsp-lite demo`: one of each category, with its pose error."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.pairs import category_pairs, labelled_categories
from zsp_lite.features import FeatureExtractor
from zsp_lite.pair_result import PairResult, label_errors
from zsp_lite.pipeline import ZeroShotPose, solve_pair

N_TARGETS = 5  # target views of each pair, as in the paper's main results


def demo_pairs(dataset: Co3D) -> list[Pair]:
    """Select the first evaluation pair, stored or sampled, of every labelled category: no result is
    looked at."""
    return [
        category_pairs(dataset, category, 1, N_TARGETS)[0]
        for category in labelled_categories(dataset)
    ]


def example_pair(dataset: Co3D) -> Pair:
    """Return a pair for a first try: a stored pair of scooters in `data_samples/`, else the first
    of all.

    The pair of scooters is chosen by its result: a turn of 41 degrees, and both solvers are less
    than 10 off.
    """
    scooters = Pair("motorcycle", "scooter", 10, "scooter2", (2, 6, 11, 16, 21))
    for sequence in (scooters.reference_sequence, scooters.target_sequence):
        if not (dataset.root / scooters.category / sequence).is_dir():
            return demo_pairs(dataset)[0]
    return scooters


def run_demo(
    dataset: Co3D, backbone: FeatureExtractor, solvers: Sequence[str] = ("paper",)
) -> Iterator[PairResult]:
    """Estimate the poses of `demo_pairs` with the paper's settings, one at a time, by each
    solver."""
    method = ZeroShotPose(backbone)
    for pair in demo_pairs(dataset):
        yield run_pair(dataset, pair, method, solvers)


def run_pair(
    dataset: Co3D, pair: Pair, method: ZeroShotPose, solvers: Sequence[str] | None = None
) -> PairResult:
    """Estimate the pose of a pair by each solver, and its error if the pair has labels.

    Without `solvers`, the method's own solver is used.
    """
    reference, targets = dataset.load_pair(pair)
    estimates = solve_pair(method, reference, targets, solvers)
    sources = (
        f"sequence {pair.reference_sequence}, frame {pair.reference_frame}",
        f"sequence {pair.target_sequence}, frames {', '.join(map(str, pair.target_frames))}",
    )
    name = getattr(method.backbone, "name", "")
    result = PairResult(
        pair.category, sources, reference, tuple(targets), estimates, {}, pair, backbone=name
    )
    sequences = (pair.reference_sequence, pair.target_sequence)
    errors = label_errors(result, dataset.root / pair.category, sequences)
    return replace(result, errors=errors)
