"""The best-view widget selects the view with the best score of those offered."""

import numpy as np
import pytest
from matplotlib import pyplot as plt

from zsp_lite.best_view import VIEW_SELECTORS
from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError

pytest.importorskip("ipywidgets", reason="widgets are an optional extra: pip install 'zsp-lite[notebooks]'")

from tools import widget_examples as examples
from zsp_lite.widgets import views
from zsp_lite.widgets.views import best_view, evenly_spaced, match_canvas, viewpoints_from_above

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def example():
    """The widget of the example, and its arguments."""
    passed = {}

    def spy(reference, targets, pairs, positions, angles):
        passed.update(reference=reference, targets=targets, pairs=pairs, positions=positions, angles=angles)
        return best_view(**passed)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(views, "best_view", spy)
        widget = examples.best_view()
    yield widget, passed
    plt.close("all")


def camera_at(degrees, tilt=0.3):
    """A camera on a circle around the origin, looking at it; +z of the world is up."""
    turn = np.radians(degrees)
    centre = 5 * np.array([np.cos(turn), np.sin(turn), tilt])
    forward = -centre / np.linalg.norm(centre)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return Camera(R, -R @ centre, np.full(2, 100.0), np.full(2, 50.0), (100, 100))


@pytest.mark.parametrize("score", VIEW_SELECTORS)
def test_the_caption_names_the_view_with_the_best_score_of_those_offered(example, score):
    widget, passed = example
    values = np.array([VIEW_SELECTORS[score](one) for one in passed["pairs"]])
    widget.controls["score"].value = score
    for count, first in ((4, 1), (2, 2), (1, 3)):
        widget.controls["views"].value, widget.controls["first"].value = count, first
        offered = [(first - 1 + i * 4 // count) % 4 for i in range(count)]
        best = max(offered, key=lambda i: values[i])
        assert f"selects view {best + 1}, {passed['angles'][best]:.0f}°" in widget.caption.value
    widget.controls["score"].value, widget.controls["views"].value, widget.controls["first"].value = "correspond", 4, 1


def test_a_control_redraws_the_figure_and_going_back_restores_it(example):
    widget, _ = example
    before = widget.picture.value
    widget.controls["views"].value = 1
    assert widget.picture.value != before
    widget.controls["views"].value = 4
    assert widget.picture.value == before


def test_too_few_angles_are_an_input_error(example):
    _, passed = example
    with pytest.raises(InputError, match="3 angles, expected equal numbers"):
        best_view(**passed | {"angles": passed["angles"][:3]})


def test_cameras_on_a_circle_are_on_a_circle_from_above():
    degrees = np.arange(0, 360, 45)
    ring, other = viewpoints_from_above([camera_at(d) for d in degrees], camera_at(20, tilt=0.8).centre[None])
    turns = np.degrees(np.unwrap(np.arctan2(*ring.T[::-1])))
    # Counter-clockwise in the world is counter-clockwise in the plot, for any axes of the plane.
    assert np.allclose(np.diff(turns), 45)
    assert np.allclose(np.linalg.norm(ring, axis=1), 1)
    from_first = np.degrees(np.arctan2(*other[0][::-1])) - turns[0]
    assert np.isclose((from_first + 180) % 360 - 180, 20)


def test_cameras_on_a_line_are_an_input_error():
    one = camera_at(0)
    places = [one.t + np.array([step, 0, 0]) for step in range(5)]
    cameras = [Camera(one.R, place, one.focal_length, one.principal_point, one.size) for place in places]
    with pytest.raises(InputError, match="5 camera centres"):
        viewpoints_from_above(cameras, np.zeros((1, 3)))
    with pytest.raises(InputError, match="2 camera centres"):
        viewpoints_from_above(cameras[:2], np.zeros((1, 3)))


def test_views_are_evenly_spaced_on_a_ring():
    assert evenly_spaced(24, 5, 0).tolist() == [0, 4, 9, 14, 19]
    assert evenly_spaced(6, 3, 5).tolist() == [5, 1, 3]


def test_lines_end_in_the_second_image_and_outliers_have_their_own_lines():
    _, axis = plt.subplots()
    canvas = match_canvas(axis, np.zeros((10, 20, 3)), np.zeros((10, 20, 3)), ("a", "b"))
    canvas.draw(np.array([[1, 2], [3, 4]]), np.array([[5, 6], [7, 8]]), np.array([True, False]))
    (inlier,), (outlier,) = canvas.inliers.get_segments(), canvas.outliers.get_segments()
    assert inlier.tolist() == [[1, 2], [5 + canvas.offset, 6]]
    assert outlier.tolist() == [[3, 4], [7 + canvas.offset, 8]]
    assert canvas.offset > 20
    plt.close("all")


def test_images_of_different_sizes_are_an_input_error():
    _, axis = plt.subplots()
    with pytest.raises(InputError, match="expected equal"):
        match_canvas(axis, np.zeros((10, 20, 3)), np.zeros((20, 10, 3)), ("a", "b"))
    plt.close("all")
