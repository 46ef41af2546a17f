"""The pairs of `zsp-lite demo`: one of each category."""

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.pairs import category_pairs, labelled_categories

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
