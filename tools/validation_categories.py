"""The categories for choices and calibration; none is trained on, none is evaluated (front +x, left
+y, up +z)."""

import numpy as np

from zsp_lite.course.synthetic.assembly import Assembly, disc
from zsp_lite.course.synthetic.primitives import (
    box,
    capsule,
    cylinder,
    ellipsoid,
    extrusion,
    lathe,
    rod,
    torus,
)


def _wheel(
    a: Assembly, x: float, y: float, radius: float, width: float, mirror: bool = True
) -> None:
    """Add a wheel that stands on the ground, with its axis along y."""
    a.add(disc(radius, width, (x, y, radius)), 3, mirror)
    a.add(disc(radius * 0.5, width * 1.2, (x, y, radius)), 4, mirror)


def helicopter(a: Assembly) -> None:
    length = a.u(0.6, 0.9)
    r = a.u(0.35, 0.5)
    z = a.u(0.6, 0.8)
    a.add(ellipsoid((length, r, r * a.u(0.9, 1.2)), (0, 0, z)), 0)
    a.add(ellipsoid((length * 0.5, r * 0.85, r * 0.7), (length * 0.55, 0, z + 0.05)), 4)
    tail = np.array([-length - a.u(0.6, 1.0), 0, z + a.u(0.1, 0.3)])
    a.add(rod((-length * 0.7, 0, z + 0.05), tail, r * 0.4, 0.07), 0)
    a.add(extrusion([[0.1, 0], [-0.12, 0], [-0.25, 0.4], [-0.1, 0.4]], 0.05).translated(tail), 1)
    blades = 2 + a.choice(3)
    phase = a.u(0, 3)
    reach = a.u(0.9, 1.3)
    top = z + r * 1.2 + 0.2
    a.add(rod((0, 0, z), (0, 0, top), 0.05), 2)
    for k in range(blades):
        blade = box((reach, 0.11, 0.03), (reach / 2, 0, top)).rotated(
            "z", phase + 2 * np.pi * k / blades
        )
        a.add(blade, 2)
    a.add(torus(0.2, 0.025, (0, 1, 0), tail + [0, 0.08, 0.05]), 3)
    if a.chance(0.7):
        a.add_pair(rod((-length * 0.6, r * 0.8, 0.05), (length * 0.9, r * 0.8, 0.05), 0.035), 3)
        for x in (-0.3, 0.35):
            a.add_pair(
                rod((x * length, r * 0.4, z - r * 0.7), (x * length, r * 0.8, 0.05), 0.03), 3
            )
    else:
        _wheel(a, length * 0.4, r * 0.7, 0.14, 0.1)
        _wheel(a, -length * 0.6, 0, 0.1, 0.1, mirror=False)


def wheelbarrow(a: Assembly) -> None:
    length = a.u(0.9, 1.2)
    w = a.u(0.55, 0.8)
    wheel = a.u(0.2, 0.32)
    z = wheel + a.u(0.15, 0.3)
    depth = a.u(0.25, 0.45)
    side = [
        [-length / 2, z + depth],
        [-length * 0.3, z],
        [length * 0.25, z],
        [length * a.u(0.55, 0.75), z + depth],
    ]
    a.add_pair(extrusion(side, 0.05).translated((0, w / 2, 0)), 0)
    a.add(box((length * 0.6, w, 0.05), (0, 0, z)), 0)
    a.add(
        rod((length * 0.3, 0, z + 0.02), (length * 0.6, 0, z + depth * 0.9), w * 0.45, w * 0.5), 0
    )
    grip = np.array([-length / 2 - a.u(0.4, 0.7), w * 0.4, z + a.u(0.1, 0.4)])
    a.add_pair(rod((length * 0.6, w * 0.15, wheel), grip, 0.04), 1)
    a.add_pair(capsule(grip, grip + [-0.15, 0, 0.02], 0.06), 2)
    a.add_pair(rod((-length * 0.2, w * 0.35, z), (-length * 0.35, w * 0.4, 0), 0.035), 1)
    _wheel(a, length * 0.65, 0, wheel, a.u(0.08, 0.16), mirror=False)


