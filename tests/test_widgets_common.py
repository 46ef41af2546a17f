"""What every widget has, whatever it shows."""

import matplotlib.pyplot as plt

from zsp_lite.widgets.common import explorer, slider


def test_the_picture_is_described_without_a_tooltip_which_jupyterlab_cannot_show_on_images():
    figure, axis = plt.subplots(figsize=(1, 1))
    widget = explorer(figure, {"x": slider("x", 0, 3, 1)}, lambda x: f"x is {x}", alt="a < b")
    assert widget.picture.tooltip is None
    assert any("a &lt; b" in getattr(child, "value", "") for child in widget.children if child is not widget.picture)
