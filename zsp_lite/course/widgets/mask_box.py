"""Widget on masks: a bounding box and the mask that GrabCut segments in it."""

import numpy as np
from matplotlib.patches import Rectangle

from zsp_lite.course.widgets.common import Widget, interactive_figure, slider
from zsp_lite.data.cameras import Box
from zsp_lite.data.frames import ON_OBJECT, Frame
from zsp_lite.importers.masks import grab_cut
from zsp_lite.viz.plots import ORANGE, show_images


def box_to_mask(frame: Frame, box: Box) -> Widget:
    """Show the mask that GrabCut segments in a box (top, left, height, width), and its overlap with
    the frame's."""
    height, width = frame.camera.size
    box_top, box_left, box_height, box_width = box
    figure, (axis,) = show_images([frame.rgb], ["box and mask"], size=4.2)
    shade = axis.imshow(
        np.zeros((height, width, 4)), extent=(0, width, height, 0), interpolation="nearest"
    )
    outline = axis.add_patch(
        Rectangle((0, 0), 1, 1, fill=False, edgecolor=ORANGE, linewidth=2, linestyle="--")
    )  # `update` sets its place and size

    def update(top: int, left: int, bottom: int, right: int) -> str:
        outline.set(xy=(left, top), width=right - left, height=bottom - top)
        mask = grab_cut(frame.rgb, (top, left, bottom - top, right - left)) > ON_OBJECT
        shade.set_data(np.where(mask[..., None], 0, (0, 0, 0, 0.65)))
        text = f"mask of {mask.sum():,} pixels"
        if frame.mask is not None:
            true = frame.mask > ON_OBJECT
            text += f", IoU with the true mask {(mask & true).sum() / (mask | true).sum():.2f}"
        return text

    # Sides may move up to 4 pixels from the opposite border. An empty box gives an empty mask.
    controls = {
        "top": slider("top", 0, height - 4, box_top),
        "left": slider("left", 0, width - 4, box_left),
        "bottom": slider("bottom", 4, height, box_top + box_height),
        "right": slider("right", 4, width, box_left + box_width),
    }
    alt = "An image with a dashed box; the background found by GrabCut is darkened."
    return interactive_figure(figure, controls, update, alt)
