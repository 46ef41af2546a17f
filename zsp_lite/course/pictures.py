"""Pictures of lessons: a turned pose, arrows to the front of objects, gains of benchmarks."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from scipy.spatial.transform import Rotation

from zsp_lite.alignment import Sim3
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.ground_truth import object_poses
from zsp_lite.estimates import PoseEstimate
from zsp_lite.viz import plots

# Arrows to the front, the second broader, so that neither hides the other.
_MOVED = {
    "color": plots.ORANGE,
    "linewidth": 2.5,
    "path_effects": plots.BORDER,
    "label": "front of the reference, moved by the pose",
}
_TRUE = {"color": plots.GREEN, "linewidth": 6, "label": "front of the target"}


def turned(estimate: PoseEstimate, up: Float[np.ndarray, "3"], degrees: float) -> PoseEstimate:
    """Turn an estimate about an axis through the middle of the moved points; `up` is its direction
    in the target's world."""
    rotvec = np.radians(degrees) * estimate.target_camera.R @ up
    turn = Rotation.from_rotvec(rotvec).as_matrix()
    middle = estimate.sim3.apply(plots.object_cloud(estimate.reference_view)).mean(axis=0)
    return replace(estimate, sim3=Sim3(1.0, turn, middle - turn @ middle) @ estimate.sim3)


def draw_fronts(axes: Sequence[Axes], dataset: Co3D, pair: Pair, estimate: PoseEstimate) -> None:
    """Draw arrows to the front of the reference and of the chosen target over their images."""
    poses = [object_poses(dataset, pair.category)[name] for name, _ in pair.frames[:2]]
    # Arrows in the objects' worlds, two standard deviations of the object long; +x is the front.
    fronts = [pose.t + np.outer([0, 2], pose.scale * pose.R[:, 0]) for pose in poses]
    fronts.append(estimate.world_sim3.apply(fronts[0]))
    seen = plots.chosen_views([estimate])
    # In the image of the reference its own arrow, in that of the target both.
    for k, front, style in zip((0, 1, 1), fronts, (_MOVED, _TRUE, _MOVED)):
        (tail, tip), _ = seen[k].frame.camera.project(front)
        arrow = FancyArrowPatch(tail, tip, arrowstyle="-|>", mutation_scale=18, zorder=4, **style)
        axes[k].add_patch(arrow).set_clip_on(False)


def show_winners(gains: Mapping[str, np.ndarray], true_gain: float) -> Figure:
    """Show the measured gains of simulated benchmarks, by a name, as a row of dots; those in which
    the better method does not win are red crosses."""
    figure, axis = plt.subplots(figsize=(7.4, 0.9 + 0.75 * len(gains)), layout="constrained")
    for row, values in enumerate(gains.values()):
        height = row + np.linspace(-0.28, 0.28, len(values))
        wins = values > 0
        better, worse = ("", "") if row else ("better method wins", "it does not")
        axis.plot(values[wins], height[wins], "o", color=plots.BLUE, label=better)
        style = {"color": plots.VERMILLION, "markeredgewidth": 2.2, "label": worse}
        axis.plot(values[~wins], height[~wins], "x", **style)
    axis.axvline(0, color="0.3", linewidth=1)
    axis.axvline(true_gain, color=plots.GREEN, linestyle="--", label="true gain")
    axis.set_yticks(range(len(gains)), gains)
    axis.set(xlabel="measured gain (points of Acc30)", ylim=(len(gains) - 0.5, -0.5))
    figure.legend(ncols=3, loc="outside upper center", fontsize=9)
    return figure
