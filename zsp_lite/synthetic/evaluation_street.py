"""Evaluation categories of the street (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.evaluation_parts import Y, bolt_circle, pane, rounded_box, tapered, wheel_pair
from zsp_lite.synthetic.primitives import TAU, box, capsule, cylinder, ellipsoid, extrusion, lathe, rod, torus


def bicycle(a: Assembly) -> None:
    """Build a bicycle: diamond or step-through frame; flat, swept or drop bars; optional basket, rack, mudguards."""
    wheel, tyre, tube = a.u(0.36, 0.52), a.u(0.022, 0.05), a.u(0.028, 0.048)
    half_base = a.u(0.5, 0.66)
    front, rear = np.array([half_base, 0, wheel]), np.array([-half_base, 0, wheel])
    for hub in (front, rear):
        a.add(torus(wheel - tyre, tyre, Y, hub, sides=32), 3)
        a.add(rod(hub - [0, 0.08, 0], hub + [0, 0.08, 0], 0.05), 2)
        for angle in np.arange(10) * TAU / 10:
            rim = hub + (wheel - tyre) * np.array([np.cos(angle), 0, np.sin(angle)])
            a.add(rod(hub, rim, 0.011, sides=5), 2)

    rise = a.u(0.5, 0.8)
    head = front + [-a.u(0.2, 0.32), 0, rise]
    saddle = rear + [a.u(0.22, 0.38), 0, rise * a.u(0.7, 0.98)]
    crank = np.array([a.u(-0.12, 0.04), 0, wheel * a.u(0.6, 0.9)])
    step_through = a.chance(0.35)
    top_tube_end = crank + (saddle - crank) * (0.35 if step_through else 0.85)
    a.add(rod(head, front + [0, 0.07, 0], tube * 0.8), 2, mirror=True)
    for start, end in ((head - [0, 0, 0.14], crank), (saddle, crank), (head - [0, 0, 0.06], top_tube_end)):
        a.add(rod(start, end, tube), 0)
    for end in (crank, saddle - [0, 0, 0.12]):
        a.add(rod(rear + [0, 0.05, 0], end, tube * 0.6), 0, mirror=True)
    a.add(ellipsoid((a.u(0.15, 0.24), a.u(0.06, 0.11), 0.05), saddle + [0, 0, 0.05]), 4)

    stem = head + [0.02, 0, a.u(0.08, 0.2)]
    a.add(rod(head, stem, tube), 2)
    reach = a.u(0.25, 0.4)
    style = a.choice(3)
    if style == 0:
        a.add(rod(stem, stem + [-0.03, reach, 0.02], 0.024), 3, mirror=True)
    elif style == 1:
        bend = stem + [0.02, reach, a.u(0.05, 0.15)]
        a.add(rod(stem, bend, 0.024), 3, mirror=True)
        a.add(capsule(bend, bend + [-a.u(0.15, 0.28), 0.02, -0.02], 0.028), 3, mirror=True)
    else:
        a.add(rod(stem, stem + [0.06, reach * 0.7, 0], 0.024), 3, mirror=True)
        hook = stem + [0.06, reach * 0.7, -0.09]
        a.add(torus(0.09, 0.024, Y, hook, 0, np.pi, sides=12), 3, mirror=True)

    for side, foot in ((1, 0.13), (-1, -0.13)):
        pedal = crank + [foot, side * 0.13, -foot]
        a.add(rod(crank + [0, side * 0.09, 0], pedal, 0.02), 2)
        a.add(box((0.1, 0.1, 0.025), pedal + [0, side * 0.05, 0]), 3)
    # The chain ring of a bicycle is on its right side.
    a.add(cylinder(0.12, 0.12, 0.02).rotated("x", np.pi / 2).translated(crank - [0, 0.06, 0]), 2)
    if a.chance(0.35):
        a.add(box((0.28, 0.34, 0.22), head + [0.2, 0, 0.05]), 5)
    if a.chance(0.4):
        a.add(box((0.5, 0.16, 0.03), rear + [-0.02, 0, wheel + 0.1]), 5)
        a.add(rod(rear + [-0.1, 0.07, 0], rear + [-0.15, 0.07, wheel + 0.1], 0.015), 5, mirror=True)
    if a.chance(0.4):
        a.add(torus(wheel + 0.035, 0.028, Y, rear, -1.7, 0.4, sides=16), 0)
        a.add(torus(wheel + 0.035, 0.028, Y, front, -0.9, 0.6, sides=16), 0)


def motorcycle(a: Assembly) -> None:
    """Build a cruiser, a sport motorcycle with a fairing, or a scooter with a leg shield; exhaust on the right."""
    style = a.choice(3)
    scooter = style == 2
    wheel = a.u(0.26, 0.32) if scooter else a.u(0.36, 0.46)
    tyre = a.u(0.07, 0.11)
    half_base = a.u(0.6, 0.72) + (0.1 if style == 0 else 0)
    front, rear = np.array([half_base, 0, wheel]), np.array([-half_base, 0, wheel])
    for hub in (front, rear):
        a.add(torus(wheel - tyre, tyre, Y, hub), 3)
        a.add(cylinder(wheel * 0.62, wheel * 0.62, 0.06, 16).rotated("x", np.pi / 2).translated(hub), 2)
        a.add(cylinder(wheel * 0.25, wheel * 0.25, 0.2, 12).rotated("x", np.pi / 2).translated(hub), 2)
    a.add(torus(wheel + 0.04, 0.05, Y, rear, -1.5, 0.6, sides=14), 0)
    a.add(torus(wheel + 0.04, 0.05, Y, front, -0.8, 0.7, sides=14), 0)

    head = front + [-a.u(0.2, 0.28) - (0.15 if style == 0 else 0), 0, a.u(0.55, 0.72)]
    a.add(rod(head, front + [0, 0.11, 0], 0.04), 2, mirror=True)
    a.add(ellipsoid((0.1, 0.12, 0.12), head + [0.12, 0, a.u(-0.06, 0.04)]), 4)
    grip_height = (a.u(0.2, 0.4), a.u(0.02, 0.1), a.u(0.15, 0.25))[style]
    grip = head + [-a.u(0.12, 0.25), a.u(0.3, 0.42), grip_height]
    a.add(rod(head, grip + [0.1, -0.06, 0], 0.026), 2, mirror=True)
    a.add(capsule(grip + [0.1, -0.06, 0], grip, 0.035), 3, mirror=True)
    if a.chance(0.6):
        a.add(rod(grip + [0.1, -0.06, 0], grip + [0.12, 0.04, 0.18], 0.012), 3, mirror=True)
        a.add(ellipsoid((0.015, 0.08, 0.05), grip + [0.12, 0.05, 0.2]), 5, mirror=True)

    seat_height = wheel * 2 + a.u(0.0, 0.12)
    if scooter:
        floor = wheel * a.u(0.75, 1.0)
        a.add(pane((half_base - 0.3, floor), head[[0, 2]] + [0.0, 0.02], a.u(0.4, 0.55), 0.07), 0)
        a.add(box((half_base * 1.1, 0.36, 0.08), (0.0, 0, floor)), 0)
        a.add(
            rounded_box(
                (half_base * 1.15, 0.42, seat_height - floor + 0.1),
                (-half_base * 0.75, 0, (seat_height + floor) / 2),
                4,
            ),
            0,
        )
        a.add(rounded_box((half_base * 1.05, 0.36, 0.14), (-half_base * 0.65, 0, seat_height + 0.08), 3), 6)
        a.add(box((0.06, 0.2, 0.09), (-half_base * 1.35, 0, seat_height * 0.85)), 5)
    else:
        engine = np.array([a.u(-0.08, 0.08), 0, wheel * a.u(0.85, 1.1)])
        a.add(box((a.u(0.4, 0.55), 0.3, a.u(0.3, 0.42)), engine), 1)
        for lean in (-0.12, 0.14):
            a.add(rod(engine, engine + [lean, 0, 0.34], 0.12), 2)
        tank = np.array([head[0] * 0.45, 0, seat_height + 0.14])
        a.add(ellipsoid((a.u(0.28, 0.36), a.u(0.14, 0.19), a.u(0.13, 0.18)), tank), 0)
        for start, end in ((head, engine), (head, tank), (engine, rear), (rear, rear * [0.8, 1, 1] + [0, 0, 0.35])):
            a.add(rod(np.add(start, [0, 0.04, 0]), np.add(end, [0, 0.06, 0]), 0.032), 2, mirror=True)
        a.add(rounded_box((half_base * 0.95, 0.28, 0.13), (-half_base * 0.48, 0, seat_height), 3), 6)
        back = (-half_base * a.u(0.95, 1.25), seat_height + a.u(0.08, 0.25))
        a.add(capsule((-half_base * 0.7, 0, seat_height), (back[0], 0, back[1]), 0.12, 0.06), 0)
        a.add(box((0.05, 0.16, 0.08), (back[0] - 0.08, 0, back[1])), 5)
        if style == 1:
            fairing = [
                [head[0] + 0.3, head[2] - 0.1],
                [head[0] - 0.05, head[2] + 0.12],
                [0.05, wheel * 1.6],
                [0.0, wheel * 0.6],
                [0.35, wheel * 0.9],
            ]
            a.add(tapered(extrusion(fairing, a.u(0.34, 0.44)), wheel, head[2] + 0.12, 0.55), 0)
            a.add(pane(head[[0, 2]] + [0.15, 0.05], head[[0, 2]] + [-0.05, 0.28], 0.24), 5)
        elif a.chance(0.4):
            a.add(pane(head[[0, 2]] + [0.1, 0.1], head[[0, 2]] + [-0.05, 0.5], 0.4), 5)
    exhaust_end = np.array([-half_base * a.u(0.9, 1.3), -0.22, wheel * a.u(0.7, 1.3)])
    a.add(rod((0.05, -0.2, wheel * 0.6), exhaust_end, 0.05, a.u(0.06, 0.09)), 7)


def car(a: Assembly) -> None:
    """Build a saloon, hatchback, pickup or van: bonnet, cabin with windows, lights, wheels."""
    style = a.choice(4)
    length, width = a.u(2.2, 2.8), a.u(0.95, 1.15)
    wheel = a.u(0.2, 0.27)
    sill, belt = wheel * a.u(0.6, 0.9), wheel * a.u(2.1, 2.5)
    roof = belt + a.u(0.3, 0.45) + (0.15 if style == 3 else 0)
    nose, tail = length / 2, -length / 2
    bonnet_end = nose - length * ((0.28, 0.26, 0.27, 0.14)[style] + a.u(-0.03, 0.04))
    boot_start = tail + length * ((0.17, 0.02, 0.42, 0.01)[style] + a.u(0, 0.02))
    nose_height = belt - (belt - sill) * a.u(0.15, 0.35)
    body = [
        [tail, sill],
        [nose, sill],
        [nose + 0.03, (sill + nose_height) / 2],
        [nose - 0.04, nose_height],
        [bonnet_end, belt],
        [boot_start, belt],
        [tail, belt - a.u(0, 0.06)],
    ]
    a.add(tapered(extrusion(body, width), sill, belt, 0.94), 0)

    slope, back_slope = a.u(0.2, 0.38), (a.u(0.12, 0.3), a.u(0.1, 0.3), a.u(0.02, 0.08), a.u(0, 0.06))[style]
    windscreen, rear_window = (bonnet_end + 0.03, belt), (boot_start, belt)
    roof_front, roof_rear = (bonnet_end - slope, roof), (boot_start + back_slope, roof)
    taper = a.u(0.76, 0.88)
    cabin = extrusion([rear_window, windscreen, roof_front, roof_rear], width * 0.92)
    a.add(tapered(cabin, belt, roof, taper), 0)
    # Side windows: the outline of the cabin, reduced in size, slightly wider, and divided by pillars.
    middle = np.mean([rear_window, windscreen, roof_front, roof_rear], axis=0)
    low_rear, low_front, top_front, top_rear = (
        middle + (np.array(corner) - middle) * [0.86, 0.7]
        for corner in (rear_window, windscreen, roof_front, roof_rear)
    )
    n_windows = 1 if style == 2 else 2 + a.choice(2)
    for k in range(n_windows):
        start, stop = (k + 0.04) / n_windows, (k + 0.96) / n_windows
        window = [
            low_rear + (low_front - low_rear) * start,
            low_rear + (low_front - low_rear) * stop,
            top_rear + (top_front - top_rear) * stop,
            top_rear + (top_front - top_rear) * start,
        ]
        a.add(tapered(extrusion(window, width * 0.94), belt, roof, taper), 4)
    for bottom, top, out in ((windscreen, roof_front, 0.015), (rear_window, roof_rear, -0.015)):
        bottom, top = np.array(bottom) + [out, 0], np.array(top) + [out, 0]
        glass = pane(bottom + (top - bottom) * 0.12, bottom + (top - bottom) * 0.88, width * 0.8, 0.03)
        a.add(tapered(glass, belt, roof, taper), 4)

    if style == 2:
        bed = (boot_start + tail) / 2
        wall = a.u(0.08, 0.18)
        a.add(box((boot_start - tail, 0.06, wall), (bed, width * 0.44, belt + wall / 2)), 0, mirror=True)
        a.add(box((0.06, width * 0.9, wall), (tail + 0.03, 0, belt + wall / 2)), 0)
    light_height = sill + (nose_height - sill) * 0.72
    a.add(
        ellipsoid((0.06, a.u(0.09, 0.15), a.u(0.05, 0.08)), (nose - 0.01, width * 0.34, light_height)), 5, mirror=True
    )
    a.add(box((0.05, width * a.u(0.25, 0.4), a.u(0.07, 0.12)), (nose + 0.01, 0, light_height - 0.02)), 6)
    a.add(box((0.04, 0.1, a.u(0.1, 0.2)), (tail - 0.01, width * 0.4, belt - 0.16)), 7, mirror=True)
    a.add(rounded_box((0.12, width * 1.0, 0.12), (nose + 0.02, 0, sill + 0.06), 4), 2)
    a.add(rounded_box((0.12, width * 1.0, 0.12), (tail - 0.02, 0, sill + 0.06), 4), 2)
    a.add(ellipsoid((0.05, 0.08, 0.05), (bonnet_end - 0.12, width * 0.53, belt + 0.06)), 0, mirror=True)
    for x in (nose - length * a.u(0.16, 0.2), tail + length * a.u(0.17, 0.21)):
        wheel_pair(a, x, width / 2 - 0.05, wheel, 0.16, 3, 2)
    if style == 0 and a.chance(0.3):
        a.add(box((0.14, width * 0.85, 0.03), (tail + 0.08, 0, belt + 0.14)), 0)
        a.add(box((0.08, 0.03, 0.14), (tail + 0.1, width * 0.3, belt + 0.07)), 0, mirror=True)
    if style in (1, 3) and a.chance(0.4):
        rail = (roof_front[0] - roof_rear[0]) * 0.8
        a.add(box((rail, 0.03, 0.05), (middle[0] - 0.05, width * 0.3, roof + 0.05)), 3, mirror=True)


def hydrant(a: Assembly) -> None:
    """Build a hydrant: barrel, flange and bonnet; large outlet at the front, small outlets at the sides; chain."""
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
        rod((0, side_reach - 0.02, side_outlet), (0, side_reach + 0.08, side_outlet), side_bore * 1.22, sides=8),
        1,
        mirror=True,
    )
    a.add(rod((0, side_reach + 0.06, side_outlet), (0, side_reach + 0.14, side_outlet), 0.045, sides=5), 2, mirror=True)
    for angle in np.arange(8) * TAU / 8 + 0.2:
        a.add(
            cylinder(0.035, 0.035, 0.05, 6).translated(
                (radius * 1.27 * np.cos(angle), radius * 1.27 * np.sin(angle), 0.11)
            ),
            2,
        )
    if a.chance(0.5):
        bolt_circle(a, (reach + 0.1, 0, outlet), bore * 0.85, 6, 0.025, 2)
    if a.chance(0.6):
        a.add(torus(a.u(0.1, 0.16), 0.018, Y, (radius + 0.12, 0.03, outlet - bore - 0.08)), 3)
    if a.chance(0.4):
        a.add(
            lathe([[radius * 1.08, height * 0.2], [radius * 1.12, height * 0.22], [radius * 1.08, height * 0.3]], 24), 4
        )
