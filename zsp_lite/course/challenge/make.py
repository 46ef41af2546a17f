"""Make a challenge: a folder to give to students, and one to keep."""

import hashlib
import logging
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import msgspec

from zsp_lite.course.synthetic.export import export_categories
from zsp_lite.data.annotations import FRAMES_FILE, SEQUENCES_FILE, SequenceAnnotation
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.exchange import write_questions
from zsp_lite.data.pairs import category_pairs
from zsp_lite.data.writing import compress
from zsp_lite.errors import InputError
from zsp_lite.io.files import write_atomic

logger = logging.getLogger(__name__)

QUESTIONS_FILE = "pairs.csv"
_TARGETS = 5  # target views of a pair
_FEW = 100  # with fewer pairs, a warning says that they tell few teams apart
_SHORTEST = 8  # characters of a secret; shorter ones are soon guessed
# Of all files that are given, the first second of 2000: times of rendering tell nothing then.
_TIME = 946_684_800
_RULES = Path(__file__).with_name("rules.md")
_STARTER = Path(__file__).with_name("starter.py")


def make_challenge(
    secret: str,
    categories: Sequence[str],
    out: str | Path,
    sequences: int,
    frames: int,
    pairs: int,
) -> None:
    """Render objects from a secret, into OUT/give without labels and into OUT/keep with them.

    Args:
        secret: Any text of at least eight characters; who knows it can render the objects.
        categories: Names of the categories.
        out: New folder.
        sequences: Number of objects of each category.
        frames: Number of frames of each object.
        pairs: Number of pairs, in equal parts of each category, rounded up.

    Raises:
        InputError: For a short secret, an unknown category, or a folder that has other files.
    """
    if len(secret) < _SHORTEST:
        raise InputError(
            f"the secret has {len(secret)} characters, expected at least {_SHORTEST}: it could be "
            "guessed"
        )
    out = Path(out)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"folder {out} is not empty, expected a new one")
    if pairs < _FEW:
        logger.warning("%d pairs tell few teams apart, expected at least %d", pairs, _FEW)

    # A seed of seven bytes. Slow on purpose: a guess costs a tenth of a second, so that no
    # dictionary can be tried.
    salt = b"zsp-lite challenge"
    key = hashlib.scrypt(secret.encode(), salt=salt, n=1 << 15, r=8, p=1, maxmem=1 << 26, dklen=7)
    kept = out / "keep" / "data"
    export_categories(categories, kept, sequences, frames, int.from_bytes(key), plain_names=True)

    given = out / "give"
    dataset = Co3D(kept)
    count = -(-pairs // len(categories))  # rounded up
    by_category = [category_pairs(dataset, name, count, _TARGETS) for name in categories]
    # In turn, so that a hand-in that is cut off by time has answered as many of each.
    asked = [pair for pairs_in_turn in zip(*by_category) for pair in pairs_in_turn]
    copy_for_pairs(kept, asked, given / "data")
    for folder in (given, kept.parent):
        write_questions(folder / QUESTIONS_FILE, dataset, asked)
    shutil.copyfile(_RULES, given / "rules.md")
    shutil.copyfile(_STARTER, given / "starter.py")
    for path in [*given.rglob("*"), given]:
        os.utime(path, (_TIME, _TIME))


def copy_for_pairs(data: Path, pairs: Sequence[Pair], out: Path) -> None:
    """Copy the frames of pairs from a data folder, with their annotations, and nothing else.

    Sequences keep their names alone: a point cloud shows more of an object than any pair does.
    """
    dataset = Co3D(data)
    for category in dataset.categories():
        used = {frame for pair in pairs if pair.category == category for frame in pair.frames}
        frames = [dataset.frame(category, *frame) for frame in sorted(used)]
        names = {frame.sequence_name for frame in frames}
        sequences = [SequenceAnnotation(name, category) for name in sorted(names)]
        for file, annotations in ((FRAMES_FILE, frames), (SEQUENCES_FILE, sequences)):
            write_atomic(out / category / file, compress(msgspec.json.encode(annotations)))
        for frame in frames:
            depth = frame.depth
            for path in (frame.image.path, depth.path, depth.mask_path, frame.mask.path):
                copy = out / path
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(data / path, copy)
