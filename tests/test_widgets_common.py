"""What all widgets have in common: controls and interactive figures."""

import ast
import sys
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import pytest

from zsp_lite.errors import InputError

pytest.importorskip("ipywidgets", reason="widgets need ipywidgets: pip install 'zsp-lite[notebooks]'")
matplotlib.use("agg")

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
