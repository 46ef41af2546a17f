"""A folder of models: `FOLDER/CATEGORY/NAME.obj`, or `FOLDER/CATEGORY/NAME/FILE.obj` for one of several files.

The optional file `models.json` gives the orientation and the origin of each model, see `ModelInfo`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.errors import InputError
from zsp_lite.io.files import plain_name, read_json
from zsp_lite.synthetic.meshes import EXTENSIONS, TexturedMesh, canonical_mesh, read_mesh

MODELS_FILE = "models.json"
_AXES = dict(zip(["+x", "+y", "+z", "-x", "-y", "-z"], np.vstack([np.eye(3), -np.eye(3)])))
_Direction = Literal["+x", "-x", "+y", "-y", "+z", "-z"] | tuple[float, float, float]


class ModelInfo(msgspec.Struct, frozen=True, omit_defaults=True):
    """Entry of `models.json` for one model; every field is optional."""

    front: _Direction | None = None  # in the axes of the file
    up: _Direction | None = None
    author: str = ""
    licence: str = ""
    source: str = ""
    changes: str = ""  # with respect to the source

    def axes(self, extension: str) -> Float[np.ndarray, "3 3"]:
        """Return the rotation from the axes of the file to the canonical frame (front +x, left +y, up +z).

        By default the front is +z and the top +y, as in glTF; for STL the front is -y and the top +z.
        """
        front, up = ("-y", "+z") if extension.lower() == ".stl" else ("+z", "+y")
        front, up = self.front or front, self.up or up
        given = [_AXES[one] if isinstance(one, str) else np.array(one) for one in (front, up)]
        x, z = (vector / max(np.linalg.norm(vector), 1e-6) for vector in given)
        y = np.cross(z, x)
        if not np.linalg.norm(y) > 1 - 5e-7:  # of unit vectors at 90 degrees, to 0.06 degrees
            raise InputError(f"front is {front} and up is {up}, expected perpendicular axes")
        return np.stack([np.cross(y, z), y, z])


@dataclass(frozen=True)
class Model:
    """One model of a folder: its category, name, file and entry of `models.json`."""

    category: str
    name: str
    path: Path
    info: ModelInfo

    def read(self) -> TexturedMesh:
        """Read the mesh in canonical coordinates; InputError if `read_mesh` refuses it."""
        return canonical_mesh(read_mesh(self.path), self.info.axes(self.path.suffix))


def list_models(folder: str | Path, front: str | None = None, up: str | None = None) -> list[Model]:
    """Return the models of a folder, sorted by category and name.

    `front` and `up` hold for the models whose entry in `models.json` does not give them. InputError if the folder holds
    no model, `models.json` is damaged or names a model that does not exist, or two files have the same name.
    """
    folder = Path(folder)
    infos, models = read_infos(folder), {}
    files = [(path.parent.name, path.stem, path) for path in folder.glob("*/*")]
    files += [(path.parts[-3], path.parts[-2], path) for path in folder.glob("*/*/*")]
    for category, name, path in sorted(files):
        if path.suffix.lower() not in EXTENSIONS or not path.is_file():
            continue
        key = f"{category}/{name}"
        if key in models:
            raise InputError(f"model {key} has two files, {models[key].path.name} and {path.name}, expected one")
        info = infos.pop(key, ModelInfo())
        info = msgspec.structs.replace(info, front=info.front or front, up=info.up or up)
        models[key] = Model(plain_name(category, "category"), plain_name(name, "model"), path, info)
    if not models:
        kinds = f"CATEGORY/NAME.EXT or CATEGORY/NAME/FILE.EXT with EXT one of {', '.join(EXTENSIONS)}"
        raise InputError(f"{folder} {'holds no model' if folder.is_dir() else 'does not exist'}, expected {kinds}")
    if infos:
        raise InputError(f"{folder / MODELS_FILE} names {min(infos)!r}, which has no file in {folder}")
    return [models[key] for key in sorted(models)]


def read_infos(folder: str | Path) -> dict[str, ModelInfo]:
    """Return the entries of a folder's `models.json` by "CATEGORY/NAME"; empty without the file."""
    path = Path(folder) / MODELS_FILE
    return read_json(path, dict[str, ModelInfo], "model list") if path.is_file() else {}
