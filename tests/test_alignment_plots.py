"""Figures of notebooks 03 to 05 show the data that they are given."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from zsp_lite.data.cameras import Camera
from zsp_lite.viz import alignment_plots
from zsp_lite.viz.plots import CHOSEN

IMAGE = np.zeros((40, 40, 3), np.uint8)
RNG = np.random.default_rng(0)
MOVED = np.arange(3), np.arange(3) * 4  # displacements, and the rotation errors they cause


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def widths_of_frames(figure):
    """Line width of each picture's frame, by the title of the picture."""
    pictures = [axis for parent in figure.axes for axis in parent.child_axes]
    return {axis.get_title(): axis.spines["left"].get_linewidth() for axis in pictures}


def test_the_ring_frames_the_view_of_highest_score_and_has_the_reference_below():
    turns = np.radians([0, 60, 120, 180, 240, 300])
    places = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    scores, angles = np.array([-30.0, -20, -50, -40, -45, -41]), np.array([60.0, 0, 60, 120, 180, 120])
    figure = alignment_plots.view_ring(IMAGE, [IMAGE] * 6, (places, places[1:2]), scores, angles)
    frames = widths_of_frames(figure)
    assert max(frames, key=frames.get) == "2: -20.0, 0° chosen" and len(frames) == 7
    bars = [line.get_xydata() for line in figure.axes[0].lines]
    # View 2 stands on the reference's side, which is below; view 1 is the next one in clockwise order seen from above.
    np.testing.assert_allclose(bars[1][-1], [0, -1], atol=1e-9)
    np.testing.assert_allclose(bars[4][-1], [0, 1], atol=1e-9)
    (left, right), (low, high) = figure.axes[0].get_xlim(), figure.axes[0].get_ylim()
    for x, y, wide, tall in (axis.get_position().bounds for axis in figure.axes[0].child_axes):
        assert x >= 0 and y >= 0 and x + wide <= 1 and y + tall <= 1
    assert right - left == pytest.approx((high - low) * np.divide(*figure.get_size_inches()))


def test_each_score_rings_its_own_best_view():
    angles = np.array([10.0, 70.0, 170.0])
    figure = alignment_plots.scores_over_angle(angles, {"a": np.array([3.0, 2, 1]), "b": np.array([1.0, 2, 3])})
    first, second = (axis.collections for axis in figure.axes)
    assert first[1].get_offsets().tolist() == [[10, 3]] and second[1].get_offsets().tolist() == [[170, 3]]
    size = figure.get_size_inches() * figure.dpi
    assert size[0] / 2 >= 300 and size[1] >= 300


def test_accuracies_are_means_over_the_first_views_and_bars_span_them():
    figure = alignment_plots.accuracy_over_views((1, 2), {"full": [np.array([20.0, 40]), np.array([50.0, 70])]})
    (axis,) = figure.axes
    assert axis.lines[0].get_ydata().tolist() == [30, 60]
    assert [bar[:, 1].tolist() for bar in axis.collections[0].get_segments()] == [[20, 40], [50, 70]]


def test_mean_scores_are_relative_to_the_pair_and_by_angle():
    angles, scores = np.array([[10.0, 100.0], [20.0, 110.0]]), np.array([[4.0, 2.0], [10.0, 6.0]])
    figure = alignment_plots.choices_and_scores_over_angle(["car", "car"], angles[:, 0], angles, scores)
    left, right = figure.axes
    assert left.collections[0].get_offsets()[:, 0].tolist() == [10, 20]
    values = right.lines[0].get_ydata()
    assert values[[0, 3]].tolist() == [1.5, -1.5] and np.isnan(values[[1, 2, 4, 5]]).all()


def test_scores_of_views_are_labelled_by_view_and_angle():
    scores = {"reference": np.array([-3.0, -1.0]), "mirrored reference": np.array([-2.0, -4.0])}
    (axis,) = alignment_plots.scores_of_views(np.array([5.0, 65.0]), scores).axes
    assert [label.get_text() for label in axis.get_xticklabels()] == ["1\n5°", "2\n65°"]
    assert [line.get_ydata().tolist() for line in axis.lines] == [[-3, -1], [-2, -4]]


def test_all_winning_scores_are_counted():
    (axis,) = alignment_plots.winning_scores(np.array([-30.0, -31]), np.array([-36.0, -29, -33])).axes
    assert sum(bar.get_height() for bar in axis.patches[:18]) == 2


def test_unknown_depth_is_not_drawn_and_filled_depth_is():
    depth = np.array([[0.0, 2.0], [3.0, 0.0]])
    figure = alignment_plots.depth_with_holes(IMAGE, depth, np.where(depth > 0, depth, 2.5), (1, 4))
    holes, filled = (axis.images[1].get_array() for axis in figure.axes[1:3])
    assert np.ma.getmaskarray(holes).tolist() == (depth == 0).tolist()
    assert not np.ma.getmaskarray(filled).any()


