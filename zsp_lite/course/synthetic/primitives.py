"""Triangle meshes of simple solids, the parts of every procedural object."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

TAU = 2 * np.pi
Vertices = Float[np.ndarray, "v 3"]
Faces = Int[np.ndarray, "f 3"]  # indices of vertices
# Of a point (3,), of a point (2,) in the plane of an outline, or of an outline's points (n, 2).
Coordinates = Sequence | np.ndarray
# Radius where the profile of a part meets the axis; zero would give triangles without an area.
# Cylinders, which may be thin, have a smaller one.
ON_AXIS = 1e-3
_CYLINDER_ON_AXIS = 1e-4
# The plane of an outline: indices of the outline's two axes, and of the axis of the thickness.
_PLANES = {
    "xz": (0, 2, 1),
    "xy": (0, 1, 2),
    "yz": (1, 2, 0),
}


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: vertices in object units, and faces as indices of vertices."""

    vertices: Vertices
    faces: Faces

    def translated(self, offset: Coordinates) -> "Mesh":
        """Return the mesh shifted by `offset` (3,)."""
        return Mesh(self.vertices + np.asarray(offset, float), self.faces)

    def scaled(self, factors: float | Coordinates) -> "Mesh":
        """Return the mesh scaled about the origin by `factors`, one number or (3,)."""
        return Mesh(self.vertices * np.asarray(factors, float), self.faces)

    def rotated(self, axis: str, angle: float) -> "Mesh":
        """Return the mesh turned about an axis through the origin, see `rotation`."""
        return Mesh(self.vertices @ rotation(axis, angle).T, self.faces)

    def pointing(self, direction: Coordinates) -> "Mesh":
        """Return the mesh rotated so that its z axis points along `direction` (3,)."""
        z = unit(np.asarray(direction, float))
        # Any x axis perpendicular to z will do: here it is perpendicular to the old y axis as well,
        # or to the old x axis if z is nearly along y.
        x = unit(np.cross([0, 1, 0] if abs(z[1]) < 0.9 else [1, 0, 0], z))
        return Mesh(self.vertices @ np.stack([x, np.cross(z, x), z]), self.faces)

    def mirrored(self) -> "Mesh":
        """Return the mirror image in the plane y = 0."""
        # The corners are reversed, so that the normals still point outwards.
        return Mesh(self.vertices * [1, -1, 1], self.faces[:, ::-1])


def point(*coordinates: float) -> Float[np.ndarray, " d"]:
    """Return a point or a vector as an array, to calculate with it."""
    return np.array(coordinates)


def joined(meshes: Sequence[Mesh]) -> tuple[Vertices, Faces]:
    """Return the vertices and the faces of several meshes as those of one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts)]
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces)


def box_centre(vertices: Vertices) -> Float[np.ndarray, "3"]:
    """Return the centre of the vertices' bounding box."""
    return (vertices.max(0) + vertices.min(0)) / 2


def surface_spread(vertices: Vertices, faces: Faces) -> float:
    """Return the standard deviation of the surface's points, averaged over the three axes."""
    # Each face counts as its middle, weighted by its (twofold) area.
    area = np.linalg.norm(area_normals(vertices, faces), axis=1)
    middle = vertices[faces].mean(1)
    covariance = np.cov(middle.T, ddof=0, aweights=area)
    return float(np.sqrt(covariance.diagonal()).mean())


