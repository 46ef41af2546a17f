"""Folders of models as textured meshes.

A model is a file `FOLDER/CATEGORY/NAME.obj` or `FOLDER/CATEGORY/NAME/FILE.obj`, or of another
format. The optional file `models.json` gives the orientation and the origin of each model, see
`ModelInfo`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from jaxtyping import Float, Int, UInt8

from zsp_lite.course.synthetic.primitives import (
    Faces,
    Mesh,
    Vertices,
    area_normals,
    box_centre,
    joined,
    surface_spread,
    unit,
)
from zsp_lite.course.synthetic.textures import linear_to_srgb
from zsp_lite.errors import InputError, check_magnitude, rotation_matrix
from zsp_lite.io.files import file_size, plain_name, read_bytes, read_json

EXTENSIONS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".dae")
MAX_BYTES = 300_000_000  # of a model file
MAX_FACES = 2_000_000
_TEXTURE_SIZE = 1024  # longer side in pixels; larger textures are reduced
_CREASE = np.cos(np.radians(40))  # edges sharper than this stay sharp
_FACES_PER_POINT = 32  # largest number of faces at a point that its normals take into account
_INVISIBLE = 0.02  # opacity below which a face is removed
MODELS_FILE = "models.json"
_AXES = dict(zip(["+x", "+y", "+z", "-x", "-y", "-z"], np.vstack([np.eye(3), -np.eye(3)])))
_Direction = Literal["+x", "-x", "+y", "-y", "+z", "-z"] | tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Material:
    """Surface of a part of a mesh.

    Its colour is the product of three: of the material, of the texture and of the pattern.
    """

    # sRGB with opacity, in [0, 1]; an opacity below 1 lets the room shine through
    colour: Float[np.ndarray, "4"]
    # rows from top to bottom; opacity below 128 means a hole
    texture: UInt8[np.ndarray, "h w 4"] | None = None
    # sRGB colours (n, 3) of points (n, 3) in object coordinates
    pattern: Callable[[np.ndarray], np.ndarray] | None = None
    specular: float = 0.04  # reflectance at normal incidence
    roughness: float = 0.7  # as in glTF: 0 for a mirror, 1 for a matte surface


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A triangle mesh with materials."""

    vertices: Vertices
    faces: Faces
    normals: Float[np.ndarray, "f 3 3"]  # unit shading normal of each corner of each face
    # of each corner; (0, 0) is the lower left corner of the texture, which repeats
    uv: Float[np.ndarray, "f 3 2"]
    # sRGB in [0, 1] of each corner, a factor of the material's colour
    colours: Float[np.ndarray, "f 3 3"]
    material: Int[np.ndarray, " f"]  # index of each face
    materials: tuple[Material, ...] = ()


class ModelInfo(msgspec.Struct, frozen=True, omit_defaults=True):
    """Entry of `models.json` for one model; every field is optional."""

    front: _Direction | None = None  # in the axes of the file
    up: _Direction | None = None
    author: str = ""
    licence: str = ""
    source: str = ""
    changes: str = ""  # with respect to the source

    def axes(self, extension: str) -> Float[np.ndarray, "3 3"]:
        """Return the rotation from the file's axes to the canonical: front +x, left +y, up +z."""
        # Axes that `models.json` does not name are those of the format: STL's, or glTF's.
        front, up = ("-y", "+z") if extension.lower() == ".stl" else ("+z", "+y")
        front = self.front or front
        up = self.up or up
        x = _unit_vector(front)
        z = _unit_vector(up)
        return rotation_matrix(
            f"front {front} and up {up}: the axes", np.stack([x, np.cross(z, x), z])
        )


def _unit_vector(direction: _Direction) -> Float[np.ndarray, "3"]:
    """Return a direction in the axes of a file as a vector."""
    vector = _AXES[direction] if isinstance(direction, str) else np.array(direction)
    # A vector of zeros stays one, which `rotation_matrix` refuses.
    return vector / max(np.linalg.norm(vector), 1e-6)


