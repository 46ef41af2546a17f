"""Evaluation categories of computers and electronics (front +x, left +y, up +z)."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.evaluation_parts import Y, rounded_box
from zsp_lite.synthetic.primitives import Mesh, box, capsule, cylinder, ellipsoid, rod, torus


def laptop(a: Assembly) -> None:
    """Build a laptop: keys and touchpad on the base, towards the user at the front; opened by 80 to 130 degrees."""
    depth, width, thick = a.u(0.8, 1.1), a.u(1.2, 1.6), a.u(0.05, 0.1)
    a.add(rounded_box((depth, width, thick), (0, 0, thick / 2), 12), 0)
    top = thick
    n_rows, n_keys = 4 + a.choice(2), 9 + a.choice(4)
    field = depth * a.u(0.4, 0.5)
    field_front = depth / 2 - depth * a.u(0.36, 0.42)
    a.add(box((field * 1.06, width * 0.88, 0.01), (field_front - field / 2, 0, top)), 5)
    for row in range(n_rows):
        x = field_front - (row + 0.5) * field / n_rows
        for y in (np.arange(n_keys) + 0.5) / n_keys - 0.5:
            if row == 0 and abs(y) < 0.25:
                continue
            a.add(
                box((field / n_rows * 0.75, width * 0.85 / n_keys * 0.78, 0.03), (x, y * width * 0.85, top + 0.012)), 1
            )
    a.add(box((field / n_rows * 0.75, width * 0.42, 0.03), (field_front - 0.5 * field / n_rows, 0, top + 0.012)), 1)
    a.add(box((depth * 0.24, width * a.u(0.22, 0.36), 0.015), (depth / 2 - depth * 0.19, a.u(-0.08, 0.04), top)), 2)

    opening = a.u(np.radians(80), np.radians(130))
    lid, rim = depth * a.u(0.9, 1.02), a.u(0.04, 0.09)

    def add_to_lid(mesh: Mesh, material: int) -> None:
        # The part is given for the closed lid: the screen faces down, the hinge is at x = 0.
        a.add(mesh.rotated("y", -opening).translated((-depth / 2 + 0.03, 0, top + 0.02)), material)

    thin = thick * 0.6
    add_to_lid(rounded_box((lid, width, thin), (lid / 2, 0, thin / 2), 12), 0)
    add_to_lid(box((lid - 2 * rim, width - 2 * rim, 0.02), (lid / 2 + 0.01, 0, 0)), 4)
    add_to_lid(box((0.03, 0.03, 0.02), (lid - rim / 2, 0, -0.005)), 3)
    a.add(rod((-depth / 2 + 0.02, -width * 0.4, top), (-depth / 2 + 0.02, width * 0.4, top), 0.035), 3)
    logo = a.u(0.06, 0.12)
    add_to_lid(cylinder(logo, logo, 0.02, 16).translated((lid / 2, 0, thin)), 6)
    if a.chance(0.5):
        for x in (0.1, -0.15):
            a.add(box((0.12, 0.02, 0.03), (x, width / 2 - 0.005, thick / 2)), 3)


def mouse(a: Assembly) -> None:
    """Build a computer mouse: buttons and wheel at the front, optional cable, thumb rest on the left."""
    length, width, height = a.u(1.1, 1.5), a.u(0.65, 0.9), a.u(0.32, 0.55)
    shell = rounded_box((length, width, 2 * height), squareness=a.u(2.2, 3.5))
    lean = a.u(0.1, 0.4)
    vertices = shell.vertices.copy()
    vertices[:, 2] = np.maximum(vertices[:, 2], 0) * (1 - lean * (vertices[:, 0] / length + 0.1))
    a.add(Mesh(vertices, shell.faces), 0)
    a.add(shell.scaled((1.03, 1.03, 0.06)), 3)
    split = length * a.u(0.02, 0.12)
    for side in (1, -1):
        # A button is the front quarter of the shell, slightly raised.
        button = vertices * [1.02, 1.0, 1.06] + [0, 0, 0.015]
        button[:, 0] = np.maximum(button[:, 0], split)
        button[:, 1] = side * np.maximum(side * button[:, 1], 0.025)
        a.add(Mesh(button, shell.faces), 1)
    wheel_x = length * a.u(0.25, 0.33)
    wheel_z = height * 0.78
    a.add(torus(0.09, 0.045, Y, (wheel_x, 0, wheel_z), sides=16), 2)
    if a.chance(0.5):
        a.add(rounded_box((length * 0.5, 0.12, height * 0.3), (0.05, width * 0.46, height * 0.55), 4), 4)
    if a.chance(0.6):
        bend = np.array([length * 0.5 + a.u(0.15, 0.3), a.u(-0.15, 0.15), 0.05])
        a.add(capsule((length * 0.46, 0, height * 0.25), bend, 0.04, 0.03), 5)
        a.add(capsule(bend, bend + [a.u(0.1, 0.3), a.u(-0.3, 0.3), 0], 0.03), 5)
    if a.chance(0.5):
        a.add(box((0.12, 0.05, 0.04), (-0.02, 0, height * 1.02)), 4)


def keyboard(a: Assembly) -> None:
    """Build a keyboard: rows of keys, space bar towards the user, optional number pad on the right, optional cable."""
    depth, width, thick = a.u(0.55, 0.8), a.u(1.6, 2.2), a.u(0.08, 0.16)
    tilt = a.u(0.03, 0.16)
    has_pad = a.chance(0.6)

    def on_top(mesh, material: int) -> None:
        a.add(mesh.rotated("y", tilt).translated((0, 0, thick / 2 + depth / 2 * np.sin(tilt))), material)

    on_top(rounded_box((depth, width, thick), squareness=a.u(8, 14)), 0)
    on_top(box((0.08, 0.2, depth * np.sin(tilt)), (-depth * 0.42, width * 0.4, -thick / 2)), 4)
    on_top(box((0.08, 0.2, depth * np.sin(tilt)), (-depth * 0.42, -width * 0.4, -thick / 2)), 4)
    field = width * (0.68 if has_pad else 0.92)
    left = width * 0.46
    n_rows, n_keys = 4 + a.choice(2), 11 + a.choice(4)
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
            on_top(box((row_depth * 0.78, bar * 0.97, 0.06), (x, left - 3 * pitch - bar / 2, thick / 2 + 0.02)), 3)
    if has_pad:
        pad_left = left - field - width * 0.03
        for row in range(n_rows):
            for key in range(4):
                at = (depth * 0.43 - (row + 0.5) * row_depth, pad_left - (key + 0.5) * width * 0.05, thick / 2 + 0.02)
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
    """Build a remote control: power key and emitter at the front, ring in the middle, number keys behind."""
    length, width, thick = a.u(1.4, 2.0), a.u(0.38, 0.58), a.u(0.14, 0.26)
    waist = a.u(0.8, 1.0)
    body = rounded_box((length, width, thick), (0, 0, thick / 2), a.u(4, 9))
    vertices = body.vertices.copy()
    vertices[:, 1] *= 1 + (waist - 1) * np.clip(0.5 - vertices[:, 0] / length, 0, 1)
    a.add(type(body)(vertices, body.faces), 0)
    top = thick + 0.005
    a.add(ellipsoid((0.06, width * 0.2, thick * 0.3), (length / 2 - 0.02, 0, thick * 0.55)), 5)
    power_y = width * a.u(0.15, 0.28) * (1 if a.chance(0.7) else -1)
    a.add(cylinder(0.055, 0.05, 0.06).translated((length * 0.41, power_y, top)), 3)
    if a.chance(0.5):
        a.add(box((0.05, 0.12, 0.04), (length * 0.41, -power_y, top)), 2)
    ring_x, ring = length * a.u(0.08, 0.22), width * a.u(0.26, 0.34)
    if a.chance(0.7):
        a.add(torus(ring, 0.035, centre=(ring_x, 0, top)), 4)
        a.add(cylinder(ring * 0.45, ring * 0.4, 0.06).translated((ring_x, 0, top)), 3)
    else:
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            a.add(box((0.09, 0.09, 0.06), (ring_x + ring * x, ring * y, top)), 4)
        a.add(cylinder(0.05, 0.05, 0.06).translated((ring_x, 0, top)), 3)
    pitch = width * 0.27
    rows = 3 + a.choice(3)
    round_keys = a.chance(0.5)
    for row in range(rows):
        for column in (-1, 0, 1):
            x = ring_x - ring - 0.12 - row * length * 0.085
            key = cylinder(0.045, 0.04, 0.05) if round_keys else box((0.07, pitch * 0.7, 0.05))
            a.add(key.translated((x, column * pitch * waist, top)), 1 if row < rows - 1 else 2)
    for x in (ring_x + ring + 0.11,):
        for column in (-1, 1) if a.chance(0.5) else (-1, 0, 1):
            a.add(box((0.06, pitch * 0.75, 0.05), (x, column * pitch, top)), 2)
    if a.chance(0.5):
        a.add(box((0.06, width * 0.4, 0.015), (-length * 0.44, 0, top)), 6)
