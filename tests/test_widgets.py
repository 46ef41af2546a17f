"""The widgets: every control has an effect, and the captions agree with the library at the values
of the controls."""

import re
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from numpy.random import default_rng
from refusals import refused

from zsp_lite import Sim3
from zsp_lite.alignment import umeyama
from zsp_lite.course.true_matches import correct_matches
from zsp_lite.matching import cyclical_distances, similarity
from zsp_lite.metrics import rotation_error

pytest.importorskip("ipywidgets", reason="widgets are optional: pip install ipywidgets anywidget")
matplotlib.use("agg")

from tools import widget_examples as examples  # noqa: E402
from zsp_lite.course.widgets import common, cycles, outliers, patches  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("closed_figures")]

# A quarter turn about z.
TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def values_of(control) -> list:
    """Return some values of a control."""
    if hasattr(control, "options"):
        return [value[1] if isinstance(value, tuple) else value for value in control.options]
    return (
        [True, False]
        if isinstance(control.value, bool)
        else [control.min, (control.min + control.max) // 2]
    )


@pytest.mark.parametrize("name", [name for name in examples.WIDGETS if name != "label_poses"])
def test_every_control_changes_the_picture_and_going_back_restores_it(name):
    widget = examples.WIDGETS[name]()
    before, caption = widget.picture.value, widget.caption.value
    assert before[:4] == b"\x89PNG"
    assert caption
    for control in widget.controls.values():
        start = control.value
        for value in values_of(control):
            control.value = value
            if widget.picture.value != before:
                break
        assert widget.picture.value != before, control.description
        control.value = start
        assert (widget.picture.value, widget.caption.value) == (before, caption)


def test_no_module_imports_ipywidgets_before_a_widget_is_made():
    for path in Path(common.__file__).parent.glob("*.py"):
        assert not re.search("^(from|import) ipywidgets", path.read_text("utf-8"), re.MULTILINE), (
            path.name
        )


def test_without_ipywidgets_the_error_has_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    refused("pip install ipywidgets", common.slider, "x", 0, 1, 0)


@pytest.fixture(scope="module")
def sim():
    """The similarities of a sample pair."""
    return similarity(*(view.features for view in examples.sample_views()))


def test_the_caption_has_the_nearest_neighbour_and_the_share_of_correct_ones(sim):
    pair = examples.sample_pair()
    kinds = {"other": -sim, "one": sim}
    # The (row, column) of the nearest neighbour of each of 28 x 28 patches.
    cells = np.stack(np.divmod(sim.argmax(1).numpy(), 28), -1)
    widget = patches.patch_similarities(
        pair.reference.rgb, pair.target.rgb, kinds, pair.cells, pair.valid, (15, 9)
    )
    widget.controls["kind"].value = "one"
    row, col = cells[15 * 28 + 9]
    assert (
        f"nearest neighbour ({row}, {col}), cosine {sim[15 * 28 + 9].max():.2f}"
        in widget.caption.value
    )
    right = correct_matches(cells.reshape(28, 28, 2), pair.cells)[pair.valid].mean()
    assert f"{right:.0%} have" in widget.caption.value


def test_an_empty_box_has_no_mask():
    widget = examples.box_to_mask()
    assert "IoU" in widget.caption.value
    widget.controls["bottom"].value = 4
    assert widget.caption.value == "mask of 0 pixels, IoU with the true mask 0.00"


def test_the_cycle_has_the_cyclical_distance_and_names_the_background(sim):
    pair = examples.sample_views()
    widget = cycles.cycle(*pair, sim, (7, 5))
    assert "u (7, 5) →" in widget.caption.value
    distances = -cyclical_distances(sim, (28, 28), (28, 28)).numpy()
    valid = np.isfinite(
        cyclical_distances(sim, (28, 28), (28, 28), *(view.foreground for view in pair)).numpy()
    )
    for row, col in ((14, 14), (20, 8), (3, 25), (0, 0)):
        widget.controls["row"].value, widget.controls["col"].value = row, col
        assert f"u ({row}, {col}) →" in widget.caption.value
        assert f"d(u, u') = {distances[row, col]:.1f} patches" in widget.caption.value
        assert ("not on the foreground" in widget.caption.value) == (not valid[row, col])


def test_the_caption_follows_the_settings_of_ransac():
    source = default_rng(0).normal(size=(40, 3))
    target = Sim3(1.3, TURN, np.ones(3)).apply(source)
    target[:10] = 9  # ten outliers
    images, pixels = np.zeros((2, 60, 60, 3)), np.zeros((2, 40, 2))
    widget = outliers.ransac_settings(tuple(images), tuple(pixels), (source, target), TURN)
    widget.controls["seed"].value = 3
    right = "30 of 40 matches are inliers; scale 1.30; rotation error 0°."
    assert widget.caption.value == right
    # Matches on a line tell no rotation.
    line = np.outer(np.arange(40.0), [1, 2, 3])
    widget = outliers.ransac_settings(tuple(images), tuple(pixels), (line, line))
    assert widget.caption.value.startswith("No fit: ")


def test_a_dragged_match_turns_the_least_squares_chair_and_loses_the_vote():
    widget = outliers.drag_match()
    for distance in (1.0, 4.0):
        widget.controls["distance"].value = distance
        target = outliers.CHAIR.copy()
        target[-1] += distance * outliers.RIGHT
        turn = rotation_error(umeyama(outliers.CHAIR, target).R, np.eye(3))
        assert f"least squares: {turn:.0f}° off" in widget.caption.value
        assert "RANSAC: 0° off, 11 of 12 matches agree" in widget.caption.value
    assert turn > 20
