"""Places marked in frames of one object: where they are on the other objects of an aligned category
(see `transfer`), and the axes that two of them name, the ends of an arrow to the front."""

import itertools
import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.named import BackboneLike, as_backbone
from zsp_lite.data.clouds import extent
from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.files import plain_name, write_atomic
from zsp_lite.io.ply import write_ply
from zsp_lite.metrics import vector_angle
from zsp_lite.points import object_pixels
from zsp_lite.scans.category import CategoryAlignment
from zsp_lite.scans.transfer import (
    FOUND,
    marked_point,
    object_size,
    spread_frames,
    surface_views,
    transfer,
)
from zsp_lite.scans.upright import find_up
from zsp_lite.views import object_crop

# All these lengths and angles are chosen, not fitted.
# A point is seen if the depth map is nearer by at most this part of the object's size.
_HIDDEN = 0.05
_SHORTEST = 0.1  # length of an arrow, in sizes of its object
_STEEPEST = 60.0  # degrees between an arrow and the floor
_RADIUS = 0.015  # of the ball that shows a mark in a point cloud, in sizes of the object
# Colours of marks in order (Okabe and Ito 2008), again from the first after the last.
COLOURS = ("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")


@dataclass(frozen=True)
class Mark:
    """A pixel of a frame."""

    sequence: str
    frame: int  # number of the frame
    x: float  # pixels from the left edge of the image; pixel centres are at half-integers
    y: float  # from the upper edge
    name: str

    @classmethod
    def parse(cls, text: str) -> "Mark":
        """Read "SEQUENCE:FRAME:X,Y" or "SEQUENCE:FRAME:X,Y:NAME"; ValueError for other text.

        Without a name, the text is the name.
        """
        sequence, frame, pixel, *names = text.split(":", 3)
        x, y = map(float, pixel.split(","))
        name = names[0] if names else text
        if not (name and name.isprintable()):
            raise ValueError("no printable name")
        return cls(sequence, int(frame), x, y, name)


@dataclass(frozen=True, eq=False)
class Place:
    """Where a mark is on one object."""

    world: Float[np.ndarray, "3"]  # in the world of the object
    confidence: float  # 1 on the object that is marked
    # the pixel (x, y) in each frame that sees the place, by the frame's number
    pixels: dict[int, tuple[float, float]]

    @property
    def found(self) -> bool:
        """Whether the object has such a place."""
        return self.confidence >= FOUND


@dataclass(frozen=True, eq=False)
class PlacedMark:
    """A mark with its places on all objects."""

    mark: Mark
    common: Float[np.ndarray, "3"]  # in the common frame of the category
    places: dict[str, Place]  # by the name of the object's sequence


def place_marks(
    alignment: CategoryAlignment,
    dataset: Co3D,
    category: str,
    marks: Sequence[Mark],
    backbone: BackboneLike = "zsp-tiny",
) -> list[PlacedMark]:
    """Find marks on all objects of an aligned category.

    Args:
        alignment: Poses of the objects in the common frame, of `align_category`.
        dataset: Data set.
        category: Name of the category.
        marks: Pixels of the objects' frames.
        backbone: Backbone, or what `load_backbone` takes.

    Raises:
        InputError: A mark is in no frame, not on the object or without depth, two marks have one
            name, or no frame of an object shows its surface.
    """
    worlds = np.stack(marked_points(dataset, category, marks, alignment.objects))
    surface = partial(surface_views, alignment, dataset, category, backbone=as_backbone(backbone))
    marked = np.array([mark.sequence for mark in marks])
    sources = {name: surface(name) for name in {mark.sequence for mark in marks}}
    places = {}  # by the name of the object, in the order of the marks
    for name, aligned in alignment.objects.items():
        target = sources.get(name) or surface(name)
        # On their own object, marks are where they are. Those of another object go together: its
        # patches are compared once.
        world = worlds.copy()
        confidence = np.ones(len(marks))
        for other in sources.keys() - {name}:
            moved = marked == other
            found = transfer(worlds[moved], sources[other], target)
            world[moved] = found.world
            confidence[moved] = found.confidence
        size = object_size(target) / aligned.sim3.scale  # in the object's world
        pixels = _pixels(dataset, category, name, world, _HIDDEN * size)
        places[name] = [Place(*place) for place in zip(world, confidence.tolist(), pixels)]

    return [
        PlacedMark(
            mark,
            alignment.objects[mark.sequence].sim3.apply(worlds[k]),
            {name: row[k] for name, row in places.items()},
        )
        for k, mark in enumerate(marks)
    ]


def marked_points(
    dataset: Co3D,
    category: str,
    marks: Sequence[Mark],
    sequences: Collection[str] | None = None,
) -> list[Float[np.ndarray, "3"]]:
    """Return the world point of each mark; see `place_marks` for what is refused.

    `sequences` are those that may be marked, by default all.
    """
    names = [mark.name for mark in marks]
    points = []
    for mark in marks:
        if sequences is not None:
            check_choice("sequence of the mark", mark.sequence, sequences)
        if names.count(mark.name) > 1:
            raise InputError(
                f"{names.count(mark.name)} marks are named {mark.name!r}, expected one"
            )
        frame = dataset.load(dataset.frame(category, mark.sequence, mark.frame))
        what = f"mark {mark.name!r}: pixel {mark.x:g},{mark.y:g} of frame {mark.frame}"
        points.append(marked_point(frame, mark.x, mark.y, what))
    return points


