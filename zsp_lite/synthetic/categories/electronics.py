"""Computers and their accessories (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.categories.parts import Y, rounded_box, tapered
from zsp_lite.synthetic.primitives import Mesh, box, capsule, cylinder, ellipsoid, torus


def laptop(a: Assembly) -> None:
    """Build a laptop: keys and touchpad on the base, towards the user at the front; opened by 80 to 130 degrees."""
    depth, width, thick = a.u(0.8, 1.1), a.u(1.2, 1.6), a.u(0.05, 0.1)
    a.add(rounded_box((depth, width, thick), (0, 0, thick / 2), 12), 0)
    n_rows, n_keys = 4 + a.choice(2), 9 + a.choice(4)
    field, front = depth * a.u(0.4, 0.5), depth * a.u(0.08, 0.14)  # of the keys
    row_depth, pitch = field / n_rows, width * 0.85 / n_keys
    a.add(box((field * 1.06, width * 0.88, 0.01), (front - field / 2, 0, thick)), 5)
    for row in range(n_rows):
        for key in range(n_keys):
            y = (key + 0.5) * pitch - width * 0.425
            if row > 0 or abs(y) > width * 0.21:
                place = (front - (row + 0.5) * row_depth, y, thick + 0.012)
                a.add(box((row_depth * 0.75, pitch * 0.78, 0.03), place), 1)
    a.add(box((row_depth * 0.75, width * 0.42, 0.03), (front - row_depth / 2, 0, thick + 0.012)), 1)  # the space bar
    a.add(box((depth * 0.24, width * a.u(0.22, 0.36), 0.015), (depth * 0.31, a.u(-0.08, 0.04), thick)), 2)
    hinge = (-depth / 2 + 0.03, 0, thick + 0.02)
    a.add(capsule((hinge[0], -width * 0.4, thick), (hinge[0], width * 0.4, thick), 0.03), 3)
    opening, lid, rim = a.u(np.radians(80), np.radians(130)), depth * a.u(0.9, 1.02), a.u(0.04, 0.09)

    def add_to_lid(mesh: Mesh, material: int) -> None:
        # The part is given for the closed lid: the screen faces down, the hinge is at x = 0.
        a.add(mesh.rotated("y", -opening).translated(hinge), material)

    add_to_lid(rounded_box((lid, width, thick * 0.6), (lid / 2, 0, thick * 0.3), 12), 0)
    add_to_lid(box((lid - 2 * rim, width - 2 * rim, 0.02), (lid / 2 + 0.01, 0, 0)), 4)
    add_to_lid(cylinder(a.u(0.06, 0.12), 0.06, 0.02, 16).translated((lid / 2, 0, thick * 0.6)), 6)


def mouse(a: Assembly) -> None:
    """Build a computer mouse: buttons and wheel at the front, optional cable, thumb rest on the left."""
    length, width, height = a.u(1.1, 1.5), a.u(0.65, 0.9), a.u(0.32, 0.55)
    shell = rounded_box((length, width, 2 * height), squareness=a.u(2.2, 3.5))
    vertices = shell.vertices.copy()
    vertices[:, 2] = np.maximum(vertices[:, 2], 0) * (1 - a.u(0.1, 0.4) * (vertices[:, 0] / length + 0.1))
    a.add(Mesh(vertices, shell.faces), 0)
    a.add(shell.scaled((1.03, 1.03, 0.06)), 3)
    # A button is the front quarter of the shell, slightly raised.
    button = vertices * [1.02, 1.0, 1.06] + [0, 0, 0.015]
    button[:, 0] = np.maximum(button[:, 0], length * a.u(0.02, 0.12))
    button[:, 1] = np.maximum(button[:, 1], 0.025)
    a.add(Mesh(button, shell.faces), 1, mirror=True)
    a.add(torus(0.09, 0.045, Y, (length * a.u(0.25, 0.33), 0, height * 0.78), sides=16), 2)
    if a.chance(0.5):
        a.add(rounded_box((length * 0.5, 0.12, height * 0.3), (0.05, width * 0.46, height * 0.55), 4), 4)
    if a.chance(0.6):
        bend = np.array([length / 2 + a.u(0.15, 0.3), a.u(-0.15, 0.15), 0.05])
        a.add(capsule((length * 0.46, 0, height * 0.25), bend, 0.04, 0.03), 5)
        a.add(capsule(bend, bend + [a.u(0.1, 0.3), a.u(-0.3, 0.3), 0], 0.03), 5)
    if a.chance(0.5):
        a.add(box((0.12, 0.05, 0.04), (-0.02, 0, height * 1.02)), 4)


def keyboard(a: Assembly) -> None:
    """Build a keyboard: rows of keys, space bar towards the user, optional number pad on the right, optional cable."""
    depth, width, thick, tilt = a.u(0.55, 0.8), a.u(1.6, 2.2), a.u(0.08, 0.16), a.u(0.03, 0.16)
    has_pad = a.chance(0.6)
    rise = depth * np.sin(tilt)

    def add_tilted(mesh: Mesh, material: int) -> None:
        a.add(mesh.rotated("y", tilt).translated((0, 0, (thick + rise) / 2)), material)

    add_tilted(rounded_box((depth, width, thick), squareness=a.u(8, 14)), 0)
    for y in (-0.4, 0.4):
        add_tilted(box((0.08, 0.2, rise), (-depth * 0.42, y * width, -thick / 2)), 4)  # a foot
    n_rows, n_keys = 5 + a.choice(2), 11 + a.choice(4)
    left, field = width * 0.46, width * (0.68 if has_pad else 0.92)
    row_depth, pitch, top = depth * 0.86 / n_rows, field / n_keys, thick / 2 + 0.02
    for row in range(n_rows):
        x = depth * 0.43 - (row + 0.5) * row_depth
        for key in range(n_keys):
            if row == 0 and 3 <= key < n_keys - 4:
                continue  # the space bar
            special = row == n_rows - 1 or key in (0, n_keys - 1)
            place = (x, left - (key + 0.5) * pitch, top)
            add_tilted(box((row_depth * 0.78, pitch * 0.8, 0.06), place), 2 if special else 1)
        for key in range(4 if has_pad and row < n_rows - 1 else 0):
            place = (x, left - field - width * 0.03 - (key + 0.5) * width * 0.05, top)
            add_tilted(box((row_depth * 0.78, width * 0.04, 0.06), place), 2 if key == 3 else 1)
    bar, front = (n_keys - 7) * pitch, depth * 0.43 - row_depth / 2
    add_tilted(box((row_depth * 0.78, bar * 0.97, 0.06), (front, left - 3 * pitch - bar / 2, top)), 3)
    if a.chance(0.4):
        add_tilted(rounded_box((a.u(0.2, 0.35), width * 0.94, thick * 0.7), (depth / 2 + 0.12, 0, -0.01)), 4)
    if a.chance(0.6):
        y = a.u(-0.3, 0.3) * width
        a.add(capsule((-depth * 0.47, y, thick), (-depth / 2 - a.u(0.1, 0.25), y + a.u(-0.1, 0.1), 0.05), 0.03), 6)


def remote(a: Assembly) -> None:
    """Build a remote control: power key and emitter at the front, ring in the middle, number keys behind."""
    length, width, thick = a.u(1.4, 2.0), a.u(0.38, 0.58), a.u(0.14, 0.26)
    body = rounded_box((thick, width, length), (0, 0, length / 2), a.u(4, 9))
    waist, top = a.u(0.8, 1.0), thick + 0.005
    body = tapered(body, length / 2, 0, waist).rotated("y", np.pi / 2)  # narrower behind
    a.add(body.translated((-length / 2, 0, thick / 2)), 0)
    a.add(ellipsoid((0.06, width * 0.2, thick * 0.3), (length / 2 - 0.02, 0, thick * 0.55)), 5)
    power_y = width * a.u(0.15, 0.28) * (1 if a.chance(0.7) else -1)
    a.add(cylinder(0.055, 0.05, 0.06).translated((length * 0.41, power_y, top)), 3)
    if a.chance(0.5):
        a.add(box((0.05, 0.12, 0.04), (length * 0.41, -power_y, top)), 2)
    ring_x, ring = length * a.u(0.08, 0.22), width * a.u(0.26, 0.34)
    if a.chance(0.7):
        a.add(torus(ring, 0.035, centre=(ring_x, 0, top)), 4)
    else:
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            a.add(box((0.09, 0.09, 0.06), (ring_x + ring * x, ring * y, top)), 4)
    a.add(cylinder(ring * 0.45, ring * 0.4, 0.06).translated((ring_x, 0, top)), 3)
    n_rows, round_keys, pitch = 3 + a.choice(3), a.chance(0.5), width * 0.27
    for row in range(n_rows):
        for column in (-1, 0, 1):
            key = cylinder(0.045, 0.04, 0.05) if round_keys else box((0.07, pitch * 0.7, 0.05))
            place = (ring_x - ring - 0.12 - row * length * 0.085, column * pitch * waist, top)
            a.add(key.translated(place), 1 if row < n_rows - 1 else 2)
    for column in (-1, 1) if a.chance(0.5) else (-1, 0, 1):
        a.add(box((0.06, pitch * 0.75, 0.05), (ring_x + ring + 0.11, column * pitch, top)), 2)


ELECTRONICS = (keyboard, laptop, mouse, remote)
