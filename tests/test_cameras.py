"""Cameras: projection, formats of others, the span of several."""

import numpy as np
import pytest
from co3d_folders import random_camera, seeds
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from refusals import refused
from synthetic_views import level_camera

from zsp_lite.data.azimuths import view_span
from zsp_lite.data.cameras import Camera

FORMATS = ["ndc_norm_image_bounds", "ndc_isotropic"]


@given(seeds, st.sampled_from(FORMATS))
def test_projection_agrees_with_pytorch3ds_own_row_vector_formula(seed, intrinsics_format):
    camera = random_camera(seed)
    in_camera = np.random.default_rng(seed).uniform([-2, -2, 0.5], [2, 2, 8], (20, 3))
    points = camera.to_world(in_camera)
    other = camera.to_pytorch3d(intrinsics_format)
    row = points @ other["R"] + other["T"]
    ndc = other["focal_length"] * row[:, :2] / row[:, 2:] + other["principal_point"]
    height, width = camera.size
    per_ndc = (
        np.array([width, height]) / 2 if intrinsics_format == FORMATS[0] else min(height, width) / 2
    )
    pixels, depth = camera.project(points)
    assert_allclose(pixels, np.array([width, height]) / 2 - ndc * per_ndc, rtol=1e-9, atol=1e-7)
    assert_allclose(depth, row[:, 2], rtol=1e-9)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"R": np.eye(2)}, r"R has shape \(2, 2\)"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "expected a rotation"),
        ({"t": [0, 0, 1e155]}, r"t holds 1e\+155"),  # its square is not finite
        ({"focal_length": [500, 0]}, "focal_length is .*0.0.*, expected .*greater than 0.001"),
        ({"size": (0, 5)}, "image size .* is 0, expected an integer from 1"),
    ],
)
def test_invalid_cameras_are_refused(changes, message):
    valid = {
        "R": np.eye(3),
        "t": [0, 0, 2],
        "focal_length": [500, 500],
        "principal_point": [32, 24],
        "size": (48, 64),
    }
    refused(message, lambda: Camera(**(valid | changes)))


@pytest.mark.parametrize("roll", [0, 1])  # quarter turns of the images
def test_the_span_of_views_is_that_around_the_object(roll):
    def span(*angles):
        return view_span(
            [level_camera(*angle).turn(roll) for angle in angles], np.array([1.0, 2, 3])
        )

    assert span((40, 20)) == pytest.approx(0, abs=1e-5)
    assert span(*((az, 0) for az in range(0, 73, 18))) == pytest.approx(72)
    for height in (0, 30, 60):
        assert span(*((az, height) for az in range(0, 360, 72))) == pytest.approx(288)  # 4 x 72
    assert 15 < span((0, 60), (20, 60), (40, 60)) < 40  # a cluster above is one side, too
    # a view from the top does not show the back
    assert span((0, 20), (20, 25), (40, 15), (180, 85)) < 60
    assert span(*((az, 75) for az in range(0, 360, 72))) < 60
