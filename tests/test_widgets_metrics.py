"""The widgets on metrics agree with a simulation and with known symmetries."""

import numpy as np
import pytest
from matplotlib import pyplot as plt

from zsp_lite.errors import InputError

pytest.importorskip("ipywidgets", reason="widgets are an optional extra: pip install 'zsp-lite[notebooks]'")

from zsp_lite.widgets.metrics import (
    accuracy_threshold,
    measured_accuracy,
    order_probabilities,
    rotated_distance,
    symmetry_rotation,
)

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def test_order_probabilities_agree_with_a_simulation():
    rng = np.random.default_rng(0)
    a, b = rng.binomial(50, 0.4, 200_000), rng.binomial(50, 0.5, 200_000)
    assert np.allclose(order_probabilities(50, 0.4, 0.5), [np.mean(b > a), np.mean(b < a)], atol=0.004)


def test_equal_methods_have_equal_probabilities_of_both_orders():
    above, below = order_probabilities(100, 0.46, 0.46)
    assert np.isclose(above, below) and above < 0.5


def test_the_caption_has_the_probabilities_at_the_sliders():
    widget = measured_accuracy()
    for pairs, gain in ((100, 4), (1000, 4), (1000, 0)):
        widget.controls["pairs"].value, widget.controls["gain"].value = pairs, gain
        above, below = order_probabilities(pairs, 0.46, (46 + gain) / 100)
        assert (
            f"above it in {100 * above:.0f} % of all benchmarks, below it in {100 * below:.0f} %"
            in widget.caption.value
        )


def test_more_pairs_redraw_the_figure():
    widget = measured_accuracy()
    before = widget.picture.value
    widget.controls["pairs"].value = 500
    assert widget.picture.value != before


def rectangle(width):
    """The outline of a rectangle 2 long, in the plane z = 0."""
    s = np.linspace(-1, 1, 201)
    sides = [(s, width + 0 * s), (s, -width + 0 * s), (1 + 0 * s, width * s), (-1 + 0 * s, width * s)]
    return np.vstack([np.column_stack([*side, 0 * s]) for side in sides])


def test_a_rectangle_coincides_after_a_half_turn_and_a_square_after_a_quarter():
    angles = np.array([0, 45, 90, 135, 180, 270])
    flat = rotated_distance(rectangle(0.5), rectangle(0.5), angles)
    square = rotated_distance(rectangle(1.0), rectangle(1.0), angles)
    assert np.allclose(flat[[0, 4]], 0, atol=1e-9) and (flat[[1, 2, 3, 5]] > 0.1).all()
    assert np.allclose(square[[0, 2, 4, 5]], 0, atol=1e-9) and (square[[1, 3]] > 0.1).all()


def test_the_distance_to_another_shape_is_never_zero():
    assert rotated_distance(rectangle(0.5), rectangle(0.8), np.arange(0, 360, 30)).min() > 0.05


def test_rotations_are_about_z_in_degrees():
    # A point at +x, rotated by 90 degrees, is at +y.
    assert np.isclose(rotated_distance(np.array([[1.0, 0, 5]]), np.array([[0.0, 1, 5]]), np.array([90]))[0], 0)


def test_the_caption_of_the_symmetry_widget_has_both_errors():
    widget = symmetry_rotation({"rectangle": rectangle(0.5), "square": rectangle(1.0)})
    widget.controls["angle"].value = 90
    assert "rotation error 90°" in widget.caption.value and "100 %" in widget.caption.value
    before = widget.picture.value
    widget.controls["cloud"].value = "square"
    assert widget.picture.value != before and "distance 0.00" in widget.caption.value


def test_no_cloud_is_an_input_error():
    with pytest.raises(InputError, match="no clouds"):
        symmetry_rotation({})


def test_the_bars_are_the_shares_of_pairs_within_the_threshold():
    widget = accuracy_threshold({"first": np.array([5.0, 20, 40, 170]), "second": np.array([50.0, 60])})
    bars = widget.figure.axes[0].patches
    assert [bar.get_width() for bar in bars] == [50, 0]
    widget.controls["threshold"].value = 55
    assert [bar.get_width() for bar in bars] == [75, 50]
    assert "Within 55°: first 75 %, second 50 %" in widget.caption.value


def test_no_method_is_an_error():
    with pytest.raises(InputError, match="no methods"):
        accuracy_threshold({})
