"""Evaluation categories of the household (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.evaluation_parts import rounded_box
from zsp_lite.synthetic.primitives import TAU, Mesh, box, capsule, cylinder, ellipsoid, extrusion, lathe, rod, torus


def chair(a: Assembly) -> None:
    """Build a chair: back of a panel, slats, rungs or a round frame; legs, swivel base or cantilever; optional arms."""
    width, depth, height = a.u(0.8, 1.2), a.u(0.8, 1.1), a.u(0.6, 1.1)
    thick, back, leg = a.u(0.06, 0.16), a.u(0.7, 1.3), a.u(0.03, 0.075)
    seat = (
        rounded_box((depth, width, thick * 1.4), (0, 0, height), 6)
        if a.chance(0.4)
        else box((depth, width, thick), (0, 0, height))
    )
    a.add(seat, 0)

    lean = a.u(0, 0.3)

    def add_to_back(mesh: Mesh, material: int) -> None:
        a.add(mesh.rotated("y", -lean).translated((-depth / 2 + thick / 2, 0, height)), material)

    style = a.choice(4)
    if style == 0:
        add_to_back(box((thick, width * a.u(0.8, 1), back), (0, 0, back / 2)), 1)
    elif style == 3:
        add_to_back(rounded_box((thick * 1.5, width * 0.95, back * 0.6), (0, 0, back * 0.7), 3), 1)
        for side in (-1, 1):
            add_to_back(rod((0, side * width * 0.3, 0), (0, side * width * 0.3, back * 0.6), leg), 2)
    else:
        n_posts = 4 + a.choice(3) if style == 1 else 2
        for y in np.linspace(-0.45, 0.45, n_posts) * width:
            add_to_back(box((thick * 0.7, 0.08, back), (0, y, back / 2)), 2)
        rung = back * a.u(0.1, 0.2)
        for share in (0.93,) if style == 1 else (0.35, 0.65, 0.95):
            add_to_back(box((thick * 0.8, width, rung), (0, 0, back * share)), 1)

    base = a.choice(4)
    if base == 0:
        a.add(rod((0, 0, 0.1), (0, 0, height), leg * 1.3), 2)
        for angle in np.arange(5) * TAU / 5 + a.u(0, 1):
            foot = 0.55 * np.array([np.cos(angle), np.sin(angle), 0])
            a.add(capsule((0, 0, 0.14), foot + [0, 0, 0.08], leg), 2)
            a.add(ellipsoid((0.06, 0.06, 0.06), foot + [0, 0, 0.04]), 3)
    elif base == 1:
        # A cantilever: one bent tube per side, open at the back.
        y, front, rear = width / 2 - 0.06, depth / 2 - 0.04, -depth / 2 + 0.06
        corners = [(rear, y, height - thick / 2), (front, y, height - thick / 2), (front, y, leg), (rear, y, leg)]
        for start, end in zip(corners, corners[1:]):
            a.add(capsule(start, end, leg), 2, mirror=True)
        a.add(rod((rear, y, leg), (rear, -y, leg), leg), 2)
    else:
        splay, foot = a.u(0, 0.14), leg * a.u(0.6, 1)
        for side in (-1, 1):
            x, y = depth / 2 - 0.08, width / 2 - 0.08
            a.add(rod((side * x, y, height), (side * (x + splay), y + splay, 0), leg, foot), 2, mirror=True)
        if a.chance(0.4):
            a.add(rod((0, width / 2 - 0.05, height * 0.4), (0, -width / 2 + 0.05, height * 0.4), leg * 0.7), 2)
            y = width / 2 - 0.06
            a.add(rod((depth / 2, y, height * 0.4), (-depth / 2, y, height * 0.4), leg * 0.7), 2, mirror=True)
    if a.chance(0.45):
        rest = a.u(0.22, 0.4)
        a.add(rounded_box((depth * a.u(0.7, 0.95), 0.12, 0.09), (-0.02, width / 2, height + rest), 5), 3, mirror=True)
        a.add(rod((depth * 0.3, width / 2, height), (depth * 0.3, width / 2, height + rest), leg), 2, mirror=True)
        a.add(rod((-depth * 0.38, width / 2, height), (-depth * 0.38, width / 2, height + rest), leg), 2, mirror=True)


def toilet(a: Assembly) -> None:
    """Build a toilet: bowl at the front, seat, open or closed lid, cistern behind with a button or a side lever."""
    bowl_length, bowl_width, seat_height = a.u(0.5, 0.66), a.u(0.36, 0.46), a.u(0.6, 0.8)
    foot = a.u(0.5, 0.75)
    bowl_x = bowl_length * 0.75
    profile = [
        [0.001, 0],
        [foot * 0.9, 0],
        [foot * 0.8, seat_height * 0.3],
        [0.95, seat_height * 0.75],
        [1, seat_height],
        [0.78, seat_height],
        [0.55, seat_height * 0.72],
        [0.001, seat_height * 0.55],
    ]
    a.add(lathe(profile, 28).scaled((bowl_length, bowl_width, 1)).translated((bowl_x, 0, 0)), 0)
    a.add(
        rounded_box(
            (bowl_x + 0.15, bowl_width * foot * 1.5, seat_height * 0.95), (bowl_x * 0.35, 0, seat_height * 0.47), 6
        ),
        0,
    )
    stretch = (bowl_length, bowl_width, 0.5)
    a.add(torus(0.88, 0.14, sides=32).scaled(stretch).translated((bowl_x, 0, seat_height + 0.04)), 1)
    lid = ellipsoid((bowl_length * 1.02, bowl_width * 1.02, 0.04), (bowl_length, 0, 0), sides=28)
    open_lid = a.chance(0.6)
    hinge = (bowl_x - bowl_length, 0, seat_height + 0.1)
    a.add(lid.rotated("y", -a.u(1.6, 1.85) if open_lid else -0.02).translated(hinge), 1 if a.chance(0.6) else 2)
    tank_depth, tank_width, tank_height = a.u(0.28, 0.38), bowl_width * a.u(1.7, 2.3), a.u(0.6, 0.9)
    tank_x, tank_base = (
        bowl_x - bowl_length - tank_depth / 2 - (0.12 if open_lid else 0),
        seat_height * a.u(0.85, 1.05),
    )
    tank = rounded_box((tank_depth, tank_width, tank_height), (tank_x, 0, tank_base + tank_height / 2), a.u(5, 12))
    a.add(tank, 0)
    a.add(
        rounded_box((tank_depth * 1.12, tank_width * 1.06, 0.09), (tank_x, 0, tank_base + tank_height), 8),
        3 if a.chance(0.3) else 0,
    )
    a.add(box((tank_depth * 1.2, tank_width * 0.45, tank_base), (tank_x + 0.1, 0, tank_base / 2)), 0)
    if a.chance(0.5):
        a.add(cylinder(0.08, 0.08, 0.04).translated((tank_x, 0, tank_base + tank_height + 0.06)), 5)
    else:
        lever = (tank_x + tank_depth / 2 + 0.03, tank_width * 0.32, tank_base + tank_height * 0.82)
        a.add(rod(lever, np.add(lever, [0.03, -0.2, -0.02]), 0.03), 5)
    for y in (-0.1, 0.1):
        a.add(rod((hinge[0] + 0.02, y - 0.04, hinge[2]), (hinge[0] + 0.02, y + 0.04, hinge[2]), 0.04), 5)


def hairdryer(a: Assembly) -> None:
    """Build a hair dryer: barrel, nozzle or diffuser at the front, grille at the back, handle below with switches."""
    length, radius = a.u(0.9, 1.3), a.u(0.22, 0.34)
    mouth = radius * a.u(0.55, 0.85)
    profile = [
        [0.001, -length * 0.42],
        [radius * 0.7, -length * 0.43],
        [radius, -length * 0.3],
        [radius, 0],
        [mouth, length * 0.58],
        [0.001, length * 0.58],
    ]
    a.add(lathe(profile, 24).rotated("y", np.pi / 2), 0)
    front = np.array([length * 0.57, 0, 0])
    style = a.choice(3)
    if style == 0:
        a.add(rod(front, front + [a.u(0.12, 0.3), 0, 0], mouth * 1.03, mouth * a.u(0.6, 0.95)), 1)
    elif style == 1:
        # A concentrator nozzle becomes flat towards its slot.
        reach = a.u(0.25, 0.4)
        cone = cylinder(mouth, mouth, reach, 20).translated((0, 0, reach / 2))
        share = cone.vertices[:, 2:] / reach
        slot = 1 + share * (np.array([a.u(0.25, 0.45), a.u(1.0, 1.5), 1]) - 1)
        a.add(
            Mesh(cone.vertices * np.where(np.arange(3) == 2, 1, slot), cone.faces)
            .rotated("y", np.pi / 2)
            .translated(front),
            1,
        )
    else:
        reach = a.u(0.2, 0.3)
        bowl = [
            [mouth * 0.9, 0],
            [mouth * 1.05, reach * 0.3],
            [radius * 1.4, reach],
            [radius * 1.3, reach],
            [0.001, reach * 0.8],
        ]
        a.add(lathe(bowl, 24).rotated("y", np.pi / 2).translated(front), 1)
    a.add(torus(radius * 0.68, 0.035, (1, 0, 0), (-length * 0.42, 0, 0)), 3)
    for y in (-0.4, 0, 0.4):
        a.add(box((0.03, 0.03, radius * 1.1), (-length * 0.435, y * radius, 0)), 3)
    drop, rake = a.u(0.7, 1.1), a.u(-0.25, 0.15)
    top, bottom = np.array([-0.08, 0, -radius * 0.5]), np.array([-0.08 + rake, 0, -drop])
    a.add(capsule(top, bottom, a.u(0.11, 0.16), a.u(0.09, 0.13)), 0 if a.chance(0.5) else 2)
    switch = top + (bottom - top) * a.u(0.35, 0.6)
    a.add(box((0.06, 0.1, 0.22), switch + [0.13, 0, 0]), 3)
    if a.chance(0.5):
        a.add(box((0.05, 0.08, 0.08), switch + [0.13, 0, 0.2]), 5)
    if a.chance(0.5):
        a.add(torus(radius * 1.02, 0.02, (1, 0, 0), (-length * 0.1, 0, 0)), 4)
    tail = bottom + [-a.u(0.1, 0.35), a.u(-0.2, 0.2), -0.3]
    a.add(capsule(bottom - [0, 0, 0.08], tail, 0.035, 0.025), 3)


def toaster(a: Assembly) -> None:
    """Build a toaster: two or four slots; lever, dial and buttons at the front end; nearly symmetric otherwise."""
    length, width, height = a.u(1.0, 1.6), a.u(0.55, 0.85), a.u(0.65, 0.95)
    feet = a.u(0.03, 0.08)
    middle = feet + height / 2
    style = a.choice(3)
    if style == 0:
        a.add(rounded_box((length, width, height), (0, 0, middle), a.u(4, 9)), 0)
    elif style == 1:
        # A retro body: an arch across, with flat end plates of another material.
        angle = np.linspace(0, np.pi, 13)
        arch = np.stack(
            [
                width / 2 * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.6,
                feet + height * (0.35 + 0.65 * np.sin(angle) ** 0.6),
            ],
            1,
        )
        arch = np.concatenate([[[width / 2, feet]], arch, [[-width / 2, feet]]])
        a.add(extrusion(arch, length * 0.84, "yz"), 0)
        for end in (-1, 1):
            cheek = (arch - [0, middle]) * [1.03, 1.02] + [0, middle]
            a.add(extrusion(cheek, length * 0.09, "yz", end * length * 0.455), 1)
    else:
        a.add(box((length * 0.96, width, height), (0, 0, middle)), 0)
        a.add(box((length, width * 0.86, height * 0.9), (0, 0, middle)), 1)
    top = feet + height
    a.add(box((length * 0.8, width * 0.78, 0.03), (0, 0, top)), 2)
    rows = (-0.22, 0.22) if a.chance(0.75) else (0.0,)
    halves = (-0.21, 0.21) if length > 1.35 and a.chance(0.6) else (0.0,)
    slot = length * (0.34 if len(halves) == 2 else 0.66)
    toasting = a.chance(0.3)
    for y in rows:
        for x in halves:
            a.add(box((slot, 0.1, 0.02), (x * length, y * width, top + 0.016)), 3)
            if toasting:
                a.add(rounded_box((slot * 0.9, 0.07, 0.5), (x * length, y * width, top + a.u(-0.12, 0.0)), 6), 6)

    end = length / 2
    travel = a.u(0.25, 0.45) * height
    lever_height = middle + a.u(-0.1, 0.25) * height
    a.add(box((0.02, 0.05, travel), (end, 0, middle + 0.05)), 3)
    a.add(rounded_box((0.16, a.u(0.14, 0.3), 0.08), (end + 0.07, 0, lever_height), 4), 4)
    knob_y = a.u(0.18, 0.28) * width
    a.add(
        rod((end - 0.03, knob_y, feet + height * 0.25), (end + 0.07, knob_y, feet + height * 0.25), a.u(0.06, 0.1)), 5
    )
    for k in range(1 + a.choice(3)):
        a.add(
            rod(
                (end - 0.03, -knob_y, feet + height * (0.2 + 0.14 * k)),
                (end + 0.04, -knob_y, feet + height * (0.2 + 0.14 * k)),
                0.035,
            ),
            5,
        )
    for x in (-0.36, 0.36):
        a.add(cylinder(0.06, 0.07, feet * 2).translated((x * length, width * 0.32, feet / 2)), 3, mirror=True)
    if a.chance(0.6):
        a.add(capsule((-end + 0.02, 0.1, feet + 0.1), (-end - a.u(0.1, 0.25), a.u(-0.2, 0.2), 0.03), 0.025), 3)
    if a.chance(0.4):
        a.add(box((length * 0.8, width * 1.02, height * 0.08), (0, 0, feet + height * 0.12)), 7)
