"""Results as one self-contained HTML page, and as one picture.

The page is the Jinja2 template `templates/report.html`. Images are inlined as data URIs and plotly's script once. It
follows the colour scheme of the browser: figures are transparent, with text in a grey that is legible on both grounds.
"""

import base64
import importlib.metadata
import io
import json
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.figure import Figure
from matplotlib.text import Text
from plotly.offline import get_plotlyjs

from zsp_lite.estimates import PairResult, PoseEstimate
from zsp_lite.io.files import write_atomic
from zsp_lite.matching import cyclical_distances, similarity
from zsp_lite.samples import REPOSITORY
from zsp_lite.views import View
from zsp_lite.viz import plots
from zsp_lite.viz.photograph import (
    PHOTOGRAPH_COLUMNS,
    PHOTOGRAPH_CREDIT,
    PhotographResult,
    photograph_figure,
    photograph_rows,
)
from zsp_lite.viz.pose_picture import pose_picture
from zsp_lite.viz.result_plots import matches_of_estimate
from zsp_lite.viz.scene3d import STYLES, aligned_clouds

COLUMNS = ("category", "solver", "view", "inliers", "error", "confidence", "time")
_MEANINGS = {
    "view": "the target view that the pose leads to",
    "inliers": "matches of that view that agree with the pose, which the verified solver does not need",
    "error": "angle to the labelled rotation",
    "confidence": "probability of an error below 30°",
}
_DPI = 110
_OVERVIEW_VIEWS = 4
_OVERVIEW_POINTS = 1500
_TWO_POSES_VIEWS = 3
_GREY = "#7a828b"  # contrast of 3.9 and more to white and to the page's dark ground
# Terms of the captions that are explained on hover.
_TERMS = {
    "eq. 2": "Equation 2 of the paper: the cyclical distance of a patch is the distance between it and the patch where "
    "the way to its nearest neighbour in the other image and back ends",
    "eq. 3": "Equation 3 of the paper: the score of a target view is minus the sum of the feature distances of its "
    "matches to the reference; nearer to zero is better",
    "CLS token": "The classification token: an extra input of the vision transformer that collects what describes the "
    "whole image; its attention to a patch says how much the patch contributes",
    "nats": "Natural units of a log-probability: one nat less means a probability that is lower by the factor 2.7",
}


def write_report(
    path: str | Path,
    results: Sequence[PairResult],
    data: str,
    data_note: str,
    backbone: str,
    photograph: Sequence[PhotographResult] = (),
) -> Path:
    """Write the page of the demo."""
    path = Path(path)
    page = render_page(results, backbone, path.parent, data, data_note, photograph=photograph)
    write_atomic(path, page.encode(errors="replace"))
    return path


def write_pair_report(path: str | Path, result: PairResult) -> Path:
    """Write the page of one pair of the user's own."""
    path = Path(path)
    names = {"given": "given with the images", "box": "GrabCut from a box", "auto": "found by depth and colours"}
    note = f"reference {names[result.masks[0]]}, target {names[result.masks[1]]}"
    page = render_page([result], result.backbone, path.parent, data_note=note, own=True)
    write_atomic(path, page.encode(errors="replace"))
    return path


def render_page(
    results: Sequence[PairResult],
    backbone: str,
    folder: Path = Path(),
    data: str = "",
    data_note: str = "",
    own: bool = False,
    photograph: Sequence[PhotographResult] = (),
) -> str:
    """Return the page as text: of the demo, or of a pair of the user's `own`. Links are relative to `folder`."""
    environment = Environment(loader=PackageLoader("zsp_lite.viz"), autoescape=True, undefined=StrictUndefined)
    environment.filters |= {"explain": _explain, "notebook": lambda name: _notebook_link(name, folder)}
    pairs = [
        {
            "result": result,
            "rows": table_rows(result),
            "pictures": {solver: _data_uri(pose_picture(result, solver)) for solver in result.estimates},
            "both": {
                solver: _data_uri(_two_poses_figure(estimate))
                for solver, estimate in result.estimates.items()
                if estimate.one_of_two
            },
            "stages": _stages(result, f"scene-{index}"),
        }
        for index, result in enumerate(results, 1)
    ]
    labelled = any(result.errors for result in results) or not own
    return environment.get_template("report.html").render(
        plotly=Markup(get_plotlyjs()), backbone=backbone, columns=COLUMNS, pairs=pairs, labelled=labelled, data=data,
        data_note=data_note, own=own, photograph=_photograph_section(photograph) if photograph else None,
    )  # fmt: skip


def _explain(text: str) -> Markup:
    """Escape a text and add the explanations of `_TERMS`."""
    safe = str(escape(text))
    for term, meaning in _TERMS.items():
        safe = re.sub(rf"\b{re.escape(term)}", f'<abbr tabindex="0" title="{escape(meaning)}">{term}</abbr>', safe)
    return Markup(safe)


