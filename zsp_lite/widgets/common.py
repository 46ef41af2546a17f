"""What all widgets are made of: controls, a picture of a matplotlib figure, and a sentence that says what it shows.

Rules for a widget:

- One function that takes data already computed (views, matrices, errors), draws once, and returns `explorer(...)`.
- Moving a control calls its `update`, which only changes what stands in the figure (`set_data`, `set_offsets`,
  `set_text`, `set_visible`): artists are made once. Heavy numbers are computed before, not on a slider's move.
- `update` returns one sentence with the figures that the picture shows: for readers who cannot see it, or its colours.
- An answer takes 150 ms at the median (`python -m zsp_lite.widgets` measures). Keep figures below about 9 by 4 inches.
- The picture is PNG in an image widget, which every frontend shows; plotly and ipympl are not needed. Where a patch or
  a point is chosen, sliders choose it: they work by keyboard too.
- In the notebook a static figure stands beside it (`show`), which has all that must be seen.
- For each widget its module has a function `example_NAME()` that builds it on `example_pair()` or other sample data,
  and `zsp_lite.widgets.WIDGETS` has a line for it.
"""

from collections.abc import Callable, Mapping
from functools import cache
from html import escape
from typing import TYPE_CHECKING, Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.patheffects import Normal, Stroke

from zsp_lite.errors import InputError

if TYPE_CHECKING:
    from ipywidgets import ValueWidget, VBox

    from zsp_lite.synthetic.ground_truth import GroundTruthPair
    from zsp_lite.views import View

_LABEL = {"description_width": "initial"}


def load_ipywidgets() -> Any:
    """The module ipywidgets.  Raises InputError saying how to install it where it lacks."""
    try:
        import ipywidgets
    except ImportError as error:
        raise InputError(
            "widgets need ipywidgets, which is not installed; pip install ipywidgets (or 'zsp-lite[notebooks]')"
        ) from error
    return ipywidgets


def slider(label: str, low: float, high: float, value: float, step: float = 1) -> "ValueWidget":
    """A slider from `low` to `high`: of whole numbers where all four are, of decimals otherwise."""
    widgets = load_ipywidgets()
    whole = all(isinstance(x, int | np.integer) for x in (low, high, value, step))
    kind = widgets.IntSlider if whole else widgets.FloatSlider
    form = {} if whole else {"readout_format": f".{max(0, -int(np.floor(np.log10(step))))}f"}
    return kind(value, min=low, max=high, step=step, description=label, style=_LABEL, layout={"width": "22em"}, **form)


def choice(label: str, options: list[str], value: str | None = None) -> "ValueWidget":
    """A menu of one of `options`, at first `value` or else the first."""
    widgets = load_ipywidgets()
    return widgets.Dropdown(options=options, value=value or options[0], description=label, style=_LABEL)


def explorer(figure: Figure, controls: Mapping[str, "ValueWidget"], update: Callable[..., str], alt: str) -> "VBox":
    """The widget: controls over a picture of `figure` over a sentence.

    update: called with each control's value by the control's name; changes the figure and returns the sentence.
    alt: what the picture is of, in a sentence that holds for all positions of the controls.

    The result's `redraw()` does what a control's move does; `controls` and `figure` are the ones given, `picture` and
    `sentence` the widgets that it changes. Raises InputError without ipywidgets.
    """
    widgets = load_ipywidgets()
    plt.close(figure)  # else the notebook would show it a second time
    canvas = FigureCanvasAgg(figure)
    picture = widgets.Image(format="png", layout={"max_width": "100%", "object_fit": "contain"})
    # Image widgets have no alternative text, and JupyterLab fails on those with a tooltip: text for screen readers.
    described = widgets.HTML(f'<span style="position: absolute; left: -9999px">Picture: {escape(alt)}</span>')
    sentence = widgets.HTML()
    # A layout engine would arrange everything again at each move, and make the picture jump.
    update(**{name: control.value for name, control in controls.items()})
    for _ in range(2):  # the first one settles the layout of images with colour bars only roughly
        canvas.draw()
    figure.set_layout_engine("none")

    def redraw(change=None) -> None:
        text = update(**{name: control.value for name, control in controls.items()})
        picture.value = png(figure)
        sentence.value = text

    for control in controls.values():
        control.observe(redraw, names="value")
    redraw()
    row = widgets.HBox(list(controls.values()), layout={"flex_flow": "row wrap"})
    box = widgets.VBox([row, described, picture, sentence])
    box.redraw, box.controls, box.figure, box.picture, box.sentence = redraw, dict(controls), figure, picture, sentence
    return box


