"""Controls and interactive figures, the building blocks of all widgets.

`tools/widget_examples.py` says how to write a widget.
"""

import importlib
from collections.abc import Callable, Mapping
from html import escape
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from zsp_lite.errors import InputError

Widget = Any  # of ipywidgets, which is imported when a widget is made
_LABEL = {"description_width": "initial"}  # as wide as the text


def load_package(name: str = "ipywidgets") -> Any:
    """Import a package that only the notebooks need; the error has the command that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"this widget needs {name}, which is not installed; pip install {name}"
        ) from error


def slider(label: str, low: float, high: float, value: float, step: float = 1) -> Widget:
    """Return a slider from `low` to `high`, with integer values if all four numbers are
    integers."""
    widgets = load_package()
    options = {"min": low, "max": high, "step": step, "description": label, "style": _LABEL}
    options["layout"] = {"width": "22em"}
    if all(isinstance(x, int | np.integer) for x in (low, high, value, step)):
        return widgets.IntSlider(value, **options)
    return widgets.FloatSlider(value, **options)


def patch_sliders(grid: tuple[int, int], start: tuple[int, int], of: str = "") -> dict[str, Widget]:
    """Return sliders over the rows and columns of a patch grid, counted from 0, that begin at a
    patch."""
    rows, columns = grid
    row, column = start
    return {
        "row": slider(f"row{of}", 0, rows - 1, row),
        "col": slider(f"column{of}", 0, columns - 1, column),
    }


def interactive_figure(
    figure: Figure, controls: Mapping[str, Widget], update: Callable[..., str], alt: str
) -> Widget:
    """Return a widget of controls above a picture of a figure above a caption, which are its
    attributes.

    `update` is called with the values of the `controls`, which have the names of its arguments; it
    changes the figure and returns the caption. `alt` describes the figure for screen readers,
    whatever the controls are.
    """
    widgets = load_package()
    plt.close(figure)  # A notebook shows open figures below the cell, a second time.
    canvas = FigureCanvasAgg(figure)
    # Not stretched in wide windows, and low enough for the controls to stay in sight on a screen of
    # 800 pixels.
    size = {
        "max_width": "100%",
        "max_height": "420px",
        "align_self": "flex-start",
        "object_fit": "contain",
    }
    picture = widgets.Image(format="png", layout=size)
    # Image widgets have no alternative text, and JupyterLab fails on images with a tooltip.
    described = widgets.HTML(
        f'<span style="position: absolute; left: -9999px">Picture: {escape(alt)}</span>'
    )
    caption = widgets.HTML()

    def redraw(change: Any = None) -> None:
        caption.value = update(**{name: control.value for name, control in controls.items()})
        canvas.draw()
        # As PNG with little compression, which is fast.
        pixels = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
        picture.value = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()

    for control in controls.values():
        control.observe(redraw, names="value")
    # The layout is computed and then fixed, so that the figure does not move between updates. For
    # images with colour bars it is exact only after the second pass.
    redraw()
    redraw()
    figure.set_layout_engine("none")
    row = widgets.HBox(list(controls.values()), layout={"flex_flow": "row wrap"})
    box = widgets.VBox([row, described, picture, caption])
    box.controls = controls
    box.picture = picture
    box.caption = caption
    return box


def redrawing(draw: Callable[..., list[Artist]]) -> Callable[..., None]:
    """Return a function that removes the artists of its last call and calls `draw`, which returns
    new ones."""
    drawn: list[Artist] = []

    def redraw(*values: Any, **named: Any) -> None:
        while drawn:
            drawn.pop().remove()
        drawn.extend(draw(*values, **named))

    return redraw


def show(figure: Figure, alt: str) -> None:
    """Show a static figure in a notebook, with an alternative text that is stored in the
    notebook."""
    from IPython.display import display  # a package that only notebooks need

    plt.close(figure)  # A notebook would show it a second time.
    display(figure, metadata={form: {"alt": alt} for form in ("image/png", "image/jpeg")})
