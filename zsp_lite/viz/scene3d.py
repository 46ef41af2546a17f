"""Aligned point clouds as an interactive 3D scene (plotly)."""

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Real, UInt8

from zsp_lite.viz.plots import BLUE, ORANGE

STYLES = ((BLUE, "circle", 2.2), (ORANGE, "diamond-open", 2.6))  # colour, symbol and size of both clouds
_AXIS_LABELS = "x (right)", "y (down)", "z (forward)"


def aligned_clouds(
    reference: Real[np.ndarray, "n 3"],
    target: Real[np.ndarray, "m 3"],
    colours: tuple[UInt8[np.ndarray, "n 3"], UInt8[np.ndarray, "m 3"]] | None = None,
) -> go.Figure:
    """Draw two point clouds in the target camera's frame, seen from near that camera: +x right, +y down, +z forward.

    The clouds differ in colour, if no `colours` are given, and in their markers. More than a few thousand points slow
    down browsers and enlarge notebooks.
    """
    traces, clouds = [], {"reference, aligned": reference, "target": target}
    for (name, cloud), own, (colour, symbol, size) in zip(clouds.items(), colours or (None, None), STYLES):
        if own is not None:
            colour = [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in own.tolist()]
        # For a cloud of unit standard deviation three decimals are finer than a pixel; they keep the page small.
        x, y, z = np.round(cloud, 3).astype(np.float32).T
        marker = {"size": size, "color": colour, "symbol": symbol, "opacity": 0.75}
        traces.append(go.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker))

    # Ranges of equal length, from percentiles, which are robust to outliers.
    low, high = np.percentile(np.concatenate([reference, target]), [1, 99], axis=0)
    middle, half = (low + high) / 2, 0.6 * float((high - low).max())
    axes = {
        f"{label[0]}axis": {"title": {"text": label}, "range": [float(x - half), float(x + half)], "nticks": 5}
        for label, x in zip(_AXIS_LABELS, middle)
    }
    camera = {
        "up": {"x": 0, "y": -1, "z": 0},
        "eye": {"x": 1.15, "y": -0.74, "z": -1.9},
        "center": {"x": 0.15, "y": 0.12, "z": 0.1},
    }
    return go.Figure(traces).update_layout(
        height=440,
        margin={"l": 0, "r": 0, "t": 0, "b": 10},
        legend={"itemsizing": "constant", "orientation": "h", "x": 0, "y": 0, "bgcolor": "rgba(255,255,255,0.8)"},
        scene={**axes, "aspectmode": "cube", "camera": camera},
    )
