"""The demo's results as one self-contained HTML page, and as one picture.

The page is the Jinja2 template `templates/report.html`. Images are inlined as data URIs and plotly's script once.
"""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from zsp_lite.data.frames import Frame
from zsp_lite.demo import DemoResult, PhotographResult
from zsp_lite.io.files import write_atomic
from zsp_lite.matching import cyclical_distances, similarity
from zsp_lite.points import axis_deviation, object_cloud
from zsp_lite.views import View, frame_defect, object_crop
from zsp_lite.viz import plots
from zsp_lite.viz.photograph import PHOTOGRAPH_COLUMNS, PHOTOGRAPH_CREDIT, photograph_figure, photograph_rows
from zsp_lite.viz.scene3d import aligned_clouds

COLUMNS = ("category", "chosen view", "inliers", "rotation error", "time")
_DPI = 110
_OVERVIEW_FRAMES = 4
_OVERVIEW_POINTS = 1500


@dataclass(frozen=True)
class StageFigure:
    """One figure of the page: an image with its alternative text, or HTML that draws it.

    Attributes:
        title: Heading.
        caption: Text below the figure.
        image: Data URI of the image, or None.
        alt: Alternative text of the image.
        html: Markup of the figure if there is no image.
        wide: Whether it spans both columns.
    """

    title: str
    caption: str
    image: str | None = None
    alt: str = ""
    html: Markup = Markup()
    wide: bool = False


def write_report(
    path: str | Path,
    results: Sequence[DemoResult],
    data: str,
    data_note: str,
    backbone: str,
    photograph: Sequence[PhotographResult] = (),
) -> Path:
    """Write the HTML page.

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
    write_atomic(path, render_page(results, data, data_note, backbone, photograph).encode())
    return path


def render_page(
    results: Sequence[DemoResult],
    data: str,
    data_note: str,
    backbone: str,
    photograph: Sequence[PhotographResult] = (),
) -> str:
    """Return the HTML page as text; the arguments are those of `write_report`."""
    loader = PackageLoader("zsp_lite.viz")
    template = Environment(loader=loader, autoescape=True, undefined=StrictUndefined).get_template("report.html")
    pairs = [
        {
            "row": table_row(result),
            "reference_sequence": result.pair.reference_sequence,
            "reference_frame": result.pair.reference_frame,
            "target_sequence": result.pair.target_sequence,
            "target_frames": result.pair.target_frames,
            "scale": result.estimate.sim3.scale,
            "timings": result.estimate.timings,
            "flags": result.estimate.flags,
            "stages": stage_figures(result, f"scene-{index}"),
        }
        for index, result in enumerate(results, 1)
    ]
    return template.render(
        plotly=Markup(get_plotlyjs()), data=data, data_note=data_note, backbone=backbone, columns=COLUMNS, pairs=pairs,
        photograph=_photograph_section(photograph) if photograph else None,
    )  # fmt: skip


def _photograph_section(results: Sequence[PhotographResult]) -> dict:
    return {
        "sequence": results[0].sequence,
        "columns": PHOTOGRAPH_COLUMNS,
        "rows": photograph_rows(results),
        "stage": StageFigure(
            "Estimated directions and aligned point cloud",
            "Points: the synthetic motorcycle after the estimated pose, from its rear (dark) to its front (bright). "
            f"{PHOTOGRAPH_CREDIT}",
            _data_uri(photograph_figure(results)),
            f"A photograph of a motorcycle with the aligned cloud of {results[0].sequence} and arrows to the front, "
            "left and up, for two foregrounds and two solvers.",
            wide=True,
        ),
    }


def table_row(result: DemoResult) -> tuple[str, str, str, str, str]:
    """Format category, chosen view, inliers, rotation error and time of a result (see `COLUMNS`)."""
    estimate = result.estimate
    return (
        result.pair.category,
        f"{estimate.view + 1} of {len(estimate.target_views)}",
        f"{int(estimate.inliers.sum())} of {len(estimate.inliers)}",
        f"{result.error:.1f}°",
        f"{result.seconds:.2f} s",
    )


def write_overview(path: str | Path, results: Sequence[DemoResult]) -> Path:
    """Write a JPEG with one row per result: reference, chosen target view, and the pose in the target sequence.

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
        titles += [f"{result.pair.category}: reference", "chosen target view"]
        titles += [f"rotation error {result.error:.0f}°" if k == 0 else "" for k in range(_OVERVIEW_FRAMES)]
    columns = 2 + _OVERVIEW_FRAMES
    figure, axes = plots.show_images(images, titles, columns=columns, size=1.7)
    for result, row in zip(results, np.reshape(np.array(axes, dtype=object), (-1, columns))):
        cloud = object_cloud(result.estimate.reference_view, most=_OVERVIEW_POINTS)
        colours = plots.coordinate_colours(cloud)
        plots.draw_points(row[0], result.estimate.reference_view.frame.camera, cloud, colours, size=3)
        cameras = [frame.camera for frame in _sequence_crops(result)]
        for axis, camera, pose in zip(row[2:], cameras, result.estimate.propagate(cameras)):
            plots.draw_points(axis, camera, pose.apply(cloud), colours, size=3)
    write_atomic(path, _jpeg(figure))
    return path


