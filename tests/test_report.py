"""The demo on synthetic data with known poses, and its HTML report and overview picture."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from plotly.offline import get_plotlyjs
from synthetic_views import CoordinateBackbone

from zsp_lite.choices import SOLVERS
from zsp_lite.course.demo import N_TARGETS, demo_pairs, run_demo
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
    monkeypatch.setattr("zsp_lite.viz.plots._rounded", lambda pose: pose)


@pytest.fixture(scope="module")
def results(ellipsoids):
    return list(run_demo(ellipsoids, CoordinateBackbone(), SOLVERS["both"]))


@pytest.fixture(scope="module")
def page(results, tmp_path_factory):
    path = tmp_path_factory.mktemp("demo") / "in/report.html"
    return write_report(path, results, "a & b", "some/folder", "synthetic ellipsoids <script>")


@pytest.fixture(scope="module")
def text(page):
    return page.read_text(encoding="utf-8")


def test_with_perfect_features_the_demo_estimates_the_true_pose(results):
    assert [result.pair.category for result in results] == ["ellipsoid"]
    assert list(results[0].errors) == ["paper", "verified"] and max(results[0].errors.values()) < 12
    assert results[0].error < 6 and results[0].disagreement < 15
    assert results[0].estimate.inliers.sum() > 20


def test_shipped_evaluation_pairs_are_preferred(ellipsoids):
    from zsp_lite.data.pairs import pairs_path, sample_pairs, write_published_pairs

    pairs = sample_pairs(ellipsoids, "ellipsoid", 3, N_TARGETS, seed=11)
    path = pairs_path(ellipsoids.root, "ellipsoid", 3, N_TARGETS)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_published_pairs(path, pairs, ellipsoids)
    assert demo_pairs(ellipsoids) == pairs[:1]


def test_alternatives_are_the_different_poses_below_the_best_with_angles_in_the_world(results):
    estimate = results[0].estimates["verified"]
    found = estimate.alternatives
    assert results[0].estimates["paper"].alternatives == ()
    assert (
        found
        == tuple(one for index, one in enumerate(estimate.hypotheses) if one.mode == index > 0)
        != ()
    )
    # The angle does not depend on the view in which the poses are expressed.
    for one in found:
        own = estimate.target_views[one.view].frame.camera
        in_target = estimate.target_camera.R @ own.R.T @ one.sim3.R
        assert estimate.angle_to(one) == pytest.approx(rotation_error(estimate.sim3.R, in_target))
        assert estimate.angle_to(one) >= 29.9


def test_the_page_loads_nothing_and_its_links_lead_to_notebooks(page, text):
    links = re.findall(r'\b(?:src|href)="([^"]*)"', text.replace(get_plotlyjs(), ""))
    local = [link for link in links if not link.startswith(("data:image/", "#pair-"))]
    assert local and {(page.parent / link).resolve().parent for link in local} == {
        REPOSITORY / "notebooks"
    }
    assert all((page.parent / link).is_file() for link in local)
    assert len(text) < 12_000_000


def test_the_table_has_the_numbers_of_both_solvers_and_the_page_those_of_the_hypotheses(
    results, text
):
    (result,) = results
    for solver, row in zip(("paper", "verified"), table_rows(result), strict=True):
        estimate = result.estimates[solver]
        assert row[:3] == ("ellipsoid", solver, f"{estimate.view + 1} of 5")
        assert row[3] == f"{estimate.inliers.sum()} of {len(estimate.inliers)}"
        assert row[4] == f"{result.errors[solver]:.1f}°"
        assert row[5] == ("–" if solver == "paper" else f"{estimate.confidence:.2f}")
    for one in estimate.alternatives:
        deficit = estimate.hypotheses[0].score - one.score
        cells = (f"{estimate.angle_to(one):.0f}°", f"{deficit:.1f}", f"{one.confidence:.2f}")
        assert "".join(f"<td>{cell}</td>" for cell in cells) in text


def test_two_poses_are_shown_in_the_same_view_where_the_answer_is_one_of_two(
    results, text, exact_poses, tmp_path
):
    assert "One of two" not in text  # the features are perfect
    estimate = results[0].estimates["verified"]
    other = estimate.alternatives[0]
    two = replace(results[0], estimates={"verified": replace(estimate, one_of_two=True)})
    page = write_report(tmp_path / "report.html", [two], "name").read_text(encoding="utf-8")
    assert f"turned by {estimate.angle_to(other):.0f} degrees" in page and "One of two" in page
    _, best, second = _two_poses_figure(estimate).axes
    assert_array_equal(best.images[0].get_array(), second.images[0].get_array())
    camera, own = estimate.target_camera, estimate.target_views[other.view].frame.camera
    cloud = object_cloud(estimate.reference_view, most=1500)
    for axis, points in (
        (best, camera.to_world(estimate.sim3.apply(cloud))),
        (second, own.to_world(other.sim3.apply(cloud))),
    ):
        pixels, depth = camera.project(points)
        assert_allclose(axis.collections[0].get_offsets(), pixels[np.argsort(-depth)], atol=1e-6)


def test_the_scene_has_every_pose_in_one_frame(results, text):
    (result,) = results
    (content,) = re.findall(r'<script type="application/json">(.*?)</script>', text)
    content = json.loads(content)
    names = re.findall(r'<option value="\d">([^<]+)</option>', text)
    assert names[:3] == ["paper solver", "verified solver", "verified solver, hypothesis 2"]
    assert len(names) == len(content["poses"])
    estimate = result.estimates["verified"]
    for rotation, one in zip(
        np.array(content["poses"])[2:, :, :3], estimate.alternatives, strict=True
    ):
        own = estimate.target_views[one.view].frame.camera
        expected = result.estimate.target_camera.R @ own.R.T @ one.sim3.R
        assert_allclose(rotation / np.cbrt(np.linalg.det(rotation)), expected, atol=1e-4)
    assert_allclose(content["poses"][0], result.estimate.sim3.matrix[:3], atol=1e-5)
    moved = result.estimates["verified"].propagate([result.estimate.target_camera])[0]
    assert_allclose(content["poses"][1], moved.matrix[:3], atol=1e-5)


def test_all_text_is_escaped(results, text, tmp_path):
    assert "synthetic ellipsoids &lt;script&gt;" in text and "a &amp; b" in text
    hostile = "<img src=x onerror=alert(1)>"
    estimate = replace(results[0].estimates["verified"], flags=(hostile,), timings={hostile: 1.0})
    own = {
        "title": hostile,
        "sources": (hostile, hostile),
        "estimates": {hostile: estimate},
        "errors": {hostile: 1.0},
    }
    result = replace(results[0], **own)
    page = write_report(tmp_path / "report.html", [result], hostile, hostile, hostile).read_text(
        encoding="utf-8"
    )
    assert hostile not in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;") >= 15


def test_the_overview_marks_the_pose_of_each_solver_in_its_view(results, tmp_path, exact_poses):
    wrong = replace(results[0], title="$x$", errors={"paper": 30.4, "verified": 29.6})
    figure = overview([results[0], wrong])
    names = [[text.get_text() for text in axis.texts] for axis in figure.axes]
    rightly = [[f"right: {error:.0f}° off"] for error in results[0].errors.values()]
    assert names == [["ellipsoid"], *rightly, ["$x$"], ["wrong: 30° off"], ["right: 30° off"]]
    assert [axis.get_title() for axis in figure.axes] == [
        "reference",
        "paper solver",
        "verified solver",
        "",
        "",
        "",
    ]
    assert figure.axes[4].patches[0].get_edgecolor() != figure.axes[5].patches[0].get_edgecolor()
    for axis, one in zip(figure.axes[1:3], results[0].estimates.values()):
        cloud = one.sim3.apply(object_cloud(one.reference_view, most=20000))
        pixels, _ = one.target_camera.project(
            one.target_camera.to_world(cloud[np.argsort(-cloud[:, 2])])
        )
        assert_allclose(axis.collections[0].get_offsets(), pixels)
    write_overview(tmp_path / "deep/overview.jpg", results)
    assert (tmp_path / "deep/overview.jpg").read_bytes()[:2] == b"\xff\xd8"