def watering_can(a: Assembly) -> None:
    r = a.u(0.4, 0.55)
    h = a.u(0.6, 1.0)
    a.add(lathe([[0.001, 0], [r, 0], [r * a.u(0.75, 1), h], [0.001, h * 0.97]]), 0)
    tip = np.array([r + a.u(0.5, 0.9), 0, h * a.u(0.95, 1.3)])
    a.add(rod((r * 0.8, 0, h * 0.2), tip, 0.09, 0.05), 0)
    rose = tip - [r * 0.8, 0, h * 0.2]
    a.add(rod(tip, tip + 0.2 * rose / np.linalg.norm(rose), 0.05, a.u(0.12, 0.2)), 1)
    a.add(rod((r * 0.7, 0, h), tip * [0.8, 1, 1] - [0, 0, 0.15], 0.025), 2)
    a.add(
        torus(
            h * a.u(0.3, 0.4), 0.05, (0, 1, 0), (-r * 0.85, 0, h * 0.55), np.pi * 0.95, np.pi * 2.05
        ),
        2,
    )
    if a.chance(0.5):
        a.add(cylinder(r * 1.05, r * 1.05, 0.08, 20).translated((0, 0, h * a.u(0.3, 0.7))), 3)


def vacuum_cleaner(a: Assembly) -> None:
    length = a.u(0.5, 0.75)
    r = a.u(0.28, 0.4)
    a.add(capsule((-length, 0, r + 0.08), (length * 0.6, 0, r + 0.05), r, r * a.u(0.7, 0.95)), 0)
    a.add(box((length * 0.8, r * 1.1, 0.12), (-length * 0.4, 0, 2 * r + 0.05)), 1)
    a.add(cylinder(0.12, 0.12, 0.1).translated((length * 0.1, 0, 2 * r + 0.08)), 2)
    _wheel(a, -length * 0.9, r * 0.95, a.u(0.2, 0.32), 0.1)
    hose = np.array([length * 0.6 + r + 0.3, 0, r + a.u(0.3, 0.6)])
    a.add(rod((length * 0.6, 0, r), hose, 0.07), 3)
    wand = np.array([hose[0] + a.u(0.2, 0.5), a.u(-0.1, 0.1), 0.08])
    a.add(rod(hose, wand, 0.06), 3)
    a.add(box((0.22, a.u(0.5, 0.8), 0.1), wand), 2)
    if a.chance(0.5):
        a.add(
            torus(0.16, 0.035, (0, 1, 0), (-length * 0.2, 0, 2 * r + 0.1), -np.pi / 2, np.pi / 2), 4
        )


def drill(a: Assembly) -> None:
    length = a.u(0.8, 1.1)
    r = a.u(0.2, 0.28)
    z = a.u(0.8, 1.0)
    a.add(rod((-length * 0.45, 0, z), (length * 0.35, 0, z), r, r * a.u(0.8, 1)), 0)
    a.add(rod((length * 0.35, 0, z), (length * 0.6, 0, z), r * 0.7, r * 0.45), 1)
    a.add(rod((length * 0.6, 0, z), (length * 0.6 + a.u(0.3, 0.7), 0, z), 0.05, 0.02), 3)
    lean = a.u(-0.25, 0.05)
    a.add(capsule((-length * 0.15, 0, z), (-length * 0.15 + lean, 0, 0.2), 0.16, 0.14), 0)
    a.add(box((a.u(0.35, 0.5), 0.3, a.u(0.15, 0.25)), (-length * 0.12 + lean, 0, 0.1)), 2)
    a.add(box((0.1, 0.1, 0.18), (length * 0.03, 0, z - r - 0.08)), 2)
    for x in (-0.35, -0.22):
        a.add(torus(r, 0.025, (1, 0, 0), (x * length, 0, z)), 4)
    if a.chance(0.4):
        a.add(rod((length * 0.25, 0, z), (length * 0.25, a.u(0.4, 0.6), z), 0.07), 2)


def dinosaur(a: Assembly) -> None:
    length = a.u(0.5, 0.8)
    r = a.u(0.28, 0.4)
    leg = a.u(0.4, 0.7)
    z = leg + r * 0.5
    hip = np.array([-length * 0.4, 0, z])
    chest = np.array([length * 0.5, 0, z + a.u(0, 0.3)])
    a.add(capsule(hip, chest, r, r * 0.75), 0)
    tail = hip - [a.u(0.5, 0.8), 0, a.u(-0.1, 0.2)]
    a.add(rod(hip, tail, r * 0.8, r * 0.4), 0)
    a.add(rod(tail, tail - [a.u(0.4, 0.7), 0, a.u(-0.2, 0.25)], r * 0.4, 0.03), 0)
    head = chest + [a.u(0.3, 0.6), 0, a.u(0.2, 0.7)]
    a.add(rod(chest, head, r * 0.6, r * 0.35), 0)
    a.add(capsule(head, head + [a.u(0.2, 0.4), 0, -0.05], r * 0.45, r * 0.28), 1)
    a.add_pair(ellipsoid((0.05, 0.04, 0.05), head + [0.06, r * 0.4, 0.08]), 3)
    a.add_pair(capsule(hip + [0, r * 0.7, 0], (hip[0] + 0.05, r * 0.9, 0.08), 0.17, 0.1), 1)
    upright = a.chance(0.5)
    foot = chest + [0.3, r * 0.5, -0.3] if upright else np.array([chest[0], r * 0.8, 0.08])
    a.add_pair(capsule(chest + [0, r * 0.5, -0.05], foot, 0.1, 0.06), 1)
    for k in range(5):
        x = hip[0] - 0.3 + 0.25 * k
        a.add(
            extrusion(
                [
                    [x - 0.1, z + r * 0.6],
                    [x + 0.1, z + r * 0.6],
                    [x - 0.05, z + r + a.u(0.15, 0.35)],
                ],
                0.05,
            ),
            2,
        )


