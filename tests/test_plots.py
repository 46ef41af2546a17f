"""Figures draw what they are given where it belongs: pixels, projections, orientations, signs, counts and intervals."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, look_at, render

from zsp_lite.data.cameras import Camera
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.verified.maps import Projection, ViewMaps
from zsp_lite.verified.verification import MAX_VIOLATION, SURFACE_SIGMA, PointTerms
from zsp_lite.viz import alignment_plots, feature_plots, plots, result_plots, scene3d, training_plots, verified
from zsp_lite.viz.plots import object_cloud
from zsp_lite.viz.reliability import draw_reliability, reliability

IMAGE = np.zeros((60, 80, 3), np.uint8)
CAMERA = Camera(np.eye(3), np.zeros(3), np.array([100.0, 100.0]), np.array([40.0, 30.0]), (60, 80))


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def test_a_map_covers_its_image_and_is_transparent_where_not_finite():
    _, (axis,) = plots.show_images([IMAGE])
    plots.overlay_map(axis, np.array([[0.0, -np.inf], [-3.0, np.nan]]))
    assert axis.images[-1].get_extent() == [0, 80, 60, 0]
    assert axis.images[-1].get_array().mask.tolist() == [[False, True], [False, True]]


def test_patches_are_marked_at_their_centres_in_pixels_x_y():
    centres = plots.patch_centres(np.array([[0, 0], [2, 3]]), (3, 4), (60, 80))
    np.testing.assert_allclose(centres, [[10, 10], [70, 50]])
    similar = np.zeros((3, 4))
    similar[2, 1] = 0.9
    figure = feature_plots.similarities_of_patch(IMAGE, (0, 0), [IMAGE], {"key": similar}, np.array([1, 3]))
    first, second = (axis for axis in figure.axes if axis.get_title())
    marks = [(line.get_marker(), *line.get_xydata()[0]) for axis in (first, second) for line in axis.lines]
    assert marks == [("o", 10, 10), ("o", 30, 50), ("*", 70, 30)]  # the patch, the most similar one, the true one


def test_lines_join_the_centres_of_matched_patches_and_those_of_outliers_are_dashed():
    cells = np.array([[0, 0], [1, 1], [2, 3]])
    figure = plots.show_matches([IMAGE, IMAGE], [cells, cells[::-1]], (3, 4), np.array([True, False, True]))
    lines = {(tuple(line.xy1), tuple(line.xy2)): line.get_linestyle() for line in figure.artists}
    assert set(lines) == {((10, 10), (70, 50)), ((30, 30), (30, 30)), ((70, 50), (10, 10))}
    assert [line in ("-", "solid") for line in lines.values()] == [False, True, True]  # outliers first, below


def test_intervals_stand_at_their_values_and_the_axis_holds_them_all():
    figure = plots.show_intervals([1, 9], {"a": ([2, 3], [1, 2], [4, 7]), "b": ([2, 3], [0, 2], [4, 5])})
    (axis,) = figure.axes
    ends = [bars.get_segments()[1][:, 1].tolist() for bars in axis.collections]
    assert ends == [[2, 7], [2, 5]] and axis.lines[0].get_xydata().tolist() == [[1, 2], [9, 3]]
    (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
    assert left < 1 < 9 < right and low < 0 < 7 < high


def test_equal_features_have_equal_colours_across_maps_and_the_background_is_white():
    features = np.random.default_rng(0).normal(size=(4, 5, 8))
    foreground = np.arange(4)[:, None].repeat(5, axis=1) > 0
    first, second = plots.pca_colours([features, features[::-1]], [foreground, foreground[::-1]])
    np.testing.assert_allclose(first, second[::-1])
    assert (first[0] == 1).all() and not (first[1:] == 1).all()


def test_points_and_axes_are_drawn_at_their_projections_and_nothing_behind_the_camera():
    _, (axis,) = plots.show_images([IMAGE])
    # With focal length 100 and principal point (40, 30), (0.1, 0, 1) is 10 pixels to the right of the latter.
    plots.draw_points(axis, CAMERA, np.array([[0.1, 0, 1], [0, 0, 2], [0, 0, -1]]))
    np.testing.assert_allclose(axis.collections[0].get_offsets(), [[40, 30], [50, 30]])
    plots.draw_axes(axis, CAMERA, lambda points: points + [0, 0, 2], np.zeros(3), 0.2)
    at = {text.get_text(): text.get_position() for text in axis.texts if text.get_text()}
    assert at["x"] == pytest.approx((50, 30)) and at["y"] == pytest.approx((40, 40))


def test_the_reference_is_drawn_where_the_pose_puts_it():
    """The object is the same, so the true place of every point is known."""
    reference = render(look_at((0.9, 0.3, 0.3)), AT_HOME, "a/0")
    targets = [render(look_at(ELSEWHERE.R @ at), ELSEWHERE, "b") for at in ((1, 0.2, 0.3), (0.8, -0.5, 0.2))]
    estimate = ZeroShotPose(CoordinateBackbone()).estimate(reference, targets)
    at_home = reference.camera.to_world(object_cloud(estimate.reference_view, most=1400))
    for axis, frame in zip(result_plots.pose_over_sequence(estimate, targets, "ab").axes, targets):
        expected, _ = frame.camera.project(ELSEWHERE.apply(at_home))
        shown = np.asarray(axis.collections[0].get_offsets())
        assert np.linalg.norm(np.sort(shown, axis=0) - np.sort(expected, axis=0), axis=1).mean() < 8


def test_the_ring_frames_the_view_of_highest_score_and_has_the_reference_below():
    turns = np.radians([0, 60, 120, 180, 240, 300])
    places = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    scores, angles = np.array([-30.0, -20, -50, -40, -45, -41]), np.array([60.0, 0, 60, 120, 180, 120])
    figure = alignment_plots.view_ring(IMAGE, [IMAGE] * 6, (places, places[1:2]), scores, angles)
    widths = {axis.get_title(): axis.spines["left"].get_linewidth() for axis in figure.axes[0].child_axes}
    assert max(widths, key=widths.get) == "2: -20.0, 0° chosen" and len(widths) == 7
    ends = [line.get_xydata()[-1] for line in figure.axes[0].lines]
    np.testing.assert_allclose([ends[1], ends[4]], [[0, -1], [0, 1]], atol=1e-9)


def test_clouds_from_above_have_depth_upwards_and_from_the_front_y_downwards():
    cloud = np.random.default_rng(0).normal(size=(50, 3)) + (0, 0, 9)
    front, above = result_plots.aligned_from_two_sides(cloud, cloud + 0.1).axes
    np.testing.assert_allclose(front.collections[1].get_offsets(), cloud[:, [0, 1]])
    np.testing.assert_allclose(above.collections[1].get_offsets(), cloud[:, [0, 2]])
    assert front.yaxis_inverted() and not above.yaxis_inverted()


def test_what_lies_outside_a_picture_is_counted_and_not_drawn():
    pixels = np.array([[10.0, 10], [20, 20]])
    cases = {"right": pixels, "wrong": np.array([[10.0, 10], [200, 20]]), "far": pixels + 100}
    figure, inside = result_plots.landing_points(IMAGE, IMAGE, pixels, cases)
    assert inside == {"right": 1.0, "wrong": 0.5, "far": 0.0}
    assert [len(axis.collections[0].get_offsets()) for axis in figure.axes[:4]] == [2, 2, 1, 0]


def test_a_scene_has_equal_axes_robust_to_outliers_and_y_down():
    cloud = np.random.default_rng(0).uniform(-1, 1, (30_000, 3)) * [1, 2, 3]
    figure = scene3d.aligned_clouds(cloud, cloud[:100])
    assert [len(trace.x) for trace in figure.data] == [2000, 100] and figure.layout.scene.camera.up.y == -1
    cloud[:10] = 100
    lengths = [high - low for low, high in scene3d.axis_ranges(cloud).values()]
    np.testing.assert_allclose(lengths, 1.2 * 6, rtol=0.05)


def test_each_kind_of_point_is_told_from_the_others_and_drawn_where_it_projects():
    # Points: on the surface, far behind it, far before it, outside the silhouette, over a hole in the depth.
    behind, weight = torch.tensor([0.0, 1, -1, 0, 0]), torch.tensor([1.0, 1, 1, 0, 0])
    off, pixels = torch.tensor([0.0, 0, 0, 0.4, 0]), torch.tensor([[10.0, 5], [20, 5], [30, 5], [55, 5], [20, 20]])
    parts = (3 + behind, torch.full((5,), 3.0), weight, off, torch.arange(5), pixels)
    touch = weight * torch.exp(-(behind**2) / (2 * SURFACE_SIGMA**2))
    front = weight * (-(behind + SURFACE_SIGMA) / MAX_VIOLATION).clamp(0, 1)
    values = (touch, off / MAX_VIOLATION, front, torch.zeros(5))
    terms = PointTerms(Projection(*(x[None, None] for x in parts)), *(x[None, None] for x in values))
    # The maps have half the image's size: their pixel 10 is pixel 20 of the image.
    maps = ViewMaps(
        torch.eye(3)[None], torch.zeros(1, 3), torch.ones(1), torch.zeros(1, 2), torch.tensor([[40.0, 30.0]]),
        torch.zeros(1, dtype=torch.long), torch.zeros(1200, 4), torch.tensor([[2.0, 2.0]]),
    )  # fmt: skip
    assert verified.classify_points(terms).tolist() == [[0, 1, 2, 3, 4]]
    assert list(verified.POINT_CLASSES)[2:4] == ["in free space", "outside the silhouette"]
    figure = verified.show_point_classes([IMAGE], terms, maps, [0], ["view"], ["pose"])
    drawn = np.concatenate([collection.get_offsets() for collection in figure.axes[0].collections])
    # The point beyond the border (110) stands at it (80).
    np.testing.assert_allclose(sorted(map(tuple, drawn)), [(20, 10), (40, 10), (40, 40), (60, 10), (80, 10)])


def test_reliability_points_lie_at_confidence_and_frequency_with_wilsons_interval():
    _, axis = plt.subplots()
    measured = reliability(np.repeat([0.2, 0.9], 10), np.tile(np.arange(10) < 3, 2), bins=2)
    draw_reliability(axis, measured)
    np.testing.assert_allclose(axis.containers[0][0].get_xydata(), [[0.2, 0.3], [0.9, 0.3]])
    # For 3 of 10, from a table: 10.8 % to 60.3 %.
    low, high = axis.containers[0][2][0].get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((0.108, 0.603), abs=1e-3)


def test_the_same_place_has_the_same_colour_and_the_background_is_white():
    surface = np.full((1, 3, 3), np.nan, np.float32)
    surface[0, :2] = 0.5
    first, second, background = training_plots.coordinate_picture(surface)[0]
    assert (first == second).all() and (background == 1).all() and not (first == 1).any()


def test_a_running_mean_stands_at_the_middle_of_its_window():
    steps, means = training_plots.smoothed([3.0, 0.0, 3.0, 6.0], 3)
    assert steps.tolist() == [2, 3] and means.tolist() == [2, 3]


def test_a_query_is_framed_and_small_weights_are_left_out():
    target = np.zeros((2, 4, 4))
    target[1, 2, 3] = 1
    figure = training_plots.show_query(np.zeros((2, 32, 32, 3), np.float32), (1, 2), target, target * 0)
    query, drawn, _, answer = figure.axes
    assert query.patches[0].get_xy() == (16, 8) and query.patches[0].get_width() == 8
    assert drawn.images[1].get_array().compressed().tolist() == [1]
    assert answer.images[1].get_array().compressed().size == 0
