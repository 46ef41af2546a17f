"""Aligned point clouds as an interactive 3D scene (plotly)."""

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Real

from zsp_lite.errors import InputError
from zsp_lite.viz.plots import BLUE, ORANGE

MAX_POINTS = 4000  # of both clouds together: beyond that browsers and notebooks grow heavy and nothing more is seen


def aligned_clouds(
    reference: Real[np.ndarray, "n 3"],
    target: Real[np.ndarray, "m 3"],
    names: tuple[str, str] = ("reference, aligned", "target"),
    title: str | None = None,
    seed: int = 0,
) -> go.Figure:
    """Two clouds in one frame: the reference after its Sim3, and the target, both in the target camera's frame.

    The view is the target camera's, moved a little aside: +x right, +y down, +z away. At most 4,000 points
    are drawn, chosen with `seed`. Besides the colour the symbols differ. Raises InputError on an empty cloud
    or values that are not finite.
    """
    rng = np.random.default_rng(seed)
    traces, kept = [], []
    looks = ((BLUE, "circle", 2.2), (ORANGE, "diamond-open", 2.6))
    for cloud, name, (colour, symbol, size) in zip((reference, target), names, looks):
        cloud = np.asarray(cloud, dtype=np.float64)
        if len(cloud) == 0 or not np.isfinite(cloud).all():
            raise InputError(f"point cloud {name!r} of shape {cloud.shape} is empty or not finite")
        if len(cloud) > MAX_POINTS // 2:
            cloud = cloud[np.sort(rng.choice(len(cloud), MAX_POINTS // 2, replace=False))]
        # Three decimals of a unit-spread cloud are finer than a pixel, and keep the page small.
        cloud = np.round(cloud, 3).astype(np.float32)
        kept.append(cloud)
        x, y, z = cloud.T
        marker = {"size": size, "color": colour, "symbol": symbol, "opacity": 0.75}
        traces.append(go.Scatter3d(x=x, y=y, z=z, mode="markers", name=name, marker=marker))

    figure = go.Figure(traces)
    figure.update_layout(
        title=title,
        height=440,
        margin={"l": 0, "r": 0, "t": 40 if title else 0, "b": 10},
        legend={
            "itemsizing": "constant",
            "orientation": "h",
            "x": 0,
            "y": 0,
            "bgcolor": "rgba(255,255,255,0.8)",
        },
        scene={
            **{f"{axis}axis": {"title": {"text": label}, "range": span} for axis, label, span in _axes(kept)},
            "aspectmode": "cube",
            "camera": {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 0.9, "y": -0.7, "z": -2.15}},
        },
    )
    return figure


def _axes(clouds: list[np.ndarray]) -> list[tuple[str, str, list[float]]]:
    """Name, label and one common span for each axis, from the middle 98 % of the points: strays must not shrink all."""
    low, high = np.percentile(np.concatenate(clouds), [1, 99], axis=0)
    centre, half = (low + high) / 2, 0.6 * float((high - low).max())
    labels = ("x (right)", "y (down)", "z (away)")
    return [
        (axis, label, [float(middle - half), float(middle + half)])
        for axis, label, middle in zip("xyz", labels, centre)
    ]
