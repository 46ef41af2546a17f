"""What the lessons compute and draw beside the library: answers between objects, and pictures."""

from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
from synthetic_views import CoordinateBackbone

from zsp_lite import ZeroShotPose
from zsp_lite.course import hypotheses, scan_pictures
from zsp_lite.course.samples import sample_data
from zsp_lite.course.widgets.turning import show_turning
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.objects.align import read_hypotheses
from zsp_lite.scans.category import synchronise
from zsp_lite.viz.plots import object_cloud

RUN = Path(__file__).parents[1] / "notebooks/results/category_run/four_cars"


@pytest.fixture(scope="module")
def truth() -> dict[str, np.ndarray]:
    """Rotations from the worlds of the four sample cars to the frame of their category."""
    labels = read_labels(sample_data(), "car")
    return {name: labels[name].trans[:3, :3].T for name in sorted(labels)}


def test_a_draw_has_one_stored_answer_of_each_ordered_pair(truth):
    drawn = hypotheses.draw_answers(read_hypotheses(RUN).values(), seed=3)
    stored = [one.centre.tolist() for one in read_hypotheses(RUN).values()]
    assert {(one.reference, one.target) for one in drawn} == {
        (a, b) for a in truth for b in truth if a != b
    }
    assert len(drawn) == 12
    assert all(one.centre.tolist() in stored for one in drawn)


def test_a_tree_believes_the_surest_answer_and_all_pairs_can_outvote_it(truth):
    drawn = hypotheses.draw_answers(read_hypotheses(RUN).values(), seed=41)
    assert not hypotheses.all_alike(truth, hypotheses.spanning_tree(drawn))
    objects = synchronise(drawn).objects
    together = {name: one.sim3.R for name, one in objects.items()}
    assert hypotheses.all_alike(truth, together)

    surest = hypotheses.right_answers(drawn, truth)
    wrong = {pair for pair, right in surest.items() if not right}
    assert wrong == {
        ("seat_leon", "peugeot_308"),
        ("suv", "peugeot_308"),
        ("peugeot_308", "wooden_car"),
    }
    fitting = hypotheses.right_answers(drawn, truth, together)
    assert len(fitting) == 12 and all(fitting.values())


def test_a_common_turn_of_all_objects_changes_nothing_and_of_one_it_does(truth):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = {name: turn @ rotation for name, rotation in truth.items()}
    assert hypotheses.all_alike(truth, turned)
    assert not hypotheses.all_alike(truth, truth | {"suv": turned["suv"]})


def test_objects_are_seen_from_the_same_side_by_the_true_rotations(truth):
    dataset = Co3D(sample_data())
    shown = scan_pictures.alike(dataset, "car", truth, "suv")
    assert list(shown) == list(truth)
    assert {picture.shape for picture in shown.values()} == {(224, 224, 3)}
    turned = dict(truth)
    turned["seat_leon"] = np.diag([-1.0, -1, 1]) @ turned["seat_leon"]
    other = scan_pictures.alike(dataset, "car", turned, "suv")
    assert np.array_equal(other["suv"], shown["suv"])
    assert not np.array_equal(other["seat_leon"], shown["seat_leon"])


def test_clouds_that_turn_are_light_and_hold_the_moved_points(frames, monkeypatch):
    estimate = ZeroShotPose(CoordinateBackbone()).estimate(frames[0], frames[1:])
    pages = []
    monkeypatch.setattr("IPython.display.display", pages.append)
    show_turning({"A": estimate}, "")
    assert len(pages[0].data) < 100_000
    moved = estimate.sim3.apply(object_cloud(estimate.reference_view, 1200)).T
    points = np.frombuffer(b64decode(max(pages[0].data.split('"'), key=len)), "<i2")
    drawn = points.reshape(-1, 3).T[:, : moved.shape[1]]
    assert np.corrcoef(moved, drawn).diagonal(3).min() > 0.9999
