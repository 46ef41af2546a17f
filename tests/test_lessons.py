"""What the lessons draw beside the library."""

from base64 import b64decode

import numpy as np
from synthetic_views import CoordinateBackbone

from zsp_lite import ZeroShotPose
from zsp_lite.course import scan_pictures
from zsp_lite.course.samples import sample_data
from zsp_lite.course.widgets.turning import show_turning
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.viz.plots import object_cloud


def test_objects_are_seen_from_the_same_side_by_the_true_rotations():
    dataset = Co3D(sample_data())
    labels = read_labels(sample_data(), "car")
    truth = {name: labels[name].trans[:3, :3].T for name in sorted(labels)}
    shown = scan_pictures.alike(dataset, "car", truth, "suv")
    assert list(shown) == list(truth)
    assert {picture.shape for picture in shown.values()} == {(224, 224, 3)}
    turned = dict(truth)
    # By a half turn about the vertical.
    turned["seat_leon"] = np.diag([-1.0, -1, 1]) @ turned["seat_leon"]
    other = scan_pictures.alike(dataset, "car", turned, "suv")
    assert np.array_equal(other["suv"], shown["suv"])
    assert not np.array_equal(other["seat_leon"], shown["seat_leon"])


def test_clouds_that_turn_are_light_and_hold_the_moved_points(frames, monkeypatch):
    estimate = ZeroShotPose(CoordinateBackbone()).estimate(frames[0], frames[1:])
    pages = []
    monkeypatch.setattr("IPython.display.display", pages.append)
    show_turning({"A": estimate}, "")
    assert len(pages[0].data) < 100_000  # characters, which a notebook stores
    moved = estimate.sim3.apply(object_cloud(estimate.reference_view, most=1200)).T
    # The longest string of the page holds the points, those of the moved cloud first.
    points = np.frombuffer(b64decode(max(pages[0].data.split('"'), key=len)), "<i2")
    drawn = points.reshape(-1, 3).T[:, : moved.shape[1]]
    # Of x, y and z with those drawn, which have other units.
    assert np.corrcoef(moved, drawn).diagonal(3).min() > 0.9999
