"""Draw the four poses of the README, those of `zsp-lite demo`, to notebooks/overview.jpg.

python -m tools.overview
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from zsp_lite.backbones.load import load_backbone
from zsp_lite.choices import SOLVERS
from zsp_lite.course.demo import demo_pairs
from zsp_lite.course.samples import sample_data
from zsp_lite.data.co3d import Co3D
from zsp_lite.metrics import SAME_ANGLE
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.scans.pair_result import PairResult, run_pair
from zsp_lite.viz import plots

PICTURE = Path(__file__).parents[1] / "notebooks" / "overview.jpg"


def overview(results: Sequence[PairResult]) -> Figure:
    """Show a row per result: the reference, and for each solver the target view of its pose under
    the moved points.

    The colour of a point is its position along the reference object. The poses are marked as right
    or wrong.
    """
    titles = ["reference", *(f"{solver} solver" for solver in results[0].estimates)]
    images = []
    for result in results:
        reference, *targets = plots.chosen_views(result.estimates.values())
        images.append(reference.frame.rgb)
        images += [plots.pale(view.frame.rgb) for view in targets]
    figure, axes = plots.show_images(images, columns=len(titles), size=2.4)
    figure.set_layout_engine("compressed")
    for axis, title in zip(axes, titles):
        axis.set_title(title, fontsize=14)
    for result, panels in zip(results, np.reshape(axes, (-1, len(titles)))):
        plots.draw_estimates(panels, result.estimates.values())
        plots.mark(panels[0], result.title, colour="none", size=14)
        for axis, error in zip(panels[1:], result.errors.values()):
            right = error < SAME_ANGLE
            word = "right" if right else "wrong"
            colour = plots.BLUE if right else plots.VERMILLION
            plots.mark(axis, f"{word}: {error:.0f}° off", colour, size=14)
    return figure


if __name__ == "__main__":
    dataset = Co3D(sample_data())
    method = ZeroShotPose(load_backbone())
    found = [run_pair(dataset, pair, method, SOLVERS["both"]) for pair in demo_pairs(dataset)]
    overview(found).savefig(PICTURE, dpi=110, bbox_inches="tight", pil_kwargs={"quality": 88})
