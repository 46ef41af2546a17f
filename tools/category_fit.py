"""Fit the probabilities of `zsp_lite.category`: that the pose of an object, or its alternative, is
right.

    python -m tools.category_fit outputs/validation

Sets of three to five objects are aligned, with all pairs and with a third. A pose is right within
30 degrees of the frame that most objects agree with. Prints constants of zsp_lite/category.py, and
calibration on categories left out.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
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
from zsp_lite.metrics import rotation_angle
from zsp_lite.pipeline import ZeroShotPose


def collect(
    data: Co3D, category: str, names: list[str], method: ZeroShotPose
) -> Iterator[PairHypotheses]:
    """Solve all pairs of objects of a category."""
    view = lru_cache(None)(
        lambda name, k: method.views([data.load(data.frame(category, name, k))])[0]
    )
    for pair in object_pairs(data, category, names, None, 5):
        reference = view(pair.reference_sequence, pair.reference_frame)
        targets = [view(pair.target_sequence, number) for number in pair.target_frames]
        estimate = replace(method, seed=pair.seed).estimate_from_views(reference, targets)
        yield world_hypotheses(pair.reference_sequence, pair.target_sequence, estimate)


def examples(
    pairs: list[PairHypotheses], labels: dict[str, Float[np.ndarray, "3 3"]]
) -> list[tuple]:
    """Return number of objects, share of pairs, margin, agreeing share; 0, 1 or 2: pose,
    alternative, neither right."""
    rng, rows = np.random.default_rng(0), []
    for some, share in product(
        (some for size in (3, 4, 5) for some in combinations(labels, size)), (1.0, 1 / 3)
    ):
        ends = rng.permutation(list(permutations(some, 2)))[
            : round(share * len(some) * (len(some) - 1))
        ].tolist()
        try:
            objects = synchronise(
                [pair for pair in pairs if [pair.reference, pair.target] in ends]
            ).objects
        except InputError:  # they do not connect all objects
            continue
        frames = np.stack([one.sim3.R @ labels[name] for name, one in objects.items()])
        common = frames[
            (rotation_angle(frames[:, None], frames) < module.SAME_ANGLE).sum(axis=1).argmax()
        ]
        for name, one in objects.items():
            poses = (one.sim3, one.alternative or one.sim3)
            right = [
                rotation_angle(pose.R @ labels[name], common) < module.SAME_ANGLE for pose in poses
            ]
            odds = (
                np.array([other := one.alternative_probability, 1 - one.probability - other])
                / one.probability
            )
            terms = (np.log(odds + 1e-30) - (0, module.NONE)) / (
                -module.MARGIN,
                module.NONE_AGREEING,
            )
            rows.append((len(objects), share, *terms, [*right, True].index(True)))
    return rows


def probabilities(
    terms: Float[np.ndarray, "n 2"], coefficients: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Return the probabilities of pose, alternative and neither: a conditional logit."""
    margin, none, agreeing = coefficients
    odds = np.exp(
        np.stack([0 * terms[:, 0], -margin * terms[:, 0], none + agreeing * terms[:, 1]], axis=1)
    )
    return odds / odds.sum(axis=1, keepdims=True)


def fit(terms: Float[np.ndarray, "n 2"], right: Int[np.ndarray, " n"]) -> Float[np.ndarray, "3"]:
    """Fit the coefficients by maximum likelihood, with a ridge."""
    chosen = np.eye(3, dtype=bool)[right]
    return minimize(
        lambda x: 1e-3 * x @ x - np.log(probabilities(terms, x)[chosen]).mean(), (1.0, -1.0, -1.0)
    ).x


def main(root: str) -> None:
    """Fit to the examples of all categories, and print."""
    data, method, rows = Co3D(root), ZeroShotPose(load_backbone(), solver="verified"), []
    for k, category in enumerate(data.categories()):
        labels = {
            name: one.trans[:3, :3] for name, one in list(read_labels(root, category).items())[:5]
        }
        rows += [
            (k, *row)
            for row in examples(list(collect(data, category, list(labels), method)), labels)
        ]
    terms, right, p = (
        (table := np.array(rows))[:, 3:5],
        table[:, 5].astype(int),
        np.empty(len(table)),
    )
    print("MARGIN, NONE, NONE_AGREEING:", fit(terms, right))
    for mine in (table[:, 0] == k for k in set(table[:, 0])):
        p[mine] = probabilities(terms[mine], fit(terms[~mine], right[~mine]))[:, 0]
    for size, share in np.unique(table[:, 1:3], axis=0):
        some = np.flatnonzero((table[:, 1:3] == (size, share)).all(axis=1))
        quarters = np.array_split(some[np.argsort(p[some])], 4)
        error = 100 * sum(abs((p[one] - (right[one] == 0)).sum()) for one in quarters) / len(some)
        print(f"{size:.0f} objects, {share:.2f} of the pairs: calibration error {error:.1f} points")


if __name__ == "__main__":
    main(*sys.argv[1:])
