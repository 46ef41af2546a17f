"""The photographed motorcycle: its pose, estimated from views of a synthetic one, and figures of
it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from zsp_lite.course import motorcycle
from zsp_lite.course.demo import N_TARGETS
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.evaluation import spread
from zsp_lite.data.frames import Frame
from zsp_lite.data.ground_truth import read_poses
from zsp_lite.estimates import PoseEstimate
from zsp_lite.features import FeatureExtractor
from zsp_lite.metrics import vector_angle
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import object_points
from zsp_lite.viz import plots
from zsp_lite.viz.report import PhotographSection

_COLUMNS = ("foreground", "solver", "front off by", "up off by", "confidence")
# Values of the setting `foreground` of `ZeroShotPose`, and their names in tables and figures.
_FOREGROUNDS = {"mask": "mask", "saliency": "own saliency"}
_SOLVERS = ("paper", "verified")
_POINTS = 1500  # largest number of points that are drawn of the aligned cloud
# Length of the arrows; the points of the photographed motorcycle have unit standard deviation.
_LENGTH = 2.2


@dataclass(frozen=True, eq=False)
class PhotographResult:
    """Pose of the motorcycle of `load_photograph` in its camera, estimated from views of a
    synthetic one."""

    photograph: Frame
    sequence: str  # sequence of the synthetic motorcycle
    foreground: str  # as set in `ZeroShotPose`
    solver: str  # as set in `ZeroShotPose`
    estimate: PoseEstimate  # the photograph is the reference
    # columns: front, left and up of the photographed motorcycle in its camera, as estimated
    axes: Float[np.ndarray, "3 3"]
    # point cloud of the synthetic motorcycle, aligned with the photographed one
    cloud: Float[np.ndarray, "n 3"]
    # position of each point of the cloud, from the rear (0) to the front (1)
    along: Float[np.ndarray, " n"]
    # degrees between the estimated front and the front judged by eye, which may be wrong by 10
    front_error: float
    up_error: float  # degrees between the estimated top and the normal of the floor


def run_photograph(dataset: Co3D, backbone: FeatureExtractor) -> Iterator[PhotographResult]:
    """Estimate how the motorcycle in a real photograph stands, from a synthetic motorcycle whose
    front is known.

    There is one result for each foreground and solver, and none without a category of synthetic
    motorcycles. The sequence is `TARGET` of `motorcycle`, or the first of other data; both are
    independent of the results.
    """
    poses = read_poses(dataset.root, motorcycle.CATEGORY)
    if not poses:
        return
    sequence = motorcycle.TARGET if motorcycle.TARGET in poses else min(poses)
    frames = dataset.frames(motorcycle.CATEGORY, sequence)
    targets = [dataset.load(frames[k]) for k in spread(N_TARGETS, len(frames))]
    pose = poses[sequence]
    points, _ = dataset.point_cloud(motorcycle.CATEGORY, sequence)
    along = pose.to_box(points)[:, 0]
    photograph = motorcycle.load_photograph()
    for foreground in _FOREGROUNDS:
        method = ZeroShotPose(backbone, foreground=foreground)
        reference, *views = method.views([photograph, *targets])
        for solver in _SOLVERS:
            estimate = replace(method, solver=solver).estimate_from_views(reference, views)
            # The estimate leads from the photograph, the reference, to the target's camera.
            camera = estimate.target_camera
            to_photograph = estimate.sim3.inverse()
            axes = to_photograph.R @ camera.R @ pose.R
            yield PhotographResult(
                photograph,
                sequence,
                foreground,
                solver,
                estimate,
                axes,
                cloud=to_photograph.apply(camera.to_camera(points)),
                along=along,
                front_error=float(vector_angle(axes[:, 0], motorcycle.FRONT)),
                up_error=float(vector_angle(axes[:, 2], motorcycle.UP)),
            )


def photograph_section(results: Sequence[PhotographResult]) -> PhotographSection:
    """Return what the report of the demo shows of the results."""
    rows = []
    for result in results:
        confidence = result.estimate.confidence
        row = (
            _FOREGROUNDS[result.foreground],
            result.solver,
            f"{result.front_error:.0f}°",
            f"{result.up_error:.0f}°",
            "–" if confidence is None else f"{confidence:.2f}",
        )
        rows.append(row)
    return PhotographSection(
        results[0].sequence, _COLUMNS, rows, partial(photograph_figure, results)
    )


def photograph_figure(results: Sequence[PhotographResult]) -> Figure:
    """Draw the aligned cloud and the estimated front, left and up on the photograph, one panel per
    result.

    The left column shows a view of the synthetic motorcycle, and the directions judged by eye.
    """
    # A view of the synthetic motorcycle, with white margins to the aspect of the photograph.
    first = results[0]
    photograph = first.photograph
    height, width = photograph.camera.size
    view = plots.chosen_views([first.estimate])[1].frame.rgb
    margin = round((view.shape[0] * width / height - view.shape[1]) / 2)
    view = np.pad(view, ((0, 0), (margin, margin), (0, 0)), constant_values=255)

    # A row for each foreground: a panel at the left, then one for each solver.
    columns = 1 + len(_SOLVERS)
    titles = [f"a view of the synthetic motorcycle,\n{first.sequence}"]
    titles += [
        f"{_FOREGROUNDS[result.foreground]}, {result.solver} solver\n"
        f"front {result.front_error:.0f}°, up {result.up_error:.0f}° off"
        for result in results
    ]
    titles.insert(columns, "directions judged by eye\n")  # at the left of the second row
    images = [view] + [photograph.rgb] * (len(results) + 1)
    figure, axes = plots.show_images(images, titles, columns=columns, size=3.6)
    by_eye = axes.pop(columns)

    # The directions judged by eye, and those of the results.
    left = np.cross(motorcycle.UP, motorcycle.FRONT)
    directions = np.array([motorcycle.FRONT, left, motorcycle.UP])
    arrows = [(by_eye, np.median(object_points(photograph), axis=0), directions)]
    for axis, result in zip(axes[1:], results):
        size = len(result.cloud)
        chosen = np.linspace(0, size - 1, min(_POINTS, size)).astype(int)
        colours = plt.get_cmap("viridis")(result.along[chosen].clip(0, 1))[:, :3]
        plots.draw_points(axis, photograph.camera, result.cloud[chosen], colours, size=6)
        arrows.append((axis, result.cloud.mean(axis=0), result.axes.T))
    for axis, origin, directions in arrows:
        ends = origin + _LENGTH * directions
        plots.draw_axes(axis, photograph.camera, origin, ends, ("front", "left", "up"))
    return figure
