"""The categories that weights and constants are fitted to; none of them is evaluated.

Objects have their front at +x, left at +y, top at +z. The constants at the head of a builder name
its materials, 0 to 7: parts of one material look alike.
"""

import numpy as np

from zsp_lite.course.synthetic.assembly import Assembly, X, Y, by_name, disc
from zsp_lite.course.synthetic.primitives import (
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


def quadruped(a: Assembly) -> None:
    """Build a four-legged animal with a neck, a snout, a tail, and mostly ears."""
    SNOUT = 1
    EAR = 2  # and tail
    EYE = 3

    length = a.uniform(0.8, 1.5)
    radius = a.uniform(0.22, 0.38)
    leg = a.uniform(0.35, 0.9)
    z = leg + radius * 0.6
    front = length / 2
    chest = (front, 0, z + a.uniform(-0.05, 0.1))
    a.add(capsule((-front, 0, z), chest, radius * a.uniform(0.8, 1), radius))
    for x in (-front, front - 0.05):
        foot = (x + a.uniform(-0.1, 0.1), radius * 0.65, 0.06)
        hip = (x, radius * 0.6, z - 0.05)
        a.add_pair(capsule(hip, foot, a.uniform(0.08, 0.13), a.uniform(0.06, 0.1)))
    # The neck, the snout, the ears and the eyes.
    head = point(front + a.uniform(0.1, 0.4), 0, z + a.uniform(0.25, 0.9))
    a.add(capsule((front, 0, z + 0.1), head, a.uniform(0.12, 0.2), a.uniform(0.1, 0.18)))
    nose = head + [a.uniform(0.2, 0.4), 0, -0.08]
    a.add(capsule(head, nose, a.uniform(0.15, 0.24), a.uniform(0.09, 0.15)), SNOUT)
    if a.chance(0.8):
        ear_size = (0.05, a.uniform(0.06, 0.12), a.uniform(0.1, 0.22))
        a.add_pair(ellipsoid(ear_size, head + [-0.05, 0.15, 0.2]), EAR)
    a.add_pair(ellipsoid((0.04, 0.03, 0.04), head + [0.1, 0.15, 0.08]), EYE)
    tail = (-front - radius - a.uniform(0.1, 0.5), 0, z + a.uniform(-0.4, 0.4))
    a.add(capsule((-front - radius * 0.6, 0, z + 0.1), tail, 0.06, 0.04), EAR)


def fish(a: Assembly) -> None:
    """Build a fish with a forked tail, a fin on its back and two at its sides."""
    FIN = 1  # and tail
    SIDE_FIN = 2
    EYE = 3

    length = a.uniform(0.8, 1.2)
    height = a.uniform(0.3, 0.6)
    a.add(ellipsoid((length, a.uniform(0.15, 0.35), height)))
    tail = [
        [-length * 0.85, 0],
        [-length * 1.5, a.uniform(0.3, 0.55)],
        [-length * 1.3, 0],
        [-length * 1.5, -a.uniform(0.3, 0.55)],
    ]
    a.add(extrusion(tail, 0.06), FIN)
    fin = [
        [0.3 * length, height * 0.8],
        [-0.1 * length, height * 0.9 + a.uniform(0.15, 0.5)],
        [-0.5 * length, height * 0.7],
    ]
    a.add(extrusion(fin, 0.05), FIN)
    a.add_pair(ellipsoid((0.06, 0.05, 0.06), (length * 0.72, 0.14, height * 0.2)), EYE)
    side_fin = ellipsoid((0.25, 0.04, 0.12)).rotated("z", -0.5)
    a.add_pair(side_fin.translated((0.15, 0.28, -0.1)), SIDE_FIN)


def teapot(a: Assembly) -> None:
    """Build a teapot with a lid, its spout in front and its handle behind."""
    LID = 1
    HANDLE = 2  # and knob

    radius = a.uniform(0.5, 0.7)
    height = a.uniform(0.6, 1.1)
    belly = (radius, height * a.uniform(0.3, 0.7))
    neck = (radius * a.uniform(0.4, 0.7), height)
    # The radius 0 would give triangles without an area.
    a.add(lathe([(0.001, 0), (radius * 0.7, 0), belly, neck, (0.001, height)]))
    a.add(ellipsoid((radius * 0.5, radius * 0.5, 0.12), (0, 0, height)), LID)
    a.add(ellipsoid((0.09, 0.09, 0.1), (0, 0, height + 0.15)), HANDLE)
    spout = (radius * 1.25, 0, height * a.uniform(0.7, 1.1))
    a.add(rod((radius * 0.75, 0, height * 0.35), spout, 0.14, 0.06))
    # The handle is a little less than half a ring. About Y, angles begin at the top and go to the
    # front: from 180 degrees, below, to 360 degrees, the arc is behind.
    ring = height * a.uniform(0.25, 0.35)
    place = (-radius * 0.9, 0, height * 0.5)
    a.add(torus(ring, a.uniform(0.04, 0.07), Y, place, 1.05 * np.pi, 1.95 * np.pi), HANDLE)


def guitar(a: Assembly) -> None:
    """Build an upright guitar: two round halves of the body, hole, neck, head and bridge."""
    NECK = 1
    BRIDGE = 2  # and head
    HOLE = 3

    radius = a.uniform(0.4, 0.55)
    neck = a.uniform(1.0, 1.5)
    # The lower and the upper half of the body.
    for half, z in ((radius, 0), (radius * 0.75, radius * 1.1)):
        a.add(cylinder(half, half, 0.22, 24).rotated("y", TAU / 4).translated((0, 0, z)))
    hole = cylinder(0.14, 0.14, 0.24, 16).rotated("y", TAU / 4)
    a.add(hole.translated((0.01, 0, radius * 0.75)), HOLE)
    shoulder = radius * 1.6
    a.add(box((0.08, 0.12, neck), (0.1, 0, shoulder + neck / 2)), NECK)
    a.add(box((0.07, 0.22, 0.3), (0.07, 0, shoulder + neck + 0.12)), BRIDGE)
    a.add(box((0.06, 0.3, 0.06), (0.14, 0, -radius * 0.35)), BRIDGE)


def camera(a: Assembly) -> None:
    """Build a camera with a lens in front, a viewfinder and a button on top, a display behind."""
    LENS = 1
    VIEWFINDER = 2
    BUTTON = 3
    GLASS = 4  # of the lens and the display

    width = a.uniform(1.0, 1.5)
    height = a.uniform(0.6, 0.9)
    depth = a.uniform(0.3, 0.5)
    a.add(box((depth, width, height)))
    radius = a.uniform(0.2, 0.33)
    lens = a.uniform(0.2, 0.7)
    y = a.uniform(-0.15, 0.15)
    front = depth / 2 + lens
    barrel = rod((depth / 2, y, 0), (front, y, 0), radius, radius * a.uniform(0.8, 1.1), 18)
    a.add(barrel, LENS)
    a.add(rod((front - lens * 0.1, y, 0), (front + 0.02, y, 0), radius * 0.7), GLASS)
    top = height / 2
    a.add(box((depth * 0.7, a.uniform(0.3, 0.5), 0.2), (0, y, top + 0.08)), VIEWFINDER)
    a.add(rod((0, width * 0.35, top), (0, width * 0.35, top + 0.1), 0.09), BUTTON)
    a.add(box((0.04, width * 0.5, height * 0.5), (-depth / 2, 0, -0.05)), GLASS)


def lamp(a: Assembly) -> None:
    """Build a desk lamp: foot, an arm of two rods with a joint, shade and bulb."""
    ARM = 1
    JOINT = 2
    SHADE = 3
    BULB = 4

    a.add(cylinder(a.uniform(0.3, 0.5), a.uniform(0.2, 0.4), 0.1))
    knee = point(-a.uniform(0.1, 0.5), 0, a.uniform(0.5, 0.9))
    elbow = point(a.uniform(0.1, 0.6), 0, knee[2] + a.uniform(0.2, 0.6))
    a.add(rod((0, 0, 0.05), knee, 0.04), ARM)
    a.add(rod(knee, elbow, 0.04), ARM)
    a.add(ellipsoid(0.08, knee), JOINT)
    # The shade opens along the beam.
    beam = point(a.uniform(0.2, 0.7), 0, -a.uniform(0.1, 0.8))
    beam /= np.linalg.norm(beam)
    mouth = elbow + beam * a.uniform(0.35, 0.55)
    a.add(rod(elbow - beam * 0.1, mouth, 0.1, a.uniform(0.25, 0.4), 18), SHADE)
    a.add(ellipsoid(0.1, elbow + beam * 0.35), BULB)


def cart(a: Assembly) -> None:
    """Build a shopping cart, wider at its top, with a grip behind and four wheels."""
    END = 1  # the walls in front and behind
    METAL = 2
    RUBBER = 3

    length = a.uniform(0.9, 1.4)
    width = a.uniform(0.6, 0.9)
    height = a.uniform(0.3, 0.7)
    wheel = a.uniform(0.12, 0.3)
    floor = wheel + 0.1
    top = floor + height
    flare = a.uniform(0, 0.2)
    front = length / 2
    side = width / 2
    a.add(box((length, width, 0.06), (0, 0, floor)))
    panel = [[-front, floor], [front, floor], [front + flare, top], [-front - flare * 0.3, top]]
    a.add_pair(extrusion(panel, 0.05, "xz", side))
    for x in (-front, front + flare * 0.5):
        a.add(box((0.05, width, height), (x, 0, floor + height / 2)), END)
    grip = point(-front - a.uniform(0.2, 0.5), width * 0.45, top + a.uniform(0.1, 0.5))
    a.add_pair(rod((-front, width * 0.45, top), grip, 0.03), METAL)
    a.add(rod(grip, grip * [1, -1, 1], 0.04), RUBBER)
    # The front wheels are smaller.
    for x, radius in ((-length * 0.35, wheel), (length * 0.35, wheel * 0.8)):
        a.add_pair(disc(radius, 0.08, (x, side, radius)), RUBBER)
        a.add_pair(disc(radius * 0.5, 0.1, (x, side, radius)), METAL)


def rocket(a: Assembly) -> None:
    """Build a standing rocket with three fins, a porthole and a door in front."""
    RIM = 1
    FIN = 2
    DOOR = 3
    GLASS = 4

    height = a.uniform(1.4, 2.2)
    radius = a.uniform(0.25, 0.4)
    profile = [
        [0.001, 0],
        [radius * 0.7, 0],
        [radius, height * 0.3],
        [radius * 0.9, height * 0.65],
        [radius * 0.4, height * 0.9],
        [0.001, height],
    ]
    a.add(lathe(profile))
    porthole = (radius * 0.85, 0, height * 0.6)
    a.add(torus(radius * 0.45, 0.05, X, porthole), RIM)
    a.add(ellipsoid((0.06, radius * 0.4, radius * 0.4), porthole), GLASS)
    tip = radius + 0.4
    outline = [[radius * 0.7, height * 0.3], [tip, 0], [tip, -0.25], [radius * 0.6, 0.05]]
    for angle in (0.5, 2.6, 4.7):
        a.add(extrusion(outline, 0.06).rotated("z", angle), FIN)
    a.add(box((0.06, 0.25, 0.4), (radius, 0, height * 0.2)), DOOR)


def windmill(a: Assembly) -> None:
    """Build a windmill of eight walls with three to five vanes, door and window in front."""
    ROOF = 1
    AXLE = 2
    VANE = 3
    OPENING = 4  # door and window

    height = a.uniform(1.2, 1.8)
    radius = a.uniform(0.28, 0.42)
    vane = a.uniform(0.6, 0.95)
    a.add(rod((0, 0, 0), (0, 0, height), radius, radius * a.uniform(0.6, 0.8), 8))
    roof = cylinder(radius, 0.02, radius * 1.2, 8)
    a.add(roof.translated((0, 0, height + radius * 0.6)), ROOF)
    hub = point(radius + 0.12, 0, height * 0.92)
    a.add(rod((0, 0, height * 0.92), hub, 0.06), AXLE)
    n_vanes = 3 + a.choice(3)
    turn = a.uniform(0, TAU)
    outline = [[0.05, 0.02], [vane, 0.1 + a.uniform(0, 0.1)], [vane, -0.02], [0.05, -0.02]]
    upright = extrusion(outline, 0.04, "yz")
    for k in range(n_vanes):
        a.add(upright.rotated("x", turn + k * TAU / n_vanes).translated(hub), VANE)
    a.add(box((0.05, 0.2, 0.4), (radius, 0, 0.2)), OPENING)
    a.add(box((0.04, 0.14, 0.14), (radius * 0.95, 0.02, height * 0.5)), OPENING)


def shoe(a: Assembly) -> None:
    """Build a shoe or a boot with two to four laces, and mostly a heel."""
    UPPER = 1
    LACE = 2
    HEEL = 3

    length = a.uniform(1.3, 1.8)
    width = a.uniform(0.45, 0.6)
    ankle = a.uniform(0.4, 1.1)
    toe = length / 2
    # The left half of the sole's outline from the heel to the toe, and its mirror image.
    half = [
        [-toe, width * 0.35],
        [0, width * 0.36],
        [length * 0.3, width * 0.5],
        [toe, width * 0.15],
    ]
    outline = [[x, -y] for x, y in half] + half[::-1]
    a.add(extrusion(outline, a.uniform(0.08, 0.16), "xy", 0.05))
    upper = (length * 0.35, width * 0.42, a.uniform(0.2, 0.3))
    a.add(ellipsoid(upper, (length * 0.15, 0, 0.15)), UPPER)
    # The shaft is open at its top.
    inside = [[width * 0.3, ankle], [0.01, ankle - 0.05]]
    shaft = lathe([[width * 0.4, 0], [width * 0.36, ankle], *inside], 16).scaled((1.2, 1, 1))
    a.add(shaft.translated((-length * 0.26, 0, 0.1)), UPPER)
    for k in range(2 + a.choice(3)):
        a.add(box((0.05, width * 0.5, 0.04), (length * (0.08 * k), 0, 0.42 - 0.05 * k)), LACE)
    if a.chance(0.6):
        a.add(box((0.25, width * 0.6, a.uniform(0.1, 0.3)), (-length * 0.36, 0, -0.08)), HEEL)


TRAINING = by_name(quadruped, fish, teapot, guitar, camera, lamp, cart, rocket, windmill, shoe)
