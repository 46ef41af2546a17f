"""Vehicles and street furniture (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.categories.parts import Y, add_wheels, disc, pane, rounded_box, tapered
from zsp_lite.synthetic.primitives import TAU, box, capsule, cylinder, ellipsoid, extrusion, lathe, rod, torus


def bicycle(a: Assembly) -> None:
    """Build a bicycle: diamond or step-through frame; flat, swept or drop bars; optional basket, rack, mudguards."""
    wheel, tyre, tube, half_base = a.u(0.36, 0.52), a.u(0.022, 0.05), a.u(0.028, 0.048), a.u(0.5, 0.66)
    front, rear = np.array([half_base, 0, wheel]), np.array([-half_base, 0, wheel])
    for hub in (front, rear):
        a.add(torus(wheel - tyre, tyre, Y, hub, sides=32), 3)
        a.add(disc(0.05, 0.16, hub), 2)
        for angle in np.arange(10) * TAU / 10:
            rim = hub + (wheel - tyre) * np.array([np.cos(angle), 0, np.sin(angle)])
            a.add(rod(hub, rim, 0.011, sides=5), 2)
    rise = a.u(0.5, 0.8)
    head = front + [-a.u(0.2, 0.32), 0, rise]
    saddle = rear + [a.u(0.22, 0.38), 0, rise * a.u(0.7, 0.98)]
    crank = np.array([a.u(-0.12, 0.04), 0, wheel * a.u(0.6, 0.9)])
    top_tube_end = crank + (saddle - crank) * (0.35 if a.chance(0.35) else 0.85)
    a.add(rod(head, front + [0, 0.07, 0], tube * 0.8), 2, mirror=True)
    for start, end in ((head - [0, 0, 0.14], crank), (saddle, crank), (head - [0, 0, 0.06], top_tube_end)):
        a.add(rod(start, end, tube), 0)
    for end in (crank, saddle - [0, 0, 0.12]):
        a.add(rod(rear + [0, 0.05, 0], end, tube * 0.6), 0, mirror=True)
    a.add(ellipsoid((a.u(0.15, 0.24), a.u(0.06, 0.11), 0.05), saddle + [0, 0, 0.05]), 4)

    stem, reach, style = head + [0.02, 0, a.u(0.08, 0.2)], a.u(0.25, 0.4), a.choice(3)
    a.add(rod(head, stem, tube), 2)
    grip = stem + ([-0.03, reach, 0.02], [0.02, reach, a.u(0.05, 0.15)], [0.06, reach * 0.7, 0])[style]
    a.add(rod(stem, grip, 0.024), 3, mirror=True)
    if style == 1:
        a.add(capsule(grip, grip + [-a.u(0.15, 0.28), 0.02, -0.02], 0.028), 3, mirror=True)
    elif style == 2:
        a.add(torus(0.09, 0.024, Y, grip - [0, 0, 0.09], 0, np.pi, sides=12), 3, mirror=True)
    for side in (1, -1):
        pedal = crank + np.array([0.13, 0.13, -0.13]) * [side, side, side]
        a.add(rod(crank + [0, side * 0.09, 0], pedal, 0.02), 2)
        a.add(box((0.1, 0.1, 0.025), pedal + [0, side * 0.05, 0]), 3)
    a.add(disc(0.12, 0.02, crank - [0, 0.06, 0]), 2)  # the chain ring of a bicycle is on its right side
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
    cruiser, sport, scooter = np.arange(3) == a.choice(3)
    wheel, tyre = a.u(0.26, 0.32) if scooter else a.u(0.36, 0.46), a.u(0.07, 0.11)
    half_base = a.u(0.6, 0.72) + (0.1 if cruiser else 0)
    front, rear = np.array([half_base, 0, wheel]), np.array([-half_base, 0, wheel])
    for hub, start, stop in ((rear, -1.5, 0.6), (front, -0.8, 0.7)):
        a.add(torus(wheel - tyre, tyre, Y, hub), 3)
        a.add(disc(wheel * 0.62, 0.06, hub), 2)
        a.add(disc(wheel * 0.25, 0.2, hub), 2)
        a.add(torus(wheel + 0.04, 0.05, Y, hub, start, stop, sides=14), 0)  # a mudguard
    head = front + [-a.u(0.2, 0.28) - (0.15 if cruiser else 0), 0, a.u(0.55, 0.72)]
    a.add(rod(head, front + [0, 0.11, 0], 0.04), 2, mirror=True)
    a.add(ellipsoid((0.1, 0.12, 0.12), head + [0.12, 0, a.u(-0.06, 0.04)]), 4)
    grip_z = a.u(0.2, 0.4) if cruiser else a.u(0.02, 0.2)
    grip = head + [-a.u(0.12, 0.25), a.u(0.3, 0.42), grip_z]
    a.add(rod(head, grip + [0.1, -0.06, 0], 0.026), 2, mirror=True)
    a.add(capsule(grip + [0.1, -0.06, 0], grip, 0.035), 3, mirror=True)
    if a.chance(0.6):
        a.add(rod(grip + [0.1, -0.06, 0], grip + [0.12, 0.04, 0.18], 0.012), 3, mirror=True)
        a.add(ellipsoid((0.015, 0.08, 0.05), grip + [0.12, 0.05, 0.2]), 5, mirror=True)

    seat_z = wheel * 2 + a.u(0, 0.12)
    if scooter:
        floor = wheel * a.u(0.75, 1.0)
        a.add(pane((half_base - 0.3, floor), head[[0, 2]], a.u(0.4, 0.55), 0.07), 0)
        a.add(box((half_base * 1.1, 0.36, 0.08), (0, 0, floor)), 0)
        body = (half_base * 1.15, 0.42, seat_z - floor + 0.1)
        a.add(rounded_box(body, (-half_base * 0.75, 0, (seat_z + floor) / 2), 4), 0)
        a.add(rounded_box((half_base * 1.05, 0.36, 0.14), (-half_base * 0.65, 0, seat_z + 0.08), 3), 6)
        a.add(box((0.06, 0.2, 0.09), (-half_base * 1.35, 0, seat_z * 0.85)), 5)
    else:
        engine = np.array([a.u(-0.08, 0.08), 0, wheel * a.u(0.85, 1.1)])
        a.add(box((a.u(0.4, 0.55), 0.3, a.u(0.3, 0.42)), engine), 1)
        for lean in (-0.12, 0.14):
            a.add(rod(engine, engine + [lean, 0, 0.34], 0.12), 2)  # a cylinder
        tank = np.array([head[0] * 0.45, 0, seat_z + 0.14])
        a.add(ellipsoid((a.u(0.28, 0.36), a.u(0.14, 0.19), a.u(0.13, 0.18)), tank), 0)
        for start, end in ((head, engine), (head, tank), (engine, rear)):
            a.add(rod(start + [0, 0.04, 0], end + [0, 0.06, 0], 0.032), 2, mirror=True)
        a.add(rounded_box((half_base * 0.95, 0.28, 0.13), (-half_base * 0.48, 0, seat_z), 3), 6)
        tail = np.array([-half_base * a.u(0.95, 1.25), 0, seat_z + a.u(0.08, 0.25)])
        a.add(capsule((-half_base * 0.7, 0, seat_z), tail, 0.12, 0.06), 0)
        a.add(box((0.05, 0.16, 0.08), tail - [0.08, 0, 0]), 5)
        screen = head[[0, 2]] + [0.12, 0.08]
        if sport:
            upper = [[head[0] + 0.3, head[2] - 0.1], [head[0] - 0.05, head[2] + 0.12]]
            lower = [[0.05, wheel * 1.6], [0.0, wheel * 0.6], [0.35, wheel * 0.9]]
            a.add(tapered(extrusion(upper + lower, a.u(0.34, 0.44)), wheel, head[2] + 0.12, 0.55), 0)
            a.add(pane(screen, screen + [-0.2, 0.22], 0.24), 5)
        elif a.chance(0.4):
            a.add(pane(screen, screen + [-0.15, 0.4], 0.4), 5)
    exhaust_end = (-half_base * a.u(0.9, 1.3), -0.22, wheel * a.u(0.7, 1.3))
    a.add(rod((0.05, -0.2, wheel * 0.6), exhaust_end, 0.05, a.u(0.06, 0.09)), 7)


def car(a: Assembly) -> None:
    """Build a saloon, hatchback, pickup or van: bonnet, cabin with windows, lights, wheels."""
    saloon, _, pickup, van = np.arange(4) == a.choice(4)
    length, width, wheel = a.u(2.2, 2.8), a.u(0.95, 1.15), a.u(0.2, 0.27)
    nose, tail = length / 2, -length / 2
    sill, belt = wheel * a.u(0.6, 0.9), wheel * a.u(2.1, 2.5)  # lower and upper edge of the body
    roof, taper = belt + a.u(0.3, 0.45) + (0.15 if van else 0), a.u(0.76, 0.88)
    bonnet_end = nose - length * (a.u(0.11, 0.18) if van else a.u(0.24, 0.31))
    boot_start = tail + length * (0.18 if saloon else 0.43 if pickup else 0.02)
    nose_z = belt - (belt - sill) * a.u(0.15, 0.35)
    front = [[nose, sill], [nose + 0.03, (sill + nose_z) / 2], [nose - 0.04, nose_z], [bonnet_end, belt]]
    a.add(tapered(extrusion([[tail, sill], *front, [tail, belt]], width), sill, belt, 0.94), 0)

    rear_slope = a.u(0.02, 0.08) if pickup or van else a.u(0.1, 0.3)
    windscreen = np.array([[bonnet_end + 0.03, belt], [bonnet_end - a.u(0.2, 0.38), roof]])
    rear_window = np.array([[boot_start, belt], [boot_start + rear_slope, roof]])
    cabin = np.concatenate([rear_window[:1], windscreen, rear_window[1:]])
    a.add(tapered(extrusion(cabin, width * 0.92), belt, roof, taper), 0)
    for (low, high), out in ((windscreen, 0.015), (rear_window, -0.015)):
        low, high = low + (high - low) * 0.12 + [out, 0], high - (high - low) * 0.12 + [out, 0]
        a.add(tapered(pane(low, high, width * 0.8, 0.03), belt, roof, taper), 4)
    # Side windows: the outline of the cabin, reduced in size, slightly wider, and divided by pillars.
    rear_low, front_low, front_high, rear_high = cabin.mean(0) + (cabin - cabin.mean(0)) * [0.86, 0.7]
    n_windows = 1 if pickup else 2 + a.choice(2)
    for k in range(n_windows):
        start, stop = (k + 0.04) / n_windows, (k + 0.96) / n_windows
        low, high = front_low - rear_low, front_high - rear_high
        window = [rear_low + low * start, rear_low + low * stop, rear_high + high * stop, rear_high + high * start]
        a.add(tapered(extrusion(window, width * 0.94), belt, roof, taper), 4)
    if pickup:
        wall, bed = a.u(0.08, 0.18), boot_start - tail
        a.add(box((bed, 0.06, wall), (tail + bed / 2, width * 0.44, belt + wall / 2)), 0, mirror=True)
        a.add(box((0.06, width * 0.9, wall), (tail + 0.03, 0, belt + wall / 2)), 0)
    light_z = sill + (nose_z - sill) * 0.72
    a.add(ellipsoid((0.06, a.u(0.09, 0.15), a.u(0.05, 0.08)), (nose, width * 0.34, light_z)), 5, mirror=True)
    a.add(box((0.05, width * a.u(0.25, 0.4), a.u(0.07, 0.12)), (nose + 0.01, 0, light_z)), 6)
    a.add(box((0.04, 0.1, a.u(0.1, 0.2)), (tail - 0.01, width * 0.4, belt - 0.16)), 7, mirror=True)
    for x in (nose + 0.02, tail - 0.02):
        a.add(rounded_box((0.12, width, 0.12), (x, 0, sill + 0.06), 4), 2)
    a.add(ellipsoid((0.05, 0.08, 0.05), (bonnet_end - 0.12, width * 0.53, belt + 0.06)), 0, mirror=True)
    for x in (nose - length * a.u(0.16, 0.2), tail + length * a.u(0.17, 0.21)):
        add_wheels(a, x, width / 2 - 0.05, wheel, 0.16)
    if saloon and a.chance(0.3):
        a.add(box((0.14, width * 0.85, 0.03), (tail + 0.08, 0, belt + 0.14)), 0)  # a spoiler
        a.add(box((0.08, 0.03, 0.14), (tail + 0.1, width * 0.3, belt + 0.07)), 0, mirror=True)


def hydrant(a: Assembly) -> None:
    """Build a hydrant: barrel, flange and bonnet; large outlet at the front, small outlets at the sides; chain."""
    radius, height = a.u(0.24, 0.36), a.u(0.9, 1.35)
    neck, rim, cap = radius * a.u(0.85, 1), radius * 1.22, height * 0.82
    foot = [[0.001, 0], [radius * 1.45, 0], [radius * 1.45, 0.09], [radius, 0.11]]
    a.add(lathe([*foot, [neck, height * 0.75], [rim, height * 0.76], [rim, cap], [neck, cap + 0.01]], 24), 0)
    t = np.linspace(0, np.pi / 2, 7)
    if a.chance(0.5):
        bonnet = np.stack([radius * np.cos(t), height * 0.25 * np.sin(t)], 1)
    else:
        bonnet = np.array(
            [[1.05 * radius, 0], [0.9 * radius, 0.14 * height], [0.35 * radius, 0.2 * height], [0, 0.22 * height]]
        )
    a.add(lathe(bonnet + [0, cap], 24), 1 if a.chance(0.6) else 0)
    top = cap + bonnet[-1, 1]
    a.add(rod((0, 0, top - 0.04), (0, 0, top + a.u(0.07, 0.14)), 0.07, sides=6), 2)

    def add_outlet(z: float, reach: float, bore: float, nut: float, turn: float) -> None:
        """Add a pipe with a cap and its nut; it points forwards, or is turned about the barrel."""
        parts = (
            (rod((0, 0, z), (reach, 0, z), bore), 0),
            (rod((reach - 0.02, 0, z), (reach + 0.1, 0, z), bore * 1.2, sides=8), 1),
            (rod((reach + 0.08, 0, z), (reach + 0.16, 0, z), nut, sides=5), 2),
        )
        for mesh, material in parts:
            a.add(mesh.rotated("z", turn), material)

    outlet, bore = height * a.u(0.5, 0.64), a.u(0.15, 0.21)
    add_outlet(outlet, radius + a.u(0.14, 0.26), bore, 0.055, 0)
    side_outlet, side_reach, side_bore = outlet + a.u(-0.03, 0.13), radius + a.u(0.1, 0.2), a.u(0.09, 0.13)
    for turn in (TAU / 4, -TAU / 4):
        add_outlet(side_outlet, side_reach, side_bore, 0.045, turn)
    for angle in np.arange(8) * TAU / 8 + 0.2:
        a.add(cylinder(0.035, 0.035, 0.05, 6).translated((radius * 1.27, 0, 0.11)).rotated("z", angle), 2)
    if a.chance(0.6):
        a.add(torus(a.u(0.1, 0.16), 0.018, Y, (radius + 0.12, 0.03, outlet - bore - 0.08)), 3)
    if a.chance(0.4):
        a.add(torus(radius, 0.04, centre=(0, 0, height * 0.25)), 4)


STREET = (bicycle, car, hydrant, motorcycle)
