"""Point clouds: PLY files, and the import of Open3D, for which all other modules call `load_open3d`."""

import ctypes
import functools
import io
import os
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Real, UInt8

from zsp_lite.errors import InputError, check_magnitude
from zsp_lite.io.files import read_bytes, write_atomic

_VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
_PROPERTIES = [*(f"float {one}" for one in "x y z nx ny nz".split()), "uchar red", "uchar green", "uchar blue"]


def write_ply(
    path: str | Path,
    points: Real[np.ndarray, "n 3"],
    colours: UInt8[np.ndarray, "n 3"],
    normals: Real[np.ndarray, "n 3"] | None = None,
) -> None:
    """Write a point cloud in CO3D's form: binary, float32 positions and normals (or zeros), 8-bit colours."""
    check_magnitude(f"point cloud {path}", points)
    vertices = np.zeros(len(points), dtype=_VERTEX)
    vertices["position"], vertices["colour"] = points, colours
    if normals is not None:
        vertices["normal"] = normals
    properties = "".join(f"property {one}\n" for one in _PROPERTIES)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}end_header\n"
    write_atomic(path, header.encode("ascii") + vertices.tobytes())


def read_ply(path: str | Path) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"] | None]:
    """Read the positions and 8-bit colours (None if there are none) of a PLY file; InputError if it is damaged."""
    from trimesh.exchange.ply import load_ply  # takes 0.5 s to import
    from trimesh.visual.color import to_rgba

    data = read_bytes(path, "point cloud")
    try:
        loaded = load_ply(io.BytesIO(data), fix_texture=False, skip_materials=True)
        points, colours = loaded["vertices"].astype(np.float64), loaded["vertex_colors"]
        if colours is not None:
            colours = to_rgba(colours)[:, :3]
    except Exception as error:  # trimesh raises IndexError, KeyError and others for malformed files
        raise InputError(f"point cloud {path} ({len(data)} bytes) is not a complete PLY file: {error!r}") from error
    check_magnitude(f"point cloud {path}", points)
    return points, colours


@functools.cache
def load_open3d():
    """Import and return the `open3d` module."""
    os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # it would start a server in a notebook
    # Open3D's Linux wheels link against libusb-1.0, which is often not installed: it is loaded from a package.
    if sys.platform.startswith("linux"):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    return open3d
