"""The pairs of `zsp-lite demo`: one of each category, with its pose error."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.pairs import category_pairs, labelled_categories
from zsp_lite.features import FeatureExtractor
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.scans.pair_result import PairResult, label_errors

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
    if (dataset.root / "motorcycle/scooter2").is_dir():
        return Pair.from_key("motorcycle/scooter:10/scooter2:2,6,11,16,21")
    return demo_pairs(dataset)[0]


def run_demo(
    dataset: Co3D, backbone: FeatureExtractor, solvers: Sequence[str]
) -> Iterator[PairResult]:
    """Estimate the poses of `demo_pairs` with the paper's settings, one at a time, by each
    solver."""
    for pair in demo_pairs(dataset):
        yield run_pair(dataset, pair, ZeroShotPose(backbone), solvers)


def run_pair(dataset: Co3D, pair: Pair, method: ZeroShotPose, solvers: Sequence[str]) -> PairResult:
    """Estimate the pose of a pair by each solver, and its error if the pair has labels."""
    reference, targets = dataset.load_pair(pair)
    # The solvers share the features.
    view, *target_views = method.views([reference, *targets])
    estimates = {
        solver: replace(method, solver=solver).estimate_from_views(view, target_views)
        for solver in solvers
    }
    sources = (
        f"sequence {pair.reference_sequence}, frame {pair.reference_frame}",
        f"sequence {pair.target_sequence}, frames {', '.join(map(str, pair.target_frames))}",
    )
    result = PairResult(
        pair.category,
        sources,
        reference,
        tuple(targets),
        estimates,
        {},
        backbone=getattr(method.backbone, "name", ""),
    )
    return replace(
        result,
        errors=label_errors(
            result, dataset.root / pair.category, (pair.reference_sequence, pair.target_sequence)
        ),
    )
