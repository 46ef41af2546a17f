"""Compound parts that several evaluation categories share."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.primitives import Mesh, cylinder, extrusion, rod

Y = (0.0, 1.0, 0.0)


def rounded_box(size, centre=(0, 0, 0), squareness: float = 5.0) -> Mesh:
    """Return a superellipsoid of the given size (3,): an ellipsoid at squareness 2, nearly a box at 10.

    Each side of a cube becomes a grid of 10 x 10 cells, denser at the edges, where the curvature is largest.
    """
    cells = 10
    line = np.sin(np.linspace(-np.pi / 2, np.pi / 2, cells + 1))
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij"))
    corner, row = i * (cells + 1) + j, cells + 1
    side = np.concatenate([np.stack([corner, corner + row, corner + row + 1], 1),
                           np.stack([corner, corner + row + 1, corner + 1], 1)])  # fmt: skip
    vertices, faces = [], []
    for axis in range(3):
        for sign in (-1, 1):
            points = np.stack([np.full(len(u), float(sign)), sign * u, v], 1)
            faces.append(side + len(vertices) * len(u))
            vertices.append(np.roll(points, axis, axis=1))
    vertices = np.concatenate(vertices)
    reach = (np.abs(vertices) ** squareness).sum(1, keepdims=True) ** (1 / squareness)
    return Mesh(vertices / reach, np.concatenate(faces)).scaled(np.asarray(size, float) / 2).translated(centre)


def tapered(mesh: Mesh, low: float, high: float, factor: float) -> Mesh:
    """Scale the width (y) of a mesh by 1 at height `low`, linearly to `factor` at height `high`."""
    share = np.clip((mesh.vertices[:, 2] - low) / (high - low), 0, 1)
    vertices = mesh.vertices.copy()
    vertices[:, 1] *= 1 + (factor - 1) * share
    return Mesh(vertices, mesh.faces)


def pane(start, end, width: float, thickness: float = 0.04) -> Mesh:
    """Return a slab between two points (x, z) of width `width` along y, for example a windscreen."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = (end - start) / np.linalg.norm(end - start)
    across = thickness / 2 * np.array([-along[1], along[0]])
    return extrusion([start - across, end - across, end + across, start + across], width)


def wheel_pair(a: Assembly, x: float, y: float, radius: float, width: float, tyre: int, hub: int) -> None:
    """Add a wheel with its hub on the floor at (x, y), and its mirror image."""
    upright = ("x", np.pi / 2)
    a.add(cylinder(radius, radius, width, 22).rotated(*upright).translated((x, y, radius)), tyre, mirror=True)
    a.add(
        cylinder(radius * 0.6, radius * 0.6, width * 1.2, 14).rotated(*upright).translated((x, y, radius)),
        hub,
        mirror=True,
    )


def bolt_circle(a: Assembly, centre, radius: float, count: int, size: float, material: int) -> None:
    """Add the bolts of a flange: small rods on a circle perpendicular to x."""
    for angle in np.arange(count) * 2 * np.pi / count:
        at = np.asarray(centre, float) + [0, radius * np.cos(angle), radius * np.sin(angle)]
        a.add(rod(at, at + [size, 0, 0], size, sides=6), material)
