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
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from plotly.offline import get_plotlyjs

from zsp_lite.alignment import Sim3
from zsp_lite.data.frames import Frame, frame_defect
from zsp_lite.data.samples import REPOSITORY
from zsp_lite.demo import PhotographResult
from zsp_lite.estimates import PairResult, PoseEstimate
from zsp_lite.io.files import write_atomic
from zsp_lite.matching import cyclical_distances, similarity
from zsp_lite.points import coloured_cloud, object_cloud
from zsp_lite.views import View, object_crop
from zsp_lite.viz import plots
from zsp_lite.viz.photograph import PHOTOGRAPH_COLUMNS, PHOTOGRAPH_CREDIT, photograph_figure, photograph_rows
from zsp_lite.viz.scene3d import STYLES, aligned_clouds

COLUMNS = ("category", "solver", "view", "inliers", "error", "confidence", "time")
_MEANINGS = {
    "view": "the target view that the pose leads to",
    "inliers": "matches of that view that agree with the pose, which the verified solver does not need",
    "error": "angle to the labelled rotation",
    "confidence": "probability of an error below 30°",
}
_DPI = 110
_OVERVIEW_FRAMES = 4
_OVERVIEW_POINTS = 1500
_TWO_POSES_FRAMES = 3
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


@dataclass(frozen=True)
class StageFigure:
    """One figure of the page: an image with its alternative text, or HTML that draws it."""

    title: str
    caption: str
    notebook: str  # that explains the stage, without its extension
    image: str | None = None  # a data URI
    alt: str = ""
    html: Markup = Markup()
    wide: bool = False  # spans both columns


def write_report(
    path: str | Path,
    results: Sequence[PairResult],
    data: str,
    data_note: str,
    backbone: str,
    photograph: Sequence[PhotographResult] = (),
) -> Path:
    """Write the page of the demo.

    Args:
        path: File to write; missing folders are created.
        results: One result per pair.
        data: Folder of the data.
        data_note: Remark on the data, printed after the folder.
        backbone: Name of the backbone.
        photograph: Results on the photograph, with which the page begins; may be empty.

    Returns:
        The path.
    """
    path = Path(path)
    page = render_page(results, backbone, path.parent, data, data_note, photograph=photograph)
    write_atomic(path, page.encode(errors="replace"))
    return path


def write_pair_report(path: str | Path, result: PairResult) -> Path:
    """Write the page of one pair of the user's own.

    Args:
        path: File to write; missing folders are created.
        result: The result.

    Returns:
        The path.
    """
    path = Path(path)
    names = {"given": "given with the images", "box": "GrabCut from a box", "auto": "found from the depth"}
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
            "title": result.title,
            "rows": table_rows(result),
            "reference": result.sources[0],
            "target": result.sources[1],
            "answers": [_answer(solver, estimate, result) for solver, estimate in result.estimates.items()],
            "disagreement": result.disagreement,
            "stages": stage_figures(result, f"scene-{index}"),
        }
        for index, result in enumerate(results, 1)
    ]
    labelled = any(result.errors for result in results) or not own
    return environment.get_template("report.html").render(
        plotly=Markup(get_plotlyjs()), backbone=backbone, columns=COLUMNS, pairs=pairs, labelled=labelled, data=data,
        data_note=data_note, own=own, photograph=_photograph_section(photograph) if photograph else None,
    )  # fmt: skip


