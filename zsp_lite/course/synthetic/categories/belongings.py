"""Bags, books, and what lies on a desk (front +x, left +y, up +z).

The number in a call of `a.add` is the part's material, 0 to 7: parts of one number look alike.
"""

from collections.abc import Callable

import numpy as np

from zsp_lite.course.synthetic.assembly import Assembly, X, Y, rounded_box, tapered
from zsp_lite.course.synthetic.primitives import (
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

_ARCH = (TAU / 4, TAU * 3 / 4)  # angles of the upper half of a torus about x


def backpack(a: Assembly) -> None:
    """Build a backpack: pockets, a flap or an upper pocket, a handle on top, straps behind."""
    depth = a.u(0.42, 0.62)
    width = a.u(0.7, 1.0)
    height = a.u(1.1, 1.5)
    front = depth / 2
    back = -front
    narrowing = a.u(0.7, 1.0)
    body = rounded_box((depth, width, height), (0, 0, height / 2), a.u(3.5, 6))
    a.add(tapered(body, height / 2, height, narrowing), 0)
    pocket_depth = depth * a.u(0.45, 0.7)
    pocket_height = height * a.u(0.35, 0.5)
    pocket_z = height * a.u(0.06, 0.12) + pocket_height / 2
    pocket = (pocket_depth, width * a.u(0.65, 0.85), pocket_height)
    a.add(rounded_box(pocket, (front, 0, pocket_z), 4), 1)
    if a.chance(0.4):
        # A flap with two belts.
        flap_size = (depth * 1.15, width * 1.02, height * 0.3)
        flap = rounded_box(flap_size, (depth * 0.08, 0, height * 0.92), 4)
        a.add(tapered(flap, height / 2, height, narrowing), 2)
        belt = box((0.04, 0.1, height * 0.38), (depth * 0.6, width * 0.2, height * 0.66))
        a.add_pair(belt, 3)
    else:
        upper_pocket = (depth * 0.4, width * 0.6, height * a.u(0.18, 0.26))
        a.add(rounded_box(upper_pocket, (depth * 0.38, 0, height * 0.74), 4), 2)
    # The handle, an arch across; then the straps, which bulge at the back.
    handle = torus(a.u(0.08, 0.13), 0.03, X, (back * 0.6, 0, height), *_ARCH, sides=12)
    a.add(handle, 3)
    strap_y = width * a.u(0.22, 0.3)
    bulge = a.u(0.12, 0.22)
    bend = (back - bulge, strap_y, height * 0.7)
    a.add_pair(capsule((back + 0.02, strap_y * 0.8, height * 0.93), bend, 0.05), 4)
    a.add_pair(capsule(bend, (back + 0.02, strap_y * 1.35, height * 0.12), 0.05), 4)
    if a.chance(0.6):
        bottle_pocket = lathe([[0.12, 0], [0.15, 0.35], [0.14, 0.35], [0.001, 0.3]], 14)
        a.add_pair(bottle_pocket.translated((0, width / 2, height * 0.08)), 2)


def handbag(a: Assembly) -> None:
    """Build a tote, flap bag or bowling bag: clasp or pocket, one or two handles, a tag."""
    depth = a.u(0.3, 0.5)
    width = a.u(1.0, 1.5)
    height = a.u(0.7, 1.1)
    style = a.pick("tote", "flap bag", "bowling bag")
    narrowing = a.u(1.0, 1.2) if style == "tote" else a.u(0.65, 0.95)
    squareness = 8 if style == "tote" else a.u(3, 5)
    body = rounded_box((depth, width, height), (0, 0, height / 2), squareness)
    a.add(tapered(body, 0, height, narrowing), 0)
    front = depth / 2
    top_width = width * narrowing
    if style == "flap bag":
        drop = height * a.u(0.45, 0.65)
        a.add(rounded_box((0.06, top_width, drop), (front + 0.02, 0, height - drop / 2), 6), 1)
        clasp = cylinder(0.07, 0.07, 0.06).rotated("y", TAU / 4)
        a.add(clasp.translated((front + 0.07, 0, height - drop + 0.08)), 3)
    else:
        pocket_width = width * a.u(0.45, 0.7)
        pocket_height = height * a.u(0.35, 0.5)
        a.add(rounded_box((0.1, pocket_width, pocket_height), (front, 0, height * 0.35), 4), 1)
        a.add(box((0.04, 0.1, 0.14), (front + 0.03, 0, height * 0.82)), 3)
    loop = top_width * a.u(0.2, 0.3)
    strap = a.u(0.025, 0.045)
    handle = torus(loop, strap, X, (0, 0, 0), *_ARCH, sides=20).scaled((1, 1, a.u(0.9, 1.6)))
    places = (0.0,) if a.chance(0.35) else (front * 0.7, -front * 0.7)
    for x in places:
        a.add(handle.translated((x, 0, height * 0.95)), 2)
    a.add(box((0.03, 0.12, 0.25), (front + 0.05, -loop * 1.1, height * 0.7)), 5)  # the tag


def book(a: Assembly) -> None:
    """Build a book, closed or slightly open: spine on the left, a title, a picture or a band."""
    # The top of the page points backwards (-x); the reader is at the front.
    height = a.u(1.3, 1.7)
    width = a.u(0.9, 1.25)
    thick = a.u(0.12, 0.4)
    board = a.u(0.025, 0.05)
    spine = width / 2
    # The pages, the lower cover, and a round or flat spine.
    a.add(box((height * 0.96, width * 0.95, thick), (0, -width * 0.01, thick / 2)), 1)
    a.add(box((height, width, board)), 0)
    if a.chance(0.5):
        angle = np.linspace(0, np.pi, 9)
        y = spine + 0.1 * np.sin(angle)
        z = thick / 2 + (thick + board) / 2 * np.cos(angle)
        a.add(extrusion(np.stack([y, z], 1), height, "yz"), 2)
    else:
        a.add(box((height, board, thick + board), (0, spine, thick / 2)), 2)
    lift = a.u(0.15, 0.7) if a.chance(0.4) else 0.0

    def add_to_cover(mesh: Mesh, material: int) -> None:
        # The cover rotates about the upper edge of the spine.
        lifted = mesh.translated((0, -spine, 0)).rotated("x", -lift)
        a.add(lifted.translated((0, spine, thick)), material)

    add_to_cover(box((height, width, board)), 0)
    title_x = -height * a.u(0.2, 0.32)
    for line in range(1 + a.choice(3)):
        title = (0.08, width * a.u(0.35, 0.7), 0.02)
        add_to_cover(box(title, (title_x + 0.13 * line, 0, board / 2)), 3)
    if a.chance(0.6):
        picture = (height * a.u(0.25, 0.4), width * a.u(0.5, 0.8), 0.015)
        add_to_cover(box(picture, (height * 0.15, 0, board / 2)), 4)
    else:
        add_to_cover(box((height, width * a.u(0.08, 0.2), 0.015), (0, width * 0.32, board / 2)), 4)


def laptop(a: Assembly) -> None:
    """Build a laptop, opened by 80 to 130 degrees, with its user at the front."""
    depth = a.u(0.8, 1.1)
    width = a.u(1.2, 1.6)
    thick = a.u(0.05, 0.1)
    a.add(rounded_box((depth, width, thick), (0, 0, thick / 2), 12), 0)
    # The keys in a field of their own, and the touchpad before them.
    n_rows = 4 + a.choice(2)
    n_keys = 10 + a.choice(4)
    field = depth * a.u(0.4, 0.5)
    front = depth * a.u(0.08, 0.14)
    a.add(box((field * 1.06, width * 0.88, 0.01), (front - field / 2, 0, thick)), 5)
    cell = (field / n_rows, width * 0.85 / n_keys)
    _add_keys(a.add, n_rows, n_keys, (front, width * 0.425), cell, thick)
    touchpad = (depth * 0.24, width * a.u(0.22, 0.36), 0.015)
    a.add(box(touchpad, (depth * 0.31, a.u(-0.08, 0.04), thick)), 2)
    # The lid with its screen, and a sign on its back.
    hinge = (-depth / 2 + 0.03, 0, thick + 0.02)
    opening = a.u(np.radians(80), np.radians(130))
    lid = depth * a.u(0.9, 1.02)
    rim = a.u(0.04, 0.09)

    def add_to_lid(mesh: Mesh, material: int) -> None:
        # The part is given for the closed lid: the screen faces down, the hinge is at x = 0.
        a.add(mesh.rotated("y", -opening).translated(hinge), material)

    add_to_lid(rounded_box((lid, width, thick * 0.6), (lid / 2, 0, thick * 0.3), 12), 0)
    add_to_lid(box((lid - 2 * rim, width - 2 * rim, 0.02), (lid / 2 + 0.01, 0, 0)), 4)
    add_to_lid(cylinder(a.u(0.06, 0.12), 0.06, 0.02, 16).translated((lid / 2, 0, thick * 0.6)), 6)


def _add_keys(
    add: Callable[[Mesh, int], None],
    n_rows: int,
    n_keys: int,
    corner: tuple[float, float],
    cell: tuple[float, float],
    z: float,
) -> None:
    """Add keys in cells of (depth, width) at height z, from the front left corner (x, y) on."""
    front, left = corner
    depth, width = cell
    for row in range(n_rows):
        for key in range(n_keys):
            # The space bar replaces all but seven keys of the front row.
            if row > 0 or not 3 <= key < n_keys - 4:
                place = (front - (row + 0.5) * depth, left - (key + 0.5) * width, z)
                material = 2 if key in (0, n_keys - 1) else 1
                add(box((depth * 0.78, width * 0.8, 0.1), place), material)
    bar = (n_keys - 7) * width
    place = (front - depth / 2, left - 3 * width - bar / 2, z)
    add(box((depth * 0.78, bar * 0.97, 0.1), place), 3)


def mouse(a: Assembly) -> None:
    """Build a computer mouse: two buttons, wheel, optional thumb rest on the left, and cable."""
    length = a.u(1.1, 1.5)
    width = a.u(0.65, 0.9)
    height = a.u(0.32, 0.55)
    shell = rounded_box((length, width, 2 * height), squareness=a.u(2.2, 3.5))
    # Only the upper half of the shell remains, lower at the front.
    vertices = shell.vertices.copy()
    slope = 1 - a.u(0.1, 0.4) * (vertices[:, 0] / length + 0.1)
    vertices[:, 2] = np.maximum(vertices[:, 2], 0) * slope
    a.add(Mesh(vertices, shell.faces), 0)
    a.add(shell.scaled((1.03, 1.03, 0.06)), 3)
    # A button is the front quarter of the shell, slightly raised.
    button = vertices * [1.02, 1.0, 1.06] + [0, 0, 0.015]
    button[:, 0] = np.maximum(button[:, 0], length * a.u(0.02, 0.12))
    button[:, 1] = np.maximum(button[:, 1], 0.025)
    a.add_pair(Mesh(button, shell.faces), 1)
    a.add(torus(0.09, 0.045, Y, (length * a.u(0.25, 0.33), 0, height * 0.78), sides=16), 2)
    if a.chance(0.5):
        rest = (length * 0.5, 0.12, height * 0.3)
        a.add(rounded_box(rest, (0.05, width * 0.46, height * 0.55), 4), 4)
    if a.chance(0.6):
        cable_end = (length / 2 + a.u(0.2, 0.5), a.u(-0.3, 0.3), 0.05)
        a.add(capsule((length * 0.46, 0, height * 0.25), cable_end, 0.04, 0.03), 5)


def keyboard(a: Assembly) -> None:
    """Build a keyboard: keys, optional number pad on the right, palm rest and cable."""
    depth = a.u(0.55, 0.8)
    width = a.u(1.6, 2.2)
    thick = a.u(0.08, 0.16)
    tilt = a.u(0.03, 0.16)
    has_pad = a.chance(0.6)

    def add_tilted(mesh: Mesh, material: int) -> None:
        # The front edge stays on the desk.
        height = thick / 2 + depth / 2 * np.sin(tilt)
        a.add(mesh.rotated("y", tilt).translated((0, 0, height)), material)

    add_tilted(rounded_box((depth, width, thick), squareness=a.u(8, 14)), 0)
    n_rows = 5 + a.choice(2)
    n_keys = 11 + a.choice(4)
    field = width * (0.68 if has_pad else 0.92)
    row_depth = depth * 0.86 / n_rows
    front = depth * 0.43
    top = thick / 2
    cell = (row_depth, field / n_keys)
    _add_keys(add_tilted, n_rows, n_keys, (front, width * 0.46), cell, top)
    if has_pad:
        for row in range(n_rows - 1):
            for key in range(4):
                place = (front - (row + 0.5) * row_depth, -width * (0.275 + 0.05 * key), top)
                add_tilted(box((row_depth * 0.78, width * 0.04, 0.1), place), 2 if key == 3 else 1)
    if a.chance(0.4):
        rest = (a.u(0.2, 0.35), width * 0.94, thick * 0.7)
        add_tilted(rounded_box(rest, (depth / 2 + 0.12, 0, -0.01)), 4)
    if a.chance(0.6):
        y = a.u(-0.3, 0.3) * width
        cable_end = (-depth / 2 - a.u(0.1, 0.25), y + a.u(-0.1, 0.1), 0.05)
        a.add(capsule((-depth * 0.47, y, thick), cable_end, 0.03), 6)


def remote(a: Assembly) -> None:
    """Build a remote control: emitter and power key in front, a ring, number keys behind."""
    length = a.u(1.4, 2.0)
    width = a.u(0.38, 0.58)
    thick = a.u(0.14, 0.26)
    body = rounded_box((thick, width, length), (0, 0, length / 2), a.u(4, 9))
    waist = a.u(0.8, 1.0)
    top = thick + 0.005
    # The body is built upright, and laid down.
    body = tapered(body, length / 2, 0, waist).rotated("y", np.pi / 2)  # narrower behind
    a.add(body.translated((-length / 2, 0, thick / 2)), 0)
    a.add(ellipsoid((0.06, width * 0.2, thick * 0.3), (length / 2 - 0.02, 0, thick * 0.55)), 5)
    a.add(cylinder(0.055, 0.05, 0.06).translated((length * 0.41, width * a.u(0.15, 0.28), top)), 3)
    # A ring, or four keys in its place, around a button.
    ring_x = length * a.u(0.08, 0.22)
    ring = width * a.u(0.26, 0.34)
    if a.chance(0.7):
        a.add(torus(ring, 0.035, centre=(ring_x, 0, top)), 4)
    else:
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            a.add(box((0.09, 0.09, 0.06), (ring_x + ring * x, ring * y, top)), 4)
    a.add(cylinder(ring * 0.45, ring * 0.4, 0.06).translated((ring_x, 0, top)), 3)
    # Rows of three keys; those of the last row, and two before the ring, have another colour.
    n_rows = 3 + a.choice(3)
    round_keys = a.chance(0.5)
    pitch = width * 0.27
    for row in range(n_rows):
        for column in (-1, 0, 1):
            key = cylinder(0.045, 0.04, 0.05) if round_keys else box((0.07, pitch * 0.7, 0.05))
            place = (ring_x - ring - 0.12 - row * length * 0.085, column * pitch * waist, top)
            a.add(key.translated(place), 1 if row < n_rows - 1 else 2)
    a.add_pair(box((0.06, pitch * 0.75, 0.05), (ring_x + ring + 0.11, pitch, top)), 2)
