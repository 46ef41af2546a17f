"""Export of a folder of textured meshes as a data folder in CO3D's layout, with pose labels and evaluation pairs."""

from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec
import numpy as np

from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_json, sha256, stable_hash, write_atomic
from zsp_lite.synthetic.models import list_models
from zsp_lite.synthetic.recording import (
    check_same_settings,
    read_poses,
    record_sequence,
    write_labels,
    write_pairs,
    write_sequence,
)

RENDERED_FILE = "rendered_models.json"  # in the data folder: the settings, and the model of each sequence
_PAIRS, _TARGETS = 20, (1, 3, 5)  # evaluation pairs per category, for each of these numbers of target views


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
    progress: Callable[[Iterable], Iterable] = iter,
) -> dict[str, str]:
    """Render every model of a folder into a sequence of a data folder, with pose labels and evaluation pairs.

    A sequence has the name of its model, and depends only on the seed, the model and its orientation. An incomplete
    export is completed; complete sequences are not rendered again, unless the model or its orientation changed. The
    first model of a category is the reference of its labels. `image_size` is the shorter image side in pixels, `front`
    and `up` are as of `list_models`; `progress` wraps the loop over models, as tqdm does. Returns the models that were
    left out ("CATEGORY/NAME"), with the reason. InputError if no model is usable, or if `out` holds other data.
    """
    models, out = list_models(folder, front, up), Path(out)
    rendered = _read_rendered(out, {"seed": seed, "frames": frames, "image_size": image_size})
    left_out = {}
    for model in progress(models):
        info, file = model.info, model.path.relative_to(folder).as_posix()
        rotation = tuple(np.round(info.axes(model.path.suffix), 9).ravel().tolist())
        origin = (info.author, info.licence, info.source, info.changes)
        record = ModelRecord(file, sha256(model.path, "model"), rotation, *origin)
        known = rendered.sequences.get(model.category, {}).get(model.name) == record
        if known and model.name in read_poses(out, model.category):
            continue
        try:
            mesh = model.read()
        except InputError as error:
            left_out[f"{model.category}/{model.name}"] = str(error)
            continue
        key = stable_hash(f"{seed}/{model.category}/{model.name}")
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


def _read_rendered(out: Path, settings: dict[str, int | str]) -> _Rendered:
    """Return the records of an earlier export; InputError if the folder holds something else."""
    path = out / RENDERED_FILE
    if not path.is_file():
        if out.is_dir() and Co3D(out).categories():
            raise InputError(f"folder {out} holds other data, expected an empty one or an export of models")
        return _Rendered(settings, {})
    found = read_json(path, _Rendered, "records")
    check_same_settings(out, found.settings, settings)
    return found
