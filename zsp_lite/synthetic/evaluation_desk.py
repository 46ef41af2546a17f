"""Evaluation categories from the desk and the hall. Each builds one object: front +x, up +z, left +y."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.evaluation_parts import rounded_box, tapered
from zsp_lite.synthetic.primitives import box, capsule, cylinder, ellipsoid, extrusion, rod, torus


def book(a: Assembly) -> None:
    """Lies shut, spine to the left, or stands a little open; title, band or ribbon on the cover."""
    height, width, thick = a.u(1.3, 1.7), a.u(0.9, 1.25), a.u(0.12, 0.4)
    board = a.u(0.025, 0.05)
    # The head of the page points backwards (-x), the reader sits at the front.
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
        # The cover turns about the spine's upper edge.
        a.add(mesh.moved((0, -spine, 0)).turned("x", -lift).moved((0, spine, thick)), material)

    on_cover(box((height, width, board)), 0)
    title = -height * a.u(0.2, 0.32)
    for line in range(1 + a.pick(3)):
        on_cover(box((0.08, width * a.u(0.35, 0.7), 0.02), (title + 0.13 * line, 0, board / 2)), 3)
    style = a.pick(3)
    if style == 0:
        on_cover(box((height * a.u(0.25, 0.4), width * a.u(0.5, 0.8), 0.015), (height * 0.15, 0, board / 2)), 4)
    elif style == 1:
        on_cover(cylinder(width * 0.25, width * 0.25, 0.02, 24).moved((height * 0.15, 0, board / 2)), 4)
    else:
        on_cover(box((height, width * a.u(0.08, 0.2), 0.015), (0, width * 0.32, board / 2)), 4)
    on_cover(box((0.05, width * a.u(0.2, 0.4), 0.02), (height * 0.42, 0, board / 2)), 5)
    for share in (-0.32, 0.3):
        a.add(box((0.07, 0.03, thick * 0.7), (share * height, spine + 0.09, thick / 2)), 3)
    if a.chance(0.5):
        ribbon_y = a.u(-0.2, 0.2)
        a.add(box((0.3, 0.05, 0.015), (height / 2 + 0.1, ribbon_y, thick * 0.6)), 6)


def keyboard(a: Assembly) -> None:
    """Keys in rows with a space bar towards the user; a number pad on the right, or none; wedge and cable."""
    depth, width, thick = a.u(0.55, 0.8), a.u(1.6, 2.2), a.u(0.08, 0.16)
    tilt = a.u(0.03, 0.16)
    has_pad = a.chance(0.6)

    def on_top(mesh, material: int) -> None:
        a.add(mesh.turned("y", tilt).moved((0, 0, thick / 2 + depth / 2 * np.sin(tilt))), material)

    on_top(rounded_box((depth, width, thick), squareness=a.u(8, 14)), 0)
    on_top(box((0.08, 0.2, depth * np.sin(tilt)), (-depth * 0.42, width * 0.4, -thick / 2)), 4)
    on_top(box((0.08, 0.2, depth * np.sin(tilt)), (-depth * 0.42, -width * 0.4, -thick / 2)), 4)
    field = width * (0.68 if has_pad else 0.92)
    left = width * 0.46
    n_rows, n_keys = 4 + a.pick(2), 11 + a.pick(4)
    row_depth = depth * 0.86 / (n_rows + 1)
    for row in range(n_rows + 1):
        x = depth * 0.43 - (row + 0.5) * row_depth
        x -= row_depth * 0.15 if row == n_rows else 0
        pitch = field / n_keys
        for key in range(n_keys):
            if row == 0 and 3 <= key < n_keys - 4:
                continue
            special = row == n_rows or key in (0, n_keys - 1)
            y = left - (key + 0.5) * pitch
            on_top(box((row_depth * 0.78, pitch * 0.8, 0.06), (x, y, thick / 2 + 0.02)), 2 if special else 1)
        if row == 0:
            bar = (n_keys - 7) * pitch
            on_top(
                box((row_depth * 0.78, bar * 0.97, 0.06), (x, left - 3 * pitch - bar / 2, thick / 2 + 0.02)),
                3,
            )
    if has_pad:
        pad_left = left - field - width * 0.03
        for row in range(n_rows):
            for key in range(4):
                at = (
                    depth * 0.43 - (row + 0.5) * row_depth,
                    pad_left - (key + 0.5) * width * 0.05,
                    thick / 2 + 0.02,
                )
                on_top(box((row_depth * 0.78, width * 0.04, 0.06), at), 2 if key == 3 else 1)
        for light in range(3):
            on_top(box((0.03, 0.05, 0.03), (-depth * 0.4, pad_left - 0.04 - 0.1 * light, thick / 2)), 5)
    if a.chance(0.4):
        on_top(rounded_box((a.u(0.2, 0.35), width * 0.94, thick * 0.7), (depth / 2 + 0.12, 0, -0.01)), 4)
    if a.chance(0.6):
        y = a.u(-0.3, 0.3) * width
        bend = (-depth / 2 - a.u(0.1, 0.25), y + a.u(-0.1, 0.1), 0.05)
        a.add(capsule((-depth * 0.47, y, thick), bend, 0.03), 6)


def remote(a: Assembly) -> None:
    """A slab pointing forwards: power key and eye at the front, ring in the middle, number keys behind."""
    length, width, thick = a.u(1.4, 2.0), a.u(0.38, 0.58), a.u(0.14, 0.26)
    waist = a.u(0.8, 1.0)
    body = rounded_box((length, width, thick), (0, 0, thick / 2), a.u(4, 9))
    vertices = body.vertices.copy()
    vertices[:, 1] *= 1 + (waist - 1) * np.clip(0.5 - vertices[:, 0] / length, 0, 1)
    a.add(type(body)(vertices, body.faces), 0)
    top = thick + 0.005
    a.add(ellipsoid((0.06, width * 0.2, thick * 0.3), (length / 2 - 0.02, 0, thick * 0.55)), 5)
    power_y = width * a.u(0.15, 0.28) * (1 if a.chance(0.7) else -1)
    a.add(cylinder(0.055, 0.05, 0.06).moved((length * 0.41, power_y, top)), 3)
    if a.chance(0.5):
        a.add(box((0.05, 0.12, 0.04), (length * 0.41, -power_y, top)), 2)
    ring_x, ring = length * a.u(0.08, 0.22), width * a.u(0.26, 0.34)
    if a.chance(0.7):
        a.add(torus(ring, 0.035, centre=(ring_x, 0, top)), 4)
        a.add(cylinder(ring * 0.45, ring * 0.4, 0.06).moved((ring_x, 0, top)), 3)
    else:
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            a.add(box((0.09, 0.09, 0.06), (ring_x + ring * x, ring * y, top)), 4)
        a.add(cylinder(0.05, 0.05, 0.06).moved((ring_x, 0, top)), 3)
    pitch = width * 0.27
    rows = 3 + a.pick(3)
    round_keys = a.chance(0.5)
    for row in range(rows):
        for column in (-1, 0, 1):
            x = ring_x - ring - 0.12 - row * length * 0.085
            key = cylinder(0.045, 0.04, 0.05) if round_keys else box((0.07, pitch * 0.7, 0.05))
            a.add(key.moved((x, column * pitch * waist, top)), 1 if row < rows - 1 else 2)
    for x in (ring_x + ring + 0.11,):
        for column in (-1, 1) if a.chance(0.5) else (-1, 0, 1):
            a.add(box((0.06, pitch * 0.75, 0.05), (x, column * pitch, top)), 2)
    if a.chance(0.5):
        a.add(box((0.06, width * 0.4, 0.015), (-length * 0.44, 0, top)), 6)


def handbag(a: Assembly) -> None:
    """Tote, flap bag or bowling bag; one or two handles, clasp and pocket at the front, tag on one side."""
    depth, width, height = a.u(0.3, 0.5), a.u(1.0, 1.5), a.u(0.7, 1.1)
    style = a.pick(3)
    narrowing = a.u(0.65, 0.95) if style != 0 else a.u(1.0, 1.2)
    body = rounded_box((depth, width, height), (0, 0, height / 2), 8 if style == 0 else a.u(3, 5))
    a.add(tapered(body, 0, height, narrowing), 0)
    top_width = width * narrowing
    front = depth / 2
    if style == 1:
        flap = rounded_box((0.06, top_width * 0.98, height * a.u(0.45, 0.65)), (front + 0.02, 0, 0), 6)
        drop = float(np.ptp(flap.vertices[:, 2]))
        a.add(flap.moved((0, 0, height * 1.0 - drop / 2)), 1)
        a.add(rounded_box((depth * 0.9, top_width * 0.98, 0.07), (0.03, 0, height), 6), 1)
        a.add(
            cylinder(0.07, 0.07, 0.06).turned("y", np.pi / 2).moved((front + 0.07, 0, height - drop + 0.08)),
            3,
        )
    else:
        pocket = (0.1, width * a.u(0.45, 0.7), height * a.u(0.35, 0.5))
        a.add(rounded_box(pocket, (front, 0, height * 0.35), 4), 1)
        a.add(box((0.03, pocket[1] * 0.8, 0.035), (front + 0.05, 0, height * 0.35 + pocket[2] * 0.3)), 3)
        a.add(box((0.04, 0.1, 0.14), (front + 0.03, 0, height * 0.82)), 3)
    loop, strap = top_width * a.u(0.2, 0.3), a.u(0.025, 0.045)
    rise = a.u(0.9, 1.6)
    for x in (0.0,) if a.chance(0.35) else (front * 0.7, -front * 0.7):
        handle = torus(loop, strap, (1, 0, 0), (0, 0, 0), np.pi / 2, 1.5 * np.pi, sides=20).scaled((1, 1, rise))
        a.add(handle.moved((x, 0, height * 0.95)), 2)
        for side in (1, -1):
            a.add(
                cylinder(0.06, 0.06, 0.05, 12).turned("y", np.pi / 2).moved((x, side * loop, height * 0.93)),
                3,
            )
    a.add(rod((-front, 0.0, height * 0.7), (-front - 0.02, 0.0, height * 0.7), 0.05), 3)
    if a.chance(0.7):
        tag_y = -loop * 1.1
        a.add(rod((front, tag_y, height * 0.9), (front + 0.04, tag_y, height * 0.72), 0.015), 3)
        a.add(box((0.03, 0.12, 0.2), (front + 0.05, tag_y, height * 0.65)), 5)
    a.add(box((depth * 0.6, width * 0.7, 0.06), (0, 0, 0.0)), 4)
    for x in (-0.25, 0.25):
        a.add(cylinder(0.04, 0.04, 0.06, 8).moved((x * depth, width * 0.32, -0.04)), 3, mirror=True)
