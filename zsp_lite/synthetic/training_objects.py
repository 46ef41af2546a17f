"""Training categories of man-made objects (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.primitives import TAU, box, cylinder, ellipsoid, extrusion, lathe, rod, torus

PI = np.pi


def teapot(a: Assembly) -> None:
    r, h = a.u(0.5, 0.7), a.u(0.6, 1.1)
    belly, neck = a.u(0.3, 0.7), a.u(0.4, 0.7)
    a.add(lathe([[0.001, 0], [r * 0.7, 0], [r, h * belly], [r * neck, h], [0.001, h]]), 0)
    a.add(ellipsoid((r * 0.5, r * 0.5, 0.12), (0, 0, h)), 1)
    a.add(ellipsoid((0.09, 0.09, 0.1), (0, 0, h + 0.15)), 2)
    a.add(rod((r * 0.75, 0, h * 0.35), (r * 1.25, 0, h * a.u(0.7, 1.1)), 0.14, 0.06), 0)
    handle = torus(h * a.u(0.25, 0.35), a.u(0.04, 0.07), (0, 1, 0), (-r * 0.9, 0, h * 0.5), 1.05 * PI, 1.95 * PI)
    a.add(handle, 2)


def table(a: Assembly) -> None:
    length, width, h = a.u(0.9, 1.3), a.u(1.2, 2.2), a.u(0.6, 1.1)
    a.add(box((length, width, a.u(0.05, 0.12)), (0, 0, h)), 0)
    leg = a.u(0.03, 0.07)
    for side in (-1, 1):
        x, y = side * (length / 2 - 0.1), width / 2 - 0.1
        a.add(rod((x, y, h), (x, y, 0), leg), 1, mirror=True)
    a.add(box((length * 0.8, width * a.u(0.25, 0.4), h * a.u(0.3, 0.8)), (0, width * 0.27, h * 0.6)), 2)
    for k in range(1 + a.choice(3)):
        a.add(box((0.04, width * 0.15, 0.04), (length * 0.42, width * 0.27, h * (0.4 + 0.2 * k))), 3)
    if a.chance(0.5):
        a.add(box((0.06, width * 0.5, 0.5), (-0.2, -0.1 * width, h + 0.35)), 3)
        a.add(rod((-0.2, -0.1 * width, h), (-0.2, -0.1 * width, h + 0.2), 0.05), 1)


def guitar(a: Assembly) -> None:
    r, neck = a.u(0.4, 0.55), a.u(1.0, 1.5)
    a.add(cylinder(r, r, 0.22, 24).rotated("y", PI / 2), 0)
    a.add(cylinder(r * 0.75, r * 0.75, 0.22, 24).rotated("y", PI / 2).translated((0, 0, r * 1.1)), 0)
    a.add(cylinder(0.14, 0.14, 0.24, 16).rotated("y", PI / 2).translated((0.01, 0, r * 0.75)), 3)
    top = r * 1.6 + neck
    a.add(box((0.08, 0.12, neck), (0.1, 0, r * 1.6 + neck / 2)), 1)
    a.add(box((0.07, 0.22, 0.3), (0.07, 0, top + 0.12)), 2)
    for k in range(3):
        z = top + 0.03 + 0.09 * k
        a.add(rod((0.07, 0.1, z), (0.07, 0.2, z), 0.025), 3, mirror=True)
    a.add(box((0.06, 0.3, 0.06), (0.14, 0, -r * 0.35)), 2)


def boat(a: Assembly) -> None:
    length, w, h = a.u(1.6, 2.4), a.u(0.5, 0.8), a.u(0.3, 0.5)
    side = [[-length / 2, w / 2], [length * 0.2, w / 2], [length * 0.38, w * 0.35], [length / 2, 0]]
    hull = [[x, -y] for x, y in side] + side[-2::-1]
    for deck in (0, 1):
        a.add(extrusion(hull, h / 2, "xy", h * (0.25 + 0.5 * deck)), deck)
    cabin = a.u(-0.5, 0)
    a.add(box((length * a.u(0.2, 0.35), w * 0.7, a.u(0.3, 0.5)), (cabin, 0, h + 0.2)), 2)
    if a.chance(0.5):
        a.add(rod((cabin - 0.1, 0, h + 0.3), (cabin - 0.15, 0, h + 0.9), a.u(0.08, 0.13)), 3)
    else:
        a.add(rod((0.1, 0, h), (0.1, 0, h + 1.6), 0.04), 3)
        a.add(extrusion([[0.1, h + 0.3], [-0.7, h + 0.3], [0.1, h + 1.5]], 0.03), 4)
    a.add(rod((length * 0.4, 0, h), (length * 0.55, 0, h + 0.1), 0.03), 3)


def house(a: Assembly) -> None:
    length, w, h, roof = a.u(1, 1.8), a.u(0.8, 1.3), a.u(0.6, 1.2), a.u(0.3, 0.7)
    a.add(box((length, w, h), (0, 0, h / 2)), 0)
    a.add(extrusion([[-w * 0.58, h], [w * 0.58, h], [0, h + roof]], length * 1.08, "yz"), 1)
    a.add(box((0.06, 0.25, 0.45), (length / 2, a.u(-0.3, 0.3) * w, 0.23)), 2)
    for side in (-1, 1):
        a.add(box((0.05, 0.22, 0.22), (length / 2, side * a.u(0.2, 0.35) * w, h * 0.7)), 4)
    for x in (-0.25, 0.2):
        a.add(box((0.22, 0.05, 0.25), (x * length, w / 2, h * 0.6)), 4, mirror=True)
    a.add(box((0.18, 0.18, 0.5), (-length * a.u(0.1, 0.3), w * 0.25, h + roof * 0.8)), 3)
    if a.chance(0.4):
        a.add(box((length * 0.5, w * 0.6, h * 0.6), (-0.1, w * 0.75, h * 0.3)), 0)


def camera(a: Assembly) -> None:
    w, h, depth = a.u(1.0, 1.5), a.u(0.6, 0.9), a.u(0.3, 0.5)
    a.add(box((depth, w, h)), 0)
    r, lens, y = a.u(0.2, 0.33), a.u(0.2, 0.7), a.u(-0.15, 0.15)
    front = depth / 2 + lens
    a.add(rod((depth / 2, y, 0), (front, y, 0), r, r * a.u(0.8, 1.1), 18), 1)
    a.add(rod((front - lens * 0.1, y, 0), (front + 0.02, y, 0), r * 0.7), 4)
    a.add(box((depth * 0.7, a.u(0.3, 0.5), 0.2), (0, y, h / 2 + 0.08)), 2)
    a.add(rod((0, w * 0.35, h / 2), (0, w * 0.35, h / 2 + 0.1), 0.09), 3)
    if a.chance(0.6):
        a.add(box((depth * 1.3, 0.2, h * 0.9), (0.08, w * 0.45, 0)), 3)
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
    length, w, h, wheel = a.u(0.9, 1.4), a.u(0.6, 0.9), a.u(0.3, 0.7), a.u(0.12, 0.3)
    z, flare = wheel + 0.1, a.u(0, 0.2)
    a.add(box((length, w, 0.06), (0, 0, z)), 0)
    panel = [[-length / 2, z], [length / 2, z], [length / 2 + flare, z + h], [-length / 2 - flare * 0.3, z + h]]
    a.add(extrusion(panel, 0.05, "xz", w / 2), 0, mirror=True)
    for x in (-length / 2, length / 2 + flare * 0.5):
        a.add(box((0.05, w, h), (x, 0, z + h / 2)), 1)
    grip = np.array([-length / 2 - a.u(0.2, 0.5), w * 0.45, z + h + a.u(0.1, 0.5)])
    a.add(rod((-length / 2, w * 0.45, z + h), grip, 0.03), 2, mirror=True)
    a.add(rod(grip, grip * [1, -1, 1], 0.04), 3)
    for x, r in ((-length * 0.35, wheel), (length * 0.35, wheel * 0.8)):
        a.add(cylinder(r, r, 0.08, 20).rotated("x", PI / 2).translated((x, w / 2, r)), 3, mirror=True)
        a.add(cylinder(r * 0.5, r * 0.45, 0.1, 12).rotated("x", PI / 2).translated((x, w / 2, r)), 2, mirror=True)


def faucet(a: Assembly) -> None:
    h, r = a.u(0.6, 1.2), a.u(0.25, 0.45)
    a.add(cylinder(0.3, 0.25, 0.12), 0)
    a.add(rod((0, 0, 0), (0, 0, h), a.u(0.08, 0.14)), 0)
    if a.chance(0.5):
        a.add(torus(r, 0.08, (0, 1, 0), (r, 0, h), -PI / 2, PI / 2), 0)
    else:
        a.add(rod((0, 0, h), (2 * r, 0, h + 0.1), 0.09, 0.07), 0)
    a.add(rod((0, 0.05, h * 0.5), (0, a.u(0.25, 0.4), h * 0.5), 0.06), 1)
    a.add(rod((0, 0.3, h * 0.5), (0.05, 0.35, h * 0.5 + a.u(0.2, 0.4)), 0.05), 2)
    a.add(rod((2 * r, 0, h - 0.12), (2 * r, 0, h + 0.1), 0.1), 3)


def sewing_machine(a: Assembly) -> None:
    length, h = a.u(1.3, 1.8), a.u(0.7, 1.0)
    needle = length * 0.36
    a.add(box((length, 0.6, 0.12), (0, 0, 0.06)), 0)
    a.add(box((0.35, 0.4, h), (-length * 0.38, 0, h / 2)), 1)
    a.add(box((length * 0.85, 0.36, a.u(0.22, 0.35)), (-0.02, 0, h)), 1)
    a.add(box((0.3, 0.38, 0.5), (needle, 0, h - 0.15)), 1)
    a.add(rod((needle, 0, 0.12), (needle, 0, h - 0.3), 0.03), 3)
    a.add(cylinder(0.2, 0.2, 0.1).rotated("y", PI / 2).translated((-length * 0.38 - 0.25, 0, h * 0.8)), 2)
    a.add(rod((0, 0, h), (0, 0, h + 0.35), 0.07, 0.05), 4)
    a.add(rod((-length * 0.3, 0.2, h * 0.6), (-length * 0.3, 0.27, h * 0.6), 0.09), 3)


def rocket(a: Assembly) -> None:
    h, r = a.u(1.4, 2.2), a.u(0.25, 0.4)
    a.add(lathe([[0.001, 0], [r * 0.7, 0], [r, h * 0.3], [r * 0.9, h * 0.65], [r * 0.4, h * 0.9], [0.001, h]]), 0)
    a.add(torus(r * 0.45, 0.05, (1, 0, 0), (r * 0.85, 0, h * 0.6)), 1)
    a.add(ellipsoid((0.06, r * 0.4, r * 0.4), (r * 0.85, 0, h * 0.6)), 4)
    fin = extrusion([[r * 0.7, h * 0.3], [r + 0.4, 0], [r + 0.4, -0.25], [r * 0.6, 0.05]], 0.06)
    for angle in (0.5, 2.6, 4.7):
        a.add(fin.rotated("z", angle), 2)
    a.add(box((0.06, 0.25, 0.4), (r, 0, h * 0.2)), 3)


def windmill(a: Assembly) -> None:
    h, r, blade = a.u(1.2, 1.8), a.u(0.28, 0.42), a.u(0.6, 0.95)
    a.add(cylinder(r, r * a.u(0.6, 0.8), h, 8).translated((0, 0, h / 2)), 0)
    a.add(cylinder(r, 0.02, r * 1.2, 8).translated((0, 0, h + r * 0.6)), 1)
    hub = np.array([r + 0.12, 0, h * 0.92])
    a.add(rod((0, 0, h * 0.92), hub, 0.06), 2)
    vanes, turn = 3 + a.choice(3), a.u(0, TAU)
    outline = [[0.05, 0.02], [blade, 0.1 + a.u(0, 0.1)], [blade, -0.02], [0.05, -0.02]]
    for k in range(vanes):
        a.add(extrusion(outline, 0.04, "yz").rotated("x", turn + k * TAU / vanes).translated(hub), 3)
    a.add(box((0.05, 0.2, 0.4), (r, 0, 0.2)), 4)
    a.add(box((0.04, 0.14, 0.14), (r * 0.95, 0.02, h * 0.5)), 4)
    if a.chance(0.5):
        a.add(rod((-r, 0, h * 0.9), (-r - a.u(0.2, 0.4), 0, h * 0.4), 0.03), 2)


def shoe(a: Assembly) -> None:
    length, w, ankle = a.u(1.3, 1.8), a.u(0.45, 0.6), a.u(0.4, 1.1)
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
    if a.chance(0.5):
        a.add(torus(0.09, 0.02, (0, 1, 0), (-length * 0.48, 0, ankle * 0.9)), 4)