def _notebook_link(name: str, folder: Path) -> Markup:
    """Link to a notebook: on the project's site, in the clone, or in the repository; a name alone if there is none."""
    label = Markup("notebook {}").format(name[:2])
    local = REPOSITORY / "notebooks" / f"{name}.ipynb"
    if site := _project_url("Documentation"):
        address = f"{site.rstrip('/')}/notebooks/{name}.html"
    elif local.is_file():
        try:
            address = Path(os.path.relpath(local, folder)).as_posix()
        except ValueError:  # on Windows, between drives
            return label
    elif repository := _project_url("Repository"):
        address = f"{repository.rstrip('/')}/blob/main/notebooks/{name}.ipynb"
    else:
        return label
    return Markup('<a href="{}">{}</a>').format(address, label)


def _project_url(label: str) -> str | None:
    """Return an address of the installed package, as in `project.urls` of its pyproject.toml; None if it is not set."""
    try:
        listed = importlib.metadata.metadata("zsp-lite").get_all("Project-URL") or []
    except importlib.metadata.PackageNotFoundError:
        return None
    return dict(one.split(", ", 1) for one in listed).get(label)


def _photograph_section(results: Sequence[PhotographResult]) -> dict:
    rows, image = photograph_rows(results), _data_uri(photograph_figure(results))
    about = {"sequence": results[0].sequence, "credit": PHOTOGRAPH_CREDIT}
    return about | {"columns": PHOTOGRAPH_COLUMNS, "rows": rows, "image": image}


def table_rows(result: PairResult) -> list[tuple[str, ...]]:
    """Format the estimate of each solver (see `COLUMNS`)."""
    rows = []
    for solver, estimate in result.estimates.items():
        error = result.errors.get(solver)
        rows.append(
            (
                result.title,
                solver,
                f"{estimate.view + 1} of {len(estimate.target_views)}",
                f"{int(estimate.inliers.sum())} of {len(estimate.inliers)}",
                "–" if error is None else f"{error:.1f}°",
                "–" if estimate.confidence is None else f"{estimate.confidence:.2f}",
                f"{sum(estimate.timings.values()):.2f} s",
            )
        )
    return rows


def legend(columns: Sequence[str] = COLUMNS) -> str:
    """Explain the columns of a table of estimates in one line of text."""
    return "; ".join(f"{name}: {_MEANINGS[name]}" for name in columns if name in _MEANINGS) + "."


def write_overview(path: str | Path, results: Sequence[PairResult]) -> Path:
    """Write a JPEG with a row per result: reference, chosen target view, and the first solver's pose in the others."""
    path = Path(path)
    images, titles, others = [], [], []
    for result in results:
        views, chosen = result.estimate.target_views, result.estimate.view
        others.append([view.frame for k, view in enumerate(views) if k != chosen][:_OVERVIEW_VIEWS])
        frames = [result.estimate.reference_view.frame, views[chosen].frame, *others[-1]]
        blank = [np.full_like(frames[0].rgb, 255)] * (_OVERVIEW_VIEWS - len(others[-1]))
        images += [frame.rgb for frame in frames] + blank
        titles += [f"{result.title}: reference", "chosen target view", f"rotation error {result.error:.0f}°"]
        titles += [""] * (_OVERVIEW_VIEWS - 1)
    columns = 2 + _OVERVIEW_VIEWS
    figure, axes = plots.show_images(images, titles, columns=columns, size=1.7)
    for index, (result, frames) in enumerate(zip(results, others)):
        first, _, *row = axes[index * columns : (index + 1) * columns]
        reference, cameras = result.estimate.reference_view, [frame.camera for frame in frames]
        cloud = plots.object_cloud(reference, most=_OVERVIEW_POINTS)
        plots.draw_points(first, reference.frame.camera, cloud, plots.coordinate_colours(cloud), size=3)
        plots.draw_moved_cloud(row, cameras, cloud, result.estimate.propagate(cameras), names=None)
    write_atomic(path, _encode(figure, format="jpeg", facecolor="white", pil_kwargs={"quality": 88}))
    return path


def _stages(result: PairResult, scene_id: str) -> dict[str, str]:
    """Draw the method's stages for the chosen view of the first solver; `scene_id` is unique on the page."""
    return {
        "saliency": _data_uri(_saliency_figure(result)),
        "cycles": _data_uri(_cycles_figure(result)),
        "matches": _data_uri(matches_of_estimate(result.estimate, size=2.7)),
        "scene": _scene_html(result, scene_id),
    }


def _saliency_figure(result: PairResult) -> Figure:
    views = _chosen_views(result)
    reference, target = (view.features.saliency.cpu().numpy() for view in views)
    maps = {"reference": reference, "chosen target": target}
    return plots.show_maps([view.frame.rgb for view in views], maps, size=2.7, limits=(0, 1), label="saliency")


