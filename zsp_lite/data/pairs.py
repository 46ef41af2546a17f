"""Evaluation pairs: a reference frame of one sequence and N target frames of another sequence of the category.

See the paper's section 5.1, "Evaluation setting". Pairs are sampled, or read from the evaluation sets of the published
code: torch files that refer to frames by their positions in the category's frame list.
"""

import hashlib
import io
import re
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError, check_integer
from zsp_lite.io.files import plain_name, read_bytes, write_atomic
from zsp_lite.io.tensors import load_torch

_FIELDS = ("class", "reference_seq_name", "reference_frame_id", "target_seq_name", "all_target_id")
_MOST_PAIRS = 100_000  # of a category


@dataclass(frozen=True)
class Pair:
    """A reference frame of one sequence and the target frames, by their numbers, of another sequence of a category."""

    category: str
    reference_sequence: str
    reference_frame: int
    target_sequence: str
    target_frames: tuple[int, ...]

    @property
    def key(self) -> str:
        """Unique identifier of the pair, used in results."""
        targets = ",".join(map(str, self.target_frames))
        reference = f"{self.category}/{self.reference_sequence}:{self.reference_frame}"
        return f"{reference}/{self.target_sequence}:{targets}"

    @property
    def seed(self) -> int:
        """Seed of all random draws for this pair; it depends on the key only."""
        return _stable_hash(self.key)


