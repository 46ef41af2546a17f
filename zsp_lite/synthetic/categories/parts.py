"""Compound parts that several categories share."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.primitives import Mesh, cylinder, extrusion

Y = (0.0, 1.0, 0.0)


def rounded_box(size, centre=(0, 0, 0), squareness: float = 5.0) -> Mesh:
    """Return a superellipsoid of the given size (3,): an ellipsoid at squareness 2, nearly a box at 10."""
    n = 11  # points along a side of a cube, denser at the edges, where the curvature is largest
    line = np.sin(np.linspace(-np.pi / 2, np.pi / 2, n))
    u, v = (grid.ravel() for grid in np.meshgrid(line, line, indexing="ij"))
    corner = np.arange(n * n).reshape(n, n)[:-1, :-1].ravel()  # of each cell, the one with the lowest index
    cells = np.concatenate([corner[:, None] + [0, n, n + 1], corner[:, None] + [0, n + 1, 1]])
    sides = [np.stack([np.full(n * n, sign), sign * u, v], 1) for sign in (-1.0, 1.0)]
    vertices = np.concatenate([np.roll(side, axis, axis=1) for axis in range(3) for side in sides])
    faces = np.concatenate([cells + side * n * n for side in range(6)])
    vertices /= (np.abs(vertices) ** squareness).sum(1, keepdims=True) ** (1 / squareness)
    return Mesh(vertices, faces).scaled(np.asarray(size) / 2).translated(centre)


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


def disc(radius: float, thickness: float, centre) -> Mesh:
    """Return a disc at `centre` whose axis is y, for example a wheel."""
    return cylinder(radius, radius, thickness, 22).rotated("x", np.pi / 2).translated(centre)


def add_wheels(a: Assembly, x: float, y: float, radius: float, width: float) -> None:
    """Add the two wheels of an axle at x, standing on the ground at y and -y."""
    a.add(disc(radius, width, (x, y, radius)), 3, mirror=True)
    a.add(disc(radius * 0.6, width * 1.2, (x, y, radius)), 2, mirror=True)
