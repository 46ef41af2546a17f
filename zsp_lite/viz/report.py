"""The demo as one HTML page that needs nothing beside itself: pictures inline, plotly's script inline once."""

import base64
import html
import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from plotly.offline import get_plotlyjs

from zsp_lite.data.frames import Frame
from zsp_lite.demo import DemoResult
from zsp_lite.io.files import write_atomic
from zsp_lite.matching import cyclical_distances, similarity
from zsp_lite.points import object_cloud
from zsp_lite.views import object_crop
from zsp_lite.viz import plots
from zsp_lite.viz.scene3d import aligned_clouds

_DPI = 110
_OVERVIEW_FRAMES = 4
_ON_OBJECT = 0.4  # of a mask: what `crop_to_object` goes by

_CSS = """
:root { color-scheme: light; --ink: #1c2733; --soft: #5a6773; --line: #dfe4e9; --accent: #0072b2; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1120px; padding: 1.5rem 1rem 4rem; background: #fff; color: var(--ink);
       font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; }
h2 { font-size: 1.35rem; margin: 0; }
h3 { font-size: 1.02rem; margin: 0 0 .3rem; }
p { margin: .3rem 0 .8rem; max-width: 75ch; }
.soft { color: var(--soft); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem .9rem .35rem 0; text-align: right;
         border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
a { color: var(--accent); }
section { border-top: 3px solid var(--ink); padding-top: .9rem; margin-top: 2.4rem; }
.stages { display: grid;
          grid-template-columns: repeat(auto-fit, minmax(min(100%, 430px), 1fr)); gap: 1.4rem; margin-top: 1rem; }
.wide { grid-column: 1 / -1; }
figure { margin: 0; min-width: 0; }
figcaption { color: var(--soft); font-size: .92rem; margin-top: .3rem; }
img { max-width: 100%; height: auto; display: block; }
.wide img { min-width: 620px; }
.flag { border-left: 4px solid #d55e00; padding-left: .7rem; }
"""


def write_report(path: str | Path, results: Sequence[DemoResult], data: str, data_note: str, backbone: str) -> Path:
    """Write the page for `results` and return its path. `data` names the folder, `data_note` says what is in it."""
    path = Path(path)
    write_atomic(path, page(results, data, data_note, backbone).encode())
    return path


def write_overview(path: str | Path, results: Sequence[DemoResult]) -> Path:
    """Write one JPEG with a row for each result: reference, chosen target view, the pose over the target sequence."""
    path = Path(path)
    images, titles = [], []
    for result in results:
        views, frames = [view.frame for view in _best_views(result)], _crops(result)
        blank = [np.full_like(views[0].rgb, 255)] * (_OVERVIEW_FRAMES - len(frames))
        images += [frame.rgb for frame in (*views, *frames)] + blank
        titles += [f"{result.pair.category}: reference", "chosen target view"]
        titles += [f"pose {result.error:.0f}° off" if k == 0 else "" for k in range(_OVERVIEW_FRAMES)]
    figure, axes = plots.show_images(images, titles, columns=2 + _OVERVIEW_FRAMES, size=1.7)
    for row, result in enumerate(results):
        cloud = object_cloud(result.estimate.reference_view, most=1500)
        colours = plots.coordinate_colours(cloud)
        first = row * (2 + _OVERVIEW_FRAMES)
        plots.draw_points(axes[first], result.estimate.reference_view.frame.camera, cloud, colours, size=3)
        cameras = [frame.camera for frame in _crops(result)]
        for axis, camera, pose in zip(axes[first + 2 :], cameras, result.estimate.propagate(cameras)):
            plots.draw_points(axis, camera, pose.apply(cloud), colours, size=3)
    write_atomic(path, _jpeg(figure))
    return path


