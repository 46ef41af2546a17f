"""Depth and poses of a few frames that agree, and each usual mistake, which is named."""

import re
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_views import ELSEWHERE, look_at, render

from zsp_lite import Frame
from zsp_lite.importers.agreement import disagreement

FLIP = np.diag([1.0, -1, -1, 1])


def views(focal: float, nearer: float = 1.0) -> list[Frame]:
    turns = np.radians([0, 25, 50, 75])
    directions = np.column_stack([np.cos(turns), np.sin(turns), [0.3, 0.5, 0.2, 0.6]])
    return [
        render(look_at(one, distance / nearer, focal=focal), ELSEWHERE, f"{k}")
        for k, (one, distance) in enumerate(zip(directions, (3.5, 4.0, 4.6, 4.2)))
    ]


@pytest.fixture(scope="module")
def frames():
    return views(190.0)


def posed(frame, to_camera) -> Frame:
    return replace(frame, camera=replace(frame.camera, R=to_camera[:3, :3], t=to_camera[:3, 3]))


def inverted(frame):
    return posed(frame, np.linalg.inv(frame.camera.matrix))


def flipped(frame):
    return posed(frame, FLIP @ frame.camera.matrix)


def reordered(frame):
    """The pose if a quaternion w, x, y, z is read as x, y, z, w."""
    to_world = np.linalg.inv(frame.camera.matrix)
    x, y, z, w = Rotation.from_matrix(to_world[:3, :3]).as_quat()
    to_world[:3, :3] = Rotation.from_quat([w, x, y, z]).as_matrix()
    return posed(frame, np.linalg.inv(to_world))


def scaled(factor, frame):
    return replace(frame, depth=frame.depth * np.float32(factor))


def along_ray(frame):
    height, width = frame.camera.size
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    lengths = np.linalg.norm(
        frame.camera.unproject_camera(pixels, np.ones((height, width))), axis=-1
    )
    return replace(frame, depth=(frame.depth * lengths).astype(np.float32))


def farther(frame):
    """Every other camera is at another distance."""
    return replace(
        frame, camera=replace(frame.camera, t=frame.camera.t * (1, 1, 1 + int(frame.name) % 2 / 2))
    )


@pytest.mark.parametrize(
    "mistake, named",
    [
        (inverted, r"agree \(\d+%\) if the poses are world to camera$"),
        (flipped, "if the poses have the other axes, OpenGL's for OpenCV's or the reverse"),
        (lambda frame: inverted(flipped(frame)), "if the poses are world to camera$"),
        (reordered, "if the poses are from quaternions with w first"),
        (partial(scaled, 0.001), r"if the depth is taken in metres: --depth-unit 1$"),
        (partial(scaled, 5), "if the depth is taken in 1/5000 m: --depth-unit 0.0002$"),
        (partial(scaled, 1000), "if the depth is multiplied by 0.001: --depth-unit 1e-06$"),
        (partial(scaled, 1.8), "if the depth is multiplied by 0.5[2-9]"),
        (farther, "no usual mistake in units or poses explains it"),
    ],
)
def test_each_mistake_is_named(frames, mistake, named):
    line = disagreement([mistake(frame) for frame in frames], 0.001)
    assert re.search(named, line)


def test_right_frames_agree(frames):
    assert disagreement(frames, 0.001) == ""


def test_depth_along_the_ray_is_named():
    assert re.search(
        "if depth is the distance along the ray of a pixel",
        disagreement(map(along_ray, views(45.0, 1.6)), 0.001),
    )


def test_positions_of_another_unit_are_named_where_the_depth_is_plausible(frames):
    wrong = [
        replace(frame, camera=replace(frame.camera, t=1000 * frame.camera.t)) for frame in frames
    ]
    assert "if the positions of the cameras are multiplied by 0.001" in disagreement(wrong, 0.001)


def test_a_small_error_of_scale_is_given_by_its_number(frames):
    line = disagreement([scaled(1.3, frame) for frame in frames], 0.001)
    assert 0.72 < float(re.search(r"multiplied by ([\d.]+)", line)[1]) < 0.82
