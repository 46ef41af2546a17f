"""Clouds that a reader turns without a kernel: a page with `cloud_view.js` and the points."""

import json
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Real

from zsp_lite.alignment import Sim3
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate
from zsp_lite.viz.plots import coordinate_colours, object_cloud

SCRIPT = (Path(__file__).parent / "cloud_view.js").read_text(encoding="utf-8")
# JupyterLab's keys do nothing in this <div>, so that the arrow keys turn the clouds.
_PAGE = """<div data-lm-suppress-shortcuts="true"><div class="zsp-turning"></div>
<script>(() => {\n%s})()</script></div>"""
_CALL = 'stored(document.currentScript.parentElement.querySelector(".zsp-turning"), %s, %s);'


def view_units(points: Real[np.ndarray, "n 3"]) -> Sim3:
    """Return the similarity from the world to view units, in which a cloud fills the unit ball,
    except for outliers: the ball is around the box from the 1st to the 99th percentile."""
    low, high = np.percentile(points, [1, 99], axis=0) if len(points) else np.zeros((2, 3))
    radius = float(np.linalg.norm(high - low)) / 2
    if not radius >= 1e-12:  # also for a radius that is NaN, for which `<` is false
        raise InputError(
            f"point cloud of {len(points)} points has no extent, expected finite points"
        )
    return Sim3(1 / radius, np.eye(3), -(low + high) / 2 / radius)


def show_turning(
    poses: Mapping[str, PoseEstimate],
    legend: str,
    lines: Mapping[str, Real[np.ndarray, "k 2 3"]] = {},
) -> None:
    """Show, by the title of a pose, the target and the moved points of the reference as clouds that
    turn together; nothing where no script runs.

    The `legend` says whose points the colours are; `lines` join points of the target's camera.
    """
    from IPython.display import HTML, display  # a package that only notebooks need

    panels = []
    for title, one in poses.items():
        own = object_cloud(one.reference_view, most=1200)
        clouds = [one.sim3.apply(own)]
        colours = [255 * coordinate_colours(own)]
        for view in one.target_views:
            cloud = object_cloud(view, 2000 // len(one.target_views))
            world = view.frame.camera.to_world(cloud)
            column, row = view.frame.camera.project(world)[0].astype(int).T
            clouds.append(one.target_camera.to_camera(world))
            colours.append(view.frame.rgb[row, column] / 2 + 127)  # pale
        to_view = view_units(np.concatenate(clouds[1:]))  # the target fills the unit ball
        # 16-bit integers, of which the script makes 8192 one view unit: they reach to 4.
        points = (8192 * to_view.apply(np.concatenate(clouds)).clip(-3.9, 3.9)).astype("<i2")
        parts = [
            b64encode(part).decode() for part in (points, np.concatenate(colours).astype("u1"))
        ]
        joined = to_view.apply(lines.get(title, np.zeros((0, 2, 3)))).round(3).tolist()
        panels.append([title, *parts, joined])
    alt = f"{legend}. Drag or press arrow keys to turn, + and − to zoom."
    call = _CALL % (json.dumps(panels), json.dumps(alt))
    display(HTML(_PAGE % SCRIPT.replace("export default { render };", call)))
