"""Results as one self-contained HTML page.

The page is the Jinja2 template `templates/report.html`. Images are inlined as data URIs and
plotly's script once. It follows the colour scheme of the browser: figures are transparent, with
text in a grey that is legible on both grounds.
"""

import base64
import io
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from zsp_lite.category import CategoryAlignment
from zsp_lite.data.co3d import Co3D
from zsp_lite.estimates import PoseEstimate
from zsp_lite.io.files import REPOSITORY, write_atomic
from zsp_lite.marks import PlacedMark
from zsp_lite.matching import cyclical_distances, similarity
from zsp_lite.pair_result import PairResult
from zsp_lite.viz import category_sheet, plots
from zsp_lite.viz.pose_picture import pose_picture
from zsp_lite.viz.scene3d import aligned_clouds
from zsp_lite.viz.votes import ring_figure, votes_figure

COLUMNS = ("category", "solver", "view", "inliers", "error", "confidence", "time")
_MEANINGS = {
    "view": "the target view that the pose leads to",
    "inliers": "matches of that view that agree with the pose, which the "
    "verified solver does not need",
    "error": "angle to the labelled rotation",
    "confidence": "probability of an error below 30°, calibrated on renderings",
}
_GREY = "#7a828b"  # contrast of 3.9 and more to white and to the page's dark ground
_TEMPLATES = Environment(
    loader=PackageLoader("zsp_lite.viz"), autoescape=True, undefined=StrictUndefined
)
# Parts of figures in this grey on the page, as keys of matplotlib's settings.
_COLOURED = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")


class PhotographSection(NamedTuple):
    """What the page of the demo shows of the photographed motorcycle."""

    sequence: str  # of the synthetic motorcycle
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    draw: Callable[[], Figure]  # called with the colours of the page


def write_pair_report(path: Path, result: PairResult) -> Path:
    """Write the page of one pair of the user's own."""
    origins = {
        "given": "given with the images",
        "box": "GrabCut from a box",
        "auto": "found by depth and colours",
    }
    note = f"reference {origins[result.masks[0]]}, target {origins[result.masks[1]]}"
    return write_report(path, [result], result.backbone, data_note=note, own=True)


def write_category_report(
    path: Path,
    alignment: CategoryAlignment,
    dataset: Co3D,
    category: str,
    placed: Sequence[PlacedMark] = (),
) -> Path:
    """Write a page with contact sheets, the table of all objects and the marks, and the first sheet
    of each as objects.jpg and marks.jpg beside it."""
    names = list(alignment.objects)
    sheets = []
    marked = []
    for start in range(0, len(names), category_sheet.MOST):
        part = names[start : start + category_sheet.MOST]
        figure = category_sheet.objects_figure(dataset, category, alignment, part)
        sheets.append(_encode_sheet(figure))
        if placed:
            figure = category_sheet.marks_figure(dataset, category, alignment, placed, part)
            marked.append(_encode_sheet(figure))
    text = _TEMPLATES.get_template("category.html").render(
        category=category,
        columns=category_sheet.COLUMNS,
        rows=category_sheet.object_rows(alignment),
        images=[_jpeg_uri(sheet) for sheet in sheets],
        marked=[_jpeg_uri(sheet) for sheet in marked],
        doubtful=category_sheet.doubtful(alignment),
    )
    write_atomic(path.with_name("objects.jpg"), sheets[0])
    if placed:
        write_atomic(path.with_name("marks.jpg"), marked[0])
    write_atomic(path, text.encode())
    return path


def _encode_sheet(figure: Figure) -> bytes:
    return _encode(figure, dpi=150, format="jpg", pil_kwargs={"quality": 90})


def _jpeg_uri(image: bytes) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(image).decode()}"


def write_report(
    path: Path,
    results: Sequence[PairResult],
    backbone: str,
    data: str = "",
    data_note: str = "",
    photograph: PhotographSection | None = None,
    own: bool = False,
) -> Path:
    """Write the page of the demo, or of a pair of the user's `own`.

    Args:
        path: File to write.
        results: Results in the order of the page.
        backbone: Name of the backbone.
        data: Name of the data, for the first paragraph.
        data_note: What the page says of the data.
        photograph: Section on the photographed motorcycle; None leaves it out.
        own: Whether the pair is the user's own.

    Returns:
        The path of the page.
    """
    with plt.rc_context(dict.fromkeys(_COLOURED, _GREY)):
        pairs = [_pair_parts(result, f"scene-{index}") for index, result in enumerate(results, 1)]
        picture = _data_uri(photograph.draw()) if photograph else ""
    page = _TEMPLATES.get_template("report.html").render(
        plotly=Markup(get_plotlyjs()),
        backbone=backbone,
        columns=COLUMNS,
        pairs=pairs,
        data=data,
        data_note=data_note,
        own=own,
        photograph=photograph,
        photograph_picture=picture,
        link=lambda name: _notebook_link(name, path.parent),
    )
    write_atomic(path, page.encode(errors="replace"))
    return path


def _pair_parts(result: PairResult, scene_id: str) -> dict[str, Any]:
    """Make the rows and the pictures of a pair for the template."""
    pictures = {}
    two_poses = {}
    for solver, estimate in result.estimates.items():
        pictures[solver] = _data_uri(pose_picture(result, solver))
        if estimate.one_of_two:
            two_poses[solver] = _data_uri(_two_poses_figure(estimate))
    votes = [votes_figure(result.votes), ring_figure(result)] if result.votes else []
    return {
        "result": result,
        "rows": table_rows(result),
        "pictures": pictures,
        "both": two_poses,
        "votes": [_data_uri(figure) for figure in votes],
        "stages": _stages(result, scene_id),
    }


