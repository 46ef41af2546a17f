"""Evaluation categories of personal belongings: bags and a book (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.evaluation_parts import rounded_box, tapered
from zsp_lite.synthetic.primitives import box, capsule, cylinder, extrusion, lathe, rod, torus


def backpack(a: Assembly) -> None:
    """Build a backpack, with or without a flap: pockets at the front, shoulder straps behind, handle on top."""
    depth, width, height = a.u(0.42, 0.62), a.u(0.7, 1.0), a.u(1.1, 1.5)
    body = rounded_box((depth, width, height), (0, 0, height / 2), a.u(3.5, 6))
    narrowing = a.u(0.7, 1.0)
    a.add(tapered(body, height * 0.5, height, narrowing), 0)
    flap = a.chance(0.4)
    pocket_height, pocket_depth = height * a.u(0.35, 0.5), depth * a.u(0.45, 0.7)
    pocket_z = height * a.u(0.06, 0.12) + pocket_height / 2
    a.add(rounded_box((pocket_depth, width * a.u(0.65, 0.85), pocket_height), (depth / 2, 0, pocket_z), 4), 1)
    a.add(box((0.03, width * 0.6, 0.03), (depth / 2 + pocket_depth * 0.45, 0, pocket_z + pocket_height * 0.28)), 3)
    if flap:
        hood = rounded_box((depth * 1.15, width * 1.02, height * 0.3), (depth * 0.08, 0, height * 0.92), 4)
        a.add(tapered(hood, height * 0.5, height, narrowing * 1.05), 2)
        for y in (0.2, -0.2):
            a.add(box((0.04, 0.07, height * 0.38), (depth * 0.6, y * width, height * 0.66)), 3)
            a.add(box((0.06, 0.1, 0.08), (depth * 0.62, y * width, height * 0.56)), 5)
    else:
        a.add(rounded_box((depth * 0.4, width * 0.6, height * a.u(0.18, 0.26)), (depth * 0.38, 0, height * 0.74), 4), 2)
        seam = torus(0.5, 0.015, (1, 0, 0), (0.05, 0, height * 0.55), np.pi / 2, 1.5 * np.pi, sides=20)
        a.add(seam.scaled((1, width * 1.0, 1)).translated((0, 0, 0)), 3)
    a.add(torus(a.u(0.08, 0.13), 0.03, (1, 0, 0), (-depth * 0.3, 0, height * 1.0), np.pi / 2, 1.5 * np.pi, sides=12), 3)
    strap_y, bulge = width * a.u(0.22, 0.3), a.u(0.12, 0.22)
    back = -depth / 2
    bends = [
        (back + 0.02, strap_y * 0.8, height * 0.93),
        (back - bulge, strap_y, height * 0.78),
        (back - bulge, strap_y * 1.15, height * 0.42),
        (back + 0.02, strap_y * 1.35, height * 0.12),
    ]
    for start, end in zip(bends, bends[1:]):
        a.add(capsule(start, end, 0.05), 4, mirror=True)
    if a.chance(0.6):
        side = lathe([[0.12, 0], [0.15, 0.35], [0.14, 0.35], [0.001, 0.3]], 14).translated(
            (0, width / 2, height * 0.08)
        )
        a.add(side, 2, mirror=True)
        if a.chance(0.5):
            a.add(cylinder(0.1, 0.1, 0.55).translated((0, width / 2, height * 0.08 + 0.35)), 6)


def handbag(a: Assembly) -> None:
    """Build a tote, flap bag or bowling bag: one or two handles, clasp and pocket at the front, tag on one side."""
    depth, width, height = a.u(0.3, 0.5), a.u(1.0, 1.5), a.u(0.7, 1.1)
    style = a.choice(3)
    narrowing = a.u(0.65, 0.95) if style != 0 else a.u(1.0, 1.2)
    body = rounded_box((depth, width, height), (0, 0, height / 2), 8 if style == 0 else a.u(3, 5))
    a.add(tapered(body, 0, height, narrowing), 0)
    top_width = width * narrowing
    front = depth / 2
    if style == 1:
        flap = rounded_box((0.06, top_width * 0.98, height * a.u(0.45, 0.65)), (front + 0.02, 0, 0), 6)
        drop = float(np.ptp(flap.vertices[:, 2]))
        a.add(flap.translated((0, 0, height * 1.0 - drop / 2)), 1)
        a.add(rounded_box((depth * 0.9, top_width * 0.98, 0.07), (0.03, 0, height), 6), 1)
        a.add(cylinder(0.07, 0.07, 0.06).rotated("y", np.pi / 2).translated((front + 0.07, 0, height - drop + 0.08)), 3)
    else:
        pocket = (0.1, width * a.u(0.45, 0.7), height * a.u(0.35, 0.5))
        a.add(rounded_box(pocket, (front, 0, height * 0.35), 4), 1)
        a.add(box((0.03, pocket[1] * 0.8, 0.035), (front + 0.05, 0, height * 0.35 + pocket[2] * 0.3)), 3)
        a.add(box((0.04, 0.1, 0.14), (front + 0.03, 0, height * 0.82)), 3)
    loop, strap = top_width * a.u(0.2, 0.3), a.u(0.025, 0.045)
    rise = a.u(0.9, 1.6)
    for x in (0.0,) if a.chance(0.35) else (front * 0.7, -front * 0.7):
        handle = torus(loop, strap, (1, 0, 0), (0, 0, 0), np.pi / 2, 1.5 * np.pi, sides=20).scaled((1, 1, rise))
        a.add(handle.translated((x, 0, height * 0.95)), 2)
        for side in (1, -1):
            a.add(cylinder(0.06, 0.06, 0.05, 12).rotated("y", np.pi / 2).translated((x, side * loop, height * 0.93)), 3)
    a.add(rod((-front, 0.0, height * 0.7), (-front - 0.02, 0.0, height * 0.7), 0.05), 3)
    if a.chance(0.7):
        tag_y = -loop * 1.1
        a.add(rod((front, tag_y, height * 0.9), (front + 0.04, tag_y, height * 0.72), 0.015), 3)
        a.add(box((0.03, 0.12, 0.2), (front + 0.05, tag_y, height * 0.65)), 5)
    a.add(box((depth * 0.6, width * 0.7, 0.06), (0, 0, 0.0)), 4)
    for x in (-0.25, 0.25):
        a.add(cylinder(0.04, 0.04, 0.06, 8).translated((x * depth, width * 0.32, -0.04)), 3, mirror=True)


def book(a: Assembly) -> None:
    """Build a book: closed or slightly open, spine on the left; title, band or ribbon on the cover."""
    height, width, thick = a.u(1.3, 1.7), a.u(0.9, 1.25), a.u(0.12, 0.4)
    board = a.u(0.025, 0.05)
    # The top of the page points backwards (-x); the reader is at the front.
    a.add(box((height * 0.96, width * 0.95, thick), (0, -width * 0.01, thick / 2)), 1)
    a.add(box((height, width, board), (0, 0, 0)), 0)
    spine = width / 2
    if a.chance(0.5):
        angle = np.linspace(0, np.pi, 9)
        arc = np.stack([spine + 0.1 * np.sin(angle), thick / 2 + (thick / 2 + board / 2) * np.cos(angle)], 1)
        a.add(extrusion(arc, height, "yz"), 2)
    else:
        a.add(box((height, board, thick + board), (0, spine, thick / 2)), 2)
    lift = a.u(0.15, 0.7) if a.chance(0.4) else 0.0

    def on_cover(mesh, material: int) -> None:
        # The cover rotates about the upper edge of the spine.
        a.add(mesh.translated((0, -spine, 0)).rotated("x", -lift).translated((0, spine, thick)), material)

    on_cover(box((height, width, board)), 0)
    title = -height * a.u(0.2, 0.32)
    for line in range(1 + a.choice(3)):
        on_cover(box((0.08, width * a.u(0.35, 0.7), 0.02), (title + 0.13 * line, 0, board / 2)), 3)
    style = a.choice(3)
    if style == 0:
        on_cover(box((height * a.u(0.25, 0.4), width * a.u(0.5, 0.8), 0.015), (height * 0.15, 0, board / 2)), 4)
    elif style == 1:
        on_cover(cylinder(width * 0.25, width * 0.25, 0.02, 24).translated((height * 0.15, 0, board / 2)), 4)
    else:
        on_cover(box((height, width * a.u(0.08, 0.2), 0.015), (0, width * 0.32, board / 2)), 4)
    on_cover(box((0.05, width * a.u(0.2, 0.4), 0.02), (height * 0.42, 0, board / 2)), 5)
    for share in (-0.32, 0.3):
        a.add(box((0.07, 0.03, thick * 0.7), (share * height, spine + 0.09, thick / 2)), 3)
    if a.chance(0.5):
        ribbon_y = a.u(-0.2, 0.2)
        a.add(box((0.3, 0.05, 0.015), (height / 2 + 0.1, ribbon_y, thick * 0.6)), 6)
