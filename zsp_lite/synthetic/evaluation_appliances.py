"""Evaluation categories with a plug or a battery. Each builds one object: front +x, up +z, left +y."""

import numpy as np

from zsp_lite.synthetic.assembly import Assembly
from zsp_lite.synthetic.evaluation_parts import Y, rounded_box
from zsp_lite.synthetic.primitives import Mesh, box, capsule, cylinder, extrusion, lathe, rod, torus


def hairdryer(a: Assembly) -> None:
    """Barrel, nozzle or diffuser at the front, grille at the back, handle below with switches."""
    length, radius = a.u(0.9, 1.3), a.u(0.22, 0.34)
    mouth = radius * a.u(0.55, 0.85)
    profile = [
        [0.001, -length * 0.42],
        [radius * 0.7, -length * 0.43],
        [radius, -length * 0.3],
        [radius, 0],
        [mouth, length * 0.58],
        [0.001, length * 0.58],
    ]
    a.add(lathe(profile, 24).turned("y", np.pi / 2), 0)
    front = np.array([length * 0.57, 0, 0])
    style = a.pick(3)
    if style == 0:
        a.add(rod(front, front + [a.u(0.12, 0.3), 0, 0], mouth * 1.03, mouth * a.u(0.6, 0.95)), 1)
    elif style == 1:
        # A concentrator flattens towards its slot.
        reach = a.u(0.25, 0.4)
        cone = cylinder(mouth, mouth, reach, 20).moved((0, 0, reach / 2))
        share = cone.vertices[:, 2:] / reach
        slot = 1 + share * (np.array([a.u(0.25, 0.45), a.u(1.0, 1.5), 1]) - 1)
        a.add(
            Mesh(cone.vertices * np.where(np.arange(3) == 2, 1, slot), cone.faces).turned("y", np.pi / 2).moved(front),
            1,
        )
    else:
        reach = a.u(0.2, 0.3)
        bowl = [
            [mouth * 0.9, 0],
            [mouth * 1.05, reach * 0.3],
            [radius * 1.4, reach],
            [radius * 1.3, reach],
            [0.001, reach * 0.8],
        ]
        a.add(lathe(bowl, 24).turned("y", np.pi / 2).moved(front), 1)
    a.add(torus(radius * 0.68, 0.035, (1, 0, 0), (-length * 0.42, 0, 0)), 3)
    for y in (-0.4, 0, 0.4):
        a.add(box((0.03, 0.03, radius * 1.1), (-length * 0.435, y * radius, 0)), 3)
    drop, rake = a.u(0.7, 1.1), a.u(-0.25, 0.15)
    top, bottom = np.array([-0.08, 0, -radius * 0.5]), np.array([-0.08 + rake, 0, -drop])
    a.add(capsule(top, bottom, a.u(0.11, 0.16), a.u(0.09, 0.13)), 0 if a.chance(0.5) else 2)
    switch = top + (bottom - top) * a.u(0.35, 0.6)
    a.add(box((0.06, 0.1, 0.22), switch + [0.13, 0, 0]), 3)
    if a.chance(0.5):
        a.add(box((0.05, 0.08, 0.08), switch + [0.13, 0, 0.2]), 5)
    if a.chance(0.5):
        a.add(torus(radius * 1.02, 0.02, (1, 0, 0), (-length * 0.1, 0, 0)), 4)
    tail = bottom + [-a.u(0.1, 0.35), a.u(-0.2, 0.2), -0.3]
    a.add(capsule(bottom - [0, 0, 0.08], tail, 0.035, 0.025), 3)


def toaster(a: Assembly) -> None:
    """Two or four slots; lever, dial and buttons at the front end; nearly symmetric otherwise."""
    length, width, height = a.u(1.0, 1.6), a.u(0.55, 0.85), a.u(0.65, 0.95)
    feet = a.u(0.03, 0.08)
    middle = feet + height / 2
    style = a.pick(3)
    if style == 0:
        a.add(rounded_box((length, width, height), (0, 0, middle), a.u(4, 9)), 0)
    elif style == 1:
        # A retro shell: arched across, with flat cheeks of another material at both ends.
        angle = np.linspace(0, np.pi, 13)
        arch = np.stack(
            [
                width / 2 * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.6,
                feet + height * (0.35 + 0.65 * np.sin(angle) ** 0.6),
            ],
            1,
        )
        arch = np.concatenate([[[width / 2, feet]], arch, [[-width / 2, feet]]])
        a.add(extrusion(arch, length * 0.84, "yz"), 0)
        for end in (-1, 1):
            cheek = (arch - [0, middle]) * [1.03, 1.02] + [0, middle]
            a.add(extrusion(cheek, length * 0.09, "yz", end * length * 0.455), 1)
    else:
        a.add(box((length * 0.96, width, height), (0, 0, middle)), 0)
        a.add(box((length, width * 0.86, height * 0.9), (0, 0, middle)), 1)
    top = feet + height
    a.add(box((length * 0.8, width * 0.78, 0.03), (0, 0, top)), 2)
    rows = (-0.22, 0.22) if a.chance(0.75) else (0.0,)
    halves = (-0.21, 0.21) if length > 1.35 and a.chance(0.6) else (0.0,)
    slot = length * (0.34 if len(halves) == 2 else 0.66)
    toasting = a.chance(0.3)
    for y in rows:
        for x in halves:
            a.add(box((slot, 0.1, 0.02), (x * length, y * width, top + 0.016)), 3)
            if toasting:
                a.add(rounded_box((slot * 0.9, 0.07, 0.5), (x * length, y * width, top + a.u(-0.12, 0.0)), 6), 6)

    end = length / 2
    travel = a.u(0.25, 0.45) * height
    lever_height = middle + a.u(-0.1, 0.25) * height
    a.add(box((0.02, 0.05, travel), (end, 0, middle + 0.05)), 3)
    a.add(rounded_box((0.16, a.u(0.14, 0.3), 0.08), (end + 0.07, 0, lever_height), 4), 4)
    knob_y = a.u(0.18, 0.28) * width
    a.add(
        rod(
            (end - 0.03, knob_y, feet + height * 0.25),
            (end + 0.07, knob_y, feet + height * 0.25),
            a.u(0.06, 0.1),
        ),
        5,
    )
    for k in range(1 + a.pick(3)):
        a.add(
            rod(
                (end - 0.03, -knob_y, feet + height * (0.2 + 0.14 * k)),
                (end + 0.04, -knob_y, feet + height * (0.2 + 0.14 * k)),
                0.035,
            ),
            5,
        )
    for x in (-0.36, 0.36):
        a.add(cylinder(0.06, 0.07, feet * 2).moved((x * length, width * 0.32, feet / 2)), 3, mirror=True)
    if a.chance(0.6):
        a.add(capsule((-end + 0.02, 0.1, feet + 0.1), (-end - a.u(0.1, 0.25), a.u(-0.2, 0.2), 0.03), 0.025), 3)
    if a.chance(0.4):
        a.add(box((length * 0.8, width * 1.02, height * 0.08), (0, 0, feet + height * 0.12)), 7)


