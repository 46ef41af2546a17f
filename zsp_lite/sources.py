"""Frames of what a user names: a sequence of a data folder, a folder with a capture, or an image with depth."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zsp_lite.data.annotations import FRAMES_FILE
from zsp_lite.data.cameras import Box
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, check_integer
from zsp_lite.importers.capture import CaptureFrame, camera_from_pose, image_size
from zsp_lite.importers.convert import READERS, capture_format
from zsp_lite.importers.geometry_masks import masks_from_depth
from zsp_lite.importers.masks import masks_from_box
from zsp_lite.views import frame_defect

MASK_CHOICES = ("given", "box", "auto")
_IMAGES = (".jpg", ".jpeg", ".png")
_CONTEXT = 8  # frames of a capture that are segmented together with the reference frame


@dataclass(frozen=True, eq=False)
class Source:
    """Frames of one object in one world, read when needed.

    Attributes:
        path: The sequence, the capture or the image.
        kind: "sequence", "capture" or "image".
        numbers: Number of each frame: that of the annotations, or its position in the capture.
        read: Reads the frame at a position of `numbers`, with the mask that comes with it, if any.
        mask: Where masks come from: "given" with the frames, "box" (GrabCut) or "auto" (depth).
        box: Bounding box of the object in the first frame, for "box".
    """

    path: Path
    kind: str
    numbers: tuple[int, ...]
    read: Callable[[int], Frame]
    mask: str
    box: Box | None = None

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def name(self) -> str:
        """Name of the sequence, the capture or the image; that of the folder itself where the path is "."."""
        return Path(os.path.abspath(self.path)).name

    def describe(self, positions: Sequence[int]) -> str:
        """Name the source and its frames at some positions."""
        if self.kind == "image":
            return f"image {self.path}"
        frames = ", ".join(str(self.numbers[position]) for position in positions)
        return f"{self.kind} {self.path}, frame{'s' if len(positions) > 1 else ''} {frames}"

    def load(self, positions: Sequence[int]) -> list[Frame]:
        """Load frames with masks of the object.

        Raises:
            InputError: There is no such position, a file cannot be read, or the object is not found.
        """
        for position in positions:
            check_integer(f"{self.path}: position of a frame", position, 0, len(self) - 1)
        if self.mask == "given":
            return [self._with_mask(position) for position in positions]
        if self.mask == "box":
            ordered = sorted({0, *positions})  # the box is that of the first frame
            masked = masks_from_box([self.read(position) for position in ordered], self.box)
        else:
            spread = np.linspace(0, len(self) - 1, min(_CONTEXT, len(self))).round().astype(int)
            ordered = sorted({*spread.tolist(), *positions})
            masked = masks_from_depth([self.read(position) for position in ordered])
        found = dict(zip(ordered, masked))
        return [found[position] for position in positions]

    def position(self, number: int) -> int:
        """Return the position of a frame number.

        Raises:
            InputError: There is no such frame.
        """
        if number not in self.numbers:
            low, high = min(self.numbers), max(self.numbers)
            raise InputError(f"{self.path} has no frame {number}, expected one of {len(self)} from {low} to {high}")
        return self.numbers.index(number)

    def spread(self, count: int) -> list[int]:
        """Return the positions of at most `count` evenly spaced frames."""
        check_integer("targets", count, 1)
        return sorted(set((np.arange(count) * len(self) // count).tolist()))

    def first_usable(self) -> tuple[int, Frame]:
        """Return the first frame with an object mask and known depth, among evenly spaced ones, and its position.

        Raises:
            InputError: There is none.
        """
        for position in self.spread(_CONTEXT):
            (frame,) = self.load([position])
            if not (defect := frame_defect(frame)):
                return position, frame
        raise InputError(f"{self.path}: no usable reference frame: {defect}")

    def _with_mask(self, position: int) -> Frame:
        frame = self.read(position)
        if frame.mask is None:
            raise InputError(
                f"{self.path}, frame {self.numbers[position]}: no mask, expected --mask auto or "
                "--box TOP,LEFT,HEIGHT,WIDTH"
            )
        return frame


def open_source(
    path: str | Path,
    intrinsics: tuple[float, float, float, float] | None = None,
    depth: str | Path | None = None,
    depth_unit: float | None = None,
    mask: str | None = None,
    box: Box | None = None,
) -> Source:
    """Open a sequence of a data folder, a folder with a capture, or an image.

    Args:
        path: ROOT/CATEGORY/SEQUENCE of a data folder; the folder of a capture in a format of `importers.READERS`; or a
            JPEG or PNG file NAME.EXT. Depth of an image is NAME_depth.png (16 bit) or NAME_depth.npy, and its mask, if
            there is one, NAME_mask.png.
        intrinsics: fx, fy, cx, cy in pixels, with pixel centres at integers as OpenCV states them; for an image, and
            for a capture of TUM's format.
        depth: Depth file of an image, if it is named otherwise.
        depth_unit: World units per stored depth value, for an image and for a capture of plain lists; 0.001 by default.
        mask: "given", "box" or "auto". By default "box" if there is a box, "given" if the first frame has a mask, and
            "auto" otherwise.
        box: Bounding box (top, left, height, width) of the object in the first frame, pixels.

    Raises:
        InputError: The path is none of these, a file cannot be read, or an option is missing or does not fit.
    """
    path = Path(path)
    if mask is not None and mask not in MASK_CHOICES:
        raise InputError(f"mask is {mask!r}, expected one of {', '.join(MASK_CHOICES)}")
    if mask == "box" and box is None:
        raise InputError(
            f"{path}: --mask box needs the bounding box of the object, expected --box TOP,LEFT,HEIGHT,WIDTH"
        )
    if box is not None and mask not in (None, "box"):
        raise InputError(f"{path}: --box goes with --mask box, got --mask {mask}")
    given = {"intrinsics": intrinsics, "depth": depth, "depth_unit": depth_unit}
    options = {name: value for name, value in given.items() if value is not None}
    kind = _format(path)
    for name in options:
        if name not in _TAKEN.get(kind, ()):
            raise InputError(f"--{name.replace('_', '-')} does not go with {_WHAT[kind]}")
    if kind == "sequence":
        numbers, read = _open_sequence(path)
    else:
        capture = [_open_image(path, **options)] if kind == "image" else READERS[kind](path, **options)
        numbers, read = tuple(range(len(capture))), lambda k: capture[k].load()
        kind = "image" if kind == "image" else "capture"
    if mask is None:
        mask = "box" if box is not None else "auto" if read(0).mask is None else "given"
    return Source(path, kind, numbers, read, mask, box)


def open_pair(reference: str | Path, target: str | Path, options: Mapping[str, Sequence]) -> tuple[Source, Source]:
    """Open two sources with the options of a command line.

    Args:
        reference: Path of the reference, see `open_source`.
        target: Path of the target.
        options: For each argument of `open_source` at most two values: the reference's and the target's. A single one
            is for each path that takes the option; a single box is the reference's.

    Raises:
        InputError: See `open_source`; or an option has too many values, or goes with neither path.
    """
    paths = Path(reference), Path(target)
    formats = [_format(path) for path in paths]
    given: list[dict] = [{}, {}]
    for name, values in options.items():
        takers = [side for side in (0, 1) if name in ("mask", "box") or name in _TAKEN.get(formats[side], ())]
        option = f"--{name.replace('_', '-')}"
        if values and not takers:
            raise InputError(f"{option} does not go with {_WHAT[formats[0]]} and {_WHAT[formats[1]]}")
        if len(values) > 2 or (name == "depth" and values and len(values) != len(takers)):
            expected = "one for each image" if name == "depth" else "at most two: the reference's and the target's"
            raise InputError(f"{option} is given {len(values)} times, expected {expected}")
        if len(values) == 2 and name != "depth":
            takers = [0, 1]
        elif name == "box":
            takers = [0]
        for side, value in zip(takers, values if len(values) == 2 else values * 2):
            given[side][name] = value
    return open_source(paths[0], **given[0]), open_source(paths[1], **given[1])


# Options that a source takes, and what it is, by the result of `_format`.
_TAKEN = {"image": ("intrinsics", "depth", "depth_unit"), "tum": ("intrinsics",), "lists": ("depth_unit",)}
_WHAT = {"image": "an image", "sequence": "a sequence of a data folder"} | {
    name: f"a capture of the format {name}" for name in READERS
}


def _format(path: Path) -> str:
    """Tell a "sequence" from an "image" and from a capture, of which the format is returned."""
    if path.is_file() and path.suffix.lower() in _IMAGES:
        return "image"
    if not path.is_dir():
        state = "is neither a folder nor a JPEG or PNG file" if path.exists() else "does not exist"
        raise InputError(f"{path} {state}, expected CATEGORY/SEQUENCE in a data folder, a capture or an image")
    whole = Path(os.path.abspath(path))  # for the names of "." and of "mine/cup/.."
    if (whole.parent / FRAMES_FILE).is_file():
        return "sequence"
    if (whole / FRAMES_FILE).is_file():
        known = ", ".join(sorted(one.sequence_name for one in Co3D(whole.parent).sequences(whole.name)))
        raise InputError(f"{path} is a category, expected one of its sequences: {known}")
    return capture_format(path)


def _open_sequence(path: Path) -> tuple[tuple[int, ...], Callable[[int], Frame]]:
    whole = Path(os.path.abspath(path))
    dataset = Co3D(whole.parent.parent)
    frames = dataset.frames(whole.parent.name, whole.name)
    frames = [one for one in frames if one.viewpoint is not None and one.depth is not None]
    if not frames:
        raise InputError(f"{path}: no frame has a camera and depth, expected some")
    return tuple(one.frame_number for one in frames), lambda k: dataset.load(frames[k])


def _open_image(
    path: Path,
    intrinsics: tuple[float, ...] | None = None,
    depth: str | Path | None = None,
    depth_unit: float = 0.001,
) -> CaptureFrame:
    if intrinsics is None:
        raise InputError(f"image {path}: no intrinsics, expected --intrinsics FX,FY,CX,CY in pixels")
    size = image_size(path)
    beside = [path.with_name(f"{path.stem}_depth{suffix}") for suffix in (".png", ".npy")]
    found = [Path(depth)] if depth is not None else [file for file in beside if file.is_file()]
    if not found:
        names = " or ".join(file.name for file in beside)
        raise InputError(f"image {path}: no {names} beside it, expected its depth there or as --depth FILE")
    fx, fy, cx, cy = intrinsics
    camera = camera_from_pose(np.eye(4), (fx, fy), (cx + 0.5, cy + 0.5), size, f"image {path}, --intrinsics")
    mask = path.with_name(f"{path.stem}_mask.png")
    return CaptureFrame(path, found[0], camera, 0.0, depth_unit, mask=mask if mask.is_file() else None)
