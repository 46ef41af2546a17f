"""Clouds that a reader turns without a kernel: a page with `cloud_view.js` and the points."""

import json
from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Real

from zsp_lite.estimates import PoseEstimate
from zsp_lite.viz.plots import coordinate_colours, object_cloud

CLOUD_VIEW = (Path(__file__).parent / "cloud_view.js").read_text(encoding="utf-8")
_PAGE = """<div data-lm-suppress-shortcuts="true"><div class="zsp-turning"></div><style>
.zsp-turning { display: flex; flex-wrap: wrap; gap: 6px 16px; font-size: 14px; line-height: 1.4; }
.zsp-turning figure { flex: 1 1 260px; max-width: 360px; min-width: 0; margin: 0; }
.zsp-turning p { flex: 1 0 100%%; margin: 0; }
.zsp-turning b { padding: 0 1.5em; background: linear-gradient(90deg, #fde725, #21918c, #440154); }
.zsp-turning canvas { display: block; background: white; cursor: grab; touch-action: pan-y; }
</style><script>(() => {\n%s})()</script></div>"""
_CALL = 'stored(document.currentScript.parentElement.querySelector(".zsp-turning"), %s);'
_TURN = "Drag or press arrow keys to turn, + and − to zoom."


def show_turning(
    poses: Mapping[str, PoseEstimate],
    legend: str,
    lines: Mapping[str, Real[np.ndarray, "k 2 3"]] = {},
) -> None:
    """Show, by title, the target and the moved points of the reference as clouds that turn
    together; nothing where no script runs.

    The `legend` says whose points the colours are; `lines` join points of the target's camera.
    """
    from IPython.display import HTML, display

    panels = []
    for title, one in poses.items():
        own = object_cloud(one.reference_view, 1200)
        clouds, colours = [one.sim3.apply(own)], [255 * coordinate_colours(own)]
        for view in one.target_views:
            cloud = object_cloud(view, 2000 // len(one.target_views))
            world = view.frame.camera.to_world(cloud)
            column, row = view.frame.camera.project(world)[0].astype(int).T
            clouds.append(one.target_camera.to_camera(world))
            colours.append(view.frame.rgb[row, column] / 2 + 127)  # pale
        corners = np.percentile(np.concatenate(clouds[1:]), [0, 100], axis=0)
        middle, unit = corners.mean(axis=0), np.linalg.norm(np.ptp(corners, axis=0)) / 2
        points = (np.concatenate(clouds) - middle) / unit
        parts = (8192 * points.clip(-3.9, 3.9)).astype("<i2"), np.concatenate(colours).astype("u1")
        panel = dict(zip(("points", "colours"), (b64encode(part).decode() for part in parts)))
        joined = ((lines.get(title, np.zeros((0, 2, 3))) - middle) / unit).round(3).tolist()
        panels.append({"title": title, "lines": joined, **panel})
    alt = f"{legend}. {_TURN}"
    state = {"panels": panels, "alt": alt, "legend": f"<p><b></b> {alt}</p>"}
    script = CLOUD_VIEW.replace("export default { render };", _CALL % json.dumps(state))
    display(HTML(_PAGE % script))
