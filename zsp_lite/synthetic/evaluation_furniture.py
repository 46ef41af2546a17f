"""Evaluation categories that stand and hold. Each generator builds one object: front +x, up +z, left +y."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.evaluation_parts import Y, bolt_circle, rounded_box, tapered
from zsp_lite.synthetic.primitives import TAU, Mesh, box, capsule, cylinder, ellipsoid, lathe, rod, torus


def chair(a: Assembly) -> None:
    """Back of a panel, slats, rungs or a round frame; four legs, swivel star or sledge; arms or none."""
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
        a.add(mesh.turned("y", -lean).moved((-depth / 2 + thick / 2, 0, height)), material)

    style = a.pick(4)
    if style == 0:
        add_to_back(box((thick, width * a.u(0.8, 1), back), (0, 0, back / 2)), 1)
    elif style == 3:
        add_to_back(rounded_box((thick * 1.5, width * 0.95, back * 0.6), (0, 0, back * 0.7), 3), 1)
        for side in (-1, 1):
            add_to_back(rod((0, side * width * 0.3, 0), (0, side * width * 0.3, back * 0.6), leg), 2)
    else:
        n_posts = 4 + a.pick(3) if style == 1 else 2
        for y in np.linspace(-0.45, 0.45, n_posts) * width:
            add_to_back(box((thick * 0.7, 0.08, back), (0, y, back / 2)), 2)
        rung = back * a.u(0.1, 0.2)
        for share in (0.93,) if style == 1 else (0.35, 0.65, 0.95):
            add_to_back(box((thick * 0.8, width, rung), (0, 0, back * share)), 1)

    base = a.pick(4)
    if base == 0:
        a.add(rod((0, 0, 0.1), (0, 0, height), leg * 1.3), 2)
        for angle in np.arange(5) * TAU / 5 + a.u(0, 1):
            foot = 0.55 * np.array([np.cos(angle), np.sin(angle), 0])
            a.add(capsule((0, 0, 0.14), foot + [0, 0, 0.08], leg), 2)
            a.add(ellipsoid((0.06, 0.06, 0.06), foot + [0, 0, 0.04]), 3)
    elif base == 1:
        # A cantilever: one bent tube per side, open at the back.
        y, front, rear = width / 2 - 0.06, depth / 2 - 0.04, -depth / 2 + 0.06
        corners = [
            (rear, y, height - thick / 2),
            (front, y, height - thick / 2),
            (front, y, leg),
            (rear, y, leg),
        ]
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
        a.add(
            rounded_box((depth * a.u(0.7, 0.95), 0.12, 0.09), (-0.02, width / 2, height + rest), 5),
            3,
            mirror=True,
        )
        a.add(
            rod((depth * 0.3, width / 2, height), (depth * 0.3, width / 2, height + rest), leg),
            2,
            mirror=True,
        )
        a.add(
            rod((-depth * 0.38, width / 2, height), (-depth * 0.38, width / 2, height + rest), leg),
            2,
            mirror=True,
        )


def toilet(a: Assembly) -> None:
    """Bowl towards the front, seat, lid open or shut, cistern behind with a button or a lever on its side."""
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
    a.add(lathe(profile, 28).scaled((bowl_length, bowl_width, 1)).moved((bowl_x, 0, 0)), 0)
    a.add(
        rounded_box(
            (bowl_x + 0.15, bowl_width * foot * 1.5, seat_height * 0.95),
            (bowl_x * 0.35, 0, seat_height * 0.47),
            6,
        ),
        0,
    )
    stretch = (bowl_length, bowl_width, 0.5)
    a.add(torus(0.88, 0.14, sides=32).scaled(stretch).moved((bowl_x, 0, seat_height + 0.04)), 1)
    lid = ellipsoid((bowl_length * 1.02, bowl_width * 1.02, 0.04), (bowl_length, 0, 0), sides=28)
    open_lid = a.chance(0.6)
    hinge = (bowl_x - bowl_length, 0, seat_height + 0.1)
    a.add(lid.turned("y", -a.u(1.6, 1.85) if open_lid else -0.02).moved(hinge), 1 if a.chance(0.6) else 2)
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
        a.add(cylinder(0.08, 0.08, 0.04).moved((tank_x, 0, tank_base + tank_height + 0.06)), 5)
    else:
        lever = (tank_x + tank_depth / 2 + 0.03, tank_width * 0.32, tank_base + tank_height * 0.82)
        a.add(rod(lever, np.add(lever, [0.03, -0.2, -0.02]), 0.03), 5)
    for y in (-0.1, 0.1):
        a.add(rod((hinge[0] + 0.02, y - 0.04, hinge[2]), (hinge[0] + 0.02, y + 0.04, hinge[2]), 0.04), 5)


def hydrant(a: Assembly) -> None:
    """Barrel on a flange under a bonnet; the big outlet looks forwards, two small ones sideways; chains."""
    radius, height = a.u(0.24, 0.36), a.u(0.9, 1.35)
    neck = radius * a.u(0.85, 1)
    a.add(
        lathe(
            [
                [0.001, 0],
                [radius * 1.45, 0],
                [radius * 1.45, 0.09],
                [radius, 0.11],
                [neck, height * 0.75],
                [radius * 1.22, height * 0.76],
                [radius * 1.22, height * 0.82],
                [neck, height * 0.83],
            ],
            24,
        ),
        0,
    )
    cap = height * 0.82
    if a.chance(0.5):
        dome = [[radius * np.cos(t), cap + height * 0.25 * np.sin(t)] for t in np.linspace(0, np.pi / 2, 7)]
    else:
        dome = [
            [radius * 1.05, cap],
            [radius * 0.9, cap + height * 0.14],
            [radius * 0.35, cap + height * 0.2],
            [0.001, cap + height * 0.22],
        ]
    a.add(lathe(dome, 24), 1 if a.chance(0.6) else 0)
    top = max(point[1] for point in dome)
    a.add(rod((0, 0, top - 0.04), (0, 0, top + a.u(0.07, 0.14)), 0.07, sides=6), 2)

    outlet, bore = height * a.u(0.5, 0.64), a.u(0.15, 0.21)
    reach = radius + a.u(0.14, 0.26)
    a.add(rod((0, 0, outlet), (reach, 0, outlet), bore), 0)
    a.add(rod((reach - 0.02, 0, outlet), (reach + 0.1, 0, outlet), bore * 1.2, sides=8), 1)
    a.add(rod((reach + 0.08, 0, outlet), (reach + 0.18, 0, outlet), 0.055, sides=5), 2)
    side_outlet, side_bore = outlet + a.u(-0.03, 0.13), a.u(0.09, 0.13)
    side_reach = radius + a.u(0.1, 0.2)
    a.add(rod((0, 0, side_outlet), (0, side_reach, side_outlet), side_bore), 0, mirror=True)
    a.add(
        rod(
            (0, side_reach - 0.02, side_outlet),
            (0, side_reach + 0.08, side_outlet),
            side_bore * 1.22,
            sides=8,
        ),
        1,
        mirror=True,
    )
    a.add(
        rod((0, side_reach + 0.06, side_outlet), (0, side_reach + 0.14, side_outlet), 0.045, sides=5),
        2,
        mirror=True,
    )
    for angle in np.arange(8) * TAU / 8 + 0.2:
        a.add(
            cylinder(0.035, 0.035, 0.05, 6).moved((radius * 1.27 * np.cos(angle), radius * 1.27 * np.sin(angle), 0.11)),
            2,
        )
    if a.chance(0.5):
        bolt_circle(a, (reach + 0.1, 0, outlet), bore * 0.85, 6, 0.025, 2)
    if a.chance(0.6):
        a.add(torus(a.u(0.1, 0.16), 0.018, Y, (radius + 0.12, 0.03, outlet - bore - 0.08)), 3)
    if a.chance(0.4):
        a.add(
            lathe(
                [
                    [radius * 1.08, height * 0.2],
                    [radius * 1.12, height * 0.22],
                    [radius * 1.08, height * 0.3],
                ],
                24,
            ),
            4,
        )


def backpack(a: Assembly) -> None:
    """School bag or rucksack with a flap: pockets at the front, shoulder straps behind, handle on top."""
    depth, width, height = a.u(0.42, 0.62), a.u(0.7, 1.0), a.u(1.1, 1.5)
    body = rounded_box((depth, width, height), (0, 0, height / 2), a.u(3.5, 6))
    narrowing = a.u(0.7, 1.0)
    a.add(tapered(body, height * 0.5, height, narrowing), 0)
    flap = a.chance(0.4)
    pocket_height, pocket_depth = height * a.u(0.35, 0.5), depth * a.u(0.45, 0.7)
    pocket_z = height * a.u(0.06, 0.12) + pocket_height / 2
    a.add(rounded_box((pocket_depth, width * a.u(0.65, 0.85), pocket_height), (depth / 2, 0, pocket_z), 4), 1)
    a.add(
        box((0.03, width * 0.6, 0.03), (depth / 2 + pocket_depth * 0.45, 0, pocket_z + pocket_height * 0.28)),
        3,
    )
    if flap:
        hood = rounded_box((depth * 1.15, width * 1.02, height * 0.3), (depth * 0.08, 0, height * 0.92), 4)
        a.add(tapered(hood, height * 0.5, height, narrowing * 1.05), 2)
        for y in (0.2, -0.2):
            a.add(box((0.04, 0.07, height * 0.38), (depth * 0.6, y * width, height * 0.66)), 3)
            a.add(box((0.06, 0.1, 0.08), (depth * 0.62, y * width, height * 0.56)), 5)
    else:
        a.add(
            rounded_box((depth * 0.4, width * 0.6, height * a.u(0.18, 0.26)), (depth * 0.38, 0, height * 0.74), 4),
            2,
        )
        seam = torus(0.5, 0.015, (1, 0, 0), (0.05, 0, height * 0.55), np.pi / 2, 1.5 * np.pi, sides=20)
        a.add(seam.scaled((1, width * 1.0, 1)).moved((0, 0, 0)), 3)
    a.add(
        torus(
            a.u(0.08, 0.13),
            0.03,
            (1, 0, 0),
            (-depth * 0.3, 0, height * 1.0),
            np.pi / 2,
            1.5 * np.pi,
            sides=12,
        ),
        3,
    )
    strap_y, bulge = width * a.u(0.22, 0.3), a.u(0.12, 0.22)
    back = -depth / 2
    bends = [
        (back + 0.02, strap_y * 0.8, height * 0.93),
        (back - bulge, strap_y, height * 0.78),
        (back - bulge, strap_y * 1.15, height * 0.42),
        (back + 0.02, strap_y * 1.35, height * 0.12),
    ]
    for start, end in zip(bends, bends[1:]):
        a.add(capsule(start, end, 0.05), 4, mirror=True)
    if a.chance(0.6):
        side = lathe([[0.12, 0], [0.15, 0.35], [0.14, 0.35], [0.001, 0.3]], 14).moved((0, width / 2, height * 0.08))
        a.add(side, 2, mirror=True)
        if a.chance(0.5):
            a.add(cylinder(0.1, 0.1, 0.55).moved((0, width / 2, height * 0.08 + 0.35)), 6)
