"""The metrics' widgets: binomials against their definition and simulation, turned clouds against known symmetries."""

from math import comb

import numpy as np
import pytest
from matplotlib import pyplot as plt

from zsp_lite.errors import InputError

pytest.importorskip("ipywidgets", reason="widgets are an optional extra: pip install 'zsp-lite[notebooks]'")

from zsp_lite.widgets.metrics import binomial, measured_accuracy, order_chances, symmetry_turn, turned_distance


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


@pytest.mark.parametrize("n, p", [(1, 0.3), (12, 0.46), (30, 0.9)])
def test_binomial_is_its_definition(n, p):
    expected = [comb(n, k) * p**k * (1 - p) ** (n - k) for k in range(n + 1)]
    assert np.allclose(binomial(n, p), expected, rtol=1e-10, atol=0)


def test_binomial_holds_for_thousands_and_at_the_ends():
    many = binomial(5000, 0.4)
    assert np.isclose(many.sum(), 1) and np.isclose(many @ np.arange(5001), 2000)
    assert binomial(3, 0.0).tolist() == [1, 0, 0, 0] and binomial(3, 1.0).tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("n, p", [(0, 0.5), (5, -0.1), (5, 1.1)])
def test_no_binomial_of_such_values(n, p):
    with pytest.raises(InputError, match="expected n >= 1"):
        binomial(n, p)


def test_order_chances_agree_with_a_simulation():
    rng = np.random.default_rng(0)
    a, b = rng.binomial(50, 0.4, 200_000), rng.binomial(50, 0.5, 200_000)
    assert np.allclose(order_chances(50, 0.4, 0.5), [np.mean(b > a), np.mean(b < a)], atol=0.004)


def test_equal_methods_come_out_in_either_order_equally_often():
    above, below = order_chances(100, 0.46, 0.46)
    assert np.isclose(above, below) and above < 0.5


def test_the_sentence_gives_the_chances_at_the_sliders():
    widget = measured_accuracy()
    for pairs, gain in ((100, 4), (1000, 4), (1000, 0)):
        widget.controls["pairs"].value, widget.controls["gain"].value = pairs, gain
        above, below = order_chances(pairs, 0.46, (46 + gain) / 100)
        assert f"above in {100 * above:.0f} % of all benchmarks, below in {100 * below:.0f} %" in widget.sentence.value


def test_more_pairs_change_the_picture():
    widget = measured_accuracy()
    before = widget.picture.value
    widget.controls["pairs"].value = 500
    assert widget.picture.value != before


def rectangle(width):
    """The outline of a rectangle 2 long, in the plane z = 0."""
    s = np.linspace(-1, 1, 201)
    sides = [(s, width + 0 * s), (s, -width + 0 * s), (1 + 0 * s, width * s), (-1 + 0 * s, width * s)]
    return np.vstack([np.column_stack([*side, 0 * s]) for side in sides])


def test_a_rectangle_repeats_after_a_half_turn_and_a_square_after_a_quarter():
    turns = np.array([0, 45, 90, 135, 180, 270])
    flat = turned_distance(rectangle(0.5), rectangle(0.5), turns)
    square = turned_distance(rectangle(1.0), rectangle(1.0), turns)
    assert np.allclose(flat[[0, 4]], 0, atol=1e-9) and (flat[[1, 2, 3, 5]] > 0.1).all()
    assert np.allclose(square[[0, 2, 4, 5]], 0, atol=1e-9) and (square[[1, 3]] > 0.1).all()


def test_another_shape_is_never_at_distance_zero():
    assert turned_distance(rectangle(0.5), rectangle(0.8), np.arange(0, 360, 30)).min() > 0.05


def test_turns_are_about_z_and_in_degrees():
    # A point at +x, turned by 90 degrees, is at +y.
    assert np.isclose(turned_distance(np.array([[1.0, 0, 5]]), np.array([[0.0, 1, 5]]), np.array([90]))[0], 0)


def test_the_symmetry_widget_says_both_errors():
    widget = symmetry_turn({"rectangle": rectangle(0.5), "square": rectangle(1.0)})
    widget.controls["turn"].value = 90
    assert "rotation error 90°" in widget.sentence.value and "100 %" in widget.sentence.value
    before = widget.picture.value
    widget.controls["cloud"].value = "square"
    assert widget.picture.value != before and "distance 0.00" in widget.sentence.value


def test_no_cloud_is_refused():
    with pytest.raises(InputError, match="no clouds"):
        symmetry_turn({})
