"""What the lessons compute and draw beside the library: answers between objects, and pictures."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex

from zsp_lite.align import read_hypotheses
from zsp_lite.category import synchronise
from zsp_lite.course import hypotheses, pictures
from zsp_lite.course.samples import sample_data
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.viz.plots import GREEN, VERMILLION

RUN = Path(__file__).parents[1] / "notebooks/results/category_run/four_cars"


@pytest.fixture(scope="module")
def truth() -> dict[str, np.ndarray]:
    """Rotations from the worlds of the four sample cars to the frame of their category."""
    labels = read_labels(sample_data(), "car")
    return {name: labels[name].trans[:3, :3].T for name in sorted(labels)}


def test_a_draw_has_one_stored_answer_of_each_ordered_pair(truth):
    drawn = hypotheses.draw_answers(RUN, seed=3)
    stored = [one.centre.tolist() for one in read_hypotheses(RUN).values()]
    assert {(one.reference, one.target) for one in drawn} == {
        (a, b) for a in truth for b in truth if a != b
    }
    assert len(drawn) == 12
    assert all(one.centre.tolist() in stored for one in drawn)


def test_a_tree_believes_the_surest_answer_and_all_pairs_can_outvote_it(truth):
    drawn = hypotheses.draw_answers(RUN, seed=62)
    assert not hypotheses.all_alike(truth, hypotheses.spanning_tree(drawn))
    objects = synchronise(drawn).objects
    together = {name: one.sim3.R for name, one in objects.items()}
    assert hypotheses.all_alike(truth, together)

    surest = hypotheses.surest_right(drawn, truth)
    wrong = {pair for pair, right in surest.items() if not right}
    assert wrong == {
        ("wooden_car", "peugeot_308"),
        ("seat_leon", "peugeot_308"),
        ("seat_leon", "wooden_car"),
    }
    fitting = hypotheses.fitting_right(drawn, truth, together)
    assert [pair for pair, right in fitting.items() if not right] == [("seat_leon", "wooden_car")]
    assert fitting["seat_leon", "wooden_car"] is None


def test_a_common_turn_of_all_objects_changes_nothing_and_of_one_it_does(truth):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = {name: turn @ rotation for name, rotation in truth.items()}
    assert hypotheses.all_alike(truth, turned)
    assert not hypotheses.all_alike(truth, truth | {"suv": turned["suv"]})


def test_objects_are_seen_from_the_same_side_by_the_true_rotations(truth):
    dataset = Co3D(sample_data())
    shown = pictures.alike(dataset, "car", truth, "suv")
    assert list(shown) == list(truth)
    assert {picture.shape for picture in shown.values()} == {(224, 224, 3)}
    turned = {name: rotation for name, rotation in truth.items()}
    turned["seat_leon"] = np.diag([-1.0, -1, 1]) @ turned["seat_leon"]
    other = pictures.alike(dataset, "car", turned, "suv")
    assert np.array_equal(other["suv"], shown["suv"])
    assert not np.array_equal(other["seat_leon"], shown["seat_leon"])


def test_the_arrows_of_a_graph_have_the_colours_of_their_answers():
    grey = {name: np.full((4, 4, 3), 128, np.uint8) for name in "abc"}
    arrows = {("a", "b"): True, ("b", "c"): False, ("c", "a"): None}
    figure = pictures.show_graphs({"one": (grey, arrows), "two": (grey, {("a", "b"): True})})
    first, second = ([to_hex(one.get_edgecolor()) for one in axis.patches] for axis in figure.axes)
    assert first == [to_hex(colour) for colour in (GREEN, VERMILLION, "0.6")]
    assert second == [to_hex(GREEN)]


def test_benchmarks_that_the_better_method_does_not_win_are_crosses():
    figure = pictures.show_winners({"10": np.array([-2.0, 0, 1]), "20": np.array([1.0, 2, 3])}, 1)
    (axis,) = figure.axes
    counts = [len(dots.get_offsets()) for dots in axis.collections]
    assert counts == [1, 2, 3, 0]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "better method wins",
        "it does not",
        "true gain",
    ]


def test_the_dots_of_a_curve_stand_above_their_pictures():
    x = np.arange(0.0, 11)
    shown = dict.fromkeys((2, 4), np.zeros((5, 6, 3), np.uint8))
    figure, axes = pictures.curve_above_pictures((x, x**2), shown, "at {:.0f}", ylabel="score")
    dots = figure.axes[0].lines[1].get_xydata()
    assert dots.tolist() == [[2, 4], [4, 16]]
    assert [axis.get_title() for axis in axes] == ["at 2", "at 4"]
