"""The categories that backbones are trained on; none of them is evaluated.

Each generator builds one object from the draws of its Assembly: front +x, left +y, up +z.
"""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.primitives import TAU, Mesh, box, capsule, cylinder, ellipsoid, extrusion, torus
from zsp_lite.synthetic.training_animals import bird, crab, fish, insect, quadruped, snail
from zsp_lite.synthetic.training_objects import (
    boat,
    camera,
    cart,
    faucet,
    guitar,
    house,
    lamp,
    rocket,
    sewing_machine,
    shoe,
    table,
    teapot,
    windmill,
)


def random_assembly(a: Assembly) -> None:
    """Build a bilaterally symmetric tree of random parts, an object of no category."""
    rng = a.rng

    def solid(size: np.ndarray) -> Mesh:
        kind = a.choice(6)
        if kind == 0:
            return box(size)
        if kind == 1:
            return ellipsoid(0.55 * size)
        if kind == 2:
            mesh = cylinder(0.5, 0.5 * a.u(0.3, 1), 1.0)
            return Mesh(mesh.vertices[:, rng.permutation(3)], mesh.faces).scaled(size)
        if kind == 3:
            return capsule((-0.25, 0, 0), (0.25, 0, 0), 0.25).scaled(size * [1, 2, 2])
        if kind == 4:
            return torus(0.36, 0.12, np.eye(3)[a.choice(3)]).scaled(size)
        angle = np.sort(rng.uniform(0, TAU, 3 + a.choice(4)))
        outline = np.stack([np.cos(angle), np.sin(angle)], 1) * rng.uniform(0.3, 0.6, (len(angle), 1))
        return extrusion(outline, a.u(0.1, 0.9), ("xz", "xy", "yz")[a.choice(3)]).scaled(size)

    nodes = []

    def grow(centre: np.ndarray, size: np.ndarray, mirror: bool) -> None:
        mesh = solid(size)
        if a.chance(0.4):
            mesh = mesh.rotated("y", a.u(-0.8, 0.8))
        if mirror and a.chance(0.5):
            mesh = mesh.rotated("z", a.u(-0.7, 0.7)).rotated("x", a.u(-0.7, 0.7))
        a.add(mesh.translated(centre), a.choice(5), mirror)
        nodes.append((centre, size))

    grow(np.zeros(3), np.array([a.u(0.5, 1.3), a.u(0.4, 1.0), a.u(0.4, 1.2)]), mirror=False)
    for _ in range(4 + a.choice(6)):
        centre, parent = nodes[a.choice(len(nodes))]
        direction = rng.normal(size=3)
        direction /= np.abs(direction).max()
        size = rng.uniform(0.12, 0.8, 3) * a.u(0.5, 1.0)
        mirror = a.chance(0.55)
        centre = centre + direction * parent * 0.5 + direction * size * 0.35
        centre[1] = abs(centre[1]) + 0.1 if mirror else 0
        grow(centre, size, mirror)


TRAINING = {
    generator.__name__: generator
    for generator in (
        teapot, table, quadruped, bird, guitar, boat, house, camera, lamp, cart, fish, faucet, sewing_machine,
        insect, rocket, snail, windmill, shoe, crab,
    )
}  # fmt: skip
