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
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from zsp_lite.alignment import Sim3
from zsp_lite.data.co3d import Co3D
from zsp_lite.estimates import PoseEstimate
from zsp_lite.io.files import REPOSITORY, write_atomic
from zsp_lite.matching import cyclical_distances, similarity
from zsp_lite.scans.category import CategoryAlignment
from zsp_lite.scans.marks import PlacedMark
from zsp_lite.scans.pair_result import PairResult
from zsp_lite.viz import category_sheet, plots
from zsp_lite.viz.pose_picture import pose_picture
from zsp_lite.viz.table import COLUMNS, table_rows
from zsp_lite.viz.votes import ring_figure, votes_figure

_GREY = "#7a828b"  # contrast of 3.9 and more to white and to the page's dark ground
_TEMPLATES = Environment(
    loader=PackageLoader("zsp_lite.viz"),
    autoescape=True,
    undefined=StrictUndefined,
    extensions=["jinja2.ext.do"],
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
    return write_report(path, [result], result.backbone, data_note=note)


def write_category_report(
    path: Path,
    alignment: CategoryAlignment,
    dataset: Co3D,
    category: str,
    placed: Sequence[PlacedMark] = (),
    axes: Sim3 | None = None,
) -> Path:
    """Write a page with contact sheets, the table of all objects, the marks and the axes (see
    `category_axes`), and the first sheet of each as objects.jpg and marks.jpg beside it."""
    names = list(alignment.objects)
    most = category_sheet.MOST
    parts = [names[start : start + most] for start in range(0, len(names), most)]
    of_all = dataset, category, alignment  # what both kinds of figures begin with
    sheets = [_sheet(category_sheet.objects_figure(*of_all, part, axes)) for part in parts]
    marked = []
    if placed:
        marked = [_sheet(category_sheet.marks_figure(*of_all, placed, part)) for part in parts]
    text = _TEMPLATES.get_template("category.html").render(
        category=category,
        columns=category_sheet.COLUMNS,
        rows=category_sheet.object_rows(alignment),
        images=[_data_uri(sheet) for sheet in sheets],
        marked=[_data_uri(sheet) for sheet in marked],
        axes=axes,
        doubtful=category_sheet.doubtful(alignment),
    )
    write_atomic(path.with_name("objects.jpg"), sheets[0])
    if placed:
        write_atomic(path.with_name("marks.jpg"), marked[0])
    write_atomic(path, text.encode())
    return path


def write_report(
    path: Path,
    results: Sequence[PairResult],
    backbone: str,
    data: str = "",
    data_note: str = "",
    photograph: PhotographSection | None = None,
) -> Path:
    """Write the page of the demo, or of a pair of the user's own, which has no `data`.

    Args:
        path: File to write.
        results: Results in the order of the page.
        backbone: Name of the backbone.
        data: Name of the demo's data, for the first paragraph.
        data_note: What the page says of the data; of the user's own pair, where its masks are from.
        photograph: Section on the photographed motorcycle; None leaves it out.

    Returns:
        The path of the page.
    """
    with plt.rc_context(dict.fromkeys(_COLOURED, _GREY)):
        pairs = [_pair_parts(result) for result in results]
        picture = _picture(photograph.draw()) if photograph else ""
    page = _TEMPLATES.get_template("report.html").render(
        plotly=Markup(get_plotlyjs()),
        backbone=backbone,
        columns=COLUMNS,
        pairs=pairs,
        data=data,
        data_note=data_note,
        own=not data,
        grey=_GREY,
        photograph=photograph,
        photograph_picture=picture,
        link=lambda name: _notebook_link(name, path.parent),
    )
    write_atomic(path, page.encode(errors="replace"))
    return path


def _pair_parts(result: PairResult) -> dict[str, Any]:
    """Make the rows and the pictures of a pair for the template."""
    pictures = {}
    two_poses = {}
    for solver, estimate in result.estimates.items():
        pictures[solver] = _picture(pose_picture(result, solver))
        if estimate.one_of_two:
            two_poses[solver] = _picture(_two_poses_figure(estimate))
    votes = [votes_figure(result.votes), ring_figure(result)] if result.votes else []
    return {
        "result": result,
        "rows": table_rows(result),
        "pictures": pictures,
        "both": two_poses,
        "votes": [_picture(figure) for figure in votes],
        "stages": _stages(result),
        "scene": _scene(result),
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


def _stages(result: PairResult) -> dict[str, str]:
    """Draw the stages for the first solver's chosen view."""
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

    estimate = result.estimate
    cells = (estimate.matches.reference, estimate.matches.target)
    grid = views[0].features.grid
    figures = {
        "saliency": plots.show_maps(images, saliency, size=2.7, limits=(0, 1), label="saliency"),
        "cycles": plots.show_maps(
            # Distances of ten patches and more have one colour.
            images,
            cycles,
            size=2.7,
            limits=(-10, 0),
            cmap="cividis",
            label="− distance (patches)",
        ),
        "matches": plots.show_matches(images, cells, grid, estimate.inliers, names, size=2.7),
    }
    return {name: _picture(figure) for name, figure in figures.items()}


def _scene(result: PairResult) -> dict[str, Any]:
    """Collect what the page's script draws: both clouds, each in its camera's frame, and all poses
    between these cameras."""
    reference, target = plots.chosen_views([result.estimate])
    poses = {}
    for solver, estimate in result.estimates.items():
        poses[f"{solver} solver"] = estimate
        for rank, other in enumerate(estimate.alternatives, 2):
            poses[f"{solver} solver, hypothesis {rank}"] = replace(
                estimate, sim3=other.sim3, view=other.view
            )
    # Similarities from the reference camera to that of the target.
    moves = [pose.propagate([target.frame.camera])[0] for pose in poses.values()]
    clouds = [plots.object_cloud(reference), plots.object_cloud(target)]

    # The scene is a cube, by percentiles, which are robust to outliers.
    shown = np.concatenate([moves[0].apply(clouds[0]), clouds[1]])
    low, high = np.percentile(shown, [1, 99], axis=0)
    half = 0.6 * (high - low).max()  # a fifth more than the clouds need
    middle = (low + high) / 2
    return {
        "names": list(poses),
        "poses": [move.matrix[:3].round(6).tolist() for move in moves],
        # Lists of x, y and z. Of a cloud with unit deviation, four decimals are finer than a pixel.
        "clouds": [cloud.T.round(4).tolist() for cloud in clouds],
        "ranges": np.stack([middle - half, middle + half], axis=1).tolist(),
    }


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


def _picture(figure: Figure) -> str:
    """Encode a figure for the page: WebP, which has transparency and is as small as JPEG.

    Its method 2 takes half the time of the default, 4, for 4 % more bytes.
    """
    options = {"quality": 86, "method": 2}
    image = _encode(figure, dpi=110, kind="webp", transparent=True, pil_kwargs=options)
    return _data_uri(image, "webp")


def _sheet(figure: Figure) -> bytes:
    """Encode a contact sheet as a file of its own, larger than the pictures of the report."""
    return _encode(figure, dpi=150, kind="jpg", pil_kwargs={"quality": 90})


def _data_uri(image: bytes, kind: str = "jpeg") -> str:
    """Write an image file as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"


def _encode(figure: Figure, dpi: int, kind: str, **options: Any) -> bytes:
    """Encode a figure and close it; `options` is what `Figure.savefig` takes."""
    # The layout is found here and removed: `savefig` draws a figure that has one twice.
    figure.set_dpi(dpi)
    figure.get_layout_engine().execute(figure)
    figure.set_layout_engine(None)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=dpi, format=kind, **options)
    plt.close(figure)
    return buffer.getvalue()
