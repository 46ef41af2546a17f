"""The demo on synthetic data with known poses, and its HTML report and overview picture."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from plotly.offline import get_plotlyjs
from synthetic_views import CoordinateBackbone

from zsp_lite import Co3D
from zsp_lite.choices import SOLVERS
from zsp_lite.course.demo import N_TARGETS, demo_pairs, run_demo
from zsp_lite.data.pairs import pairs_path, sample_pairs, write_published_pairs
from zsp_lite.io.files import REPOSITORY
from zsp_lite.metrics import rotation_error
from zsp_lite.viz.plots import object_cloud
from zsp_lite.viz.report import (
    _two_poses_figure,
    overview,
    table_rows,
    write_overview,
    write_report,
)

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("closed_figures")]


@pytest.fixture
def exact_poses(monkeypatch):
    """Poses are drawn as they are, not rounded for equal pictures on all machines."""
    monkeypatch.setattr("zsp_lite.viz.plots._rounded", lambda pose: pose)


@pytest.fixture(scope="module")
def results(ellipsoids):
    """The demo on the ellipsoids: one pair, by both solvers."""
    return list(run_demo(ellipsoids, CoordinateBackbone(), SOLVERS["both"]))


@pytest.fixture(scope="module")
def page(results, tmp_path_factory) -> Path:
    """The report of the demo."""
    path = tmp_path_factory.mktemp("demo") / "in/report.html"
    return write_report(path, results, "a & b", "some/folder", "synthetic ellipsoids <script>")


@pytest.fixture
def text(page) -> str:
    """The text of the report."""
    return page.read_text("utf-8")


def test_the_demo_takes_a_pair_of_each_category_and_both_solvers(results):
    (result,) = results
    assert result.pair.category == "ellipsoid"
    assert list(result.errors) == ["paper", "verified"]


def test_with_perfect_features_the_demo_estimates_the_true_pose(results):
    (result,) = results
    assert max(result.errors.values()) < 12
    assert result.error < 6
    assert result.disagreement < 15
    assert result.estimate.inliers.sum() > 20


def test_shipped_evaluation_pairs_are_preferred(ellipsoids, tmp_path):
    dataset = Co3D(shutil.copytree(ellipsoids.root, tmp_path / "copy"))
    pairs = sample_pairs(dataset, "ellipsoid", 3, N_TARGETS, seed=11)
    path = pairs_path(dataset.root, "ellipsoid", 3, N_TARGETS)
    write_published_pairs(path, pairs, dataset)
    assert demo_pairs(dataset) == pairs[:1]


def test_alternatives_are_the_different_poses_below_the_best(results):
    (result,) = results
    estimate = result.estimates["verified"]
    different = [one for index, one in enumerate(estimate.hypotheses) if one.mode == index > 0]
    assert different
    assert estimate.alternatives == tuple(different)
    assert result.estimates["paper"].alternatives == ()


def test_the_angle_to_an_alternative_is_that_in_the_world(results):
    estimate = results[0].estimates["verified"]
    for one in estimate.alternatives:
        own = estimate.target_views[one.view].frame.camera
        in_target = estimate.target_camera.R @ own.R.T @ one.sim3.R
        angle = estimate.angle_to(one)
        assert angle == pytest.approx(rotation_error(estimate.sim3.R, in_target))
        assert angle >= 29.9  # poses within 30 degrees are the same


def test_the_page_loads_nothing_and_its_links_lead_to_notebooks(page, text):
    links = re.findall(r'\b(?:src|href)="([^"]*)"', text.replace(get_plotlyjs(), ""))
    local = [link for link in links if not link.startswith(("data:image/", "#pair-"))]
    files = [(page.parent / link).resolve() for link in local]
    assert {file.parent for file in files} == {REPOSITORY / "notebooks"}
    assert all(file.is_file() for file in files)


def test_the_page_is_of_moderate_size(text):
    assert len(text) < 12_000_000


@pytest.mark.parametrize("index, solver", [(0, "paper"), (1, "verified")])
def test_the_table_has_the_numbers_of_a_solver(results, index, solver):
    (result,) = results
    estimate = result.estimates[solver]
    expected = (
        "ellipsoid",
        solver,
        f"{estimate.view + 1} of 5",
        f"{estimate.inliers.sum()} of {len(estimate.inliers)}",
        f"{result.errors[solver]:.1f}°",
        "–" if solver == "paper" else f"{estimate.confidence:.2f}",
    )
    assert table_rows(result)[index][:6] == expected  # the time follows


def test_the_page_has_the_numbers_of_the_hypotheses(results, text):
    estimate = results[0].estimates["verified"]
    for one in estimate.alternatives:
        deficit = estimate.hypotheses[0].score - one.score
        cells = (f"{estimate.angle_to(one):.0f}°", f"{deficit:.1f}", f"{one.confidence:.2f}")
        assert "".join(f"<td>{cell}</td>" for cell in cells) in text


def test_the_page_says_where_the_answer_is_one_of_two(results, text, tmp_path):
    assert "One of two" not in text  # the features are perfect
    estimate = results[0].estimates["verified"]
    two = replace(results[0], estimates={"verified": replace(estimate, one_of_two=True)})
    page = write_report(tmp_path / "report.html", [two], "name").read_text("utf-8")
    assert "One of two" in page
    angle = estimate.angle_to(estimate.alternatives[0])
    assert f"turned by {angle:.0f} degrees" in page


def test_two_poses_are_shown_in_the_same_view(results, exact_poses):
    estimate = results[0].estimates["verified"]
    other = estimate.alternatives[0]
    _, best, second = _two_poses_figure(estimate).axes
    assert_array_equal(best.images[0].get_array(), second.images[0].get_array())
    camera, own = estimate.target_camera, estimate.target_views[other.view].frame.camera
    cloud = object_cloud(estimate.reference_view, most=1500)  # as many as the figure draws
    placed = {
        best: camera.to_world(estimate.sim3.apply(cloud)),
        second: own.to_world(other.sim3.apply(cloud)),
    }
    for axis, points in placed.items():
        pixels, depth = camera.project(points)
        far_to_near = pixels[np.argsort(-depth)]
        assert_allclose(axis.collections[0].get_offsets(), far_to_near, atol=1e-6)


@pytest.fixture
def poses(text) -> np.ndarray:
    """The poses of the scene, (N, 3, 4)."""
    (content,) = re.findall(r'<script type="application/json">(.*?)</script>', text)
    return np.array(json.loads(content)["poses"])


def test_the_scene_names_every_pose(text, poses):
    names = re.findall(r'<option value="\d">([^<]+)</option>', text)
    assert names[:3] == ["paper solver", "verified solver", "verified solver, hypothesis 2"]
    assert len(names) == len(poses)


def test_the_scene_has_the_poses_of_both_solvers_in_one_frame(results, poses):
    (result,) = results
    assert_allclose(poses[0], result.estimate.sim3.matrix[:3], atol=1e-5)
    (moved,) = result.estimates["verified"].propagate([result.estimate.target_camera])
    assert_allclose(poses[1], moved.matrix[:3], atol=1e-5)


def test_the_scene_has_the_alternatives_in_the_same_frame(results, poses):
    (result,) = results
    estimate = result.estimates["verified"]
    for pose, one in zip(poses[2:], estimate.alternatives, strict=True):
        own = estimate.target_views[one.view].frame.camera
        expected = result.estimate.target_camera.R @ own.R.T @ one.sim3.R
        rotation = pose[:, :3] / np.cbrt(np.linalg.det(pose[:, :3]))  # without its scale
        assert_allclose(rotation, expected, atol=1e-4)


def test_text_of_the_page_is_escaped(text):
    assert "synthetic ellipsoids &lt;script&gt;" in text
    assert "a &amp; b" in text


def test_all_text_of_a_pair_is_escaped(results, tmp_path):
    hostile = "<img src=x onerror=alert(1)>"
    estimate = replace(results[0].estimates["verified"], flags=(hostile,), timings={hostile: 1.0})
    result = replace(
        results[0],
        title=hostile,
        sources=(hostile, hostile),
        estimates={hostile: estimate},
        errors={hostile: 1.0},
    )
    path = write_report(tmp_path / "report.html", [result], hostile, hostile, hostile)
    page = path.read_text("utf-8")
    assert hostile not in page
    # Each of them at least once, some in several places.
    assert page.count("&lt;img src=x onerror=alert(1)&gt;") >= 15


@pytest.fixture
def axes(results, exact_poses):
    """The overview of the demo and of a pair with other errors, three pictures for each."""
    wrong = replace(results[0], title="$x$", errors={"paper": 30.4, "verified": 29.6})
    return overview([results[0], wrong]).axes


def test_the_overview_names_the_solvers_and_says_which_are_right(results, axes):
    names = [[text.get_text() for text in axis.texts] for axis in axes]
    right = [[f"right: {error:.0f}° off"] for error in results[0].errors.values()]
    assert names == [["ellipsoid"], *right, ["$x$"], ["wrong: 30° off"], ["right: 30° off"]]
    titles = ["reference", "paper solver", "verified solver", "", "", ""]
    assert [axis.get_title() for axis in axes] == titles
    colours = {axis.patches[0].get_edgecolor() for axis in axes[-2:]}  # of wrong and right
    assert len(colours) == 2


def test_the_overview_marks_the_pose_of_each_solver_in_its_view(results, axes):
    for axis, one in zip(axes[1:3], results[0].estimates.values()):
        cloud = one.sim3.apply(object_cloud(one.reference_view, most=20000))
        far_to_near = cloud[np.argsort(-cloud[:, 2])]
        pixels, _ = one.target_camera.project(one.target_camera.to_world(far_to_near))
        assert_allclose(axis.collections[0].get_offsets(), pixels)


def test_the_overview_is_written_as_jpeg(results, tmp_path):
    write_overview(tmp_path / "deep/overview.jpg", results)
    assert (tmp_path / "deep/overview.jpg").read_bytes().startswith(b"\xff\xd8")
