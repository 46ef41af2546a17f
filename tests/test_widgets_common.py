"""What all widgets have in common: controls, interactive figures, examples, latency."""

import ast
import sys
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

from zsp_lite.errors import InputError

pytest.importorskip("ipywidgets", reason="widgets need ipywidgets: pip install 'zsp-lite[notebooks]'")
matplotlib.use("agg")

from tools import widget_examples as examples
from tools.widget_latency import control_values, latency, main  # noqa: E402
from zsp_lite.widgets import common  # noqa: E402


def test_no_module_imports_ipywidgets_before_a_widget_is_made():
    for path in Path(common.__file__).parent.glob("*.py"):
        # The body of the module excludes functions and `if TYPE_CHECKING`.
        for node in ast.parse(path.read_text()).body:
            names = [getattr(node, "module", "")]
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            assert "ipywidgets" not in names, path.name


def test_without_ipywidgets_the_error_has_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(InputError, match="pip install ipywidgets"):
        common.slider("x", 0, 1, 0)


def test_a_control_calls_update_with_all_values_and_shows_the_caption():
    figure, axis = plt.subplots(figsize=(1, 1))
    line = axis.axvline(0)
    calls = []

    def update(x, name):
        calls.append((x, name))
        line.set_xdata([x, x])
        return f"x is {x}, {name}"

    controls = {"x": common.slider("x", 0.0, 1.0, 0.0, 0.25), "name": common.choice("name", ["a", "b"])}
    widget = common.interactive_figure(figure, controls, update, "a line")
    before = widget.picture.value
    widget.controls["x"].value = 0.5
    assert widget.picture.value != before
    widget.controls["name"].value = "b"
    assert calls[-2:] == [(0.5, "a"), (0.5, "b")] and widget.caption.value == "x is 0.5, b"
    assert widget.picture.value[:4] == b"\x89PNG" and not plt.fignum_exists(figure.number)


def test_the_description_is_text_and_no_tooltip_which_jupyterlab_cannot_show_on_images():
    figure, _ = plt.subplots(figsize=(1, 1))
    widget = common.interactive_figure(figure, {"x": common.slider("x", 0, 3, 1)}, lambda x: f"x is {x}", alt="a < b")
    assert widget.picture.tooltip is None
    assert any("a &lt; b" in getattr(child, "value", "") for child in widget.children if child is not widget.picture)


def test_a_picture_keeps_its_size_and_leaves_room_for_the_controls():
    figure, _ = plt.subplots(figsize=(1, 1))
    layout = common.interactive_figure(figure, {}, lambda: "", "nothing").picture.layout
    assert (layout.max_width, layout.max_height) == ("100%", "420px")
    assert layout.align_self == "flex-start" and layout.object_fit == "contain"  # not stretched


def test_values_for_the_latency_always_change_the_control():
    for control in (
        common.slider("x", 0, 9, 3),
        common.slider("y", 0.0, 1.0, 0.0, 0.1),
        common.choice("z", ["a", "b"]),
    ):
        values = control_values(control, 7)
        assert len(values) >= 5
        assert all(a != b for a, b in zip([control.value, *values], values))


def test_the_latency_is_measured_for_each_control_and_restores_its_value():
    widget = examples.one_outlier()
    ticks = iter(range(100))
    assert latency(widget, 3, clock=lambda: float(next(ticks))) == {"distance": 1000.0}
    assert widget.controls["distance"].value == 0.0


def test_the_command_prints_a_line_for_each_control(monkeypatch, capsys):
    monkeypatch.setattr("tools.widget_latency.latency", lambda widget, clock=None: {"pairs": 200.0, "gain": 3.0})
    with pytest.raises(SystemExit) as stop:
        main(["measured_accuracy"])
    first, second = capsys.readouterr().out.splitlines()
    assert (
        stop.value.code == 1 and first.endswith("200 ms ( 200 ms) above 150 ms") and second.endswith("3 ms (   3 ms)")
    )
    with pytest.raises(SystemExit) as stop:
        main(["unknown"])
    assert stop.value.code == 2 and "measured_accuracy" in capsys.readouterr().err
