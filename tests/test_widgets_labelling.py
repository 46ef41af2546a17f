"""The labelling widget without a browser: clicks are sent as messages, and every change is on disk
at once."""

import re

import numpy as np
import pytest
from co3d_folders import sequence_data
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation

from zsp_lite.alignment import Sim3
from zsp_lite.course.labelling import Labelling
from zsp_lite.data.co3d import write_co3d
from zsp_lite.data.labels import PoseLabel, read_labels, write_label
from zsp_lite.metrics import rotation_error

pytest.importorskip("anywidget", reason="the labelling widget is optional: pip install anywidget")

from zsp_lite.course.widgets.cloud_view import point_under, view_units  # noqa: E402
from zsp_lite.course.widgets.labelling import label_poses  # noqa: E402

TURN = Rotation.random(random_state=4).as_matrix()


@pytest.fixture
def root(tmp_path):
    """Three sequences: the cloud of a is that of best after a similarity transform, the cloud of b
    is shifted."""
    sequences = [sequence_data("best", quality=3.0), sequence_data("a"), sequence_data("b")]
    points = np.random.default_rng(0).normal(size=(9000, 3)) * (1, 0.6, 0.4)
    colours = np.full(points.shape, 90, np.uint8)
    clouds = {"best": points, "a": 1.3 * points @ TURN.T + 2, "b": points + 1}
    changed = [
        one.__class__(**{**vars(one), "points": clouds[one.name], "colours": colours})
        for one in sequences
    ]
    write_co3d(tmp_path, "chair", changed)
    return tmp_path


@pytest.fixture
def labelling(root):
    return Labelling(root, "chair")


def click(box, which, point):
    """Send the message of a click on `point`, from a viewpoint where the point is in front."""
    canvas = box.views[which]
    forward = -canvas._to_view.apply(point)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.roll(forward, 1))
    right /= np.linalg.norm(right)
    view = np.array([right, np.cross(forward, right), forward])
    at = (view @ canvas._to_view.apply(point))[:2].tolist()
    content = {"at": at, "view": view.ravel().tolist(), "reach": 0.05}
    canvas.widget._handle_custom_msg(content, [])


def corners(labelling, sequence, n=5):
    """Extreme points of a cloud, corresponding ones on best and a."""
    best = labelling.cloud("best")[0]
    directions = np.random.default_rng(1).normal(size=(60, 3))
    indices = dict.fromkeys((best @ directions.T).argmax(axis=0))
    return labelling.cloud(sequence)[0][list(indices)[:n]]


def click_all(box, labelling, which, sequence, n=5):
    for point in corners(labelling, sequence, n):
        click(box, which, point)


def message(box):
    return re.sub("<[^>]*>", "", box.message.value)


def table(box, name):
    """Rows of a table as lists of texts."""
    rows = re.findall("<tr>.*?</tr>", box.tables[name].value, re.DOTALL)
    return [
        [re.sub("<[^>]*>", "", cell) for cell in re.findall("<td.*?</td>", row)] for row in rows
    ]


def test_clicks_give_keypoints_and_an_accepted_label(labelling):
    box = label_poses(labelling)
    assert box.controls["sequence"].value == "best" and "at least 4 more" in message(box)
    box.controls["name"].value = "left arm"
    click_all(box, labelling, "reference", "best")
    assert labelling.names[0] == "left arm" and len(labelling.names) == 5
    assert_array_equal(labelling.picks("best"), corners(labelling, "best"))
    box.buttons["next"].click()
    assert box.controls["sequence"].value == "a"
    click_all(box, labelling, "sequence", "a")
    assert_array_equal(labelling.picks("a"), corners(labelling, "a"))
    assert box.controls["overlay"].value and "residual 0.0 %" in message(box)
    box.buttons["accept"].click()
    assert rotation_error(read_labels(labelling.root, "chair")["a"].trans[:3, :3], TURN) < 0.01
    assert message(box) == "Written: class_labels/chair/a.json. Now b."
    reference, *others = [row[1:] for row in table(box, "progress")]
    assert reference == ["best", "● reference", "5", ""]
    assert others == [["a", "✓ accepted", "5", "0.0 %"], ["b", "○ open", "0", ""]]


