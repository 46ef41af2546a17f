"""Point clouds as PLY files."""

import io
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Real, UInt8

from zsp_lite.errors import InputError, check_magnitude
from zsp_lite.io.files import read_bytes, write_atomic

_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])


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
    from trimesh.exchange.ply import load_ply  # takes a quarter of a second

    data = read_bytes(path, "point cloud")
    try:
        content = load_ply(io.BytesIO(data), skip_materials=True)
        points = content["vertices"].astype(np.float64)
        (count,) = re.findall(rb"element vertex (\d+)", data.partition(b"end_header")[0])
        if not 0 < len(points) == int(count):
            raise ValueError(f"{len(points)} of {int(count)} vertices")
    except Exception as error:  # whatever is malformed
        raise InputError(
            f"point cloud {path} ({len(data)} bytes) is not a complete PLY file: {error!r}"
        ) from error
    check_magnitude(f"point cloud {path}", points)
    return points, _colours(content.get("vertex_colors"))


def _colours(stored: Real[np.ndarray, "n c"] | None) -> UInt8[np.ndarray, "n 3"] | None:
    """Convert colours of 8 or 16 bits, or floats up to 1 or 255; None if there are none."""
    if stored is None:
        return None
    colours = np.where(np.isfinite(stored), stored, 0.0)[:, :3]
    if stored.dtype == np.uint16 and colours.max(initial=0) > 255:
        colours /= 257  # 65535 / 255
    elif stored.dtype.kind == "f" and colours.max(initial=0) < 1.01:  # rounding may exceed 1
        colours *= 255
    return colours.round().clip(0, 255).astype(np.uint8)
