"""Small models on disk, made by the tests themselves."""

from pathlib import Path

import cv2
import numpy as np

from zsp_lite.course.synthetic.primitives import Mesh, box, joined
from zsp_lite.course.synthetic.room import CheapCamera, Room

# Two triangles in the plane z = 0 of the file, 2 x 2, seen upright from +z.
_QUAD = """mtllib {stem}.mtl
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl paint
f 1/1 2/2 3/3
f 1/1 3/3 4/4
"""


def write_quad(
    path: Path, texture: np.ndarray | None = None, colour=(1, 1, 1), opacity: float = 1.0
) -> Path:
    """Write a textured square as OBJ, MTL and PNG; `texture` is RGB or RGBA, rows from top to
    bottom."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_QUAD.format(stem=path.stem))
    lines = ["newmtl paint", "Kd {} {} {}".format(*colour), "Ks 0 0 0", "Ns 1", f"d {opacity}"]
    if texture is not None:
        lines.append(f"map_Kd {path.stem}.png")
        order = [2, 1, 0, 3][: texture.shape[2]]  # OpenCV writes BGR and BGRA
        cv2.imwrite(str(path.with_suffix(".png")), texture[..., order])
    path.with_suffix(".mtl").write_text("\n".join(lines) + "\n")
    return path


def wedge(seat: float = 0.5) -> Mesh:
    """An object without symmetry, like a chair: a seat, a back at the rear, one arm on the left and
    one leg at the front.

    Front +x, up +z; `seat` is the height of the seat.
    """
    parts = (
        box((1.2, 1.0, 0.2), (0, 0, seat)),
        box((0.2, 1.0, 1.2), (-0.5, 0, seat + 0.6)),
        box((0.8, 0.15, 0.4), (0.1, 0.45, seat + 0.25)),
        box((0.2, 0.2, seat), (0.3, 0, seat / 2)),
    )
    return Mesh(*joined(parts))


def write_wedge(path: Path, seat: float = 0.5) -> Path:
    """Write `wedge` in the default axes of an OBJ file: front +z, up +y."""
    mesh = wedge(seat)
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {y} {z} {x}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


def studio() -> Room:
    """Return plain, light grey surroundings with one soft light, for pictures of single models."""
    plain = np.full((8, 8, 3), 0.55, np.float32)
    light = np.array([0.6, 0.48, 0.64])  # a unit vector, towards the front, the left and above
    camera = CheapCamera(exposure=0.42, noise=0.0, vignetting=0.0)
    size = np.array([14.0, 14, 12])
    # The light is white, and has an angular radius of 0.15.
    return Room(size * [-1, -1, 0], size, (plain,) * 6, light, 0.15, np.ones(3), camera)
