"""Toys (front +x, left +y, up +z).

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
    disc,
    pair,
    pane,
    rounded_box,
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
)

# Materials of several vehicles; `wheels` gives their rims material 2, and their tyres 3.
_CHASSIS = 2
_GLASS = 4
_HEADLAMP = 5


def teddybear(draw: Draw) -> Parts:
    """Build a sitting or standing teddy bear, some with a light belly or a shirt."""
    LIGHT_FUR = 1
    FOOT = 2
    DARK = 3  # nose and eyes
    SHIRT = 4

    belly = draw(0.36, 0.55)
    tall = draw(0.48, 0.68)
    skull = draw(0.32, 0.46)
    standing = draw.chance(0.3)
    seat = draw(0.35, 0.5) if standing else 0.0  # height of the body's lower end
    yield ellipsoid((belly * 0.85, belly, tall), (0, 0, seat + tall)), BODY
    # The head: skull, muzzle, nose, eyes and ears.
    head = point(0.05, 0, seat + tall * 1.85 + skull * 0.68)
    yield ellipsoid((skull * 0.9, skull * draw(0.95, 1.18), skull), head), BODY
    snout = draw(0.13, 0.26)
    face = head + [skull * 0.82, 0, 0]
    yield ellipsoid((snout, draw(0.15, 0.21), 0.15), face - [0, 0, 0.09]), LIGHT_FUR
    yield ellipsoid((0.06, 0.075, 0.05), face + [snout * 0.92, 0, -0.04]), DARK
    yield from pair(ellipsoid((0.05, 0.05, 0.06), face + [0, skull * 0.36, skull * 0.22]), DARK)
    ear = draw(0.12, 0.2)
    ear_centre = head + [0, skull * draw(0.65, 0.85), skull * draw(0.65, 0.85)]
    yield from pair(ellipsoid((0.075, ear, ear), ear_centre), LIGHT_FUR)
    # Each arm has its own pose, raised or hanging.
    for side in (1, -1):
        shoulder = point(0, side * belly * 0.8, seat + tall * 1.45)
        forwards = draw(-0.05, 0.45)
        outwards = draw(0.2, 0.42)
        hand = shoulder + [forwards, side * outwards, draw(-0.5, 0.45)]
        yield capsule(shoulder, hand, draw(0.12, 0.16), draw(0.12, 0.18)), BODY
    # Legs and feet; a sitting bear shows its soles.
    leg = draw(0.14, 0.21)
    if standing:
        foot = point(0.08, belly * 0.6, leg)
        yield from pair(capsule((0, belly * 0.5, seat + tall * 0.4), foot, leg))
        yield from pair(ellipsoid((leg * 1.5, leg, leg * 0.7), foot + [0.1, 0, -leg * 0.35]), FOOT)
    else:
        foot = point(draw(0.45, 0.75), belly * draw(0.7, 1.1), leg)
        yield from pair(capsule((0.1, belly * 0.55, 0.15), foot, leg))
        sole = ellipsoid((0.07, leg * 0.85, leg * 1.15), foot + [leg * 0.85, 0, 0.05])
        yield from pair(sole, LIGHT_FUR)
    # The tail; then a light belly, a shirt, or neither.
    yield ellipsoid(0.1, (-belly * 0.85, 0, seat + 0.25)), BODY
    if draw.chance(0.6):
        light_belly = (belly * 0.3, belly * 0.65, tall * 0.65)
        yield ellipsoid(light_belly, (belly * 0.62, 0, seat + tall * 0.95)), LIGHT_FUR
    elif draw.chance(0.6):
        shirt = np.array([[0.97, 0.75], [1.04, 1.0], [0.96, 1.4], [0.66, 1.78]]) * [belly, tall]
        yield lathe(shirt, 24).scaled((0.87, 1, 1)).translated((0, 0, seat)), SHIRT


def toyplane(draw: Draw) -> Parts:
    """Build a propeller plane or a jet: one or two wings, tail, engines, cockpit, some wheels."""
    WING = 1
    FIN = 2
    METAL = 3
    BLADE = 5
    TYRE = 6

    length = draw(1.6, 2.6)
    radius = draw(0.16, 0.32)
    nose = length / 2
    tail = -nose
    jet = draw.chance(0.4)
    yield capsule((tail, 0, 0), (nose - radius, 0, 0), radius * draw(0.35, 0.7), radius), BODY
    # The outline (x, y) of the left wing, from its leading to its trailing edge.
    span = draw(0.8, 1.5)
    chord = draw(0.3, 0.6)
    wing_x = draw(-0.1, 0.3)
    sweep = draw(0.25, 0.6) if jet else draw(-0.05, 0.2)
    lead = wing_x + chord / 2
    trail = wing_x - chord / 2
    wing = [
        [lead, 0],
        [lead - sweep, span],
        [trail - sweep + chord * draw(0.1, 0.4), span],
        [trail, 0],
    ]
    biplane = not jet and draw.chance(0.35)
    if biplane:
        wing_z = -radius * 0.7
    elif draw.chance(0.7):
        wing_z = draw(-0.12, 0.1)
    else:
        wing_z = radius
    yield from pair(extrusion(wing, 0.06, "xy", wing_z), WING)
    # A biplane has a second wing, and struts between the two.
    if biplane:
        upper = radius * 1.6
        yield from pair(extrusion(wing, 0.06, "xy", upper), WING)
        for root_x in (lead - 0.1, trail + 0.1):
            x = root_x - sweep * 0.6
            y = span * 0.65
            yield from pair(rod((x, y, wing_z), (x, y, upper), 0.02), METAL)
    # The tail: a fin, and a stabiliser at its foot or at its top.
    fin = draw(0.3, 0.6)
    stabiliser = draw(0.3, 0.55)
    side_view = [[tail + 0.35, 0], [tail + 0.05, fin], [tail - 0.12, fin], [tail - 0.02, 0]]
    yield extrusion(side_view, 0.06), FIN
    top_view = [[tail + 0.3, 0], [tail + 0.1, stabiliser], [tail - 0.1, stabiliser], [tail, 0]]
    z = 0.05 if draw.chance(0.75) else fin * 0.92
    yield from pair(extrusion(top_view, 0.05, "xy", z), WING)
    # Two jet engines, or a propeller with its spinner.
    if jet:
        # The engines are below the wings, or beside the tail.
        engine = point(wing_x - sweep * 0.4, span * 0.4, wing_z - 0.13)
        if not draw.chance(0.6):
            engine = point(tail + 0.55, radius + 0.1, 0.08)
        half = point(0.2, 0, 0)
        yield from pair(rod(engine - half, engine + half, 0.08, draw(0.1, 0.13)), METAL)
    else:
        yield ellipsoid((0.12, 0.09, 0.09), (nose + 0.05, 0, 0)), METAL
        blade = draw(0.3, 0.45)
        turn = draw(0, np.pi)
        n_blades = 2 + draw.choice(3)
        upright = box((0.035, 0.1, blade), (nose + 0.08, 0, blade / 2))
        for k in range(n_blades):
            yield upright.rotated("x", turn + k * TAU / n_blades), BLADE
    # The cockpit, and wheels on struts.
    cockpit = (draw(0.2, 0.35), radius * 0.7, radius * 0.7)
    yield ellipsoid(cockpit, (length * draw(0.16, 0.28), 0, radius * 0.75)), _GLASS
    if draw.chance(0.6):
        gear = point(wing_x + 0.1, 0.25, -radius - 0.22)
        # The strut reaches from the middle of the hull outwards.
        yield from pair(rod(gear * [1, 0.6, 0], gear, 0.025), METAL)
        yield from pair(disc(0.1, 0.07, gear), TYRE)


def toytruck(draw: Draw) -> Parts:
    """Build a truck: cab, some with a bonnet; a box, flat bed, tank, tipper or crane behind."""
    LOAD = 1
    CABLE = 3  # and tyres
    GRILLE = 6

    length = draw(1.7, 2.6)
    width = draw(0.7, 1.0)
    wheel = draw(0.16, 0.28)
    nose = length / 2
    tail = -nose
    deck = wheel * 1.3
    cab_length = draw(0.4, 0.65)
    cab_height = draw(0.5, 0.85)
    slope = draw(0.04, 0.18)
    yield box((length, width * 0.8, 0.12), (0, 0, deck)), _CHASSIS
    bonnet = draw(0.25, 0.45) if draw.chance(0.5) else 0.0
    if bonnet:
        size = (bonnet * 1.3, width * 0.85, cab_height * 0.55)
        yield rounded_box(size, (nose - bonnet * 0.5, 0, deck + cab_height * 0.26), 6), BODY
    # The cab: its outline from the side, windows, headlamps and grille.
    front = nose - bonnet * 0.85
    roof = deck + cab_height
    rear = front - cab_length
    # Points (x, z): the lower and the upper edge of the windscreen, then the outline from the rear.
    bend = point(front, deck + cab_height * 0.5)
    top = point(front - slope, roof)
    floor = deck + 0.04
    yield extrusion([(rear, floor), (front, floor), bend, top, (rear, roof)], width), BODY
    side_window = (cab_length * 0.5, width * 1.02, cab_height * 0.3)
    yield box(side_window, (rear + cab_length * 0.48, 0, deck + cab_height * 0.72)), _GLASS
    yield pane(bend + [0.01, 0.04], top + [0.01, -0.04], width * 0.84), _GLASS
    lamp = ellipsoid((0.05, 0.08, 0.08), (nose, width * 0.34, deck + cab_height * 0.28))
    yield from pair(lamp, _HEADLAMP)
    grille_size = (0.06, width * 0.4, cab_height * 0.2)
    yield box(grille_size, (nose + 0.01, 0, deck + cab_height * 0.27)), GRILLE

    # What the truck carries: `load_length` is the length behind the cab.
    load_length = rear - 0.05 - tail
    load_x = tail + load_length / 2
    style = draw.pick("box", "tank", "crane", "tipper", "flat bed")
    if style == "box":
        height = draw(0.6, 1.0)
        size = (load_length, width * draw(0.95, 1.1), height)
        yield box(size, (load_x, 0, deck + 0.08 + height / 2)), LOAD
    elif style == "tank":
        radius = width * draw(0.38, 0.5)
        axis_z = deck + radius
        yield rod((tail, 0, axis_z), (tail + load_length, 0, axis_z), radius, sides=22), LOAD
    elif style == "crane":
        mast = point(load_x, 0, deck + 0.3)
        jib = mast + [-load_length * draw(0.4, 0.7), 0, draw(0.5, 0.9)]
        base = width * 0.35
        yield cylinder(base, base, 0.2).translated((load_x, 0, deck + 0.16)), LOAD
        yield box(0.3, mast + [0, 0, 0.08]), LOAD
        yield rod(mast, jib, 0.07, 0.05), LOAD
        yield rod(jib, jib - [0, 0, 0.45], 0.02), CABLE
    else:
        # A tipper is a flat bed that is tilted about its rear edge.
        tilt = draw(0.15, 0.6) if style == "tipper" else 0.0
        wall = draw(0.2, 0.45)
        middle = load_length / 2
        bottom = box((load_length, width, 0.06), (middle, 0, 0))
        front_wall = box((0.06, width, wall), (load_length, 0, wall / 2))
        side_wall = box((load_length, 0.06, wall), (middle, width / 2, wall / 2))
        for mesh in (bottom, front_wall, side_wall, side_wall.mirrored()):
            yield mesh.rotated("y", -tilt).translated((tail, 0, deck + 0.1)), LOAD
    # One rear axle or two, and one below the cab.
    axles = [nose - cab_length * 0.6 - 0.1]
    if draw.chance(0.5):
        axles.append(tail + 0.3)
    else:
        axles += [tail + 0.25, tail + 0.25 + 2.1 * wheel]
    for x in axles:
        yield from wheels(x, width / 2 - 0.02, wheel, 0.16)


def toybus(draw: Draw) -> Parts:
    """Build a city bus, double-decker or school bus with a bonnet; doors on the right."""
    STRIPE = 1
    DOOR = 6  # and destination sign
    REAR_LIGHT = 7

    style = draw.pick("city bus", "double-decker", "school bus")
    length = draw(1.9, 2.9)
    width = draw(0.65, 0.9)
    wheel = draw(0.15, 0.22)
    height = draw(0.65, 0.85)
    # Heights of the door, of the windows and of their middles, as shares of the bus's height.
    door_share = 0.72
    window_share = 0.3
    floor_shares = [0.66]
    if style == "double-decker":
        height *= 1.6
        door_share = 0.42
        window_share = 0.2
        floor_shares = [0.36, 0.78]
    nose = length / 2
    tail = -nose
    floor = wheel * 0.8
    # A bonnet, or a destination sign at the front.
    bonnet = draw(0.3, 0.45) if style == "school bus" else 0.0
    if bonnet:
        size = (bonnet * 1.4, width * 0.8, height * 0.5)
        yield rounded_box(size, (nose - bonnet * 0.6, 0, floor + height * 0.25), 6), BODY
    else:
        yield box((0.05, width * 0.7, height * 0.1), (nose, 0, floor + height * 0.93)), DOOR
    # The body with a stripe along it.
    front = nose - bonnet
    body = front - tail
    middle = (front + tail) / 2
    yield rounded_box((body, width, height), (middle, 0, floor + height / 2), draw(7, 14)), BODY
    stripe = (body * 0.96, width * 1.02, height * draw(0.04, 0.1))
    yield box(stripe, (middle, 0, floor + height * 0.3)), STRIPE
    # The windows of each floor: at the sides, in front and behind.
    n_windows = 4 + draw.choice(4)
    window_height = height * window_share
    pitch = body * 0.9 / n_windows
    for share in floor_shares:
        z = floor + height * share
        for k in range(n_windows):
            x = tail + body * 0.05 + (k + 0.5) * pitch
            yield box((pitch * 0.82, width * 1.015, window_height), (x, 0, z)), _GLASS
        yield box((0.04, width * 0.84, window_height * 1.2), (front, 0, z)), _GLASS
        yield box((0.04, width * 0.6, window_height * 0.8), (tail, 0, z)), _GLASS
    # The door on the right, headlamps and rear lights.
    door = height * door_share
    place = (front - body * 0.12, -width / 2, floor + 0.06 + door / 2)
    yield box((pitch * 0.9, 0.04, door), place), DOOR
    yield from pair(ellipsoid((0.05, 0.07, 0.07), (nose, width * 0.33, floor + 0.14)), _HEADLAMP)
    yield from pair(box((0.03, 0.09, 0.14), (tail, width * 0.4, floor + 0.2)), REAR_LIGHT)
    for x in (nose - length * draw(0.18, 0.24), tail + length * draw(0.17, 0.24)):
        yield from wheels(x, width / 2 - 0.04, wheel, 0.12)


def toytrain(draw: Draw) -> Parts:
    """Build a locomotive: steam engine with boiler, chimney and cab, or diesel with a long hood."""
    ROOF = 1
    CHIMNEY = 3  # and tyres
    BOILER_DOOR = 6
    BRASS = 7  # dome, cowcatcher and rods

    length = draw(1.6, 2.3)
    width = draw(0.6, 0.8)
    wheel = draw(0.14, 0.24)
    nose = length / 2
    tail = -nose
    deck = wheel * 1.5
    yield box((length, width * 0.85, 0.12), (0, 0, deck)), _CHASSIS
    # The cab with windows and a roof.
    cab_length = length * draw(0.22, 0.34)
    cab_height = draw(0.65, 0.95)
    cab_x = tail + cab_length / 2 + 0.04
    floor = deck + 0.06
    yield box((cab_length, width, cab_height), (cab_x, 0, floor + cab_height / 2)), BODY
    windows = (cab_length * 0.5, width * 1.03, cab_height * 0.3)
    yield box(windows, (cab_x, 0, deck + cab_height * 0.72)), _GLASS
    roof = (cab_length * 0.68, width * 0.6, draw(0.08, 0.18))
    yield ellipsoid(roof, (cab_x, 0, floor + cab_height)), ROOF
    # Before the cab, a boiler with chimney, dome and lamp, or a hood with lamps and exhaust.
    rear = tail + cab_length
    front = nose - 0.06
    if draw.chance(0.7):
        radius = width * draw(0.34, 0.46)
        axis_z = floor + radius
        end = (front, 0, axis_z)
        top = floor + radius * 1.9
        yield rod((rear, 0, axis_z), end, radius, sides=24), BODY
        yield rod(end, (front + 0.05, 0, axis_z), radius * 0.86, sides=24), BOILER_DOOR
        chimney = draw(0.2, 0.45)
        mouth = draw(0.08, 0.18)
        # The chimney's ends are closed.
        profile = [
            [ON_AXIS, 0],
            [0.09, 0],
            [0.09, chimney * 0.6],
            [mouth, chimney],
            [ON_AXIS, chimney],
        ]
        yield lathe(profile).translated((front - 0.2, 0, top)), CHIMNEY
        dome = (0.13, 0.13, draw(0.12, 0.2))
        yield ellipsoid(dome, (rear + (front - rear) * 0.42, 0, top)), BRASS
        yield rod(end, (front + 0.15, 0, axis_z), 0.08, 0.1), _HEADLAMP
    else:
        hood_width = width * draw(0.7, 0.95)
        hood_height = cab_height * draw(0.55, 0.8)
        middle = (rear + front) / 2
        hood = (front - rear, hood_width, hood_height)
        yield rounded_box(hood, (middle, 0, floor + hood_height / 2), 9), BODY
        lamp = ellipsoid((0.05, 0.07, 0.07), (front, width * 0.22, deck + hood_height * 0.8))
        yield from pair(lamp, _HEADLAMP)
        yield box((0.25, width * 0.3, 0.14), (middle, 0, deck + 0.1 + hood_height)), CHIMNEY
    # The cowcatcher; wheels on two to four axles, and the rods that connect them.
    cowcatcher = [[nose, deck + 0.05], [nose + draw(0.12, 0.25), 0.05], [nose, 0.05]]
    yield extrusion(cowcatcher, width * 0.75), BRASS
    axles = np.linspace(tail + wheel * 1.3, nose - wheel * 1.6, 2 + draw.choice(3))
    for x in axles:
        yield from wheels(x, width / 2 - 0.03, wheel, 0.08)
    connection = (axles[-1] - axles[0], 0.03, 0.05)
    yield from pair(box(connection, (axles.mean(), width / 2 + 0.06, wheel)), BRASS)


BUILDERS = (teddybear, toybus, toyplane, toytrain, toytruck)
