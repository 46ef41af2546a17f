"""Bags, books, and what lies on a desk (front +x, left +y, up +z).

The constants at the head of a builder name its materials, 0 to 7: parts of one material look alike.
Other numbers are lengths or shares of lengths, chosen by hand; the unit is arbitrary, since
`make_shape` scales each object. The third argument of `rounded_box` is its squareness. The second
of `lathe` and the fourth of `cylinder` are numbers of sides.
"""

import numpy as np

from zsp_lite.course.synthetic.assembly import BODY, Draw, Parts, X, Y, pair, rounded_box, tapered
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
    torus,
)

# The materials of the keys of laptops and keyboards. Edge keys look like a laptop's touchpad.
_KEY = 1
_EDGE_KEY = 2
_SPACE_BAR = 3

_ARCH = (TAU / 4, TAU * 3 / 4)  # angles of the upper half of a torus about x


def backpack(draw: Draw) -> Parts:
    """Build a backpack: pockets, a flap or an upper pocket, a handle on top, straps behind."""
    POCKET = 1
    FLAP = 2  # and the smaller pockets
    BELT = 3  # and handle
    STRAP = 4

    depth = draw(0.42, 0.62)
    width = draw(0.7, 1.0)
    height = draw(1.1, 1.5)
    front = depth / 2
    back = -front
    middle = height / 2  # from here on, the width narrows
    narrowing = draw(0.7, 1.0)
    body = rounded_box((depth, width, height), (0, 0, middle), draw(3.5, 6))
    yield tapered(body, middle, height, narrowing), BODY
    pocket_depth = depth * draw(0.45, 0.7)
    pocket_height = height * draw(0.35, 0.5)
    pocket_z = height * draw(0.06, 0.12) + pocket_height / 2
    pocket = (pocket_depth, width * draw(0.65, 0.85), pocket_height)
    yield rounded_box(pocket, (front, 0, pocket_z), 4), POCKET
    if draw.chance(0.4):
        # A flap with two belts.
        flap_size = (depth * 1.15, width * 1.02, height * 0.3)
        flap = rounded_box(flap_size, (depth * 0.08, 0, height * 0.92), 4)
        yield tapered(flap, middle, height, narrowing), FLAP
        belt = box((0.04, 0.1, height * 0.38), (depth * 0.6, width * 0.2, height * 0.66))
        yield from pair(belt, BELT)
    else:
        upper_pocket = (depth * 0.4, width * 0.6, height * draw(0.18, 0.26))
        yield rounded_box(upper_pocket, (depth * 0.38, 0, height * 0.74), 4), FLAP
    # The handle, an arch across; then the straps, which bulge at the back.
    handle = torus(draw(0.08, 0.13), 0.03, X, (back * 0.6, 0, height), *_ARCH, sides=12)
    yield handle, BELT
    strap_y = width * draw(0.22, 0.3)
    bulge = draw(0.12, 0.22)
    bend = (back - bulge, strap_y, height * 0.7)
    yield from pair(capsule((back + 0.02, strap_y * 0.8, height * 0.93), bend, 0.05), STRAP)
    yield from pair(capsule(bend, (back + 0.02, strap_y * 1.35, height * 0.12), 0.05), STRAP)
    if draw.chance(0.6):
        bottle_pocket = lathe([[0.12, 0], [0.15, 0.35], [0.14, 0.35], [ON_AXIS, 0.3]], 14)
        yield from pair(bottle_pocket.translated((0, width / 2, height * 0.08)), FLAP)


