"""Triangle meshes of simple solids, the parts of every procedural object."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

TAU = 2 * np.pi
# axes of the outline, and that of the thickness
_PLANES = {
    "xz": (0, 2, 1),
    "xy": (0, 1, 2),
    "yz": (1, 2, 0),
}


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: vertices in object units, and faces as indices of vertices."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]

    def translated(self, offset) -> "Mesh":
        """Return the mesh shifted by `offset` (3,)."""
        return Mesh(self.vertices + np.asarray(offset, float), self.faces)

    def scaled(self, factors) -> "Mesh":
        """Return the mesh scaled about the origin by `factors`, one number or (3,)."""
        return Mesh(self.vertices * np.asarray(factors, float), self.faces)

    def rotated(self, axis: str, angle: float) -> "Mesh":
        """Return the mesh rotated about the axis "x", "y" or "z" through the origin, right-handed,
        in radians."""
        i = "xyz".index(axis)
        j, k = (i + 1) % 3, (i + 2) % 3
        R = np.eye(3)
        R[j, j] = R[k, k] = np.cos(angle)
        R[j, k] = -np.sin(angle)
        R[k, j] = np.sin(angle)
        return Mesh(self.vertices @ R.T, self.faces)

    def pointing(self, direction) -> "Mesh":
        """Return the mesh rotated so that its z axis points along `direction` (3,)."""
        z = np.asarray(direction, float) / np.linalg.norm(direction)
        x = np.cross([0, 1, 0] if abs(z[1]) < 0.9 else [1, 0, 0], z)
        x /= np.linalg.norm(x)
        return Mesh(self.vertices @ np.stack([x, np.cross(z, x), z]), self.faces)

    def mirrored(self) -> "Mesh":
        """Return the mirror image in the plane y = 0; faces are reversed so that normals still
        point outwards."""
        return Mesh(self.vertices * [1, -1, 1], self.faces[:, ::-1])


def joined(meshes: Sequence) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Return the vertices and the faces of several meshes as those of one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces)


def surface_spread(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Return the standard deviation of the surface, averaged over the axes, in the unit of the
    vertices."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)[:, None]
    middle = (a + b + c) / 3
    mean = (middle * area).sum(0) / area.sum()
    return float(np.sqrt(((middle - mean) ** 2 * area).sum(0) / area.sum()).mean())


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) scaled to unit length; zeros stay."""
    return vectors / np.maximum(
        np.sqrt(np.einsum("...d,...d->...", vectors, vectors))[..., None], 1e-30
    )


def box(size, centre=(0, 0, 0)) -> Mesh:
    """Return an axis-aligned box of the given size (3,)."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    faces = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    return Mesh(corners, faces).scaled(size).translated(centre)


def lathe(profile, sides: int = 20, start: float = 0.0, stop: float = TAU) -> Mesh:
    """Revolve a profile (n, 2) of radii and heights about z; normals point outwards if the profile
    goes up."""
    profile = np.asarray(profile, float)
    closed = np.isclose(stop - start, TAU)
    angle = np.linspace(start, stop, sides, endpoint=not closed)
    x = np.outer(profile[:, 0], np.cos(angle))
    y = np.outer(profile[:, 0], np.sin(angle))
    vertices = np.stack([x, y, np.repeat(profile[:, 1:], sides, 1)], -1).reshape(-1, 3)
    columns = np.arange(sides if closed else sides - 1)
    ring, j = np.meshgrid(np.arange(len(profile) - 1) * sides, columns, indexing="ij")
    a = (ring + j).ravel()
    b = (ring + (j + 1) % sides).ravel()
    faces = np.stack([np.stack([a, b, b + sides], 1), np.stack([a, b + sides, a + sides], 1)], 1)
    return Mesh(vertices, faces.reshape(-1, 3))


def cylinder(bottom: float, top: float, height: float, sides: int = 18) -> Mesh:
    """Return a closed cone frustum about z, centred at the origin, with radii `bottom` and
    `top`."""
    return lathe(
        [[1e-4, -height / 2], [bottom, -height / 2], [top, height / 2], [1e-4, height / 2]], sides
    )


def ellipsoid(radii, centre=(0, 0, 0), sides: int = 18) -> Mesh:
    """Return an axis-aligned ellipsoid with the given radii (3,)."""
    t = np.linspace(-np.pi / 2, np.pi / 2, 12)
    unit = lathe(np.stack([np.cos(t) + 1e-5, np.sin(t)], 1), sides)
    return unit.scaled(radii).translated(centre)


def rod(start, end, radius: float, end_radius: float | None = None, sides: int = 12) -> Mesh:
    """Return a closed cone frustum from point `start` (3,) to point `end` (3,)."""
    along = np.subtract(end, start)
    mesh = cylinder(radius, end_radius or radius, np.linalg.norm(along), sides)
    return mesh.pointing(along).translated(np.add(start, end) / 2)


def capsule(start, end, radius: float, end_radius: float | None = None) -> Mesh:
    """Return a rod from `start` (3,) to `end` (3,) with hemispherical ends."""
    along = np.subtract(end, start)
    half = np.linalg.norm(along) / 2
    t = np.linspace(0, np.pi / 2, 5)
    round_end = np.stack([np.cos(t) + 1e-5, np.sin(t)], 1)
    tail = round_end[::-1] * [radius, -radius]
    head = round_end * (end_radius or radius)
    mesh = lathe(np.concatenate([tail - [0, half], head + [0, half]]), sides=14)
    return mesh.pointing(along).translated(np.add(start, end) / 2)


def torus(
    major: float, minor: float, axis=(0, 0, 1), centre=(0, 0, 0), start=0.0, stop=TAU, sides=24
) -> Mesh:
    """Return a torus about `axis`, or its arc from angle `start` to `stop` in radians."""
    t = np.linspace(-np.pi, np.pi, 11)
    tube = np.stack([major + minor * np.cos(t), minor * np.sin(t)], 1)
    return lathe(tube, sides, start, stop).pointing(axis).translated(centre)


def extrusion(outline, thickness: float, plane: str = "xz", offset: float = 0.0) -> Mesh:
    """Extrude an outline (n, 2), star-shaped about its mean, in the plane "xz", "xy" or "yz", to a
    slab at `offset`."""
    outline = np.asarray(outline, float)
    n = len(outline)
    flat = np.concatenate([outline, [outline.mean(0)]])
    across = np.repeat([-thickness / 2, thickness / 2], n + 1) + offset
    i, k = np.arange(n), (np.arange(n) + 1) % n
    back = np.full(n, n)
    front = n + 1
    hub = np.full(n, 2 * n + 1)
    faces = [
        [back, i, k],
        [hub, front + k, front + i],
        [i, k, front + k],
        [i, front + k, front + i],
    ]
    vertices = np.zeros((2 * n + 2, 3))
    vertices[:, _PLANES[plane]] = np.column_stack([np.tile(flat, (2, 1)), across])
    return Mesh(vertices, np.stack([np.stack(f, 1) for f in faces], 1).reshape(-1, 3))
