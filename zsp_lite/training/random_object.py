"""Objects of no category: random parts, left and right alike (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.primitives import TAU, Mesh, box, capsule, cylinder, ellipsoid, extrusion, torus


def build_random_object(a: Assembly) -> None:
    """Build a tree of 5 to 10 random parts, each attached to one of those before it."""
    nodes = [(np.zeros(3), np.array([a.u(0.5, 1.3), a.u(0.4, 1.0), a.u(0.4, 1.2)]))]  # centre and size of each part
    a.add(_random_solid(a, nodes[0][1]), a.choice(5))
    for _ in range(4 + a.choice(6)):
        parent, parent_size = nodes[a.choice(len(nodes))]
        direction, size = a.rng.normal(size=3), a.rng.uniform(0.12, 0.8, 3) * a.u(0.5, 1.0)
        centre = parent + direction / np.abs(direction).max() * (parent_size * 0.4 + size * 0.3)
        mesh, mirror = _random_solid(a, size), a.chance(0.55)
        centre[1] = abs(centre[1]) if mirror else 0
        if mirror and a.chance(0.5):
            mesh = mesh.rotated("z", a.u(-0.7, 0.7)).rotated("x", a.u(-0.7, 0.7))
        a.add(mesh.translated(centre), a.choice(5), mirror)
        nodes.append((centre, size))


def _random_solid(a: Assembly, size: np.ndarray) -> Mesh:
    """Return a solid of about the given size (3,), sometimes rotated about the axis to the left."""
    angle = np.arange(5) * TAU / 5 + a.rng.uniform(0, TAU / 5, 5)
    outline = np.stack([np.cos(angle), np.sin(angle)], 1) * a.rng.uniform(0.3, 0.6, (5, 1))
    solids = (
        box((1, 1, 1)),
        ellipsoid((0.55, 0.55, 0.55)),
        cylinder(0.5, 0.5 * a.u(0.3, 1), 1.0),
        capsule((-0.25, 0, 0), (0.25, 0, 0), 0.25).scaled((1, 2, 2)),
        torus(0.36, 0.12, np.eye(3)[a.choice(3)]),
        extrusion(outline, a.u(0.1, 0.9), ("xz", "xy", "yz")[a.choice(3)]),
    )
    mesh = solids[a.choice(len(solids))].scaled(size)
    return mesh.rotated("y", a.u(-0.8, 0.8)) if a.chance(0.4) else mesh
