"""Export of a folder of textured meshes as a data folder in CO3D's layout, with pose labels and evaluation pairs."""

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np

from zsp_lite.data.annotations import decode
from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Co3D, SequenceData, write_co3d
from zsp_lite.data.labels import PoseLabel, write_label
from zsp_lite.data.pairs import sample_pairs, upstream_pairs_path, write_upstream_pairs
from zsp_lite.errors import InputError, check_integer
from zsp_lite.io.files import read_bytes, write_atomic
from zsp_lite.synthetic.export import JPEG_QUALITY, POSES_FILE
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.models import Model, list_models
from zsp_lite.synthetic.raytracing import MeshScene, Quality
from zsp_lite.synthetic.render import Rendering
from zsp_lite.synthetic.room import random_room
from zsp_lite.synthetic.sensor import simulate_capture
from zsp_lite.synthetic.sequences import RenderedSequence, handheld_sweep, image_shape

RENDERED_FILE = "rendered_models.json"  # in the data folder: the settings, and the model of each sequence
_PAIRS, _TARGETS = 20, (1, 3, 5)


@runtime_checkable
class Renderer(Protocol):
    """Renders a mesh from several cameras, for instance `render_views`."""

    def __call__(self, mesh: TexturedMesh, cameras: Sequence[Camera], rng: np.random.Generator) -> Iterable[Rendering]:
        """Return one rendering per camera; the cameras map from the coordinates of the mesh."""
        ...


@runtime_checkable
class Sensor(Protocol):
    """Converts exact renderings to recorded frames, for instance `zsp_lite.synthetic.sensor.simulate_capture`."""

    def __call__(
        self, sequence: RenderedSequence, name: str, seed: np.random.Generator
    ) -> tuple[SequenceData, RenderedSequence]:
        """Return the recorded sequence, and the exact one in the same unit."""
        ...


class ModelRecord(msgspec.Struct, frozen=True):
    """Origin of a rendered sequence, as `rendered_models.json` holds it.

    Attributes:
        file: Model file, relative to the folder of models.
        sha256: Checksum of the file.
        rotation: Rotation from the axes of the file to the canonical frame, row by row.
        author, licence, source, changes: As in `models.json`.
    """

    file: str
    sha256: str
    rotation: tuple[float, ...]
    author: str
    licence: str
    source: str
    changes: str


class _Rendered(msgspec.Struct):
    settings: dict[str, int]
    sequences: dict[str, dict[str, ModelRecord]]


def render_views(
    mesh: TexturedMesh, cameras: Sequence[Camera], rng: np.random.Generator, quality: Quality = Quality()
) -> Iterable[Rendering]:
    """Render a mesh in a random room with the ray-casting renderer, see `zsp_lite.synthetic.raytracing`.

    Args:
        mesh: Mesh in canonical coordinates.
        cameras: Cameras that map from these coordinates.
        rng: Source of the room and of the noise.
        quality: Numbers of rays.
    """
    scene = MeshScene(mesh, random_room(rng), quality, int(rng.integers(2**32)))
    return [scene.render(camera, rng) for camera in cameras]


def render_model(
    mesh: TexturedMesh,
    seed: int | np.random.Generator,
    frames: int,
    image_size: int,
    renderer: Renderer = render_views,
) -> RenderedSequence:
    """Render views around a mesh; the same seed gives the same cameras.

    The world is the frame of the first camera, so that the pose of the object in it does not depend on the category.

    Args:
        mesh: Mesh in canonical coordinates.
        seed: Seed or source of the draws.
        frames: Number of views.
        image_size: Shorter image side in pixels.
        renderer: Makes the pictures and their geometry.

    Returns:
        The exact views.
    """
    rng = np.random.default_rng(seed)
    cameras = handheld_sweep(mesh.vertices, rng, frames, image_shape(image_size, rng))
    first = cameras[0].matrix
    rounded = partial(np.round, decimals=9)  # equal files on processors with other last digits of sines
    views = []
    for view in renderer(mesh, cameras, rng):
        pose = rounded(view.camera.matrix @ np.linalg.inv(first)) + 0.0  # no negative zeros
        views.append(replace(view, camera=replace(view.camera, R=pose[:3, :3], t=pose[:3, 3])))
    seconds = np.round(np.arange(frames) * rng.uniform(0.4, 0.9), 3)
    return RenderedSequence(tuple(views), tuple(seconds.tolist()), rounded(first), 1.0)