@dataclass(frozen=True)
class Model:
    """One model of a folder: its category, name, file and entry of `models.json`."""

    category: str
    name: str
    path: Path
    info: ModelInfo


def list_models(folder: str | Path, front: str | None = None, up: str | None = None) -> list[Model]:
    """Return the models of a folder, sorted by category and name.

    Args:
        folder: with a folder per category.
        front: axis such as "+z" that points to the front of models without an entry `front`; by
            default the front axis of their format.
        up: axis that points up, for models without an entry `up`.

    Raises:
        InputError: if there is no model, two files of one model, or an entry without a file.
    """
    folder = Path(folder)
    listing = folder / MODELS_FILE
    infos = read_json(listing, dict[str, ModelInfo], "model list") if listing.is_file() else {}
    models = {}
    files = [(path.parent.name, path.stem, path) for path in folder.glob("*/*")]
    files += [(path.parts[-3], path.parts[-2], path) for path in folder.glob("*/*/*")]
    for category, name, path in sorted(files):
        if path.suffix.lower() not in EXTENSIONS or not path.is_file():
            continue
        key = f"{category}/{name}"
        if key in models:
            raise InputError(
                f"model {key} has two files, {models[key].path.name} and {path.name}, expected one"
            )
        info = infos.pop(key, ModelInfo())
        info = msgspec.structs.replace(info, front=info.front or front, up=info.up or up)
        models[key] = Model(plain_name(category, "category"), plain_name(name, "model"), path, info)
    if not models:
        problem = "holds no model" if folder.is_dir() else "does not exist"
        raise InputError(
            f"{folder} {problem}, expected CATEGORY/NAME.EXT or CATEGORY/NAME/FILE.EXT with EXT "
            f"one of {', '.join(EXTENSIONS)}"
        )
    # The loop has removed the entries of all models that have a file.
    if infos:
        raise InputError(f"{listing} names {min(infos)!r}, which has no file in {folder}")
    return [models[key] for key in sorted(models)]


def read_mesh(path: str | Path) -> TexturedMesh:
    """Read a mesh file with its textures, in the axes and the unit of the file.

    Args:
        path: of a file with one of `EXTENSIONS`.

    Returns:
        Its visible faces.

    Raises:
        InputError: if the file is too large, damaged, or has no visible face.
    """
    import trimesh  # slow to import

    path = Path(path)
    file_size(path, "model", MAX_BYTES)
    missing = _missing(path)
    if missing:
        raise InputError(f"model {path} lacks {missing}")
    parts = []
    try:
        scene = trimesh.load_scene(path, process=False)
        for node in scene.graph.nodes_geometry:
            transform, name = scene.graph[node]
            geometry = scene.geometry[name]
            # Geometries of points or lines have no faces.
            if len(getattr(geometry, "faces", ())):
                parts.append(_part(geometry, transform))
    except Exception as error:  # trimesh raises many types of exceptions for damaged files
        raise InputError(f"model {path} cannot be read: {type(error).__name__}: {error}") from error
    n_faces = [len(mesh.faces) for mesh, *_ in parts]
    if not 0 < sum(n_faces) <= MAX_FACES:
        raise InputError(f"model {path} has {sum(n_faces):,} faces, expected 1 to {MAX_FACES:,}")
    meshes, uv, colours, materials = zip(*parts)
    vertices, faces = joined(meshes)
    material = np.repeat(np.arange(len(parts)), n_faces)
    check_magnitude(f"model {path}: vertices", vertices)

    # Faces without an area and nearly transparent faces are removed, then vertices without a face.
    # Areas, here twofold, are in squares of the longest side.
    area = np.linalg.norm(area_normals(vertices / _size(vertices), faces), axis=1)
    opacity = np.array([part_material.colour[3] for part_material in materials])
    visible = (area > 1e-12) & (opacity[material] >= _INVISIBLE)
    if not visible.any():
        raise InputError(f"model {path} has no visible face with an area")
    used, faces = np.unique(faces[visible], return_inverse=True)
    vertices = vertices[used]
    faces = faces.reshape(-1, 3)
    return TexturedMesh(
        vertices,
        faces,
        smooth_normals(vertices, faces),
        np.concatenate(uv)[visible],
        np.concatenate(colours)[visible],
        material[visible],
        materials,
    )


