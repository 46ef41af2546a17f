"""The verified solver's ranked hypotheses: leafed through in 3D, in the views, and by what speaks for each."""

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from zsp_lite.errors import InputError
from zsp_lite.verified import Solution
from zsp_lite.verified.poses import rotation_angles
from zsp_lite.verified.verification import TERM_NAMES, ScoreWeights, forward_terms
from zsp_lite.viz.plots import BLUE, ORANGE
from zsp_lite.viz.verified import POINT_CLASSES, classify_points, score_contributions
from zsp_lite.widgets.common import explorer, slider

if TYPE_CHECKING:
    from ipywidgets import VBox

    from zsp_lite.views import View

_MOST = 350  # points of either cloud in 3D
_REACH = 2.2  # of the 3D axes, in spreads of the object


def ranked_hypotheses(solution: Solution, targets: Sequence["View"], weights: ScoreWeights = ScoreWeights()) -> "VBox":
    """The hypotheses of `solution`, best first: clouds in 3D, points in a target view, and the score's parts.

    targets: all target views, in the order that the solver was given.  weights: those that it scored with.
    Controls: the rank, the target view, and the turn of the 3D picture about its upright axis.
    Raises InputError where the targets are not those of the solution, and without ipywidgets.
    """
    used = sorted(solution.view_order)
    if len(targets) != len(solution.view_angles):
        raise InputError(f"{len(targets)} target views, expected all {len(solution.view_angles)} that were given")
    found, scene = solution.hypotheses, solution.scene
    point_terms = forward_terms(scene, solution.poses)
    classes = [classify_points(point_terms, rank) for rank in range(len(found))]
    pixels = (point_terms.projection.pixels * scene.target_maps.pixel_scale[:, None]).numpy()
    clouds = [_upright(cloud.numpy()) for cloud in solution.poses.apply(scene.reference_points[:: _step(scene)])]
    apart = rotation_angles(solution.poses.rotation, solution.poses.rotation[:1])[:, 0].numpy()
    parts = [score_contributions(one.terms, weights) for one in found]
    names = [name for name in TERM_NAMES if getattr(weights, name)]

    figure = plt.figure(figsize=(9, 3.4), dpi=85)
    grid = figure.add_gridspec(1, 3, width_ratios=(1.25, 1, 0.9), left=0.01, right=0.98, bottom=0.16, top=0.9)
    space, cloud = _clouds(figure, grid[0], solution, clouds[0])
    image_axis = figure.add_subplot(grid[1])
    image_axis.set_axis_off()
    size = targets[used[0]].frame.camera.size
    picture = image_axis.imshow(targets[used[0]].frame.rgb, extent=(0, size[1], size[0], 0))
    marks = [
        image_axis.scatter([], [], s=14, c=colour, marker=marker, edgecolors="black", linewidths=0.4, label=name)
        for name, (colour, marker) in POINT_CLASSES.items()
    ]
    image_axis.set(xlim=(0, size[1]), ylim=(size[0], 0))
    image_axis.legend(loc="upper center", bbox_to_anchor=(0.5, 0), ncols=2, fontsize=6.5, frameon=False)
    bar_axis = figure.add_subplot(grid[2])
    bars = bar_axis.barh(names, np.zeros(len(names)), color=BLUE, edgecolor="black")
    bar_axis.invert_yaxis()
    bar_axis.axvline(0, color="black", linewidth=0.8)
    bar_axis.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    values = [part[name] for part in parts for name in names]
    bar_axis.set_xlim(min(0.0, *values) * 1.1 - 0.1, max(0.0, *values) * 1.1 + 0.1)
    bar_axis.set_xlabel("weight × term (nats)", fontsize=8)
    bar_axis.tick_params(labelsize=8)

    def update(rank: int, view: int, turn: int) -> str:
        index, place = rank - 1, solution.view_order.index(used[view - 1])
        one = found[index]
        cloud._offsets3d = tuple(clouds[index].T)
        space.view_init(elev=15, azim=turn)
        frame = targets[used[view - 1]].frame
        picture.set_data(frame.rgb)
        limits = np.array(frame.camera.size[::-1])
        counts = []
        for point_class, mark in enumerate(marks):
            at = pixels[index, place][classes[index][place] == point_class]
            mark.set_offsets(np.clip(at, 0, limits))
            counts.append(len(at))
        image_axis.set_title(f"target {used[view - 1] + 1}", fontsize=9)
        for bar, name in zip(bars, names):
            bar.set_width(parts[index][name])
        bar_axis.set_title(f"score {one.score:.1f}", fontsize=9)
        behind = f"{found[0].score - one.score:.1f} nats behind the best, {apart[index]:.0f} degrees from it"
        told = ", ".join(f"{count} {name}" for count, name in zip(counts, POINT_CLASSES))
        return (
            f"Hypothesis {rank} of {len(found)}: {behind if index else 'the best'}; score {one.score:.1f}, confidence "
            f"{one.confidence:.0%}. Points in target view {used[view - 1] + 1}: {told}."
        )

    controls = {
        "rank": slider("hypothesis", 1, len(found), 1),
        "view": slider("target view", 1, len(used), 1),
        "turn": slider("turn", -180, 180, -60, 5),
    }
    return explorer(
        figure, controls, update,
        "Left: the reference's points under a hypothesis among the targets' points, in 3D. Middle: the same points "
        "over a target view, marked by what becomes of them. Right: what each term brings into the score.",
    )  # fmt: skip