def _answer(solver: str, estimate: PoseEstimate, result: PairResult) -> dict:
    """Collect what the page says of one solver's answer."""
    return {
        "solver": solver,
        "error": result.errors.get(solver),
        "confidence": estimate.confidence,
        "matrix": estimate.sim3.matrix,
        "scale": estimate.sim3.scale,
        "view": estimate.view + 1,
        "turn": estimate.reference_turn,
        "alternatives": estimate.alternatives,
        "flags": estimate.flags,
        "timings": estimate.timings,
    }


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
    return {
        "sequence": results[0].sequence,
        "columns": PHOTOGRAPH_COLUMNS,
        "rows": photograph_rows(results),
        "stage": StageFigure(
            "Estimated directions and aligned point cloud",
            "Points: the synthetic motorcycle after the estimated pose, from its rear (dark) to its front (bright). "
            f"{PHOTOGRAPH_CREDIT}",
            "00_quickstart",
            _data_uri(photograph_figure(results)),
            f"A photograph of a motorcycle with the aligned cloud of {results[0].sequence} and arrows to the front, "
            "left and up, for two foregrounds and two solvers.",
            wide=True,
        ),
    }


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
    """Write a JPEG with one row per result: reference, chosen target view, and the pose in the target sequence.

    The pose is that of the first solver.

    Args:
        path: File to write; missing folders are created.
        results: One result per pair.

    Returns:
        The path.
    """
    path = Path(path)
    images, titles = [], []
    for result in results:
        views, frames = [view.frame for view in _chosen_views(result)], _sequence_crops(result)
        blank = [np.full_like(views[0].rgb, 255)] * (_OVERVIEW_FRAMES - len(frames))
        images += [frame.rgb for frame in (*views, *frames)] + blank
        titles += [f"{result.title}: reference", "chosen target view"]
        titles += [f"rotation error {result.error:.0f}°" if k == 0 else "" for k in range(_OVERVIEW_FRAMES)]
    columns = 2 + _OVERVIEW_FRAMES
    figure, axes = plots.show_images(images, titles, columns=columns, size=1.7)
    for result, row in zip(results, np.reshape(np.array(axes, dtype=object), (-1, columns))):
        reference = result.estimate.reference_view
        cloud = object_cloud(reference, most=_OVERVIEW_POINTS)
        plots.draw_points(row[0], reference.frame.camera, cloud, plots.coordinate_colours(cloud), size=3)
        cameras = [frame.camera for frame in _sequence_crops(result)]
        plots.draw_moved_cloud(row[2:], cameras, cloud, result.estimate.propagate(cameras), names=None)
    write_atomic(path, _jpeg(figure))
    return path


def stage_figures(result: PairResult, scene_id: str) -> list[StageFigure]:
    """Draw the figures of one result, in the order of the method's stages, those of a single view by the first solver.

    `scene_id` is the HTML id of the 3D scene, unique on the page.
    """
    estimate, title, chosen = result.estimate, result.title, f"target view {result.estimate.view + 1}"
    inliers = int(estimate.inliers.sum())
    paper = "paper" in result.estimates
    scores = (
        "The score is that of eq. 3; the paper's solver chooses the view with the highest."
        if paper
        else "The angle is that between the cameras of the reference and of the view under the estimated pose; the "
        "view with the smallest is chosen."
    )
    stages = [
        StageFigure(
            f"One of two: both poses of the {solver} solver",
            "The solver cannot decide between these two poses, which explain the views about equally well. Points: the "
            "reference object under each pose, coloured along its longest axis. Arrows: the axes of the reference "
            "camera (x right, y down, z forward).",
            "11_hypotheses_and_evidence",
            _data_uri(_two_poses_figure(result, one)),
            f"The same frames of the target sequence with the reference cloud under two poses of the {solver} solver: "
            f"left the estimate, right its first alternative, turned by {one.alternatives[0].angle:.0f} degrees.",
            wide=True,
        )
        for solver, one in result.estimates.items()
        if one.one_of_two
    ]
    stages += [
        StageFigure(
            "Reference and target views",
            f"All views are cropped to the object. {scores}",
            "03_best_view" if paper else "11_hypotheses_and_evidence",
            _data_uri(_views_figure(result)),
            f"The reference and the target views of {title}; {chosen} is framed.",
            wide=True,
        ),
        StageFigure(
            "Saliency",
            "Attention of the CLS token to the patches. Patches above 0.05 are foreground.",
            "01_features",
            _data_uri(_saliency_figure(result)),
            f"Saliency of the reference and of {chosen} as a colour overlay.",
        ),
        StageFigure(
            "Cyclical distances",
            "Each patch is mapped to its nearest neighbour in the other image and back (eq. 2). Bright patches return "
            "close to where they started; uncoloured ones leave the foreground.",
            "02_cyclical_maps",
            _data_uri(_cycles_figure(result)),
            f"Cyclical distance maps between the reference and {chosen}, in both directions.",
        ),
        StageFigure(
            "Correspondences",
            f"{len(estimate.matches)} matches: {inliers} inliers of the pose (solid), "
            f"{len(estimate.matches) - inliers} outliers (dashed)."
            + (
                ""
                if paper
                else " The verified solver starts from matches of all views; few need to agree with its pose."
            ),
            "04_umeyama_ransac",
            _data_uri(_matches_figure(result)),
            f"Lines between matched patches of the reference and {chosen}; inliers solid, outliers dashed.",
        ),
        StageFigure(
            "Aligned point clouds",
            "The reference's points, transformed by the chosen pose, and the target's points, in the frame of "
            f"{chosen}'s camera. Each camera sees one side of its object. Drag to rotate, drag with the right button "
            "to move; the buttons above the scene zoom.",
            "04_umeyama_ransac",
            html=_scene_html(result, scene_id),
        ),
    ]
    for solver, one in result.estimates.items():
        stages.append(
            StageFigure(
                f"The pose in the target sequence: {solver} solver",
                "The estimate, propagated to other frames through the known cameras (sec. 5.6). Points: the reference "
                "object, coloured along its longest axis. Arrows: the axes of the reference camera (x right, y down, "
                "z forward).",
                "06_end_to_end_demo" if solver == "paper" else "11_hypotheses_and_evidence",
                _data_uri(_sequence_figure(result, one)),
                f"The aligned reference cloud of the {solver} solver, drawn over {len(result.sequence)} frames of the "
                "target sequence.",
                wide=True,
            )
        )
    return stages