def mailbox(a: Assembly) -> None:
    length = a.u(0.8, 1.2)
    r = a.u(0.25, 0.38)
    h = a.u(0.7, 1.1)
    a.add(box((length, 2 * r, r), (0, 0, h + r / 2)), 0)
    a.add(rod((-length / 2, 0, h + r), (length / 2, 0, h + r), r, sides=18), 0)
    a.add(box((0.04, r * 1.6, r * 1.3), (length / 2 + 0.02, 0, h + r * 0.8)), 1)
    a.add(box((0.08, 0.12, 0.06), (length / 2 + 0.06, 0, h + r * 1.4)), 3)
    a.add(rod((0, 0, 0), (a.u(-0.1, 0.1), 0, h), a.u(0.06, 0.1)), 2)
    a.add(cylinder(a.u(0.2, 0.4), 0.15, 0.1).translated((0, 0, 0.05)), 2)
    flag = a.u(-0.1, 0.3) * length
    a.add(rod((flag, r, h + r), (flag, r + 0.05, h + 2 * r + 0.2), 0.025), 3)
    a.add(box((0.22, 0.03, 0.16), (flag - 0.1, r + 0.05, h + 2 * r + 0.2)), 4)


def excavator(a: Assembly) -> None:
    length = a.u(0.9, 1.2)
    w = a.u(0.6, 0.8)
    a.add_pair(capsule((-length / 2, w / 2, 0.16), (length / 2, w / 2, 0.16), 0.16), 3)
    a.add(box((length * 0.9, w * 0.9, a.u(0.25, 0.4)), (-0.08, 0, 0.5)), 0)
    side = a.u(0.1, 0.2) * (1 if a.chance(0.5) else -1)
    a.add(box((0.4, w * 0.45, a.u(0.4, 0.55)), (length * 0.15, side, 0.9)), 4)
    a.add(box((0.3, w * 0.8, 0.25), (-length * 0.42, 0, 0.75)), 1)
    elbow = np.array([length * 0.45 + a.u(0.3, 0.6), -side * 0.6, a.u(1.1, 1.5)])
    wrist = np.array([elbow[0] + a.u(0.3, 0.6), -side * 0.6, a.u(0.5, 0.9)])
    a.add(rod((length * 0.35, -side * 0.6, 0.6), elbow, 0.1, 0.08), 0)
    a.add(rod(elbow, wrist, 0.08, 0.06), 0)
    scoop = [[0.12, 0.05], [-0.15, -0.05], [-0.22, -0.35], [0.02, -0.4]]
    a.add(extrusion(scoop, w * a.u(0.35, 0.55)).translated(wrist), 2)
    a.add(rod((-length * 0.3, w * 0.25, 0.8), (-length * 0.3, w * 0.25, 1.1), 0.05), 3)


def bed(a: Assembly) -> None:
    double = a.chance(0.5)
    length = a.u(1.9, 2.3)
    width = a.u(1.35, 1.8) if double else a.u(0.85, 1.2)
    z = a.u(0.3, 0.5)
    a.add(box((length, width, a.u(0.15, 0.3)), (0, 0, z)), 0)
    for end, height in ((1, a.u(0.65, 1.1)), (-1, a.u(0.35, 0.65))):
        a.add(box((0.08, width, height), (end * length / 2, 0, height / 2 + 0.08)), 1)
        a.add_pair(
            rod(
                (end * length / 2, width / 2, 0), (end * length / 2, width / 2, height + 0.12), 0.05
            ),
            1,
        )
    top = z + 0.17
    if double:
        a.add_pair(ellipsoid((0.2, width * 0.2, 0.1), (length * 0.37, width * 0.24, top)), 2)
    else:
        a.add(ellipsoid((0.2, width * 0.36, 0.1), (length * 0.37, 0, top)), 2)
    a.add(box((length * a.u(0.4, 0.65), width * 1.03, 0.12), (-length * 0.15, 0, top - 0.05)), 3)