def stage_figures(result: DemoResult, scene_id: str) -> list[StageFigure]:
    """Draw the figures of one result, in the order of the method's stages.

    Args:
        result: The result.
        scene_id: HTML id of the 3D scene, unique on the page.
    """
    estimate, category, chosen = result.estimate, result.pair.category, f"target view {result.estimate.view + 1}"
    inliers = int(estimate.inliers.sum())
    return [
        StageFigure(
            "Reference and target views",
            "All views are cropped to the object. The score is that of eq. 3; the view with the highest is chosen.",
            _data_uri(_views_figure(result)),
            f"The reference {category} and the views of another {category}; {chosen} is framed.",
            wide=True,
        ),
        StageFigure(
            "Saliency",
            "Attention of the CLS token to the patches. Patches above 0.05 are foreground.",
            _data_uri(_saliency_figure(result)),
            f"Saliency of the reference and of {chosen} as a colour overlay.",
        ),
        StageFigure(
            "Cyclical distances",
            "Each patch is mapped to its nearest neighbour in the other image and back (eq. 2). Bright patches return "
            "close to where they started; uncoloured ones leave the foreground.",
            _data_uri(_cycles_figure(result)),
            f"Cyclical distance maps between the reference and {chosen}, in both directions.",
        ),
        StageFigure(
            "Correspondences",
            f"{len(estimate.matches)} matches: {inliers} inliers of the pose (solid), "
            f"{len(estimate.matches) - inliers} outliers (dashed).",
            _data_uri(_matches_figure(result)),
            f"Lines between matched patches of the reference and {chosen}; inliers solid, outliers dashed.",
        ),
        StageFigure(
            "Aligned point clouds",
            "The reference's points, transformed by the estimated pose, and the target's points, in the target "
            "camera's frame. Each camera sees one side of its object. Drag to rotate.",
            html=_scene_html(result, scene_id),
        ),
        StageFigure(
            "The pose in the target sequence",
            "The estimate, propagated to other frames through the known cameras (sec. 5.6). Points: the reference "
            "object, coloured along its longest axis. Arrows: the axes of the reference camera (x right, y down, z "
            "forward).",
            _data_uri(_sequence_figure(result)),
            f"The aligned reference cloud drawn over {len(result.sequence)} frames of the target sequence.",
            wide=True,
        ),
    ]


def _views_figure(result: DemoResult) -> Figure:
    estimate = result.estimate
    views = [estimate.reference_view, *estimate.target_views]
    titles = ["reference"] + [
        f"target {number}\n" + (f"score {score:.1f}" if np.isfinite(score) else "left out")
        for number, score in enumerate(estimate.view_scores, 1)
    ]
    figure, axes = plots.show_images([view.frame.rgb for view in views], titles, size=1.9)
    plots.mark(axes[1 + estimate.view], "chosen")
    return figure


def _saliency_figure(result: DemoResult) -> Figure:
    views = _chosen_views(result)
    figure, axes = plots.show_images([view.frame.rgb for view in views], ["reference", "chosen target"], size=2.7)
    for axis, view in zip(axes, views):
        plots.overlay_map(axis, view.features.saliency.cpu().numpy(), limits=(0, 1), label="saliency")
    return figure


def _cycles_figure(result: DemoResult) -> Figure:
    views = _chosen_views(result)
    figure, axes = plots.show_images([view.frame.rgb for view in views], ["reference", "chosen target"], size=2.7)
    sim = similarity(views[0].features, views[1].features)
    for axis, start, end, table in ((axes[0], *views, sim), (axes[1], *views[::-1], sim.T)):
        distances = cyclical_distances(table, start.features.grid, end.features.grid, start.foreground, end.foreground)
        plots.overlay_map(axis, distances.cpu().numpy(), limits=(-10, 0), cmap="cividis", label="− distance (patches)")
    return figure


def _matches_figure(result: DemoResult) -> Figure:
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


def _scene_html(result: DemoResult, scene_id: str) -> Markup:
    first, second = _chosen_views(result)
    scene = aligned_clouds(result.estimate.sim3.apply(object_cloud(first)), object_cloud(second))
    scene.update_layout(height=370)
    config = {"displayModeBar": False, "responsive": True}
    return Markup(scene.to_html(full_html=False, include_plotlyjs=False, div_id=scene_id, config=config))


def _sequence_figure(result: DemoResult) -> Figure:
    cloud = object_cloud(result.estimate.reference_view, most=_OVERVIEW_POINTS)
    colours = plots.coordinate_colours(cloud)
    frames = result.sequence
    titles = [f"frame {i + 1} of {len(frames)}" for i in range(len(frames))]
    figure, axes = plots.show_images([frame.rgb for frame in frames], titles, columns=3, size=3.3)
    length = 2 * axis_deviation(cloud)
    for axis, frame, pose in zip(axes, frames, result.estimate.propagate([frame.camera for frame in frames])):
        plots.draw_points(axis, frame.camera, pose.apply(cloud), colours, size=3)
        plots.draw_axes(axis, frame.camera, pose.apply, cloud.mean(axis=0), length)
    return figure


def _chosen_views(result: DemoResult) -> list[View]:
    """Return the reference and the chosen target view."""
    return [result.estimate.reference_view, result.estimate.target_views[result.estimate.view]]


def _sequence_crops(result: DemoResult) -> list[Frame]:
    """Crop the first usable frames of the target sequence to their objects; in CO3D some frames have an empty mask."""
    usable = [frame for frame in result.sequence if not frame_defect(frame)]
    return [object_crop(frame) for frame in usable[:_OVERVIEW_FRAMES]]


def _data_uri(figure: Figure) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(_jpeg(figure)).decode()


def _jpeg(figure: Figure) -> bytes:
    """Encode a figure and close it. JPEG, because it mostly shows photographs."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="jpeg", dpi=_DPI, facecolor="white", pil_kwargs={"quality": 88})
    plt.close(figure)
    return buffer.getvalue()