def _clouds(figure: Figure, cell, solution: Solution, moved: np.ndarray):
    """3D axes with the targets' points and the reference's, and the artist of the latter."""
    space = figure.add_subplot(cell, projection="3d")
    target = solution.scene.target_points.numpy()
    seen = _upright(target[:: max(len(target) // _MOST, 1)])
    space.scatter(*seen.T, s=5, c=ORANGE, marker="D", linewidths=0, depthshade=False, label="targets, all views")
    cloud = space.scatter(*moved.T, s=7, c=BLUE, marker="o", linewidths=0, depthshade=False, label="reference, moved")
    span = (-_REACH, _REACH)
    space.set(xlim=span, ylim=span, zlim=span, xticks=[], yticks=[], zticks=[])
    space.set_xlabel("right", fontsize=8, labelpad=-14)
    space.set_ylabel("away", fontsize=8, labelpad=-14)
    space.set_zlabel("up", fontsize=8, labelpad=-14)
    space.set_box_aspect((1, 1, 1), zoom=1.2)
    space.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=2, fontsize=7, frameon=False, markerscale=2)
    return space, cloud


def _step(scene) -> int:
    return max(len(scene.reference_points) // _MOST, 1)


def _upright(points: np.ndarray) -> np.ndarray:
    """A camera's axes (right, down, away) as right, away, up."""
    return points[:, [0, 2, 1]] * [1, 1, -1]


@cache
def _example_solution() -> tuple[Solution, tuple["View", ...]]:
    """A sample pair of toy trucks, solved."""
    from zsp_lite.backbones.load import load_backbone
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.samples import sample_data
    from zsp_lite.demo import demo_pairs
    from zsp_lite.pipeline import ZeroShotPose
    from zsp_lite.verified import VerifiedSolver

    dataset = Co3D(sample_data())
    pair = demo_pairs(dataset, n_targets=3)[-1]
    reference, targets = dataset.load_pair(pair)
    method = ZeroShotPose(load_backbone("zsp-tiny", "cpu"))
    reference, *targets = method.views([reference, *targets])
    sims = method.similarities(reference, targets)
    pairs = [method.match_pair(reference, *pair) for pair in zip(targets, sims)]
    return VerifiedSolver().solve(reference, targets, pairs), tuple(targets)


def example_ranked_hypotheses() -> "VBox":
    """The widget on a sample pair of toy trucks with three target views."""
    return ranked_hypotheses(*_example_solution())
