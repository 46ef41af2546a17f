"""Conversion of AC3D models, FlightGear's format, to OBJ files with materials and textures.

Textures are looked for beside the model and in the given folders, and written as PNG beside the OBJ
file.
"""

import re
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

import numpy as np
from PIL import Image

from zsp_lite.errors import InputError

Material = dict[str, list[float]]  # the numbers after each keyword
Corners = list[tuple[int, float, float]]  # vertex, u, v


@dataclass
class Ac3dObject:
    """One object of the file, in the coordinates of the file's world."""

    vertices: np.ndarray  # (v, 3)
    texture: str | None  # name of the texture file
    faces: list[tuple[int, Corners]]  # polygons: index of the material, corners


def read_ac3d(path: Path) -> tuple[list[Material], list[Ac3dObject]]:
    """Return the materials and the objects of an AC3D file."""
    text = path.read_text("latin-1")
    # After a line "data N", N characters are a comment.
    while comment := re.search(r"(?m)^data (\d+)\n", text):
        text = text[: comment.start()] + text[comment.end() + int(comment[1]) :]
    lines = iter([line for line in text.splitlines() if line.strip()])
    if not next(lines, "").startswith("AC3D"):
        raise InputError(f"{path} does not begin with AC3D")
    materials: list[Material] = []
    objects: list[Ac3dObject] = []
    try:
        for line in lines:
            words = shlex.split(line)
            if words[:1] == ["MATERIAL"]:
                materials.append(_material(words[2:]))  # the second word is its name
            elif words[:1] == ["OBJECT"]:
                _read_object(lines, np.eye(3), np.zeros(3), objects)
    except (StopIteration, ValueError, LookupError) as error:
        raise InputError(f"{path} is damaged: {error!r}") from error
    return materials, objects


def convert(path: Path, out: Path, texture_folders: Sequence[Path] = ()) -> None:
    """Write an AC3D model as OBJ with MTL and PNG files; textures may be beside it or in
    `texture_folders`."""
    materials, objects = read_ac3d(path)
    out.parent.mkdir(parents=True, exist_ok=True)

    # Vertices, texture coordinates and faces. OBJ counts vertices and corners from 1 in the whole
    # file. `names` has the OBJ material of each combination of material and texture.
    obj = [f"mtllib {out.stem}.mtl"]
    names = {}
    vertex_start = 1
    corner_start = 1
    for part in objects:
        obj += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in part.vertices.tolist()]
        for material, corners in part.faces:
            name = names.setdefault((material, part.texture), f"m{len(names)}")
            obj += [f"vt {u:.6f} {v:.6f}" for _, u, v in corners]
            face = "f"
            for corner, (vertex, _, _) in enumerate(corners, corner_start):
                face += f" {vertex_start + vertex}/{corner}"
            obj += [f"usemtl {name}", face]
            corner_start += len(corners)
        vertex_start += len(part.vertices)

    # Materials. Where the model says nothing: white, opaque, with a broad highlight.
    mtl = []
    for (index, texture), name in names.items():
        material = materials[index]
        diffuse = " ".join(map(str, material.get("rgb", [1, 1, 1])))
        specular = " ".join(map(str, material.get("spec", [1, 1, 1])))
        mtl += [
            f"newmtl {name}",
            f"Kd {diffuse}",
            f"Ks {specular}",
            f"Ns {material.get('shi', [10])[0]}",
            f"d {1 - material.get('trans', [0])[0]}",
        ]
        if texture:
            mtl.append(f"map_Kd {_write_texture(texture, path, out.parent, texture_folders)}")
    out.with_suffix(".mtl").write_text("\n".join(mtl) + "\n")
    out.write_text("\n".join(obj) + "\n")


def _material(words: list[str]) -> Material:
    """Parse a MATERIAL line: each keyword is followed by its numbers."""
    material: Material = {}
    keyword = ""
    for word in words:
        if word.isalpha():
            keyword = word
            material[keyword] = []
        else:
            material[keyword].append(float(word))
    return material


def _read_object(
    lines: Iterator[str], rotation: np.ndarray, shift: np.ndarray, objects: list[Ac3dObject]
) -> None:
    """Read one object and its children, which move with it."""
    turn = np.eye(3)
    offset = np.zeros(3)
    vertices = np.zeros((0, 3))
    texture = None
    repeat = (1, 1)
    displacement = (0, 0)
    faces: list[tuple[int, Corners]] = []
    for line in lines:
        # Few lines have names in quotes; `shlex` is much slower than `str.split`.
        keyword, *rest = shlex.split(line) if '"' in line else line.split()
        if keyword == "loc":
            offset = np.array(rest, float)
        elif keyword == "rot":
            # The rows of the file are the images of the axes.
            turn = np.array(rest, float).reshape(3, 3).T
        elif keyword == "texture":
            texture = rest[0]
        elif keyword == "texrep":
            repeat = float(rest[0]), float(rest[1])
        elif keyword == "texoff":
            displacement = float(rest[0]), float(rest[1])
        elif keyword == "numvert":
            rows = [next(lines).split()[:3] for _ in range(int(rest[0]))]
            vertices = np.array(rows, float).reshape(-1, 3)
        elif keyword == "SURF":
            # The low four bits are the kind of the surface: 0 is a polygon, others are lines.
            is_polygon = int(rest[0], 16) & 0xF == 0
            material, corners = _read_surface(lines, repeat, displacement)
            if is_polygon and len(corners) >= 3:
                faces.append((material, corners))
        elif keyword == "kids":  # the last entry of an object
            shift = shift + rotation @ offset
            rotation = rotation @ turn
            if faces:
                objects.append(Ac3dObject(vertices @ rotation.T + shift, texture, faces))
            for _ in range(int(rest[0])):
                line = next(lines, None)
                if line is None:  # Some exporters count more children than they write.
                    return
                if not line.startswith("OBJECT"):
                    raise ValueError(f"expected a child object, got {line!r}")
                _read_object(lines, rotation, shift, objects)
            return
    raise ValueError("the file ends inside an object")


def _read_surface(
    lines: Iterator[str], repeat: tuple[float, float], displacement: tuple[float, float]
) -> tuple[int, Corners]:
    """Read the index of the material and the corners (vertex, u, v) of a surface."""
    material = 0
    corners = []
    for line in lines:
        keyword, *values = line.split()
        if keyword == "mat":
            material = int(values[0])
        elif keyword == "refs":
            for _ in range(int(values[0])):
                vertex, u, v = next(lines).split()[:3]
                u = float(u) * repeat[0] + displacement[0]
                v = float(v) * repeat[1] + displacement[1]
                corners.append((int(vertex), u, v))
            break
    return material, corners


def _write_texture(texture: str, model: Path, out: Path, folders: Sequence[Path]) -> str:
    """Write a texture of a model as PNG and return the name of the file."""
    name = PureWindowsPath(texture).name
    for folder in (model.parent, *folders):
        if (folder / name).is_file():
            written = Path(name).stem + ".png"
            with Image.open(folder / name) as image:
                image.convert("RGBA").save(out / written)
            return written
    raise InputError(f"model {model} lacks its texture {name!r}")
