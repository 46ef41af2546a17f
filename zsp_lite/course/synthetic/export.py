"""Export of procedural categories, or of models, to a data folder with labels and pairs."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial import KDTree
from tqdm import tqdm

from zsp_lite.course.synthetic.assembly import make_shape, random_materials
from zsp_lite.course.synthetic.categories import CATEGORIES
from zsp_lite.course.synthetic.meshes import TexturedMesh, canonical_mesh, list_models, read_mesh
from zsp_lite.course.synthetic.primitives import Vertices, box_centre, rotation
from zsp_lite.course.synthetic.sequences import record_sequence
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.evaluation import sample_pairs
from zsp_lite.data.ground_truth import POSES_FILE, ObjectPose, read_poses
from zsp_lite.data.labels import PoseLabel
from zsp_lite.data.writing import (
    pairs_path,
    write_co3d,
    write_label,
    write_published_pairs,
)
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.download import sha256
from zsp_lite.io.files import read_json, stable_hash, write_atomic

# File with the settings of the export, in the data folder of procedural objects.
SETTINGS_FILE = "synthetic.json"
# File with the settings and the model of each sequence, in the data folder of models.
RENDERED_FILE = "rendered_models.json"
_MODEL_PAIRS = 20  # per category of models and number of target views
_MODEL_TARGETS = (1, 3, 5)  # numbers of target views


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
    # The three numbers are `sequences`, `frames` and `image_size`.
    # The sample data outside the repository, made in some 15 s. The photograph of the demo needs a
    # motorcycle.
    "demo": Preset(("bicycle", "chair", "motorcycle"), 2, 12, 176, pairs=10, targets=(1, 3, 5)),
    # The size of the paper's evaluation: twenty categories, ten sequences of about a hundred frames
    # each.
    "paper": Preset(tuple(CATEGORIES), 10, 100, 256, pairs=100, targets=(1, 3, 5, 10, 20)),
    "paper-small": Preset(tuple(CATEGORIES), 5, 24, 256, pairs=25, targets=(1, 3, 5, 10, 20)),
}


def export_preset(preset: str, out: str | Path, seed: int = 0) -> None:
    """Write a preset with its evaluation pairs to a folder; see `export_categories`."""
    check_choice("preset", preset, PRESETS)
    data = PRESETS[preset]
    export_categories(data.categories, out, data.sequences, data.frames, seed, data.image_size)
    for category in data.categories:
        write_pairs(Path(out), category, data.pairs, data.targets, seed)


def sequence_name(seed: int, category: str, index: int) -> str:
    """Return a name like CO3D's, three groups of digits; below index 900, names sort by index."""
    digits = _key(seed, category, index)
    return f"{100 + index}_{1000 + digits % 9000}_{1000 + digits // 9000 % 9000}"


def export_categories(
    categories: Sequence[str],
    out: str | Path,
    sequences: int,
    frames: int,
    seed: int,
    image_size: int = 256,
    plain_names: bool = False,
) -> None:
    """Write sequences of procedural categories to a folder, with pose labels.

    A sequence depends only on the seed, its category and its index. An incomplete export is
    completed; complete sequences are not rendered again.

    Args:
        categories: their names.
        out: the data folder.
        sequences: number of sequences per category; the first is the reference of the labels.
        frames: number of frames per sequence.
        seed: seed of everything random.
        image_size: shorter image side in pixels.
        plain_names: whether the names of sequences say nothing of the seed.

    Raises:
        InputError: if a category is unknown, or the folder was written with other settings.
    """
    for category in categories:
        check_choice("category", category, CATEGORIES)
    out = Path(out)
    settings = {"seed": seed, "frames": frames, "image_size": image_size}
    if (out / SETTINGS_FILE).is_file():
        written = read_json(out / SETTINGS_FILE, dict[str, int], "settings")
        _check_same_settings(out, written, settings)
    write_atomic(out / SETTINGS_FILE, json.dumps(settings).encode())
    for category in categories:
        names = [
            str(100 + index) if plain_names else sequence_name(seed, category, index)
            for index in range(sequences)
        ]
        for index, name in enumerate(tqdm(names, category, disable=None)):
            if name not in read_poses(out, category):
                mesh = make_object(category, index, seed)
                key = _key(seed, category, index)
                write_sequence(out, category, mesh, name, key, frames, image_size)
        write_true_labels(out, category, names)


def make_object(category: str, index: int, seed: int) -> TexturedMesh:
    """Return the object of sequence number `index` in canonical coordinates, with its materials."""
    key = _key(seed, category, index)
    # Shape and materials have random numbers of their own; `record_sequence` takes [key, 1 and 2].
    return replace(make_shape(CATEGORIES[category], [key, 0]), materials=random_materials([key, 3]))


class _Rendered(msgspec.Struct):
    """Content of `RENDERED_FILE`."""

    settings: dict[str, int | str]
    # by category and name of the sequence: the file of its model, its rotation, licence and more
    sequences: dict[str, dict[str, dict]]


