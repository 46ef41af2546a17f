"""Training categories of animals (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.primitives import box, capsule, ellipsoid, extrusion, rod, torus


def quadruped(a: Assembly) -> None:
    length, r, leg = a.u(0.8, 1.5), a.u(0.22, 0.38), a.u(0.35, 0.9)
    z = leg + r * 0.6
    a.add(capsule((-length / 2, 0, z), (length / 2, 0, z + a.u(-0.05, 0.1)), r * a.u(0.8, 1), r), 0)
    for x in (-length / 2, length / 2 - 0.05):
        foot = (x + a.u(-0.1, 0.1), r * 0.65, 0.06)
        a.add(capsule((x, r * 0.6, z - 0.05), foot, a.u(0.08, 0.13), a.u(0.06, 0.1)), 0, mirror=True)
    head = np.array([length / 2 + a.u(0.1, 0.4), 0, z + a.u(0.25, 0.9)])
    a.add(capsule((length / 2, 0, z + 0.1), head, a.u(0.12, 0.2), a.u(0.1, 0.18)), 0)
    a.add(capsule(head, head + [a.u(0.2, 0.4), 0, -0.08], a.u(0.15, 0.24), a.u(0.09, 0.15)), 1)
    if a.chance(0.8):
        a.add(ellipsoid((0.05, a.u(0.06, 0.12), a.u(0.1, 0.22)), head + [-0.05, 0.15, 0.2]), 2, mirror=True)
    if a.chance(0.3):
        a.add(rod(head + [0, 0.08, 0.15], head + [-0.05, 0.2, 0.5], 0.04, 0.01), 3, mirror=True)
    a.add(ellipsoid((0.04, 0.03, 0.04), head + [0.1, 0.15, 0.08]), 3, mirror=True)
    tail = (-length / 2 - r - a.u(0.1, 0.5), 0, z + a.u(-0.4, 0.4))
    a.add(capsule((-length / 2 - r * 0.6, 0, z + 0.1), tail, 0.06, 0.04), 2)


def bird(a: Assembly) -> None:
    size, z = a.u(0.5, 0.8), a.u(0.5, 1.0)
    a.add(ellipsoid((size, size * a.u(0.45, 0.7), size * a.u(0.5, 0.7)), (0, 0, z)), 0)
    head = np.array([size * 0.9, 0, z + size * a.u(0.3, 1.3)])
    a.add(capsule((size * 0.6, 0, z + 0.1), head, 0.14, 0.1), 0)
    a.add(ellipsoid((0.2, 0.17, 0.18), head), 1)
    a.add(rod(head + [0.1, 0, 0], head + [0.15 + a.u(0.15, 0.5), 0, -0.05], 0.07, 0.01), 2)
    a.add(ellipsoid((0.035, 0.03, 0.035), head + [0.1, 0.14, 0.06]), 3, mirror=True)
    a.add(ellipsoid((size * 0.8, 0.07, size * 0.4), (-0.08, size * 0.52, z + 0.05)), 1, mirror=True)
    spread, back = a.u(0.1, 0.35), -size * 1.6
    tail = [[-size * 0.8, 0.15], [-size * 0.8, -0.15], [back, -spread], [back, spread]]
    a.add(extrusion(tail, 0.06, "xy", z + 0.1), 3)
    a.add(rod((0, 0.15, z - 0.1), (0, 0.17, 0.02), 0.035), 2, mirror=True)
    a.add(box((0.25, 0.13, 0.04), (0.06, 0.17, 0.02)), 2, mirror=True)


def fish(a: Assembly) -> None:
    length, h = a.u(0.8, 1.2), a.u(0.3, 0.6)
    a.add(ellipsoid((length, a.u(0.15, 0.35), h)), 0)
    tail = [[-length * 0.85, 0], [-length * 1.5, a.u(0.3, 0.55)], [-length * 1.3, 0], [-length * 1.5, -a.u(0.3, 0.55)]]
    a.add(extrusion(tail, 0.06), 1)
    fin = [[0.3 * length, h * 0.8], [-0.1 * length, h * 0.9 + a.u(0.15, 0.5)], [-0.5 * length, h * 0.7]]
    a.add(extrusion(fin, 0.05), 1)
    a.add(ellipsoid((0.06, 0.05, 0.06), (length * 0.72, 0.14, h * 0.2)), 3, mirror=True)
    a.add(ellipsoid((0.25, 0.04, 0.12)).rotated("z", -0.5).translated((0.15, 0.28, -0.1)), 2, mirror=True)
    a.add(ellipsoid((0.1, 0.1, 0.05), (length * 0.95, 0, -0.05)), 2)


def insect(a: Assembly) -> None:
    z = a.u(0.3, 0.5)
    a.add(ellipsoid((0.5, a.u(0.25, 0.45), 0.28), (-0.5, 0, z)), 0)
    a.add(ellipsoid((0.28, 0.25, 0.22), (0.15, 0, z)), 1)
    a.add(ellipsoid((0.2, 0.22, 0.18), (0.52, 0, z + 0.03)), 0)
    a.add(ellipsoid((0.08, 0.07, 0.08), (0.62, 0.14, z + 0.1)), 3, mirror=True)
    for i, x in enumerate((-0.1, 0.12, 0.32)):
        knee = np.array([x + (i - 1) * 0.25, 0.55, z + 0.25])
        a.add(rod((x, 0.15, z), knee, 0.04), 2, mirror=True)
        a.add(rod(knee, (x + (i - 1) * 0.45, 0.85, 0), 0.03), 2, mirror=True)
    a.add(rod((0.6, 0.08, z + 0.15), (0.95, a.u(0.1, 0.3), z + a.u(0.2, 0.6)), 0.02), 2, mirror=True)
    if a.chance(0.6):
        wing = ellipsoid((0.6, 0.22, 0.02)).rotated("z", 0.4 * a.u(0.5, 1.5)).translated((-0.4, 0.4, z + 0.3))
        a.add(wing, 4, mirror=True)


def snail(a: Assembly) -> None:
    length, shell = a.u(0.9, 1.4), a.u(0.35, 0.55)
    a.add(capsule((-length * 0.6, 0, 0.12), (length * 0.5, 0, 0.14), 0.06, a.u(0.12, 0.18)), 0)
    centre = np.array([-length * 0.1, 0, shell + 0.15])
    for k in range(3):
        scale = 1 - 0.3 * k
        a.add(torus(shell * scale * 0.6, shell * scale * 0.4, (0, 1, 0), centre + [0, 0.06 * k, 0.03 * k]), 1 + k % 2)
    head = np.array([length * 0.6, 0, a.u(0.3, 0.55)])
    a.add(capsule((length * 0.45, 0, 0.15), head, 0.15, 0.12), 0)
    horn = head + [a.u(0.05, 0.2), a.u(0.1, 0.2), a.u(0.2, 0.4)]
    a.add(rod(head, horn, 0.035, 0.02), 0, mirror=True)
    a.add(ellipsoid((0.05, 0.05, 0.05), horn), 3, mirror=True)


def crab(a: Assembly) -> None:
    body, z = a.u(0.5, 0.7), a.u(0.25, 0.4)
    a.add(ellipsoid((body * a.u(0.6, 0.8), body, a.u(0.18, 0.3)), (0, 0, z)), 0)
    for k in range(3):
        x = -0.3 + 0.25 * k
        knee = np.array([x * 1.4, body + 0.25, z + a.u(0.1, 0.3)])
        a.add(rod((x, body * 0.7, z), knee, 0.06), 1, mirror=True)
        a.add(rod(knee, knee * [1.1, 1.25, 0], 0.05, 0.02), 1, mirror=True)
    for side, size in ((1, a.u(0.12, 0.3)), (-1, a.u(0.12, 0.22))):
        claw = np.array([body * 1.1, side * body * 0.9, z + 0.1])
        a.add(rod((body * 0.4, side * body * 0.7, z), claw, 0.07), 1)
        a.add(ellipsoid((size * 1.4, size, size * 0.7), claw + [size, 0, 0]), 2)
        a.add(rod(claw + [size, -side * 0.05, 0], claw + [size * 2.6, -side * size * 0.6, 0], size * 0.4, 0.01), 2)
    stalk = np.array([body * 0.55, 0.15, z + a.u(0.3, 0.45)])
    a.add(rod((body * 0.45, 0.12, z + 0.1), stalk, 0.03), 3, mirror=True)
    a.add(ellipsoid((0.06, 0.06, 0.06), stalk), 4, mirror=True)