def sample_pairs(
    dataset: Co3D, category: str, n: int, n_targets: int, seed: int | np.random.Generator = 0
) -> list[Pair]:
    """Sample evaluation pairs of a category.

    Reference sequences cycle through the labelled sequences in sorted order; the target sequence is a random other
    one. The reference frame is random; the target frames are evenly spaced over the sequence, from a random start.

    Args:
        dataset: The data set, with labels.
        category: Name of the category.
        n: Number of pairs.
        n_targets: Number of target frames per pair.
        seed: Seed or generator. With an integer, the draws depend on the category and the seed only, and the pairs of
            a smaller `n` are the first ones of a larger `n`.

    Raises:
        InputError: Fewer than two sequences are labelled, or a sequence has fewer than `n_targets` frames.
    """
    check_integer("number of pairs", n, 1, _MOST_PAIRS)
    check_integer("number of targets", n_targets, 1)
    if not isinstance(seed, np.random.Generator):
        seed = np.random.default_rng([seed, _stable_hash(category)])
    numbers: dict[str, list[int]] = {}
    for key in dataset.frame_list(category):
        numbers.setdefault(key.sequence_name, []).append(key.frame_number)
    sequences = sorted(read_labels(dataset.root, category))
    if len(sequences) < 2:
        raise InputError(f"category {category} has {len(sequences)} labelled sequences, expected at least 2")
    for name in sequences:
        count = len(numbers.get(name, ()))
        if count < n_targets:
            raise InputError(f"labelled sequence {category}/{name} has {count} frames, expected at least {n_targets}")
    numbers = {name: sorted(numbers[name]) for name in sequences}

    pairs = []
    for index in range(n):
        reference = sequences[index % len(sequences)]
        others = [name for name in sequences if name != reference]
        target = others[seed.integers(len(others))]
        frame = numbers[reference][seed.integers(len(numbers[reference]))]
        length = len(numbers[target])
        positions = (seed.integers(length) + np.arange(n_targets) * length // n_targets) % length
        pairs.append(Pair(category, reference, frame, target, tuple(numbers[target][p] for p in positions)))
    return pairs


def labelled_categories(dataset: Co3D) -> list[str]:
    """List the categories with at least two labelled sequences.

    Raises:
        InputError: There is none.
    """
    categories = dataset.categories()
    if not categories:
        raise InputError(f"{dataset.root}: no category found, expected folders with frame_annotations.jgz")
    if found := [category for category in categories if len(read_labels(dataset.root, category)) >= 2]:
        return found
    raise InputError(
        f"{dataset.root}: none of {len(categories)} categories has pose labels of two sequences, expected them in "
        "class_labels/CATEGORY/SEQUENCE.json (see zsp-lite data labels)"
    )


def upstream_pairs_path(root: str | Path, category: str, n: int, n_targets: int) -> Path:
    """Return the path of an evaluation set of `n` pairs: ROOT/determ_eval/{n}samples_{n_targets}tgt/CATEGORY.pt."""
    folder = Path(root) / "determ_eval" / f"{n}samples_{n_targets}tgt"
    return folder / f"{plain_name(category, 'category')}.pt"


def shipped_pairs(dataset: Co3D, category: str, n_targets: int, at_least: int = 1) -> list[Pair]:
    """Read an evaluation set that is part of the data folder.

    Args:
        dataset: The data set; its sets are in ROOT/determ_eval or, as in the published code, ROOT/data/determ_eval.
        category: Name of the category.
        n_targets: Number of target frames per pair.
        at_least: Smallest number of pairs of the set.

    Returns:
        The pairs of the first set that is large enough; [] if there is none.

    Raises:
        InputError: A set cannot be read (see `read_upstream_pairs`).
    """
    name = f"determ_eval/*samples_{n_targets}tgt/{plain_name(category, 'category')}.pt"
    for path in [*sorted(dataset.root.glob(name)), *sorted(dataset.root.glob(f"data/{name}"))]:
        pairs = read_upstream_pairs(path, dataset)
        if len(pairs) >= at_least:
            return pairs
    return []


def read_upstream_pairs(path: str | Path, dataset: Co3D) -> list[Pair]:
    """Read an evaluation set of the published code, whose ids are positions in `dataset.frame_list(category)`.

    The file is loaded with `weights_only=True`, so code in it is not executed.

    Raises:
        InputError: The file holds more than plain data, has another structure, compares a sequence with itself, has
            another number of targets than its folder says, or does not fit the data set.
    """
    where = f"evaluation pairs {path}"
    named = re.fullmatch(r".*_(\d{1,6})tgt", Path(path).absolute().parent.name)
    pairs = []
    for number, item in enumerate(check_upstream_pairs(read_bytes(path, "evaluation pairs"), where)):
        category, reference, reference_id, target, target_ids = (item[name] for name in _FIELDS)
        place = f"{where}, pair {number}"
        if reference == target:
            raise InputError(f"{place}: {reference!r} is compared with itself, expected two sequences")
        if named and len(target_ids) != int(named[1]):
            raise InputError(f"{place}: {len(target_ids)} targets, expected {named[1]} as in the name of its folder")
        reference_frame = _frame_number(dataset, category, reference, reference_id, place)
        target_frames = tuple(_frame_number(dataset, category, target, position, place) for position in target_ids)
        pairs.append(Pair(category, reference, reference_frame, target, target_frames))
    return pairs


def check_upstream_pairs(data: bytes, where: str) -> list[dict]:
    """Return the dicts of the torch file `where` of the published code; InputError if its structure is another one.

    Code in it is not executed. `all_target_id` is a list or tuple.
    """
    items = load_torch(data, where)
    if not isinstance(items, list):
        raise InputError(f"{where} hold a {type(items).__name__}, expected a list of dicts")
    for number, item in enumerate(items):
        missing = [name for name in _FIELDS if not isinstance(item, dict) or name not in item]
        if missing:
            raise InputError(
                f"{where}, pair {number}: missing {', '.join(missing)}, expected a dict of {', '.join(_FIELDS)}"
            )
        ids = item["all_target_id"]
        item["all_target_id"] = ids = ids.tolist() if isinstance(ids, torch.Tensor) else ids
        if not isinstance(ids, (list, tuple)) or not ids:
            raise InputError(
                f"{where}, pair {number}: all_target_id is {reprlib.repr(ids)}, expected positions in the frame list"
            )
    return items


def write_upstream_pairs(path: str | Path, pairs: Sequence[Pair], dataset: Co3D) -> None:
    """Write pairs as an evaluation set in the format of the published code."""
    positions = {
        category: {(key.sequence_name, key.frame_number): i for i, key in enumerate(dataset.frame_list(category))}
        for category in dict.fromkeys(pair.category for pair in pairs)
    }
    items = []
    for pair in pairs:
        position = positions[pair.category]
        reference_id = position[pair.reference_sequence, pair.reference_frame]
        target_ids = [position[pair.target_sequence, number] for number in pair.target_frames]
        values = (pair.category, pair.reference_sequence, reference_id, pair.target_sequence, target_ids)
        items.append(dict(zip(_FIELDS, values, strict=True)))
    buffer = io.BytesIO()  # torch.save to a file would store the file's name
    torch.save(items, buffer)
    write_atomic(path, buffer.getvalue())


def _frame_number(dataset: Co3D, category: str, sequence: str, position, where: str) -> int:
    """Return the number of the frame at a position of the frame list; InputError if it is not in the sequence."""
    frames = dataset.frame_list(category)
    if isinstance(position, torch.Tensor) and position.numel() == 1:
        position = position.item()
    if not isinstance(position, int) or isinstance(position, bool) or not 0 <= position < len(frames):
        raise InputError(f"{where}: frame id is {reprlib.repr(position)}, expected 0 to {len(frames) - 1}")
    if frames[position].sequence_name != sequence:
        raise InputError(f"{where}: frame id {position} is of {frames[position].sequence_name}, expected {sequence}")
    return frames[position].frame_number


def _stable_hash(text: str) -> int:
    """Hash text to 63 bits; unlike Python's `hash`, the result is the same in every process."""
    return int.from_bytes(hashlib.sha256(text.encode(errors="surrogateescape")).digest()[:8], "big") >> 1
