"""Bags and books (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.categories.parts import rounded_box, tapered
from zsp_lite.synthetic.primitives import TAU, Mesh, box, capsule, cylinder, extrusion, lathe, torus


def backpack(a: Assembly) -> None:
    """Build a backpack, with or without a flap: pockets at the front, shoulder straps behind, handle on top."""
    depth, width, height = a.u(0.42, 0.62), a.u(0.7, 1.0), a.u(1.1, 1.5)
    front, back, narrowing = depth / 2, -depth / 2, a.u(0.7, 1.0)
    a.add(
        tapered(rounded_box((depth, width, height), (0, 0, height / 2), a.u(3.5, 6)), height / 2, height, narrowing), 0
    )
    pocket_depth, pocket_height = depth * a.u(0.45, 0.7), height * a.u(0.35, 0.5)
    pocket_z = height * a.u(0.06, 0.12) + pocket_height / 2
    a.add(rounded_box((pocket_depth, width * a.u(0.65, 0.85), pocket_height), (front, 0, pocket_z), 4), 1)
    zip_x, zip_z = front + pocket_depth * 0.45, pocket_z + pocket_height * 0.28
    a.add(box((0.03, width * 0.6, 0.03), (zip_x, 0, zip_z)), 3)
    if a.chance(0.4):
        flap = rounded_box((depth * 1.15, width * 1.02, height * 0.3), (depth * 0.08, 0, height * 0.92), 4)
        a.add(tapered(flap, height / 2, height, narrowing), 2)
        a.add(box((0.04, 0.07, height * 0.38), (depth * 0.6, width * 0.2, height * 0.66)), 3, mirror=True)
        a.add(box((0.06, 0.1, 0.08), (depth * 0.62, width * 0.2, height * 0.56)), 5, mirror=True)
    else:
        upper_pocket = (depth * 0.4, width * 0.6, height * a.u(0.18, 0.26))
        a.add(rounded_box(upper_pocket, (depth * 0.38, 0, height * 0.74), 4), 2)
    a.add(torus(a.u(0.08, 0.13), 0.03, (1, 0, 0), (back * 0.6, 0, height), TAU / 4, TAU * 3 / 4, sides=12), 3)
    strap_y, bulge = width * a.u(0.22, 0.3), a.u(0.12, 0.22)
    upper, lower = (back - bulge, strap_y, height * 0.78), (back - bulge, strap_y * 1.15, height * 0.42)
    a.add(capsule((back + 0.02, strap_y * 0.8, height * 0.93), upper, 0.05), 4, mirror=True)
    a.add(capsule(upper, lower, 0.05), 4, mirror=True)
    a.add(capsule(lower, (back + 0.02, strap_y * 1.35, height * 0.12), 0.05), 4, mirror=True)
    if a.chance(0.6):
        bottle_pocket = lathe([[0.12, 0], [0.15, 0.35], [0.14, 0.35], [0.001, 0.3]], 14)
        a.add(bottle_pocket.translated((0, width / 2, height * 0.08)), 2, mirror=True)
        if a.chance(0.5):
            a.add(cylinder(0.1, 0.1, 0.55).translated((0, width / 2, height * 0.08 + 0.35)), 6)


def handbag(a: Assembly) -> None:
    """Build a tote, flap bag or bowling bag: one or two handles, clasp and pocket at the front, tag on one side."""
    depth, width, height = a.u(0.3, 0.5), a.u(1.0, 1.5), a.u(0.7, 1.1)
    style = a.choice(3)
    narrowing = a.u(1.0, 1.2) if style == 0 else a.u(0.65, 0.95)
    body = rounded_box((depth, width, height), (0, 0, height / 2), 8 if style == 0 else a.u(3, 5))
    a.add(tapered(body, 0, height, narrowing), 0)
    front, top_width = depth / 2, width * narrowing
    if style == 1:
        drop = height * a.u(0.45, 0.65)
        a.add(rounded_box((0.06, top_width, drop), (front + 0.02, 0, height - drop / 2), 6), 1)
        a.add(rounded_box((depth * 0.9, top_width, 0.07), (0.03, 0, height), 6), 1)
        a.add(cylinder(0.07, 0.07, 0.06).rotated("y", TAU / 4).translated((front + 0.07, 0, height - drop + 0.08)), 3)
    else:
        pocket_width, pocket_height = width * a.u(0.45, 0.7), height * a.u(0.35, 0.5)
        a.add(rounded_box((0.1, pocket_width, pocket_height), (front, 0, height * 0.35), 4), 1)
        zip_z = height * 0.35 + pocket_height * 0.3
        a.add(box((0.03, pocket_width * 0.8, 0.035), (front + 0.05, 0, zip_z)), 3)
        a.add(box((0.04, 0.1, 0.14), (front + 0.03, 0, height * 0.82)), 3)
    loop, strap, rise = top_width * a.u(0.2, 0.3), a.u(0.025, 0.045), a.u(0.9, 1.6)
    for x in (0.0,) if a.chance(0.35) else (front * 0.7, -front * 0.7):
        handle = torus(loop, strap, (1, 0, 0), start=TAU / 4, stop=TAU * 3 / 4, sides=20)
        a.add(handle.scaled((1, 1, rise)).translated((x, 0, height * 0.95)), 2)
        ring = cylinder(0.06, 0.06, 0.05, 12).rotated("y", TAU / 4)
        a.add(ring.translated((x, loop, height * 0.93)), 3, mirror=True)
    if a.chance(0.7):
        a.add(box((0.03, 0.12, 0.25), (front + 0.05, -loop * 1.1, height * 0.7)), 5)
    a.add(box((depth * 0.6, width * 0.7, 0.06)), 4)


def book(a: Assembly) -> None:
    """Build a book: closed or slightly open, spine on the left; title, band or ribbon on the cover."""
    # The top of the page points backwards (-x); the reader is at the front.
    height, width, thick, board = a.u(1.3, 1.7), a.u(0.9, 1.25), a.u(0.12, 0.4), a.u(0.025, 0.05)
    spine = width / 2
    a.add(box((height * 0.96, width * 0.95, thick), (0, -width * 0.01, thick / 2)), 1)
    a.add(box((height, width, board)), 0)
    if a.chance(0.5):
        angle = np.linspace(0, np.pi, 9)
        arc = np.stack([spine + 0.1 * np.sin(angle), thick / 2 + (thick + board) / 2 * np.cos(angle)], 1)
        a.add(extrusion(arc, height, "yz"), 2)
    else:
        a.add(box((height, board, thick + board), (0, spine, thick / 2)), 2)
    lift = a.u(0.15, 0.7) if a.chance(0.4) else 0.0

    def add_to_cover(mesh: Mesh, material: int) -> None:
        # The cover rotates about the upper edge of the spine.
        a.add(mesh.translated((0, -spine, 0)).rotated("x", -lift).translated((0, spine, thick)), material)

    add_to_cover(box((height, width, board)), 0)
    title_x = -height * a.u(0.2, 0.32)
    for line in range(1 + a.choice(3)):
        add_to_cover(box((0.08, width * a.u(0.35, 0.7), 0.02), (title_x + 0.13 * line, 0, board / 2)), 3)
    picture, place = a.choice(3), (height * 0.15, 0, board / 2)
    if picture == 0:
        add_to_cover(box((height * a.u(0.25, 0.4), width * a.u(0.5, 0.8), 0.015), place), 4)
    elif picture == 1:
        add_to_cover(cylinder(width * 0.25, width * 0.25, 0.02, 24).translated(place), 4)
    else:
        add_to_cover(box((height, width * a.u(0.08, 0.2), 0.015), (0, width * 0.32, board / 2)), 4)
    add_to_cover(box((0.05, width * a.u(0.2, 0.4), 0.02), (height * 0.42, 0, board / 2)), 5)
    if a.chance(0.5):
        a.add(box((0.3, 0.05, 0.015), (height / 2 + 0.1, a.u(-0.2, 0.2), thick * 0.6)), 6)


BELONGINGS = (backpack, book, handbag)
