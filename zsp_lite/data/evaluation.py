"""Evaluation pairs (section 5.1 of the paper): sampled, and the true poses of given ones."""

import itertools
import logging
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.ground_truth import read_poses
from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.errors import InputError
from zsp_lite.io.files import stable_hash

logger = logging.getLogger(__name__)
_warn_once = cache(logger.warning)


def sample_pairs(dataset: Co3D, category: str, n: int, n_targets: int, seed: int = 0) -> list[Pair]:
    """Sample `n` different pairs of a category with `n_targets` frames, or all if there are fewer.

    Reference sequences take turns; the target sequence is a random other one. The reference frame
    is random; the target frames are evenly spaced from a random start. The pairs for a smaller `n`
    are the first pairs for a larger one.
    """
    rng = np.random.default_rng([seed, stable_hash(category) >> 1])  # 63 bits, as in `Pair.seed`
    numbers = _labelled_frames(dataset, category, n_targets)
    # The number of pairs of each reference sequence that are not sampled yet. Each frame of another
    # sequence is the start of one choice of target frames.
    n_frames = sum(map(len, numbers.values()))
    unsampled = {name: len(frames) * (n_frames - len(frames)) for name, frames in numbers.items()}
    total = sum(unsampled.values())
    if total < n:
        logger.warning(
            f"category {category} has {total} different pairs of {n_targets} targets, not {n}"
        )

    pairs: dict[Pair, None] = {}  # a set that keeps the order
    for reference in itertools.cycle(numbers):
        if len(pairs) == min(n, total):
            return list(pairs)
        before = len(pairs)
        # A pair that is sampled already is drawn again.
        while unsampled[reference] and len(pairs) == before:
            others = [name for name in numbers if name != reference]
            target = others[rng.integers(len(others))]
            frame = numbers[reference][rng.integers(len(numbers[reference]))]
            length = len(numbers[target])
            start = rng.integers(length)
            steps = spread(n_targets, length)
            targets = tuple(numbers[target][(start + step) % length] for step in steps)
            pairs[Pair(category, reference, frame, target, targets)] = None
        unsampled[reference] -= len(pairs) - before


def spread(count: int, length: int) -> list[int]:
    """Return at most `count` evenly spaced positions below `length`, 0 among them."""
    return sorted({k * length // count for k in range(count)})


def _labelled_frames(dataset: Co3D, category: str, least: int) -> dict[str, list[int]]:
    """List the frame numbers of each labelled sequence.

    InputError for fewer than two sequences, or a sequence of fewer than `least` frames.
    """
    frames = dataset.frame_numbers(category)
    labels = sorted(read_labels(dataset.root, category))
    numbers = {name: frames.get(name, []) for name in labels}
    if len(numbers) < 2:
        raise InputError(
            f"category {category} has {len(numbers)} labelled sequences, expected at least 2"
        )
    shortest = min(numbers, key=lambda name: len(numbers[name]))
    count = len(numbers[shortest])
    if count < least:
        raise InputError(
            f"labelled sequence {category}/{shortest} has {count} frames, expected at least {least}"
        )
    return numbers


def true_poses(
    root: str | Path, pairs: Sequence[Pair], views: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 4"]:
    """Compute the labelled pose of each pair, for the target view whose index is in `views`."""
    dataset = Co3D(root)
    labels = cache(partial(read_labels, root))
    return np.stack(
        [
            true_pose(dataset, labels(pair.category), pair, int(view))
            for pair, view in zip(pairs, views)
        ]
    )


def true_pose(
    dataset: Co3D, labels: Mapping[str, PoseLabel], pair: Pair, view: int
) -> Float[np.ndarray, "4 4"]:
    """Compute the labelled pose of a pair: from the reference's camera to that of a target view."""
    ends = []
    for sequence, number in (pair.frames[0], pair.frames[1 + view]):
        annotation = dataset.frame(pair.category, sequence, number)
        ends += [labels[sequence], dataset.camera(annotation)]
    return relative_pose(*ends)


def common_turns(
    out: Path, category: str, first: str, second: str
) -> Float[np.ndarray, "s 3 3"] | None:
    """Return the rotations in the second object's world after which both objects look the same.

    The first of them is the identity. None if the pose of an object is not known.
    """
    try:
        poses = read_poses(out, category)
    # A damaged file costs one figure of the benchmark only.
    except InputError as error:
        _warn_once("%s", f"{error}: without it there is no symmetric_acc30")
        return None
    if not {first, second} <= poses.keys():
        return None
    common = [turn for turn in poses[first].turns if turn in poses[second].turns]
    angles = [[turn] for turn in (0, *common)]
    # A turn about the object's up axis, in the coordinates of the world.
    to_world = poses[second].R
    return to_world @ Rotation.from_euler("z", angles, degrees=True).as_matrix() @ to_world.T
