"""The demo on synthetic data with known poses, and its HTML report and overview picture."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from synthetic_views import CoordinateBackbone

from zsp_lite.data.frames import read_image
from zsp_lite.demo import demo_pairs, run_demo
from zsp_lite.points import object_cloud
from zsp_lite.viz.report import COLUMNS, _views_figure, render_page, table_row, write_overview, write_report

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def results(ellipsoids):
    return list(run_demo(ellipsoids, CoordinateBackbone()))


@pytest.fixture(scope="module")
def text(results):
    return render_page(results, "some/folder", "synthetic ellipsoids <script>", "a & b")


def test_with_perfect_features_the_demo_estimates_the_true_pose(results):
    assert [result.pair.category for result in results] == ["ellipsoid"]
    assert results[0].error < 6
    assert results[0].estimate.inliers.sum() > 20


def test_demo_pairs_are_deterministic(ellipsoids):
    assert demo_pairs(ellipsoids) == demo_pairs(ellipsoids)


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


def test_the_table_row_shows_the_estimate(results):
    category, view, inliers, error, seconds = table_row(results[0])
    estimate = results[0].estimate
    assert len(COLUMNS) == 5
    assert (category, view) == ("ellipsoid", f"{estimate.view + 1} of 5")
    assert inliers == f"{estimate.inliers.sum()} of {len(estimate.inliers)}"
    assert error.endswith("°") and seconds.endswith(" s")


class Outline(HTMLParser):
    def __init__(self):
        super().__init__()
        self.images, self.links, self.open = [], [], []

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "img":
            self.images.append(attributes)
        self.links += [attributes[name] for name in ("src", "href") if name in attributes]
        if tag not in ("img", "meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_well_formed_and_self_contained(text):
    outline = Outline()
    outline.feed(text)
    assert not outline.open
    assert outline.links and all(link.startswith(("data:image/", "#pair-")) for link in outline.links)
    assert len(text) < 12_000_000


def test_the_page_has_every_stage_and_every_image_has_an_alternative_text(text):
    outline = Outline()
    outline.feed(text)
    for stage in ("Reference and target views", "Saliency", "Cyclical distances", "Correspondences",
                  "Aligned point clouds", "The pose in the target sequence"):  # fmt: skip
        assert text.count(f"<h3>{stage}</h3>") == 1
    assert len(outline.images) == 5
    assert all(len(image["alt"]) > 20 for image in outline.images)


def test_plotlys_script_is_inlined_once_and_draws_each_scene(text):
    assert len(re.findall(r"Plotly\.newPlot\(", text)) == 1
    assert "plotly.js v" in text


def test_all_text_is_escaped(results, text):
    assert "synthetic ellipsoids &lt;script&gt;" in text and "a &amp; b" in text
    hostile = "<img src=x onerror=alert(1)>"
    pair = replace(results[0].pair, category=hostile, reference_sequence=hostile, target_sequence=hostile)
    estimate = replace(results[0].estimate, flags=(hostile,), timings={hostile: 1.0})
    page = render_page([replace(results[0], pair=pair, estimate=estimate)], hostile, hostile, hostile)
    assert hostile not in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;") == 11


def test_a_view_that_was_left_out_has_no_score(results):
    estimate = results[0].estimate
    scores = np.where(np.arange(5) == (estimate.view + 1) % 5, -np.inf, estimate.view_scores)
    figure = _views_figure(replace(results[0], estimate=replace(estimate, view_scores=scores)))
    titles = [axis.get_title() for axis in figure.axes]
    assert sum("left out" in title for title in titles) == 1 and sum("score" in title for title in titles) == 4
    assert not any("inf" in title for title in titles)


def test_the_report_is_written_to_its_path(results, tmp_path):
    path = write_report(tmp_path / "deep" / "report.html", results, "folder", "note", "name")
    assert path.read_text().startswith("<!doctype html>")


def test_the_overview_shows_all_results(results, tmp_path):
    picture = read_image(write_overview(tmp_path / "deep" / "overview.jpg", results * 2))
    height, width = picture.shape[:2]
    assert 2 < width / height < 4  # two rows of six square images


def test_frames_with_an_empty_mask_are_left_out_of_the_overview(results, tmp_path):
    (result,) = results
    empty = [replace(frame, mask=np.zeros_like(frame.mask)) for frame in result.sequence[:4]]
    sequence = (*empty, *result.sequence[4:])
    whole = read_image(write_overview(tmp_path / "whole.jpg", results))
    assert read_image(write_overview(tmp_path / "some.jpg", [replace(result, sequence=sequence)])).shape == whole.shape