def page(results: Sequence[DemoResult], data: str, data_note: str, backbone: str) -> str:
    """The page as text."""
    rows = "\n".join(_row(index, result) for index, result in enumerate(results))
    sections = "\n".join(_section(index, result) for index, result in enumerate(results))
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>zsp-lite: zero-shot pose, end to end</title><style>{_CSS}</style>
<script>{get_plotlyjs()}</script></head><body>
<header><h1>Zero-shot category-level pose, end to end</h1>
<p>Two objects of one category, neither with a label: how must the first be turned, moved and scaled to lie on the
second? Below, every stage of the method on one pair of each category in <code>{html.escape(data)}</code>.</p>
<p><strong>Data:</strong> {html.escape(data_note)}
<strong>Backbone:</strong> <code>{html.escape(backbone)}</code>.
The pairs are the first evaluation pair of each category, fixed before anything was run: what fails is shown
too.</p></header>
<div class="scroll"><table><thead><tr><th scope="col">category</th><th scope="col">chosen view</th>
<th scope="col">inliers</th><th scope="col">rotation error</th><th scope="col">time</th></tr></thead>
<tbody>{rows}</tbody></table></div>
<p class="soft">Rotation error: angle between the estimated and the labelled rotation; 180 degrees is the
largest there is. Time: from the frames in memory to the pose.</p>
{sections}
</body></html>
"""


def table_row(result: DemoResult) -> tuple[str, str, str, str, str]:
    """Category, chosen view, inliers, rotation error and time of a result, as text."""
    estimate = result.estimate
    return (
        result.pair.category,
        f"{estimate.view + 1} of {len(estimate.target_views)}",
        f"{int(estimate.inliers.sum())} of {len(estimate.inliers)}",
        f"{result.error:.1f}°",
        f"{result.seconds:.2f} s",
    )


def _row(index: int, result: DemoResult) -> str:
    category, *cells = map(html.escape, table_row(result))
    return (
        f'<tr><td><a href="#pair-{index}">{category}</a></td>' + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
    )


def _section(index: int, result: DemoResult) -> str:
    estimate, pair = result.estimate, result.pair
    category = pair.category
    flag = f'<p class="flag">{html.escape(estimate.note)}</p>' if estimate.flags else ""
    timings = ", ".join(f"{name} {1000 * seconds:.0f} ms" for name, seconds in estimate.timings.items())
    chosen = f"target view {estimate.view + 1}"
    stages = [
        _figure(
            "Reference and target views",
            _views(result),
            True,
            f"The reference {category} and the views of another {category}; {chosen} is marked.",
            "All views are cropped to the object. The score is eq. 3; the marked view has the highest.",
        ),
        _figure(
            "Saliency",
            _saliency(result),
            False,
            f"Saliency of the reference and of {chosen} as a colour overlay.",
            "Attention of the CLS token. Patches above 0.05 count as the object.",
        ),
        _figure(
            "Cyclical distances",
            _cycles(result),
            False,
            f"Cyclical distance map of the reference against {chosen}, and back.",
            "Each patch goes to its nearest neighbour in the other image and back; bright is a return near to the "
            "start. Clear patches leave the object on the way.",
        ),
        _figure(
            "Correspondences",
            _correspondences(result),
            False,
            f"Lines between matched patches of the reference and {chosen}; inliers solid, outliers dashed.",
            f"{len(estimate.matches)} matches; the {int(estimate.inliers.sum())} solid ones agree with the pose, "
            "the dashed grey ones do not.",
        ),
        _scene(result, f"pair-{index}-scene"),
        _figure(
            "The pose over the target sequence",
            _propagated(result),
            True,
            f"The aligned reference cloud drawn over {len(result.sequence)} frames of the target sequence.",
            "One estimate, carried to other frames through the known cameras. Colours run along the reference "
            "object: the same colour stays on the same part.",
        ),
    ]
    return f"""<section id="pair-{index}"><h2>{html.escape(category)}: {result.error:.1f}° off</h2>
