"""Textured meshes from files: one record for OBJ, glTF, PLY, STL and COLLADA."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes
from zsp_lite.synthetic.assembly import surface_spread
from zsp_lite.synthetic.textures import linear_to_srgb

EXTENSIONS = (".obj", ".glb", ".gltf", ".ply", ".stl", ".dae")
MAX_BYTES = 300_000_000  # of a model file
MAX_FACES = 2_000_000
_TEXTURE_SIZE = 1024  # longer side in pixels; larger textures are reduced
_MAX_TEXTURE_PIXELS = 2**28
_CREASE = np.cos(np.radians(40))  # edges sharper than this stay sharp where the file has no normals
_HALF_CREASE = np.cos(np.radians(20))
_INVISIBLE = 0.02  # opacity below which a face is removed


@dataclass(frozen=True, eq=False)
class Material:
    """Surface of a part of a mesh; its colour is the product of `colour`, `texture` and `pattern`, all sRGB.

    A pattern maps points (n, 3) in object coordinates to colours (n, 3) in [0, 1].
    """

    colour: Float[np.ndarray, "4"]  # with opacity, in [0, 1]; an opacity below 1 means glass
    texture: UInt8[np.ndarray, "h w 4"] | None = None  # rows from top to bottom; opacity below 128 means a hole
    pattern: Callable[[np.ndarray], np.ndarray] | None = None
    specular: float = 0.04  # reflectance at normal incidence
    roughness: float = 0.7  # as in glTF: 0 for a mirror, 1 for a matte surface
    metallic: float = 0.0  # 1 for metals, whose reflection has the colour of the surface


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A triangle mesh with materials."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]  # indices of vertices
    normals: Float[np.ndarray, "f 3 3"]  # unit shading normal of each corner of each face
    uv: Float[np.ndarray, "f 3 2"]  # of each corner; (0, 0) is the lower left corner of the texture, which repeats
    colours: Float[np.ndarray, "f 3 3"]  # sRGB in [0, 1] of each corner, a factor of the material's colour
    material: Int[np.ndarray, " f"]  # index of each face
    materials: tuple[Material, ...]
    name: str = "mesh"  # for messages


def read_mesh(path: str | Path) -> TexturedMesh:
    """Read a mesh file with its textures, in the axes and the unit of the file.

    Raises InputError if the file cannot be read, is larger than `MAX_BYTES`, lacks a texture or pycollada, or holds no
    faces, more than `MAX_FACES` faces, or coordinates that are not finite.
    """
    import trimesh  # slow to import

    path = Path(path)
    if path.suffix.lower() not in EXTENSIONS:
        raise InputError(f"model {path} has the extension {path.suffix!r}, expected one of {', '.join(EXTENSIONS)}")
    if not path.is_file():
        raise InputError(f"model {path} does not exist")
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"model {path} has {path.stat().st_size:,} bytes, expected at most {MAX_BYTES:,}")
    if path.suffix.lower() == ".dae":
        _require_pycollada(path)
    if missing := _missing_textures(path):
        raise InputError(f"model {path} lacks its {missing[0]}")
    try:
        scene = trimesh.load_scene(path, process=False)
        parts = [
            _part(scene.geometry[name], scene.graph[node][0])
            for node in scene.graph.nodes_geometry
            for name in (scene.graph[node][1],)
            if isinstance(scene.geometry[name], trimesh.Trimesh) and len(scene.geometry[name].faces)
        ]
    except InputError as error:
        raise InputError(f"model {path}: {error}") from error
    except Exception as error:  # trimesh raises many types of exceptions for damaged files
        raise InputError(f"model {path} cannot be read: {type(error).__name__}: {error}") from error
    n_faces = sum(len(part.faces) for part in parts)
    if not 0 < n_faces <= MAX_FACES:
        raise InputError(f"model {path} has {n_faces:,} faces, expected 1 to {MAX_FACES:,}")
    mesh = replace(_joined(parts), name=str(path))
    return _cleaned(mesh)


def canonical_mesh(mesh: TexturedMesh, rotation: Float[np.ndarray, "3 3"]) -> TexturedMesh:
    """Rotate a mesh to front +x, left +y, up +z, centre its bounding box, and scale its surface to unit spread.

    The spread is the standard deviation of the surface, averaged over the three axes.
    """
    vertices = mesh.vertices @ rotation.T
    vertices = vertices - (vertices.max(0) + vertices.min(0)) / 2
    spread = surface_spread(vertices, mesh.faces)
    return replace(mesh, vertices=vertices / spread, normals=(mesh.normals @ rotation.T).astype(np.float32))


def _require_pycollada(path: Path) -> None:
    try:
        import collada  # noqa: F401
    except ImportError as error:
        raise InputError(f"model {path} needs the package pycollada: pip install pycollada") from error


def _missing_textures(path: Path) -> list[str]:
    """Return the files that an OBJ file refers to and that are missing; trimesh does not report them."""
    if path.suffix.lower() != ".obj":
        return []
    missing = []
    for line in _lines(path, b"mtllib"):
        library = path.parent / line
        if not library.is_file():
            missing.append(f"material file {line!r}")
            continue
        for key in (b"map_kd", b"map_d"):
            missing += [f"texture {name!r}" for name in _lines(library, key) if not (library.parent / name).is_file()]
    return missing


def _lines(path: Path, key: bytes) -> list[str]:
    """Return the values of the lines that begin with a keyword."""
    found = (line.strip().split(maxsplit=1) for line in read_bytes(path, "model").splitlines() if key in line.lower())
    return [words[1].decode(errors="replace").strip() for words in found if len(words) == 2 and words[0].lower() == key]


def _part(mesh, transform: np.ndarray) -> TexturedMesh:
    """Convert one geometry of a trimesh scene."""
    faces = np.asarray(mesh.faces, np.int64)
    vertices = np.asarray(mesh.vertices, float) @ transform[:3, :3].T + transform[:3, 3]
    if not np.isfinite(vertices).all() or np.abs(vertices).max() > 1e12:
        raise InputError("vertices are not finite, or beyond 1e12")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"faces refer to vertices {faces.min()} to {faces.max()}, expected 0 to {len(vertices) - 1}")
    given = mesh._cache.cache.get("vertex_normals")  # those of the file; the property would compute them
    if given is not None and np.shape(given) == vertices.shape and np.isfinite(given).all():
        # Normals transform with the cofactor matrix, which exists for mirrored and flattened parts as well.
        cofactor = np.stack([np.cross(transform[1, :3], transform[2, :3]), np.cross(transform[2, :3], transform[0, :3]),
                             np.cross(transform[0, :3], transform[1, :3])])  # fmt: skip
        normals = _unit((np.asarray(given) @ cofactor.T)[faces]).astype(np.float32)
        flat = _unit(
            np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
        )
        normals = np.where((np.abs(normals).sum(-1) > 0.1)[..., None], normals, flat[:, None].astype(np.float32))
    else:
        normals = smooth_normals(vertices, faces)
    uv, colours = np.zeros((len(faces), 3, 2), np.float32), np.ones((len(faces), 3, 3), np.float32)
    visual = mesh.visual
    if visual.kind == "texture":
        if visual.uv is not None and len(visual.uv) == len(vertices):
            uv = np.nan_to_num(np.asarray(visual.uv, np.float32))[faces]
        material = _material(visual.material)
    else:
        material = Material(np.array([0.6, 0.6, 0.6, 1.0]))
        if visual.kind is not None:
            material = Material(np.ones(4))
            colours = (np.asarray(visual.vertex_colors)[faces][..., :3] / 255).astype(np.float32)
    return TexturedMesh(vertices, faces, normals, uv, colours, np.zeros(len(faces), int), (material,))


def _material(given) -> Material:
    """Convert a material of trimesh: Phong's of an OBJ or COLLADA file, or glTF's."""
    if hasattr(given, "baseColorFactor"):
        colour = np.ones(4) if given.baseColorFactor is None else _rgba(given.baseColorFactor)
        colour = np.append(linear_to_srgb(colour[:3]), colour[3])  # glTF's factors are linear
        metallic, roughness = (
            1.0 if value is None else float(value) for value in (given.metallicFactor, given.roughnessFactor)
        )
        if given.metallicRoughnessTexture is not None:
            mean = _image(given.metallicRoughnessTexture).reshape(-1, 4).mean(0) / 255
            metallic, roughness = metallic * mean[2], roughness * mean[1]
        texture = None if given.baseColorTexture is None else _image(given.baseColorTexture)
        mode = (given.alphaMode or "OPAQUE").upper()
        if mode == "OPAQUE":
            colour[3] = 1
            texture = (
                None if texture is None else np.dstack([texture[..., :3], np.full(texture.shape[:2], 255, np.uint8)])
            )
        roughness = float(np.clip(roughness, 0.05, 1))
        return Material(colour, texture, roughness=roughness, metallic=float(metallic))
    colour = _rgba(given.diffuse)
    texture = None if given.image is None else _image(given.image)
    if texture is not None and colour[:3].max() < 0.02:
        colour = np.append(np.ones(3), colour[3])  # some exporters write black beside a texture, and mean white
    colour[3] = _opacity(given.kwargs)
    specular = _rgba(given.specular)[:3].mean() if "ks" in given.kwargs else 0.2
    glossiness = max(float(given.glossiness), 1.0)
    # Phong's exponent n as roughness: n = 2 / roughness^4 - 2.
    roughness = (2 / (glossiness + 2)) ** 0.25
    roughness = float(np.clip(roughness, 0.15, 1))
    return Material(colour, texture, specular=0.02 + 0.12 * float(specular), roughness=roughness)


def _opacity(keys: dict) -> float:
    """Return the opacity of a material of an OBJ file: `d`, or 1 - `Tr`."""
    for key, sign in (("d", 1), ("tr", -1)):
        try:
            value = float(keys[key][-1])
        except (KeyError, ValueError, TypeError, IndexError):
            continue
        return float(np.clip(value if sign > 0 else 1 - value, 0, 1))
    return 1.0


def _rgba(colour) -> np.ndarray:
    """Return a colour as (4,) floats in [0, 1]; bytes are divided by 255."""
    colour = np.asarray(colour)
    colour = colour / 255.0 if colour.dtype.kind in "ui" else colour.astype(float)
    return np.clip(np.append(colour, 1.0)[:4] if len(colour) < 4 else colour[:4], 0, 1)


def _image(image) -> UInt8[np.ndarray, "h w 4"]:
    """Return a PIL image as RGBA bytes, reduced to at most `_TEXTURE_SIZE` pixels along its longer side."""
    if image.width * image.height > _MAX_TEXTURE_PIXELS:
        raise InputError(f"texture of {image.width} x {image.height} pixels, expected at most {_MAX_TEXTURE_PIXELS:,}")
    pixels = np.asarray(image.convert("RGBA"))
    factor = _TEXTURE_SIZE / max(pixels.shape[:2])
    return pixels if factor >= 1 else cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)


def _joined(parts: list[TexturedMesh]) -> TexturedMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    counts = [len(part.faces) for part in parts]
    join = lambda field: np.concatenate([getattr(part, field) for part in parts])  # noqa: E731
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    materials = tuple(part.materials[0] for part in parts)
    material = np.repeat(np.arange(len(parts)), counts)
    return TexturedMesh(join("vertices"), faces, join("normals"), join("uv"), join("colours"), material, materials)


def _cleaned(mesh: TexturedMesh) -> TexturedMesh:
    """Remove invisible faces, faces without area, and vertices without faces. Raises InputError if none is left."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    size = float(np.ptp(mesh.vertices, axis=0).max())
    area = np.linalg.norm(np.cross((b - a) / size, (c - a) / size), axis=1) if size > 0 else np.zeros(len(a))
    opacity = np.array([material.colour[3] for material in mesh.materials])
    keep = (area > 1e-12) & (opacity[mesh.material] >= _INVISIBLE)
    if not keep.any():
        raise InputError(f"model {mesh.name} has no visible face with an area")
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    corners = {name: getattr(mesh, name)[keep] for name in ("normals", "uv", "colours", "material")}
    return replace(mesh, vertices=mesh.vertices[used], faces=faces.reshape(-1, 3), **corners)


