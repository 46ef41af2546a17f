"""Figures draw what they are given where it belongs: pixels, projections, orientations, signs,
counts and intervals."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from zsp_lite import Camera
from zsp_lite.verified.scene import Projection
from zsp_lite.verified.verification import MAX_VIOLATION, SURFACE_SIGMA, PointTerms
from zsp_lite.viz import plots, point_classes

IMAGE = np.zeros((60, 80, 3), np.uint8)
pytestmark = pytest.mark.usefixtures("closed_figures")
CAMERA = Camera(np.eye(3), np.zeros(3), np.array([100.0, 100.0]), np.array([40.0, 30.0]), (60, 80))


def test_patches_are_marked_at_their_centres_in_pixels_x_y():
    centres = plots.patch_centres(np.array([[0, 0], [2, 3]]), (3, 4), (60, 80))
    assert_allclose(centres, [[10, 10], [70, 50]])
    similar = np.zeros((3, 4))
    similar[2, 1] = 0.9
    maps, circles = {"this patch": None, "key": similar}, [(0, 0), (2, 1)]
    first, second = plots.show_maps(
        [IMAGE, IMAGE], maps, circles=circles, stars=[None, (1, 3)]
    ).axes
    marks = [
        (line.get_marker(), *line.get_xydata()[0])
        for axis in (first, second)
        for line in axis.lines
    ]
    assert marks == [("o", 10, 10), ("o", 30, 50), ("*", 70, 30)]


def test_lines_join_the_centres_of_matched_patches_and_those_of_outliers_are_dashed():
    cells = np.array([[0, 0], [1, 1], [2, 3]])
    figure = plots.show_matches(
        [IMAGE, IMAGE], [cells, cells[::-1]], (3, 4), np.array([True, False, True])
    )
    lines = {(tuple(line.xy1), tuple(line.xy2)): line.get_linestyle() for line in figure.artists}
    assert set(lines) == {((10, 10), (70, 50)), ((30, 30), (30, 30)), ((70, 50), (10, 10))}
    # outliers first, below
    assert [line in ("-", "solid") for line in lines.values()] == [
        False,
        True,
        True,
    ]


def test_points_and_axes_are_drawn_where_they_project_unless_behind_the_camera():
    _, (axis,) = plots.show_images([IMAGE])
    # With focal length 100 and principal point (40, 30), (0.1, 0, 1) is 10 pixels to the right of
    # the latter.
    plots.draw_points(axis, CAMERA, np.array([[0.1, 0, 1], [0, 0, 2], [0, 0, -1]]))
    assert_allclose(axis.collections[0].get_offsets(), [[40, 30], [50, 30]])
    assert axis.get_xlim() == (0, 80)
    assert axis.get_ylim() == (60, 0)
    plots.draw_axes(
        axis, CAMERA, np.array([0, 0, 2]), np.array([[0.2, 0, 2], [0, 0.2, 2], [0, 0, -1]]), "xyz"
    )
    at = {text.get_text(): text.get_position() for text in axis.texts if text.get_text()}
    assert at == {"x": pytest.approx((50, 30)), "y": pytest.approx((40, 40))}


def test_each_kind_of_point_is_told_from_the_others_and_drawn_where_it_projects():
    # Points: on the surface, far behind it, far before it, outside the silhouette, over a hole in
    # the depth.
    behind, weight = torch.tensor([0.0, 1, -1, 0, 0]), torch.tensor([1.0, 1, 1, 0, 0])
    off = torch.tensor([0.0, 0, 0, 0.4, 0])
    pixels = torch.tensor([[10.0, 5], [20, 5], [30, 5], [55, 5], [20, 20]])
    parts = (3 + behind, torch.full((5,), 3.0), weight, off, torch.arange(5), pixels)
    touch = weight * torch.exp(-(behind**2) / (2 * SURFACE_SIGMA**2))
    front = weight * (-(behind + SURFACE_SIGMA) / MAX_VIOLATION).clamp(0, 1)
    values = (touch, off / MAX_VIOLATION, front, torch.zeros(5))
    terms = PointTerms(
        Projection(*(x[None, None] for x in parts)), *(x[None, None] for x in values)
    )
    assert point_classes.classify_points(terms).tolist() == [[0, 1, 2, 3, 4]]
    assert list(point_classes.POINT_CLASSES)[2:4] == ["in free space", "outside the silhouette"]
    figure = point_classes.show_point_classes(
        [IMAGE], ["view"], [2 * pixels.numpy()], [*point_classes.classify_points(terms)]
    )
    drawn = np.concatenate([collection.get_offsets() for collection in figure.axes[0].collections])
    # The point beyond the border (110) stands at it (80).
    assert_allclose(sorted(map(tuple, drawn)), [(20, 10), (40, 10), (40, 40), (60, 10), (80, 10)])
