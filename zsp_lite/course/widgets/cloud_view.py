"""A point cloud that the user can rotate and click, on a plain canvas without WebGL or network.

The browser draws the points and sends clicks (`cloud_view.js`). Python finds the clicked point in
the full cloud.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float, Real, UInt8

from zsp_lite.alignment import Sim3
from zsp_lite.course.widgets.common import load_package
from zsp_lite.course.widgets.turning import SCRIPT, view_units
from zsp_lite.viz.plots import BLUE, ORANGE

MAX_POINTS = 6000  # points drawn; more are slow in the browser
# View units. A point that is farther behind the front point under the pointer cannot be clicked.
_DEPTH_TOLERANCE = 0.15

_STYLE = """
.zsp-cloud { border: 1px solid #888; background: white; cursor: crosshair; touch-action: none; }
.zsp-cloud:focus { outline: 3px solid #0072B2; outline-offset: -3px; }
"""


def point_under(
    points: Float[np.ndarray, "n 3"],
    view: Real[np.ndarray, "3 3"],
    at: Real[np.ndarray, "2"],
    reach: float,
) -> int | None:
    """Return the index of the clicked point, or None.

    It is the nearest of the points (in view units) within `reach` of the click that are not far
    behind the front one. The rows of `view` point right, down and forward; `at` is the click
    (right, down) from the centre of the canvas.
    """
    on_screen = points @ view.T
    distance = np.hypot(*(on_screen[:, :2] - at).T)
    under = np.flatnonzero(distance <= reach)
    if not len(under):
        return None
    depth = on_screen[under, 2]
    front = under[depth <= depth.min() + _DEPTH_TOLERANCE]
    return int(front[distance[front].argmin()])


class CloudView:
    """A canvas with one point cloud; `widget` is its Jupyter widget."""

    def __init__(self, name: str, on_pick: Callable[[np.ndarray | None], Any]):
        """Create an empty canvas, of class zsp-cloud-NAME; a click calls `on_pick` with the world
        point, or None."""
        self.widget = _cloud_widget()()  # an object of the class
        self.widget.add_class(f"zsp-cloud-{name}")
        self.widget.on_msg(self._clicked)
        self.on_pick = on_pick
        self._cloud = np.zeros((0, 3))
        self._to_view: Sim3 | None = None  # None while the canvas is empty

    def show(
        self,
        points: Real[np.ndarray, "n 3"],
        colours: UInt8[np.ndarray, "n 3"],
        view: Real[np.ndarray, "3 3"] | None,
        alt: str,
        overlay: Real[np.ndarray, "m 3"] | None = None,
    ) -> None:
        """Show a cloud of coloured world points.

        Args:
            points: World points of the cloud.
            colours: Colours of the points.
            view: Direction of view (see `point_under`); None keeps the present one.
            alt: Alternative text.
            overlay: World points of a second cloud. The first cloud is then orange discs, the
                second blue crosses.
        """
        self._cloud = np.asarray(points, dtype=np.float64)
        self._to_view = view_units(points)
        # Two clouds share the number of points that is not slow.
        most = MAX_POINTS if overlay is None else MAX_POINTS // 2
        drawn, colours = (_shuffled(part)[:most] for part in (points, colours))
        discs = len(drawn)
        if overlay is not None:
            second = _shuffled(overlay)[:most]
            drawn = np.concatenate([drawn, second])
            # From "#RRGGBB" to three numbers.
            both = np.uint8([list(bytes.fromhex(name[1:])) for name in (ORANGE, BLUE)])
            colours = both.repeat([discs, len(second)], axis=0)
        with self.widget.hold_sync():
            self.widget.points = self._to_view.apply(drawn).astype(np.float32).tobytes()
            self.widget.colours = colours.tobytes()
            self.widget.discs = discs
            self.widget.alt = alt
            if view is not None:
                self.widget.view = np.asarray(view, dtype=np.float64).ravel().tolist()
                self.widget.view_resets += 1

    def clear(self, alt: str) -> None:
        """Show an empty canvas; `alt` gives the reason."""
        self._to_view = None
        with self.widget.hold_sync():
            self.widget.points = self.widget.colours = b""
            self.widget.marks = []
            self.widget.alt = alt

    def mark(self, points: Real[np.ndarray, "k 3"]) -> None:
        """Draw the numbers 1, 2, ... beside world points."""
        self.widget.marks = self._to_view.apply(points).tolist()

    def _clicked(self, widget: Any, content: dict, buffers: list) -> None:
        """Find the point of a click that the browser sends, and pass it on; what the browser sends
        is said at `point_under`."""
        if self._to_view is not None:
            view = np.array(content["view"]).reshape(3, 3)
            points = self._to_view.apply(self._cloud)
            index = point_under(points, view, np.array(content["at"]), content["reach"])
            self.on_pick(None if index is None else self._cloud[index])


def _shuffled(rows: np.ndarray) -> np.ndarray:
    """Return rows in a random order, always the same."""
    return np.random.default_rng(0).permutation(rows)


@cache
def _cloud_widget() -> type:
    """Return the class of the canvas; anywidget and traitlets, which only notebooks need, are
    imported when the first one is made."""
    anywidget = load_package("anywidget")
    from traitlets import Bytes, Float, Int, List, Unicode

    class CloudCanvas(anywidget.AnyWidget):
        """State shared with the browser, see `cloud_view.js`."""

        _esm = SCRIPT
        _css = _STYLE
        points = Bytes().tag(sync=True)  # float32 (n, 3), view units
        colours = Bytes().tag(sync=True)  # uint8 (n, 3)
        discs = Int().tag(sync=True)  # so many points are discs, the others are crosses
        marks = List().tag(sync=True)  # points (x, y, z) with a number, view units
        # the rotation (3, 3), row by row
        view = List(Float(), [1.0, 0, 0, 0, 1, 0, 0, 0, 1]).tag(sync=True)
        view_resets = Int().tag(sync=True)  # increases when the browser must take over `view`
        side = Int(400).tag(sync=True)  # of the canvas, pixels
        alt = Unicode().tag(sync=True)

    return CloudCanvas