def area_normals(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "f 3"]:
    """Return the normals of faces, with twice their areas as lengths."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return vectors scaled to unit length; zeros stay."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def rotation(axis: str, angle: float) -> Float[np.ndarray, "3 3"]:
    """Return the right-handed rotation about the axis "x", "y" or "z"; the angle in radians."""
    return Rotation.from_euler(axis, angle).as_matrix()


def direction(azimuth: float, elevation: float) -> Float[np.ndarray, "3"]:
    """Return the unit vector with these angles in radians; azimuth 0 is +x, a quarter turn +y."""
    across = np.cos(elevation)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])


def box(size: float | Coordinates, centre: Coordinates = (0, 0, 0)) -> Mesh:
    """Return an axis-aligned box of the given size (3,); one number gives a cube."""
    # Corner 4 i + 2 j + k is on side i along x, side j along y, side k along z (0 for -, 1 for +).
    corners = np.indices((2, 2, 2)).reshape(3, 8).T - 0.5
    # The four corners of each side, counter-clockwise seen from outside.
    sides = np.array(
        [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    )
    faces = sides[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return Mesh(corners, faces).scaled(size).translated(centre)


def lathe(profile: Coordinates, sides: int = 20, start: float = 0.0, stop: float = TAU) -> Mesh:
    """Revolve a profile (n, 2) of radii and heights about z, between two angles in radians.

    Normals point out of a profile that runs upwards. Its ends have a radius `ON_AXIS`, not 0, where
    they close a solid.
    """
    profile = np.asarray(profile, float)
    closed = np.isclose(stop - start, TAU)
    angle = np.linspace(start, stop, sides, endpoint=not closed)
    circle = np.stack([np.cos(angle), np.sin(angle), np.ones(sides)], 1)
    # Vertex i * sides + j is point i of the profile at angle j.
    vertices = profile[:, None, [0, 0, 1]] * circle
    # Two triangles fill the cell between the vertices a and b of a ring and those above them.
    a = np.arange(vertices[1:, :, 0].size).reshape(-1, sides)
    b = np.roll(a, -1, axis=1)
    faces = np.stack([a, b, b + sides, a, b + sides, a + sides], -1)
    if not closed:
        faces = faces[:, :-1]
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3))


def cylinder(bottom: float, top: float, height: float, sides: int = 18) -> Mesh:
    """Return a closed cone frustum about z, centred at the origin, of radii `bottom` and `top`."""
    high = height / 2
    low = -high
    return lathe(
        [[_CYLINDER_ON_AXIS, low], [bottom, low], [top, high], [_CYLINDER_ON_AXIS, high]], sides
    )


def ellipsoid(radii: float | Coordinates, centre: Coordinates = (0, 0, 0), sides: int = 18) -> Mesh:
    """Return an axis-aligned ellipsoid with the given radii (3,); one number gives a sphere."""
    angle = np.linspace(-TAU / 4, TAU / 4, 12)  # from pole to pole
    # The radius 0 at the poles would give triangles without an area.
    sphere = lathe(np.stack([np.cos(angle) + 1e-5, np.sin(angle)], 1), sides)
    return sphere.scaled(radii).translated(centre)


def rod(
    start: Coordinates,
    end: Coordinates,
    radius: float,
    end_radius: float | None = None,
    sides: int = 12,
) -> Mesh:
    """Return a closed cone frustum from point `start` (3,) to point `end` (3,)."""
    along = np.subtract(end, start)
    mesh = cylinder(radius, end_radius or radius, np.linalg.norm(along), sides)
    return mesh.pointing(along).translated(np.add(start, end) / 2)


def capsule(
    start: Coordinates, end: Coordinates, radius: float, end_radius: float | None = None
) -> Mesh:
    """Return a rod from `start` (3,) to `end` (3,) with hemispherical ends."""
    along = np.subtract(end, start)
    half = np.linalg.norm(along) / 2
    angle = np.linspace(0, TAU / 4, 5)  # from the rim to the pole
    # As in `ellipsoid`, no radius is 0.
    round_end = np.stack([np.cos(angle) + 1e-5, np.sin(angle)], 1)
    tail = round_end[::-1] * [radius, -radius]
    head = round_end * (end_radius or radius)
    mesh = lathe(np.concatenate([tail - [0, half], head + [0, half]]), sides=14)
    return mesh.pointing(along).translated(np.add(start, end) / 2)


def torus(
    major: float,
    minor: float,
    axis: Coordinates = (0, 0, 1),
    centre: Coordinates = (0, 0, 0),
    start: float = 0.0,
    stop: float = TAU,
    sides: int = 24,
) -> Mesh:
    """Return a torus about `axis`, or its arc from angle `start` to `stop` in radians."""
    angle = np.linspace(-np.pi, np.pi, 11)  # around the tube
    tube = np.stack([major + minor * np.cos(angle), minor * np.sin(angle)], 1)
    return lathe(tube, sides, start, stop).pointing(axis).translated(centre)


def extrusion(
    outline: Coordinates, thickness: float, plane: str = "xz", offset: float = 0.0
) -> Mesh:
    """Return a slab at `offset` from the plane "xz", "xy" or "yz", with an outline (n, 2) in it.

    The outline is star-shaped about its mean.
    """
    outline = np.asarray(outline, float)
    n = len(outline)
    # Vertices 0 .. n - 1 are the outline at the back, n is its mean; then the same at the front.
    flat = np.concatenate([outline, [outline.mean(0)]])
    across = np.repeat([-thickness / 2, thickness / 2], n + 1) + offset
    vertices = np.zeros((2 * n + 2, 3))
    vertices[:, _PLANES[plane]] = np.column_stack([np.tile(flat, (2, 1)), across])
    # Four faces belong to the edge from `a` to `b`: one at the back, one at the front, two between.
    a = np.arange(n)
    b = np.roll(a, -1)
    mean = np.full(n, n)
    front_a, front_b, front_mean = np.stack([a, b, mean]) + n + 1
    back = [mean, a, b]
    front = [front_mean, front_b, front_a]
    faces = np.stack([*back, *front, a, b, front_b, a, front_b, front_a], 1)
    return Mesh(vertices, faces.reshape(-1, 3))
