"""Places marked in frames of one object, and where they are on the other objects of an aligned
category (see `transfer`)."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsp_lite.backbones.load import BackboneLike, as_backbone
from zsp_lite.category import CategoryAlignment
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.files import plain_name, write_atomic
from zsp_lite.io.ply import write_ply
from zsp_lite.points import object_pixels
from zsp_lite.transfer import TransferredPoints, object_size, surface_views, transfer

# A point is seen if the depth map is nearer by at most this part of the object's size.
_HIDDEN = 0.05
_RADIUS = 0.015  # of the ball that shows a mark in a point cloud, in sizes of the object
_BALL_POINTS = 400
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
        return cls(sequence, int(frame), x, y, (names or [text])[0])


@dataclass(frozen=True, eq=False)
class Place:
    """Where a mark is on one object."""

    world: Float[np.ndarray, "3"]  # in the world of the object
    confidence: float  # 1 on the object that is marked
    found: bool
    # the pixel (x, y) in each frame that sees the place, by the frame's number
    pixels: dict[int, tuple[float, float]] = field(default_factory=dict)


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
    worlds = marked_points(dataset, category, marks)
    for mark in marks:
        check_choice("sequence of the mark", mark.sequence, alignment.objects)
    extractor = as_backbone(backbone)
    surfaces = {
        name: surface_views(alignment, dataset, category, name, extractor)
        for name in alignment.objects
    }
    frames = {
        name: {one.frame_number: dataset.load(one) for one in dataset.frames(category, name)}
        for name in alignment.objects
    }
    placed = []
    for mark, world in zip(marks, worlds, strict=True):
        places = {}
        for name, surface in surfaces.items():
            if name == mark.sequence:
                found = TransferredPoints(world[None], np.ones(1), np.zeros(1))
                confidence = 1.0
            else:
                found = transfer(world[None], surfaces[mark.sequence], surface)
                confidence = float(found.confidence[0])
            size = object_size(surface) / alignment.objects[name].sim3.scale  # in its world
            pixels = _pixels(found.world[0], frames[name], _HIDDEN * size)
            here = name == mark.sequence or bool(found.found[0])
            places[name] = Place(found.world[0], confidence, here, pixels)
        common = alignment.objects[mark.sequence].sim3.apply(world)
        placed.append(PlacedMark(mark, common, places))
    return placed


def marked_points(
    dataset: Co3D, category: str, marks: Sequence[Mark]
) -> list[Float[np.ndarray, "3"]]:
    """Return the world point of each mark; see `place_marks` for what is refused."""
    names = [mark.name for mark in marks]
    points = []
    for mark in marks:
        if names.count(mark.name) > 1:
            raise InputError(
                f"{names.count(mark.name)} marks are named {mark.name!r}, expected one"
            )
        frame = dataset.load(dataset.frame(category, mark.sequence, mark.frame))
        height, width = frame.camera.size
        what = f"mark {mark.name!r}: pixel {mark.x:g},{mark.y:g} of frame {mark.frame}"
        if not (0 <= mark.x < width and 0 <= mark.y < height):
            raise InputError(f"{what} is outside the image, expected one of {width} x {height}")
        row, column = int(mark.y), int(mark.x)
        if frame.depth is None or not frame.depth[row, column] > 0:
            raise InputError(f"{what} has no depth, expected a pixel with measured depth")
        if frame.mask is not None and not object_pixels(frame)[row, column]:
            raise InputError(f"{what} is not on the object, expected a pixel of its mask")
        points.append(frame.camera.unproject(np.array([mark.x, mark.y]), frame.depth[row, column]))
    return points


def _pixels(
    point: Float[np.ndarray, "3"], frames: dict[int, Frame], tolerance: float
) -> dict[int, tuple[float, float]]:
    """Return the pixel of a world point in each frame that sees it."""
    pixels = {}
    for number, frame in frames.items():
        (x, y), depth = frame.camera.project(point)
        height, width = frame.camera.size
        if depth <= 0 or not (0 <= x < width and 0 <= y < height) or frame.depth is None:
            continue
        measured = frame.depth[int(y), int(x)]
        if measured > 0 and depth - measured <= tolerance:
            pixels[number] = (round(float(x), 2), round(float(y), 2))
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
                "pixels": {str(number): pixel for number, pixel in place.pixels.items()},
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
    directions = np.random.default_rng(0).normal(size=(_BALL_POINTS, 3))
    ball = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for name in placed[0].places:
        extent = dataset.extent(category, name)
        radius = _RADIUS * (extent[1] if extent else 1.0)
        points = [np.zeros((0, 3))]
        colours = [np.zeros((0, 3), np.uint8)]
        for number, one in enumerate(placed):
            if one.places[name].found:
                colour = bytes.fromhex(COLOURS[number % len(COLOURS)][1:])
                points.append(one.places[name].world + radius * ball)
                colours.append(np.tile(np.frombuffer(colour, np.uint8), (_BALL_POINTS, 1)))
        path = out / "marks" / f"{plain_name(name, 'sequence')}.ply"
        write_ply(path, np.concatenate(points), np.concatenate(colours))
    write_atomic(out / "marks.json", json.dumps(document, indent=1).encode())
    return out / "marks.json"