def handbag(draw: Draw) -> Parts:
    """Build a tote, flap bag or bowling bag: clasp or pocket, one or two handles, a tag."""
    FRONT = 1  # flap or pocket
    HANDLE = 2
    CLASP = 3
    TAG = 5  # 4 is free

    depth = draw(0.3, 0.5)
    width = draw(1.0, 1.5)
    height = draw(0.7, 1.1)
    style = draw.pick("tote", "flap bag", "bowling bag")
    if style == "tote":
        narrowing = draw(1.0, 1.2)
        squareness = 8
    else:
        narrowing = draw(0.65, 0.95)
        squareness = draw(3, 5)
    body = rounded_box((depth, width, height), (0, 0, height / 2), squareness)
    yield tapered(body, 0, height, narrowing), BODY
    front = depth / 2
    top_width = width * narrowing
    if style == "flap bag":
        drop = height * draw(0.45, 0.65)
        yield rounded_box((0.06, top_width, drop), (front + 0.02, 0, height - drop / 2), 6), FRONT
        clasp = cylinder(0.07, 0.07, 0.06).rotated("y", TAU / 4)
        yield clasp.translated((front + 0.07, 0, height - drop + 0.08)), CLASP
    else:
        pocket_width = width * draw(0.45, 0.7)
        pocket_height = height * draw(0.35, 0.5)
        yield rounded_box((0.1, pocket_width, pocket_height), (front, 0, height * 0.35), 4), FRONT
        yield box((0.04, 0.1, 0.14), (front + 0.03, 0, height * 0.82)), CLASP
    loop = top_width * draw(0.2, 0.3)
    strap = draw(0.025, 0.045)
    handle = torus(loop, strap, X, (0, 0, 0), *_ARCH, sides=20).scaled((1, 1, draw(0.9, 1.6)))
    # One handle in the middle, or two.
    places = (0.0,) if draw.chance(0.35) else (front * 0.7, -front * 0.7)
    for x in places:
        yield handle.translated((x, 0, height * 0.95)), HANDLE
    yield box((0.03, 0.12, 0.25), (front + 0.05, -loop * 1.1, height * 0.7)), TAG


def book(draw: Draw) -> Parts:
    """Build a book, closed or slightly open: spine on the left, a title, a picture or a band."""
    COVER = 0
    PAPER = 1
    SPINE = 2
    TITLE = 3
    PICTURE = 4

    # The top of the page points backwards (-x); the reader is at the front.
    height = draw(1.3, 1.7)
    width = draw(0.9, 1.25)
    thick = draw(0.12, 0.4)
    board = draw(0.025, 0.05)  # thickness of a cover
    spine_y = width / 2
    # The pages, the lower cover, and a round or flat spine.
    yield box((height * 0.96, width * 0.95, thick), (0, -width * 0.01, thick / 2)), PAPER
    yield box((height, width, board)), COVER
    if draw.chance(0.5):
        # The outline (y, z) of a round spine is half an ellipse.
        angle = np.linspace(0, np.pi, 9)
        y = spine_y + 0.1 * np.sin(angle)
        z = thick / 2 + (thick + board) / 2 * np.cos(angle)
        yield extrusion(np.stack([y, z], 1), height, "yz"), SPINE
    else:
        yield box((height, board, thick + board), (0, spine_y, thick / 2)), SPINE
    lift = draw(0.15, 0.7) if draw.chance(0.4) else 0.0

    def on_cover(mesh: Mesh) -> Mesh:
        # The cover rotates about the upper edge of the spine.
        lifted = mesh.translated((0, -spine_y, 0)).rotated("x", -lift)
        return lifted.translated((0, spine_y, thick))

    yield on_cover(box((height, width, board))), COVER
    outside = board / 2
    title_x = -height * draw(0.2, 0.32)
    for line in range(1 + draw.choice(3)):
        title = (0.08, width * draw(0.35, 0.7), 0.02)
        yield on_cover(box(title, (title_x + 0.13 * line, 0, outside))), TITLE
    if draw.chance(0.6):
        picture = (height * draw(0.25, 0.4), width * draw(0.5, 0.8), 0.015)
        yield on_cover(box(picture, (height * 0.15, 0, outside))), PICTURE
    else:
        band = (height, width * draw(0.08, 0.2), 0.015)
        yield on_cover(box(band, (0, width * 0.32, outside))), PICTURE


