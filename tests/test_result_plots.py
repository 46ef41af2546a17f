"""Figures of results: points lie where the pose puts them, and every panel shows what its title says."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from synthetic_views import AT_HOME, DIRECTIONS, ELSEWHERE, CoordinateBackbone, look_at, render

from zsp_lite.estimates import match_points
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import object_cloud
from zsp_lite.viz import result_plots
from zsp_lite.viz.plots import BLUE, ORANGE

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def frames():
    """The reference, and five views of the same object elsewhere."""
    reference = render(look_at((0.9, 0.3, 0.3)), AT_HOME, "a/0")
    cameras = [look_at(ELSEWHERE.R @ direction) for direction in DIRECTIONS]
    return reference, [render(camera, ELSEWHERE, f"b/{i}") for i, camera in enumerate(cameras)]


@pytest.fixture(scope="module")
def estimate(frames):
    return ZeroShotPose(CoordinateBackbone()).estimate(*frames)


def drawn_points(axis):
    """Positions of the largest scatter plot of an axis."""
    return max((one.get_offsets() for one in axis.collections), key=len)


def test_the_overview_draws_the_points_before_and_after_the_pose(estimate):
    figure = result_plots.pose_overview(estimate, "a $ title", points=300)
    first, chosen, moved = figure.axes
    assert figure.get_suptitle() == r"a \$ title" and f"target {estimate.view + 1}" in chosen.get_title()
    assert len(drawn_points(first)) == len(drawn_points(moved)) == 300 and not chosen.collections
    cloud = estimate.sim3.apply(object_cloud(estimate.reference_view, most=300))
    camera = estimate.target_camera
    expected, _ = camera.project(camera.to_world(cloud[np.argsort(-cloud[:, 2])]))
    np.testing.assert_allclose(drawn_points(moved), expected, atol=1e-6)


def test_the_box_of_the_crop_is_drawn_on_the_frame(frames):
    figure = result_plots.crop_steps(frames[0], frames[0])
    (box,) = figure.axes[0].patches
    rows, cols = np.nonzero(frames[0].mask > 0.4)
    assert box.get_x() <= cols.min() and box.get_x() + box.get_width() > cols.max()
    assert box.get_y() <= rows.min() and box.get_y() + box.get_height() > rows.max()


def test_the_sheet_has_a_row_per_view_and_frames_the_chosen_one(estimate):
    views = [estimate.reference_view, *estimate.target_views]
    maps = [np.full(views[0].features.grid, -float(i)) for i in range(5)]
    figure = result_plots.stage_sheet(views, maps, [f"row {i}" for i in range(6)], estimate.view)
    panels = np.reshape(figure.axes[:24], (6, 4)).T
    assert [axis.get_title() for axis in panels[:, 0]] == ["crop", "features", "saliency", "cyclical distance"]
    assert [axis.texts[0].get_text() for axis in panels[0]] == [f"row {i}" for i in range(6)]
    assert [len(axis.patches) for axis in panels[0]] == [int(i == 1 + estimate.view) for i in range(6)]
    assert [float(axis.images[-1].get_array().mean()) for axis in panels[3, 1:]] == [0, -1, -2, -3, -4]
    saliency = panels[2, 0].images[-1].get_array()
    assert np.array_equal(~saliency.mask, views[0].foreground.numpy())


def test_a_match_has_one_colour_in_both_panels(estimate):
    views = estimate.reference_view, estimate.target_views[estimate.view]
    points = match_points(*views, estimate.matches)
    figure = result_plots.matched_points(views, points, ("first", "second"))
    for axis, matched in zip(figure.axes, points):
        shown = axis.collections[1]
        order = np.argsort(np.argsort(points[0][:, 1]))
        np.testing.assert_allclose(shown.get_offsets(), matched[:, :2])  # perfect matches are all near the object
        assert np.array_equal(shown.get_array(), order)
        assert f"{len(matched)} of {len(matched)}" in axis.get_title()


def test_the_histogram_counts_inliers_and_outliers():
    residuals = np.array([0.05, 0.12, 0.15, 0.7, 5.0])
    figure = result_plots.residual_histogram(residuals, residuals < 0.2, 0.2)
    heights = [sum(bar.get_height() for bar in container) for container in figure.axes[0].containers]
    assert heights == [3, 2]
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert {"3 inliers", "2 outliers", "threshold"} == set(labels)


def test_clouds_from_above_have_depth_upwards_and_from_the_front_y_downwards():
    cloud = np.random.default_rng(0).normal(size=(50, 3)) + (0, 0, 9)
    front, above = result_plots.aligned_from_two_sides(cloud, cloud + 0.1).axes
    np.testing.assert_allclose(front.collections[1].get_offsets(), cloud[:, [0, 1]])
    np.testing.assert_allclose(above.collections[1].get_offsets(), cloud[:, [0, 2]])
    assert front.yaxis_inverted() and not above.yaxis_inverted()


def test_the_pose_is_carried_to_every_frame_of_the_sequence(estimate, frames):
    with_axes = result_plots.pose_over_sequence(estimate, frames[1], list("abcde"))
    without = result_plots.pose_over_sequence(estimate, frames[1], list("abcde"), show_axes=False)
    cloud = object_cloud(estimate.reference_view, most=1400)
    at_home = frames[0].camera.to_world(cloud)  # the object is the same, so the truth is known
    for axis, frame in zip(without.axes, frames[1]):
        expected, _ = frame.camera.project(ELSEWHERE.apply(at_home))
        shown = np.asarray(drawn_points(axis))
        assert np.linalg.norm(np.sort(shown, axis=0) - np.sort(expected, axis=0), axis=1).mean() < 8
        assert not axis.texts
    assert all(axis.texts for axis in with_axes.axes[:5])


def test_points_on_images_keep_their_colours(frames):
    cloud = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3)) + (0, 0, 4)
    colours = np.random.default_rng(1).uniform(size=(40, 3))
    figure = result_plots.points_on_images(frames[1][:2], [cloud, cloud + 0.1], [colours] * 2, ["a", "b"])
    for axis in figure.axes:
        shown = axis.collections[0].get_facecolors()[:, :3]
        np.testing.assert_allclose(shown, colours[np.argsort(-cloud[:, 2])])


def test_a_zoomed_panel_is_a_square_around_the_object(frames):
    frame, cloud = frames[0], np.array([[0.0, 0, 4]])
    (axis,) = result_plots.points_on_images([frame], [cloud], [np.ones((1, 3))], ["a"], zoom=True).axes
    rows, cols = np.nonzero(frame.mask > 0.4)
    left, right, low, high = *axis.get_xlim(), *axis.get_ylim()
    assert left < cols.min() and cols.max() < right and high < rows.min() and rows.max() < low
    assert right - left == pytest.approx(low - high)
    assert right - left < 1.4 * max(np.ptp(rows) + 1, np.ptp(cols) + 1)


def test_the_foreground_is_transparent_elsewhere(estimate):
    view = replace(estimate.reference_view)
    (axis,) = result_plots.foregrounds([view], ["own"]).axes
    assert np.array_equal(~axis.images[-1].get_array().mask, view.foreground.numpy())


def test_errors_against_the_viewpoint_have_a_marker_per_group():
    figure = result_plots.errors_against_viewpoint([10, 20, 170], [5, 50, 175], ["car", "chair", "car"])
    axis = figure.axes[0]
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["car", "chair"]
    assert [one.get_offsets().tolist() for one in axis.collections] == [[[10, 5], [170, 175]], [[20, 50]]]


def test_label_errors_have_a_median_and_a_high_curve_per_number_of_keypoints():
    errors = {4: np.array([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]), 8: np.ones((2, 3))}
    axis = result_plots.label_error_curves((0.01, 0.02), errors).axes[0]
    assert axis.lines[0].get_ydata().tolist() == [2, 4] and axis.lines[1].get_ydata()[0] == pytest.approx(2.9)
    assert axis.lines[2].get_ydata().tolist() == [1, 1]


def test_overlays_show_the_wanted_sides_in_their_colours():
    own, moved = np.random.default_rng(0).normal(size=(2, 30, 3))
    figure = result_plots.cloud_overlays([(own, moved)] * 2, ["side", "above"], [(0, 2), (0, 1)], 2)
    for axis, shown in zip(figure.axes, ([0, 2], [0, 1])):
        for drawn, cloud, colour in zip(axis.collections, (own, moved), (ORANGE, BLUE)):
            np.testing.assert_allclose(drawn.get_offsets(), cloud[:, shown])
            np.testing.assert_allclose(drawn.get_facecolors()[0], plt.matplotlib.colors.to_rgba(colour))


def test_landing_points_outside_the_picture_are_counted_and_not_drawn():
    picture = np.zeros((60, 80, 3), np.uint8)
    pixels = np.array([[10.0, 10], [20, 20]])
    cases = {"right": pixels, "wrong": np.array([[10.0, 10], [200, 20]]), "far": pixels + 100}
    figure, inside = result_plots.landing_points(picture, picture, pixels, cases)
    assert inside == {"right": 1.0, "wrong": 0.5, "far": 0.0}
    assert [len(axis.collections[0].get_offsets()) for axis in figure.axes[:4]] == [2, 2, 1, 0]
    notes = [[text.get_text() for text in axis.texts] for axis in figure.axes[:4]]
    assert notes == [[], [], [], ["no point in this picture"]]


def test_fused_clouds_have_y_downwards():
    cloud, colours = np.random.default_rng(0).normal(size=(20, 3)), np.full((20, 3), 255, np.uint8)
    (axis,) = result_plots.fused_clouds({"one": (cloud, colours)}, points=10).axes
    x, z, up = axis.collections[0]._offsets3d
    kept = cloud[np.random.default_rng(0).permutation(20)[:10]]
    assert axis.get_title() == "one" and len(x) == 10
    np.testing.assert_allclose(np.sort(up), np.sort(-kept[:, 1]))


def test_accuracies_and_intervals_are_drawn_as_they_are():
    cells = np.array([[10.0, 90.0]])
    axis = result_plots.category_heatmap(cells, ["ours"], ["car", "chair"], "Acc30 (%)").axes[0]
    assert [text.get_text() for text in axis.texts] == ["10", "90"]
    bounds = np.array([[20.0, 60.0], [30.0, 50.0]])
    axis = result_plots.interval_against_pairs([25, 100], [44.0, 40.0], bounds).axes[0]
    assert axis.lines[0].get_ydata().tolist() == [44, 40]
    np.testing.assert_allclose(axis.lines[1].get_ydata(), [20, 30])  # 40 - 100 / sqrt(n)
    axis = result_plots.accuracy_of_wrong_labels([0, 10], {"within 15°": [50, 40]}).axes[0]
    assert axis.lines[0].get_ydata().tolist() == [50, 40]
