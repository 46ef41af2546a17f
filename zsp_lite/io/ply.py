"""Point clouds as PLY files."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, Real, UInt8

from zsp_lite.errors import InputError, check_magnitude
from zsp_lite.io.files import read_bytes, write_atomic

_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
# numpy's types by their names in PLY. Some programs write numpy's own names, such as float32.
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}


def write_ply(
    path: str | Path,
    points: Real[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
    normals: Real[np.ndarray, "n 3"] | None = None,
) -> None:
    """Write a point cloud as CO3D does: binary, float32 positions and normals, 8-bit colours.

    Normals that are not given are zeros.
    """
    check_magnitude(f"point cloud {path}", points)
    vertices = np.zeros(len(points), dtype=_VERTEX)
    vertices["position"] = points
    vertices["colour"] = colours
    if normals is not None:
        vertices["normal"] = normals
    header = (
        "ply\n"
        "format binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\n"
        "property float x\n"
        "property float y\n"
        "property float z\n"
        "property float nx\n"
        "property float ny\n"
        "property float nz\n"
        "property uchar red\n"
        "property uchar green\n"
        "property uchar blue\n"
        "end_header\n"
    )
    write_atomic(path, header.encode("ascii") + vertices.tobytes())


def read_ply(
    path: str | Path,
) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"] | None]:
    """Read the positions and 8-bit colours (None if there are none) of a PLY file."""
    data = read_bytes(path, "point cloud")
    try:
        columns = _vertex_columns(data)
        points = np.stack([columns[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        colours = _colours(columns)
    except Exception as error:  # ValueError, KeyError, TypeError and others, whatever is malformed
        raise InputError(
            f"point cloud {path} ({len(data)} bytes) is not a complete PLY file: {error!r}"
        ) from error
    check_magnitude(f"point cloud {path}", points)
    return points, colours


def _vertex_columns(data: bytes) -> dict[str, np.ndarray]:
    """Return the properties of the vertices, which must be the first element of a PLY file.

    A malformed file raises ValueError, KeyError, TypeError or another error.
    """
    header, _, rest = data.partition(b"end_header")
    body = rest[rest.index(b"\n") + 1 :]

    # The header has names and numbers of all elements; the types of the first element's properties
    # are kept.
    encoding = ""
    elements = []
    types = {}
    for line in header.decode("latin-1").splitlines():
        match line.split():
            case ["format", encoding, _]:
                pass
            case ["element", name, count]:
                elements.append((name, int(count)))
            case ["property", kind, name] if len(elements) == 1:
                types[name] = np.dtype(_TYPES.get(kind, kind))
            case ["property", *_] if len(elements) == 1:
                raise ValueError(f"{line!r} for a vertex, expected one value")
    (name, count), *others = elements
    if name != "vertex" or count < 1:
        raise ValueError(f"{count} x {name!r} first, expected vertices")

    # The body: one column per property, as text or as packed records.
    if encoding == "ascii":
        table = np.array(body.split()[: count * len(types)], np.float64).reshape(count, len(types))
        return {name: column.astype(kind) for (name, kind), column in zip(types.items(), table.T)}
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    vertex = np.dtype([(name, kind.newbyteorder(order)) for name, kind in types.items()])
    if not others and len(body) != count * vertex.itemsize:
        raise ValueError(f"{len(body)} bytes for {count} vertices of {vertex.itemsize}")
    vertices = np.frombuffer(body, vertex, count)
    return {name: vertices[name] for name in types}


def _colours(columns: dict[str, np.ndarray]) -> UInt8[np.ndarray, "n 3"] | None:
    """Return 8-bit colours of 16-bit ones or numbers to 1 or 255; None if there are none."""
    if not {"red", "green", "blue"} <= columns.keys():
        return None
    stored = np.stack([columns[name] for name in ("red", "green", "blue")], axis=-1)
    colours = np.where(np.isfinite(stored), stored, 0.0)
    if stored.dtype == np.uint16 and colours.max(initial=0) > 255:
        colours /= 257
    elif stored.dtype.kind == "f" and colours.max(initial=0) < 1.01:  # rounding may exceed 1
        colours *= 255
    return colours.round().clip(0, 255).astype(np.uint8)
