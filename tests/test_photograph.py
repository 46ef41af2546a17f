"""The photograph of a motorcycle: its depth, mask and directions; and the demo with a rendered
picture of known pose in its place."""

import json

import numpy as np
import pytest
import skimage.data
from numpy.random import default_rng
from numpy.testing import assert_allclose
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, around, look_at, render

from zsp_lite import Sim3
from zsp_lite.cli.demo import MODELS_NOTE
from zsp_lite.course.motorcycle import FRONT, UP, load_photograph, motorcycle_frame
from zsp_lite.course.photograph import run_photograph
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.writing import SequenceData, write_co3d
from zsp_lite.importers.segments import fit_plane
from zsp_lite.metrics import rotation_error, vector_angle
from zsp_lite.points import axis_deviation, object_points

pytestmark = pytest.mark.slow

# Front, left and up of the object, in the coordinates of `synthetic_views`: any rotation does.
CANONICAL = look_at((1, 0.5, 0.2)).R
FLOOR = np.s_[450:, :]  # the lowest rows, which the motorcycle does not reach


@pytest.fixture(scope="module")
def frame():
    """The photograph with depth in metres."""
    rgb, _, disparity = skimage.data.stereo_motorcycle()
    return motorcycle_frame(rgb, disparity)


def test_the_mask_holds_the_seat_and_both_wheels_and_neither_the_floor_nor_the_bench(frame):
    on_object = {
        (240, 230): 1,  # seat
        (320, 135): 1,  # rear tyre
        (370, 675): 1,  # front tyre
        (470, 300): 0,  # floor
        (160, 100): 0,  # bench
    }
    assert {pixel: frame.mask[pixel] for pixel in on_object} == on_object


def test_up_is_the_normal_of_the_floor_and_front_is_parallel_to_it(frame):
    known = frame.depth[FLOOR] > 0
    points = unproject_depth(frame.depth, frame.camera)[FLOOR][known]
    normal, _ = fit_plane(points, threshold=0.01)  # metres
    # y points down in cameras: the normal that points up has a negative y.
    assert vector_angle(-np.sign(normal[1]) * normal, UP) < 2  # degrees
    assert abs(vector_angle(FRONT, UP) - 90) < 1


def test_the_photograph_is_scaled_as_scenes_of_co3d(frame):
    photograph = load_photograph()
    assert_allclose(axis_deviation(object_points(photograph)), 1, atol=1e-4)
    unit = axis_deviation(object_points(frame))
    assert_allclose(unit, 0.22, atol=0.005)  # metres, as the documentation says
    assert_allclose(photograph.depth * unit, frame.depth, rtol=1e-5)


def test_depth_follows_from_the_disparity_by_the_calibration(frame):
    *_, disparity = skimage.data.stereo_motorcycle()
    row, col = 330, 390  # on the engine
    x, _, z = frame.camera.unproject_camera(np.array([col + 0.5, row + 0.5]), frame.depth[row, col])
    # Middlebury's calibration, in metres and pixels. The principal point of the right camera lies
    # farther right.
    focal, centre, farther, baseline = 994.978, 311.193, 31.086, 0.193001
    seen = focal * (x - baseline) / z + centre + farther
    assert_allclose(seen, col + 0.5 - disparity[row, col], atol=1e-3)


@pytest.fixture(scope="module")
def motorcycles(tmp_path_factory):
    """A synthetic category "motorcycle" of two sequences of the object ELSEWHERE, with its true
    pose."""
    root = tmp_path_factory.mktemp("motorcycles")
    frames = around(ELSEWHERE)
    points = ELSEWHERE.apply(default_rng(0).uniform(-1, 1, (400, 3)))
    colours = np.full((400, 3), 128, np.uint8)
    trans = Sim3(1.0, ELSEWHERE.R @ CANONICAL, ELSEWHERE.t).matrix
    pose = {
        "trans": trans.tolist(),
        "scale": ELSEWHERE.scale,
        "low": [-1.0] * 3,
        "high": [1.0] * 3,
    }
    poses = dict.fromkeys(("second", "first"), pose)
    sequences = [SequenceData(name, frames, list(range(7)), points, colours) for name in poses]
    write_co3d(root, "motorcycle", sequences, quality=98)
    (root / "motorcycle/object_poses.json").write_text(json.dumps(poses))
    (root / "rendered_models.json").write_text("{}")
    return Co3D(root)


@pytest.fixture(scope="module")
def photograph():
    """A rendered frame that takes the place of the photograph."""
    rendered = render(look_at((-0.7, 1, 0.35)), AT_HOME, "photograph")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zsp_lite.course.motorcycle.load_photograph", lambda: rendered)
        yield rendered


def test_with_perfect_features_the_directions_and_the_cloud_are_those_of_the_object(
    motorcycles, photograph
):
    truth = photograph.camera.R @ CANONICAL
    # The cloud of the sequences, seen by the camera of the photograph.
    points = photograph.camera.to_camera(default_rng(0).uniform(-1, 1, (400, 3)))
    results = list(run_photograph(motorcycles, CoordinateBackbone()))
    assert len(results) == 4  # two foregrounds, two solvers
    for result in results:
        relative = result.estimate.target_camera.R @ ELSEWHERE.R @ photograph.camera.R.T
        error = rotation_error(result.estimate.sim3.R, relative)
        assert error < 12  # degrees: two patches
        assert_allclose(rotation_error(result.axes, truth), error, atol=1e-4)
        front, _, up = result.axes.T
        assert_allclose(result.front_error, vector_angle(front, FRONT), atol=1e-4)
        assert_allclose(result.up_error, vector_angle(up, UP), atol=1e-4)
        # The cloud has a size of 2; `along` is the coordinate of each point towards the front.
        assert np.linalg.norm(result.cloud - points, axis=1).mean() < 0.3
        assert np.corrcoef(points @ truth[:, 0], result.along)[0, 1] > 0.999


def test_a_folder_without_synthetic_motorcycles_gives_no_result(ellipsoids):
    assert list(run_photograph(ellipsoids, CoordinateBackbone())) == []


def test_the_demo_begins_with_the_credited_photograph(
    motorcycles, photograph, tmp_path, monkeypatch, loaded, run
):
    # Without the other pairs of the demo, for speed.
    monkeypatch.setattr("zsp_lite.course.demo.demo_pairs", lambda dataset: [])
    text = run(f"demo --data {motorcycles.root} --out {tmp_path}")
    page = (tmp_path / "report.html").read_text("utf-8")
    assert text.index("Photographed motorcycle") < text.index("One pair per category")
    assert text.count("│ verified ") == 2  # rows of the table, one for each foreground
    assert MODELS_NOTE in " ".join(text.split())
    assert "Which way does a real motorcycle stand?" in page
    assert "Middlebury" in page
