"""Aligned point clouds as an interactive 3D scene (plotly)."""

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Real

from zsp_lite.viz.plots import BLUE, ORANGE


def aligned_clouds(
    reference: Real[np.ndarray, "n 3"], target: Real[np.ndarray, "m 3"]
) -> go.Figure:
    """Draw two point clouds in the target camera's frame, seen from near that camera: +x right, +y
    down, +z forward.

    More than a few thousand points slow down browsers and enlarge notebooks.
    """
    traces = []
    styles = (
        {"color": BLUE, "symbol": "circle", "size": 2.2},
        {"color": ORANGE, "symbol": "diamond-open", "size": 2.6},
    )
    for name, cloud, style in zip(("reference, aligned", "target"), (reference, target), styles):
        # For a cloud of unit standard deviation three decimals are finer than a pixel; they keep
        # the page small.
        x, y, z = np.round(cloud, 3).astype(np.float32).T
        traces.append(
            go.Scatter3d(
                x=x, y=y, z=z, mode="markers", name=name, marker={"opacity": 0.75, **style}
            )
        )

    # Ranges of equal length, from percentiles, which are robust to outliers.
    low, high = np.percentile(np.concatenate([reference, target]), [1, 99], axis=0)
    middle = (low + high) / 2
    half = 0.6 * float((high - low).max())  # a fifth more than the clouds need
    axes = {
        f"{label[0]}axis": {
            "title": {"text": label},
            "range": [float(x - half), float(x + half)],
            "nticks": 5,
        }
        for label, x in zip(("x (right)", "y (down)", "z (forward)"), middle)
    }
    camera = {
        "up": {"x": 0, "y": -1, "z": 0},
        "eye": {"x": 1.15, "y": -0.74, "z": -1.9},
        "center": {"x": 0.15, "y": 0.12, "z": 0.1},
    }
    return go.Figure(traces).update_layout(
        height=440,
        margin={"l": 0, "r": 0, "t": 0, "b": 28},
        legend={
            "itemsizing": "constant",
            "orientation": "h",
            "x": 0.5,
            "xanchor": "center",
            "y": 0,
            "yanchor": "top",
        },
        scene={**axes, "aspectmode": "cube", "camera": camera},
    )
