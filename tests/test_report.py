"""The demo on synthetic data with known poses, and its HTML report."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from plotly.offline import get_plotlyjs
from synthetic_views import CoordinateBackbone

from zsp_lite import Camera, Co3D, ZeroShotPose
from zsp_lite.choices import SOLVERS
from zsp_lite.course.demo import N_TARGETS, demo_pairs
from zsp_lite.data.evaluation import sample_pairs
from zsp_lite.data.writing import pairs_path, write_published_pairs
from zsp_lite.estimates import Hypothesis, PoseEstimate
from zsp_lite.io.files import REPOSITORY
from zsp_lite.metrics import rotation_error
from zsp_lite.scans.pair_result import run_pair
from zsp_lite.viz.plots import show_residuals
from zsp_lite.viz.report import write_report

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("closed_figures")]


@pytest.fixture(scope="module")
def results(ellipsoids):
    """The demo on the ellipsoids: one pair, by both solvers."""
    method = ZeroShotPose(CoordinateBackbone())
    pairs = demo_pairs(ellipsoids)
    return [run_pair(ellipsoids, pair, method, SOLVERS["both"]) for pair in pairs]


@pytest.fixture(scope="module")
def page(results, tmp_path_factory) -> Path:
    """The report of the demo."""
    path = tmp_path_factory.mktemp("demo") / "in/report.html"
    return write_report(path, results, "name", "data")


@pytest.fixture
def text(page) -> str:
    """The text of the report."""
    return page.read_text("utf-8")


def test_shipped_evaluation_pairs_are_preferred(ellipsoids, tmp_path):
    dataset = Co3D(shutil.copytree(ellipsoids.root, tmp_path / "copy"))
    pairs = sample_pairs(dataset, "ellipsoid", 3, N_TARGETS, seed=11)
    path = pairs_path(dataset.root, "ellipsoid", 3, N_TARGETS)
    write_published_pairs(path, pairs, dataset)
    assert demo_pairs(dataset) == pairs[:1]


def rotation_seen_by(camera: Camera, estimate: PoseEstimate, pose: Hypothesis) -> np.ndarray:
    """The rotation from the reference's camera to a camera, by a hypothesis, which is a pose in
    its own target view."""
    view_camera = estimate.target_views[pose.view].frame.camera
    return camera.R @ view_camera.R.T @ pose.sim3.R


def test_the_angle_to_an_alternative_is_that_in_the_world(results):
    estimate = results[0].estimates["verified"]
    for pose in estimate.alternatives:
        rotation = rotation_seen_by(estimate.target_camera, estimate, pose)
        angle = estimate.angle_to(pose)
        assert angle == pytest.approx(rotation_error(estimate.sim3.R, rotation))
        assert angle >= 29.9  # poses within 30 degrees are of one mode, up to rounding


def test_the_page_loads_nothing_and_its_links_lead_to_notebooks(page, text):
    links = re.findall(r'\b(?:src|href)="([^"]*)"', text.replace(get_plotlyjs(), ""))
    local = [link for link in links if not link.startswith(("data:image/", "#pair-"))]
    files = [(page.parent / link).resolve() for link in local]
    assert {file.parent for file in files} == {REPOSITORY / "notebooks"}
    assert all(file.is_file() for file in files)


def test_the_page_has_the_errors_and_the_numbers_of_the_hypotheses(results, text):
    (result,) = results
    assert all(f"<td>{error:.1f}°</td>" in text for error in result.errors.values())
    estimate = result.estimates["verified"]
    for pose in estimate.alternatives:
        deficit = estimate.hypotheses[0].score - pose.score
        cells = (f"{estimate.angle_to(pose):.0f}°", f"{deficit:.1f}", f"{pose.confidence:.2f}")
        assert "".join(f"<td>{cell}</td>" for cell in cells) in text


def test_the_page_says_where_the_answer_is_one_of_two(results, text, tmp_path):
    assert "One of two" not in text  # with perfect features the answer is certain
    estimate = results[0].estimates["verified"]
    uncertain = replace(results[0], estimates={"verified": replace(estimate, one_of_two=True)})
    page = write_report(tmp_path / "report.html", [uncertain], "name", "data").read_text("utf-8")
    assert "One of two" in page
    angle = estimate.angle_to(estimate.alternatives[0])
    assert f"turned by {angle:.0f} degrees" in page


def test_lines_end_at_the_partners_and_a_fit_marks_its_inliers(results):
    estimate = results[0].estimate
    source, target = estimate.points
    views = estimate.reference_view, estimate.target_views[estimate.view]
    (fitted,) = show_residuals(views, (source, target), {"estimate": estimate.sim3}).axes
    pixels, _ = views[1].frame.camera.project(views[1].frame.camera.to_world(target))
    # The threshold of RANSAC is 0.2.
    inliers = np.linalg.norm(estimate.sim3.apply(source) - target, axis=1) < 0.2
    _, lines, discs = fitted.collections
    assert_allclose(discs.get_offsets(), pixels[inliers])
    # Every third outlier has a line.
    assert len(lines.get_segments()) == len(pixels[~inliers][::3])


@pytest.fixture
def poses(text) -> np.ndarray:
    """The poses of the scene, (N, 3, 4)."""
    (content,) = re.findall(r'<script type="application/json">(.*?)</script>', text)
    return np.array(json.loads(content)["poses"])


def test_the_scene_has_the_poses_of_both_solvers_in_one_frame(results, text, poses):
    (result,) = results
    names = re.findall(r'<option value="\d">([^<]+)</option>', text)
    assert names[:2] == ["paper solver", "verified solver"]
    assert len(names) == len(poses)
    assert_allclose(poses[0], result.estimate.sim3.matrix[:3], atol=1e-5)
    (moved,) = result.estimates["verified"].propagate([result.estimate.target_camera])
    assert_allclose(poses[1], moved.matrix[:3], atol=1e-5)


def test_the_scene_has_the_alternatives_in_the_same_frame(results, poses):
    (result,) = results
    estimate = result.estimates["verified"]
    for matrix, pose in zip(poses[2:], estimate.alternatives, strict=True):
        expected = rotation_seen_by(result.estimate.target_camera, estimate, pose)
        scaled = matrix[:, :3]
        assert_allclose(scaled / np.cbrt(np.linalg.det(scaled)), expected, atol=1e-4)


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
    # The ten texts given above stand in 15 places or more; some of them stand in several.
    assert page.count("&lt;img src=x onerror=alert(1)&gt;") >= 15
