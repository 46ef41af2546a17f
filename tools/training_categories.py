"""The categories that weights and constants are fitted to; none of them is evaluated (front +x,
left +y, up +z)."""

import numpy as np

from zsp_lite.course.synthetic.assembly import Assembly, disc
from zsp_lite.course.synthetic.primitives import (
    TAU,
    box,
    capsule,
    cylinder,
    ellipsoid,
    extrusion,
    lathe,
    rod,
    torus,
)


def quadruped(a: Assembly) -> None:
    length = a.u(0.8, 1.5)
    r = a.u(0.22, 0.38)
    leg = a.u(0.35, 0.9)
    z = leg + r * 0.6
    a.add(capsule((-length / 2, 0, z), (length / 2, 0, z + a.u(-0.05, 0.1)), r * a.u(0.8, 1), r), 0)
    for x in (-length / 2, length / 2 - 0.05):
        foot = (x + a.u(-0.1, 0.1), r * 0.65, 0.06)
        a.add_pair(capsule((x, r * 0.6, z - 0.05), foot, a.u(0.08, 0.13), a.u(0.06, 0.1)), 0)
    head = np.array([length / 2 + a.u(0.1, 0.4), 0, z + a.u(0.25, 0.9)])
    a.add(capsule((length / 2, 0, z + 0.1), head, a.u(0.12, 0.2), a.u(0.1, 0.18)), 0)
    a.add(capsule(head, head + [a.u(0.2, 0.4), 0, -0.08], a.u(0.15, 0.24), a.u(0.09, 0.15)), 1)
    if a.chance(0.8):
        a.add_pair(ellipsoid((0.05, a.u(0.06, 0.12), a.u(0.1, 0.22)), head + [-0.05, 0.15, 0.2]), 2)
    a.add_pair(ellipsoid((0.04, 0.03, 0.04), head + [0.1, 0.15, 0.08]), 3)
    tail = (-length / 2 - r - a.u(0.1, 0.5), 0, z + a.u(-0.4, 0.4))
    a.add(capsule((-length / 2 - r * 0.6, 0, z + 0.1), tail, 0.06, 0.04), 2)


def fish(a: Assembly) -> None:
    length = a.u(0.8, 1.2)
    h = a.u(0.3, 0.6)
    a.add(ellipsoid((length, a.u(0.15, 0.35), h)), 0)
    tail = [
        [-length * 0.85, 0],
        [-length * 1.5, a.u(0.3, 0.55)],
        [-length * 1.3, 0],
        [-length * 1.5, -a.u(0.3, 0.55)],
    ]
    a.add(extrusion(tail, 0.06), 1)
    fin = [
        [0.3 * length, h * 0.8],
        [-0.1 * length, h * 0.9 + a.u(0.15, 0.5)],
        [-0.5 * length, h * 0.7],
    ]
    a.add(extrusion(fin, 0.05), 1)
    a.add_pair(ellipsoid((0.06, 0.05, 0.06), (length * 0.72, 0.14, h * 0.2)), 3)
    a.add_pair(ellipsoid((0.25, 0.04, 0.12)).rotated("z", -0.5).translated((0.15, 0.28, -0.1)), 2)


def teapot(a: Assembly) -> None:
    r = a.u(0.5, 0.7)
    h = a.u(0.6, 1.1)
    belly = a.u(0.3, 0.7)
    neck = a.u(0.4, 0.7)
    a.add(lathe([[0.001, 0], [r * 0.7, 0], [r, h * belly], [r * neck, h], [0.001, h]]), 0)
    a.add(ellipsoid((r * 0.5, r * 0.5, 0.12), (0, 0, h)), 1)
    a.add(ellipsoid((0.09, 0.09, 0.1), (0, 0, h + 0.15)), 2)
    a.add(rod((r * 0.75, 0, h * 0.35), (r * 1.25, 0, h * a.u(0.7, 1.1)), 0.14, 0.06), 0)
    handle = torus(
        h * a.u(0.25, 0.35),
        a.u(0.04, 0.07),
        (0, 1, 0),
        (-r * 0.9, 0, h * 0.5),
        1.05 * np.pi,
        1.95 * np.pi,
    )
    a.add(handle, 2)


