"""The labelling widget without a browser: clicks arrive as its messages, and all it does is on disk at once."""

import json
import re
import time

import numpy as np
import pytest
from co3d_folders import sequence_data
from scipy.spatial.transform import Rotation

from zsp_lite.alignment import Sim3
from zsp_lite.data.co3d import write_co3d
from zsp_lite.data.labels import PoseLabel, read_labels, write_label
from zsp_lite.errors import InputError
from zsp_lite.labelling import Labelling
from zsp_lite.metrics import rotation_error

pytest.importorskip("anywidget", reason="the labelling widget needs anywidget: pip install 'zsp-lite[notebooks]'")

from zsp_lite.widgets import cloud_view  # noqa: E402
from zsp_lite.widgets.cloud_view import ViewBox, point_under, subsample  # noqa: E402
from zsp_lite.widgets.labelling import label_poses  # noqa: E402
from zsp_lite.widgets.latency import LIMIT, build_example, measure  # noqa: E402

TURN = Rotation.random(random_state=4).as_matrix()


@pytest.fixture
def root(tmp_path):
    """The cloud of a is that of the best, turned, larger and elsewhere; b is another one."""
    sequences = [sequence_data("best", quality=3.0), sequence_data("a"), sequence_data("b")]
    points = np.random.default_rng(0).normal(size=(9000, 3)) * (1, 0.6, 0.4)
    colours = np.full(points.shape, 90, np.uint8)
    clouds = {"best": points, "a": 1.3 * points @ TURN.T + 2, "b": points + 1}
    changed = [one.__class__(**{**vars(one), "points": clouds[one.name], "colours": colours}) for one in sequences]
    write_co3d(tmp_path, "chair", changed)
    return tmp_path


@pytest.fixture
def labelling(root):
    return Labelling(root, "chair")


def click(box, which, point):
    """What the browser sends when the canvas is clicked where `point` is drawn, from a side where it is in front."""
    canvas = box.views[which]
    away = -canvas._box.place(point)
    away /= np.linalg.norm(away)
    right = np.cross(away, np.roll(away, 1))
    right /= np.linalg.norm(right)
    view = np.array([right, np.cross(away, right), away])
    at = (view @ canvas._box.place(point))[:2].tolist()
    message = {"kind": "click", "at": at, "view": view.ravel().tolist(), "reach": 0.05}
    canvas.widget._handle_custom_msg(message, [])


def corners(labelling, sequence, n=5):
    """Points far out on a cloud, the same ones on best and a."""
    best = labelling.cloud("best")[0]
    directions = np.random.default_rng(1).normal(size=(60, 3))
    indices = dict.fromkeys((best @ directions.T).argmax(axis=0))  # each once
    return labelling.cloud(sequence)[0][list(indices)[:n]]


def click_all(box, labelling, which, sequence, n=5):
    for point in corners(labelling, sequence, n):
        click(box, which, point)


def said(box):
    return re.sub("<[^>]*>", "", box.message.value)


def table(box, name):
    """Rows of a table as lists of texts."""
    rows = re.findall("<tr.*?</tr>", box.tables[name].value)[1:]
    return [[re.sub("<[^>]*>", "", cell) for cell in re.findall("<td.*?</td>", row)] for row in rows]


def test_clicks_make_keypoints_and_an_accepted_label(labelling):
    box = label_poses(labelling)
    assert box.controls["sequence"].value == "best" and "4 more at least" in said(box)
    box.name.value = "left arm"
    click_all(box, labelling, "reference", "best")
    assert labelling.names[0] == "left arm" and len(labelling.names) == 5
    np.testing.assert_array_equal(labelling.picks("best"), corners(labelling, "best"))
    box.buttons["next"].click()
    assert box.controls["sequence"].value == "a"
    click_all(box, labelling, "sequence", "a")
    np.testing.assert_array_equal(labelling.picks("a"), corners(labelling, "a"))
    assert box.controls["overlay"].value and "residual 0.0 %" in said(box)
    assert [row[3] for row in table(box, "keypoints")] == ["0.0 %"] * 5
    box.buttons["accept"].click()
    assert rotation_error(read_labels(labelling.root, "chair")["a"].trans[:3, :3], TURN) < 0.01
    assert said(box) == "Written: class_labels/chair/a.json. Now b."
    assert [row[1:] for row in table(box, "progress")] == [
        ["best", "● reference", "5", ""], ["a", "✓ accepted", "5", "0.0 %"], ["b", "○ open", "0", ""],
    ]  # fmt: skip