def _views_figure(result: PairResult) -> Figure:
    estimate = result.estimate
    views = [estimate.reference_view, *estimate.target_views]
    titles = ["reference"]
    for number, score in enumerate(estimate.view_scores, 1):
        if not np.isfinite(score):
            text = "left out"
        elif "paper" in result.estimates:
            text = f"score {score:.1f}"
        else:
            text = f"angle {-score:.0f}°"  # the verified solver's scores are negative angles
        titles.append(f"target {number}\n{text}")
    columns = len(views) if len(views) <= 6 else -(-len(views) // 2)
    figure, axes = plots.show_images([view.frame.rgb for view in views], titles, columns=columns, size=1.9)
    chosen: dict[int, list[str]] = {}
    for solver, one in result.estimates.items():
        chosen.setdefault(one.view, []).append(solver)
    for view, solvers in chosen.items():
        plots.mark(axes[1 + view], "chosen" if len(chosen) == 1 else " and ".join(solvers))
    return figure


def _saliency_figure(result: PairResult) -> Figure:
    views = _chosen_views(result)
    figure, axes = plots.show_images([view.frame.rgb for view in views], ["reference", "chosen target"], size=2.7)
    for axis, view in zip(axes, views):
        plots.overlay_map(axis, view.features.saliency.cpu().numpy(), limits=(0, 1), label="saliency")
    return figure


def _cycles_figure(result: PairResult) -> Figure:
    views = _chosen_views(result)
    figure, axes = plots.show_images([view.frame.rgb for view in views], ["reference", "chosen target"], size=2.7)
    sim = similarity(views[0].features, views[1].features)
    for axis, start, end, table in ((axes[0], *views, sim), (axes[1], *views[::-1], sim.T)):
        distances = cyclical_distances(table, start.features.grid, end.features.grid, start.foreground, end.foreground)
        plots.overlay_map(axis, distances.cpu().numpy(), limits=(-10, 0), cmap="cividis", label="− distance (patches)")
    return figure


def _matches_figure(result: PairResult) -> Figure:
    estimate = result.estimate
    first, second = _chosen_views(result)
    return plots.draw_matches(
        first.frame.rgb,
        second.frame.rgb,
        plots.patch_centres(estimate.matches.reference, first.features.grid, first.frame.camera.size),
        plots.patch_centres(estimate.matches.target, second.features.grid, second.frame.camera.size),
        estimate.inliers,
        ("reference", "chosen target"),
        size=2.7,
    )


def _scene_html(result: PairResult, scene_id: str) -> Markup:
    """Draw both clouds, with a menu of all poses and a choice of the colours; the page's script serves both."""
    first, second = _chosen_views(result)
    camera = second.frame.camera
    (cloud, colours), (target, target_colours) = coloured_cloud(first), coloured_cloud(second)
    poses = []
    for solver, estimate in result.estimates.items():
        poses.append((f"{solver} solver", _in_camera(estimate, estimate.sim3, estimate.view, camera)))
        for one in estimate.alternatives:
            pose = _in_camera(estimate, one.sim3, one.view, camera)
            poses.append((f"{solver} solver, hypothesis {one.rank}", pose))
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
_CLOSE = {
    "up": {"x": 0, "y": -1, "z": 0},
    "eye": {"x": 0.75, "y": -0.5, "z": -1.2},
    "center": {"x": 0, "y": 0, "z": 0},
}


def _in_camera(estimate: PoseEstimate, sim3: Sim3, view: int, camera) -> Sim3:
    """Express a pose in one of the target view's cameras in another camera of the same world."""
    own = estimate.target_views[view].frame.camera
    rotation = camera.R @ own.R.T
    return Sim3(1.0, rotation, camera.t - rotation @ own.t) @ sim3


def _sequence_figure(result: PairResult, estimate: PoseEstimate) -> Figure:
    frames = result.sequence
    titles = [f"frame {i + 1} of {len(frames)}" for i in range(len(frames))]
    figure, axes = plots.show_images([frame.rgb for frame in frames], titles, columns=3, size=3.3)
    _draw_pose(axes, frames, estimate)
    return figure


def _two_poses_figure(result: PairResult, estimate: PoseEstimate) -> Figure:
    """Draw the estimate (left) and its first alternative (right) in some frames of the target sequence, a row each."""
    second = estimate.alternatives[0]
    poses = {
        f"probability {estimate.confidence:.2f}": estimate,
        f"turned by {second.angle:.0f}°, probability {second.probability:.2f}": replace(
            estimate, sim3=second.sim3, view=second.view
        ),
    }
    frames = result.sequence[:: -(-len(result.sequence) // _TWO_POSES_FRAMES)]
    titles = [title if row == 0 else "" for row in range(len(frames)) for title in poses]
    images = [frame.rgb for frame in frames for _ in poses]
    figure, axes = plots.show_images(images, titles, columns=2, size=4.2)
    for place, one in enumerate(poses.values()):
        _draw_pose(axes[place::2], frames, one)
    return figure


def _draw_pose(axes: Sequence[Axes], frames: Sequence[Frame], estimate: PoseEstimate) -> None:
    """Draw the reference cloud and the axes of its camera under the pose over frames of the target sequence."""
    cloud, cameras = object_cloud(estimate.reference_view, most=_OVERVIEW_POINTS), [frame.camera for frame in frames]
    plots.draw_moved_cloud(axes, cameras, cloud, estimate.propagate(cameras), ("x", "y", "z"))


def _chosen_views(result: PairResult) -> list[View]:
    """Return the reference and the chosen target view."""
    return [result.estimate.reference_view, result.estimate.target_views[result.estimate.view]]


def _sequence_crops(result: PairResult) -> list[Frame]:
    """Crop the first usable frames of the target sequence to their objects; in CO3D some frames have an empty mask."""
    usable = [frame for frame in result.sequence if not frame_defect(frame)]
    return [object_crop(frame) for frame in usable[:_OVERVIEW_FRAMES]]


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


def _jpeg(figure: Figure) -> bytes:
    """Encode a figure as JPEG, because it mostly shows photographs."""
    return _encode(figure, format="jpeg", facecolor="white", pil_kwargs={"quality": 88})


def _encode(figure: Figure, **options) -> bytes:
    """Encode a figure and close it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=_DPI, **options)
    plt.close(figure)
    return buffer.getvalue()