def laptop(draw: Draw) -> Parts:
    """Build a laptop, opened by 80 to 130 degrees, with its user at the front."""
    TOUCHPAD = 2  # and the keys at the edges
    SCREEN = 4
    KEY_FIELD = 5
    SIGN = 6

    depth = draw(0.8, 1.1)
    width = draw(1.2, 1.6)
    thick = draw(0.05, 0.1)
    yield rounded_box((depth, width, thick), (0, 0, thick / 2), 12), BODY
    # The keys in a field of their own, whose front edge is at x = front; the touchpad before them.
    n_rows = 4 + draw.choice(2)
    n_keys = 10 + draw.choice(4)
    field = depth * draw(0.4, 0.5)
    front = depth * draw(0.08, 0.14)
    yield box((field * 1.06, width * 0.88, 0.01), (front - field / 2, 0, thick)), KEY_FIELD
    cell = (field / n_rows, width * 0.85 / n_keys)
    yield from _keys(n_rows, n_keys, (front, width * 0.425), cell, thick)
    touchpad = (depth * 0.24, width * draw(0.22, 0.36), 0.015)
    yield box(touchpad, (depth * 0.31, draw(-0.08, 0.04), thick)), TOUCHPAD
    # The lid with its screen, and a sign on its back.
    hinge = (-depth / 2 + 0.03, 0, thick + 0.02)
    opening = draw(np.radians(80), np.radians(130))
    lid = depth * draw(0.9, 1.02)
    rim = draw(0.04, 0.09)

    def on_lid(mesh: Mesh) -> Mesh:
        # Parts are those of a closed lid: the screen faces down, the hinge is at x = 0.
        return mesh.rotated("y", -opening).translated(hinge)

    middle = lid / 2
    back = thick * 0.6  # of the closed lid, whose screen is at z = 0
    yield on_lid(rounded_box((lid, width, back), (middle, 0, thick * 0.3), 12)), BODY
    yield on_lid(box((lid - 2 * rim, width - 2 * rim, 0.02), (middle + 0.01, 0, 0))), SCREEN
    sign = cylinder(draw(0.06, 0.12), 0.06, 0.02, 16)
    yield on_lid(sign.translated((middle, 0, back))), SIGN


def _keys(
    n_rows: int,
    n_keys: int,
    corner: tuple[float, float],
    cell: tuple[float, float],
    z: float,
) -> Parts:
    """Build keys at height z in cells of (depth, width), from the front left corner (x, y) on."""
    front, left = corner
    depth, width = cell
    for row in range(n_rows):
        for key in range(n_keys):
            # The space bar replaces all but seven keys of the front row, three on its left.
            if row > 0 or not 3 <= key < n_keys - 4:
                place = (front - (row + 0.5) * depth, left - (key + 0.5) * width, z)
                material = _EDGE_KEY if key in (0, n_keys - 1) else _KEY
                yield box((depth * 0.78, width * 0.8, 0.1), place), material
    bar = (n_keys - 7) * width
    place = (front - depth / 2, left - 3 * width - bar / 2, z)
    yield box((depth * 0.78, bar * 0.97, 0.1), place), _SPACE_BAR


def mouse(draw: Draw) -> Parts:
    """Build a computer mouse: two buttons, wheel, optional thumb rest on the left, and cable."""
    BUTTON = 1
    WHEEL = 2
    BASE = 3
    THUMB_REST = 4
    CABLE = 5

    length = draw(1.1, 1.5)
    width = draw(0.65, 0.9)
    height = draw(0.32, 0.55)
    shell = rounded_box((length, width, 2 * height), squareness=draw(2.2, 3.5))
    # Only the upper half of the shell remains, lower at the front and higher at the back. The
    # height is unchanged at x = -0.1 length.
    vertices = shell.vertices.copy()
    slope = 1 - draw(0.1, 0.4) * (vertices[:, 0] / length + 0.1)
    vertices[:, 2] = np.maximum(vertices[:, 2], 0) * slope
    yield Mesh(vertices, shell.faces), BODY
    yield shell.scaled((1.03, 1.03, 0.06)), BASE
    # A button is the front quarter of the shell, slightly raised.
    button = vertices * [1.02, 1.0, 1.06] + [0, 0, 0.015]
    button[:, 0] = np.maximum(button[:, 0], length * draw(0.02, 0.12))
    button[:, 1] = np.maximum(button[:, 1], 0.025)  # half the gap between the buttons
    yield from pair(Mesh(button, shell.faces), BUTTON)
    wheel = (length * draw(0.25, 0.33), 0, height * 0.78)
    yield torus(0.09, 0.045, Y, wheel, sides=16), WHEEL
    if draw.chance(0.5):
        rest = (length * 0.5, 0.12, height * 0.3)
        yield rounded_box(rest, (0.05, width * 0.46, height * 0.55), 4), THUMB_REST
    if draw.chance(0.6):
        cable_end = (length / 2 + draw(0.2, 0.5), draw(-0.3, 0.3), 0.05)
        yield capsule((length * 0.46, 0, height * 0.25), cable_end, 0.04, 0.03), CABLE


