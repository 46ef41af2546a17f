"""Pixels on the object under a soft mask, and the two measures of the spread of points."""

import numpy as np
import pytest
from co3d_folders import random_camera

from zsp_lite.data.frames import Frame
from zsp_lite.points import axis_deviation, object_pixels, object_points, standard_deviation

MASK = np.array([[0.0, 0.5, 0.55, 0.85, 1.0, 1.0]], np.float32)
DEPTH = np.array([[2.0, 2.0, 2.0, 2.0, 2.0, 0.0]], np.float32)


def soft_frame(mask):
    return Frame(np.zeros((1, 6, 3), np.uint8), DEPTH, mask, random_camera(0, (1, 6)))


def test_a_pixel_is_on_the_object_if_that_is_more_probable_than_not_and_its_depth_is_known():
    assert object_pixels(soft_frame(MASK)).tolist() == [[False, False, True, True, True, False]]
    assert len(object_points(soft_frame(MASK))) == 3
    assert object_pixels(soft_frame(MASK), 0.9).tolist() == [[False, False, False, False, True, False]]
    assert object_pixels(soft_frame(None)).tolist() == (DEPTH > 0).tolist()
    assert "mask above 0.5 at 67%" in repr(soft_frame(MASK))


def test_the_two_spreads_average_deviations_and_variances_of_the_axes():
    points = np.array([[1, 2, 3], [-1, -2, -3], [1, -2, 3], [-1, 2, -3]]) + 7.0
    assert axis_deviation(points) == pytest.approx(2)
    assert standard_deviation(points) == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
