"""Procedural categories written as a folder in CO3D's layout, with pose labels and evaluation pairs."""

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zsp_lite.data.annotations import decode
from zsp_lite.data.cameras import NDC_ISOTROPIC, NDC_NORM_IMAGE_BOUNDS
from zsp_lite.data.co3d import Co3D, SequenceData, write_co3d
from zsp_lite.data.labels import PoseLabel, write_label
from zsp_lite.data.pairs import sample_pairs, upstream_pairs_path, write_upstream_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic
from zsp_lite.synthetic.assembly import Shape, make_shape
from zsp_lite.synthetic.evaluation_categories import EVALUATION
from zsp_lite.synthetic.sensor import observe
from zsp_lite.synthetic.sequences import RenderedSequence, render_sequence
from zsp_lite.synthetic.training_categories import TRAINING
from zsp_lite.synthetic.validation_categories import VALIDATION

SPLITS = {"training": TRAINING, "validation": VALIDATION, "evaluation": EVALUATION}
GENERATORS = TRAINING | VALIDATION | EVALUATION
SETTINGS_FILE = "synthetic.json"  # in the data folder: what it was made with
POSES_FILE = "object_poses.json"  # in each category: where each sequence's object stands in its world
JPEG_QUALITY = 88
LAYOUTS = {"v1": NDC_NORM_IMAGE_BOUNDS, "v2": NDC_ISOTROPIC}


@dataclass(frozen=True)
class Preset:
    """A data set as plain data: `image_size` is the shorter image side in pixels, `pairs` is per category."""

    categories: tuple[str, ...]
    sequences: int
    frames: int
    image_size: int
    pairs: int
    targets: tuple[int, ...]


# Half of the paper's twenty names, fixed before any result: the five of its Table 1 and five others.
_EVAL = (
    "bicycle", "car", "chair", "hairdryer", "hydrant", "motorcycle", "teddybear", "toaster", "toyplane", "toytruck"
)  # fmt: skip

PRESETS = {
    "samples": Preset(("bicycle", "chair", "teddybear", "toytruck"), 4, 24, 176, pairs=20, targets=(1, 3, 5)),
    "eval": Preset(_EVAL, 10, 24, 256, pairs=50, targets=(1, 3, 5, 20)),
    # As large as the paper's evaluation: its twenty categories, ten sequences of about a hundred frames each.
    "paper": Preset(tuple(EVALUATION), 10, 100, 256, pairs=100, targets=(1, 3, 5, 10, 20)),
}


def export_preset(
    preset: str, out: str | Path, seed: int = 0, progress: Callable[[Iterable], Iterable] | None = None
) -> None:
    """Write a preset with its evaluation pairs to the folder `out`; `progress` wraps the loop, as tqdm does.

    Raises InputError on an unknown preset and as `export_categories`.
    """
    if preset not in PRESETS:
        raise InputError(f"preset is {preset!r}, expected one of {', '.join(PRESETS)}")
    wanted = PRESETS[preset]
    export_categories(
        wanted.categories, out, wanted.sequences, wanted.frames, seed, wanted.image_size, progress=progress
    )
    write_pairs(wanted, out, seed)


def write_pairs(preset: Preset, out: str | Path, seed: int) -> None:
    """Sample the preset's evaluation pairs and write them in the upstream form."""
    dataset = Co3D(out)
    for category in preset.categories:
        for n_targets in preset.targets:
            pairs = sample_pairs(dataset, category, preset.pairs, n_targets, seed)
            write_upstream_pairs(upstream_pairs_path(out, category, preset.pairs, n_targets), pairs, dataset)


