"""A folder of models: `FOLDER/CATEGORY/NAME.obj` (or another extension of `EXTENSIONS`).

A model with several files may have its own folder, `FOLDER/CATEGORY/NAME/FILE.obj`. The optional file
`models.json` gives the orientation and the origin of each model, see `ModelInfo`.
"""

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.io.files import plain_name, read_bytes
from zsp_lite.synthetic.meshes import EXTENSIONS, TexturedMesh, canonical_mesh, read_mesh

MODELS_FILE = "models.json"
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_Direction = str | tuple[float, float, float]


class ModelInfo(msgspec.Struct, frozen=True, omit_defaults=True):
    """Entry of `models.json` for one model; every field is optional.

    `front` and `up` are directions in the axes of the file: "+x", "-x", ... "-z", or three numbers.
    """

    front: _Direction | None = None
    up: _Direction | None = None
    author: str = ""
    licence: str = ""
    source: str = ""
    changes: str = ""  # with respect to the source

    def axes(self, extension: str) -> Float[np.ndarray, "3 3"]:
        """Return the rotation from the axes of the file to the canonical frame (front +x, left +y, up +z).

        By default the front is +z and the top +y, as in glTF; for STL the front is -y and the top +z. Raises InputError
        if a direction is invalid, or the two are not perpendicular.
        """
        front, up = ("-y", "+z") if extension.lower() == ".stl" else ("+z", "+y")
        x, z = (_direction(given) for given in (self.front or front, self.up or up))
        if abs(x @ z) > 1e-3:
            raise InputError(f"front is {self.front or front} and up is {self.up or up}, expected perpendicular axes")
        y = np.cross(z, x)
        return np.stack([np.cross(y, z), y, z])


@dataclass(frozen=True)
class Model:
    """One model of a folder: its category, name, file and entry of `models.json`."""

    category: str
    name: str
    path: Path
    info: ModelInfo

    def read(self) -> TexturedMesh:
        """Read the mesh in canonical coordinates. Raises InputError as `read_mesh` and `ModelInfo.axes` do."""
        mesh = read_mesh(self.path)
        try:
            return canonical_mesh(mesh, self.info.axes(self.path.suffix))
        except InputError as error:
            raise InputError(f"{MODELS_FILE}, {self.category}/{self.name}: {error}") from error


def list_models(folder: str | Path, front: str | None = None, up: str | None = None) -> list[Model]:
    """Return the models of a folder, sorted by category and name.

    `front` and `up` hold for the models whose entry in `models.json` does not give them. Raises InputError if the
    folder does not exist or holds no model, `models.json` is damaged or names a model that does not exist, or two files
    have the same name.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"folder of models {folder} does not exist")
    infos, models = read_infos(folder), {}
    files = [(path.parent.name, path.stem, path) for path in folder.glob("*/*") if path.is_file()]
    files += [(path.parts[-3], path.parts[-2], path) for path in folder.glob("*/*/*") if path.is_file()]
    for category, name, path in sorted(files):
        if path.suffix.lower() in EXTENSIONS:
            key = f"{category}/{name}"
            if key in models:
                raise InputError(f"model {key} has two files, {models[key].path.name} and {path.name}, expected one")
            info = infos.get(key, ModelInfo())
            info = msgspec.structs.replace(info, front=info.front or front, up=info.up or up)
            models[key] = Model(plain_name(category, "category"), plain_name(name, "model"), path, info)
    if not models:
        raise InputError(
            f"{folder} holds no model, expected CATEGORY/NAME.EXT or CATEGORY/NAME/FILE.EXT with EXT one of "
            f"{', '.join(EXTENSIONS)}"
        )
    if unknown := sorted(infos.keys() - models.keys()):
        raise InputError(f"{folder / MODELS_FILE} names {unknown[0]!r}, which has no file in {folder}")
    return [models[key] for key in sorted(models)]


def read_infos(folder: str | Path) -> dict[str, ModelInfo]:
    """Return the entries of a folder's `models.json` by "CATEGORY/NAME"; empty without the file."""
    path = Path(folder) / MODELS_FILE
    return decode(read_bytes(path, "model list"), dict[str, ModelInfo], path) if path.is_file() else {}


def _direction(given: _Direction) -> np.ndarray:
    """Return the unit vector of "+x" ... "-z" or of three numbers."""
    if isinstance(given, str):
        sign, axis = (given[:1], given[1:]) if given[:1] in "+-" else ("+", given)
        if axis not in _AXES:
            raise InputError(f"direction is {given!r}, expected +x, -x, +y, -y, +z, -z or three numbers")
        return (-1.0 if sign == "-" else 1.0) * np.array(_AXES[axis])
    vector = np.array(given, float)
    length = np.linalg.norm(vector)
    if not 1e-6 < length < np.inf:
        raise InputError(f"direction is {given}, expected three finite numbers that are not all zero")
    return vector / length
