"""Evaluation pairs (section 5.1 of the paper): the published code's evaluation sets.

These sets are torch files that refer to frames by their positions in the category's frame list.
"""

import logging
import pkgutil
from pathlib import Path
from typing import Annotated

import msgspec
import torch

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError
from zsp_lite.io.files import load_torch, plain_name

logger = logging.getLogger(__name__)


class _PublishedPair(msgspec.Struct):
    category: str = msgspec.field(name="class")
    reference_seq_name: str
    reference_frame_id: int
    target_seq_name: str
    all_target_id: Annotated[list[int], msgspec.Meta(min_length=1)]


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
    # A module above this one, imported when it is used.
    sample = pkgutil.resolve_name("zsp_lite.data.evaluation:sample_pairs")
    return shipped[:n] or sample(dataset, category, n, n_targets)


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
