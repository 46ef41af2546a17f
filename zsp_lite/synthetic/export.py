"""Export of procedural categories as a folder in CO3D's layout, with pose labels and evaluation pairs."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from zsp_lite.data.co3d import SequenceData
from zsp_lite.errors import check_choice
from zsp_lite.io.files import read_json, stable_hash, write_atomic
from zsp_lite.synthetic.assembly import Builder, make_shape
from zsp_lite.synthetic.categories import CATEGORIES
from zsp_lite.synthetic.materials import random_materials, with_materials
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.recording import (
    check_same_settings,
    read_poses,
    record_sequence,
    write_labels,
    write_pairs,
    write_sequence,
)
from zsp_lite.synthetic.sequences import HEIGHTS, RenderedSequence

SETTINGS_FILE = "synthetic.json"  # in the data folder: the settings of the export


@dataclass(frozen=True)
class Preset:
    """Definition of a data set."""

    categories: tuple[str, ...]
    sequences: int  # per category
    frames: int  # per sequence
    image_size: int  # shorter side in pixels
    pairs: int  # per category
    targets: tuple[int, ...]  # numbers of target views; each has its own file of pairs


PRESETS = {
    # The sample data outside the repository, made in some 15 s: the photograph of the demo needs a motorcycle.
    "demo": Preset(("bicycle", "chair", "motorcycle"), 2, 12, 176, pairs=10, targets=(1, 3, 5)),
    # The size of the paper's evaluation: twenty categories, ten sequences of about a hundred frames each.
    "paper": Preset(tuple(CATEGORIES), 10, 100, 256, pairs=100, targets=(1, 3, 5, 10, 20)),
    "paper-small": Preset(tuple(CATEGORIES), 5, 24, 256, pairs=25, targets=(1, 3, 5, 10, 20)),
}


def export_preset(preset: str, out: str | Path, seed: int = 0, progress: Callable[[Iterable], Iterable] = iter) -> None:
    """Write a preset with its evaluation pairs to a folder; see `export_categories`."""
    check_choice("preset", preset, PRESETS)
    size = PRESETS[preset]
    export_categories(size.categories, out, size.sequences, size.frames, seed, size.image_size, progress)
    for category in size.categories:
        write_pairs(Path(out), category, size.pairs, size.targets, seed)


def export_categories(
    categories: Sequence[str],
    out: str | Path,
    sequences: int,
    frames: int,
    seed: int,
    image_size: int = 256,
    progress: Callable[[Iterable], Iterable] = iter,
    builders: Mapping[str, Builder] = CATEGORIES,
    heights: tuple[float, float] = HEIGHTS,
) -> None:
    """Write sequences of procedural categories to a folder, with pose labels.

    A sequence depends only on the seed, its category and its index. An incomplete export is completed; complete
    sequences are not rendered again. The first sequence of a category is the reference of its labels. `image_size` is
    the shorter image side in pixels, `heights` the range of the mean elevation of a sequence's cameras in degrees;
    `progress` wraps the loop over sequences, as tqdm does. InputError if a category is unknown, or if the folder was
    written with other settings.
    """
    for category in categories:
        check_choice("category", category, builders)
    out, settings = Path(out), {"seed": seed, "frames": frames, "image_size": image_size}
    if (out / SETTINGS_FILE).is_file():
        check_same_settings(out, read_json(out / SETTINGS_FILE, dict[str, int], "settings"), settings)
    write_atomic(out / SETTINGS_FILE, json.dumps(settings).encode())
    jobs = [(category, index) for category in categories for index in range(sequences)]
    for category, index in progress(jobs):
        name = sequence_name(seed, category, index)
        if name not in read_poses(out, category):
            recorded = make_sequence(category, index, frames, seed, image_size, builders, heights)
            write_sequence(out, category, make_object(category, index, seed, builders), recorded)
    for category in categories:
        write_labels(out, category, [sequence_name(seed, category, index) for index in range(sequences)])


def make_sequence(
    category: str,
    index: int,
    frames: int,
    seed: int,
    image_size: int,
    builders: Mapping[str, Builder] = CATEGORIES,
    heights: tuple[float, float] = HEIGHTS,
) -> tuple[SequenceData, RenderedSequence]:
    """Make sequence number `index` of a category, with simulated sensor errors, and its exact rendering."""
    name = sequence_name(seed, category, index)
    key = stable_hash(f"{seed}/{category}/{index}")
    return record_sequence(make_object(category, index, seed, builders), name, key, frames, image_size, heights)


def make_object(category: str, index: int, seed: int, builders: Mapping[str, Builder] = CATEGORIES) -> TexturedMesh:
    """Return the object of sequence number `index` in canonical coordinates, with its materials."""
    key = stable_hash(f"{seed}/{category}/{index}")
    return with_materials(make_shape(builders[category], [key, 0]), random_materials([key, 3]))


def sequence_name(seed: int, category: str, index: int) -> str:
    """Return a name like CO3D's, three groups of digits; names sort in the order of their indices, up to 900."""
    digits = stable_hash(f"{seed}/{category}/{index}")
    return f"{100 + index}_{1000 + digits % 9000}_{1000 + digits // 9000 % 9000}"
