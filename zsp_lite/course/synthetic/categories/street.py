"""Vehicles and street furniture (front +x, left +y, up +z).

The constants at the head of a builder name its materials, 0 to 7: parts of one material look alike.
Other numbers are lengths or shares of lengths, chosen by hand; the unit is arbitrary, since
`make_shape` scales each object. The third argument of `rounded_box` is its squareness. The second
of `lathe` and the fourth of `cylinder` are numbers of sides.
"""

import numpy as np

from zsp_lite.course.synthetic.assembly import (
    BODY,
    Draw,
    Parts,
    Y,
    disc,
    pair,
    pane,
    rounded_box,
    tapered,
    wheels,
)
from zsp_lite.course.synthetic.primitives import (
    ON_AXIS,
    TAU,
    box,
    capsule,
    cylinder,
    ellipsoid,
    extrusion,
    lathe,
    point,
    rod,
    torus,
)


def bicycle(draw: Draw) -> Parts:
    """Build a bicycle: diamond or step-through frame; flat, swept or drop bars; optional basket."""
    METAL = 2
    RUBBER = 3
    SADDLE = 4
    BASKET = 5

    wheel = draw(0.36, 0.52)
    tyre = draw(0.022, 0.05)
    tube = draw(0.028, 0.048)
    half_base = draw(0.5, 0.66)
    # The wheels, with ten spokes each: a tyre, a hub, spokes from the hub to the rim.
    front = point(half_base, 0, wheel)
    rear = point(-half_base, 0, wheel)
    for hub in (front, rear):
        yield torus(wheel - tyre, tyre, Y, hub, sides=32), RUBBER
        yield disc(0.05, 0.16, hub), METAL
        for angle in np.arange(10) * TAU / 10:
            rim = hub + (wheel - tyre) * point(np.cos(angle), 0, np.sin(angle))
            yield rod(hub, rim, 0.011, sides=5), METAL
    # The frame: its joints, then its tubes.
    rise = draw(0.5, 0.8)
    head = front + [-draw(0.2, 0.32), 0, rise]
    saddle = rear + [draw(0.22, 0.38), 0, rise * draw(0.7, 0.98)]
    crank = point(draw(-0.12, 0.04), 0, wheel * draw(0.6, 0.9))
    # The top tube ends low on the seat tube in a step-through frame.
    top_tube_end = crank + (saddle - crank) * (0.35 if draw.chance(0.35) else 0.85)
    # The fork, whose legs are on both sides of the front wheel.
    yield from pair(rod(head, front + [0, 0.07, 0], tube * 0.8), METAL)
    # The down tube, the seat tube and the top tube.
    yield rod(head - [0, 0, 0.14], crank, tube), BODY
    yield rod(saddle, crank, tube), BODY
    yield rod(head - [0, 0, 0.06], top_tube_end, tube), BODY
    # The stays from the rear hub to the crank and to the saddle.
    for end in (crank, saddle - [0, 0, 0.12]):
        yield from pair(rod(rear + [0, 0.05, 0], end, tube * 0.6))
    saddle_radii = (draw(0.15, 0.24), draw(0.06, 0.11), 0.05)
    yield ellipsoid(saddle_radii, saddle + [0, 0, 0.05]), SADDLE

    # The bars, on a stem.
    stem = head + [0.02, 0, draw(0.08, 0.2)]
    bars = draw.pick("flat", "swept", "drop")
    yield rod(head, stem, tube), METAL
    half_width = draw(0.18, 0.28) if bars == "drop" else draw(0.25, 0.4)
    grip = stem + [0.02, half_width, draw(0, 0.12)]
    yield from pair(rod(stem, grip, 0.024), RUBBER)
    if bars == "swept":
        yield from pair(capsule(grip, grip + [-draw(0.15, 0.28), 0.02, -0.02], 0.028), RUBBER)
    elif bars == "drop":
        yield from pair(torus(0.09, 0.024, Y, grip - [0, 0, 0.09], 0, np.pi, sides=12), RUBBER)
    # Pedals half a turn apart, and the chain ring, which is on the right side of a bicycle.
    for side in (1, -1):
        pedal = crank + side * point(0.13, 0.13, -0.13)
        yield rod(crank + [0, side * 0.09, 0], pedal, 0.02), METAL
        yield box((0.1, 0.1, 0.025), pedal + [0, side * 0.05, 0]), RUBBER
    yield disc(0.12, 0.02, crank - [0, 0.06, 0]), METAL
    if draw.chance(0.35):
        yield box((0.28, 0.34, 0.22), head + [0.2, 0, 0.05]), BASKET


