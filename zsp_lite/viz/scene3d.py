"""Aligned point clouds as an interactive 3D scene (plotly)."""

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Real, UInt8

from zsp_lite.errors import InputError
from zsp_lite.viz.plots import BLUE, ORANGE

MAX_POINTS = 4000  # of both clouds together; more points slow down browsers and enlarge notebooks
STYLES = ((BLUE, "circle", 2.2), (ORANGE, "diamond-open", 2.6))  # colour, symbol and size of both clouds
_AXIS_LABELS = {"x": "x (right)", "y": "y (down)", "z": "z (forward)"}


def aligned_clouds(
    reference: Real[np.ndarray, "n 3"],
    target: Real[np.ndarray, "m 3"],
    names: tuple[str, str] = ("reference, aligned", "target"),
    title: str | None = None,
    seed: int = 0,
    colours: tuple[UInt8[np.ndarray, "n 3"], UInt8[np.ndarray, "m 3"]] | None = None,
) -> go.Figure:
    """Draw two point clouds in the target camera's frame, seen from near that camera: +x right, +y down, +z forward.

    A random subset is drawn of each; the clouds differ in colour, if no `colours` are given, and in their markers.
    """
    rng = np.random.default_rng(seed)
    traces, drawn = [], []
    for index, (cloud, name, (colour, symbol, size)) in enumerate(zip((reference, target), names, STYLES)):
        cloud = np.asarray(cloud, dtype=np.float64)
        if len(cloud) == 0 or not np.isfinite(cloud).all():
            raise InputError(f"point cloud {name!r} of shape {cloud.shape} is empty or not finite")
        own = None if colours is None else colours[index]
        if len(cloud) > MAX_POINTS // 2:
            kept = np.sort(rng.choice(len(cloud), MAX_POINTS // 2, replace=False))
            cloud, own = cloud[kept], None if own is None else own[kept]
        if own is not None:
            colour = [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in own.tolist()]
        # For a cloud of unit standard deviation three decimals are finer than a pixel; they keep the page small.
        cloud = np.round(cloud, 3).astype(np.float32)
        drawn.append(cloud)
        x, y, z = cloud.T
        marker = {"size": size, "color": colour, "symbol": symbol, "opacity": 0.75}
        traces.append(go.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker))

    axes = {
        f"{axis}axis": {"title": {"text": _AXIS_LABELS[axis]}, "range": limits, "nticks": 5}
        for axis, limits in axis_ranges(np.concatenate(drawn)).items()
    }
    camera = {
        "up": {"x": 0, "y": -1, "z": 0},
        "eye": {"x": 1.15, "y": -0.74, "z": -1.9},
        "center": {"x": 0.15, "y": 0.12, "z": 0.1},
    }
    figure = go.Figure(traces)
    figure.update_layout(
        title=title,
        height=440,
        margin={"l": 0, "r": 0, "t": 40 if title else 0, "b": 10},
        legend={"itemsizing": "constant", "orientation": "h", "x": 0, "y": 0, "bgcolor": "rgba(255,255,255,0.8)"},
        scene={**axes, "aspectmode": "cube", "camera": camera},
    )
    return figure


def axis_ranges(points: Real[np.ndarray, "n 3"]) -> dict[str, list[float]]:
    """Ranges of equal length for the x, y and z axis.

    The length is 1.2 times the largest range from the 1st to the 99th percentile, which is robust to outliers.
    """
    low, high = np.percentile(points, [1, 99], axis=0)
    half = 0.6 * float((high - low).max())
    return {axis: [float(middle - half), float(middle + half)] for axis, middle in zip("xyz", (low + high) / 2)}