def laptop(a: Assembly) -> None:
    """Base with keys and touchpad towards the user at the front; the screen opens at 80 to 130 degrees."""
    depth, width, thick = a.u(0.8, 1.1), a.u(1.2, 1.6), a.u(0.05, 0.1)
    a.add(rounded_box((depth, width, thick), (0, 0, thick / 2), 12), 0)
    top = thick
    n_rows, n_keys = 4 + a.pick(2), 9 + a.pick(4)
    field = depth * a.u(0.4, 0.5)
    field_front = depth / 2 - depth * a.u(0.36, 0.42)
    a.add(box((field * 1.06, width * 0.88, 0.01), (field_front - field / 2, 0, top)), 5)
    for row in range(n_rows):
        x = field_front - (row + 0.5) * field / n_rows
        for y in (np.arange(n_keys) + 0.5) / n_keys - 0.5:
            if row == 0 and abs(y) < 0.25:
                continue
            a.add(
                box(
                    (field / n_rows * 0.75, width * 0.85 / n_keys * 0.78, 0.03),
                    (x, y * width * 0.85, top + 0.012),
                ),
                1,
            )
    a.add(
        box((field / n_rows * 0.75, width * 0.42, 0.03), (field_front - 0.5 * field / n_rows, 0, top + 0.012)),
        1,
    )
    a.add(
        box((depth * 0.24, width * a.u(0.22, 0.36), 0.015), (depth / 2 - depth * 0.19, a.u(-0.08, 0.04), top)),
        2,
    )

    opening = a.u(np.radians(80), np.radians(130))
    lid, rim = depth * a.u(0.9, 1.02), a.u(0.04, 0.09)

    def add_to_lid(mesh: Mesh, material: int) -> None:
        # Built closed: the lid's inside looks down, its hinge lies at x = 0.
        a.add(mesh.turned("y", -opening).moved((-depth / 2 + 0.03, 0, top + 0.02)), material)

    thin = thick * 0.6
    add_to_lid(rounded_box((lid, width, thin), (lid / 2, 0, thin / 2), 12), 0)
    add_to_lid(box((lid - 2 * rim, width - 2 * rim, 0.02), (lid / 2 + 0.01, 0, 0)), 4)
    add_to_lid(box((0.03, 0.03, 0.02), (lid - rim / 2, 0, -0.005)), 3)
    a.add(rod((-depth / 2 + 0.02, -width * 0.4, top), (-depth / 2 + 0.02, width * 0.4, top), 0.035), 3)
    logo = a.u(0.06, 0.12)
    add_to_lid(cylinder(logo, logo, 0.02, 16).moved((lid / 2, 0, thin)), 6)
    if a.chance(0.5):
        for x in (0.1, -0.15):
            a.add(box((0.12, 0.02, 0.03), (x, width / 2 - 0.005, thick / 2)), 3)


def mouse(a: Assembly) -> None:
    """Buttons and wheel at the front, cable or none, thumb rest on the left."""
    length, width, height = a.u(1.1, 1.5), a.u(0.65, 0.9), a.u(0.32, 0.55)
    shell = rounded_box((length, width, 2 * height), squareness=a.u(2.2, 3.5))
    lean = a.u(0.1, 0.4)
    vertices = shell.vertices.copy()
    vertices[:, 2] = np.maximum(vertices[:, 2], 0) * (1 - lean * (vertices[:, 0] / length + 0.1))
    a.add(Mesh(vertices, shell.faces), 0)
    a.add(shell.scaled((1.03, 1.03, 0.06)), 3)
    split = length * a.u(0.02, 0.12)
    for side in (1, -1):
        # A button is the front quarter of the shell, lifted a little.
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
