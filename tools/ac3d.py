"""Conversion of AC3D models, FlightGear's format, to OBJ files with materials and textures.

Textures are looked for beside the model and in the given folders, and written as PNG beside the OBJ
file.
"""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from zsp_lite.errors import InputError


@dataclass
class Ac3dObject:
    """One object of the file, in the coordinates of the file's world."""

    vertices: np.ndarray  # (v, 3)
    texture: str | None  # its name
    # Polygons: index of the material, (vertex, u, v) of corners
    faces: list[tuple[int, list[tuple[int, float, float]]]]


def read_ac3d(path: Path) -> tuple[list[dict[str, list[float]]], list[Ac3dObject]]:
    """Return the materials (each a dict of numbers by keyword) and the objects of an AC3D file."""
    lines = iter(
        [line for line in path.read_bytes().decode("latin-1").splitlines() if line.strip()]
    )
    if not next(lines, "").startswith("AC3D"):
        raise InputError(f"{path} does not begin with AC3D")
    materials: list[dict[str, list[float]]] = []
    objects: list[Ac3dObject] = []
    try:
        for line in lines:
            words = shlex.split(line)
            if words[:1] == ["MATERIAL"]:
                materials.append(_material(words[2:]))
            elif words[:1] == ["OBJECT"]:
                _read_object(lines, np.eye(3), np.zeros(3), objects)
    except (StopIteration, ValueError, IndexError) as error:
        raise InputError(f"{path} is damaged: {error!r}") from error
    return materials, objects


def convert(path: Path, out: Path, texture_folders: Sequence[Path] = ()) -> None:
    """Write an AC3D model as OBJ with MTL and PNG files; textures may be beside it or in
    `texture_folders`."""
    materials, objects = read_ac3d(path)
    out.parent.mkdir(parents=True, exist_ok=True)
    obj, used, start, corner = [f"mtllib {out.stem}.mtl"], {}, 1, 1
    for part in objects:
        obj += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in part.vertices.tolist()]
        for material, corners in part.faces:
            name = used.setdefault((material, part.texture), f"m{len(used)}")
            obj += [f"vt {u:.6f} {v:.6f}" for _, u, v in corners]
            face = " ".join(
                f"{start + vertex}/{corner + k}" for k, (vertex, _, _) in enumerate(corners)
            )
            obj += [f"usemtl {name}", f"f {face}"]
            corner += len(corners)
        start += len(part.vertices)
    mtl = []
    for (index, texture), name in used.items():
        given = materials[index]
        numbers = {key: " ".join(map(str, given.get(key, [1, 1, 1]))) for key in ("rgb", "spec")}
        mtl += [
            f"newmtl {name}",
            f"Kd {numbers['rgb']}",
            f"Ks {numbers['spec']}",
            f"Ns {given.get('shi', [10])[0]}",
        ]
        mtl.append(f"d {1 - given.get('trans', [0])[0]}")
        if texture:
            mtl.append(f"map_Kd {_write_texture(texture, path, out.parent, texture_folders)}")
    out.with_suffix(".mtl").write_text("\n".join(mtl) + "\n")
    out.write_text("\n".join(obj) + "\n")


def _material(words: list[str]) -> dict[str, list[float]]:
    """Return the numbers after each keyword of a MATERIAL line."""
    found: dict[str, list[float]] = {}
    for word in words:
        if word.isalpha():
            found[word] = numbers = []
        else:
            numbers.append(float(word))
    return found


def _read_object(
    lines: Iterator[str], rotation: np.ndarray, shift: np.ndarray, objects: list[Ac3dObject]
) -> None:
    """Read one object and its children, which move with it."""
    turn, offset, vertices = np.eye(3), np.zeros(3), np.zeros((0, 3))
    texture, repeat, displacement = None, (1, 1), (0, 0)
    faces: list[tuple[int, list[tuple[int, float, float]]]] = []
    for line in lines:
        words = shlex.split(line) if '"' in line else line.split()
        keyword, rest = words[0], words[1:]
        if keyword == "loc":
            offset = np.array(rest, float)
        elif keyword == "rot":
            # rows of the file are the images of the axes
            turn = np.array(rest, float).reshape(3, 3).T
        elif keyword == "data":
            left = int(rest[0])
            while left > 0:
                left -= len(next(lines)) + 1
        elif keyword == "texture":
            texture = rest[0]
        elif keyword == "texrep":
            repeat = float(rest[0]), float(rest[1])
        elif keyword == "texoff":
            displacement = float(rest[0]), float(rest[1])
        elif keyword == "numvert":
            vertices = np.array(
                [next(lines).split()[:3] for _ in range(int(rest[0]))], float
            ).reshape(-1, 3)
        elif keyword == "SURF":
            is_polygon, material, corners = int(rest[0], 16) & 0xF == 0, 0, []
            for line_ in lines:
                key, *values = line_.split()
                if key == "mat":
                    material = int(values[0])
                elif key == "refs":
                    for _ in range(int(values[0])):
                        vertex, u, v = next(lines).split()[:3]
                        u, v = (
                            float(u) * repeat[0] + displacement[0],
                            float(v) * repeat[1] + displacement[1],
                        )
                        corners.append((int(vertex), u, v))
                    break
            if is_polygon and len(corners) >= 3:
                faces.append((material, corners))
        elif keyword == "kids":
            shift = shift + rotation @ offset
            rotation = rotation @ turn
            if faces:
                objects.append(Ac3dObject(vertices @ rotation.T + shift, texture, faces))
            for _ in range(int(rest[0])):
                line = next(lines, None)
                if line is None:  # some exporters count more children than they write
                    return
                if not line.startswith("OBJECT"):
                    raise ValueError(f"expected a child object, got {line!r}")
                _read_object(lines, rotation, shift, objects)
            return
    raise ValueError("the file ends inside an object")


def _write_texture(texture: str, model: Path, out: Path, folders: Sequence[Path]) -> str:
    name = texture.replace("\\", "/").split("/")[-1]
    for folder in (model.parent, *folders):
        if (folder / name).is_file():
            written = Path(name).stem + ".png"
            with Image.open(folder / name) as image:
                image.convert("RGBA").save(out / written)
            return written
    raise InputError(f"model {model} lacks its texture {name!r}")