def export_models(
    folder: str | Path,
    out: str | Path,
    frames: int = 24,
    seed: int = 0,
    image_size: int = 256,
    renderer: Renderer = render_views,
    sensor: Sensor = simulate_capture,
    progress: Callable[[Iterable], Iterable] | None = None,
) -> dict[str, str]:
    """Render every model of a folder into a sequence of a data folder, with pose labels and evaluation pairs.

    A sequence has the name of its model, and depends only on the seed, the model and its orientation. Complete
    sequences are not rendered again, unless the model or its orientation changed. The first model of a category is
    the reference of its labels.

    Args:
        folder: Folder of models, see `zsp_lite.synthetic.models`.
        out: Data folder to write; an incomplete export is completed.
        frames: Frames per sequence.
        seed: Seed of rooms, cameras, noise and pairs.
        image_size: Shorter image side in pixels.
        renderer: Makes the pictures and their geometry.
        sensor: Makes depth, masks and point cloud from the exact renderings.
        progress: Wraps the loop over models, as tqdm does.

    Returns:
        Models that were left out ("CATEGORY/NAME"), with the reason.

    Raises:
        InputError: If the folder holds no usable model, a setting is out of its range, or `out` was written with
            other settings.
    """
    check_integer("frames", frames, 1)
    check_integer("image_size", image_size, 32)
    check_integer("seed", seed, 0)
    models, out = list_models(folder), Path(out)
    rendered = _read_rendered(out, {"seed": seed, "frames": frames, "image_size": image_size})
    left_out = {}
    for model in progress(models) if progress else models:
        record = _record(model, Path(folder))
        poses = _read_poses(out, model.category)
        if rendered.sequences.get(model.category, {}).get(model.name) == record and model.name in poses:
            continue
        try:
            mesh = model.read()
        except InputError as error:
            left_out[f"{model.category}/{model.name}"] = str(error)
            continue
        key = int.from_bytes(hashlib.sha256(f"{seed}/{model.category}/{model.name}".encode()).digest()[:8], "big")
        exact = render_model(mesh, np.random.default_rng([key, 1]), frames, image_size, renderer)
        data, exact = sensor(exact, model.name, np.random.default_rng([key, 2]))
        low, high = mesh.vertices.min(0).tolist(), mesh.vertices.max(0).tolist()
        poses[model.name] = {"trans": exact.object_pose.tolist(), "scale": exact.scale, "low": low, "high": high}
        write_atomic(out / model.category / POSES_FILE, json.dumps(poses, indent=1).encode())
        write_co3d(out, model.category, [data], quality=JPEG_QUALITY)
        # The record is written last; a sequence with a record is complete.
        rendered.sequences.setdefault(model.category, {})[model.name] = record
        write_atomic(out / RENDERED_FILE, msgspec.json.format(msgspec.json.encode(rendered), indent=1))
    if not rendered.sequences:
        key, reason = next(iter(left_out.items()))
        raise InputError(f"{folder} holds no usable model; {key}: {reason}")
    for category, sequences in rendered.sequences.items():
        _write_labels(out, category, sorted(sequences))
        _write_pairs(out, category, len(sequences), frames, seed)
    return left_out


def _record(model: Model, folder: Path) -> ModelRecord:
    info, digest = model.info, hashlib.sha256(read_bytes(model.path, "model")).hexdigest()
    rotation = tuple(np.round(info.axes(model.path.suffix), 9).ravel().tolist())
    file = model.path.relative_to(folder).as_posix()
    return ModelRecord(file, digest, rotation, info.author, info.licence, info.source, info.changes)


def _read_rendered(out: Path, settings: dict[str, int]) -> _Rendered:
    """Return the records of an earlier export. Raises InputError if the folder is another one's."""
    path = out / RENDERED_FILE
    if not path.is_file():
        if out.is_dir() and Co3D(out).categories():
            raise InputError(f"folder {out} holds other data, expected an empty one or an export of models")
        return _Rendered(settings, {})
    found = decode(read_bytes(path, "records"), _Rendered, path)
    if found.settings != settings:
        raise InputError(f"folder {out} was written with {found.settings}, expected {settings} or another folder")
    return found


def _read_poses(out: Path, category: str) -> dict:
    path = out / category / POSES_FILE
    return decode(read_bytes(path, "object poses"), dict, path) if path.is_file() else {}


def _write_labels(out: Path, category: str, names: list[str]) -> None:
    poses = {name: np.array(pose["trans"]) for name, pose in _read_poses(out, category).items()}
    for name in names:
        trans = np.round(poses[name] @ np.linalg.inv(poses[names[0]]), 12) + 0.0
        write_label(out, category, PoseLabel(np.eye(4) if name == names[0] else trans, name, names[0]))


def _write_pairs(out: Path, category: str, sequences: int, frames: int, seed: int) -> None:
    """Write evaluation pairs where the category has two sequences, with up to as many targets as frames."""
    dataset = Co3D(out)
    for n_targets in _TARGETS if sequences > 1 else ():
        if n_targets <= frames:
            pairs = sample_pairs(dataset, category, _PAIRS, n_targets, seed)
            write_upstream_pairs(upstream_pairs_path(out, category, _PAIRS, n_targets), pairs, dataset)
