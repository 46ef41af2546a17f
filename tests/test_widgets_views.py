"""The best-view widget: what it chooses is the best score's view among those offered, and it draws that view."""

import numpy as np
import pytest
from matplotlib import pyplot as plt

from zsp_lite.best_view import VIEW_SELECTORS
from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError

pytest.importorskip("ipywidgets", reason="widgets are an optional extra: pip install 'zsp-lite[notebooks]'")

from zsp_lite.widgets import views
from zsp_lite.widgets.views import around, best_view, evenly, match_canvas


@pytest.fixture(scope="module")
def example():
    """The arguments that the example passes, and the widget that it makes of them."""
    passed = {}

    def spy(reference, targets, comparisons, places, angles):
        passed.update(reference=reference, targets=targets, comparisons=comparisons, places=places, angles=angles)
        return best_view(**passed)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(views, "best_view", spy)
        widget = views.example_best_view()
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
def test_the_sentence_names_the_view_with_the_best_score_of_those_offered(example, score):
    widget, passed = example
    values = np.array([VIEW_SELECTORS[score](one) for one in passed["comparisons"]])
    widget.controls["score"].value = score
    for count, first in ((4, 1), (2, 2), (1, 3)):
        widget.controls["views"].value, widget.controls["first"].value = count, first
        offered = [(first - 1 + i * 4 // count) % 4 for i in range(count)]
        best = max(offered, key=lambda i: values[i])
        assert f"chooses view {best + 1}, {passed['angles'][best]:.0f}°" in widget.sentence.value
    widget.controls["score"].value, widget.controls["views"].value, widget.controls["first"].value = "correspond", 4, 1


def test_another_choice_changes_the_picture_and_going_back_restores_it(example):
    widget, _ = example
    before = widget.picture.value
    widget.controls["views"].value = 1
    assert widget.picture.value != before
    widget.controls["views"].value = 4
    assert widget.picture.value == before


def test_as_many_angles_as_targets_are_asked_for(example):
    _, passed = example
    with pytest.raises(InputError, match="3 angles, expected as many"):
        best_view(**passed | {"angles": passed["angles"][:3]})


def test_a_circle_of_cameras_comes_out_as_a_circle_seen_from_above():
    degrees = np.arange(0, 360, 45)
    ring, other = around([camera_at(d) for d in degrees], camera_at(20, tilt=0.8).centre[None])
    turns = np.degrees(np.unwrap(np.arctan2(*ring.T[::-1])))
    # Counter-clockwise in the world stays so in the picture, whatever axes the plane is given.
    assert np.allclose(np.diff(turns), 45)
    assert np.allclose(np.linalg.norm(ring, axis=1), 1)
    from_first = np.degrees(np.arctan2(*other[0][::-1])) - turns[0]
    assert np.isclose((from_first + 180) % 360 - 180, 20)


def test_cameras_on_a_line_go_round_nothing():
    one = camera_at(0)
    places = [one.t + np.array([step, 0, 0]) for step in range(5)]
    cameras = [Camera(one.R, place, one.focal_length, one.principal_point, one.size) for place in places]
    with pytest.raises(InputError, match="5 camera centres"):
        around(cameras, np.zeros((1, 3)))
    with pytest.raises(InputError, match="2 camera centres"):
        around(cameras[:2], np.zeros((1, 3)))


def test_views_are_taken_evenly_and_round_the_ring():
    assert evenly(24, 5, 0).tolist() == [0, 4, 9, 14, 19]
    assert evenly(6, 3, 5).tolist() == [5, 1, 3]


def test_lines_end_in_the_second_image_and_outliers_are_drawn_apart():
    _, axis = plt.subplots()
    canvas = match_canvas(axis, np.zeros((10, 20, 3)), np.zeros((10, 20, 3)), ("a", "b"))
    canvas.draw(np.array([[1, 2], [3, 4]]), np.array([[5, 6], [7, 8]]), np.array([True, False]))
    (kept,), (dropped,) = canvas.kept.get_segments(), canvas.dropped.get_segments()
    assert kept.tolist() == [[1, 2], [5 + canvas.offset, 6]]
    assert dropped.tolist() == [[3, 4], [7 + canvas.offset, 8]]
    assert canvas.offset > 20
    plt.close("all")


def test_images_of_different_sizes_are_refused():
    _, axis = plt.subplots()
    with pytest.raises(InputError, match="expected equal"):
        match_canvas(axis, np.zeros((10, 20, 3)), np.zeros((20, 10, 3)), ("a", "b"))
    plt.close("all")