def export_categories(
    categories: Sequence[str],
    out: str | Path,
    sequences: int,
    frames: int,
    seed: int,
    image_size: int = 256,
    layout: str = "v1",
    progress: Callable[[Iterable], Iterable] | None = None,
) -> None:
    """Write `sequences` sequences of `frames` frames of each category to the folder `out`, with pose labels.

    The name of a split stands for all its categories. The shorter image side has `image_size` pixels. A sequence
    depends on the seed, its category and its index alone, so any part of an export can be made again; sequences that
    are complete already are left alone. The first sequence of a category is its labels' reference. Raises InputError
    on unknown categories or layouts, and on a folder that was made with other settings.
    """
    categories = list(dict.fromkeys(name for given in categories for name in SPLITS.get(given, [given])))
    for category in categories:
        if category not in GENERATORS:
            raise InputError(f"category is {category!r}, expected one of {', '.join([*SPLITS, *sorted(GENERATORS)])}")
    if layout not in LAYOUTS:
        raise InputError(f"layout is {layout!r}, expected one of {', '.join(LAYOUTS)}")
    if min(sequences, frames) < 1 or image_size < 32:
        raise InputError(
            f"export has {sequences} sequences of {frames} frames of {image_size} pixels, expected at least 1, 1 and 32"
        )
    out = Path(out)
    settings = {"seed": seed, "frames": frames, "image_size": image_size, "layout": layout}
    _claim(out, settings)
    jobs = [(category, index) for category in categories for index in range(sequences)]
    for category, index in progress(jobs) if progress else jobs:
        name = sequence_name(seed, category, index)
        poses = _read_poses(out, category)
        if name not in poses or name not in _complete(out, category):
            data, exact = make_sequence(category, index, frames, seed, image_size)
            # The pose goes first: a sequence counts as complete by the annotations, which come last.
            poses[name] = {"trans": exact.object_pose.tolist(), "scale": exact.scale}
            write_atomic(out / category / POSES_FILE, json.dumps(poses, indent=1).encode())
            write_co3d(out, category, [data], quality=JPEG_QUALITY, intrinsics_format=LAYOUTS[layout])
        reference = sequence_name(seed, category, 0)
        trans = np.array(poses[name]["trans"]) @ np.linalg.inv(poses[reference]["trans"])
        trans = np.eye(4) if name == reference else np.round(trans, 12) + 0.0  # the same on any processor
        write_label(out, category, PoseLabel(trans, name, reference))


def make_sequence(
    category: str, index: int, frames: int, seed: int, image_size: int
) -> tuple[SequenceData, RenderedSequence]:
    """Sequence number `index` of a category, as CO3D would hold it, and its exact twin."""
    key = _stable_hash(seed, category, index)
    shape = _make_object(category, key)
    rendered = render_sequence(shape, np.random.default_rng([key, 1]), frames, image_size)
    return observe(rendered, sequence_name(seed, category, index), np.random.default_rng([key, 2]))


def make_object(category: str, sequence: str, seed: int) -> Shape:
    """The object of an exported sequence, given its name and the export's seed, in canonical coordinates.

    Raises InputError where no such sequence is exported with that seed.
    """
    index = int(sequence[:3]) - 100 if sequence[:3].isdecimal() else -1
    if category not in GENERATORS or index < 0 or sequence != sequence_name(seed, category, index):
        raise InputError(f"sequence {category}/{sequence} is none of an export with seed {seed}")
    return _make_object(category, _stable_hash(seed, category, index))


def _make_object(category: str, key: int) -> Shape:
    return make_shape(GENERATORS[category], [key, 0])


def sequence_name(seed: int, category: str, index: int) -> str:
    """A name like CO3D's, digits in three groups; sorted names are in the order of the indices, up to 900."""
    digits = _stable_hash(seed, category, index)
    return f"{100 + index}_{1000 + digits % 9000}_{1000 + digits // 9000 % 9000}"


def _stable_hash(seed: int, category: str, index: int) -> int:
    """64 bits that are the same on every machine and in every process."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{category}/{index}".encode()).digest()[:8], "big")


def _claim(out: Path, settings: dict) -> None:
    """Note the settings in the folder, or refuse one that was made with others."""
    path = out / SETTINGS_FILE
    if path.is_file():
        found = decode(read_bytes(path, "settings"), dict, path)
        if found != settings:
            raise InputError(f"folder {out} was made with {found}, expected {settings} or another folder")
    write_atomic(path, json.dumps(settings).encode())


def _read_poses(out: Path, category: str) -> dict:
    path = out / category / POSES_FILE
    return decode(read_bytes(path, "object poses"), dict, path) if path.is_file() else {}


def _complete(out: Path, category: str) -> set[str]:
    """Names of the sequences that stand in both of the category's annotation files."""
    dataset = Co3D(out)
    if category not in dataset.categories():
        return set()
    listed = {sequence.sequence_name for sequence in dataset.sequences(category)}
    return listed & {key.sequence_name for key in dataset.frame_list(category)}