def motorcycle(draw: Draw) -> Parts:
    """Build a cruiser, sport motorcycle with fairing, or scooter; the exhaust is on the right."""
    ENGINE = 1
    METAL = 2
    RUBBER = 3
    HEADLAMP = 4
    GLASS = 5  # rear light and screen
    SEAT = 6
    EXHAUST = 7

    style = draw.pick("cruiser", "sport", "scooter")
    wheel = draw(0.26, 0.32) if style == "scooter" else draw(0.36, 0.46)
    tyre = draw(0.07, 0.11)
    half_base = draw(0.6, 0.72) + (0.1 if style == "cruiser" else 0)
    # The wheels with their mudguards, arcs between two angles in radians.
    front = point(half_base, 0, wheel)
    rear = point(-half_base, 0, wheel)
    for hub, start, stop in ((rear, -1.5, 0.6), (front, -0.8, 0.7)):
        yield torus(wheel - tyre, tyre, Y, hub), RUBBER
        yield disc(wheel * 0.62, 0.06, hub), METAL
        yield torus(wheel + 0.04, 0.05, Y, hub, start, stop, sides=14), BODY
    # Fork, headlamp and bars.
    rake = draw(0.2, 0.28) + (0.15 if style == "cruiser" else 0)
    head = front + [-rake, 0, draw(0.55, 0.72)]
    head_xz = head[[0, 2]]
    yield from pair(rod(head, front + [0, 0.11, 0], 0.04), METAL)
    yield ellipsoid((0.1, 0.12, 0.12), head + [0.12, 0, draw(-0.06, 0.04)]), HEADLAMP
    grip = head + [-draw(0.12, 0.25), draw(0.3, 0.42), 0]
    grip[2] += draw(0.2, 0.4) if style == "cruiser" else draw(0.02, 0.2)
    bend = grip + [0.1, -0.06, 0]
    yield from pair(rod(head, bend, 0.026), METAL)
    yield from pair(capsule(bend, grip, 0.035), RUBBER)

    seat_z = wheel * 2 + draw(0, 0.12)
    if style == "scooter":
        # Leg shield, footboard, body, seat and rear light.
        board = wheel * draw(0.75, 1.0)  # height of the footboard
        yield pane((half_base - 0.3, board), head_xz, draw(0.4, 0.55), 0.07), BODY
        yield box((half_base * 1.1, 0.36, 0.08), (0, 0, board)), BODY
        body = (half_base * 1.15, 0.42, seat_z - board + 0.1)
        yield rounded_box(body, (-half_base * 0.75, 0, (seat_z + board) / 2), 4), BODY
        seat = (half_base * 1.05, 0.36, 0.14)
        yield rounded_box(seat, (-half_base * 0.65, 0, seat_z + 0.08), 3), SEAT
        yield box((0.06, 0.2, 0.09), (-half_base * 1.35, 0, seat_z * 0.85)), GLASS
    else:
        # Engine, tank, the tubes between them, seat, tail and rear light.
        engine = point(draw(-0.08, 0.08), 0, wheel * draw(0.85, 1.1))
        yield box((draw(0.4, 0.55), 0.3, draw(0.3, 0.42)), engine), ENGINE
        tank = point(head[0] * 0.45, 0, seat_z + 0.14)
        tank_radii = (draw(0.28, 0.36), draw(0.14, 0.19), draw(0.13, 0.18))
        yield ellipsoid(tank_radii, tank), BODY
        for start, end in ((head, engine), (head, tank), (engine, rear)):
            yield from pair(rod(start + [0, 0.04, 0], end + [0, 0.06, 0], 0.032), METAL)
        yield rounded_box((half_base * 0.95, 0.28, 0.13), (-half_base * 0.48, 0, seat_z), 3), SEAT
        tail = point(-half_base * draw(0.95, 1.25), 0, seat_z + draw(0.08, 0.25))
        yield capsule((-half_base * 0.7, 0, seat_z), tail, 0.12, 0.06), BODY
        yield box((0.05, 0.16, 0.08), tail - [0.08, 0, 0]), GLASS
        # A fairing, narrower at its top, with a screen; both by points (x, z).
        if style == "sport":
            top = head_xz + [-0.05, 0.12]
            lower = [[0.05, wheel * 1.6], [0.0, wheel * 0.6], [0.35, wheel * 0.9]]
            fairing = extrusion([head_xz + [0.3, -0.1], top, *lower], draw(0.34, 0.44))
            yield tapered(fairing, wheel, top[1], 0.55), BODY
            yield pane(head_xz + [0.12, 0.08], head_xz + [-0.08, 0.3], 0.24), GLASS
    exhaust_end = (-half_base * draw(0.9, 1.3), -0.22, wheel * draw(0.7, 1.3))
    yield rod((0.05, -0.2, wheel * 0.6), exhaust_end, 0.05, draw(0.06, 0.09)), EXHAUST


