"""The photograph of a motorcycle: depth, mask, directions; and the demo with a rendered stand-in of
known pose."""

import json

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, around, look_at, render

from zsp_lite.cli.demo import MODELS_NOTE
from zsp_lite.course.motorcycle import FRONT, UP, load_photograph, motorcycle_frame
from zsp_lite.course.photograph import run_photograph
from zsp_lite.data.co3d import Co3D, SequenceData, write_co3d
from zsp_lite.data.depth import fit_plane, unproject_depth
from zsp_lite.metrics import rotation_error
from zsp_lite.points import axis_deviation, object_points

pytestmark = pytest.mark.slow

# front, left and up of the object, in the coordinates of `synthetic_views`
CANONICAL = look_at((1, 0.5, 0.2)).R
CLEAR_OF_THE_FLOOR = np.s_[450:, :]  # the motorcycle does not reach the lowest rows


def angle(first, second) -> float:
    first, second = np.asarray(first), np.asarray(second)
    return float(
        np.degrees(np.arccos(first @ second / np.linalg.norm(first) / np.linalg.norm(second)))
    )


@pytest.fixture(scope="module")
def frame():
    """The photograph with depth in metres."""
    import skimage.data

    rgb, _, disparity = skimage.data.stereo_motorcycle()
    return motorcycle_frame(rgb, disparity)


def test_the_mask_holds_the_seat_and_both_wheels_and_neither_the_floor_nor_the_bench(frame):
    seat = (240, 230)
    rear_tyre = (320, 135)
    front_tyre = (370, 675)
    floor = (470, 300)
    bench = (160, 100)
    assert [frame.mask[pixel] for pixel in (seat, rear_tyre, front_tyre, floor, bench)] == [
        1,
        1,
        1,
        0,
        0,
    ]


def test_up_is_the_normal_of_the_floor_and_front_is_parallel_to_it(frame):
    floor = frame.depth[CLEAR_OF_THE_FLOOR] > 0
    normal, _ = fit_plane(
        unproject_depth(frame.depth, frame.camera)[CLEAR_OF_THE_FLOOR][floor], 0.01
    )
    assert angle(-np.sign(normal[1]) * normal, UP) < 2
    assert abs(angle(FRONT, UP) - 90) < 1


def test_the_photograph_is_scaled_as_scenes_of_co3d_and_is_the_same_at_every_call(frame):
    first, second = load_photograph(), load_photograph()
    assert_allclose(axis_deviation(object_points(first)), 1, atol=1e-4)
    unit = axis_deviation(object_points(frame))
    assert_allclose(unit, 0.22, atol=0.005)  # metres, as the documentation says
    np.testing.assert_allclose(first.depth * unit, frame.depth, rtol=1e-5)
    assert all(
        np.array_equal(getattr(first, name), getattr(second, name))
        for name in ("rgb", "depth", "mask")
    )


def test_depth_follows_from_the_disparity_by_the_calibration(frame):
    import skimage.data

    _, right, disparity = skimage.data.stereo_motorcycle()
    row, col = 330, 390  # on the engine
    point = frame.camera.unproject_camera(np.array([col + 0.5, row + 0.5]), frame.depth[row, col])
    # The right camera stands 0.193001 m to the right; its principal point lies 31.086 pixels
    # farther right.
    seen = 994.978 * (point[0] - 0.193001) / point[2] + 311.193 + 31.086
    assert_allclose(seen, col + 0.5 - disparity[row, col], atol=1e-3)
    unknown = ~np.isfinite(disparity)
    assert unknown.any()
    assert_array_equal(frame.depth[unknown], 0)


@pytest.fixture(scope="module")
def motorcycles(tmp_path_factory):
    """A synthetic category "motorcycle" with two sequences, elsewhere in their world, and their
    object poses."""
    root, sequences, poses = tmp_path_factory.mktemp("motorcycles"), [], {}
    points = default_rng(0).uniform(-1, 1, (400, 3))
    for name in ("second", "first"):
        frames, colours = around(ELSEWHERE), np.full((400, 3), 128, np.uint8)
        sequences.append(
            SequenceData(name, frames, list(range(7)), ELSEWHERE.apply(points), colours)
        )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = ELSEWHERE.R @ CANONICAL, ELSEWHERE.t
        poses[name] = {
            "trans": pose.tolist(),
            "scale": ELSEWHERE.scale,
            "low": [-1.0] * 3,
            "high": [1.0] * 3,
        }
    write_co3d(root, "motorcycle", sequences, quality=98)
    (root / "motorcycle/object_poses.json").write_text(json.dumps(poses))
    (root / "rendered_models.json").write_text("{}")
    return Co3D(root)


@pytest.fixture(scope="module")
def photograph():
    """Stands in for the photograph in all that follows."""
    rendered = render(look_at((-0.7, 1, 0.35)), AT_HOME, "photograph")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zsp_lite.course.motorcycle.load_photograph", lambda: rendered)
        yield rendered


def test_with_perfect_features_the_directions_and_the_cloud_are_those_of_the_object(
    motorcycles, photograph
):
    truth = photograph.camera.R @ CANONICAL
    points = photograph.camera.to_camera(default_rng(0).uniform(-1, 1, (400, 3)))
    by_eye = np.array([FRONT, UP])
    results = list(run_photograph(motorcycles, CoordinateBackbone()))
    assert len(results) == 4  # two foregrounds, two solvers
    for result in results:
        relative = result.estimate.target_camera.R @ ELSEWHERE.R @ photograph.camera.R.T
        error = rotation_error(result.estimate.sim3.R, relative)
        assert error < 12
        assert_allclose(rotation_error(result.axes, truth), error, atol=1e-4)
        cosines = (result.axes.T[[0, 2]] * by_eye).sum(axis=1) / np.linalg.norm(by_eye, axis=1)
        assert_allclose(
            np.cos(np.radians([result.front_error, result.up_error])), cosines, atol=1e-6
        )
        assert np.linalg.norm(result.cloud - points, axis=1).mean() < 0.3
        assert np.corrcoef(points @ truth[:, 0], result.along)[0, 1] > 0.999


def test_a_folder_without_synthetic_motorcycles_gives_no_result(ellipsoids):
    assert list(run_photograph(ellipsoids, CoordinateBackbone())) == []


def test_the_demo_begins_with_the_credited_photograph(
    motorcycles, photograph, tmp_path, monkeypatch, loaded, run
):
    monkeypatch.setattr(
        "zsp_lite.course.demo.run_demo", lambda dataset, backbone, solvers: iter(())
    )
    monkeypatch.setattr("zsp_lite.viz.report.write_overview", lambda *others: None)
    text = run(f"demo --data {motorcycles.root} --out {tmp_path}")
    page = (tmp_path / "report.html").read_text("utf-8")
    assert text.index("Photographed motorcycle") < text.index("One pair per category")
    assert text.count("│ verified ") == 2
    assert MODELS_NOTE in " ".join(text.split())
    assert "Which way does a real motorcycle stand?" in page
    assert "Middlebury" in page