def export_models(
    folder: str | Path,
    out: str | Path,
    frames: int = 24,
    seed: int = 0,
    image_size: int = 256,
    front: str | None = None,
    up: str | None = None,
) -> dict[str, str]:
    """Render every model of a folder into a data folder, with pose labels and evaluation pairs.

    An incomplete export is completed; complete sequences are not rendered again, unless the model
    or its orientation changed.

    Args:
        folder: folder of the models, see `list_models`.
        out: the data folder.
        frames: number of frames per sequence.
        seed: seed of everything random.
        image_size: shorter image side in pixels.
        front: axis to the front of models without an entry, see `list_models`.
        up: axis to the top of models without an entry.

    Returns:
        The reason for each model ("CATEGORY/NAME") that was left out.

    Raises:
        InputError: if no model is usable, or if `out` holds other data.
    """
    models = list_models(folder, front, up)
    out = Path(out)
    settings = {"seed": seed, "frames": frames, "image_size": image_size}
    rendered = _Rendered(settings, {})
    left_out = {}
    if (out / RENDERED_FILE).is_file():
        rendered = read_json(out / RENDERED_FILE, _Rendered, "records")
        _check_same_settings(out, rendered.settings, settings)
    elif out.is_dir() and Co3D(out).categories():
        raise InputError(
            f"folder {out} holds other data, expected an empty one or an export of models"
        )
    for model in tqdm(models, "rendering", disable=None):
        to_canonical = model.info.axes(model.path.suffix)
        record = {
            "file": model.path.relative_to(folder).as_posix(),
            "sha256": sha256(model.path, "model"),
            "rotation": np.round(to_canonical, 9).ravel().tolist(),
            "author": model.info.author,
            "licence": model.info.licence,
            "source": model.info.source,
            "changes": model.info.changes,
        }
        known = rendered.sequences.get(model.category, {}).get(model.name) == record
        if known and model.name in read_poses(out, model.category):
            continue
        try:
            mesh = canonical_mesh(read_mesh(model.path), to_canonical)
        except InputError as error:
            left_out[f"{model.category}/{model.name}"] = str(error)
            continue
        key = _key(seed, model.category, model.name)
        write_sequence(out, model.category, mesh, model.name, key, frames, image_size)
        # The record is written last; a sequence with a record is complete.
        rendered.sequences.setdefault(model.category, {})[model.name] = record
        text = msgspec.json.format(msgspec.json.encode(rendered), indent=1)
        write_atomic(out / RENDERED_FILE, text)
    if not rendered.sequences:
        name, reason = next(iter(left_out.items()))
        raise InputError(f"{folder} holds no usable model; {name}: {reason}")
    for category, sequences in rendered.sequences.items():
        write_true_labels(out, category, sorted(sequences))
        if len(sequences) > 1:
            targets = [n for n in _MODEL_TARGETS if n <= frames]
            write_pairs(out, category, _MODEL_PAIRS, targets, seed)
    return left_out


def _key(seed: int, category: str, sequence: int | str) -> int:
    """Return the seed of everything random about a sequence: object, room, cameras and noise."""
    return stable_hash(f"{seed}/{category}/{sequence}")


def _check_same_settings(out: Path, written: Mapping, settings: Mapping) -> None:
    """Raise InputError if a folder was written with other settings."""
    if written != settings:
        raise InputError(
            f"folder {out} was written with {written}, expected {settings} or another folder"
        )


def write_sequence(
    out: Path,
    category: str,
    mesh: TexturedMesh,
    name: str,
    key: int,
    frames: int,
    image_size: int,
) -> None:
    """Add a sequence to a data folder, as `record_sequence` makes it, with the pose of its
    object."""
    data, pose, scale = record_sequence(mesh, name, key, frames, image_size)
    write_co3d(out, category, [data], quality=88)
    low = mesh.vertices.min(0).tolist()
    high = mesh.vertices.max(0).tolist()
    # The pose is written last; a sequence with a pose is complete.
    poses = read_poses(out, category)
    poses[name] = ObjectPose(pose.tolist(), scale, low, high, shape_turns(mesh.vertices))
    text = json.dumps(msgspec.to_builtins(poses), indent=1)
    write_atomic(out / category / POSES_FILE, text.encode())


def shape_turns(vertices: Vertices) -> tuple[int, ...]:
    """Return the quarter turns about z, in degrees, that map the vertices to themselves."""
    points = vertices - box_centre(vertices)
    tree = KDTree(points)
    limit = 0.03 * np.ptp(points)  # a share of the longest side, chosen by hand
    turns = []
    for degrees in (90, 180, 270):
        distances, _ = tree.query(points @ rotation("z", np.radians(degrees)).T)
        if distances.max() < limit:
            turns.append(degrees)
    return tuple(turns)


def write_true_labels(out: Path, category: str, names: Sequence[str]) -> None:
    """Write pose labels of sequences from their object poses; the first is the reference."""
    poses = {name: np.array(pose.trans) for name, pose in read_poses(out, category).items()}
    from_reference = np.linalg.inv(poses[names[0]])
    for name in names:
        # Rounding makes rotations equal on all processors, and the label of the reference exactly
        # the identity. It does not make translations equal: their unit, that of the sequence,
        # differs by some 3e-5 between processors. Adding 0.0 turns negative zeros into zeros.
        trans = np.round(poses[name] @ from_reference, 12) + 0.0
        write_label(out, category, PoseLabel(trans, name, names[0]))


def write_pairs(out: Path, category: str, pairs: int, targets: Iterable[int], seed: int) -> None:
    """Sample evaluation pairs, and write a file of them per number of target views."""
    dataset = Co3D(out)
    for n_targets in targets:
        sampled = sample_pairs(dataset, category, pairs, n_targets, seed)
        write_published_pairs(pairs_path(out, category, pairs, n_targets), sampled, dataset)
