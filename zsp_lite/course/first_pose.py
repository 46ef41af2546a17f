"""The first lesson: a pose that is turned, and arrows to the front of objects."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from zsp_lite.alignment import Sim3
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.ground_truth import object_poses
from zsp_lite.estimates import PoseEstimate
from zsp_lite.viz import plots

_MOVED = {"color": plots.ORANGE, "linewidth": 2.5, "path_effects": plots.BORDER}
_TRUE = {"color": plots.GREEN, "linewidth": 6}


def turned(estimate: PoseEstimate, up: Float[np.ndarray, "3"], degrees: float) -> PoseEstimate:
    """Turn an estimate about the middle of its moved points and a direction of the target's
    world."""
    axis = np.radians(degrees) * estimate.target_camera.R @ up
    turn = Rotation.from_rotvec(axis).as_matrix()
    middle = estimate.sim3.apply(plots.object_cloud(estimate.reference_view)).mean(axis=0)
    return replace(estimate, sim3=Sim3(1.0, turn, middle - turn @ middle) @ estimate.sim3)


def show_fronts(
    dataset: Co3D, pairs: Sequence[Pair], estimates: Sequence[PoseEstimate], titles: Sequence[str]
) -> Figure:
    """Show the references of pairs and, below, their chosen targets, with arrows to the fronts;
    poses move points and arrows."""
    views = [plots.chosen_views([one]) for one in estimates]
    images = [plots.pale(pair[row].frame.rgb) for row in (0, 1) for pair in views]
    figure, axes = plots.show_images(images, titles, len(pairs), 2.3)
    for pair, one, seen, *both in zip(pairs, estimates, views, axes, axes[len(pairs) :]):
        plots.draw_estimates(both, [one], most=1500)
        poses = [object_poses(dataset, pair.category)[name] for name, _ in pair.frames[:2]]
        fronts = [pose.t + np.outer([0, 2], pose.scale * pose.R[:, 0]) for pose in poses]
        fronts.append(one.world_sim3.apply(fronts[0]))
        for row, front, style in zip((0, 1, 1), fronts, (_MOVED, _TRUE, _MOVED)):
            (tail, tip), _ = seen[row].frame.camera.project(front)
            shape = {"arrowstyle": "-|>", "mutation_scale": 18, **style}
            both[row].annotate("", tip, tail, arrowprops=shape, annotation_clip=False)
    axes[0].plot([], [], **_MOVED, label="front of the reference, moved by the pose")
    axes[0].plot([], [], **_TRUE, label="front of the target")
    figure.legend(loc="outside lower center", ncols=2)
    return figure
