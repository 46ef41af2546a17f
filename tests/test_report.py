"""The demo on synthetic data with known poses, and its HTML report and overview picture."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
from synthetic_views import CoordinateBackbone

from zsp_lite.choices import SOLVERS
from zsp_lite.data.frames import read_image
from zsp_lite.data.samples import REPOSITORY
from zsp_lite.demo import demo_pairs, run_demo
from zsp_lite.metrics import rotation_error
from zsp_lite.points import object_cloud
from zsp_lite.viz.report import (
    COLUMNS,
    _notebook_link,
    _two_poses_figure,
    _views_figure,
    render_page,
    stage_figures,
    table_rows,
    write_overview,
    write_report,
)

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results(ellipsoids):
    return list(run_demo(ellipsoids, CoordinateBackbone(), SOLVERS["both"]))


@pytest.fixture(scope="module")
def text(results):
    return render_page(results, "a & b", REPOSITORY, "some/folder", "synthetic ellipsoids <script>")


def test_with_perfect_features_the_demo_estimates_the_true_pose(results):
    assert [result.pair.category for result in results] == ["ellipsoid"]
    assert list(results[0].errors) == ["paper", "verified"] and max(results[0].errors.values()) < 12
    assert results[0].error < 6 and results[0].disagreement < 15
    assert results[0].estimate.inliers.sum() > 20


def test_a_notebook_on_another_drive_is_named_without_a_link(monkeypatch):
    def fail(*arguments):
        raise ValueError("path is on mount 'C:', start on mount 'D:'")

    monkeypatch.setattr("zsp_lite.viz.report._project_url", lambda label: None)
    assert 'href="notebooks/01_features.ipynb"' in _notebook_link("01_features", REPOSITORY)
    monkeypatch.setattr("zsp_lite.viz.report.os.path.relpath", fail)
    assert _notebook_link("01_features", REPOSITORY) == "notebook 01"


def test_shipped_evaluation_pairs_are_preferred(ellipsoids):
    from zsp_lite.data.pairs import sample_pairs, upstream_pairs_path, write_upstream_pairs

    pairs = sample_pairs(ellipsoids, "ellipsoid", 3, 2, seed=11)
    path = upstream_pairs_path(ellipsoids.root, "ellipsoid", 3, 2)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_upstream_pairs(path, pairs, ellipsoids)
    assert demo_pairs(ellipsoids, n_targets=2) == pairs[:1]


def test_the_object_cloud_is_the_visible_surface(results):
    cloud = object_cloud(results[0].estimate.reference_view, most=500)
    assert cloud.shape == (500, 3)
    # The cameras are at a distance of 4 from the centre of an object of radius 1.6.
    assert (np.abs(cloud[:, 2] - 4) < 1.7).all()


def test_the_table_has_a_row_for_each_solver(results):
    (result,) = results
    for solver, row in zip(("paper", "verified"), table_rows(result), strict=True):
        title, name, view, inliers, error, confidence, seconds = row
        estimate = result.estimates[solver]
        assert (title, name, view) == ("ellipsoid", solver, f"{estimate.view + 1} of 5")
        assert inliers == f"{estimate.inliers.sum()} of {len(estimate.inliers)}"
        assert error == f"{result.errors[solver]:.1f}°" and seconds.endswith(" s")
        assert confidence == ("–" if solver == "paper" else f"{estimate.confidence:.2f}")
    assert len(COLUMNS) == 7


def test_alternatives_are_the_different_poses_below_the_best_with_angles_in_the_world(results):
    estimate = results[0].estimates["verified"]
    found = estimate.alternatives
    assert results[0].estimates["paper"].alternatives == ()
    different = [one for index, one in enumerate(estimate.hypotheses) if one.mode == index]
    assert len(different) == len(found) + 1 > 1
    assert [one.rank for one in found] == list(range(2, len(found) + 2))
    # The angle does not depend on the view in which the poses are expressed.
    target = estimate.target_camera
    for one, hypothesis in zip(found, different[1:]):
        own = estimate.target_views[hypothesis.view].frame.camera
        in_target = target.R @ own.R.T @ hypothesis.sim3.R
        assert one.angle == pytest.approx(rotation_error(estimate.sim3.R, in_target)) and one.angle >= 29.9
        assert one.probability == hypothesis.confidence
        assert one.deficit == estimate.hypotheses[0].score - hypothesis.score >= 0


class Outline(HTMLParser):
    def __init__(self):
        super().__init__()
        self.images, self.links, self.open = [], [], []

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "img":
            self.images.append(attributes)
        self.links += [attributes[name] for name in ("src", "href") if name in attributes]
        if tag not in ("img", "meta", "br", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_well_formed_and_self_contained(text):
    outline = Outline()
    outline.feed(text)
    assert not outline.open
    local = [link for link in outline.links if not link.startswith(("data:image/", "#pair-"))]
    assert local and all(link.startswith("notebooks/") for link in local)  # nothing is loaded from elsewhere
    assert all((REPOSITORY / link).is_file() for link in local)
    assert len(text) < 12_000_000


def test_the_page_has_every_stage_and_every_image_has_an_alternative_text(text):
    outline = Outline()
    outline.feed(text)
    for stage in ("Reference and target views", "Saliency", "Cyclical distances", "Correspondences",
                  "Aligned point clouds", "The pose in the target sequence: paper solver",
                  "The pose in the target sequence: verified solver"):  # fmt: skip
        assert text.count(f"<h3>{stage}</h3>") == 1
    assert len(outline.images) == 6
    assert all(len(image["alt"]) > 20 for image in outline.images)


def test_plotlys_script_is_inlined_once_and_draws_each_scene(text):
    assert len(re.findall(r"Plotly\.newPlot\(", text)) == 1
    assert "plotly.js v" in text


def test_the_page_shows_both_answers_with_confidence_and_hypotheses(results, text):
    estimate = results[0].estimates["verified"]
    for solver, error in results[0].errors.items():
        assert f"<h3>{solver} solver: rotation error {error:.1f}°</h3>" in " ".join(text.split("\n"))
    assert f"Confidence {estimate.confidence:.2f}: the estimated probability" in text
    assert "This solver does not estimate its confidence." in text
    for one in estimate.alternatives:
        cells = (f"{one.rank}", f"{one.angle:.0f}°", f"{one.deficit:.1f}", f"{one.probability:.2f}")
        assert "".join(f"<td>{cell}</td>" for cell in cells) in text


def test_two_poses_are_shown_side_by_side_where_the_answer_is_one_of_two(results, text):
    assert "One of two" not in text  # the features are perfect
    estimate = results[0].estimates["verified"]
    doubtful = replace(results[0], estimates={"verified": replace(estimate, one_of_two=True)})
    first, *others = stage_figures(doubtful, "scene")
    assert first.title == "One of two: both poses of the verified solver"
    assert f"turned by {estimate.alternatives[0].angle:.0f} degrees" in first.alt and first.wide
    assert not any("One of two" in stage.title for stage in others)
    figure = _two_poses_figure(doubtful, estimate)
    titles = [axis.get_title() for axis in figure.axes]
    assert titles[0] == f"probability {estimate.confidence:.2f}"
    assert titles[1].endswith(f"°, probability {estimate.alternatives[0].probability:.2f}")
    assert len(titles) == 6  # two poses in three frames
    # Both columns show the same frames; what is drawn over them differs.
    for left, right in zip(figure.axes[::2], figure.axes[1::2]):
        np.testing.assert_array_equal(left.images[0].get_array(), right.images[0].get_array())
        assert not np.allclose(left.collections[0].get_offsets().mean(0), right.collections[0].get_offsets().mean(0))
    plt.close(figure)


def test_terms_are_explained_and_stages_lead_to_their_notebooks(text):
    for term in ("eq. 2", "eq. 3", "CLS token", "nats"):
        assert re.search(rf'<abbr tabindex="0" title="[^"]{{40,}}">{re.escape(term)}</abbr>', text), term
    verified = ("11_hypotheses_and_evidence", "12_score_and_calibration")
    for name in ("01_features", "02_cyclical_maps", "03_best_view", "04_umeyama_ransac", *verified):
        assert f'href="notebooks/{name}.ipynb"' in text


def test_links_lead_to_the_projects_site_where_its_address_is_known(results, monkeypatch):
    monkeypatch.setattr("zsp_lite.viz.report._project_url", {"Documentation": "https://host/course/"}.get)
    assert 'href="https://host/course/notebooks/01_features.html"' in render_page(results, "b")


def test_outside_the_clone_notebooks_are_linked_in_the_repository_or_named_only(results, monkeypatch, tmp_path):
    monkeypatch.setattr("zsp_lite.viz.report.REPOSITORY", tmp_path)
    monkeypatch.setattr("zsp_lite.viz.report._project_url", {"Repository": "https://host/code"}.get)
    assert 'href="https://host/code/blob/main/notebooks/01_features.ipynb"' in render_page(results, "b")
    monkeypatch.setattr("zsp_lite.viz.report._project_url", lambda label: None)
    page = render_page(results, "b")
    assert "More: notebook 01." in page and ".ipynb" not in page


def test_the_page_follows_the_colour_scheme_and_its_figures_have_no_ground(text):
    assert "@media (prefers-color-scheme: dark)" in text
    images = re.findall(r'src="data:image/webp;base64,([^"]+)"', text)
    assert len(images) == 6
    for image in images:
        array = cv2.imdecode(np.frombuffer(base64.b64decode(image), np.uint8), cv2.IMREAD_UNCHANGED)
        assert array.shape[2] == 4 and array[0, 0, 3] == 0


def test_the_scene_has_every_pose_in_one_frame_the_pictures_colours_and_leaves_the_wheel_to_the_page(results, text):
    (result,) = results
    (content,) = re.findall(r'<script type="application/json">(.*?)</script>', text)
    content = json.loads(content)
    names = re.findall(r'<option value="\d">([^<]+)</option>', text)
    assert names[:3] == ["paper solver", "verified solver", "verified solver, hypothesis 2"]
    assert len(names) == len(content["poses"])
    np.testing.assert_allclose(content["poses"][0], result.estimate.sim3.matrix[:3], atol=1e-5)
    moved = result.estimates["verified"].propagate([result.estimate.target_camera])[0]
    np.testing.assert_allclose(content["poses"][1], moved.matrix[:3], atol=1e-5)
    assert len(content["points"]) == len(content["pictures"][0]) and len(set(content["pictures"][0])) > 50
    assert all(re.fullmatch("#[0-9a-f]{6}", colour) for colour in content["pictures"][0])
    assert '"scrollZoom": false' in text


def test_all_text_is_escaped(results, text):
    assert "synthetic ellipsoids &lt;script&gt;" in text and "a &amp; b" in text
    hostile = "<img src=x onerror=alert(1)>"
    estimate = replace(results[0].estimates["verified"], flags=(hostile,), timings={hostile: 1.0})
    result = replace(
        results[0],
        title=hostile,
        sources=(hostile, hostile),
        estimates={hostile: estimate},
        errors={hostile: 1.0},
    )
    page = render_page([result], hostile, data=hostile, data_note=hostile)
    assert hostile not in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;") >= 15


def test_a_view_that_was_left_out_has_no_score(results):
    estimate = results[0].estimate
    scores = np.where(np.arange(5) == (estimate.view + 1) % 5, -np.inf, estimate.view_scores)
    left_out = {"paper": replace(estimate, view_scores=scores)}
    figure = _views_figure(replace(results[0], estimates=left_out))
    titles = [axis.get_title() for axis in figure.axes]
    assert sum("left out" in title for title in titles) == 1 and sum("score" in title for title in titles) == 4
    assert not any("inf" in title for title in titles)


def test_views_of_the_verified_solver_have_their_angle_to_the_reference(results):
    verified = results[0].estimates["verified"]
    figure = _views_figure(replace(results[0], estimates={"verified": verified}))
    titles = [axis.get_title() for axis in figure.axes]
    assert titles[1:] == [f"target {k}\nangle {-score:.0f}°" for k, score in enumerate(verified.view_scores, 1)]


def test_the_overview_shows_all_results(results, tmp_path):
    assert write_report(tmp_path / "in/report.html", results, "folder", "note", "name").read_text()[0] == "<"
    picture = read_image(write_overview(tmp_path / "deep" / "overview.jpg", results * 2))
    height, width = picture.shape[:2]
    assert 2 < width / height < 4  # two rows of six square images


def test_frames_with_an_empty_mask_are_left_out_of_the_overview(results, tmp_path):
    (result,) = results
    empty = [replace(frame, mask=np.zeros_like(frame.mask)) for frame in result.sequence[:4]]
    sequence = (*empty, *result.sequence[4:])
    whole = read_image(write_overview(tmp_path / "whole.jpg", results))
    assert read_image(write_overview(tmp_path / "some.jpg", [replace(result, sequence=sequence)])).shape == whole.shape
