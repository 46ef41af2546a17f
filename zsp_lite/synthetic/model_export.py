"""Export of a folder of textured meshes as a data folder in CO3D's layout, with pose labels and evaluation pairs."""

import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec
import numpy as np

from zsp_lite.data.annotations import decode
from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError, check_integer
from zsp_lite.io.files import read_bytes, write_atomic
from zsp_lite.synthetic.models import Model, list_models
from zsp_lite.synthetic.recording import (
    MOST_FRAMES,
    MOST_PIXELS,
    read_poses,
    record_sequence,
    stable_hash,
    write_labels,
    write_pairs,
    write_sequence,
)

RENDERED_FILE = "rendered_models.json"  # in the data folder: the settings, and the model of each sequence
_PAIRS, _TARGETS = 20, (1, 3, 5)


class ModelRecord(msgspec.Struct, frozen=True):
    """Origin of a rendered sequence, as `rendered_models.json` holds it; `rotation` is that to the canonical frame."""

    file: str
    sha256: str
    rotation: tuple[float, ...]
    author: str
    licence: str
    source: str
    changes: str


class _Rendered(msgspec.Struct):
    settings: dict[str, int | str]
    sequences: dict[str, dict[str, ModelRecord]]


def export_models(
    folder: str | Path,
    out: str | Path,
    frames: int = 24,
    seed: int = 0,
    image_size: int = 256,
    front: str | None = None,
    up: str | None = None,
    progress: Callable[[Iterable], Iterable] | None = None,
) -> dict[str, str]:
    """Render every model of a folder into a sequence of a data folder, with pose labels and evaluation pairs.

    A sequence has the name of its model, and depends only on the seed, the model and its orientation. An incomplete
    export is completed; complete sequences are not rendered again, unless the model or its orientation changed. The
    first model of a category is the reference of its labels. `front` and `up` are those of `list_models`.

    Returns the models that were left out ("CATEGORY/NAME"), with the reason. Raises InputError if the folder holds no
    usable model, a setting is out of its range, or `out` was written with other settings.
    """
    check_integer("frames", frames, 1, MOST_FRAMES)
    check_integer("image_size", image_size, 32, MOST_PIXELS)
    check_integer("seed", seed, 0)
    models, out = list_models(folder, front, up), Path(out)
    rendered = _read_rendered(out, {"seed": seed, "frames": frames, "image_size": image_size})
    left_out = {}
    for model in progress(models) if progress else models:
        record = _record(model, Path(folder))
        known = rendered.sequences.get(model.category, {}).get(model.name) == record
        if known and model.name in read_poses(out, model.category):
            continue
        try:
            mesh = model.read()
        except InputError as error:
            left_out[f"{model.category}/{model.name}"] = str(error)
            continue
        key = stable_hash(seed, model.category, model.name)
        recorded = record_sequence(mesh, model.name, key, frames, image_size)
        write_sequence(out, model.category, mesh, recorded)
        # The record is written last; a sequence with a record is complete.
        rendered.sequences.setdefault(model.category, {})[model.name] = record
        write_atomic(out / RENDERED_FILE, msgspec.json.format(msgspec.json.encode(rendered), indent=1))
    if not rendered.sequences:
        key, reason = next(iter(left_out.items()))
        raise InputError(f"{folder} holds no usable model; {key}: {reason}")
    for category, sequences in rendered.sequences.items():
        write_labels(out, category, sorted(sequences))
        if len(sequences) > 1:
            write_pairs(out, category, _PAIRS, [n for n in _TARGETS if n <= frames], seed)
    return left_out


def _record(model: Model, folder: Path) -> ModelRecord:
    info, digest = model.info, hashlib.sha256(read_bytes(model.path, "model")).hexdigest()
    rotation = tuple(np.round(info.axes(model.path.suffix), 9).ravel().tolist())
    file = model.path.relative_to(folder).as_posix()
    return ModelRecord(file, digest, rotation, info.author, info.licence, info.source, info.changes)


def _read_rendered(out: Path, settings: dict[str, int | str]) -> _Rendered:
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