def _notebook_link(name: str, folder: Path) -> Markup:
    """Link to a notebook of the clone, or give its number alone where no link can lead to it."""
    label = Markup("notebook {}").format(name[:2])
    local = REPOSITORY / "notebooks" / f"{name}.ipynb"
    try:
        address = Path(os.path.relpath(local, folder)).as_posix()
    except ValueError:  # on another drive
        return label
    return Markup('<a href="{}">{}</a>').format(address, label) if local.is_file() else label


def table_rows(result: PairResult) -> list[tuple[str, ...]]:
    """Format the estimate of each solver (see `COLUMNS`)."""
    rows = []
    for solver, estimate in result.estimates.items():
        view = f"{estimate.view + 1} of {len(estimate.target_views)}"
        inliers = f"{int(estimate.inliers.sum())} of {len(estimate.inliers)}"
        error = f"{result.errors[solver]:.1f}°" if solver in result.errors else "–"
        confidence = "–" if estimate.confidence is None else f"{estimate.confidence:.2f}"
        seconds = f"{sum(estimate.timings.values()):.2f} s"
        rows.append((result.title, solver, view, inliers, error, confidence, seconds))
    return rows


def legend(columns: Sequence[str] = COLUMNS) -> str:
    """Explain the columns of a table of estimates in one line of text."""
    return "; ".join(f"{name}: {_MEANINGS[name]}" for name in columns if name in _MEANINGS) + "."


def _stages(result: PairResult, scene_id: str) -> dict[str, str]:
    """Draw the stages for the first solver's chosen view; `scene_id` is unique on the page."""
    views = plots.chosen_views([result.estimate])
    names = ("reference", "chosen target")
    images = [view.frame.rgb for view in views]
    saliency = {name: view.features.saliency.numpy() for name, view in zip(names, views)}

    # Cycles of the reference's patches by way of the target, and of the target's by the reference.
    sim = similarity(views[0].features, views[1].features)
    cycles = {}
    for name, start, end, table in zip(names, views, views[::-1], (sim, sim.T)):
        distances = cyclical_distances(
            table, start.features.grid, end.features.grid, start.foreground, end.foreground
        )
        cycles[name] = distances.numpy()

    matches, axes = plots.show_images(images, names, size=2.7)
    pixels = plots.match_pixels(views, result.estimate.matches)
    plots.draw_matches(axes, pixels, result.estimate.inliers)
    figures = {
        "saliency": plots.show_maps(images, saliency, size=2.7, limits=(0, 1), label="saliency"),
        "cycles": plots.show_maps(
            images, cycles, size=2.7, limits=(-10, 0), cmap="cividis", label="− distance (patches)"
        ),
        "matches": matches,
    }
    stages = {name: _data_uri(figure) for name, figure in figures.items()}
    stages["scene"] = _scene_html(result, scene_id)
    return stages


def _scene_html(result: PairResult, scene_id: str) -> Markup:
    """Draw both clouds, with a menu of all poses that the page's script serves."""
    reference, target = plots.chosen_views([result.estimate])
    cloud = plots.object_cloud(reference)
    poses = {}
    for solver, estimate in result.estimates.items():
        poses[f"{solver} solver"] = estimate
        for rank, other in enumerate(estimate.alternatives, 2):
            poses[f"{solver} solver, hypothesis {rank}"] = replace(
                estimate, sim3=other.sim3, view=other.view
            )
    # Similarities from the reference camera to that of the target.
    moves = [pose.propagate([target.frame.camera])[0] for pose in poses.values()]

    scene = aligned_clouds(moves[0].apply(cloud), plots.object_cloud(target))
    # The clouds fill the scene. The eye is above the target camera, to its right.
    camera = {"eye": {"x": 0.75, "y": -0.5, "z": -1.2}, "center": {"x": 0, "y": 0, "z": 0}}
    scene.update_layout(
        height=400,
        scene_camera=camera,
        paper_bgcolor="rgba(0,0,0,0)",
        font_color=_GREY,
        legend_bgcolor="rgba(0,0,0,0)",
        **{f"scene_{axis}axis_visible": False for axis in "xyz"},
    )

    config = {
        "displaylogo": False,
        "responsive": True,
        "scrollZoom": False,
        "displayModeBar": False,
    }
    content = {
        "points": cloud.round(4).tolist(),
        "poses": [move.matrix[:3].round(6).tolist() for move in moves],
    }
    plot = scene.to_html(full_html=False, include_plotlyjs=False, div_id=scene_id, config=config)
    return Markup(
        _TEMPLATES.get_template("scene.html").render(
            names=list(poses), plot=Markup(plot), content=content
        )
    )


def _two_poses_figure(estimate: PoseEstimate) -> Figure:
    """Draw the estimate and its first alternative in the same target view."""
    second = estimate.alternatives[0]
    alternative = replace(estimate, sim3=second.sim3, view=second.view)
    # The same pose, from the reference to the view of the estimate.
    (sim3,) = alternative.propagate([estimate.target_camera])
    title = f"turned by {estimate.angle_to(second):.0f}°, probability {second.confidence:.2f}"
    poses = {
        f"probability {estimate.confidence:.2f}": estimate,
        title: replace(estimate, sim3=sim3),
    }
    return plots.moved_points(poses)


def _data_uri(figure: Figure) -> str:
    """Encode a figure for the page: WebP, which has transparency and is as small as JPEG."""
    data = _encode(figure, format="webp", transparent=True, pil_kwargs={"quality": 86})
    return "data:image/webp;base64," + base64.b64encode(data).decode()


def _encode(figure: Figure, dpi: int = 110, **options: Any) -> bytes:
    """Encode a figure and close it; `options` is what `Figure.savefig` takes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=dpi, **options)
    plt.close(figure)
    return buffer.getvalue()
