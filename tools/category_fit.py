"""Fit the probabilities that `zsp_lite.category` gives to an object's pose and its alternative.

    python -m tools.category_fit outputs/validation

Sets of three to five objects are aligned, once with all pairs and once with a third of them. A pose
is right within 30 degrees of the frame that most objects agree with. The tool prints constants of
zsp_lite/category.py, and how well they are calibrated on categories left out of the fit.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import combinations, permutations, product

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize

from zsp_lite import category as module
from zsp_lite.backbones.load import load_backbone
from zsp_lite.category import PairHypotheses, object_pairs, synchronise, world_hypotheses
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError
from zsp_lite.metrics import SAME_ANGLE, rotation_angle
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.views import View


def collect(
    data: Co3D, category: str, names: list[str], method: ZeroShotPose
) -> Iterator[PairHypotheses]:
    """Solve all pairs of objects of a category."""

    @cache
    def view(name: str, number: int) -> View:
        return method.views([data.load(data.frame(category, name, number))])[0]

    # All pairs of the objects, none left out.
    for pair in object_pairs(data, category, names, per_object=None, targets=5):
        reference = view(pair.reference_sequence, pair.reference_frame)
        targets = [view(pair.target_sequence, number) for number in pair.target_frames]
        estimate = replace(method, seed=pair.seed).estimate_from_views(reference, targets)
        yield world_hypotheses(pair.reference_sequence, pair.target_sequence, estimate)


def examples(
    pairs: list[PairHypotheses], labels: dict[str, Float[np.ndarray, "3 3"]]
) -> list[tuple]:
    """Align many sets of objects.

    Returns:
        For each object of each set: number of objects, share of the pairs that are used, margin,
        agreeing share, and 0, 1 or 2 if its pose, its alternative or neither is right.
    """
    rng = np.random.default_rng(0)
    rows = []
    sets = [names for size in (3, 4, 5) for names in combinations(labels, size)]
    for names, share in product(sets, (1.0, 1 / 3)):
        ends = rng.permutation(list(permutations(names, 2)))
        ends = ends[: round(share * len(ends))].tolist()
        solved = [pair for pair in pairs if [pair.reference, pair.target] in ends]
        try:
            objects = synchronise(solved).objects
        except InputError:  # The chosen pairs do not connect all objects.
            continue

        # Rotations from the frame of the labels to the frame of the alignment, by each object. They
        # should be equal; the one that most objects agree with counts as true.
        frames = np.stack([pose.sim3.R @ labels[name] for name, pose in objects.items()])
        agreeing = (rotation_angle(frames[:, None], frames) < SAME_ANGLE).sum(axis=1)
        common = frames[agreeing.argmax()]
        for name, pose in objects.items():
            other = pose.alternative or pose.sim3
            turns = rotation_angle(np.stack([pose.sim3.R, other.R]) @ labels[name], common)
            right = [*(turns < SAME_ANGLE), True].index(True)  # of pose, alternative, neither
            # The terms of the logit are computed back from the probabilities that it gave with the
            # present constants.
            other_probability = pose.alternative_probability
            neither = 1 - pose.probability - other_probability
            odds = np.array([other_probability, neither]) / pose.probability
            margin, none = np.log(odds + 1e-30)
            terms = (margin / -module.MARGIN, (none - module.NONE) / module.NONE_AGREEING)
            rows.append((len(objects), share, *terms, right))
    return rows


def probabilities(
    terms: Float[np.ndarray, "n 2"], coefficients: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Return the probabilities of pose, alternative and neither, by a conditional logit.

    `terms` are margin and agreeing share. The score of the pose is 0.
    """
    margin, none, agreeing = coefficients
    scores = [0 * terms[:, 0], -margin * terms[:, 0], none + agreeing * terms[:, 1]]
    odds = np.exp(np.stack(scores, axis=1))
    return odds / odds.sum(axis=1, keepdims=True)


def fit(terms: Float[np.ndarray, "n 2"], right: Int[np.ndarray, " n"]) -> Float[np.ndarray, "3"]:
    """Fit the coefficients by maximum likelihood, with a ridge that keeps them finite."""
    chosen = np.eye(3, dtype=bool)[right]  # (n, 3): the right one of the three in each row

    def loss(x: np.ndarray) -> float:
        return 1e-3 * x @ x - np.log(probabilities(terms, x)[chosen]).mean()

    return minimize(loss, (1.0, -1.0, -1.0)).x


def main(root: str) -> None:
    """Fit to the examples of all categories, and print."""
    data = Co3D(root)
    method = ZeroShotPose(load_backbone(), solver="verified")
    rows = []
    for k, category in enumerate(data.categories()):
        # The rotations of the first five labels: sets have up to five objects.
        stored = list(read_labels(root, category).items())[:5]
        labels = {name: label.trans[:3, :3] for name, label in stored}
        pairs = list(collect(data, category, list(labels), method))
        rows += [(k, *row) for row in examples(pairs, labels)]
    table = np.array(rows)  # category, and the columns of `examples`
    terms = table[:, 3:5]
    right = table[:, 5].astype(int)
    print("MARGIN, NONE, NONE_AGREEING:", fit(terms, right))

    # The probability of each pose by a fit that has not seen its category.
    p = np.empty(len(table))
    for k in set(table[:, 0]):
        held_out = table[:, 0] == k
        coefficients = fit(terms[~held_out], right[~held_out])
        p[held_out] = probabilities(terms[held_out], coefficients)[:, 0]

    # The calibration error, in four bins of equal count, for each size of the sets and share of
    # their pairs.
    for size, share in np.unique(table[:, 1:3], axis=0):
        members = np.flatnonzero((table[:, 1:3] == (size, share)).all(axis=1))
        quarters = np.array_split(members[np.argsort(p[members])], 4)
        errors = [abs((p[part] - (right[part] == 0)).sum()) for part in quarters]
        error = 100 * sum(errors) / len(members)
        print(f"{size:.0f} objects, {share:.2f} of the pairs: calibration error {error:.1f} points")


if __name__ == "__main__":
    main(*sys.argv[1:])
