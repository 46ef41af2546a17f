"""Sources of frames of one object: sequences of data folders, captures, images with depth, and
frames in memory."""

import os
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from zsp_lite.data.annotations import FRAMES_FILE
from zsp_lite.data.cameras import Box, Camera, Values, camera_from_pose
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import ON_OBJECT, Frame, frame_defect
from zsp_lite.errors import InputError
from zsp_lite.importers import FORMATS, open_capture, recognise
from zsp_lite.importers.agreement import disagreement, neighbours
from zsp_lite.importers.capture import CaptureFrame
from zsp_lite.importers.files import (
    CO3D_DEPTH,
    DEPTHS,
    MASKS,
    PICTURES,
    question_intrinsics,
    read_picture,
)
from zsp_lite.importers.masks import (
    depth_flags,
    given_mask_flags,
    mask_flags,
    masks_from_box,
    masks_from_depth,
)

# Options that each format takes; "open" is a source that is open already.
_MASKED = ("mask", "box")
_FILES = ("label", "orientation", "depth_unit")  # values of `CaptureFrame`
_TAKEN = {
    "open": (),
    "image": (*_MASKED, *_FILES, "intrinsics", "depth"),
    "sequence": _MASKED,
    "frames": _MASKED,
    **{name: (*_MASKED, *_FILES, "masks", "count", *one.options) for name, one in FORMATS.items()},
}
_SWEEPS = 20  # over the chosen views, which mostly stay after ten
_CONTEXT = 8  # frames of a source that are segmented together, or tried as the reference


