"""What several frames say of one pose: each frame with the pose that it votes for, and all
hypotheses on a ring."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from zsp_lite.data.azimuths import ground_axes
from zsp_lite.metrics import SAME_ANGLE
from zsp_lite.scans.pair_result import PairResult, Vote
from zsp_lite.viz import plots

_SHOWN = 8  # largest number of votes with pictures


def votes_figure(votes: Sequence[Vote]) -> Figure:
    """Show at most eight reference frames, each beside the view of the other object that its own
    pose leads to.

    The colour of a point is its position along the frame's object, in both pictures.
    """
    step = -(-len(votes) // _SHOWN)  # rounded up
    shown = votes[::step]
    images = []
    titles = []
    for vote in shown:
        reference, target = plots.chosen_views([vote.estimate])
        images += [plots.pale(reference.frame.rgb), plots.pale(target.frame.rgb)]
        titles += [
            vote.name.replace(" of ", "\nof "),
            f"{vote.degrees:.0f}° off,\nprob. {vote.estimate.confidence:.2f}",
        ]
    # Four frames to a row, each with its view.
    figure, axes = plots.show_images(images, titles, columns=8, size=1.45)
    for k, vote in enumerate(shown):
        panels = axes[2 * k : 2 * k + 2]  # the frame and the view that it leads to
        plots.draw_estimates(panels, [vote.estimate], most=1500, size=2)
        colour = plots.VERMILLION if vote.degrees > SAME_ANGLE else plots.BLUE
        panels[1].title.set_color(colour)
    return figure


def ring_figure(result: PairResult) -> Figure:
    """Show the turns about the vertical of all hypotheses from the answer (dots), and the answer's
    poses (stars)."""
    answer = result.estimates["verified"]
    up = np.cross(*ground_axes([view.frame.camera for view in answer.target_views]))
    figure, axis = plt.subplots(
        figsize=(3.6, 3.6), layout="constrained", subplot_kw={"polar": True}
    )

    def turn(rotation: np.ndarray) -> float:
        """Return the angle in radians of the part of a rotation that is about the vertical."""
        x, y, z, w = Rotation.from_matrix(rotation @ answer.world_sim3.R.T).as_quat()
        return 2 * np.arctan2(up @ (x, y, z), w)

    # Dots on the outer circle, of radius 1; their areas in square points are proportional to the
    # confidence, by a factor that is chosen by eye.
    for vote in result.votes:
        for pose in vote.estimate.hypotheses:
            world = vote.estimate.between_worlds(pose.sim3, pose.view)
            angle = turn(world.inverse().R if vote.backward else world.R)
            agrees = np.cos(angle) > np.cos(np.radians(SAME_ANGLE))
            colour = plots.BLUE if agrees else plots.VERMILLION
            axis.scatter(angle, 1, s=260 * pose.confidence, c=colour, alpha=0.45)

    # Stars half-way to the circle, each with its confidence nearer to the middle.
    for pose in (answer.hypotheses[0], *answer.alternatives):
        angle = turn(answer.between_worlds(pose.sim3, pose.view).R)
        axis.scatter(
            angle,
            0.5,
            s=400 * pose.confidence,
            c=plots.ORANGE,
            marker="*",
            edgecolors="black",
            linewidths=0.5,
        )
        axis.text(angle, 0.24, f"{pose.confidence:.2f}", ha="center", va="center", fontsize=9)
    axis.set(
        theta_zero_location="N", ylim=(0, 1.15), yticks=[], xticks=np.radians([0, 90, 180, 270])
    )
    return figure