def guitar(a: Assembly) -> None:
    r = a.u(0.4, 0.55)
    neck = a.u(1.0, 1.5)
    a.add(cylinder(r, r, 0.22, 24).rotated("y", np.pi / 2), 0)
    a.add(
        cylinder(r * 0.75, r * 0.75, 0.22, 24).rotated("y", np.pi / 2).translated((0, 0, r * 1.1)),
        0,
    )
    a.add(cylinder(0.14, 0.14, 0.24, 16).rotated("y", np.pi / 2).translated((0.01, 0, r * 0.75)), 3)
    top = r * 1.6 + neck
    a.add(box((0.08, 0.12, neck), (0.1, 0, r * 1.6 + neck / 2)), 1)
    a.add(box((0.07, 0.22, 0.3), (0.07, 0, top + 0.12)), 2)
    a.add(box((0.06, 0.3, 0.06), (0.14, 0, -r * 0.35)), 2)


def camera(a: Assembly) -> None:
    w = a.u(1.0, 1.5)
    h = a.u(0.6, 0.9)
    depth = a.u(0.3, 0.5)
    a.add(box((depth, w, h)), 0)
    r = a.u(0.2, 0.33)
    lens = a.u(0.2, 0.7)
    y = a.u(-0.15, 0.15)
    front = depth / 2 + lens
    a.add(rod((depth / 2, y, 0), (front, y, 0), r, r * a.u(0.8, 1.1), 18), 1)
    a.add(rod((front - lens * 0.1, y, 0), (front + 0.02, y, 0), r * 0.7), 4)
    a.add(box((depth * 0.7, a.u(0.3, 0.5), 0.2), (0, y, h / 2 + 0.08)), 2)
    a.add(rod((0, w * 0.35, h / 2), (0, w * 0.35, h / 2 + 0.1), 0.09), 3)
    a.add(box((0.04, w * 0.5, h * 0.5), (-depth / 2, 0, -0.05)), 4)


def lamp(a: Assembly) -> None:
    a.add(cylinder(a.u(0.3, 0.5), a.u(0.2, 0.4), 0.1), 0)
    knee = np.array([-a.u(0.1, 0.5), 0, a.u(0.5, 0.9)])
    elbow = np.array([a.u(0.1, 0.6), 0, knee[2] + a.u(0.2, 0.6)])
    a.add(rod((0, 0, 0.05), knee, 0.04), 1)
    a.add(rod(knee, elbow, 0.04), 1)
    a.add(ellipsoid((0.08, 0.08, 0.08), knee), 2)
    beam = np.array([a.u(0.2, 0.7), 0, -a.u(0.1, 0.8)])
    beam /= np.linalg.norm(beam)
    a.add(rod(elbow - beam * 0.1, elbow + beam * a.u(0.35, 0.55), 0.1, a.u(0.25, 0.4), 18), 3)
    a.add(ellipsoid((0.1, 0.1, 0.1), elbow + beam * 0.35), 4)


def cart(a: Assembly) -> None:
    length = a.u(0.9, 1.4)
    w = a.u(0.6, 0.9)
    h = a.u(0.3, 0.7)
    wheel = a.u(0.12, 0.3)
    z = wheel + 0.1
    flare = a.u(0, 0.2)
    a.add(box((length, w, 0.06), (0, 0, z)), 0)
    panel = [
        [-length / 2, z],
        [length / 2, z],
        [length / 2 + flare, z + h],
        [-length / 2 - flare * 0.3, z + h],
    ]
    a.add_pair(extrusion(panel, 0.05, "xz", w / 2), 0)
    for x in (-length / 2, length / 2 + flare * 0.5):
        a.add(box((0.05, w, h), (x, 0, z + h / 2)), 1)
    grip = np.array([-length / 2 - a.u(0.2, 0.5), w * 0.45, z + h + a.u(0.1, 0.5)])
    a.add_pair(rod((-length / 2, w * 0.45, z + h), grip, 0.03), 2)
    a.add(rod(grip, grip * [1, -1, 1], 0.04), 3)
    for x, r in ((-length * 0.35, wheel), (length * 0.35, wheel * 0.8)):
        a.add_pair(disc(r, 0.08, (x, w / 2, r)), 3)
        a.add_pair(disc(r * 0.5, 0.1, (x, w / 2, r)), 2)


