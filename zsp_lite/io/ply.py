"""Reading and writing of point clouds in PLY files."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Real, UInt8

from zsp_lite.errors import InputError, check_magnitude
from zsp_lite.io.files import read_bytes, write_atomic

_COLOURS = ("red", "green", "blue")
_VERTEX = np.dtype([(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in _COLOURS])


def write_ply(
    path: str | Path,
    points: Real[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
    normals: Real[np.ndarray, "n 3"] | None = None,
) -> None:
    """Write a point cloud in CO3D's form: binary, float32 positions and normals (or zeros), 8-bit colours.

    Written here rather than by trimesh, because the sample data must be reproducible byte for byte. InputError if a
    position is above 1e9 or not finite.
    """
    check_magnitude(f"point cloud {path}", points)
    vertices = np.zeros(len(points), dtype=_VERTEX)
    normals = np.zeros((len(points), 3)) if normals is None else normals
    for names, values in ((("x", "y", "z"), points), (("nx", "ny", "nz"), normals), (_COLOURS, colours)):
        for name, column in zip(names, np.asarray(values).T):
            vertices[name] = column
    properties = "".join(f"property {'uchar' if name in _COLOURS else 'float'} {name}\n" for name in _VERTEX.names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}end_header\n"
    write_atomic(path, header.encode("ascii") + vertices.tobytes())


def read_ply(path: str | Path) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"] | None]:
    """Read the vertices of a binary or ASCII PLY file.

    Returns:
        Positions (n, 3), and 8-bit RGB colours (n, 3) or None if the file has none. Colours are rescaled from [0, 1]
        if they are floats of at most 1, from [0, 65535] if any is above 255, and are taken as [0, 255] otherwise.

    Raises:
        InputError: The file is missing, damaged or empty, or has positions that are not finite or above 1e9.
    """
    data = read_bytes(path, "point cloud")
    try:
        points, colours = _parse(data)
    except Exception as error:  # trimesh raises IndexError, KeyError and others for malformed files
        raise InputError(f"point cloud {path} ({len(data)} bytes) is not a complete PLY file: {error!r}") from error
    check_magnitude(f"point cloud {path}", points)
    return points, colours


def _parse(data: bytes) -> tuple[np.ndarray, np.ndarray | None]:
    from trimesh.exchange.ply import load_ply  # takes 0.5 s to import

    loaded = load_ply(io.BytesIO(data), fix_texture=False, skip_materials=True)
    colours = loaded["vertex_colors"]
    return loaded["vertices"].astype(np.float64), None if colours is None else _to_8_bit(colours[:, :3])


def _to_8_bit(colours: np.ndarray) -> UInt8[np.ndarray, "n 3"]:
    is_unit = colours.dtype.kind == "f" and colours.max() <= 1
    white = 1 if is_unit else 255 if colours.max() <= 255 else 65535
    return np.rint(colours * (255 / white)).clip(0, 255).astype(np.uint8)
