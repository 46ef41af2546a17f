"""Plots of trainings show the values that they are given, at the right places."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from zsp_lite.viz import training_plots


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


def test_the_same_place_has_the_same_colour_and_the_background_is_white():
    surface = np.full((1, 3, 3), np.nan, np.float32)
    surface[0, :2] = 0.5
    first, second, background = training_plots.coordinate_picture(surface)[0]
    assert (first == second).all() and (background == 1).all() and not (first == 1).any()


def test_a_running_mean_stands_at_the_middle_of_its_window():
    steps, means = training_plots.smoothed([3.0, 0.0, 3.0, 6.0], 3)
    assert steps.tolist() == [2, 3] and means.tolist() == [2, 3]


def test_a_collapse_is_drawn_against_the_largest_entropy():
    rows = [{"teacher_entropy": 1.0, "kl": 0.5, "information": 0.25}] * 12
    figure = training_plots.show_collapses({"both": rows, "none": rows[:9]}, outputs=512)
    entropy = figure.axes[0]
    assert [len(line.get_xdata()) for line in entropy.lines[:2]] == [4, 1]
    assert entropy.lines[2].get_ydata()[0] == pytest.approx(np.log(512))
    assert [axis.lines[0].get_ydata()[0] for axis in figure.axes] == pytest.approx([1, 0.5, 0.25])


def test_a_query_is_framed_and_small_weights_are_left_out():
    target = np.zeros((2, 4, 4))
    target[1, 2, 3] = 1
    views = np.zeros((2, 32, 32, 3), np.float32)
    figure = training_plots.show_query(views, (1, 2), target, target * 0)
    query, drawn, _, answer = figure.axes
    assert query.patches[0].get_xy() == (16, 8) and query.patches[0].get_width() == 8
    assert drawn.images[1].get_array().compressed().tolist() == [1]
    assert answer.images[1].get_array().compressed().size == 0


def test_supervision_is_white_off_the_object():
    inside = np.eye(2, dtype=bool)
    view, normals = np.zeros((16, 16, 3), np.float32), np.zeros((2, 2, 3), np.float32)
    figure = training_plots.show_supervision(view, normals, np.ones((2, 2)), np.ones((2, 2)), inside)
    colours = figure.axes[1].images[0].get_array()
    np.testing.assert_allclose(colours[0, 0], 0.5)
    np.testing.assert_allclose(colours[0, 1], 1)
    assert figure.axes[2].images[1].get_array().compressed().size == 2


def test_the_step_of_a_change_is_marked_in_each_loss():
    rows = [{"match": float(step), "geometry": 1.0} for step in range(20)]
    figure = training_plots.show_losses(rows, {"match": "correspondence", "geometry": "geometry"}, 15)
    assert [axis.lines[1].get_xdata()[0] for axis in figure.axes] == [15, 15]
    assert figure.axes[0].lines[0].get_ydata()[0] == pytest.approx(5)  # mean of the first eleven