def rocket(a: Assembly) -> None:
    h = a.u(1.4, 2.2)
    r = a.u(0.25, 0.4)
    a.add(
        lathe(
            [
                [0.001, 0],
                [r * 0.7, 0],
                [r, h * 0.3],
                [r * 0.9, h * 0.65],
                [r * 0.4, h * 0.9],
                [0.001, h],
            ]
        ),
        0,
    )
    a.add(torus(r * 0.45, 0.05, (1, 0, 0), (r * 0.85, 0, h * 0.6)), 1)
    a.add(ellipsoid((0.06, r * 0.4, r * 0.4), (r * 0.85, 0, h * 0.6)), 4)
    fin = extrusion([[r * 0.7, h * 0.3], [r + 0.4, 0], [r + 0.4, -0.25], [r * 0.6, 0.05]], 0.06)
    for angle in (0.5, 2.6, 4.7):
        a.add(fin.rotated("z", angle), 2)
    a.add(box((0.06, 0.25, 0.4), (r, 0, h * 0.2)), 3)


def windmill(a: Assembly) -> None:
    h = a.u(1.2, 1.8)
    r = a.u(0.28, 0.42)
    blade = a.u(0.6, 0.95)
    a.add(cylinder(r, r * a.u(0.6, 0.8), h, 8).translated((0, 0, h / 2)), 0)
    a.add(cylinder(r, 0.02, r * 1.2, 8).translated((0, 0, h + r * 0.6)), 1)
    hub = np.array([r + 0.12, 0, h * 0.92])
    a.add(rod((0, 0, h * 0.92), hub, 0.06), 2)
    vanes = 3 + a.choice(3)
    turn = a.u(0, TAU)
    outline = [[0.05, 0.02], [blade, 0.1 + a.u(0, 0.1)], [blade, -0.02], [0.05, -0.02]]
    for k in range(vanes):
        a.add(
            extrusion(outline, 0.04, "yz").rotated("x", turn + k * TAU / vanes).translated(hub), 3
        )
    a.add(box((0.05, 0.2, 0.4), (r, 0, 0.2)), 4)
    a.add(box((0.04, 0.14, 0.14), (r * 0.95, 0.02, h * 0.5)), 4)


def shoe(a: Assembly) -> None:
    length = a.u(1.3, 1.8)
    w = a.u(0.45, 0.6)
    ankle = a.u(0.4, 1.1)
    half = [[-length / 2, w * 0.35], [0, w * 0.36], [length * 0.3, w * 0.5], [length / 2, w * 0.15]]
    sole = [[x, -y] for x, y in half] + half[::-1]
    a.add(extrusion(sole, a.u(0.08, 0.16), "xy", 0.05), 0)
    a.add(ellipsoid((length * 0.35, w * 0.42, a.u(0.2, 0.3)), (length * 0.15, 0, 0.15)), 1)
    shaft = lathe([[w * 0.4, 0], [w * 0.36, ankle], [w * 0.3, ankle], [0.01, ankle - 0.05]], 16)
    a.add(shaft.scaled((1.2, 1, 1)).translated((-length * 0.26, 0, 0.1)), 1)
    for k in range(2 + a.choice(3)):
        a.add(box((0.05, w * 0.5, 0.04), (length * (0.0 + 0.08 * k), 0, 0.42 - 0.05 * k)), 2)
    if a.chance(0.6):
        a.add(box((0.25, w * 0.6, a.u(0.1, 0.3)), (-length * 0.36, 0, -0.08)), 3)


BUILDERS = (quadruped, fish, teapot, guitar, camera, lamp, cart, rocket, windmill, shoe)
TRAINING = {build.__name__: build for build in BUILDERS}
