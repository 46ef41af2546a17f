"""Figures draw what they are given where it belongs: pixels, projections, orientations, signs,
counts and intervals."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from zsp_lite import Camera
from zsp_lite.course.view_circle import show_view_circle
from zsp_lite.viz import plots

GRID = (3, 4)  # patches of 20 x 20 pixels
IMAGE = np.zeros((60, 80, 3), np.uint8)
pytestmark = pytest.mark.usefixtures("closed_figures")
CAMERA = Camera(np.eye(3), np.zeros(3), np.array([100.0, 100.0]), np.array([40.0, 30.0]), (60, 80))


def test_patches_of_maps_are_marked_at_their_centres():
    (axis,) = plots.show_maps([IMAGE], {"key": np.zeros(GRID)}).axes
    lines = [*plots.circle_patch(axis, (2, 1), GRID), *plots.circle_patch(axis, (1, 3), GRID, "*")]
    marks = [(line.get_marker(), *line.get_xydata()[0]) for line in lines]
    assert marks == [("o", 30, 50), ("*", 70, 30)]  # x and y of (row, column)


def test_lines_join_the_centres_of_matched_patches_and_those_of_outliers_are_dashed():
    cells = np.array([[0, 0], [1, 1], [2, 3]])
    figure = plots.show_matches(
        [IMAGE, IMAGE], [cells, cells[::-1]], GRID, np.array([True, False, True])
    )
    lines = {(tuple(line.xy1), tuple(line.xy2)): line.get_linestyle() for line in figure.artists}
    # Outliers are drawn first, so that they lie below; their match here is the middle one.
    outlier, *inliers = lines
    assert outlier == ((30, 30), (30, 30))
    assert set(inliers) == {((10, 10), (70, 50)), ((70, 50), (10, 10))}
    assert [line in ("-", "solid") for line in lines.values()] == [False, True, True]


def test_the_view_with_the_best_score_is_marked_and_has_a_thumbnail():
    turns = np.array([-170.0, -90, 5, 20, 90, 150])
    scores = np.array([-20.0, -40, -30, -32, -41, -25])
    circle, *thumbnails, _ = show_view_circle(IMAGE, [IMAGE] * 6, turns, scores).axes
    assert_allclose(circle.lines[1].get_xydata(), [[np.radians(-170), -20]])
    # Every third view in the order of the turns, from the best one.
    assert [axis.get_title() for axis in thumbnails] == ["-20.0", "-32.0"]
    assert thumbnails[0].texts[0].get_text() == "wins"


@pytest.fixture
def axis():
    """The axes of a picture of `IMAGE`."""
    _, (axis,) = plots.show_images([IMAGE])
    return axis


def test_points_are_drawn_where_they_project_unless_behind_the_camera(axis):
    # The first point is 0.1 to the right at depth 1: 10 pixels right of the principal point.
    points = np.array([[0.1, 0, 1], [0, 0, 2], [0, 0, -1]])
    plots.draw_points(axis, CAMERA, points, colours=np.eye(3))
    assert_allclose(axis.collections[0].get_offsets(), [[40, 30], [50, 30]])
    # The picture keeps its limits, with y down.
    assert axis.get_xlim() == (0, 80)
    assert axis.get_ylim() == (60, 0)


def test_axes_are_named_where_their_ends_project_unless_behind_the_camera(axis):
    ends = np.array([[0.2, 0, 2], [0, 0.2, 2], [0, 0, -1]])
    plots.draw_axes(axis, CAMERA, np.array([0, 0, 2]), ends, "xyz")
    places = {text.get_text(): text.get_position() for text in axis.texts if text.get_text()}
    assert places == {"x": pytest.approx((50, 30)), "y": pytest.approx((40, 40))}