def patch_slider(label: str, cells: int, value: int) -> "ValueWidget":
    """A slider over the rows or columns of a patch grid, counted from 0 as in the code."""
    return slider(label, 0, cells - 1, value)


def patch_box(
    axis: Axes, grid: tuple[int, int], size: tuple[int, int], label: str, before: bool = False
) -> Callable[[int, int], None]:
    """A frame around one patch of a (rows, cols) grid over an image of (H, W) pixels; call the result to move it.

    White on black, so that it is seen on any picture; its label stands on the right, or on the left (`before`).
    """
    height, width = size[0] / grid[0], size[1] / grid[1]
    frames = [
        axis.add_patch(Rectangle((0, 0), width, height, fill=False, edgecolor=colour, linewidth=line, zorder=8))
        for colour, line in (("black", 4.5), ("white", 2))
    ]
    text = axis.text(0, 0, label, fontsize=11, weight="bold", zorder=9, va="center", clip_on=True,
                     path_effects=[Stroke(linewidth=3, foreground="white"), Normal()])  # fmt: skip

    def move(row: int, col: int) -> None:
        for frame in frames:
            frame.set_xy((col * width, row * height))
        right = col < 4 or (not before and col < grid[1] - 4)
        text.set(x=(col + (1.5 if right else -0.5)) * width, y=(row + 0.5) * height, ha="left" if right else "right")

    return move


def patch_map(
    axis: Axes, grid: tuple[int, int], size: tuple[int, int], limits: tuple[float, float] = (0, 1), alpha: float = 0.65,
    label: str | None = None,
) -> AxesImage:  # fmt: skip
    """An empty map over the patches of an image of (H, W) pixels; fill it with `set_data` (masked patches are clear).

    label: of the colour bar below it, none without.
    """
    drawn = axis.imshow(
        np.zeros(grid), cmap="viridis", alpha=alpha, extent=(0, size[1], size[0], 0), vmin=limits[0], vmax=limits[1],
        interpolation="nearest",
    )  # fmt: skip
    if label is not None:
        bar = axis.figure.colorbar(drawn, ax=axis, location="bottom", shrink=0.85, pad=0.02)
        bar.set_label(label, fontsize=9)
        bar.ax.tick_params(labelsize=8)
    return drawn


def png(figure: Figure) -> bytes:
    """The figure as PNG, quickly (hardly compressed)."""
    canvas = figure.canvas
    canvas.draw()
    pixels = cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def show(figure: Figure, alt: str) -> None:
    """Show a static figure in a notebook with a text for those who cannot see it, kept in the file."""
    from IPython.display import display

    plt.close(figure)
    display(figure, metadata={form: {"alt": alt} for form in ("image/png", "image/jpeg")})


@cache
def example_truth() -> "GroundTruthPair":
    """The true correspondences of a sample pair; for trying widgets out."""
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.samples import sample_data
    from zsp_lite.demo import demo_pairs
    from zsp_lite.synthetic.ground_truth import ground_truth_pair

    dataset = Co3D(sample_data())
    return ground_truth_pair(dataset, demo_pairs(dataset)[-1])


@cache
def example_pair() -> tuple["View", "View"]:
    """The views of `example_truth`: different objects of one category from about the same side."""
    from zsp_lite.backbones.load import load_backbone
    from zsp_lite.views import extract_views

    truth = example_truth()
    first, second = extract_views(load_backbone("zsp-tiny", "cpu"), [truth.reference, truth.target])
    return first, second