<p class="soft">Reference {html.escape(pair.reference_sequence)}, frame {pair.reference_frame}; target
{html.escape(pair.target_sequence)}, frames {", ".join(map(str, pair.target_frames))}.
Scale {estimate.sim3.scale:.2f}.
Time per stage: {html.escape(timings)}.</p>{flag}
<div class="stages">{"".join(stages)}</div></section>"""


def _views(result: DemoResult) -> Figure:
    estimate = result.estimate
    views = [estimate.reference_view, *estimate.target_views]
    titles = ["reference"] + [f"target {i + 1}\nscore {score:.1f}" for i, score in enumerate(estimate.view_scores)]
    figure, axes = plots.show_images([view.frame.rgb for view in views], titles, size=1.9)
    plots.mark(axes[1 + estimate.view], "chosen")
    return figure


def _saliency(result: DemoResult) -> Figure:
    views = _best_views(result)
    figure, axes = plots.show_images([view.frame.rgb for view in views], ["reference", "chosen target"], size=2.7)
    for axis, view in zip(axes, views):
        plots.overlay_map(axis, view.features.saliency.cpu().numpy(), limits=(0, 1), label="saliency")
    return figure


def _cycles(result: DemoResult) -> Figure:
    views = _best_views(result)
    figure, axes = plots.show_images([view.frame.rgb for view in views], ["reference", "chosen target"], size=2.7)
    sim = similarity(views[0].features, views[1].features)
    for axis, start, end, table in ((axes[0], *views, sim), (axes[1], *views[::-1], sim.T)):
        distances = cyclical_distances(table, start.features.grid, end.features.grid, start.foreground, end.foreground)
        plots.overlay_map(axis, distances.cpu().numpy(), limits=(-10, 0), cmap="cividis", label="− distance (patches)")
    return figure


def _correspondences(result: DemoResult) -> Figure:
    estimate = result.estimate
    first, second = _best_views(result)
    return plots.draw_matches(
        first.frame.rgb,
        second.frame.rgb,
        plots.patch_centres(estimate.matches.reference, first.features.grid, first.frame.camera.size),
        plots.patch_centres(estimate.matches.target, second.features.grid, second.frame.camera.size),
        estimate.inliers,
        ("reference", "chosen target"),
        size=2.7,
    )


def _propagated(result: DemoResult) -> Figure:
    cloud = object_cloud(result.estimate.reference_view, most=1500)
    colours = plots.coordinate_colours(cloud)
    frames = result.sequence
    titles = [f"view {i + 1}" for i in range(len(frames))]
    figure, axes = plots.show_images([frame.rgb for frame in frames], titles, columns=3, size=3)
    length = 1.2 * float(cloud.std(axis=0).mean())
    for axis, frame, pose in zip(axes, frames, result.estimate.propagate([frame.camera for frame in frames])):
        plots.draw_points(axis, frame.camera, pose.apply(cloud), colours, size=3)
        plots.draw_axes(axis, frame.camera, pose.apply, cloud.mean(axis=0), length)
    return figure


def _scene(result: DemoResult, name: str) -> str:
    first, second = _best_views(result)
    scene = aligned_clouds(result.estimate.sim3.apply(object_cloud(first)), object_cloud(second))
    inline = scene.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id=name,
        config={"displaylogo": False, "responsive": True},
    )
    return (
        f"<figure><h3>Aligned point clouds</h3>{inline}<figcaption>The reference's points after the "
        "estimated pose, and the target's own, in the target camera's frame. Drag to turn. Each cloud holds "
        "only what its camera saw.</figcaption></figure>"
    )


def _best_views(result: DemoResult):
    return [result.estimate.reference_view, result.estimate.target_views[result.estimate.view]]


def _crops(result: DemoResult) -> list[Frame]:
    """The object in the target sequence's frames that show it; in CO3D some have an empty mask."""
    shown = [frame for frame in result.sequence if frame.mask is None or (frame.mask > _ON_OBJECT).any()]
    return [object_crop(frame) for frame in shown[:_OVERVIEW_FRAMES]]


def _figure(title: str, figure: Figure, wide: bool, alt: str, caption: str) -> str:
    source = _inline_image(figure)
    return (
        f'<figure{" class=wide" if wide else ""}><h3>{html.escape(title)}</h3><div class="scroll">'
        f'<img alt="{html.escape(alt)}" src="{source}"></div>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _inline_image(figure: Figure) -> str:
    """The figure as a data URI."""
    return "data:image/jpeg;base64," + base64.b64encode(_jpeg(figure)).decode()


def _jpeg(figure: Figure) -> bytes:
    """The figure's bytes; JPEG, for most of it is pictures. Closes the figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="jpeg", dpi=_DPI, facecolor="white", pil_kwargs={"quality": 88})
    plt.close(figure)
    return buffer.getvalue()