def _cycles_figure(result: PairResult) -> Figure:
    views, maps = _chosen_views(result), {}
    sim = similarity(views[0].features, views[1].features)
    for title, start, end, table in (("reference", *views, sim), ("chosen target", *views[::-1], sim.T)):
        distances = cyclical_distances(table, start.features.grid, end.features.grid, start.foreground, end.foreground)
        maps[title] = distances.cpu().numpy()
    style = {"limits": (-10, 0), "cmap": "cividis", "label": "− distance (patches)"}
    return plots.show_maps([view.frame.rgb for view in views], maps, size=2.7, **style)


def _scene_html(result: PairResult, scene_id: str) -> Markup:
    """Draw both clouds, with a menu of all poses and a choice of the colours; the page's script serves both."""
    first, second = _chosen_views(result)
    camera = second.frame.camera
    (cloud, colours), (target, target_colours) = map(plots.coloured_cloud, (first, second))
    poses = []
    for solver, estimate in result.estimates.items():
        poses.append((f"{solver} solver", estimate.propagate([camera])[0]))
        for rank, one in enumerate(estimate.alternatives, 2):
            (pose,) = replace(estimate, sim3=one.sim3, view=one.view).propagate([camera])
            poses.append((f"{solver} solver, hypothesis {rank}", pose))
    scene = aligned_clouds(poses[0][1].apply(cloud), target, colours=(colours, target_colours))
    scene.update_layout(
        height=400, paper_bgcolor="rgba(0,0,0,0)", font={"color": _GREY},
        legend={"x": 0.5, "xanchor": "center", "y": 0, "yanchor": "top", "bgcolor": "rgba(0,0,0,0)"},
        margin={"l": 0, "r": 0, "t": 0, "b": 28}, scene_camera=_CLOSE,
    )  # fmt: skip
    scene.update_layout({f"scene_{axis}axis": {"visible": False} for axis in "xyz"})
    config = {"displaylogo": False, "responsive": True, "scrollZoom": False, "displayModeBar": False}
    content = {
        "points": np.round(cloud, 4).tolist(),
        "poses": [pose.matrix[:3].round(6).tolist() for _, pose in poses],
        "plain": [style[0] for style in STYLES],
        "pictures": [list(trace.marker.color) for trace in scene.data],
    }
    loader = PackageLoader("zsp_lite.viz")
    template = Environment(loader=loader, autoescape=True, undefined=StrictUndefined).get_template("scene.html")
    plot = scene.to_html(full_html=False, include_plotlyjs=False, div_id=scene_id, config=config)
    # "<" could end the script element
    text = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    return Markup(template.render(names=[name for name, _ in poses], plot=Markup(plot), content=Markup(text)))


# The clouds fill the scene. The eye is above the target camera, to its right.
_CLOSE = {"up": {"x": 0, "y": -1, "z": 0}, "eye": {"x": 0.75, "y": -0.5, "z": -1.2}, "center": {"x": 0, "y": 0, "z": 0}}


def _two_poses_figure(estimate: PoseEstimate) -> Figure:
    """Draw the estimate (left) and its first alternative (right) in at most three target views, a row each."""
    second = estimate.alternatives[0]
    poses = {
        f"probability {estimate.confidence:.2f}": estimate,
        f"turned by {estimate.angle_to(second):.0f}°, probability {second.confidence:.2f}": replace(
            estimate, sim3=second.sim3, view=second.view
        ),
    }
    views = estimate.target_views[:: -(-len(estimate.target_views) // _TWO_POSES_VIEWS)]
    cameras = [view.frame.camera for view in views]
    titles = [title if row == 0 else "" for row in range(len(views)) for title in poses]
    images = [view.frame.rgb for view in views for _ in poses]
    figure, axes = plots.show_images(images, titles, columns=2, size=4.2)
    cloud = plots.object_cloud(estimate.reference_view, most=_OVERVIEW_POINTS)
    for place, one in enumerate(poses.values()):
        plots.draw_moved_cloud(axes[place::2], cameras, cloud, one.propagate(cameras), ("x", "y", "z"))
    return figure


def _chosen_views(result: PairResult) -> list[View]:
    """Return the reference and the chosen target view."""
    return [result.estimate.reference_view, result.estimate.target_views[result.estimate.view]]


def _data_uri(figure: Figure) -> str:
    """Encode a figure for the page, without a ground: WebP, which has transparency and is as small as JPEG."""
    for text in figure.findobj(Text):
        if text.get_bbox_patch() is None and not text.get_path_effects():  # others have a ground of their own
            text.set_color(_GREY)
    for axis in figure.axes:
        axis.tick_params(color=_GREY)
        for spine in axis.spines.values():
            spine.set_edgecolor(_GREY)
    data = _encode(figure, format="webp", transparent=True, pil_kwargs={"quality": 86})
    return "data:image/webp;base64," + base64.b64encode(data).decode()


def _encode(figure: Figure, **options) -> bytes:
    """Encode a figure and close it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=_DPI, **options)
    plt.close(figure)
    return buffer.getvalue()