def test_points_off_the_object_are_counted_and_crossed():
    points, off = RNG.normal(size=(5, 3)), np.array([True, False, False, True, False])
    figure = alignment_plots.points_from_above({"a": points, "b": points}, {"a": off, "b": ~off}, 0.2)
    assert "2 of 5 points" in figure.axes[0].get_title() and "3 of 5 points" in figure.axes[1].get_title()
    np.testing.assert_allclose(figure.axes[0].collections[1].get_offsets(), points[off][:, [0, 2]])


@pytest.mark.parametrize("shift", [0.0, 25.0])
def test_the_limits_lie_around_the_points_on_the_object_wherever_they_are(shift):
    points, off = RNG.normal(size=(5, 3)) + shift, np.array([False, False, False, False, True])
    far = points + [0, 0, 1000] * off[:, None]
    figure = alignment_plots.points_from_above({"a": far, "b": points}, {"a": off, "b": off}, 0.2)
    for axis in figure.axes:
        (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
        assert ((left < points[~off, 0]) & (points[~off, 0] < right)).all() and high - low < 20
        assert ((low < points[~off, 2]) & (points[~off, 2] < high)).all()
    assert panel_sizes(figure).min() >= 300


@pytest.mark.parametrize("move", [1.0, 12.0])
def test_a_far_outlier_is_inside_its_panel(move):
    target = RNG.normal(size=(4, 3))
    target[-1, 0] += move
    figure = alignment_plots.fits_with_one_outlier({"a": target, "b": target}, {"a": target, "b": target}, *MOVED)
    for axis in figure.axes[:1] + figure.axes[2:]:
        (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
        assert ((left < target[:, 0]) & (target[:, 0] < right)).all()
        assert ((high < target[:, 1]) & (target[:, 1] < low)).all()


def panel_sizes(figure):
    """Width and height of each panel in pixels."""
    figure.draw_without_rendering()
    return np.array([axis.get_window_extent().size for axis in figure.axes])


def test_filled_depths_of_each_part_are_counted_beyond_the_axis_too():
    figure = alignment_plots.filled_depth_errors({"in": np.array([0.0, 0.1]), "out": np.array([0.5])}, 0.2)
    assert [sum(bar.get_height() for bar in axis.patches) for axis in figure.axes] == [2, 1]


def test_residuals_join_fitted_points_to_their_targets():
    target, fitted = RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3))
    good = np.array([True, True, True, False])
    figure = alignment_plots.matched_points_after_fits(
        {"a": fitted, "b": target}, target, {"a": good, "b": good}, target
    )
    bad_line, good_lines = figure.axes[0].collections[1:3]
    np.testing.assert_allclose(bad_line.get_segments(), [[fitted[3, :2], target[3, :2]]])
    np.testing.assert_allclose(good_lines.get_segments(), np.stack([fitted[:3, :2], target[:3, :2]], axis=1))
    assert "3 of 4 residuals" in figure.axes[0].get_title()


def test_one_outlier_is_joined_to_the_point_that_was_fitted_to_it():
    target, fitted = RNG.normal(size=(4, 3)), RNG.normal(size=(4, 3))
    figure = alignment_plots.fits_with_one_outlier({"moved": fitted}, {"moved": target}, *MOVED)
    assert len(figure.axes[0].collections[0].get_segments()) == 4
    assert figure.axes[1].lines[0].get_ydata().tolist() == [0, 4, 8]


def test_trials_and_marked_shares_are_drawn():
    figure = alignment_plots.trials_over_good_share(np.array([0.2, 0.5]), {"s": [5000, 80]}, 1000, {"ours": 0.4})
    lines = figure.axes[0].lines
    assert lines[0].get_ydata().tolist() == [5000, 80] and set(lines[1].get_ydata()) == {1000}
    assert set(lines[2].get_xdata()) == {0.4}


def test_every_draw_of_a_sweep_has_a_dot_in_both_rows():
    results = {0.1: ([3, 4], [10.0, 20.0], 1), 0.2: ([8, 9], [5.0, 6.0], 7)}
    figure = alignment_plots.ransac_sweeps({"ours": ("threshold", results)}, matches=10)
    above, below = figure.axes
    assert [line.get_ydata().tolist() for line in above.lines] == [[3, 4], [1], [8, 9], [7]]
    assert [line.get_ydata().tolist() for line in below.lines] == [[10, 20], [5, 6]]


def test_the_middle_quartile_is_the_line():
    figure = alignment_plots.rotation_error_over_width(np.array([0.1, 1]), np.array([[1.0, 2, 4], [0.5, 1, 2]]), 0.05)
    assert figure.axes[0].lines[0].get_ydata().tolist() == [2, 1]


def test_the_chosen_view_has_the_colour_of_choices():
    figure = alignment_plots.scores_over_angle(np.array([1.0, 2.0]), {"a": np.array([0.0, 1.0])})
    assert plt.matplotlib.colors.to_hex(figure.axes[0].collections[1].get_edgecolors()[0]) == CHOSEN.lower()


