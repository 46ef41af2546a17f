"""A point cloud that can be turned by hand and clicked on, in any Jupyter: a plain canvas, no WebGL, no network.

The browser draws and says where was clicked (`cloud_view.js`); which point that is, is found here, on the full cloud.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int, Real, UInt8

from zsp_lite.errors import InputError

if TYPE_CHECKING:
    from anywidget import AnyWidget

SHOWN = 6000  # points drawn: more are slow in the browser, and nothing more is seen
_FRONT = 0.15  # what lies deeper than this behind the nearest point under the pointer belongs to the back; view units

_STYLE = """
.zsp-cloud { border: 1px solid #888; background: white; cursor: crosshair; touch-action: none; }
.zsp-cloud:focus { outline: 3px solid #0072B2; outline-offset: -3px; }
"""


@dataclass(frozen=True, eq=False)
class ViewBox:
    """Where a cloud's view units are in its world: the cloud fills the ball of radius 1 about `centre`."""

    centre: Float[np.ndarray, "3"]
    radius: float

    @classmethod
    def around(cls, points: Real[np.ndarray, "n 3"]) -> "ViewBox":
        """The box of a cloud; strays (the outermost percent along each axis) count for nothing.

        Raises InputError on an empty cloud, values that are not finite, and a cloud that is a single place.
        """
        points = np.asarray(points, dtype=np.float64)
        if len(points) == 0 or not np.isfinite(points).all():
            raise InputError(f"point cloud of shape {points.shape} is empty or not finite, expected points to show")
        low, high = np.percentile(points, [1, 99], axis=0)
        radius = float(np.linalg.norm(high - low)) / 2
        if radius < 1e-12:
            raise InputError(f"point cloud of {len(points)} points is a single place, expected an object")
        return cls((low + high) / 2, radius)

    def place(self, points: Real[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """World points in view units."""
        return (np.asarray(points, dtype=np.float64) - self.centre) / self.radius


def subsample(points: Real[np.ndarray, "n 3"], most: int = SHOWN) -> Int[np.ndarray, " m"]:
    """Indices of at most `most` points, always the same ones, ordered so that neighbours follow each other.

    The order is that of Morton's curve: a slider that runs along it walks over the object.
    """
    points = np.asarray(points, dtype=np.float64)
    kept = np.arange(len(points))
    if len(points) > most:
        kept = np.random.default_rng(0).choice(len(points), most, replace=False)
    low, high = points[kept].min(axis=0), points[kept].max(axis=0)
    cell = ((points[kept] - low) / np.maximum(high - low, 1e-12) * 1023).astype(np.int64)
    code = sum(((cell[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))
    return kept[np.lexsort((kept, code))]


def point_under(
    points: Float[np.ndarray, "n 3"], view: Real[np.ndarray, "3 3"], at: Real[np.ndarray, "2"], reach: float
) -> int | None:
    """Which of the points (in view units) was clicked on: of those within `reach` on the screen and not far behind the
    foremost of them, the nearest. None where there is none.

    view: rows are the screen's directions right, down and away.  at: (right, down) from the middle, in view units.
    """
    seen = points @ view.T
    distance = np.hypot(*(seen[:, :2] - at).T)
    near = np.flatnonzero(distance <= reach)
    if not len(near):
        return None
    near = near[seen[near, 2] <= seen[near, 2].min() + _FRONT]
    return int(near[distance[near].argmin()])


class CloudView:
    """One canvas. `widget` is what is shown; `on_pick` is called with the world point that was clicked on, or None."""

    def __init__(self, name: str, on_pick: Callable[[np.ndarray | None], Any], side: int = 400):
        """name: a CSS class, for style sheets and browser tests.  side: of the canvas, in CSS pixels."""
        self.widget = _cloud_widget()(side=side)
        self.widget.add_class(name)
        self.widget.on_msg(self._receive)
        self.on_pick = on_pick
        self._cloud: np.ndarray = np.zeros((0, 3))
        self._placed: np.ndarray = self._cloud
        self._box: ViewBox | None = None

    def show(
        self, points: Real[np.ndarray, "n 3"], colours: UInt8[np.ndarray, "n 3"], view: Real[np.ndarray, "3 3"] | None,
        alt: str, overlay: tuple[Real[np.ndarray, "m 3"], tuple[int, int, int], tuple[int, int, int]] | None = None,
    ) -> None:  # fmt: skip
        """Show a cloud in its colours; with `overlay`, another one too.

        view: as in `point_under`, None to leave it.  overlay: the other cloud (drawn with crosses), its colour, and the
        one of the cloud itself (drawn with discs). Raises InputError as `ViewBox.around`.
        """
        self._box = box = ViewBox.around(points)
        self._cloud, self._placed = np.asarray(points, dtype=np.float64), box.place(points)
        kept = subsample(points, SHOWN if overlay is None else SHOWN // 2)
        drawn, paint = self._placed[kept], colours[kept]
        crosses = np.zeros(len(kept), np.uint8)
        if overlay is not None:
            other = box.place(overlay[0])[subsample(overlay[0], SHOWN // 2)]
            paint = np.repeat(np.array([overlay[2], overlay[1]], np.uint8), [len(kept), len(other)], axis=0)
            drawn, crosses = np.concatenate([drawn, other]), np.repeat(np.uint8([0, 1]), [len(kept), len(other)])
        with self.widget.hold_sync():
            self.widget.points = drawn.astype(np.float32).tobytes()
            self.widget.colours = np.ascontiguousarray(paint, dtype=np.uint8).tobytes()
            self.widget.crosses = crosses.tobytes()
            self.widget.alt = alt
            if view is not None:
                self.widget.view = np.asarray(view, dtype=np.float64).ravel().tolist()
                self.widget.aimed += 1

    def clear(self, alt: str) -> None:
        """Show nothing, with the reason in `alt`."""
        self._box, self._cloud, self._placed = None, np.zeros((0, 3)), np.zeros((0, 3))
        with self.widget.hold_sync():
            self.widget.points = self.widget.colours = self.widget.crosses = b""
            self.widget.marks, self.widget.cursor, self.widget.alt = [], [], alt

    def mark(self, points: Real[np.ndarray, "k 3"], chosen: int | None = None) -> None:
        """Numbers 1, 2, ... beside world points; the one with index `chosen` stands out."""
        if self._box is not None:
            self.widget.marks = [
                {"at": at, "label": str(index + 1), "chosen": index == chosen}
                for index, at in enumerate(self._box.place(points).tolist())
            ]

    def point_at(self, point: Real[np.ndarray, "3"] | None) -> None:
        """A cross-hair on a world point, none with None."""
        self.widget.cursor = [] if point is None or self._box is None else self._box.place(point).tolist()

    def _receive(self, _, content: dict, buffers: list) -> None:
        if content.get("kind") == "click" and self._box is not None:
            view, at = np.array(content["view"]).reshape(3, 3), np.array(content["at"])
            found = point_under(self._placed, view, at, content["reach"])
            self.on_pick(None if found is None else self._cloud[found])


def load_anywidget() -> Any:
    """The module anywidget.  Raises InputError saying how to install it where it lacks."""
    try:
        import anywidget
    except ImportError as error:
        raise InputError(
            "clicks on a point cloud need anywidget, which is not installed; pip install anywidget "
            "(or 'zsp-lite[notebooks]')"
        ) from error
    return anywidget


@cache
def _cloud_widget() -> "type[AnyWidget]":
    anywidget = load_anywidget()
    from traitlets import Bytes, Float, Int, List, Unicode

    class CloudCanvas(anywidget.AnyWidget):
        """What the browser knows of a cloud; see `cloud_view.js`."""

        _esm = (Path(__file__).parent / "cloud_view.js").read_text(encoding="utf-8")
        _css = _STYLE
        points = Bytes().tag(sync=True)  # float32 (n, 3), view units
        colours = Bytes().tag(sync=True)  # uint8 (n, 3)
        crosses = Bytes().tag(sync=True)  # uint8 (n): 1 a cross, 0 a disc
        marks = List().tag(sync=True)
        cursor = List(Float()).tag(sync=True)  # [] or a point
        view = List(Float(), [1.0, 0, 0, 0, 1, 0, 0, 0, 1]).tag(sync=True)
        aimed = Int().tag(sync=True)  # counts up when the view is to be taken anew
        side = Int(400).tag(sync=True)
        alt = Unicode().tag(sync=True)

    return CloudCanvas
