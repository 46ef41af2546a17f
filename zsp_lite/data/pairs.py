"""Evaluation pairs (section 5.1 of the paper): sampled, or the published code's evaluation sets.

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
    """Sample `n` different pairs of a category with `n_targets` frames, or all if there are fewer.

    Reference sequences take turns; the target sequence is a random other one. The reference frame
    is random; the target frames are evenly spaced from a random start. The pairs for a smaller `n`
    are the first pairs for a larger one.
    """
    rng = np.random.default_rng([seed, stable_hash(category) >> 1])
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


def labelled_categories(dataset: Co3D) -> list[str]:
    """List the categories with at least two labelled sequences; InputError if there is none."""
    categories = dataset.categories()
    labelled = [
        category for category in categories if len(read_labels(dataset.root, category)) >= 2
    ]
    if not labelled:
        raise InputError(
            f"{dataset.root}: none of {len(categories)} categories has pose labels of two "
            "sequences, expected them in class_labels/CATEGORY/SEQUENCE.json; "
            "`zsp-lite data labels` imports published labels"
        )
    return labelled


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


def pairs_path(root: str | Path, category: str, n: int, n_targets: int) -> Path:
    """Return ROOT/determ_eval/{n}samples_{n_targets}tgt/CATEGORY.pt."""
    return Path(
        root,
        "determ_eval",
        f"{n}samples_{n_targets}tgt",
        f"{plain_name(category, 'category')}.pt",
    )


def shipped_pairs(dataset: Co3D, category: str, n_targets: int, at_least: int = 1) -> list[Pair]:
    """Read the pairs of the folder's first evaluation set with `at_least` pairs, each pair once.

    [] if there is no such set.
    """
    sets = (
        read_published_pairs(path, dataset)
        for path in pair_files(dataset, category, f"*samples_{n_targets}tgt")
    )
    pairs = next((pairs for pairs in sets if len(pairs) >= at_least), [])
    different = [*dict.fromkeys(pairs)]
    if len(different) < len(pairs):
        logger.warning(
            f"category {category}: {len(different)} of {len(pairs)} stored pairs are different"
        )
    return different


def category_pairs(dataset: Co3D, category: str, n: int, n_targets: int) -> list[Pair]:
    """Return the first n pairs of the folder's evaluation set; sampled ones if none is so large."""
    shipped = shipped_pairs(dataset, category, n_targets, at_least=n)
    return shipped[:n] or sample_pairs(dataset, category, n, n_targets)


def pair_files(dataset: Co3D, category: str, folders: str = "*") -> list[Path]:
    """List a category's evaluation sets, ROOT/determ_eval/SET/CATEGORY.pt."""
    return sorted(dataset.root.glob(f"determ_eval/{folders}/{plain_name(category, 'category')}.pt"))


def read_published_pairs(path: str | Path, dataset: Co3D) -> list[Pair]:
    """Read an evaluation set of the published code; InputError if it does not fit the data set."""
    pairs = []
    for number, item in enumerate(read_pair_file(Path(path))):
        frames = dataset.frame_list(item.category)
        # (sequence, position in the list) of the reference and of each target.
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
    """Read an evaluation set without its data set; InputError if it has another structure."""
    content = load_torch(path, "evaluation pairs")
    try:
        # Numbers may be stored as tensors. Anything else becomes text, which is refused.
        plain = msgspec.to_builtins(
            content, enc_hook=lambda value: value.tolist() if torch.is_tensor(value) else str(value)
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
        reference, *targets = [position[frame] for frame in pair.frames]
        items.append(
            _PublishedPair(
                pair.category, pair.reference_sequence, reference, pair.target_sequence, targets
            )
        )
    buffer = io.BytesIO()  # torch.save to a file would store the file's name
    torch.save(msgspec.to_builtins(items), buffer)
    write_atomic(path, buffer.getvalue())