def test_errors_of_formulas_have_one_curve_at_each_end():
    errors = {"arccos, single": ([1e-2], [2e-2]), "atan2, double": ([1e-9], [2e-9])}
    figure = alignment_plots.angle_errors_of_formulas(np.array([1.0]), errors)
    drawn = [[float(line.get_ydata()[0]) for line in axis.lines] for axis in figure.axes]
    assert drawn == [[1e-2, 1e-9, 1.0], [2e-2, 2e-9, 1.0]]


def test_the_chain_of_poses_draws_points_in_five_frames():
    camera = Camera(np.eye(3), np.zeros(3), np.array([40.0, 40.0]), np.array([20.0, 20.0]), (40, 40))
    points = RNG.normal(size=(6, 3)) + [0, 0, 10]
    worlds = {name: (points + shift, points) for shift, name in enumerate(("world of a", "cloud", "world of b"))}
    figure = alignment_plots.pose_chain((IMAGE, IMAGE), (camera, camera), (points, points), worlds)
    titles = [axis.get_title() for axis in figure.axes]
    assert titles == ["1  camera of a", "2  world of a", "3  cloud", "4  world of b", "5  camera of b", ""]
    moved = figure.axes[3].collections[1].get_offsets()
    np.testing.assert_allclose(moved, points[:, :2] + 2)
    size = figure.get_size_inches() * figure.dpi
    assert size[0] / 3 >= 300 and size[1] / 2 >= 300


def test_shares_of_benchmarks_are_two_panels_of_one_curve_each():
    figure = alignment_plots.share_of_benchmarks(np.array([0, 4]), {"100 pairs": np.array([[50, 68], [3, 8]])})
    assert [axis.lines[0].get_ydata().tolist() for axis in figure.axes] == [[50, 68], [3, 8]]


def test_measured_accuracies_are_drawn_per_method():
    values, density = np.array([40.0, 50.0]), np.array([0.1, 0.2])
    figure = alignment_plots.measured_accuracies({"100 pairs": [(values, density), (values, 2 * density)]}, ["a", "b"])
    assert [line.get_ydata().tolist() for line in figure.axes[0].lines] == [[0.1, 0.2], [0.2, 0.4]]


def test_measured_accuracies_are_shown_where_they_are_likely():
    values, density = np.array([70.0, 80, 90, 100]), np.array([1e-6, 0.1, 0.3, 0.1])
    figure = alignment_plots.measured_accuracies({"a": [(values, density)], "b": [(values, density)]}, ["one"])
    assert [axis.get_xlim() for axis in figure.axes] == [(80, 100), (80, 100)]


def test_each_accuracy_lies_on_its_own_interval():
    intervals = {"pairs": {"a": (30, 50), "b": (10, 20)}, "objects": {"a": (20, 60), "b": (5, 30)}}
    (axis,) = alignment_plots.accuracies_with_intervals({"a": 40.0, "b": 15.0}, intervals).axes
    for collection, dots, kind in zip(axis.collections, axis.lines, intervals):
        bars = collection.get_segments()
        assert [tuple(bar[:, 1]) for bar in bars] == list(intervals[kind].values())
        np.testing.assert_allclose([bar[0, 0] for bar in bars], dots.get_xdata())


def test_errors_have_a_row_per_category_with_its_median():
    (axis,) = alignment_plots.errors_by_category(np.array([10.0, 20, 170, 5]), ["car", "car", "car", "chair"]).axes
    rows = axis.collections[0].get_offsets()
    assert rows[:, 0].tolist() == [10, 20, 170] and (np.abs(rows[:, 1]) < 0.3).all()
    assert [line.get_xdata()[0] for line in axis.lines] == [20, 5, 30]


def test_distances_over_the_turn_are_drawn_per_object():
    (axis,) = alignment_plots.distances_over_turn(np.array([0, 90]), {"car": np.array([0.0, 2.0])}).axes
    assert axis.lines[0].get_ydata().tolist() == [0, 2]


def test_the_minimum_of_each_pair_is_marked():
    curves = {"car": np.array([[0.3, 0.2, 0.5], [0.1, 0.4, 0.6]])}
    (axis,) = alignment_plots.distances_between_instances(np.array([0, 90, 180]), curves).axes
    marks = [line for line in axis.lines if line.get_marker() == "v"]
    assert [(line.get_xdata()[0], line.get_ydata()[0]) for line in marks] == [(90, 0.2), (0, 0.1)]


def test_paired_errors_have_a_dot_per_pair():
    (axis,) = alignment_plots.paired_errors({"paper": np.array([5.0, 90]), "published": np.array([7.0, 10])}).axes
    assert axis.collections[0].get_offsets().tolist() == [[5, 7], [90, 10]]
    assert axis.get_xlabel() == "error, paper (degrees)"
