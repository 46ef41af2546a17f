"""The photograph in the demo, with a rendered stand-in of known pose: estimated directions, table, figure and page."""

import json

import numpy as np
import pytest
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, look_at, render

from zsp_lite.cli.demo import MODELS_NOTE
from zsp_lite.cli.main import main
from zsp_lite.data.co3d import Co3D, SequenceData, write_co3d
from zsp_lite.data.photograph import PHOTOGRAPH_FRONT, PHOTOGRAPH_UP
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.viz.photograph import PHOTOGRAPH_CREDIT, photograph_figure, run_photograph
from zsp_lite.viz.report import render_page

pytestmark = pytest.mark.slow

CANONICAL = look_at((1, 0.5, 0.2)).R  # front, left and up of the object, in the coordinates of `synthetic_views`


@pytest.fixture(scope="module")
def motorcycles(tmp_path_factory):
    """A synthetic category "motorcycle" with two sequences, elsewhere in their world, and their object poses."""
    root, sequences, poses = tmp_path_factory.mktemp("motorcycles"), [], {}
    points = np.random.default_rng(0).uniform(-1, 1, (400, 3))
    for name in ("second", "first"):
        angles = np.linspace(0, 2 * np.pi, 7, endpoint=False)
        cameras = [look_at(ELSEWHERE.R @ (np.cos(a), np.sin(a), 0.3)) for a in angles]
        frames = [render(camera, ELSEWHERE, f"{name}/{i}") for i, camera in enumerate(cameras)]
        colours = np.full((400, 3), 128, np.uint8)
        sequences.append(SequenceData(name, frames, list(range(7)), ELSEWHERE.apply(points), colours))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = ELSEWHERE.R @ CANONICAL, ELSEWHERE.t
        poses[name] = {"trans": pose.tolist(), "scale": ELSEWHERE.scale, "low": [-1.0] * 3, "high": [1.0] * 3}
    write_co3d(root, "motorcycle", sequences, quality=98)
    (root / "motorcycle" / "object_poses.json").write_text(json.dumps(poses))
    (root / "rendered_models.json").write_text("{}")
    return Co3D(root)


@pytest.fixture(scope="module")
def photograph():
    return render(look_at((-0.7, 1, 0.35)), AT_HOME, "photograph")


@pytest.fixture(scope="module")
def results(motorcycles, photograph):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zsp_lite.viz.photograph.motorcycle_photograph", lambda: photograph)
        return list(run_photograph(motorcycles, CoordinateBackbone()))


def test_with_perfect_features_the_directions_are_those_of_the_object(results, photograph):
    truth = photograph.camera.R @ CANONICAL
    for result in results:
        relative = result.estimate.target_camera.R @ ELSEWHERE.R @ photograph.camera.R.T
        error = rotation_error(result.estimate.sim3.R, relative)
        assert error < 12 and rotation_error(result.axes, truth) == pytest.approx(error, abs=1e-4)


def test_the_aligned_cloud_lies_on_the_photographed_object(results, photograph):
    rng = np.random.default_rng(0)
    expected = photograph.camera.to_camera(rng.uniform(-1, 1, (400, 3)))
    for result in results:
        assert np.linalg.norm(result.cloud - expected, axis=1).mean() < 0.3
        front = expected @ (photograph.camera.R @ CANONICAL)[:, 0]
        assert np.corrcoef(front, result.along)[0, 1] > 0.999


def test_errors_are_angles_to_the_directions_judged_by_eye(results):
    for result in results:
        front, _, up = result.axes.T
        for error, direction, by_eye in (
            (result.front_error, front, PHOTOGRAPH_FRONT),
            (result.up_error, up, PHOTOGRAPH_UP),
        ):
            unit = np.array(by_eye) / np.linalg.norm(by_eye)
            assert 2 * np.degrees(np.arcsin(np.linalg.norm(direction - unit) / 2)) == pytest.approx(error, abs=1e-4)


def test_the_sequence_may_be_given_and_must_exist(motorcycles, photograph, monkeypatch):
    monkeypatch.setattr("zsp_lite.viz.photograph.motorcycle_photograph", lambda: photograph)
    assert next(run_photograph(motorcycles, CoordinateBackbone(), "second")).sequence == "second"
    with pytest.raises(InputError, match="third"):
        next(run_photograph(motorcycles, CoordinateBackbone(), "third"))


def test_foregrounds_and_solvers_may_be_chosen(motorcycles, photograph, monkeypatch):
    monkeypatch.setattr("zsp_lite.viz.photograph.motorcycle_photograph", lambda: photograph)
    (one,) = run_photograph(motorcycles, CoordinateBackbone(), foregrounds=["mask"], solvers=["paper"])
    assert (one.foreground, one.solver) == ("mask", "paper")
    with pytest.raises(InputError, match="solver"):
        list(run_photograph(motorcycles, CoordinateBackbone(), foregrounds=["mask"], solvers=["nobody's"]))


def test_a_folder_without_synthetic_motorcycles_gives_no_result(ellipsoids):
    assert list(run_photograph(ellipsoids, CoordinateBackbone())) == []


def test_the_figure_has_a_panel_per_result_beside_the_object_and_the_directions_by_eye(results):
    figure = photograph_figure(results)
    titles = [axis.get_title() for axis in figure.axes]
    assert len(titles) == 6 and "first" in titles[0] and "by eye" in titles[3]
    for title, result in zip((titles[1], titles[2], titles[4], titles[5]), results):
        assert result.solver in title and f"front {result.front_error:.0f}°, up {result.up_error:.0f}° off" in title
    arrows = [[text.get_text() for text in axis.texts if text.get_text()] for axis in figure.axes]
    assert arrows == [[], *[["front", "left", "up"]] * 5]


def test_the_page_begins_with_the_photograph_and_credits_it(results):
    page = render_page([], "backbone", photograph=results)
    assert page.index("Which way does a real motorcycle stand?") < page.index("One pair of each category")
    assert PHOTOGRAPH_CREDIT in page and "judged by eye" in page and "first" in page
    assert "real motorcycle" not in render_page([], "backbone")


def test_the_demo_begins_with_the_photograph(motorcycles, photograph, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("zsp_lite.viz.photograph.motorcycle_photograph", lambda: photograph)
    monkeypatch.setattr("zsp_lite.demo.run_demo", lambda dataset, backbone, solvers: iter(()))
    monkeypatch.setattr("zsp_lite.backbones.load.load_backbone", lambda name: CoordinateBackbone())
    monkeypatch.setattr(CoordinateBackbone, "name", "coordinates", raising=False)
    monkeypatch.setattr("zsp_lite.viz.report.write_overview", lambda *others: None)
    assert main(["demo", "--data", str(motorcycles.root), "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert text.index("Photographed motorcycle") < text.index("One pair per category")
    assert text.count("│ verified ") == 2 and "own saliency" in text and MODELS_NOTE in " ".join(text.split())
    assert "Which way does a real motorcycle stand?" in (tmp_path / "report.html").read_text()