def test_a_restart_goes_on_where_it_stopped(root, labelling):
    box = label_poses(labelling)
    click_all(box, labelling, "reference", "best")
    box.buttons["next"].click()
    click_all(box, labelling, "sequence", "a", 2)
    again = Labelling(root, "chair")
    box = label_poses(again)
    assert said(box) == "What was picked before is here again." and box.controls["sequence"].value == "a"
    assert len(box.views["sequence"].widget.marks) == 2 and len(box.views["reference"].widget.marks) == 5
    box.buttons["undo"].click()  # what came before the restart can be taken back pick by pick
    assert len(Labelling(root, "chair").picks("a")) == 1


def test_undo_takes_back_picks_moves_and_redo_itself(labelling):
    box = label_poses(labelling)
    click_all(box, labelling, "reference", "best")
    box.controls["keypoint"].value = 1
    box.name.value = "seat"
    assert labelling.names[1] == "seat"
    box.controls["keypoint"].value = -1
    box.buttons["undo"].click()
    assert len(labelling.picks("best")) == 4 and labelling.names[1] == "seat"
    box.buttons["next"].click()
    click_all(box, labelling, "sequence", "a", 4)
    before = labelling.picks("a")
    box.controls["keypoint"].value = 2
    click(box, "sequence", corners(labelling, "a", 9)[8])
    assert not np.array_equal(labelling.picks("a")[2], before[2]) and box.controls["keypoint"].value == -1
    assert said(box) == "Keypoint 3, keypoint 3, moved on a."
    box.buttons["undo"].click()
    np.testing.assert_array_equal(labelling.picks("a"), before)
    box.buttons["redo"].click()
    assert len(labelling.picks("a")) == 0 and not box.controls["overlay"].value
    box.buttons["undo"].click()
    np.testing.assert_array_equal(labelling.picks("a"), before)


def test_the_guess_is_put_on_the_cloud_and_single_picks_are_corrected(labelling, monkeypatch):
    monkeypatch.setattr(
        "zsp_lite.labelling.guess.guess_alignment",
        lambda *_: (Sim3(1.3, TURN, np.full(3, 2.0) + 0.001), 0.8),
    )
    box = label_poses(labelling, backbone=object())
    box.buttons["guess"].click()
    assert said(box) == "Not done: a guess needs 4 keypoints on the reference, and another sequence chosen"
    click_all(box, labelling, "reference", "best")
    box.buttons["next"].click()
    box.buttons["guess"].click()
    assert "80% sure" in said(box) and box.controls["overlay"].value
    np.testing.assert_array_equal(labelling.picks("a"), corners(labelling, "a"))
    box.controls["keypoint"].value = 3
    assert [mark["chosen"] for mark in box.views["sequence"].widget.marks] == [False, False, False, True, False]
    click(box, "sequence", corners(labelling, "a", 8)[7])
    np.testing.assert_array_equal(labelling.picks("a")[3], corners(labelling, "a", 8)[7])
    box.buttons["undo"].click()
    box.buttons["undo"].click()
    assert len(labelling.picks("a")) == 0


def test_skip_and_next_go_round_the_open_ones(labelling):
    box = label_poses(labelling)
    box.buttons["next"].click()
    assert box.controls["sequence"].value == "best" and "on the reference first" in said(box)
    click_all(box, labelling, "reference", "best", 4)
    box.buttons["skip"].click()
    assert "cannot be skipped" in said(box)
    box.buttons["next"].click()
    box.buttons["next"].click()
    assert box.controls["sequence"].value == "b"
    box.buttons["skip"].click()
    assert said(box) == "b is left out. Now a." and table(box, "progress")[2][2] == "– skipped"
    box.buttons["skip"].click()
    assert said(box) == "a is left out. No sequence is open any more."


def test_the_slider_chooses_a_point_by_keyboard(labelling):
    box = label_poses(labelling)
    box.controls["point"].value = 1234
    cursor = np.array(box.views["reference"].widget.cursor)
    box.buttons["pick"].click()
    np.testing.assert_allclose(box.views["reference"]._box.place(labelling.picks("best")[0]), cursor)