def read_front(dataset: Co3D, category: str, tail: Mark, tip: Mark) -> Float[np.ndarray, "3 3"]:
    """Return the directions front, left and up (rows) in the world of an object.

    Args:
        dataset: Data set.
        category: Name of the category.
        tail: Mark on the object, where an arrow to its front starts.
        tip: Mark on the same object, where the arrow ends. Its part normal to the vertical counts.

    Raises:
        InputError: A mark is refused (see `place_marks`), the arrow is short or steep, or nothing
            tells the vertical.
    """
    name = tail.sequence
    check_choice("sequence of the arrow's tip", tip.sequence, [name])
    start, end = marked_points(dataset, category, (tail, tip))
    # A crop shows the floor close around the object.
    crops = map(object_crop, spread_frames(dataset, category, name))
    up, problem = find_up([*crops])
    if up is None:
        raise InputError(
            f"arrow on {name}: {problem or 'no vertical'}, expected a scan with a floor around it"
        )
    arrow = end - start
    length = np.linalg.norm(arrow)
    box = extent(dataset, category, name)
    least = _SHORTEST * (box[1] if box else 0.0)  # any length without a point cloud
    tilt = abs(90 - vector_angle(arrow, up))
    if not length > least or tilt > _STEEPEST:
        raise InputError(
            f"the arrow on {name} is {length:.2g} long and {tilt:.0f} degrees from the floor, "
            f"expected at least {least:.2g}, a tenth of the object, and at most {_STEEPEST:.0f}"
        )
    left = np.cross(up, arrow)
    axes = np.stack([np.cross(left, up), left, up])
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def category_axes(alignment: CategoryAlignment, name: str, front: Float[np.ndarray, "3 3"]) -> Sim3:
    """Return the rigid transform from the common frame to axes whose x, y and z are the directions
    of `read_front` for one object, and whose origin is amid all objects."""
    objects = alignment.objects
    check_choice("aligned sequence with the arrow", name, objects)
    R = front @ objects[name].sim3.R.T
    centres = [one.sim3.apply(one.centre) for one in objects.values()]
    return Sim3(1.0, R, -R @ np.median(centres, axis=0))


def _pixels(
    dataset: Co3D,
    category: str,
    name: str,
    points: Float[np.ndarray, "n 3"],
    tolerance: float,
) -> list[dict[int, tuple[float, float]]]:
    """Return for each world point its pixel in each frame of an object that sees it.

    One frame at a time is in memory: real sequences have hundreds.
    """
    pixels = [{} for _ in points]
    for annotation in dataset.frames(category, name):
        if annotation.viewpoint is None or annotation.depth is None:
            continue
        frame = dataset.load(annotation)
        shown = object_pixels(frame)  # on the object, with measured depth
        height, width = frame.camera.size
        for seen, point in zip(pixels, points):
            (x, y), depth = frame.camera.project(point)
            if depth <= 0 or not (0 <= x < width and 0 <= y < height):
                continue
            row, column = int(y), int(x)
            if shown[row, column] and depth - frame.depth[row, column] <= tolerance:
                seen[annotation.frame_number] = (round(float(x), 2), round(float(y), 2))
    return pixels


def write_marks(
    placed: Sequence[PlacedMark], dataset: Co3D, category: str, out: str | Path
) -> Path:
    """Write OUT/marks.json, and for each object the places that are found as small balls of points
    in its world, OUT/marks/SEQUENCE.ply."""
    out = Path(out)
    document = []
    for one in placed:
        places = {
            name: {
                "world": place.world.round(6).tolist(),
                "confidence": round(place.confidence, 4),
                "found": place.found,
                "pixels": place.pixels,
            }
            for name, place in one.places.items()
        }
        mark = one.mark
        document.append(
            {
                "name": mark.name,
                "sequence": mark.sequence,
                "frame": mark.frame,
                "pixel": [mark.x, mark.y],
                "common": one.common.round(6).tolist(),
                "objects": places,
            }
        )
    # 400 points on its surface show a ball.
    directions = np.random.default_rng(0).normal(size=(400, 3))
    ball = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for name in placed[0].places:
        box = extent(dataset, category, name)
        radius = _RADIUS * (box[1] if box else 1.0)
        points = []
        colours = []
        for one, colour in zip(placed, itertools.cycle(COLOURS)):
            if one.places[name].found:
                points += [*one.places[name].world + radius * ball]
                colours += [list(bytes.fromhex(colour[1:]))] * len(ball)
        if points:
            path = out / "marks" / f"{plain_name(name, 'sequence')}.ply"
            write_ply(path, np.array(points), np.array(colours, np.uint8))
    write_atomic(out / "marks.json", json.dumps(document, indent=1).encode())
    return out / "marks.json"
