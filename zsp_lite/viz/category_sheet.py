"""Picture of a category: its objects seen by one camera, as scanned and in their common frame."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from zsp_lite.alignment import Sim3
from zsp_lite.data.annotations import FrameAnnotation
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame
from zsp_lite.metrics import rotation_angle
from zsp_lite.scans.category import CategoryAlignment
from zsp_lite.scans.marks import COLOURS, Place, PlacedMark
from zsp_lite.views import object_crop
from zsp_lite.viz.plots import VERMILLION, draw_axes

# Of the table of objects: the probability that the pose is right, the angle to the next best pose,
# and the probability of that one.
COLUMNS = ("object", "right (%)", "else turned by", "that (%)")
_DOUBTFUL = 0.8  # an object whose pose has a lower probability should be looked at
MOST = 10  # objects of a figure
# Width and height of a picture with its texts, and the figure's border, in inches.
_WIDTH = 1.25
_HEIGHT = 1.35
_BORDER = 0.3


def objects_figure(
    dataset: Co3D,
    category: str,
    alignment: CategoryAlignment,
    names: Sequence[str] | None = None,
    front: Sim3 | None = None,
) -> Figure:
    """Show objects by the frame that is nearest to one camera: in their own worlds above, in the
    common frame below.

    The camera is that of the first frame of the most probable object of the category. Doubtful
    objects are shown in their next best turn, too. At most ten objects are shown, with the
    axes of the category if they are known.
    """
    objects = alignment.objects
    names = list(names or objects)[:MOST]
    flagged = doubtful(alignment)

    # The rows: for each object, its pose in the common frame.
    surest = max(objects, key=lambda name: objects[name].probability)
    camera = dataset.camera(_frames(dataset, category, surest)[0]).R
    common = camera @ objects[surest].sim3.R.T  # from the common frame to the camera
    aligned = {name: objects[name].sim3 for name in names}
    rows = {"as scanned": aligned, "aligned": aligned}
    turned = {
        name: pose for name in names if name in flagged and (pose := objects[name].alternative)
    }
    if turned:
        rows["or turned"] = turned

    figure, axes = _panels(len(rows), len(names), _HEIGHT * len(rows) + _BORDER)
    for panels, (title, poses) in zip(axes, rows.items()):
        # The row "or turned" has pictures of some objects only; its title is at the first.
        first = names.index(next(iter(poses)))
        panels[first].set_ylabel(title)
        for axis, name in zip(panels, names):
            if name in poses:
                rotation = camera if title == "as scanned" else common @ poses[name].R
                crop = nearest_crop(dataset, _frames(dataset, category, name), rotation)
                axis.imshow(crop.rgb)
                if front:
                    seen = crop.camera.sim3 @ (front @ poses[name]).inverse()
                    # An arrow that is parallel to the image has 0.35 of its width.
                    reach = 0.35 * seen.t[2] * len(crop.rgb) / crop.camera.K[0, 0]
                    ends = seen.t + reach * seen.R.T
                    draw_axes(axis, crop.camera, seen.t, ends, ("front", "left", "up"), size=7)

    # Names, of which 16 characters have room, and probabilities below the row "aligned".
    for axis, name in zip(axes[1], names):
        text = f"{name[:16]}\n{100 * objects[name].probability:.0f} %"
        colour = VERMILLION if name in flagged else "black"
        axis.set_xlabel(text, fontsize=8, color=colour, parse_math=False)
    return figure


def marks_figure(
    dataset: Co3D,
    category: str,
    alignment: CategoryAlignment,
    placed: Sequence[PlacedMark],
    names: Sequence[str],
) -> Figure:
    """Show marks on objects, a row for each mark: each object by the frame that sees the place from
    the most similar side, the marked one by the frame that is marked.

    Of the names, as many characters are shown as have room.
    """
    figure, axes = _panels(len(placed), len(names), (_HEIGHT + _BORDER) * len(placed))
    for number, (panels, one) in enumerate(zip(axes, placed)):
        mark = one.mark
        marked = dataset.camera(dataset.frame(category, mark.sequence, mark.frame)).R
        # From the common frame to the camera that is marked.
        common = marked @ alignment.objects[mark.sequence].sim3.R.T
        panels[0].set_ylabel(mark.name[:24], fontsize=8, parse_math=False)
        for axis, name in zip(panels, names):
            place = one.places[name]
            frames = _frames(dataset, category, name)
            seeing = [frame for frame in frames if frame.frame_number in place.pixels]
            shown = place.found and len(seeing) > 0
            rotation = common @ alignment.objects[name].sim3.R
            crop = nearest_crop(dataset, seeing if shown else frames, rotation)
            axis.imshow(crop.rgb)
            label = "marked" if name == mark.sequence else _found(place, shown)
            axis.set_xlabel(f"{name[:16]}\n{label}", fontsize=8, parse_math=False)
            if shown:
                x, y = crop.camera.project(place.world)[0] - 0.5  # pixel centres at integers
                colour = COLOURS[number % len(COLOURS)]
                axis.plot(x, y, "o", ms=8, mfc=colour, mec="white", mew=1.5)
    return figure


def _panels(rows: int, columns: int, height: float) -> tuple[Figure, np.ndarray]:
    """Return panels without ticks and frames, in a figure of a height in inches."""
    return plt.subplots(
        rows,
        columns,
        figsize=(_WIDTH * columns + _BORDER, height),
        layout="constrained",
        squeeze=False,
        subplot_kw={"xticks": [], "yticks": [], "frame_on": False},
    )


def _found(place: Place, shown: bool) -> str:
    """Say whether and how surely an object has a place, and whether the picture shows it."""
    if not place.found:
        return "nothing here"
    percent = f"{100 * place.confidence:.0f} %"
    return percent if shown else f"{percent}, not seen"


def nearest_crop(
    dataset: Co3D, frames: Sequence[FrameAnnotation], rotation: Float[np.ndarray, "3 3"]
) -> Frame:
    """Return the object crop of the frame whose camera's rotation from the world is nearest to the
    given one."""
    cameras = np.stack([dataset.camera(frame).R for frame in frames])
    nearest = rotation_angle(cameras, rotation).argmin()
    return object_crop(dataset.load(frames[nearest]))


def doubtful(alignment: CategoryAlignment) -> list[str]:
    """Return the names of the objects whose pose should be looked at."""
    return [name for name, pose in alignment.objects.items() if pose.probability < _DOUBTFUL]


def object_rows(alignment: CategoryAlignment) -> list[tuple[str, ...]]:
    """Return the table of objects: name, probability, next best turn and its probability."""
    rows = []
    for name, pose in alignment.objects.items():
        turn = ""
        probability = ""
        if pose.alternative:
            turn = f"{rotation_angle(pose.sim3.R, pose.alternative.R):.0f}°"
            probability = f"{100 * pose.alternative_probability:.0f}"
        flag = " (look)" if name in doubtful(alignment) else ""
        rows.append((f"{name}{flag}", f"{100 * pose.probability:.0f}", turn, probability))
    return rows


def _frames(dataset: Co3D, category: str, name: str) -> list[FrameAnnotation]:
    """Read the frames of an object with a camera and a mask; without any mask, all frames with a
    camera."""
    frames = [frame for frame in dataset.frames(category, name) if frame.viewpoint is not None]
    return [frame for frame in frames if frame.mask is not None] or frames