def bathtub(a: Assembly) -> None:
    length = a.u(1.6, 2.0)
    w = a.u(0.75, 0.95)
    h = a.u(0.5, 0.65)
    rear = a.u(0.55, 0.7) * length / 2
    front = a.u(0.44, 0.56) * length / 2
    a.add(extrusion([[-rear, 0], [front, 0], [length / 2, h], [-length / 2, h]], w), 0)
    a.add(box((length * 0.88, w * 0.8, 0.03), (0, 0, h + 0.01)), 1)
    for x in (-rear, front):
        a.add_pair(ellipsoid((0.07, 0.07, 0.1), (x * 0.85, w * 0.38, -0.03)), 2)
    tap = np.array([-length / 2 + 0.06, 0, h])
    rise = a.u(0.12, 0.3)
    a.add(rod(tap, tap + [0, 0, rise], 0.035), 2)
    a.add(rod(tap + [0, 0, rise], tap + [a.u(0.1, 0.25), 0, rise - 0.03], 0.03), 2)
    a.add_pair(ellipsoid((0.04, 0.04, 0.06), tap + [0, 0.13, 0.05]), 2)


def skateboard(a: Assembly) -> None:
    length = a.u(1.6, 2.2)
    w = a.u(0.4, 0.55)
    z = 0.25
    a.add(box((length * 0.66, w, 0.05), (0, 0, z)), 0)
    for end, reach, rise in (
        (1, a.u(0.2, 0.3), a.u(0.35, 0.6)),
        (-1, a.u(0.14, 0.22), a.u(0.15, 0.35)),
    ):
        deck = box((length * reach, w * 0.92, 0.05), (length * reach / 2 - 0.01, 0, 0)).rotated(
            "y", -rise
        )
        deck = deck if end == 1 else deck.rotated("z", np.pi)
        a.add(deck.translated((end * length * 0.33, 0, z)), 0)
    for x in (-0.24 * length, 0.26 * length):
        a.add_pair(disc(0.09, 0.1, (x, w * 0.42, 0.09)), 2)
        a.add(rod((x, -w * 0.4, 0.1), (x, w * 0.4, 0.1), 0.04), 1)
        a.add(box((0.2, 0.15, 0.12), (x, 0, 0.18)), 1)
    a.add(box((length * 0.25, w * 0.98, 0.02), (length * a.u(0.05, 0.15), 0, z + 0.03)), 3)


def tram(a: Assembly) -> None:
    length = a.u(2.4, 3.2)
    w = a.u(0.7, 0.9)
    h = a.u(0.7, 0.9)
    floor = 0.15
    rake = a.u(0.1, 0.3)
    belt = floor + h * 0.45
    roof = floor + h
    front = [[length / 2, floor], [length / 2, belt]]
    rear = [[-length / 2, roof], [-length / 2, floor]]
    a.add(extrusion([*front, [length / 2 - rake, roof], *rear], w), 0)
    screen = box((0.03, w * 0.8, h * 0.36)).rotated("y", -np.arctan(rake / (roof - belt)))
    a.add(screen.translated((length / 2 - rake / 2 + 0.01, 0, (belt + roof) / 2)), 4)
    a.add(box((0.03, w * 0.5, h * 0.3), (-length / 2, 0, (belt + roof) / 2)), 4)
    for k in range(4):
        a.add_pair(
            box(
                (length * 0.15, 0.03, h * 0.3), ((k - 1.6) * length * 0.2, w / 2, (belt + roof) / 2)
            ),
            4,
        )
    a.add_pair(ellipsoid((0.04, 0.07, 0.06), (length / 2, w * 0.32, floor + 0.17)), 5)
    a.add_pair(box((0.04, 0.1, 0.08), (-length / 2, w * 0.35, floor + 0.2)), 6)
    for x in (-0.32, 0.32):
        a.add(box((length * 0.2, w * 0.8, 0.2), (x * length, 0, 0.1)), 3)
    arm = np.array([length * a.u(-0.05, 0.1), 0, roof + a.u(0.25, 0.4)])
    a.add(rod((arm[0] - length * a.u(0.1, 0.18), 0, roof), arm, 0.03), 3)
    a.add(box((0.05, w * 0.7, 0.03), arm), 3)


# Long bodies whose ends differ only in details measure errors of half a turn.
LONG_BODIES = (bed, bathtub, skateboard, tram)
OTHERS = (
    helicopter,
    wheelbarrow,
    watering_can,
    vacuum_cleaner,
    drill,
    dinosaur,
    mailbox,
    excavator,
)
VALIDATION = {build.__name__: build for build in (*OTHERS, *LONG_BODIES)}