@dataclass(frozen=True, eq=False)
class Source:
    """Frames of one object in one world, read when needed."""

    path: Path  # the sequence, the capture or the image; a name for frames in memory
    format: str  # "sequence", "image", "frames", or the format of a capture
    # Number of each frame: that of the annotations, or its position in the capture
    numbers: tuple[int, ...]
    # Reads the frame at a position of `numbers`, with the mask that comes with it, if any
    read: Callable[[int], Frame]
    # where masks come from: "given" with the frames, "box" (GrabCut) or "auto" (depth and colours)
    mask: str
    box: Box | None = None  # bounding box of the object in the first frame, for "box"
    # Of the frames, where these are chosen by their directions, not by their order
    cameras: tuple[Camera, ...] = ()
    left_out: Sequence[str] = ()  # what is wrong with each frame that cannot be used
    # Positions and names of frames without a given mask
    missing: Mapping[int, str] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()  # what speaks against the intrinsics
    depth_unit: float | None = None  # world units per stored depth value, of an image or a capture

    @property
    def name(self) -> str:
        """Name of the sequence, the capture or the image; that of the folder itself where the path
        is "."."""
        return Path(os.path.abspath(self.path)).name

    def describe(self, positions: Sequence[int]) -> str:
        """Name the source and its frames at some positions."""
        if self.format == "image":
            return f"image {self.path}"
        kind = self.format if self.format in ("sequence", "frames") else "capture"
        frames = ", ".join(str(self.numbers[position]) for position in positions)
        return f"{kind} {self.path}, frame{'s' if len(positions) > 1 else ''} {frames}"

    def load(self, positions: Sequence[int], context: int = _CONTEXT) -> list[Frame]:
        """Load frames with masks of the object; those that have to be made use up to `context`
        frames together.

        InputError if a file cannot be read, or no frame shows the object.
        """
        others = {
            "given": [],
            "box": [0],
            "auto": np.linspace(0, len(self.numbers) - 1, context).round(),
        }[self.mask]
        frames = {
            position: self.read(position) for position in sorted({*positions, *map(int, others)})
        }
        some = list(frames.values())
        if self.mask != "given":
            try:
                masked = list(
                    masks_from_box(some, self.box) if self.box else masks_from_depth(some)
                )
            except InputError as error:
                raise InputError(
                    "; ".join(filter(None, (str(error), self.contradiction())))
                ) from error
            frames = dict(zip(frames, masked, strict=True))
        elif any(frame.mask is None for frame in some):
            made = replace(self, mask="auto").load(list(frames), context)
            frames = {
                k: one if frames[k].mask is None else frames[k]
                for k, one in zip(frames, made, strict=True)
            }
        return [frames[position] for position in positions]

    def segmented(self) -> "Source":
        """Make the masks of all frames that lack one; only their bits are kept, since all frames
        need much memory."""
        every = range(len(self.numbers))
        if self.box:
            found = zip(every, masks_from_box(map(self.read, every), self.box))
        else:
            found = self._by_depth(every if self.mask == "auto" else list(self.missing))
        bits = {position: np.packbits(frame.mask > ON_OBJECT) for position, frame in found}

        def read(position: int) -> Frame:
            frame = self.read(position)
            if position not in bits:
                return frame
            mask = np.unpackbits(bits[position], count=frame.depth.size).reshape(frame.depth.shape)
            return replace(frame, mask=mask.astype(np.float32))

        return replace(self, read=read)

    def _by_depth(self, positions: Sequence[int]) -> Iterator[tuple[int, Frame]]:
        """Segment frames by depth, in groups all around the object."""
        groups = -(-len(positions) // _CONTEXT)
        for first in range(groups):
            group = positions[first::groups]
            yield from zip(
                group, replace(self, mask="auto").load(group, _CONTEXT - len(group)), strict=True
            )

    def flags(self, frames: Sequence[Frame]) -> list[str]:
        """Question depth and poses of some frames, the intrinsics, and masks and depth of given
        frames."""
        metric = self.format not in ("sequence", "frames")
        found = (
            given_mask_flags(frames, self.missing.values())
            if self.mask == "given"
            else mask_flags(frames)
        )
        found = [*depth_flags(frames, metric), *self.doubts, *found, self.contradiction()]
        if self.left_out:
            more = f"; and {len(self.left_out) - 3} more" if len(self.left_out) > 3 else ""
            found.insert(
                0, f"frames left out: {len(self.left_out)}: {'; '.join(self.left_out[:3])}{more}"
            )
        return list(filter(None, found))

    def contradiction(self) -> str:
        """Say how depth and poses of a few frames contradict each other (see `disagreement`)."""
        return disagreement(self._some(), self.depth_unit)

    def _some(self) -> Iterator[Frame]:
        """Read a few frames once around the object, without masks that follow from the poses."""
        for position in neighbours(len(self.numbers)):
            with suppress(InputError):  # a damaged file that the estimate does not use
                frame = self.read(position)
                yield frame if self.mask == "given" else replace(frame, mask=None)

    def select(
        self, references: int, targets: int, first: int | None = None
    ) -> tuple[list[int], list[int], dict[int, Frame]]:
        """Load frames from all sides; return the positions of reference frames and of target views,
        and the frames.

        Frames with a defect are no references. The first reference frame is that with the number
        `first`.
        """
        if first not in (None, *self.numbers):
            known = f"{len(self.numbers)} from {min(self.numbers)} to {max(self.numbers)}"
            raise InputError(f"{self.path} has no frame {first}, expected one of {known}")
        start = 0 if first is None else self.numbers.index(first)
        tried = max(references, _CONTEXT) if references and first is None else references
        every = range(len(self.numbers))
        candidates = self._spread(tried, [*every[start:], *every[:start]])
        views = self._spread(targets, every)
        needed = list(dict.fromkeys([*candidates, *views]))
        frames = dict(zip(needed, self.load(needed), strict=True))
        defects = {position: frame_defect(frames[position]) for position in candidates}
        usable = [position for position in candidates if not defects[position]]
        if references and (not usable or first is not None and defects[start]):
            expected = "another --reference-frame, --mask or --box"
            raise InputError(
                f"{self.path}: no usable reference frame: {defects[start]}, expected {expected}"
            )
        return self._spread(references, usable), views, frames

    def _spread(self, count: int, positions: Sequence[int]) -> list[int]:
        """Choose at most `count` positions with the first, evenly by the directions of the cameras,
        or by the order."""
        if not self.cameras or count == 0:
            return [positions[k] for k in spread(count, len(positions))]
        cameras = [self.cameras[position] for position in positions]
        return [positions[k] for k in spread_views(cameras, count)]


# A path, frames, or what `open_source` returns
SourceLike = str | Path | Frame | Sequence[Frame] | Source


def open_source(
    path: str | Path | Frame | Sequence[Frame],
    intrinsics: Values | None = None,
    depth: str | Path | None = None,
    depth_unit: float | None = None,
    mask: str | None = None,
    box: Box | None = None,
    label: int | None = None,
    orientation: str | None = None,
    object: int | None = None,
    masks: Path | None = None,
    count: int | None = None,
    layout: str | None = None,
) -> Source:
    """Open a sequence of a data folder, a folder with a capture, an image, or frames of one object
    in one world.

    Args:
        path: ROOT/CATEGORY/SEQUENCE of a data folder; the folder or zip of a capture (see
            `importers.recognise`); or a JPEG, PNG or WebP file NAME.EXT. Depth of an image is
            NAME_depth.png (16 bit), .npy, .tiff, ..., registered to its colours, and its mask, if
            there is one, NAME_mask.png. Or frames, such as of `Frame.from_arrays`.
        intrinsics: fx, fy, cx, cy of an image or of TUM RGB-D in pixels, or K as 3 x 3, with pixel
            centres at half-integers (0.5 more than OpenCV's cx and cy).
        depth: Depth file of an image, if it is named otherwise.
        depth_unit: World units per stored depth value; by default the format's own, and 0.001 of an
            image.
        mask: "given", "box" or "auto". By default "box" if there is a box, "given" if some frame
            has a mask, and "auto" otherwise.
        box: Bounding box (top, left, height, width) of the object in the first frame, pixels.
        label: Number of the object in masks that label several.
        orientation: "stored" or "displayed": how depth, mask and intrinsics refer to an image that
            its EXIF orientation turns, where their sizes do not tell. Frames are as displayed.
        object: Number of the object in a scene of BOP.
        masks: Folder of a capture's masks, named like its images, in place of its own.
        count: Number of sharp frames of a capture to choose; by default 100.
        layout: Format of a capture, a name in `importers.FORMATS`, if it is not to be recognised.

    Raises:
        InputError: The path is none of these, a file cannot be read, or an option is missing or
            does not fit.
    """
    options = {
        "intrinsics": intrinsics,
        "depth": depth,
        "depth_unit": depth_unit,
        "object": object,
        "masks": masks,
        "count": count,
        "label": label,
        "orientation": orientation,
    }
    options = {name: value for name, value in options.items() if value is not None}
    layout, unit = layout or _format(path), None

    # Refuse options that do not fit the format, or each other.
    if layout == "frames":
        frames = _check_frames([path] if isinstance(path, Frame) else path)
        path = frames[0].name or f"{len(frames)} frames"
    path = Path(path)
    if masks is not None and not Path(masks).is_dir():
        raise InputError(
            f"--masks {masks} is no folder, expected one with masks that are named like the images"
        )
    for name in options:
        if name not in _TAKEN[layout]:
            option = {"count": "frames"}.get(name, name.replace("_", "-"))
            raise InputError(f"--{option} does not go with {path}, of the format {layout}")
    ways = ("given", "auto") if box is None else ("box",)
    if mask not in (None, *ways):
        expected = "--mask given, --mask auto, or --mask box with --box TOP,LEFT,HEIGHT,WIDTH"
        raise InputError(f"{path}: mask is {mask!r} and box is {box}, expected {expected}")

    # Each format gives the numbers of its frames, a function that reads one, and which have a mask.
    cameras, left_out, doubts = (), (), ()
    if layout == "frames":
        read, masked = frames.__getitem__, [frame.mask is not None for frame in frames]
        names = numbers = range(len(frames))
        doubts = question_intrinsics(frames[0].camera, str(path))
    elif layout == "sequence":
        folder = _sequence_folder(path)
        dataset = Co3D(folder.parents[1])
        every = dataset.frames(folder.parent.name, folder.name)
        frames = [one for one in every if one.viewpoint is not None and one.depth is not None]
        if not frames:
            raise InputError(f"{path}: no frame has a camera and depth, expected some")
        read, masked = (lambda k: dataset.load(frames[k])), [one.mask is not None for one in frames]
        names = numbers = [one.frame_number for one in frames]
    else:
        files = {name: options.pop(name) for name in _FILES if name in options}
        if layout == "image":
            capture = [replace(_open_image(path, **options), **files)]
        else:
            capture, left_out = open_capture(path, layout, files=files, **options)
        _check_poses([frame.camera for frame in capture], path)
        read, masked = (lambda k: capture[k].load()), [frame.mask is not None for frame in capture]
        names, numbers = [frame.image.name for frame in capture], range(len(capture))
        cameras, unit = tuple(frame.camera for frame in capture), capture[0].depth_unit
        different = {camera.K.tobytes(): camera for camera in reversed(cameras)}.values()
        doubts = tuple(line for one in different for line in question_intrinsics(one, str(path)))
    if mask is None and box is not None:
        mask = "box"
    elif mask is None:
        mask = "given" if any(masked) else "auto"
    if mask == "given" and not any(masked):
        raise InputError(
            f"{path}: no mask, expected masks named like the images, --mask auto or --box "
            "TOP,LEFT,HEIGHT,WIDTH"
        )

    missing = {k: str(name) for k, name in enumerate(names) if not masked[k]}
    return Source(
        path, layout, tuple(numbers), read, mask, box, cameras, left_out, missing, doubts, unit
    )


def open_pair(
    reference: SourceLike,
    target: SourceLike,
    options: Mapping[str, Sequence],
    helpers: Sequence[SourceLike] = (),
) -> list[Source]:
    """Open two sources and helpers with the options of a command line, by the names of arguments of
    `open_source`.

    An option has one value for each path that takes it (`depth`: each image), or one for all of
    them. There may be fewer values, for the reference and the target alone. A single `box` is for
    the first path whose `mask` is "box", if any, or the first of all. An open source takes none.
    """
    sides = reference, target, *helpers
    formats = [_format(side) for side in sides]
    given: list[dict] = [{} for _ in sides]
    for name, values in options.items():
        takers = [k for k, one in enumerate(formats) if name in _TAKEN[one]]
        counts = {len(takers), sum(k < 2 for k in takers)}
        if takers and name != "depth":  # each image has its own depth
            counts.add(1)
        if values and len(values) not in counts:
            option, expected = f"--{name.replace('_', '-')}", " or ".join(map(str, sorted(counts)))
            raise InputError(
                f"{option}: {len(values)} values with {' and '.join(formats)}, expected {expected}"
            )
        if len(values) == 1 and name == "box":
            boxed = [
                k for k, way in enumerate(options.get("mask", ())) if way == "box" and k in takers
            ]
            takers = (boxed or takers)[:1]
        if len(values) == 1 and name != "depth":
            values = [*values] * len(takers)
        for k, value in zip(takers, values):
            given[k][name] = value
    return [
        side if isinstance(side, Source) else open_source(side, **some)
        for side, some in zip(sides, given)
    ]


def _check_frames(frames: Sequence[Frame]) -> list[Frame]:
    """Refuse what cannot be frames of one object in one world."""
    if not frames or not all(isinstance(frame, Frame) for frame in frames):
        raise InputError(
            f"frames are {reprlib.repr(frames)}, expected a sequence of zsp_lite.Frame"
        )
    for number, frame in enumerate(frames):
        if frame.depth is None:
            raise InputError(f"frame {number} {frame.name} has no depth map, expected one")
    _check_poses([frame.camera for frame in frames], "in memory")
    return list(frames)


def _check_poses(cameras: Sequence[Camera], where: str | Path) -> None:
    """Refuse several frames with one pose, as those of a program without tracking."""
    if len({camera.matrix.tobytes() for camera in cameras}) == 1 < len(cameras):
        raise InputError(
            f"{where}: all {len(cameras)} frames have one camera pose, expected their poses "
            "in one world"
        )


def _format(side: SourceLike) -> str:
    """Tell a "sequence" from an "image", from "frames", and from a capture, of which the format is
    returned."""
    if not isinstance(side, str | Path):
        return "open" if isinstance(side, Source) else "frames"
    path = Path(side)
    if path.is_file() and path.suffix.lower() in PICTURES:
        return "image"
    if _sequence_folder(path):
        return "sequence"
    return recognise(
        path, "a picture (.jpg, .png, .webp), CATEGORY/SEQUENCE of a data folder, or "
    )[0]


def _sequence_folder(path: Path) -> Path | None:
    """Return the folder of a sequence in its data folder, also where the path is a link to it; None
    if it is none."""
    # Both are absolute, so that "." and "mine/cup/.." have names.
    folders = (Path(os.path.abspath(path)), path.resolve())
    return next(
        (one for one in folders if one.is_dir() and (one.parent / FRAMES_FILE).is_file()), None
    )


def _open_image(
    path: Path, intrinsics: Values | None = None, depth: str | Path | None = None
) -> CaptureFrame:
    """Name the files and the camera of an image, whose world is its camera's frame."""
    if intrinsics is None:
        raise InputError(
            f"image {path}: no intrinsics, expected --intrinsics FX,FY,CX,CY in pixels"
        )
    depth = _beside(path, "depth", DEPTHS) if depth is None else Path(depth)
    if depth is None:
        names = f"{path.stem}_depth.png or {path.stem}_depth.npy"
        raise InputError(
            f"image {path}: no {names} beside it, expected its depth there or as --depth FILE"
        )
    depth_unit = 1.0 if depth.name.endswith(CO3D_DEPTH) else 0.001
    rgb, orientation = read_picture(path)
    camera = camera_from_pose(np.eye(4), intrinsics, rgb.shape[:2], f"image {path}")
    stored = np.linalg.norm(2 * camera.principal_point - camera.size[::-1])
    displayed = np.linalg.norm(2 * camera.principal_point - camera.size)
    # The principal point is nearer to the middle of the displayed form
    if orientation > 4 and displayed < stored:
        camera = replace(camera, size=camera.size[::-1])
    return CaptureFrame(
        path, depth, camera, depth_unit, mask=_beside(path, "mask", MASKS), posed=False
    )


def _beside(path: Path, kind: str, suffixes: Sequence[str]) -> Path | None:
    """Find the file of a kind, such as NAME_depth.png, beside an image."""
    files = [path.with_name(f"{path.stem}_{kind}{suffix}") for suffix in suffixes]
    return next((file for file in files if file.is_file()), None)


def spread(count: int, length: int) -> list[int]:
    """Return at most `count` evenly spaced positions among `length`, which go once around an
    object."""
    return sorted({k * length // count for k in range(count)})


def spread_views(cameras: Sequence[Camera], count: int) -> list[int]:
    """Return the positions of at most `count` cameras, spread evenly over the directions from which
    they see an object.

    They are the first camera and others that lie as charges which repel each other.
    """
    if len(cameras) <= count:
        return list(range(len(cameras)))
    centres = np.stack([one.centre for one in cameras])
    axes = np.stack([one.R[2] for one in cameras])
    # The object is at the point that is nearest to all optical axes.
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    point = np.linalg.lstsq(
        across.sum(axis=0), np.einsum("nij,nj->i", across, centres), rcond=None
    )[0]
    directions = centres - point
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-9)
    # Sorted, so that the choice is the same for every order of the other cameras.
    order = [0, *(1 + np.lexsort(directions[1:].T.round(6)))]
    gaps = directions[order][:, None] - directions[order]
    energy = 1 / (np.sum(gaps**2, axis=-1) + 1e-9)
    np.fill_diagonal(energy, np.inf)  # no camera is chosen twice
    chosen = [0]
    for _ in range(_SWEEPS):
        for k in range(1, count):  # in the first sweep, they are added
            others = chosen[:k] + chosen[k + 1 :]
            chosen[k : k + 1] = [int(energy[others].sum(axis=0).argmin())]
    return sorted(int(order[k]) for k in chosen)
