"""Picture of a category: its objects seen by one camera, as scanned and in their common frame."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zsp_lite.category import CategoryAlignment
from zsp_lite.data.annotations import FrameAnnotation
from zsp_lite.data.co3d import Co3D
from zsp_lite.metrics import rotation_angle
from zsp_lite.views import object_crop
from zsp_lite.viz.plots import VERMILLION

COLUMNS = ("object", "right (%)", "else turned by", "that (%)")
_DOUBTFUL = 0.8  # an object with a lower probability should be looked at
MOST = 10  # objects of a figure


def objects_figure(
    dataset: Co3D, category: str, alignment: CategoryAlignment, names: Sequence[str] | None = None
) -> Figure:
    """Show objects by the frame that is nearest to one camera: in their own worlds above, in the
    common frame below.

    The camera is that of the first frame of the most probable object of the category. Doubtful
    objects are shown in their next best turn, too. At most ten objects are shown.
    """
    names = list(names or alignment.objects)[:MOST]
    objects = alignment.objects
    look = doubtful(alignment)
    surest, first = max(objects.items(), key=lambda item: item[1].probability)
    camera = dataset.camera(_frames(dataset, category, surest)[0]).R
    common = camera @ first.sim3.R.T
    rows = {"as scanned": dict.fromkeys(names, camera)}
    rows["aligned"] = {name: common @ objects[name].sim3.R for name in names}
    others = {name: objects[name].alternative for name in names if name in look}
    turned = {name: common @ other.R for name, other in others.items() if other}
    if turned:
        rows["or turned"] = turned
    size = 1.25 * len(names) + 0.3, 1.35 * len(rows) + 0.3
    figure, axes = plt.subplots(
        len(rows), len(names), figsize=size, layout="constrained", squeeze=False
    )
    for line, (title, cameras) in zip(axes, rows.items(), strict=True):
        line[names.index(next(iter(cameras)))].set_ylabel(title)
        for axis, name in zip(line, names, strict=True):
            axis.set(xticks=[], yticks=[], frame_on=False)
            if name in cameras:
                frames = _frames(dataset, category, name)
                angles = rotation_angle(
                    np.stack([dataset.camera(one).R for one in frames]), cameras[name]
                )
                axis.imshow(object_crop(dataset.load(frames[int(np.argmin(angles))])).rgb)
    for axis, name in zip(axes[1], names, strict=True):
        text = f"{name[:16]}\n{100 * objects[name].probability:.0f} %"
        colour = VERMILLION if name in look else "black"
        axis.set_xlabel(text, fontsize=8, color=colour, parse_math=False)
    return figure


def doubtful(alignment: CategoryAlignment) -> list[str]:
    """Return the names of the objects whose pose should be looked at."""
    return [name for name, one in alignment.objects.items() if one.probability < _DOUBTFUL]


def object_rows(alignment: CategoryAlignment) -> list[tuple[str, ...]]:
    """Return the table of objects: name, probability, next best turn and its probability."""
    rows = []
    for name, one in alignment.objects.items():
        other = "", ""
        if one.alternative:
            turn = rotation_angle(one.sim3.R, one.alternative.R)
            other = f"{turn:.0f}°", f"{100 * one.alternative_probability:.0f}"
        flag = " (look)" if name in doubtful(alignment) else ""
        rows.append((f"{name}{flag}", f"{100 * one.probability:.0f}", *other))
    return rows


def _frames(dataset: Co3D, category: str, name: str) -> list[FrameAnnotation]:
    """Read the frames of an object with a camera, and those with a mask only if there are some."""
    frames = [one for one in dataset.frames(category, name) if one.viewpoint is not None]
    return [one for one in frames if one.mask is not None] or frames
