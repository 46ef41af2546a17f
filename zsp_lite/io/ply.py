"""Point clouds as PLY files."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, Real, UInt8

from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_SIZED_NAMES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_TYPES = dict(zip(_NAMES + _SIZED_NAMES, _CODES + _CODES, strict=True))
_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("red", "green", "blue")]
)


def write_ply(
    path: str | Path,
    points: Real[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
    normals: Real[np.ndarray, "n 3"] | None = None,
) -> None:
    """Write a cloud as CO3D does: binary, float positions and normals (zeros where none), 8-bit colours."""
    vertices = np.zeros(len(points), dtype=_VERTEX)
    for names, values in (
        ("xyz", points),
        (("nx", "ny", "nz"), normals),
        (("red", "green", "blue"), colours),
    ):
        if values is None:
            continue
        if np.shape(values) != (len(vertices), 3):
            raise InputError(
                f"point cloud {path} has {tuple(names)} of shape {np.shape(values)}, expected {(len(vertices), 3)}"
            )
        for axis, name in enumerate(names):
            vertices[name] = np.asarray(values)[:, axis]
    properties = "".join(
        f"property {'uchar' if _VERTEX[name] == np.uint8 else 'float'} {name}\n" for name in _VERTEX.names
    )
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}end_header\n"
    write_atomic(path, header.encode("ascii") + vertices.tobytes())


def read_ply(path: str | Path) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"] | None]:
    """Positions and, where the file has them, colours of a binary or ASCII PLY; the rest is left out.

    Colours stored as numbers in [0, 1] come back as 8 bit. Raises InputError where the file is missing, cut
    off, not a point cloud, or has positions that are not finite.
    """
    data = read_bytes(path, "point cloud")
    header, mark, body = data.partition(b"end_header")
    if not data.startswith(b"ply") or not mark:
        raise InputError(f"point cloud {path} has no PLY header ({len(data)} bytes)")
    try:
        vertices = _vertices(header.decode("ascii"), body.partition(b"\n")[2])
        points = np.stack([vertices[name] for name in "xyz"], axis=-1).astype(np.float64)
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"point cloud {path} cannot be read as PLY: {error}") from error
    if not np.isfinite(points).all():
        raise InputError(f"point cloud {path} has positions that are not finite")
    if not {"red", "green", "blue"} <= set(vertices.dtype.names):
        return points, None
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)
    if colours.dtype.kind == "f":
        colours = np.rint(colours * 255).clip(0, 255)
    return points, colours.astype(np.uint8)


def _vertices(header: str, body: bytes) -> np.ndarray:
    """The vertex element as a structured array; ValueError or KeyError says what does not fit."""
    encoding, count, names = "", None, []
    for words in map(str.split, header.splitlines()[1:]):
        if words[:1] == ["format"]:
            encoding = words[1]
        elif words[:1] == ["element"]:
            if count is not None:
                break  # what follows the vertices lies behind them in the file as well
            if words[1] != "vertex":
                raise ValueError(f"its first element is {words[1]!r}, expected 'vertex'")
            count = int(words[2])
        elif words[:1] == ["property"]:
            order = ">" if encoding == "binary_big_endian" else "<"
            names.append((words[2], order + _TYPES[words[1]]))
    if count is None:
        raise ValueError("it has no vertex element")
    dtype = np.dtype(names)
    if encoding == "ascii":
        rows = [tuple(map(float, line.split())) for line in body.decode("ascii").splitlines()[:count]]
        if len(rows) < count:
            raise ValueError(f"it holds {len(rows)} vertices, its header says {count}")
        return np.array(rows, dtype=dtype)
    if len(body) < count * dtype.itemsize:
        raise ValueError(f"it holds {len(body)} bytes, its header says {count * dtype.itemsize}")
    return np.frombuffer(body, dtype=dtype, count=count)
