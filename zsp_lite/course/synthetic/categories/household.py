"""Furniture and devices of a household (front +x, left +y, up +z).

The constants at the head of a builder name its materials, 0 to 7: parts of one material look alike.
Other numbers are lengths or shares of lengths, chosen by hand; the unit is arbitrary, since
`make_shape` scales each object. The third argument of `rounded_box` is its squareness. The second
of `lathe` and the fourth of `cylinder` are numbers of sides.
"""

import numpy as np

from zsp_lite.course.synthetic.assembly import BODY, Draw, Parts, pair, rounded_box
from zsp_lite.course.synthetic.primitives import (
    ON_AXIS,
    TAU,
    Mesh,
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


def chair(draw: Draw) -> Parts:
    """Build a chair: seat, back of one of four styles, base of one of three, optional arms."""
    BACK = 1
    FRAME = 2
    ARM = 3

    width = draw(0.8, 1.2)
    depth = draw(0.8, 1.1)
    height = draw(0.6, 1.1)
    thick = draw(0.06, 0.16)
    back = draw(0.7, 1.3)
    leg = draw(0.03, 0.075)
    lean = draw(0, 0.3)
    if draw.chance(0.4):
        seat = rounded_box((depth, width, thick * 1.4), squareness=6)
    else:
        seat = box((depth, width, thick))
    yield seat.translated((0, 0, height)), BODY

    # The back is built upright at the origin; it leans about its lower edge.
    def on_back(mesh: Mesh) -> Mesh:
        return mesh.rotated("y", -lean).translated((-depth / 2 + thick / 2, 0, height))

    style = draw.pick("panel", "round", "slats", "rungs")
    if style == "panel":
        yield on_back(box((thick, width * draw(0.8, 1), back), (0, 0, back / 2))), BACK
    elif style == "round":
        panel = (thick * 1.5, width * 0.95, back * 0.6)
        yield on_back(rounded_box(panel, (0, 0, back * 0.7), 3)), BACK
        post = rod((0, width * 0.3, 0), (0, width * 0.3, back * 0.6), leg)
        yield from pair(on_back(post), FRAME)
    else:
        # Slats are many posts with one rung on top; heights are shares of the back's.
        rungs = (0.35, 0.65, 0.95)
        n_posts = 2
        if style == "slats":
            rungs = (0.93,)
            n_posts = 4 + draw.choice(3)
        for y in np.linspace(-0.45, 0.45, n_posts) * width:
            yield on_back(box((thick * 0.7, 0.08, back), (0, y, back / 2))), FRAME
        rung_height = back * draw(0.1, 0.2)
        for share in rungs:
            yield on_back(box((thick * 0.8, width, rung_height), (0, 0, back * share))), BACK

    # The base; x and y are those of the front left leg.
    x = depth / 2 - 0.06
    y = width / 2 - 0.06
    base = draw.pick("swivel", "cantilever", "legs", "legs")
    if base == "swivel":
        yield rod((0, 0, 0.1), (0, 0, height), leg * 1.3), FRAME
        for angle in np.arange(5) * TAU / 5 + draw(0, 1):
            foot = (0.55 * np.cos(angle), 0.55 * np.sin(angle), 0.06)
            yield capsule((0, 0, 0.14), foot, leg), FRAME
    elif base == "cantilever":
        # One bent tube per side, open at the back.
        corners = [
            (-x, y, height - thick / 2),
            (x, y, height - thick / 2),
            (x, y, leg),
            (-x, y, leg),
        ]
        for start, end in zip(corners, corners[1:]):
            yield from pair(capsule(start, end, leg), FRAME)
        yield rod((-x, y, leg), (-x, -y, leg), leg), FRAME
    else:
        splay = draw(0, 0.14)
        for end in (-1, 1):
            foot = (end * (x + splay), y + splay, 0)
            yield from pair(rod((end * x, y, height), foot, leg), FRAME)
    # The arms, each on two posts.
    if draw.chance(0.45):
        side = width / 2
        rest = height + draw(0.22, 0.4)
        arm = rounded_box((depth * draw(0.7, 0.95), 0.12, 0.09), (0, side, rest), 5)
        yield from pair(arm, ARM)
        for post_x in (depth * 0.3, -depth * 0.38):
            yield from pair(rod((post_x, side, height), (post_x, side, rest), leg), FRAME)


def toilet(draw: Draw) -> Parts:
    """Build a toilet: bowl, seat, open or closed lid; cistern with a button or a side lever."""
    SEAT = 1
    LID = 2
    COVER = 3
    METAL = 5

    # The length and the width are radii of the bowl.
    length = draw(0.5, 0.66)
    width = draw(0.36, 0.46)
    height = draw(0.6, 0.8)
    foot = draw(0.5, 0.75)
    bowl_x = length * 0.75
    # The bowl: profiles of unit radius.
    outside = [
        [ON_AXIS, 0],
        [foot * 0.9, 0],
        [foot * 0.8, height * 0.3],
        [0.95, height * 0.75],
        [1, height],
    ]
    inside = [[0.78, height], [0.55, height * 0.72], [ON_AXIS, height * 0.55]]
    yield lathe(outside + inside, 28).scaled((length, width, 1)).translated((bowl_x, 0, 0)), BODY
    base = (bowl_x + 0.15, width * foot * 1.5, height * 0.95)
    yield rounded_box(base, (bowl_x * 0.35, 0, height * 0.47), 6), BODY
    # Seat and lid; the lid is built closed, with its hinge at the origin.
    seat = torus(0.88, 0.14, sides=32).scaled((length, width, 0.5))
    yield seat.translated((bowl_x, 0, height + 0.04)), SEAT
    is_open = draw.chance(0.6)
    hinge = (bowl_x - length, 0, height + 0.1)
    lid = ellipsoid((length * 1.02, width * 1.02, 0.04), (length, 0, 0), sides=28)
    if is_open:
        lid = lid.rotated("y", -draw(1.6, 1.85))
    yield lid.translated(hinge), SEAT if draw.chance(0.6) else LID
    # The cistern, farther behind if the lid leans on it.
    depth = draw(0.28, 0.38)
    tank_width = width * draw(1.7, 2.3)
    tank_height = draw(0.6, 0.9)
    tank_x = hinge[0] - depth / 2 - (0.12 if is_open else 0)
    tank_z = height * draw(0.85, 1.05)
    top = tank_z + tank_height
    tank = (depth, tank_width, tank_height)
    yield rounded_box(tank, (tank_x, 0, tank_z + tank_height / 2), draw(5, 12)), BODY
    cover = rounded_box((depth * 1.12, tank_width * 1.06, 0.09), (tank_x, 0, top), 8)
    yield cover, COVER if draw.chance(0.3) else BODY
    yield box((depth * 1.2, tank_width * 0.45, tank_z), (tank_x + 0.1, 0, tank_z / 2)), BODY
    if draw.chance(0.5):
        yield cylinder(0.08, 0.08, 0.04).translated((tank_x, 0, top + 0.06)), METAL
    else:
        lever = point(tank_x + depth / 2 + 0.03, tank_width * 0.32, tank_z + tank_height * 0.82)
        yield rod(lever, lever + [0.03, -0.2, -0.02], 0.03), METAL


def hairdryer(draw: Draw) -> Parts:
    """Build a hair dryer: barrel, nozzle or diffuser, grille at the back, handle with a switch."""
    NOZZLE = 1
    HANDLE = 2
    DARK = 3  # grille, switch and cable

    length = draw(0.9, 1.3)
    radius = draw(0.22, 0.34)
    mouth = radius * draw(0.55, 0.85)
    rear = -length * 0.43
    front = length * 0.57
    # The barrel, from its back to its mouth.
    barrel = [
        [ON_AXIS, rear],
        [radius * 0.7, rear],
        [radius, -length * 0.3],
        [radius, 0],
        [mouth, front],
        [ON_AXIS, front],
    ]
    yield lathe(barrel, 24).rotated("y", TAU / 4), BODY
    # The nozzle or the diffuser is built about z, upwards from the mouth.
    if draw.chance(0.6):
        # A nozzle becomes more or less flat towards its slot.
        reach = draw(0.15, 0.4)
        high = draw(0.25, 0.8)
        wide = draw(0.8, 1.5)
        cone = cylinder(mouth, mouth, reach, 20).translated((0, 0, reach / 2))
        share = cone.vertices[:, 2:] / reach  # of the way to the slot
        nozzle = Mesh(cone.vertices * (1 + share * (point(high, wide, 1) - 1)), cone.faces)
    else:
        reach = draw(0.2, 0.3)
        bowl = [
            [mouth, 0],
            [mouth * 1.1, reach * 0.3],
            [radius * 1.4, reach],
            [ON_AXIS, reach * 0.8],
        ]
        nozzle = lathe(bowl, 24)
    yield nozzle.rotated("y", TAU / 4).translated((front, 0, 0)), NOZZLE
    # The bars of the grille.
    for y in (-0.4, 0, 0.4):
        yield box((0.03, 0.05, radius * 1.1), (rear, y * radius, 0)), DARK
    # The handle, with a switch and a cable.
    top = point(-0.08, 0, -radius * 0.5)
    bottom = point(-0.08 + draw(-0.25, 0.15), 0, -draw(0.7, 1.1))
    handle = capsule(top, bottom, draw(0.11, 0.16), draw(0.09, 0.13))
    yield handle, BODY if draw.chance(0.5) else HANDLE
    switch = top + (bottom - top) * draw(0.35, 0.6) + [0.13, 0, 0]
    yield box((0.06, 0.1, 0.22), switch), DARK
    cable_end = bottom + [-draw(0.1, 0.35), draw(-0.2, 0.2), -0.38]
    yield capsule(bottom, cable_end, 0.035, 0.025), DARK


def toaster(draw: Draw) -> Parts:
    """Build a toaster: one to four slots; lever, dial and buttons at the front, else symmetric."""
    END_PLATE = 1
    TOP = 2
    DARK = 3  # slots, slit, feet and cable
    LEVER = 4
    KNOB = 5
    TOAST = 6

    length = draw(1.0, 1.6)
    width = draw(0.55, 0.85)
    height = draw(0.65, 0.95)
    feet = draw(0.03, 0.08)
    end = length / 2
    top = feet + height
    middle = feet + height / 2
    if draw.chance(0.6):
        yield rounded_box((length, width, height), (0, 0, middle), draw(4, 9)), BODY
    else:
        # An arch across, with end plates of another material: points (y, z) of the upper half of a
        # superellipse, between the lower edges.
        side = width / 2
        angle = np.linspace(0, np.pi, 13)
        across = np.cos(angle)
        y = side * np.sign(across) * np.abs(across) ** 0.6
        z = feet + height * (0.35 + 0.65 * np.sin(angle) ** 0.6)
        arch = np.array([(side, feet), *zip(y, z), (-side, feet)])
        yield extrusion(arch, length * 0.84, "yz"), BODY
        plate = (arch - [0, middle]) * 1.03 + [0, middle]
        for x in (-0.455, 0.455):
            yield extrusion(plate, length * 0.09, "yz", x * length), END_PLATE
    yield box((length * 0.8, width * 0.78, 0.03), (0, 0, top)), TOP
    # One or two rows of slots side by side; in a long toaster, each may be divided in two.
    two_rows = draw.chance(0.75)
    slot_y = width * 0.22 if two_rows else 0.0
    slots = (0,)
    slot = length * 0.66
    if length > 1.35 and draw.chance(0.6):
        slots = (-0.21, 0.21)
        slot = length * 0.34
    toasting = draw.chance(0.3)
    for x in slots:
        yield from pair(box((slot, 0.1, 0.02), (x * length, slot_y, top + 0.016)), DARK, two_rows)
        if toasting:
            place = (x * length, slot_y, top + draw(-0.12, 0))
            yield from pair(rounded_box((slot * 0.9, 0.07, 0.5), place, 6), TOAST, two_rows)
    # At the front end: the lever in its slit, a dial on the left, buttons on the right.
    yield box((0.02, 0.05, height * draw(0.25, 0.45)), (end, 0, middle + 0.05)), DARK
    lever = (0.16, draw(0.14, 0.3), 0.08)
    yield rounded_box(lever, (end + 0.07, 0, middle + draw(-0.1, 0.25) * height), 4), LEVER
    knob_y = draw(0.18, 0.28) * width
    knob_z = feet + height * 0.25
    dial_end = (end + 0.07, knob_y, knob_z)
    yield rod((end - 0.03, knob_y, knob_z), dial_end, draw(0.06, 0.1)), KNOB
    for z in knob_z + height * 0.14 * np.arange(1 + draw.choice(3)):
        yield rod((end - 0.03, -knob_y, z), (end + 0.04, -knob_y, z), 0.035), KNOB
    # The feet, and a cable.
    foot = cylinder(0.06, 0.07, feet * 2)
    for x in (-0.36, 0.36):
        yield from pair(foot.translated((x * length, width * 0.32, feet / 2)), DARK)
    if draw.chance(0.6):
        cable_end = (-end - draw(0.1, 0.25), draw(-0.2, 0.2), 0.03)
        yield capsule((-end, 0.1, feet + 0.1), cable_end, 0.025), DARK


BUILDERS = (chair, hairdryer, toaster, toilet)