def keyboard(draw: Draw) -> Parts:
    """Build a keyboard: keys, optional number pad on the right, palm rest and cable."""
    PALM_REST = 4
    CABLE = 6

    depth = draw(0.55, 0.8)
    width = draw(1.6, 2.2)
    thick = draw(0.08, 0.16)
    tilt = draw(0.03, 0.16)
    has_pad = draw.chance(0.6)

    def tilted(mesh: Mesh) -> Mesh:
        # The front edge stays on the desk.
        height = thick / 2 + depth / 2 * np.sin(tilt)
        return mesh.rotated("y", tilt).translated((0, 0, height))

    yield tilted(rounded_box((depth, width, thick), squareness=draw(8, 14))), BODY
    n_rows = 5 + draw.choice(2)
    n_keys = 11 + draw.choice(4)
    field = width * (0.68 if has_pad else 0.92)
    row_depth = depth * 0.86 / n_rows
    front = depth * 0.43
    top = thick / 2
    cell = (row_depth, field / n_keys)
    for mesh, material in _keys(n_rows, n_keys, (front, width * 0.46), cell, top):
        yield tilted(mesh), material
    if has_pad:
        pad_key = box((row_depth * 0.78, width * 0.04, 0.1))
        for row in range(n_rows - 1):
            # From left to right; -y is to the right.
            for key, material in enumerate((_KEY, _KEY, _KEY, _EDGE_KEY)):
                place = (front - (row + 0.5) * row_depth, -width * (0.275 + 0.05 * key), top)
                yield tilted(pad_key.translated(place)), material
    if draw.chance(0.4):
        rest = (draw(0.2, 0.35), width * 0.94, thick * 0.7)
        yield tilted(rounded_box(rest, (depth / 2 + 0.12, 0, -0.01))), PALM_REST
    if draw.chance(0.6):
        y = draw(-0.3, 0.3) * width
        cable_end = (-depth / 2 - draw(0.1, 0.25), y + draw(-0.1, 0.1), 0.05)
        yield capsule((-depth * 0.47, y, thick), cable_end, 0.03), CABLE


def remote(draw: Draw) -> Parts:
    """Build a remote control: emitter and power key in front, a ring, number keys behind."""
    KEY = 1
    COLOURED_KEY = 2
    BUTTON = 3  # round
    RING = 4
    EMITTER = 5

    length = draw(1.4, 2.0)
    width = draw(0.38, 0.58)
    thick = draw(0.14, 0.26)
    front = length / 2
    top = thick + 0.005
    # The body is built upright, front end on top, and laid down. From its middle down to its foot,
    # it narrows: the heights of `tapered` are in reverse.
    upright = rounded_box((thick, width, length), (0, 0, length / 2), draw(4, 9))
    narrowing = draw(0.8, 1.0)
    body = tapered(upright, length / 2, 0, narrowing).rotated("y", TAU / 4)
    yield body.translated((-front, 0, thick / 2)), BODY
    emitter = (0.06, width * 0.2, thick * 0.3)
    yield ellipsoid(emitter, (front - 0.02, 0, thick * 0.55)), EMITTER
    power_key = (length * 0.41, width * draw(0.15, 0.28), top)
    yield cylinder(0.055, 0.05, 0.06).translated(power_key), BUTTON
    # A ring, or four keys in its place, around a button.
    ring_x = length * draw(0.08, 0.22)
    ring = width * draw(0.26, 0.34)
    if draw.chance(0.7):
        yield torus(ring, 0.035, centre=(ring_x, 0, top)), RING
    else:
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            yield box((0.09, 0.09, 0.06), (ring_x + ring * x, ring * y, top)), RING
    yield cylinder(ring * 0.45, ring * 0.4, 0.06).translated((ring_x, 0, top)), BUTTON
    # Rows of three keys, closer together if the body narrows; the keys of the last row and two
    # before the ring have another colour.
    n_rows = 3 + draw.choice(3)
    pitch = width * 0.27
    key = cylinder(0.045, 0.04, 0.05) if draw.chance(0.5) else box((0.07, pitch * 0.7, 0.05))
    for row in range(n_rows):
        for column in (-1, 0, 1):
            place = (ring_x - ring - 0.12 - row * length * 0.085, column * pitch * narrowing, top)
            yield key.translated(place), KEY if row < n_rows - 1 else COLOURED_KEY
    yield from pair(
        box((0.06, pitch * 0.75, 0.05), (ring_x + ring + 0.11, pitch, top)), COLOURED_KEY
    )


BUILDERS = (backpack, book, handbag, keyboard, laptop, mouse, remote)
