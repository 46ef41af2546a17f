"""Plots: artists are drawn at the right positions, and 3D scenes stay small."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError
from zsp_lite.viz import plots, scene3d

IMAGE = np.zeros((60, 80, 3), np.uint8)
CAMERA = Camera(np.eye(3), np.zeros(3), np.array([100.0, 100.0]), np.array([40.0, 30.0]), (60, 80))


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def test_images_are_shown_in_a_grid_with_titles_and_without_ticks():
    figure, axes = plots.show_images([IMAGE] * 3, ["a", "b", "c"], columns=2)
    assert [axis.get_title() for axis in axes] == ["a", "b", "c"]
    assert len(figure.axes) == 4  # two rows of two, the last one empty
    assert not any(axis.axison for axis in figure.axes)


def test_axis_limits_are_the_edges_of_the_image():
    _, (axis,) = plots.show_images([IMAGE])
    assert axis.get_xlim() == (0, 80) and axis.get_ylim() == (60, 0)


@pytest.mark.parametrize(("images", "titles"), [([], None), ([IMAGE], ["a", "b"])])
def test_no_image_and_too_many_titles_raise(images, titles):
    with pytest.raises(InputError, match="expected"):
        plots.show_images(images, titles)


def test_a_map_covers_its_image_and_is_transparent_where_not_finite():
    _, (axis,) = plots.show_images([IMAGE])
    plots.overlay_map(axis, np.array([[0.0, -np.inf], [-3.0, np.nan]]))
    drawn = axis.images[-1]
    assert drawn.get_extent() == [0, 80, 60, 0]
    assert drawn.get_array().mask.tolist() == [[False, True], [False, True]]


def test_patch_centres_are_pixels_x_y():
    # A grid of 3 x 4 over 60 x 80 pixels has patches of 20 x 20.
    centres = plots.patch_centres(np.array([[0, 0], [2, 3]]), (3, 4), (60, 80))
    np.testing.assert_allclose(centres, [[10, 10], [70, 50]])


def test_outliers_are_dashed_and_inliers_solid():
    pixels = np.array([[10.0, 10], [20, 20], [30, 30]])
    figure = plots.draw_matches(IMAGE, IMAGE, pixels, pixels, np.array([True, False, True]))
    styles = [artist.get_linestyle() for artist in figure.artists]
    assert len(styles) == 3 and sum(style in ("-", "solid") for style in styles) == 2


def test_matches_of_different_lengths_raise():
    with pytest.raises(InputError, match="3 reference pixels, 2 target pixels"):
        plots.draw_matches(IMAGE, IMAGE, np.zeros((3, 2)), np.zeros((2, 2)))


def test_equal_features_have_equal_colours_across_maps():
    features = np.random.default_rng(0).normal(size=(4, 5, 8))
    first, second = plots.pca_colours([features, features[::-1]])
    np.testing.assert_allclose(first, second[::-1])
    assert first.shape == (4, 5, 3) and first.min() >= 0 and first.max() <= 1


def test_background_patches_are_white():
    features = np.random.default_rng(0).normal(size=(4, 5, 8))
    foreground = np.ones((4, 5), bool)
    foreground[0] = False
    (colours,) = plots.pca_colours([features], [foreground])
    assert (colours[0] == 1).all() and not (colours[1:] == 1).all()


def test_pca_of_two_patches_raises():
    with pytest.raises(InputError, match="at least 3"):
        plots.pca_colours([np.zeros((1, 2, 8))])


def test_points_are_drawn_at_their_pixels_and_points_behind_the_camera_are_not():
    _, (axis,) = plots.show_images([IMAGE])
    # With focal length 100 and principal point (40, 30), (0.1, 0, 1) is 10 pixels to the right of the latter.
    plots.draw_points(axis, CAMERA, np.array([[0.1, 0, 1], [0, 0, 2], [0, 0, -1]]))
    np.testing.assert_allclose(axis.collections[0].get_offsets(), [[40, 30], [50, 30]])
    assert axis.get_xlim() == (0, 80)


def test_axes_are_drawn_at_their_projections():
    _, (axis,) = plots.show_images([IMAGE])
    plots.draw_axes(axis, CAMERA, lambda points: points + [0, 0, 2], np.zeros(3), 0.2)
    at = {text.get_text(): text.get_position() for text in axis.texts if text.get_text()}
    assert at["x"] == pytest.approx((50, 30)) and at["y"] == pytest.approx((40, 40))


def test_coordinate_colours_run_along_the_longest_axis():
    points = np.random.default_rng(0).normal(size=(200, 3)) * [1, 5, 1]
    colours = plots.coordinate_colours(points)
    assert abs(np.corrcoef(colours[:, 1], points[:, 1])[0, 1]) > 0.95  # the green channel of viridis is increasing


def test_a_scene_has_at_most_four_thousand_points_and_a_marker_per_cloud():
    cloud = np.random.default_rng(0).normal(size=(30_000, 3))
    figure = scene3d.aligned_clouds(cloud, cloud[:100])
    assert [len(trace.x) for trace in figure.data] == [2000, 100]
    assert len({trace.marker.symbol for trace in figure.data}) == 2
    assert [trace.name for trace in figure.data] == ["reference, aligned", "target"]
    assert figure.layout.scene.camera.up.y == -1
    assert len(figure.to_html(full_html=False, include_plotlyjs=False)) < 300_000


def test_a_scene_is_deterministic_for_a_seed():
    cloud = np.random.default_rng(0).normal(size=(5000, 3))
    first, second = (scene3d.aligned_clouds(cloud, cloud, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.data[0].x, second.data[0].x)


@pytest.mark.parametrize("cloud", [np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_an_empty_cloud_and_values_that_are_not_finite_raise(cloud):
    with pytest.raises(InputError, match="empty or not finite"):
        scene3d.aligned_clouds(cloud, np.zeros((4, 3)))


def test_axis_ranges_are_equal_in_length_and_robust_to_outliers():
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * [1, 2, 3]
    points[:10] = 100
    ranges = scene3d.axis_ranges(points)
    lengths = [high - low for low, high in ranges.values()]
    np.testing.assert_allclose(lengths, 1.2 * 6, rtol=0.05)
    np.testing.assert_allclose([sum(limits) / 2 for limits in ranges.values()], 0, atol=0.2)