def canonical_mesh(mesh: TexturedMesh, rotation: Float[np.ndarray, "3 3"]) -> TexturedMesh:
    """Rotate a mesh, centre its bounding box, and scale its surface to unit spread."""
    vertices = mesh.vertices @ rotation.T
    vertices = vertices - box_centre(vertices)
    spread = surface_spread(vertices, mesh.faces)
    return replace(
        mesh, vertices=vertices / spread, normals=(mesh.normals @ rotation.T).astype(np.float32)
    )


def _missing(path: Path) -> str:
    """Name the package or the file that is missing to read a model; trimesh would skip it."""
    if path.suffix.lower() == ".dae" and not find_spec("collada"):
        return "the package pycollada: pip install pycollada"
    if path.suffix.lower() != ".obj":
        return ""
    for name in _values(path, b"mtllib"):
        library = path.parent / name
        if not library.is_file():
            return f"its material file {name!r}"
        # Of the textures of a material file, trimesh reads this one only.
        for texture in _values(library, b"map_kd"):
            if not (library.parent / texture).is_file():
                return f"its texture {texture!r}"
    return ""


def _values(path: Path, key: bytes) -> list[str]:
    """Return the values of the lines that begin with a keyword, given in lower case."""
    values = []
    for line in read_bytes(path, "model").splitlines():
        words = line.split(maxsplit=1)
        if len(words) == 2 and words[0].lower() == key:
            values.append(words[1].decode(errors="replace").strip())
    return values


def _part(mesh: Any, transform: np.ndarray) -> tuple[Mesh, np.ndarray, np.ndarray, Material]:
    """Return a `trimesh.Trimesh` as mesh, texture coordinates, colours and material.

    Texture coordinates and colours belong to the corners of the faces.
    """
    faces = np.asarray(mesh.faces, np.int64)
    visual = mesh.visual
    vertices = np.asarray(mesh.vertices, float) @ transform[:3, :3].T + transform[:3, 3]
    uv = np.zeros((len(faces), 3, 2), np.float32)
    colours = np.ones((len(faces), 3, 3), np.float32)
    material = Material(np.ones(4))
    if visual.kind == "texture":
        if visual.uv is not None and len(visual.uv) == len(vertices):
            uv = np.nan_to_num(np.asarray(visual.uv, np.float32))[faces]
        material = _material(visual.material)
    elif visual.kind is None:  # the file gives no colour: light grey
        material = Material(np.array([0.6, 0.6, 0.6, 1.0]))
    else:  # colours of vertices or of faces
        colours = (np.asarray(visual.vertex_colors)[faces][..., :3] / 255).astype(np.float32)
    return Mesh(vertices, faces), uv, colours, material


def _material(given: Any) -> Material:
    """Convert a material of trimesh: a Phong material of OBJ or COLLADA, or a material of glTF."""
    if hasattr(given, "baseColorFactor"):
        return _gltf_material(given)
    colour = _rgba(given.diffuse)
    texture = _image(given.image)
    if texture is not None and colour[:3].max() < 0.02:
        colour[:3] = 1  # some exporters write black beside a texture, and mean white
    # Lines of the material file by keyword, as lists of words: "d" is the opacity, "tr" the
    # transparency.
    keys = given.kwargs
    opacity = 1.0
    if "d" in keys:
        opacity = float(keys["d"][-1])
    elif "tr" in keys:
        opacity = 1 - float(keys["tr"][-1])
    colour[3] = np.clip(opacity, 0, 1)
    # The reflectance is 0.02 for black Ks to 0.14 for white; without Ks as for 0.2. These numbers
    # are chosen by hand.
    specular = _rgba(given.specular)[:3].mean() if "ks" in keys else 0.2
    # Phong's exponent n as roughness: n = 2 / roughness^4 - 2.
    roughness = (2 / (max(float(given.glossiness), 1) + 2)) ** 0.25
    return Material(colour, texture, specular=0.02 + 0.12 * float(specular), roughness=roughness)