def car(draw: Draw) -> Parts:
    """Build a saloon, hatchback, pickup or van: bonnet, cabin with windows, lights, wheels."""
    BUMPER = 2  # and rims
    GLASS = 4
    HEADLAMP = 5
    GRILLE = 6
    REAR_LIGHT = 7

    style = draw.pick("saloon", "hatchback", "pickup", "van")
    length = draw(2.2, 2.8)
    width = draw(0.95, 1.15)
    wheel = draw(0.2, 0.27)
    nose = length / 2
    tail = -nose
    # The lower and the upper edge of the body.
    sill = wheel * draw(0.6, 0.9)
    belt = wheel * draw(2.1, 2.5)
    roof = belt + draw(0.3, 0.45) + (0.15 if style == "van" else 0)
    taper = draw(0.76, 0.88)
    bonnet = draw(0.11, 0.18) if style == "van" else draw(0.24, 0.31)
    bonnet_end = nose - length * bonnet
    # The boot, or the bed of a pickup, is this share of the length.
    boot_start = tail + length * {"saloon": 0.18, "pickup": 0.43}.get(style, 0.02)
    nose_z = belt - (belt - sill) * draw(0.15, 0.35)
    # The body, below the windows: its outline (x, z) from the sill in front to the sill behind.
    front = [
        [nose, sill],
        [nose + 0.03, (sill + nose_z) / 2],
        [nose - 0.04, nose_z],
        [bonnet_end, belt],
    ]
    body = extrusion([[tail, sill], *front, [tail, belt]], width)
    yield tapered(body, sill, belt, 0.94), BODY

    # The cabin, with a pane in front and one behind.
    rear_slope = draw(0.02, 0.08) if style in ("pickup", "van") else draw(0.1, 0.3)
    windscreen = np.array([[bonnet_end + 0.03, belt], [bonnet_end - draw(0.2, 0.38), roof]])
    rear_window = np.array([[boot_start, belt], [boot_start + rear_slope, roof]])
    # The outline runs up the windscreen and down the rear window.
    rear_foot, rear_top = rear_window
    cabin = np.array([rear_foot, *windscreen, rear_top])
    yield tapered(extrusion(cabin, width * 0.92), belt, roof, taper), BODY
    for (low, high), out in ((windscreen, 0.015), (rear_window, -0.015)):
        # The pane leaves a margin at both edges, and is slightly outside the cabin.
        margin = (high - low) * 0.12
        glass = pane(low + margin + [out, 0], high - margin + [out, 0], width * 0.8, 0.03)
        yield tapered(glass, belt, roof, taper), GLASS
    # The side windows have the outline of the cabin, reduced in size, and a pillar in the middle.
    middle = cabin.mean(0)
    windows = extrusion(middle + (cabin - middle) * [0.86, 0.7], width * 0.94)
    yield tapered(windows, belt, roof, taper), GLASS
    pillar = pane((middle[0], belt), (middle[0], roof), width * 0.95, 0.06)
    yield tapered(pillar, belt, roof, taper), BODY
    if style == "pickup":
        # The walls of the bed: two at its sides, one behind.
        wall_height = draw(0.08, 0.18)
        wall_z = belt + wall_height / 2
        bed_length = boot_start - tail
        place = (tail + bed_length / 2, width * 0.44, wall_z)
        yield from pair(box((bed_length, 0.06, wall_height), place))
        yield box((0.06, width * 0.9, wall_height), (tail + 0.03, 0, wall_z)), BODY
    # Headlamps, grille, rear lights, bumpers and wheels.
    light_z = sill + (nose_z - sill) * 0.72
    lamp_radii = (0.06, draw(0.09, 0.15), draw(0.05, 0.08))
    yield from pair(ellipsoid(lamp_radii, (nose, width * 0.34, light_z)), HEADLAMP)
    grille_size = (0.05, width * draw(0.25, 0.4), draw(0.07, 0.12))
    yield box(grille_size, (nose + 0.01, 0, light_z)), GRILLE
    rear_light = (0.04, 0.1, draw(0.1, 0.2))
    yield from pair(box(rear_light, (tail - 0.01, width * 0.4, belt - 0.16)), REAR_LIGHT)
    for x in (nose + 0.02, tail - 0.02):
        yield rounded_box((0.12, width, 0.12), (x, 0, sill + 0.06), 4), BUMPER
    for x in (nose - length * draw(0.16, 0.2), tail + length * draw(0.17, 0.21)):
        yield from wheels(x, width / 2 - 0.05, wheel, 0.16)


