"""Evaluation categories of toys (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.evaluation_parts import pane, rounded_box, wheel_pair
from zsp_lite.synthetic.primitives import TAU, box, capsule, cylinder, ellipsoid, extrusion, lathe, rod


def teddybear(a: Assembly) -> None:
    """Build a sitting or standing teddy bear: round or long muzzle, arms raised or hanging, optional shirt and hat."""
    belly, tall, skull = a.u(0.36, 0.55), a.u(0.48, 0.68), a.u(0.32, 0.46)
    standing = a.chance(0.3)
    floor = a.u(0.35, 0.5) if standing else 0.0
    a.add(ellipsoid((belly * 0.85, belly, tall), (0, 0, floor + tall)), 0)
    head = np.array([0.05, a.u(-0.03, 0.03), floor + tall * 1.85 + skull * 0.68])
    a.add(ellipsoid((skull * 0.9, skull * a.u(0.95, 1.18), skull), head), 0)
    snout = a.u(0.13, 0.26)
    a.add(ellipsoid((snout, a.u(0.15, 0.21), 0.15), head + [skull * 0.82, 0, -0.09]), 1)
    a.add(ellipsoid((0.06, 0.075, 0.05), head + [skull * 0.82 + snout * 0.92, 0, -0.04]), 3)
    eye = head + [skull * 0.8, skull * 0.36, skull * 0.22]
    a.add(ellipsoid((0.05, 0.05, 0.06), eye), 3, mirror=True)
    ear, ear_at = a.u(0.12, 0.2), head + [0, skull * a.u(0.65, 0.85), skull * a.u(0.65, 0.85)]
    a.add(ellipsoid((0.075, ear, ear), ear_at), 0, mirror=True)
    a.add(ellipsoid((0.05, ear * 0.6, ear * 0.6), ear_at + [0.05, 0, 0]), 1, mirror=True)

    shoulder = np.array([0, belly * 0.8, floor + tall * 1.45])
    for side in (1, -1):
        # Each arm has its own pose.
        hand = shoulder + [a.u(-0.05, 0.45), a.u(0.2, 0.42), a.u(-0.5, 0.45)]
        a.add(capsule(shoulder * [1, side, 1], hand * [1, side, 1], a.u(0.12, 0.16), a.u(0.12, 0.18)), 0)
    leg = a.u(0.14, 0.21)
    if standing:
        foot = np.array([0.08, belly * 0.6, leg])
        a.add(capsule((0, belly * 0.5, floor + tall * 0.4), foot, leg * 1.05, leg), 0, mirror=True)
        a.add(ellipsoid((leg * 1.5, leg, leg * 0.7), foot + [0.1, 0, -leg * 0.35]), 2, mirror=True)
    else:
        foot = np.array([a.u(0.45, 0.75), belly * a.u(0.7, 1.1), leg])
        a.add(capsule((0.1, belly * 0.55, 0.15), foot, leg), 0, mirror=True)
        a.add(ellipsoid((0.07, leg * 0.85, leg * 1.15), foot + [leg * 0.85, 0, 0.05]), 1, mirror=True)
    a.add(ellipsoid((0.1, 0.1, 0.1), (-belly * 0.85, 0, floor + 0.25)), 0)
    if a.chance(0.5):
        a.add(ellipsoid((belly * 0.3, belly * 0.65, tall * 0.65), (belly * 0.62, 0, floor + tall * 0.95)), 1)
    elif a.chance(0.5):
        shirt = lathe(
            [
                [belly * 0.97, tall * 0.75],
                [belly * 1.04, tall * 1.0],
                [belly * 0.96, tall * 1.4],
                [belly * 0.66, tall * 1.78],
            ],
            24,
        )
        a.add(shirt.scaled((0.87, 1, 1)).translated((0, 0, floor)), 4)
    if a.chance(0.4):
        a.add(ellipsoid((0.06, 0.12, 0.09), (belly * 0.62, 0.1, floor + tall * 1.78)), 5, mirror=True)
    if a.chance(0.2):
        a.add(cylinder(skull * 0.55, skull * 0.45, 0.22).translated(head + [0, 0, skull * 1.05]), 6)
        a.add(cylinder(skull * 0.8, skull * 0.8, 0.04).translated(head + [0, 0, skull * 0.94]), 6)


def toyplane(a: Assembly) -> None:
    """Build a propeller plane or jet: low, middle, high or double wing, straight or swept; optional wheels."""
    length, radius = a.u(1.6, 2.6), a.u(0.16, 0.32)
    nose, tail = length / 2, -length / 2
    a.add(capsule((tail, 0, 0), (nose - radius, 0, 0), radius * a.u(0.35, 0.7), radius), 0)
    jet = a.chance(0.4)
    span, chord = a.u(0.8, 1.5), a.u(0.3, 0.6)
    sweep = a.u(0.25, 0.6) if jet else a.u(-0.05, 0.2)
    wing_x = a.u(-0.1, 0.3)
    lead, trail = wing_x + chord / 2, wing_x - chord / 2
    outline = [[lead, 0], [lead - sweep, span], [trail - sweep + chord * a.u(0.1, 0.4), span], [trail, 0]]
    biplane = not jet and a.chance(0.35)
    thickness = a.u(0.04, 0.09)
    levels = (-radius * 0.7, radius * 1.6) if biplane else (a.u(-0.12, 0.1) if a.chance(0.7) else radius,)
    for level in levels:
        a.add(extrusion(outline, thickness, "xy", level), 1, mirror=True)
    if biplane:
        for x in (lead - 0.1, trail + 0.1):
            strut_y = span * 0.65
            a.add(
                rod((x - sweep * 0.6, strut_y, levels[0]), (x - sweep * 0.6, strut_y, levels[1]), 0.02), 3, mirror=True
            )
        a.add(rod((wing_x, 0.08, 0), (wing_x, 0.12, levels[1]), 0.02), 3, mirror=True)

    fin = a.u(0.3, 0.6)
    a.add(extrusion([[tail + 0.35, 0], [tail + 0.05, fin], [tail - 0.12, fin], [tail - 0.02, 0]], 0.06), 2)
    stabiliser, level = a.u(0.3, 0.55), (a.u(0, 0.1) if a.chance(0.75) else fin * 0.92)
    a.add(
        extrusion([[tail + 0.3, 0], [tail + 0.1, stabiliser], [tail - 0.1, stabiliser], [tail, 0]], 0.05, "xy", level),
        1,
        mirror=True,
    )
    if jet:
        engine = (
            (wing_x - sweep * 0.4, span * 0.4, levels[0] - 0.13) if a.chance(0.6) else (tail + 0.55, radius + 0.1, 0.08)
        )
        a.add(rod(np.add(engine, [-0.2, 0, 0]), np.add(engine, [0.2, 0, 0]), 0.08, a.u(0.1, 0.13)), 3, mirror=True)
        a.add(rod(np.add(engine, [0.15, 0, 0]), np.add(engine, [0.22, 0, 0]), 0.07), 5, mirror=True)
    else:
        a.add(ellipsoid((0.12, 0.09, 0.09), (nose + 0.05, 0, 0)), 3)
        blade, turn = a.u(0.3, 0.45), a.u(0, np.pi)
        n_blades = 2 + a.choice(3)
        for k in range(n_blades):
            upright = box((0.035, 0.1, blade)).translated((0, 0, blade / 2))
            a.add(upright.rotated("x", turn + k * TAU / n_blades).translated((nose + 0.08, 0, 0)), 5)
    if a.chance(0.85):
        canopy = length * a.u(0.16, 0.28)
        a.add(ellipsoid((a.u(0.2, 0.35), radius * 0.7, radius * 0.7), (canopy, 0, radius * 0.75)), 4)
    if length > 2 and a.chance(0.6):
        for x in np.linspace(-length * 0.2, length * 0.15, 4):
            a.add(box((0.09, 0.05, 0.09), (x, radius * 0.88, 0.08)), 4, mirror=True)
    if a.chance(0.6):
        gear = np.array([wing_x + 0.1, 0.25, -radius - 0.22])
        a.add(rod(gear * [1, 0.6, 0], gear, 0.025), 3, mirror=True)
        a.add(cylinder(0.1, 0.1, 0.07).rotated("x", np.pi / 2).translated(gear), 6, mirror=True)


def toytruck(a: Assembly) -> None:
    """Build a truck: cab over engine or with a bonnet; box, flat bed, tank, tipper or crane behind."""
    length, width, wheel = a.u(1.7, 2.6), a.u(0.7, 1.0), a.u(0.16, 0.28)
    deck, cab_height, cab_length = wheel * 1.3, a.u(0.5, 0.85), a.u(0.4, 0.65)
    nose, tail = length / 2, -length / 2
    a.add(box((length, width * 0.8, 0.12), (0, 0, deck)), 2)
    cab_front = nose
    if a.chance(0.5):
        bonnet = a.u(0.25, 0.45)
        a.add(
            rounded_box(
                (bonnet * 1.3, width * 0.85, cab_height * 0.55), (nose - bonnet * 0.5, 0, deck + cab_height * 0.26), 6
            ),
            0,
        )
        cab_front -= bonnet * 0.85
    cab_rear = cab_front - cab_length
    slope = a.u(0.04, 0.18)
    cab = [
        [cab_rear, deck + 0.04],
        [cab_front, deck + 0.04],
        [cab_front, deck + cab_height * 0.5],
        [cab_front - slope, deck + cab_height],
        [cab_rear, deck + cab_height],
    ]
    a.add(extrusion(cab, width), 0)
    a.add(
        box(
            (cab_length * 0.5, width * 1.02, cab_height * 0.3),
            (cab_rear + cab_length * 0.48, 0, deck + cab_height * 0.72),
        ),
        4,
    )
    a.add(
        pane(
            (cab_front + 0.01, deck + cab_height * 0.55),
            (cab_front - slope * 0.85, deck + cab_height * 0.94),
            width * 0.84,
        ),
        4,
    )
    a.add(ellipsoid((0.05, 0.08, 0.08), (nose, width * 0.34, deck + cab_height * 0.28)), 5, mirror=True)
    a.add(box((0.06, width * 0.4, cab_height * 0.2), (nose + 0.01, 0, deck + cab_height * 0.27)), 6)
    a.add(box((0.1, width * 0.95, 0.1), (nose + 0.03, 0, deck - 0.02)), 2)

    load_front = cab_rear - 0.05
    load_length, load_x = load_front - tail, (load_front + tail) / 2
    style = a.choice(5)
    if style == 0:
        height = a.u(0.6, 1.0)
        a.add(box((load_length, width * a.u(0.95, 1.1), height), (load_x, 0, deck + 0.08 + height / 2)), 1)
        a.add(box((0.02, width * 0.04, height * 0.9), (tail - 0.01, 0, deck + 0.08 + height / 2)), 2)
    elif style == 1:
        wall = a.u(0.2, 0.45)
        a.add(box((load_length, width, 0.06), (load_x, 0, deck + 0.1)), 1)
        a.add(box((load_length, 0.06, wall), (load_x, width / 2, deck + 0.1 + wall / 2)), 1, mirror=True)
        for x in (tail, load_front):
            a.add(box((0.06, width, wall), (x, 0, deck + 0.1 + wall / 2)), 1)
        if a.chance(0.6):
            a.add(ellipsoid((load_length * 0.4, width * 0.4, wall * 1.1), (load_x, 0, deck + 0.15)), 7)
    elif style == 2:
        radius = width * a.u(0.38, 0.5)
        a.add(rod((tail, 0, deck + radius), (load_front, 0, deck + radius), radius, sides=22), 1)
        a.add(cylinder(0.1, 0.1, 0.08).translated((load_x, 0, deck + 2 * radius + 0.02)), 7)
    elif style == 3:
        tilt, wall = a.u(0.15, 0.6), a.u(0.3, 0.45)
        tray = [[0, 0], [load_length, 0], [load_length + 0.08, wall], [0.0, wall]]
        for mesh in (
            extrusion(tray, 0.06, "xz", width / 2),
            extrusion(tray, 0.06, "xz", -width / 2),
            box((load_length, width, 0.06), (load_length / 2, 0, 0)),
            box((0.06, width, wall), (load_length, 0, wall / 2)),
        ):
            a.add(mesh.rotated("y", -tilt).translated((tail, 0, deck + 0.12)), 1)
        a.add(rod((load_x, 0, deck), (load_x + 0.1, 0, deck + 0.12 + load_length * 0.5 * np.sin(tilt)), 0.05), 2)
    else:
        a.add(cylinder(width * 0.35, width * 0.35, 0.2).translated((load_x, 0, deck + 0.16)), 1)
        mast = np.array([load_x, 0, deck + 0.3])
        jib = mast + [-load_length * a.u(0.4, 0.7), 0, a.u(0.5, 0.9)]
        a.add(box((0.3, 0.3, 0.3), mast + [0, 0, 0.08]), 1)
        a.add(rod(mast, jib, 0.07, 0.05), 1)
        a.add(rod(jib, jib - [0, 0, a.u(0.3, 0.5)], 0.02), 3)
        a.add(ellipsoid((0.07, 0.04, 0.09), jib - [0, 0, 0.45]), 3)
    rear_axles = [tail + 0.3] if a.chance(0.5) else [tail + 0.25, tail + 0.25 + 2.1 * wheel]
    for x in (nose - cab_length * 0.6 - 0.1, *rear_axles):
        wheel_pair(a, x, width / 2 - 0.02, wheel, 0.16, 3, 2)


def toybus(a: Assembly) -> None:
    """Build a city bus, double-decker or school bus with a bonnet; doors on the right."""
    style = a.choice(3)
    length, width, wheel = a.u(1.9, 2.9), a.u(0.65, 0.9), a.u(0.15, 0.22)
    height = a.u(0.65, 0.85) * (1.6 if style == 1 else 1)
    floor = wheel * 0.8
    nose, tail = length / 2, -length / 2
    if style == 2:
        bonnet = a.u(0.3, 0.45)
        a.add(
            rounded_box((bonnet * 1.4, width * 0.8, height * 0.5), (nose - bonnet * 0.6, 0, floor + height * 0.25), 6),
            0,
        )
        body_nose = nose - bonnet
    else:
        body_nose = nose
    body_length, middle = body_nose - tail, (body_nose + tail) / 2
    a.add(rounded_box((body_length, width, height), (middle, 0, floor + height / 2), a.u(7, 14)), 0)
    a.add(box((body_length * 0.96, width * 1.02, height * a.u(0.04, 0.1)), (middle, 0, floor + height * 0.3)), 1)
    rows = (0.36, 0.78) if style == 1 else (0.66,)
    window_height = height * (0.2 if style == 1 else 0.3)
    n_windows = 4 + a.choice(4)
    pitch = body_length * 0.9 / n_windows
    for row in rows:
        for k in range(n_windows):
            x = tail + body_length * 0.05 + (k + 0.5) * pitch
            a.add(box((pitch * 0.82, width * 1.015, window_height), (x, 0, floor + height * row)), 4)
        a.add(box((0.04, width * 0.84, window_height * 1.2), (body_nose, 0, floor + height * row)), 4)
        a.add(box((0.04, width * 0.6, window_height * 0.8), (tail, 0, floor + height * row)), 4)
    door_x = body_nose - body_length * 0.12
    a.add(
        box(
            (pitch * 0.9, 0.04, height * (0.42 if style == 1 else 0.72)),
            (door_x, -width / 2, floor + height * (0.27 if style == 1 else 0.45)),
        ),
        6,
    )
    a.add(ellipsoid((0.05, 0.07, 0.07), (nose, width * 0.33, floor + 0.14)), 5, mirror=True)
    a.add(box((0.03, 0.09, 0.14), (tail, width * 0.4, floor + 0.2)), 7, mirror=True)
    a.add(box((0.08, width, 0.08), (nose + 0.01, 0, floor + 0.02)), 2)
    a.add(box((0.08, width, 0.08), (tail - 0.01, 0, floor + 0.02)), 2)
    if style != 2:
        a.add(box((0.05, width * 0.7, height * 0.1), (nose, 0, floor + height * 0.93)), 6)
    if a.chance(0.5):
        a.add(box((0.1, 0.06, 0.14), (nose - 0.02, width * 0.54, floor + height * 0.6)), 3, mirror=True)
    if a.chance(0.5):
        a.add(
            box((body_length * a.u(0.15, 0.3), width * 0.6, 0.1), (tail + body_length * 0.3, 0, floor + height + 0.03)),
            1,
        )
    for x in (nose - length * a.u(0.18, 0.24), tail + length * a.u(0.17, 0.24)):
        wheel_pair(a, x, width / 2 - 0.04, wheel, 0.12, 3, 2)


def toytrain(a: Assembly) -> None:
    """Build a locomotive: steam engine with boiler, chimney and cab, or diesel with a long hood."""
    length, width, wheel = a.u(1.6, 2.3), a.u(0.6, 0.8), a.u(0.14, 0.24)
    deck = wheel * 1.5
    nose, tail = length / 2, -length / 2
    a.add(box((length, width * 0.85, 0.12), (0, 0, deck)), 2)
    cab_length, cab_height = length * a.u(0.22, 0.34), a.u(0.65, 0.95)
    cab_x = tail + cab_length / 2 + 0.04
    a.add(box((cab_length, width, cab_height), (cab_x, 0, deck + 0.06 + cab_height / 2)), 0)
    a.add(box((cab_length * 0.5, width * 1.03, cab_height * 0.3), (cab_x, 0, deck + cab_height * 0.72)), 4)
    a.add(box((cab_length * 1.03, width * 0.7, cab_height * 0.24), (cab_x, 0, deck + cab_height * 0.78)), 4)
    roof = ellipsoid((cab_length * 0.68, width * 0.6, a.u(0.08, 0.18)), (cab_x, 0, deck + 0.06 + cab_height))
    a.add(roof, 1)
    hood_rear = tail + cab_length
    if a.chance(0.7):
        radius = width * a.u(0.34, 0.46)
        boiler = deck + 0.06 + radius
        front = nose - 0.06
        a.add(rod((hood_rear, 0, boiler), (front, 0, boiler), radius, sides=24), 0)
        a.add(rod((front - 0.03, 0, boiler), (front + 0.05, 0, boiler), radius * 0.86, sides=24), 6)
        for share in (0.25, 0.6):
            x = hood_rear + (front - hood_rear) * share
            a.add(rod((x, 0, boiler), (x + 0.05, 0, boiler), radius * 1.04, sides=24), 7)
        chimney, flare = a.u(0.2, 0.45), a.u(0.9, 2.0)
        base = boiler + radius * 0.9
        a.add(
            lathe([[0.001, 0], [0.09, 0], [0.09, chimney * 0.6], [0.09 * flare, chimney], [0.001, chimney]]).translated(
                (front - 0.2, 0, base)
            ),
            3,
        )
        a.add(ellipsoid((0.13, 0.13, a.u(0.12, 0.2)), (hood_rear + (front - hood_rear) * 0.42, 0, base)), 7)
        a.add(rod((front + 0.03, 0, boiler + radius * 0.6), (front + 0.15, 0, boiler + radius * 0.6), 0.08, 0.1), 5)
    else:
        hood_height = cab_height * a.u(0.55, 0.8)
        hood = (nose - 0.05 - hood_rear, width * a.u(0.7, 0.95), hood_height)
        a.add(rounded_box(hood, ((nose - 0.05 + hood_rear) / 2, 0, deck + 0.06 + hood_height / 2), 9), 0)
        a.add(box((0.04, hood[1] * 0.6, hood_height * 0.4), (nose - 0.05, 0, deck + hood_height * 0.4)), 6)
        a.add(ellipsoid((0.05, 0.07, 0.07), (nose - 0.05, width * 0.22, deck + hood_height * 0.8)), 5, mirror=True)
        a.add(box((0.25, width * 0.3, 0.14), ((nose + hood_rear) / 2, 0, deck + 0.1 + hood_height)), 3)
    # The cowcatcher slopes down and forwards.
    plough = [[nose - 0.02, deck + 0.05], [nose + a.u(0.12, 0.25), 0.05], [nose - 0.02, 0.05]]
    a.add(extrusion(plough, width * 0.75), 7)
    a.add(rod((tail - 0.12, 0, deck), (tail, 0, deck), 0.05), 3)
    n_axles = 2 + a.choice(3)
    big_rear = a.chance(0.4)
    axles = np.linspace(tail + wheel * 1.3, nose - wheel * 1.6, n_axles)
    for k, x in enumerate(axles):
        wheel_pair(a, x, width / 2 - 0.03, wheel * (1.35 if big_rear and k == 0 else 1), 0.08, 3, 2)
    a.add(
        box((axles[-1] - axles[0], 0.03, 0.05), ((axles[0] + axles[-1]) / 2, width / 2 + 0.06, wheel)), 7, mirror=True
    )
