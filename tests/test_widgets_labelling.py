"""The labelling widget without a browser: clicks are sent as messages, and every change is on disk
at once."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from co3d_folders import sequence_data
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation

from zsp_lite import Sim3
from zsp_lite.course.labelling import Labelling
from zsp_lite.data.labels import PoseLabel, read_labels
from zsp_lite.data.writing import write_co3d, write_label
from zsp_lite.metrics import rotation_error

pytest.importorskip("anywidget", reason="the labelling widget is optional: pip install anywidget")

from zsp_lite.course.widgets.cloud_view import point_under, view_units  # noqa: E402
from zsp_lite.course.widgets.labelling import Widget, label_poses  # noqa: E402

TURN = Rotation.random(random_state=4).as_matrix()
REACH = 0.05  # how far from a click a point may be, in units of the view


@pytest.fixture
def root(tmp_path) -> Path:
    """Three sequences: the cloud of a is that of best after a similarity transform, the cloud of b
    is shifted."""
    points = default_rng(0).normal(size=(9000, 3)) * (1, 0.6, 0.4)
    colours = np.full(points.shape, 90, np.uint8)
    clouds = {"best": points, "a": 1.3 * points @ TURN.T + 2, "b": points + 1}
    qualities = {"best": 3.0, "a": 1.0, "b": 1.0}
    sequences = [
        replace(sequence_data(name, quality=qualities[name]), points=cloud, colours=colours)
        for name, cloud in clouds.items()
    ]
    write_co3d(tmp_path, "chair", sequences)
    return tmp_path


@pytest.fixture
def labelling(root) -> Labelling:
    """A session with these sequences."""
    return Labelling(root, "chair")


def click(box: Widget, which: str, point: np.ndarray) -> None:
    """Send the message of a click on `point`, from a viewpoint where the point is in front."""
    canvas = box.views[which]
    forward = -canvas._to_view.apply(point)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.roll(forward, 1))
    right /= np.linalg.norm(right)
    view = np.array([right, np.cross(forward, right), forward])
    at = (view @ canvas._to_view.apply(point))[:2].tolist()
    content = {"at": at, "view": view.ravel().tolist(), "reach": REACH}
    canvas.widget._handle_custom_msg(content, [])


def corners(labelling: Labelling, sequence: str, n: int = 5) -> np.ndarray:
    """Extreme points of a cloud, corresponding ones on best and a."""
    best = labelling.cloud("best")[0]
    directions = default_rng(1).normal(size=(60, 3))
    indices = dict.fromkeys((best @ directions.T).argmax(axis=0))
    return labelling.cloud(sequence)[0][list(indices)[:n]]


def click_all(box: Widget, labelling: Labelling, which: str, sequence: str, n: int = 5) -> None:
    """Click on the extreme points."""
    for point in corners(labelling, sequence, n):
        click(box, which, point)


def message(box: Widget) -> str:
    """The message of the widget as text."""
    return re.sub("<[^>]*>", "", box.message.value)


def progress(box: Widget) -> list[list[str]]:
    """Rows of the table of sequences as lists of texts."""
    rows = re.findall("<tr>.*?</tr>", box.tables["progress"].value, re.DOTALL)
    return [
        [re.sub("<[^>]*>", "", cell) for cell in re.findall("<td.*?</td>", row)] for row in rows
    ]


@pytest.fixture
def clicked(labelling) -> Widget:
    """A widget in which five points of the reference were clicked."""
    box = label_poses(labelling)
    box.controls["name"].value = "left arm"
    click_all(box, labelling, "reference", "best")
    return box


def test_a_fit_to_clicks_is_laid_over_and_accepted_and_the_next_sequence_is_shown(
    clicked, labelling
):
    assert labelling.names[0] == "left arm"
    clicked.buttons["next"].click()
    click_all(clicked, labelling, "sequence", "a")
    for name in ("best", "a"):
        assert_array_equal(labelling.picks(name), corners(labelling, name))
    assert clicked.controls["overlay"].value
    assert "residual 0.0 %" in message(clicked)
    clicked.buttons["accept"].click()
    label = read_labels(labelling.root, "chair")["a"].trans
    assert rotation_error(label[:3, :3], TURN) < 0.01
    assert message(clicked) == "Written: class_labels/chair/a.json. Now b."
    assert [row[1:] for row in progress(clicked)] == [
        ["best", "● reference", "5", ""],
        ["a", "✓ accepted", "5", "0.0 %"],
        ["b", "○ open", "0", ""],
    ]


def test_a_new_widget_continues_an_earlier_session(clicked, root, labelling):
    clicked.buttons["next"].click()
    click_all(clicked, labelling, "sequence", "a", 2)
    box = label_poses(Labelling(root, "chair"))
    assert message(box) == "The earlier keypoints are loaded."
    assert box.controls["sequence"].value == "a"
    marks = {name: len(view.widget.marks) for name, view in box.views.items()}
    assert marks == {"reference": 5, "sequence": 2}
    for button, left in (("undo", 1), ("redo", 0)):
        box.buttons[button].click()
        assert len(Labelling(root, "chair").picks("a")) == left


def test_a_widget_shows_an_imported_label(clicked, root):
    write_label(root, "chair", PoseLabel(np.eye(4), "b", "best"))
    clicked.controls["sequence"].value = "b"
    assert not clicked.controls["overlay"].disabled
    clicked.controls["overlay"].value = True
    colours = np.frombuffer(clicked.views["sequence"].widget.colours, np.uint8).reshape(-1, 3)
    assert len(np.unique(colours, axis=0)) == 2  # of the sequence and of the reference


def test_proposals_are_looked_at_one_by_one_and_accepted_without_a_click(labelling):
    proposal = Sim3(1.0, TURN, np.zeros(3))
    labelling.proposal = lambda sequence: proposal
    box = label_poses(labelling)
    box.buttons["next"].click()
    assert "proposal is laid over" in message(box)
    assert box.controls["overlay"].value
    first = box.controls["sequence"].value
    box.buttons["accept"].click()
    assert_allclose(
        read_labels(labelling.root, labelling.category)[first].trans[:3, :3], TURN, atol=1e-9
    )
    assert box.controls["sequence"].value != first
    assert not box.buttons["accept"].disabled


def test_the_reference_comes_first(labelling):
    box = label_poses(labelling)
    assert "at least 4 more" in message(box)
    box.buttons["next"].click()
    assert box.controls["sequence"].value == "best"
    assert "on the reference first" in message(box)


def test_next_goes_through_the_open_sequences(clicked, root):
    for name in "aba":
        clicked.buttons["next"].click()
        assert clicked.controls["sequence"].value == name
    for name in "ab":
        write_label(root, "chair", PoseLabel(np.eye(4), name, "best"))
    clicked.buttons["next"].click()
    assert message(clicked) == "No sequence is open."


def test_a_click_beside_the_cloud_is_no_keypoint(labelling):
    box = label_poses(labelling)
    beside = {"at": [5.0, 5.0], "view": np.eye(3).ravel().tolist(), "reach": REACH}
    box.views["reference"].widget._handle_custom_msg(beside, [])
    assert message(box) == "There is no point of the cloud at the click."
    assert labelling.names == ()


def test_a_click_on_a_sequence_before_four_on_the_reference_is_refused(labelling):
    box = label_poses(labelling)
    click_all(box, labelling, "reference", "best", 3)
    box.controls["sequence"].value = "a"
    click(box, "sequence", corners(labelling, "a")[0])
    assert message(box) == "Not done: the reference has 3 keypoints, expected 4 first"


def test_a_fit_to_points_on_a_line_is_refused(labelling):
    box = label_poses(labelling)
    click_all(box, labelling, "reference", "best", 4)
    labelling.put("a", np.outer(np.arange(4), (1, 2, 3)))
    box.buttons["next"].click()
    box.controls["overlay"].value = True
    assert "collinear" in message(box)
    assert not box.controls["overlay"].value


def test_a_click_selects_the_nearest_of_the_front_points():
    points = np.array([(0, 0, -1.0), (0.02, 0, -0.95), (0.01, 0, 0.9), (0.5, 0, 0)])
    assert point_under(points, np.eye(3), np.array([0.011, 0]), REACH) == 1
    behind = np.diag([-1.0, 1, -1])
    assert point_under(points, behind, np.array([-0.01, 0]), REACH) == 2


def test_outliers_do_not_change_the_scale_and_bad_clouds_are_input_errors():
    points = default_rng(3).uniform(size=(1000, 3))
    points[0] = 1000  # the outlier
    assert view_units(points).scale > 1
    for bad in (np.full((4, 3), np.nan), np.ones((4, 3))):
        refused("has no extent, expected finite points", view_units, bad)