def hydrant(draw: Draw) -> Parts:
    """Build a hydrant: barrel, flange, bonnet; a large outlet in front, small ones at the sides."""
    CAP = 1
    NUT = 2
    RING = 3

    radius = draw(0.24, 0.36)
    height = draw(0.9, 1.35)
    neck = radius * draw(0.85, 1)
    rim = radius * 1.22
    bonnet_z = height * 0.82
    foot = [[ON_AXIS, 0], [radius * 1.45, 0], [radius * 1.45, 0.09], [radius, 0.11]]
    flange = [[neck, height * 0.75], [rim, height * 0.76], [rim, bonnet_z], [neck, bonnet_z + 0.01]]
    yield lathe(foot + flange, 24), BODY
    # The bonnet, with the nut that opens the valve and covers its tip, where the radius is 0.
    angle = np.linspace(0, TAU / 4, 7)
    dome = np.stack([np.cos(angle), 0.25 * np.sin(angle)], 1)
    cone = [[1.05, 0], [0.9, 0.14], [0.35, 0.2], [0, 0.22]]
    bonnet = np.array(dome if draw.chance(0.5) else cone) * [radius, height] + [0, bonnet_z]
    yield lathe(bonnet, 24), CAP if draw.chance(0.6) else BODY
    top = bonnet[-1, 1]
    yield rod((0, 0, top - 0.04), (0, 0, top + draw(0.07, 0.14)), 0.07, sides=6), NUT

    outlet = height * draw(0.5, 0.64)
    bore = draw(0.15, 0.21)
    # Height, reach and radius of the outlets.
    large = (outlet, radius + draw(0.14, 0.26), bore)
    small = (outlet + draw(-0.03, 0.13), radius + draw(0.1, 0.2), draw(0.09, 0.13))
    # Each outlet is a pipe with a cap and a nut.
    for turn, (z, reach, pipe) in ((0, large), (TAU / 4, small), (-TAU / 4, small)):
        mouth = (reach, 0, z)
        yield rod((0, 0, z), mouth, pipe).rotated("z", turn), BODY
        yield rod(mouth, (reach + 0.1, 0, z), pipe * 1.2, sides=8).rotated("z", turn), CAP
        yield rod(mouth, (reach + 0.18, 0, z), 0.05, sides=5).rotated("z", turn), NUT
    # Eight bolts around the foot, and a ring for the chain.
    bolt = cylinder(0.035, 0.035, 0.05, 6).translated((radius * 1.27, 0, 0.11))
    for angle in np.arange(8) * TAU / 8 + 0.2:
        yield bolt.rotated("z", angle), NUT
    if draw.chance(0.6):
        place = (radius + 0.12, 0.03, outlet - bore - 0.08)
        yield torus(draw(0.1, 0.16), 0.018, Y, place), RING


BUILDERS = (bicycle, car, hydrant, motorcycle)
