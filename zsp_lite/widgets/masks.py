"""A box around an object and the mask that GrabCut makes of it."""

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from zsp_lite.errors import InputError
from zsp_lite.importers.masks import grab_cut
from zsp_lite.viz.plots import ORANGE, show_images
from zsp_lite.widgets.common import explorer, slider

if TYPE_CHECKING:
    from ipywidgets import VBox

    from zsp_lite.data.cameras import Box
    from zsp_lite.data.frames import Frame


def box_to_mask(frame: "Frame", box: "Box") -> "VBox":
    """Sliders move the sides of a box (top, left, height, width) over a picture; the mask follows.

    Where the frame has a mask, the sentence says how far both overlap. Raises InputError without ipywidgets.
    """
    height, width = frame.camera.size
    top, left, box_height, box_width = box
    figure, (axis,) = show_images([frame.rgb], ["box and mask"], size=4.2)
    from matplotlib.patches import Rectangle

    shade = axis.imshow(np.zeros((height, width, 4)), extent=(0, width, height, 0), interpolation="nearest")
    outline = axis.add_patch(Rectangle((0, 0), 1, 1, fill=False, edgecolor=ORANGE, linewidth=2, linestyle="--"))

    def update(top: int, left: int, bottom: int, right: int) -> str:
        outline.set(xy=(left, top), width=right - left, height=bottom - top)
        dark = np.zeros((height, width, 4))
        try:
            if bottom - top < 4 or right - left < 4:
                raise InputError("the box is empty, expected top above bottom and left before right")
            mask = grab_cut(frame.rgb, (top, left, bottom - top, right - left)) > 0.5
        except InputError as problem:
            shade.set_data(dark)
            return str(problem)
        dark[~mask] = (0, 0, 0, 0.65)
        shade.set_data(dark)
        said = f"mask of {mask.sum():,} pixels"
        if frame.mask is not None:
            true = frame.mask > 0.5
            said += f", overlap (IoU) with the true one {(mask & true).sum() / (mask | true).sum():.2f}"
        return said

    controls = {
        "top": slider("top", 0, height - 4, top),
        "left": slider("left", 0, width - 4, left),
        "bottom": slider("bottom", 4, height, top + box_height),
        "right": slider("right", 4, width, left + box_width),
    }
    alt = "A picture with a dashed box; what GrabCut takes for background is darkened."
    return explorer(figure, controls, update, alt)


@cache
def example_box_to_mask() -> "VBox":
    """`box_to_mask` on a sample frame."""
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.frames import mask_to_bbox
    from zsp_lite.data.samples import sample_data

    dataset = Co3D(sample_data())
    category = dataset.categories()[0]
    frame = dataset.load(dataset.frames(category, dataset.sequences(category)[0].sequence_name)[0])
    return box_to_mask(frame, mask_to_bbox(frame.mask))
