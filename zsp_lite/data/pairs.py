"""Evaluation pairs (section 5.1 of the paper): sampled, or read from the evaluation sets of the
published code.

These sets are torch files that refer to frames by their positions in the category's frame list.
"""

import io
import itertools
import logging
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import torch
from jaxtyping import Float, Int

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.errors import InputError
from zsp_lite.io.files import load_torch, plain_name, stable_hash, write_atomic

logger = logging.getLogger(__name__)


class _PublishedPair(msgspec.Struct):
    category: str = msgspec.field(name="class")
    reference_seq_name: str
    reference_frame_id: int
    target_seq_name: str
    all_target_id: Annotated[list[int], msgspec.Meta(min_length=1)]


def sample_pairs(dataset: Co3D, category: str, n: int, n_targets: int, seed: int = 0) -> list[Pair]:
    """Sample `n` different evaluation pairs of a category, or all if there are fewer, each with
    `n_targets` frames.

    Reference sequences take turns; the target sequence is a random other one. The reference frame
    is random; the target frames are evenly spaced from a random start. The pairs of a smaller `n`
    are the first ones of a larger.
    """
    rng = np.random.default_rng([seed, stable_hash(category) >> 1])
    sequences = sorted(read_labels(dataset.root, category))
    frames = dataset.frame_numbers(category)
    numbers = {name: frames.get(name, []) for name in sequences}
    if len(sequences) < 2:
        raise InputError(
            f"category {category} has {len(sequences)} labelled sequences, expected at least 2"
        )
    shortest = min(sequences, key=lambda name: len(numbers[name]))
    if (found := len(numbers[shortest])) < n_targets:
        raise InputError(
            f"labelled sequence {category}/{shortest} has {found} frames, expected at least "
            f"{n_targets}"
        )

    # All frames; each is the start of one choice of target frames.
    every = sum(map(len, numbers.values()))
    # Pairs of each reference sequence that are not sampled yet.
    left = {name: len(own) * (every - len(own)) for name, own in numbers.items()}
    if (total := sum(left.values())) < n:
        logger.warning(
            "category %s has %d different pairs of %d targets, not %d",
            category,
            total,
            n_targets,
            n,
        )
    pairs: dict[Pair, None] = {}
    for reference in itertools.cycle(sequences):
        if len(pairs) == min(n, total):
            return list(pairs)
        found = len(pairs)
        while left[reference] and len(pairs) == found:  # drawn again if it is there already
            others = [name for name in sequences if name != reference]
            target = others[rng.integers(len(others))]
            frame = numbers[reference][rng.integers(len(numbers[reference]))]
            length = len(numbers[target])
            positions = (rng.integers(length) + np.arange(n_targets) * length // n_targets) % length
            targets = tuple(numbers[target][position] for position in positions)
            pairs[Pair(category, reference, frame, target, targets)] = None
        left[reference] -= len(pairs) - found


def labelled_categories(dataset: Co3D) -> list[str]:
    """List the categories with at least two labelled sequences; InputError if there is none."""
    categories = dataset.categories()
    if found := [
        category for category in categories if len(read_labels(dataset.root, category)) >= 2
    ]:
        return found
    raise InputError(
        f"{dataset.root}: none of {len(categories)} categories has pose labels of two "
        "sequences, expected them in "
        "class_labels/CATEGORY/SEQUENCE.json; `zsp-lite data labels` imports published labels"
    )


def true_poses(
    root: str | Path, pairs: Sequence[Pair], views: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "n 4 4"]:
    """Compute the labelled pose of each pair, from its reference's camera to that of the target
    view with an index."""
    dataset, labels = Co3D(root), cache(partial(read_labels, root))
    return np.stack(
        [
            true_pose(dataset, labels(pair.category), pair, int(view))
            for pair, view in zip(pairs, views, strict=True)
        ]
    )


def true_pose(
    dataset: Co3D, labels: Mapping[str, PoseLabel], pair: Pair, view: int
) -> Float[np.ndarray, "4 4"]:
    """Compute the labelled pose of a pair from its reference's camera to that of a target view, by
    its index."""
    first, second = pair.reference_sequence, pair.target_sequence
    reference = dataset.camera(dataset.frame(pair.category, first, pair.reference_frame))
    target = dataset.camera(dataset.frame(pair.category, second, pair.target_frames[view]))
    return relative_pose(labels[first], reference, labels[second], target)


def pairs_path(root: str | Path, category: str, n: int, n_targets: int) -> Path:
    """Return the path of an evaluation set of `n` pairs:

    ROOT/determ_eval/{n}samples_{n_targets}tgt/CATEGORY.pt.
    """
    return (
        Path(root)
        / "determ_eval"
        / f"{n}samples_{n_targets}tgt"
        / f"{plain_name(category, 'category')}.pt"
    )


def shipped_pairs(dataset: Co3D, category: str, n_targets: int, at_least: int = 1) -> list[Pair]:
    """Read the first evaluation set of the folder with at least so many pairs, without repetitions;
    [] without one."""
    sets = (
        read_published_pairs(path, dataset)
        for path in pair_files(dataset, category, f"*samples_{n_targets}tgt")
    )
    pairs = next((pairs for pairs in sets if len(pairs) >= at_least), [])
    different = [*dict.fromkeys(pairs)]
    if len(different) < len(pairs):
        logger.warning(
            "category %s: %d of %d stored pairs are different", category, len(different), len(pairs)
        )
    return different


def category_pairs(dataset: Co3D, category: str, n: int, n_targets: int) -> list[Pair]:
    """Return n pairs: the first of the folder's own evaluation set if it has so many, else sampled
    ones."""
    shipped = shipped_pairs(dataset, category, n_targets, at_least=n)
    return shipped[:n] or sample_pairs(dataset, category, n, n_targets)


def pair_files(dataset: Co3D, category: str, folders: str = "*") -> list[Path]:
    """List a category's evaluation sets, ROOT/determ_eval/SET/CATEGORY.pt."""
    return sorted(dataset.root.glob(f"determ_eval/{folders}/{plain_name(category, 'category')}.pt"))


def read_published_pairs(path: str | Path, dataset: Co3D) -> list[Pair]:
    """Read an evaluation set of the published code; InputError if it is damaged or does not fit the
    data set."""
    pairs = []
    for number, item in enumerate(read_pair_file(Path(path))):
        frames = dataset.frame_list(item.category)
        chosen = [(item.reference_seq_name, item.reference_frame_id)]
        chosen += [(item.target_seq_name, position) for position in item.all_target_id]
        for sequence, position in chosen:
            if not 0 <= position < len(frames) or frames[position].sequence_name != sequence:
                raise InputError(
                    f"evaluation pairs {path}, pair {number}: frame id {position} is not of "
                    f"{sequence}, expected a position in the list of {len(frames)} frames"
                )
        reference, *targets = [frames[position].frame_number for _, position in chosen]
        pairs.append(
            Pair(
                item.category,
                item.reference_seq_name,
                reference,
                item.target_seq_name,
                tuple(targets),
            )
        )
    return pairs


def read_pair_file(path: Path) -> list[_PublishedPair]:
    """Read an evaluation set without its data set; InputError if it is damaged or has another
    structure."""
    content = load_torch(path, "evaluation pairs")
    try:
        plain = msgspec.to_builtins(
            content, enc_hook=lambda one: one.tolist() if torch.is_tensor(one) else str(one)
        )
        return msgspec.convert(plain, list[_PublishedPair])
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"evaluation pairs {path}: {error}") from error


def write_published_pairs(path: str | Path, pairs: Sequence[Pair], dataset: Co3D) -> None:
    """Write pairs of one category as an evaluation set in the format of the published code."""
    keys = dataset.frame_list(pairs[0].category)
    position = {(key.sequence_name, key.frame_number): i for i, key in enumerate(keys)}
    items = []
    for pair in pairs:
        reference = position[pair.reference_sequence, pair.reference_frame]
        targets = [position[pair.target_sequence, number] for number in pair.target_frames]
        item = _PublishedPair(
            pair.category, pair.reference_sequence, reference, pair.target_sequence, targets
        )
        items.append(msgspec.to_builtins(item))
    buffer = io.BytesIO()  # torch.save to a file would store the file's name
    torch.save(items, buffer)
    write_atomic(path, buffer.getvalue())
