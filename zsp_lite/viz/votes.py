"""What several frames say of one pose: each frame with the pose that it votes for."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from zsp_lite.metrics import SAME_ANGLE
from zsp_lite.pair_result import Vote
from zsp_lite.viz import plots

_SHOWN = 8  # largest number of votes with pictures


def votes_figure(votes: Sequence[Vote]) -> Figure:
    """Show reference frames, each beside the view of the other object that its own pose leads to.

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
    figure, axes = plots.show_images(images, titles, columns=8, size=1.45)
    for k, vote in enumerate(shown):
        panels = axes[2 * k : 2 * k + 2]  # the frame and the view that it leads to
        plots.draw_estimates(panels, [vote.estimate], most=1500, size=2)
        colour = plots.VERMILLION if vote.degrees > SAME_ANGLE else plots.BLUE
        panels[1].title.set_color(colour)
    return figure