def test_a_new_widget_continues_an_earlier_session_and_shows_an_imported_label(root, labelling):
    box = label_poses(labelling)
    click_all(box, labelling, "reference", "best")
    box.buttons["next"].click()
    click_all(box, labelling, "sequence", "a", 2)
    again = Labelling(root, "chair")
    box = label_poses(again)
    assert (
        message(box) == "The earlier keypoints are loaded."
        and box.controls["sequence"].value == "a"
    )
    assert (
        len(box.views["sequence"].widget.marks) == 2
        and len(box.views["reference"].widget.marks) == 5
    )
    for button, left in (("undo", 1), ("redo", 0)):
        box.buttons[button].click()
        assert len(Labelling(root, "chair").picks("a")) == left
    write_label(root, "chair", PoseLabel(np.eye(4), "b", "best"))
    box.controls["sequence"].value = "b"
    assert not box.controls["overlay"].disabled
    box.controls["overlay"].value = True
    colours = np.frombuffer(box.views["sequence"].widget.colours, np.uint8).reshape(-1, 3)
    assert len(np.unique(colours, axis=0)) == 2


def test_proposals_are_looked_at_one_by_one_and_accepted_without_a_click(labelling):
    proposal = Sim3(1.0, TURN, np.zeros(3))
    labelling.proposal = lambda sequence: proposal
    box = label_poses(labelling)
    box.buttons["next"].click()
    assert "proposal is laid over" in message(box) and box.controls["overlay"].value
    first = box.controls["sequence"].value
    box.buttons["accept"].click()
    assert_allclose(
        read_labels(labelling.root, labelling.category)[first].trans[:3, :3], TURN, atol=1e-9
    )
    assert box.controls["sequence"].value != first and not box.buttons["accept"].disabled


def test_skip_and_next_go_through_the_open_sequences_and_the_slider_chooses_a_point(labelling):
    box = label_poses(labelling)
    box.controls["point"].value = 1234
    cursor = np.array(box.views["reference"].widget.cursor)
    box.buttons["pick"].click()
    assert_allclose(box.views["reference"]._to_view.apply(labelling.picks("best")[0]), cursor)
    box.buttons["undo"].click()
    box.buttons["next"].click()
    assert box.controls["sequence"].value == "best" and "on the reference first" in message(box)
    click_all(box, labelling, "reference", "best", 4)
    box.buttons["skip"].click()
    assert "cannot be skipped" in message(box)
    box.buttons["next"].click()
    box.buttons["next"].click()
    assert box.controls["sequence"].value == "b"
    box.buttons["skip"].click()
    assert message(box) == "b is skipped. Now a." and table(box, "progress")[2][2] == "– skipped"
    box.buttons["skip"].click()
    assert message(box) == "a is skipped. No sequence is open."


def test_errors_are_one_line_in_the_widget(labelling):
    box = label_poses(labelling)
    beside = {"at": [5.0, 5.0], "view": np.eye(3).ravel().tolist(), "reach": 0.05}
    box.views["reference"].widget._handle_custom_msg(beside, [])
    assert (
        message(box) == "There is no point of the cloud at the click." and len(labelling.names) == 0
    )
    click_all(box, labelling, "reference", "best", 3)
    box.controls["sequence"].value = "a"
    click(box, "sequence", corners(labelling, "a")[0])
    assert message(box) == "Not done: the reference has 3 keypoints, expected 4 first"
    box.controls["sequence"].value = "best"
    click(box, "reference", corners(labelling, "best")[3])
    labelling.put("a", np.outer(np.arange(4), (1, 2, 3)))
    box.buttons["next"].click()
    box.controls["overlay"].value = True
    assert "collinear" in message(box) and not box.controls["overlay"].value
    box.buttons["accept"].click()
    assert "collinear" in message(box) and read_labels(labelling.root, "chair") == {}


def test_a_click_selects_the_nearest_of_the_front_points():
    points = np.array([(0, 0, -1.0), (0.02, 0, -0.95), (0.01, 0, 0.9), (0.5, 0, 0)])
    assert point_under(points, np.eye(3), np.array([0.011, 0]), 0.05) == 1
    behind = np.diag([-1.0, 1, -1])
    assert point_under(points, behind, np.array([-0.01, 0]), 0.05) == 2
    assert point_under(points, np.eye(3), np.array([-0.4, 0]), 0.05) is None


def test_outliers_do_not_change_the_scale_and_bad_clouds_are_input_errors():
    points = np.random.default_rng(3).uniform(size=(1000, 3))
    points[0] = 1000
    assert view_units(points).scale > 1
    for bad in (np.full((4, 3), np.nan), np.ones((4, 3))):
        refused("not finite|no extent", view_units, bad)
