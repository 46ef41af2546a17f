"""The categories for choices and calibration; none is trained on, none is evaluated.

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


def _wheel(
    a: Assembly, x: float, y: float, radius: float, width: float, mirror: bool = True
) -> None:
    """Add a wheel that stands on the ground, with its axis along y."""
    TYRE = 3
    HUB = 4

    a.add(disc(radius, width, (x, y, radius)), TYRE, mirror)
    a.add(disc(radius * 0.5, width * 1.2, (x, y, radius)), HUB, mirror)


def helicopter(a: Assembly) -> None:
    """Build a helicopter of two to four rotor blades, on skids or on wheels."""
    FIN = 1
    ROTOR = 2
    METAL = 3  # tail rotor and skids
    GLASS = 4

    length = a.uniform(0.6, 0.9)
    radius = a.uniform(0.35, 0.5)
    z = a.uniform(0.6, 0.8)
    a.add(ellipsoid((length, radius, radius * a.uniform(0.9, 1.2)), (0, 0, z)))
    cockpit = (length * 0.5, radius * 0.85, radius * 0.7)
    a.add(ellipsoid(cockpit, (length * 0.55, 0, z + 0.05)), GLASS)
    tail = point(-length - a.uniform(0.6, 1.0), 0, z + a.uniform(0.1, 0.3))
    a.add(rod((-length * 0.7, 0, z + 0.05), tail, radius * 0.4, 0.07))
    a.add(extrusion([[0.1, 0], [-0.12, 0], [-0.25, 0.4], [-0.1, 0.4]], 0.05).translated(tail), FIN)
    # The main rotor on its mast, and the tail rotor.
    n_blades = 2 + a.choice(3)
    phase = a.uniform(0, 3)
    reach = a.uniform(0.9, 1.3)
    top = z + radius * 1.2 + 0.2
    a.add(rod((0, 0, z), (0, 0, top), 0.05), ROTOR)
    blade = box((reach, 0.11, 0.03), (reach / 2, 0, top))
    for k in range(n_blades):
        a.add(blade.rotated("z", phase + TAU * k / n_blades), ROTOR)
    a.add(torus(0.2, 0.025, Y, tail + [0, 0.08, 0.05]), METAL)
    if a.chance(0.7):
        skid_y = radius * 0.8
        a.add_pair(rod((-length * 0.6, skid_y, 0.05), (length * 0.9, skid_y, 0.05), 0.035), METAL)
        for x in (-0.3 * length, 0.35 * length):
            strut_top = (x, radius * 0.4, z - radius * 0.7)
            a.add_pair(rod(strut_top, (x, skid_y, 0.05), 0.03), METAL)
    else:
        _wheel(a, length * 0.4, radius * 0.7, 0.14, 0.1)
        _wheel(a, -length * 0.6, 0, 0.1, 0.1, mirror=False)


def wheelbarrow(a: Assembly) -> None:
    """Build a wheelbarrow: tray, one wheel in front, two handles and legs behind."""
    FRAME = 1
    GRIP = 2

    length = a.uniform(0.9, 1.2)
    width = a.uniform(0.55, 0.8)
    wheel = a.uniform(0.2, 0.32)
    z = wheel + a.uniform(0.15, 0.3)
    depth = a.uniform(0.25, 0.45)
    # The tray: two side walls, the bottom, and a rounded front.
    rear = -length / 2
    wall = [
        [rear, z + depth],
        [-length * 0.3, z],
        [length * 0.25, z],
        [length * a.uniform(0.55, 0.75), z + depth],
    ]
    a.add_pair(extrusion(wall, 0.05).translated((0, width / 2, 0)))
    a.add(box((length * 0.6, width, 0.05), (0, 0, z)))
    front = length * 0.6
    nose = (front, 0, z + depth * 0.9)
    a.add(rod((length * 0.3, 0, z + 0.02), nose, width * 0.45, width * 0.5))
    grip = point(rear - a.uniform(0.4, 0.7), width * 0.4, z + a.uniform(0.1, 0.4))
    a.add_pair(rod((front, width * 0.15, wheel), grip, 0.04), FRAME)
    a.add_pair(capsule(grip, grip + [-0.15, 0, 0.02], 0.06), GRIP)
    foot = (-length * 0.35, width * 0.4, 0)
    a.add_pair(rod((-length * 0.2, width * 0.35, z), foot, 0.035), FRAME)
    _wheel(a, length * 0.65, 0, wheel, a.uniform(0.08, 0.16), mirror=False)


def watering_can(a: Assembly) -> None:
    """Build a watering can: spout with a rose in front, handle behind, sometimes a band."""
    ROSE = 1
    HANDLE = 2
    BAND = 3

    radius = a.uniform(0.4, 0.55)
    height = a.uniform(0.6, 1.0)
    rim = (radius * a.uniform(0.75, 1), height)
    # The radius 0 would give triangles without an area.
    a.add(lathe([(0.001, 0), (radius, 0), rim, (0.001, height * 0.97)]))
    spout = (radius * 0.8, 0, height * 0.2)
    tip = point(radius + a.uniform(0.5, 0.9), 0, height * a.uniform(0.95, 1.3))
    a.add(rod(spout, tip, 0.09, 0.05))
    along = tip - spout
    rose = tip + 0.2 * along / np.linalg.norm(along)
    a.add(rod(tip, rose, 0.05, a.uniform(0.12, 0.2)), ROSE)
    # A brace from the rim to the spout, and the handle, a little more than half a ring.
    a.add(rod((radius * 0.7, 0, height), tip * [0.8, 1, 1] - [0, 0, 0.15], 0.025), HANDLE)
    place = (-radius * 0.85, 0, height * 0.55)
    ring = height * a.uniform(0.3, 0.4)
    a.add(torus(ring, 0.05, Y, place, np.pi * 0.95, np.pi * 2.05), HANDLE)
    if a.chance(0.5):
        band = cylinder(radius * 1.05, radius * 1.05, 0.08, 20)
        a.add(band.translated((0, 0, height * a.uniform(0.3, 0.7))), BAND)


def vacuum_cleaner(a: Assembly) -> None:
    """Build a vacuum cleaner on two wheels, with hose, wand and nozzle in front."""
    LID = 1
    PLASTIC = 2  # switch and nozzle
    HOSE = 3
    HANDLE = 4

    length = a.uniform(0.5, 0.75)
    radius = a.uniform(0.28, 0.4)
    front = length * 0.6
    nose = radius * a.uniform(0.7, 0.95)
    a.add(capsule((-length, 0, radius + 0.08), (front, 0, radius + 0.05), radius, nose))
    top = 2 * radius
    a.add(box((length * 0.8, radius * 1.1, 0.12), (-length * 0.4, 0, top + 0.05)), LID)
    a.add(cylinder(0.12, 0.12, 0.1).translated((length * 0.1, 0, top + 0.08)), PLASTIC)
    _wheel(a, -length * 0.9, radius * 0.95, a.uniform(0.2, 0.32), 0.1)
    elbow = point(front + radius + 0.3, 0, radius + a.uniform(0.3, 0.6))
    a.add(rod((front, 0, radius), elbow, 0.07), HOSE)
    nozzle = point(elbow[0] + a.uniform(0.2, 0.5), a.uniform(-0.1, 0.1), 0.08)
    a.add(rod(elbow, nozzle, 0.06), HOSE)
    a.add(box((0.22, a.uniform(0.5, 0.8), 0.1), nozzle), PLASTIC)
    if a.chance(0.5):
        place = (-length * 0.2, 0, top + 0.1)
        a.add(torus(0.16, 0.035, Y, place, -TAU / 4, TAU / 4), HANDLE)


def drill(a: Assembly) -> None:
    """Build a cordless drill: motor, chuck and bit; grip, battery; sometimes a side handle."""
    CHUCK = 1
    DARK = 2  # battery, trigger and side handle
    BIT = 3
    RING = 4

    length = a.uniform(0.8, 1.1)
    radius = a.uniform(0.2, 0.28)
    z = a.uniform(0.8, 1.0)
    front = (length * 0.35, 0, z)
    tip = (length * 0.6, 0, z)
    a.add(rod((-length * 0.45, 0, z), front, radius, radius * a.uniform(0.8, 1)))
    a.add(rod(front, tip, radius * 0.7, radius * 0.45), CHUCK)
    a.add(rod(tip, tip + point(a.uniform(0.3, 0.7), 0, 0), 0.05, 0.02), BIT)
    # The grip leans; the battery is at its foot.
    lean = a.uniform(-0.25, 0.05)
    grip_x = -length * 0.15
    a.add(capsule((grip_x, 0, z), (grip_x + lean, 0, 0.2), 0.16, 0.14))
    battery = (a.uniform(0.35, 0.5), 0.3, a.uniform(0.15, 0.25))
    a.add(box(battery, (-length * 0.12 + lean, 0, 0.1)), DARK)
    a.add(box((0.1, 0.1, 0.18), (length * 0.03, 0, z - radius - 0.08)), DARK)
    for x in (-0.35, -0.22):
        a.add(torus(radius, 0.025, X, (x * length, 0, z)), RING)
    if a.chance(0.4):
        side = length * 0.25
        a.add(rod((side, 0, z), (side, a.uniform(0.4, 0.6), z), 0.07), DARK)


def dinosaur(a: Assembly) -> None:
    """Build a dinosaur on four legs or upright, with five spikes along its back."""
    LIMB = 1  # and snout
    SPIKE = 2
    EYE = 3

    length = a.uniform(0.5, 0.8)
    radius = a.uniform(0.28, 0.4)
    leg = a.uniform(0.4, 0.7)
    z = leg + radius * 0.5
    hip = point(-length * 0.4, 0, z)
    chest = point(length * 0.5, 0, z + a.uniform(0, 0.3))
    a.add(capsule(hip, chest, radius, radius * 0.75))
    # The tail, in two parts; then the neck, the snout and the eyes.
    bend = hip - [a.uniform(0.5, 0.8), 0, a.uniform(-0.1, 0.2)]
    a.add(rod(hip, bend, radius * 0.8, radius * 0.4))
    tail = bend - [a.uniform(0.4, 0.7), 0, a.uniform(-0.2, 0.25)]
    a.add(rod(bend, tail, radius * 0.4, 0.03))
    head = chest + [a.uniform(0.3, 0.6), 0, a.uniform(0.2, 0.7)]
    a.add(rod(chest, head, radius * 0.6, radius * 0.35))
    nose = head + [a.uniform(0.2, 0.4), 0, -0.05]
    a.add(capsule(head, nose, radius * 0.45, radius * 0.28), LIMB)
    a.add_pair(ellipsoid((0.05, 0.04, 0.05), head + [0.06, radius * 0.4, 0.08]), EYE)
    # The hind legs; then the forelegs, which an upright dinosaur stretches forwards.
    foot = (hip[0] + 0.05, radius * 0.9, 0.08)
    a.add_pair(capsule(hip + [0, radius * 0.7, 0], foot, 0.17, 0.1), LIMB)
    paw = point(chest[0], radius * 0.8, 0.08)
    if a.chance(0.5):
        paw = chest + [0.3, radius * 0.5, -0.3]
    a.add_pair(capsule(chest + [0, radius * 0.5, -0.05], paw, 0.1, 0.06), LIMB)
    back = z + radius * 0.6
    for k in range(5):
        x = hip[0] - 0.3 + 0.25 * k
        spike = (x - 0.05, z + radius + a.uniform(0.15, 0.35))
        a.add(extrusion([(x - 0.1, back), (x + 0.1, back), spike], 0.05), SPIKE)


def mailbox(a: Assembly) -> None:
    """Build a mailbox on a post, with a round top, a door in front and a flag on the left."""
    DOOR = 1
    POST = 2
    METAL = 3  # knob and pole of the flag
    FLAG = 4

    length = a.uniform(0.8, 1.2)
    radius = a.uniform(0.25, 0.38)
    height = a.uniform(0.7, 1.1)
    front = length / 2
    axis = height + radius  # of the round top
    a.add(box((length, 2 * radius, radius), (0, 0, height + radius / 2)))
    a.add(rod((-front, 0, axis), (front, 0, axis), radius, sides=18))
    a.add(box((0.04, radius * 1.6, radius * 1.3), (front + 0.02, 0, height + radius * 0.8)), DOOR)
    a.add(box((0.08, 0.12, 0.06), (front + 0.06, 0, height + radius * 1.4)), METAL)
    a.add(rod((0, 0, 0), (a.uniform(-0.1, 0.1), 0, height), a.uniform(0.06, 0.1)), POST)
    a.add(cylinder(a.uniform(0.2, 0.4), 0.15, 0.1).translated((0, 0, 0.05)), POST)
    flag = a.uniform(-0.1, 0.3) * length
    top = (flag, radius + 0.05, height + 2 * radius + 0.2)
    a.add(rod((flag, radius, axis), top, 0.025), METAL)
    a.add(box((0.22, 0.03, 0.16), top - point(0.1, 0, 0)), FLAG)


def excavator(a: Assembly) -> None:
    """Build an excavator on tracks: cabin on one side, boom with a bucket on the other."""
    COUNTERWEIGHT = 1
    BUCKET = 2
    DARK = 3  # tracks and exhaust
    CABIN = 4

    length = a.uniform(0.9, 1.2)
    width = a.uniform(0.6, 0.8)
    front = length / 2
    side = width / 2
    a.add_pair(capsule((-front, side, 0.16), (front, side, 0.16), 0.16), DARK)
    a.add(box((length * 0.9, width * 0.9, a.uniform(0.25, 0.4)), (-0.08, 0, 0.5)))
    cabin_y = a.uniform(0.1, 0.2) * (1 if a.chance(0.5) else -1)
    boom_y = -cabin_y * 0.6
    a.add(box((0.4, width * 0.45, a.uniform(0.4, 0.55)), (length * 0.15, cabin_y, 0.9)), CABIN)
    a.add(box((0.3, width * 0.8, 0.25), (-length * 0.42, 0, 0.75)), COUNTERWEIGHT)
    elbow = (length * 0.45 + a.uniform(0.3, 0.6), boom_y, a.uniform(1.1, 1.5))
    wrist = (elbow[0] + a.uniform(0.3, 0.6), boom_y, a.uniform(0.5, 0.9))
    a.add(rod((length * 0.35, boom_y, 0.6), elbow, 0.1, 0.08))
    a.add(rod(elbow, wrist, 0.08, 0.06))
    outline = [[0.12, 0.05], [-0.15, -0.05], [-0.22, -0.35], [0.02, -0.4]]
    a.add(extrusion(outline, width * a.uniform(0.35, 0.55)).translated(wrist), BUCKET)
    exhaust = (-length * 0.3, width * 0.25, 0.8)
    a.add(rod(exhaust, exhaust + point(0, 0, 0.3), 0.05), DARK)


def bed(a: Assembly) -> None:
    """Build a single or double bed: mattress between two boards, pillows at the head, blanket."""
    FRAME = 1
    PILLOW = 2
    BLANKET = 3

    double = a.chance(0.5)
    length = a.uniform(1.9, 2.3)
    width = a.uniform(1.35, 1.8) if double else a.uniform(0.85, 1.2)
    z = a.uniform(0.3, 0.5)
    a.add(box((length, width, a.uniform(0.15, 0.3)), (0, 0, z)))
    # The boards at the head (in front) and at the foot, each between two posts.
    head = length / 2
    for x, height in ((head, a.uniform(0.65, 1.1)), (-head, a.uniform(0.35, 0.65))):
        a.add(box((0.08, width, height), (x, 0, height / 2 + 0.08)), FRAME)
        a.add_pair(rod((x, width / 2, 0), (x, width / 2, height + 0.12), 0.05), FRAME)
    top = z + 0.17
    pillow_x = length * 0.37
    if double:
        a.add_pair(ellipsoid((0.2, width * 0.2, 0.1), (pillow_x, width * 0.24, top)), PILLOW)
    else:
        a.add(ellipsoid((0.2, width * 0.36, 0.1), (pillow_x, 0, top)), PILLOW)
    blanket = (length * a.uniform(0.4, 0.65), width * 1.03, 0.12)
    a.add(box(blanket, (-length * 0.15, 0, top - 0.05)), BLANKET)


def bathtub(a: Assembly) -> None:
    """Build a full bathtub on four feet, with a tap and two handles at its rear end."""
    WATER = 1
    METAL = 2

    length = a.uniform(1.6, 2.0)
    width = a.uniform(0.75, 0.95)
    height = a.uniform(0.5, 0.65)
    end = length / 2
    rear = a.uniform(0.55, 0.7) * end
    front = a.uniform(0.44, 0.56) * end
    a.add(extrusion([[-rear, 0], [front, 0], [end, height], [-end, height]], width))
    a.add(box((length * 0.88, width * 0.8, 0.03), (0, 0, height + 0.01)), WATER)
    for x in (-rear, front):
        a.add_pair(ellipsoid((0.07, 0.07, 0.1), (x * 0.85, width * 0.38, -0.03)), METAL)
    tap = point(-end + 0.06, 0, height)
    rise = a.uniform(0.12, 0.3)
    bend = tap + [0, 0, rise]
    a.add(rod(tap, bend, 0.035), METAL)
    a.add(rod(bend, tap + [a.uniform(0.1, 0.25), 0, rise - 0.03], 0.03), METAL)
    a.add_pair(ellipsoid((0.04, 0.04, 0.06), tap + [0, 0.13, 0.05]), METAL)


def skateboard(a: Assembly) -> None:
    """Build a skateboard whose ends are raised, the front end higher, with a strip of grip tape."""
    TRUCK = 1  # the axle and its mount
    WHEEL = 2
    GRIP = 3

    length = a.uniform(1.6, 2.2)
    width = a.uniform(0.4, 0.55)
    z = 0.25
    a.add(box((length * 0.66, width, 0.05), (0, 0, z)))
    front = (length * a.uniform(0.2, 0.3), a.uniform(0.35, 0.6))
    rear = (length * a.uniform(0.14, 0.22), a.uniform(0.15, 0.35))
    for sign, (reach, rise) in ((1, front), (-1, rear)):
        end = box((reach, width * 0.92, 0.05), (reach / 2 - 0.01, 0, 0)).rotated("y", -rise)
        if sign < 0:
            end = end.rotated("z", TAU / 2)
        a.add(end.translated((sign * length * 0.33, 0, z)))
    for x in (-0.24 * length, 0.26 * length):
        a.add_pair(disc(0.09, 0.1, (x, width * 0.42, 0.09)), WHEEL)
        a.add(rod((x, -width * 0.4, 0.1), (x, width * 0.4, 0.1), 0.04), TRUCK)
        a.add(box((0.2, 0.15, 0.12), (x, 0, 0.18)), TRUCK)
    tape = (length * 0.25, width * 0.98, 0.02)
    a.add(box(tape, (length * a.uniform(0.05, 0.15), 0, z + 0.03)), GRIP)


def tram(a: Assembly) -> None:
    """Build a tram with a sloping windscreen, four side windows, and a current collector."""
    DARK = 3  # wheels and collector
    GLASS = 4
    HEADLAMP = 5
    REAR_LIGHT = 6

    length = a.uniform(2.4, 3.2)
    width = a.uniform(0.7, 0.9)
    height = a.uniform(0.7, 0.9)
    nose = length / 2
    floor = 0.15
    rake = a.uniform(0.1, 0.3)
    belt = floor + height * 0.45
    roof = floor + height
    front = [[nose, floor], [nose, belt], [nose - rake, roof]]
    a.add(extrusion([*front, [-nose, roof], [-nose, floor]], width))
    # The windscreen leans with the front; the windows are at its height.
    window_z = (belt + roof) / 2
    screen = box((0.03, width * 0.8, height * 0.36)).rotated("y", -np.arctan(rake / (roof - belt)))
    a.add(screen.translated((nose - rake / 2 + 0.01, 0, window_z)), GLASS)
    a.add(box((0.03, width * 0.5, height * 0.3), (-nose, 0, window_z)), GLASS)
    for k in range(4):
        place = ((k - 1.6) * length * 0.2, width / 2, window_z)
        a.add_pair(box((length * 0.15, 0.03, height * 0.3), place), GLASS)
    a.add_pair(ellipsoid((0.04, 0.07, 0.06), (nose, width * 0.32, floor + 0.17)), HEADLAMP)
    a.add_pair(box((0.04, 0.1, 0.08), (-nose, width * 0.35, floor + 0.2)), REAR_LIGHT)
    for x in (-0.32, 0.32):
        a.add(box((length * 0.2, width * 0.8, 0.2), (x * length, 0, 0.1)), DARK)
    collector = point(length * a.uniform(-0.05, 0.1), 0, roof + a.uniform(0.25, 0.4))
    foot = (collector[0] - length * a.uniform(0.1, 0.18), 0, roof)
    a.add(rod(foot, collector, 0.03), DARK)
    a.add(box((0.05, width * 0.7, 0.03), collector), DARK)


VALIDATION = by_name(
    helicopter,
    wheelbarrow,
    watering_can,
    vacuum_cleaner,
    drill,
    dinosaur,
    mailbox,
    excavator,
    # Long bodies whose ends differ only in details measure errors of half a turn.
    bed,
    bathtub,
    skateboard,
    tram,
)
