"""Evaluation pairs: one reference frame of a sequence against N target frames of another in its category.

The paper's section 5.1, "Evaluation setting". Pairs are sampled here or read from upstream's evaluation sets,
torch files whose ids are positions in the category's frame list.
"""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError
from zsp_lite.io.files import plain_name, read_bytes, write_atomic

_FIELDS = ("class", "reference_seq_name", "reference_frame_id", "target_seq_name", "all_target_id")


@dataclass(frozen=True)
class Pair:
    """Frames are given by their `frame_number`."""

    category: str
    reference_sequence: str
    reference_frame: int
    target_sequence: str
    target_frames: tuple[int, ...]

    @property
    def key(self) -> str:
        """Names the pair in results: equal for equal pairs, different for different ones."""
        targets = ",".join(map(str, self.target_frames))
        reference = f"{self.category}/{self.reference_sequence}:{self.reference_frame}"
        return f"{reference}/{self.target_sequence}:{targets}"

    @property
    def seed(self) -> int:
        """What every draw on this pair starts from: a function of the key alone."""
        return _stable_hash(self.key)


def sample_pairs(
    dataset: Co3D, category: str, n: int, n_targets: int, seed: int | np.random.Generator = 0
) -> list[Pair]:
    """Draw `n` pairs with `n_targets` target frames each.

    The reference goes round the category's labelled sequences in sorted order, the target is another of them
    at random; the reference frame is random, the target frames are evenly spaced over the sequence from a
    random start, in that order. An integer seed gives each category its own draws, and its first n pairs
    whatever the n. Raises InputError on fewer than two labelled sequences or a
    sequence of fewer than `n_targets` frames.
    """
    if n < 1 or n_targets < 1:
        raise InputError(f"pairs to sample are {n} with {n_targets} targets each, expected at least 1 and 1")
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
    """The categories that pairs can be made of: CO3D's folders hold more than anyone has labelled.

    Raises InputError where there is none.
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
    """Where a data folder keeps its evaluation set: ROOT/determ_eval/{n}samples_{N}tgt/CATEGORY.pt."""
    folder = Path(root) / "determ_eval" / f"{n}samples_{n_targets}tgt"
    return folder / f"{plain_name(category, 'category')}.pt"


def shipped_pairs(dataset: Co3D, category: str, n_targets: int, at_least: int = 1) -> list[Pair]:
    """The data folder's own pairs with `n_targets` targets, from the first set of so many; [] where it has none.

    Sets lie in ROOT/determ_eval or, as upstream has them, in ROOT/data/determ_eval. Raises InputError as
    `read_upstream_pairs`.
    """
    name = f"determ_eval/*samples_{n_targets}tgt/{plain_name(category, 'category')}.pt"
    for path in [*sorted(dataset.root.glob(name)), *sorted(dataset.root.glob(f"data/{name}"))]:
        pairs = read_upstream_pairs(path, dataset)
        if len(pairs) >= at_least:
            return pairs
    return []


def read_upstream_pairs(path: str | Path, dataset: Co3D) -> list[Pair]:
    """The pairs of one upstream evaluation file, whose ids are positions in `dataset.frame_list(category)`.

    Nothing in the file is executed. Raises InputError on a file that holds more than plain data, has another
    form, or does not fit the data set.
    """
    where = f"evaluation pairs {path}"
    pairs = []
    for number, item in enumerate(check_upstream_pairs(read_bytes(path, "evaluation pairs"), where)):
        category, reference, reference_id, target, target_ids = (item[name] for name in _FIELDS)
        place = f"{where}, pair {number}"
        pairs.append(
            Pair(
                category,
                reference,
                _frame_number(dataset, category, reference, reference_id, place),
                target,
                tuple(_frame_number(dataset, category, target, position, place) for position in target_ids),
            )
        )
    return pairs


def check_upstream_pairs(data: bytes, where: str) -> list[dict]:
    """The content of an upstream evaluation file, as it stands there.

    Nothing in it is executed. Raises InputError, naming `where` it came from, on more than plain data and another form.
    """
    try:
        items = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its unpickler stumbles over
        raise InputError(f"{where} are not a torch file of plain data") from error
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
            raise InputError(f"{where}, pair {number}: all_target_id is {ids!r}, expected positions in the frame list")
    return items


def write_upstream_pairs(path: str | Path, pairs: Sequence[Pair], dataset: Co3D) -> None:
    """Write pairs in the upstream form; InputError where the data set lacks one of their frames."""
    positions = {
        category: {(key.sequence_name, key.frame_number): i for i, key in enumerate(dataset.frame_list(category))}
        for category in dict.fromkeys(pair.category for pair in pairs)
    }
    items = []
    for pair in pairs:
        position = positions[pair.category]
        try:
            reference_id = position[pair.reference_sequence, pair.reference_frame]
            target_ids = [position[pair.target_sequence, number] for number in pair.target_frames]
        except KeyError as error:
            raise InputError(f"pair {pair.key}: the data set has no frame {error.args[0]}") from error
        values = (pair.category, pair.reference_sequence, reference_id, pair.target_sequence, target_ids)
        items.append(dict(zip(_FIELDS, values, strict=True)))
    buffer = io.BytesIO()  # a file name would go into the archive, and equal pairs would differ
    torch.save(items, buffer)
    write_atomic(path, buffer.getvalue())


def _frame_number(dataset: Co3D, category: str, sequence: str, position, where: str) -> int:
    """The number of the frame at a position, which must be one of `sequence`."""
    frames = dataset.frame_list(category)
    if isinstance(position, torch.Tensor) and position.numel() == 1:
        position = position.item()
    if not isinstance(position, int) or not 0 <= position < len(frames):
        raise InputError(f"{where}: frame id is {position!r}, expected 0 to {len(frames) - 1}")
    if frames[position].sequence_name != sequence:
        raise InputError(f"{where}: frame id {position} is of {frames[position].sequence_name}, expected {sequence}")
    return frames[position].frame_number


def _stable_hash(text: str) -> int:
    """63 bits that do not change from run to run, as Python's own hash of a string does."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1