def smooth_normals(vertices: np.ndarray, faces: np.ndarray) -> Float[np.ndarray, "f 3 3"]:
    """Return corner normals: the mean normal of the faces around the corner that meet at less than 40 degrees."""
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-30)
    point = _merged(np.round(vertices / size, 6))[faces.ravel()]  # of each corner
    a, b, c = (vertices[faces[:, i]] / size for i in range(3))
    weighted = np.cross(b - a, c - a)
    unit = _unit(weighted)
    total = np.stack([np.bincount(point, np.repeat(axis, 3)) for axis in weighted.T], 1)[point]
    # Where all faces around a point are within half the angle of their mean, all are averaged.
    bent = np.einsum("nd,nd->n", np.repeat(unit, 3, axis=0), _unit(total)) < _HALF_CREASE
    corner = np.flatnonzero(np.bincount(point, bent)[point])
    if len(corner):
        corner = corner[np.argsort(point[corner], kind="stable")]
        _, of, counts = np.unique(point[corner], return_inverse=True, return_counts=True)
        face, first = corner // 3, np.cumsum(counts) - counts
        total[corner] = 0
        several = np.arange(len(corner))
        for step in range(min(int(counts.max()), 32)):  # every corner with the step-th corner of its point
            several = several[counts[of[several]] > step]
            other = face[first[of[several]] + step]
            close = np.einsum("nd,nd->n", unit[face[several]], unit[other]) > _CREASE
            total[corner[several[close]]] += weighted[other[close]]
    alone = np.flatnonzero(np.abs(total).sum(1) == 0)
    total[alone] = unit[alone // 3]
    return _unit(total).reshape(-1, 3, 3).astype(np.float32)


def _merged(vertices: np.ndarray) -> np.ndarray:
    """Return the index of each vertex among the different positions."""
    order = np.lexsort(vertices.T)
    different = (np.diff(vertices[order], axis=0, prepend=np.nan) != 0).any(1)
    index = np.empty(len(vertices), np.int64)
    index[order] = np.cumsum(different) - 1
    return index


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