def _gltf_material(given: Any) -> Material:
    """Convert a material of glTF, whose missing factors are 1."""
    colour = np.ones(4) if given.baseColorFactor is None else _rgba(given.baseColorFactor)
    colour[:3] = linear_to_srgb(colour[:3])
    texture = _image(given.baseColorTexture)
    if (given.alphaMode or "OPAQUE").upper() == "OPAQUE":
        colour[3] = 1
        if texture is not None:
            texture[..., 3] = 255
    metallic = 1.0 if given.metallicFactor is None else float(given.metallicFactor)
    roughness = 1.0 if given.roughnessFactor is None else float(given.roughnessFactor)
    if given.metallicRoughnessTexture is not None:
        # The green channel is the roughness, the blue channel the metallic share.
        mean = _image(given.metallicRoughnessTexture).mean((0, 1)) / 255
        roughness *= float(mean[1])
        metallic *= float(mean[2])
    # The reflectance is 0.04 as for all dielectrics of glTF, and 0.4 for metals as in `assembly`.
    return Material(colour, texture, specular=0.04 + 0.36 * metallic, roughness=roughness)


def _rgba(colour: Any) -> Float[np.ndarray, "4"]:
    """Return a colour, given as three or four bytes or fractions, as fractions with opacity."""
    colour = np.asarray(colour)
    colour = colour / 255.0 if colour.dtype.kind in "ui" else colour.astype(float)
    return np.clip(np.append(colour, 1.0)[:4], 0, 1)


def _image(image: Any) -> UInt8[np.ndarray, "h w 4"] | None:
    """Return a PIL image as RGBA bytes, of at most `_TEXTURE_SIZE` pixels along its longer side."""
    if image is None:
        return None
    image = image.convert("RGBA")
    image.thumbnail((_TEXTURE_SIZE, _TEXTURE_SIZE))
    return np.array(image)


def _size(vertices: np.ndarray) -> float:
    """Return the longest side of the bounding box, at least a tiny one."""
    return max(float(np.ptp(vertices, axis=0).max()), 1e-30)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "f 3 3"]:
    """Return for each corner the mean normal of the faces that meet there below 40 degrees."""
    unit_size = vertices / _size(vertices)
    weighted = area_normals(unit_size, faces)
    normal = unit(weighted)
    # Faces meet where their corners are at the same point, even if they share no vertex. Corners
    # 3 f to 3 f + 2 belong to face f; `by_point` lists them point by point.
    _, point = np.unique(np.round(unit_size, 6), axis=0, return_inverse=True)
    point = point.ravel()[faces.ravel()]
    by_point = np.argsort(point, kind="stable")
    count = np.bincount(point)
    start = np.cumsum(count) - count  # where the corners of each point start in `by_point`
    total = np.zeros((len(point), 3))
    # In each step, every corner meets the step-th corner of its point, if there is one.
    for step in range(min(count.max(), _FACES_PER_POINT)):
        corner = np.flatnonzero(count[point] > step)
        other_face = by_point[start[point[corner]] + step] // 3
        smooth = np.einsum("nd,nd->n", normal[corner // 3], normal[other_face]) > _CREASE
        total[corner[smooth]] += weighted[other_face[smooth]]
    # At a point of more than _FACES_PER_POINT faces, a corner may have met none, not even its own
    # face; it keeps the normal of that face.
    normals = unit(np.where(total.any(1, keepdims=True), total, np.repeat(normal, 3, axis=0)))
    return normals.reshape(-1, 3, 3).astype(np.float32)