def test_what_is_refused_is_one_line_in_the_widget(labelling):
    box = label_poses(labelling)
    box.views["reference"].widget._handle_custom_msg(
        {"kind": "click", "at": [5.0, 5.0], "view": np.eye(3).ravel().tolist(), "reach": 0.05}, []
    )
    assert said(box) == "No point of the cloud is there." and len(labelling.names) == 0
    click_all(box, labelling, "reference", "best", 3)
    box.controls["sequence"].value = "a"
    click(box, "sequence", corners(labelling, "a")[0])
    assert said(box) == "Not done: the reference has 3 keypoints, expected 4 first"
    box.controls["sequence"].value = "best"
    click(box, "reference", corners(labelling, "best")[3])
    box.buttons["next"].click()
    click(box, "sequence", corners(labelling, "a")[0])
    click(box, "sequence", corners(labelling, "a")[0])
    assert said(box) == "Not done: keypoint 1, keypoint 1, is at this very point already"
    labelling.put("a", np.outer(np.arange(4), (1, 2, 3)))
    box.controls["overlay"].value = True
    assert "collinear" in said(box) and not box.controls["overlay"].value
    assert table(box, "progress")[1][4] == "see above"
    box.buttons["accept"].click()
    assert "collinear" in said(box) and read_labels(labelling.root, "chair") == {}
    box.controls["sequence"].value = "best"
    click(box, "reference", corners(labelling, "best")[4])
    assert "in use on a; clear those first" in said(box) and len(labelling.names) == 4


@pytest.mark.parametrize("content", ["broken", "one place"])
def test_a_cloud_that_cannot_be_shown_is_said_and_the_others_go_on(root, content):
    labelling = Labelling(root, "chair")
    box = label_poses(labelling)
    click_all(box, labelling, "reference", "best", 4)
    if content == "broken":
        (labelling.dataset.root / labelling.dataset.sequences("chair")[1].point_cloud.path).write_bytes(b"ply\n")
    else:
        labelling._clouds["a"] = np.ones((9, 3)), np.zeros((9, 3), np.uint8)
    box.buttons["next"].click()
    assert said(box).startswith("Not done: ") and box.controls["sequence"].value == "a"
    assert box.views["sequence"].widget.points == b""
    box.buttons["next"].click()
    assert said(box) == "Now b." and len(box.views["sequence"].widget.points) > 0


def test_a_label_without_picks_can_be_looked_at(root):
    write_label(root, "chair", PoseLabel(np.eye(4), "best", "best"))
    write_label(root, "chair", PoseLabel(np.eye(4), "b", "best"))
    box = label_poses(Labelling(root, "chair"))
    box.controls["sequence"].value = "b"
    assert not box.controls["overlay"].disabled
    box.controls["overlay"].value = True
    colours = np.frombuffer(box.views["sequence"].widget.colours, np.uint8).reshape(-1, 3)
    assert len(np.unique(colours, axis=0)) == 2
    crosses = np.frombuffer(box.views["sequence"].widget.crosses, np.uint8)
    assert crosses.sum() == len(crosses) / 2
    assert json.loads((root / "class_labels/chair/b.json").read_text())["seq"] == "b"


def test_it_answers_quickly():
    taken = measure(build_example("label_poses"), 3, clock=time.process_time)
    assert taken.keys() == {"sequence", "keypoint", "overlay", "point"} and max(taken.values()) < LIMIT


def test_the_front_is_picked_and_the_nearest_of_it():
    points = np.array([(0, 0, -1.0), (0.02, 0, -0.95), (0.01, 0, 0.9), (0.5, 0, 0)])
    assert point_under(points, np.eye(3), np.array([0.011, 0]), 0.05) == 1
    behind = np.diag([-1.0, 1, -1])
    assert point_under(points, behind, np.array([-0.01, 0]), 0.05) == 2
    assert point_under(points, np.eye(3), np.array([-0.4, 0]), 0.05) is None


def test_thinning_is_deterministic_and_neighbours_follow_each_other():
    points = np.random.default_rng(3).uniform(size=(9000, 3))
    kept = subsample(points)
    assert len(kept) == 6000 == len(np.unique(kept))
    np.testing.assert_array_equal(kept, subsample(points.copy()))
    steps = np.linalg.norm(np.diff(points[kept], axis=0), axis=1)
    assert np.median(steps) < 0.25 * np.median(np.linalg.norm(points[kept][1:] - points[kept][::-1][1:], axis=1))
    assert len(subsample(points[:5])) == 5


def test_strays_do_not_shrink_the_object_and_odd_clouds_are_named():
    points = np.random.default_rng(3).uniform(size=(1000, 3))
    points[0] = 1000
    assert ViewBox.around(points).radius < 1
    for bad, message in (
        (np.zeros((0, 3)), "empty"),
        (np.full((4, 3), np.nan), "not finite"),
        (np.ones((4, 3)), "single"),
    ):
        with pytest.raises(InputError, match=message):
            ViewBox.around(bad)


def test_without_anywidget_it_says_what_to_install(labelling, monkeypatch):
    cloud_view._cloud_widget.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "anywidget", None)
    with pytest.raises(InputError, match="pip install anywidget"):
        label_poses(labelling)
