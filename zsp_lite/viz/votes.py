"""What several frames say of one pose: each frame with the pose that it votes for, and all hypotheses on a ring."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from zsp_lite.category import SAME_ANGLE
from zsp_lite.data.cameras import ground_axes
from zsp_lite.estimates import PairResult
from zsp_lite.viz import plots

_COLUMNS = 4  # frames of each object with pictures


def votes_figure(result: PairResult) -> Figure:
    """Show reference frames above the poses that they vote for, and the turns of all hypotheses from the answer.

    The colour of a point is its position along the frame's object, in both rows. Turns are about the vertical.
    """
    votes = result.votes[:: -(-len(result.votes) // (2 * _COLUMNS))]
    places = [[k for k, vote in enumerate(votes) if vote.backward == backward] for backward in (False, True)]
    columns = max(map(len, places))
    rows = [
        [*(f"{row}{k}" for k in some), *["."] * (columns - len(some)), "ring", "ring"]
        for some in places if some for row in ("frame", "pose")
    ]  # fmt: skip
    size = 1.75 * columns + 3.4, 1.8 * len(rows)
    ring = {"ring": {"polar": True}}
    figure, axes = plt.subplot_mosaic(rows, figsize=size, layout="constrained", per_subplot_kw=ring)
    for k, vote in enumerate(votes):
        panels = axes[f"frame{k}"], axes[f"pose{k}"]
        for axis, view in zip(panels, plots.chosen_views([vote.estimate])):
            axis.imshow(plots.pale(view.frame.rgb))
            axis.set(xticks=[], yticks=[], autoscale_on=False)
        plots.draw_estimates(panels, [vote.estimate], most=1500, size=2)
        panels[0].set_title(vote.name, fontsize=9, parse_math=False)
        right = vote.degrees <= SAME_ANGLE
        label = f"{vote.degrees:.0f}° from the answer\nprobability {vote.estimate.confidence:.2f}"
        panels[1].set_xlabel(label, fontsize=9, color=plots.BLUE if right else plots.VERMILLION)
    _draw_ring(axes["ring"], result)
    return figure


def _draw_ring(axis: Axes, result: PairResult) -> None:
    """Draw all hypotheses of the frames on a circle, and inside it the answer, at the top, and its alternatives."""
    answer = result.estimates["verified"]
    up = np.cross(*ground_axes([view.frame.camera for view in answer.target_views]))

    def turn(rotation: np.ndarray) -> float:
        """Return the part about the vertical of a rotation between the worlds after that of the answer."""
        x, y, z, w = Rotation.from_matrix(rotation @ answer.world_sim3.R.T).as_quat()
        return 2 * np.arctan2(up @ (x, y, z), w)

    for vote in result.votes:
        for one in vote.estimate.hypotheses:
            world = vote.estimate.between_worlds(one.sim3, one.view)
            angle = turn(world.inverse().R if vote.backward else world.R)
            near = abs(np.degrees((angle + np.pi) % (2 * np.pi) - np.pi)) <= SAME_ANGLE
            axis.scatter(angle, 1, 260 * one.confidence, plots.BLUE if near else plots.VERMILLION, alpha=0.45)
    for one in (answer.hypotheses[0], *answer.alternatives):
        angle = turn(answer.between_worlds(one.sim3, one.view).R)
        axis.scatter(angle, 0.5, 400 * one.confidence, plots.ORANGE, "*", edgecolors="black", linewidths=0.5)
        axis.text(angle, 0.24, f"{one.confidence:.2f}", ha="center", va="center", fontsize=9)
    axis.set(theta_zero_location="N", ylim=(0, 1.15), yticks=[], xticks=np.radians([0, 90, 180, 270]))
    axis.set_xticklabels(["0°: answer", "90°", "180°", "270°"], fontsize=9)
    axis.set_title(f"hypotheses of {len(result.votes)} frames (dots), answer (stars)", fontsize=9)
