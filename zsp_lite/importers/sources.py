"""Sources of frames of one object: sequences of data folders, captures, images, and frames."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from zsp_lite.data.arrays import camera_from_pose
from zsp_lite.data.cameras import Box, Camera, Values
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.evaluation import spread
from zsp_lite.data.frames import ON_OBJECT, Frame, frame_defect, list_frames
from zsp_lite.errors import Doubt, InputError, check_choice
from zsp_lite.importers import FORMATS, open_capture, recognise
from zsp_lite.importers.agreement import disagreement, neighbours
from zsp_lite.importers.capture import CaptureFrame, first_three
from zsp_lite.importers.files import (
    CO3D_DEPTH,
    DEPTHS,
    MASKS,
    question_intrinsics,
    read_picture,
)
from zsp_lite.importers.masks import (
    axes_equation,
    depth_flags,
    given_mask_flags,
    mask_flags,
    masks_from_box,
    masks_from_depth,
)
from zsp_lite.importers.registration import misregistration
from zsp_lite.points import near_median, object_points

# The options that each format takes. "open" stands for a source that is open already.
_MASKED = ("mask", "box", "up")
_ATTRIBUTES = ("label", "orientation", "depth_unit")  # attributes of `CaptureFrame`
_CAPTURE = (*_MASKED, *_ATTRIBUTES, "masks", "count")
_TAKEN = {
    "open": (),
    "image": (*_MASKED, *_ATTRIBUTES, "intrinsics", "depth"),
    "sequence": _MASKED,
    "frames": _MASKED,
    **{name: (*_CAPTURE, *layout.options) for name, layout in FORMATS.items()},
}
_SWEEPS = 20  # number of sweeps over the chosen views: most views move no more after ten
# So many frames of a source are segmented together, or tried as the reference.
_CONTEXT = 8


@dataclass(frozen=True, eq=False)
class Source:
    """Frames of one object in one world, read when needed."""

    path: Path  # the sequence, the capture or the image; a name for frames in memory
    format: str  # "sequence", "image", "frames", or the format of a capture
    # Number of each frame: that in the annotations, that of a capture (see `CaptureFrame`), or the
    # position.
    numbers: tuple[int, ...]
    # Reads the frame at a position of `numbers`, with the mask that comes with it, if any.
    read_frame: Callable[[int], Frame]
    # Where masks come from: "given" with the frames, "box" (GrabCut) or "auto" (depth and colours).
    mask: str = "given"
    box: Box | None = None  # bounding box of the object in the first frame, for "box"
    # Camera of each frame, if frames are to be chosen by directions; () if by their order.
    cameras: tuple[Camera, ...] = ()
    left_out: Sequence[str] = ()  # for each frame that cannot be used, what is wrong with it
    # Names of the frames that come without a mask, by position.
    missing: Mapping[int, str] = field(default_factory=dict)
    # Reasons to doubt the intrinsics, the poses or the order of the images; "" is none.
    doubts: Sequence[str] = ()
    depth_unit: float | None = None  # world units per stored depth value, of an image or a capture
    # Direction up in the world, zeros if it is not to be used; "floor" if `upright` is to find it.
    up: Values | Literal["floor"] = "floor"

    @property
    def name(self) -> str:
        """Name of the sequence, the capture or the image, also where the path is "."."""
        path = Path(os.path.abspath(self.path))
        # An inner folder of Polycam's has the same name in all scans.
        return path.parent.name if path.name == "keyframes" else path.name

    def describe(self, positions: Sequence[int], frames: Mapping[int, Frame]) -> str:
        """Name the source and its frames at some positions, and the object's `size` in them."""
        size = self.size(frames[position] for position in positions)
        if self.format == "image":
            return f"image {self.path}{size}"
        shown = ", ".join(str(self.numbers[position]) for position in positions)
        return f"{self.format} {self.path}, frame{'s' if len(positions) > 1 else ''} {shown}{size}"

    def size(self, frames: Iterable[Frame]) -> str:
        """Say how wide and how far away the object is in the first of the frames that shows it.

        Nothing but a ruler can check the unit and the intrinsics of a single image.
        """
        unit = "" if self.format == "sequence" else " m"  # sequences have their own unit
        for frame in frames:
            points = object_points(frame)
            if len(points):
                # Single points may be off the object.
                low, middle, high = np.percentile(points[near_median(points)], [1, 50, 99], axis=0)
                return (
                    f"; by depth and intrinsics, the object in {frame.name or 'a frame'} "
                    f"is {(high - low)[0]:.3g}{unit} wide and {middle[2]:.3g}{unit} away"
                )
        return ""

    def load(self, positions: Sequence[int], context: int = _CONTEXT) -> list[Frame]:
        """Load frames with masks of the object.

        Masks by depth are made with up to `context` more frames from all around the object.
        InputError if a file cannot be read, or no frame shows the object.
        """
        # Positions of the frames, and of those from which their masks are made.
        needed = set(positions)
        missing = needed & self.missing.keys() if self.mask == "given" else needed
        if self.mask == "box":
            needed = needed | {0}
        elif missing:
            every = np.linspace(0, len(self.numbers) - 1, context).round()
            needed = needed.union(map(int, every))
        frames = {position: self.read_frame(position) for position in sorted(needed)}

        # Make all masks, or those that are missing.
        if missing:
            loaded = list(frames.values())
            try:
                made = masks_from_box(loaded, self.box) if self.box else masks_from_depth(loaded)
            except InputError as error:
                reasons = (str(error), self.contradiction())
                raise InputError("; ".join(filter(None, reasons))) from error
            frames |= {k: frame for k, frame in zip(frames, made) if k in missing}
        return [frames[position] for position in positions]

    def segmented(self) -> "Source":
        """Return the source with masks for all frames that lack one."""
        every = range(len(self.numbers))
        if self.box:
            masked = zip(every, masks_from_box(map(self.read_frame, every), self.box))
        else:
            masked = self._by_depth(every if self.mask == "auto" else list(self.missing))
        # Only the bits of the masks stay in memory: the frames would need too much.
        bits = {position: np.packbits(frame.mask > ON_OBJECT) for position, frame in masked}

        def read_masked(position: int) -> Frame:
            """Read a frame with its mask."""
            frame = self.read_frame(position)
            if position not in bits:
                return frame
            mask = np.unpackbits(bits[position], count=frame.depth.size).reshape(frame.depth.shape)
            return replace(frame, mask=mask.astype(np.float32))

        return replace(self, read_frame=read_masked)

    def _by_depth(self, positions: Sequence[int]) -> Iterator[tuple[int, Frame]]:
        """Segment frames by depth, in groups of frames from all around the object."""
        groups = -(-len(positions) // _CONTEXT)  # rounded up
        for first in range(groups):
            group = positions[first::groups]
            # A small group is completed by other frames.
            masked = replace(self, mask="auto").load(group, _CONTEXT - len(group))
            yield from zip(group, masked)

    def flags(self, frames: Sequence[Frame]) -> list[str]:
        """List doubts about the masks and depth of frames, and the intrinsics and poses of all."""
        flags = []
        if self.left_out:
            flags.append(f"frames left out: {len(self.left_out)}: {first_three(self.left_out)}")
        flags += depth_flags(frames, metric=self.format != "sequence")
        flags += map(Doubt, self.doubts)
        if self.mask == "given":
            flags += given_mask_flags(frames, self.missing.values())
            flags.append(misregistration(frames))
        else:
            flags += mask_flags(frames)
        flags.append(self.contradiction())
        return list(filter(None, flags))

    def contradiction(self) -> str:
        """Say how depth and poses of a few frames contradict each other (see `disagreement`)."""
        return disagreement(self._few_frames(), self.depth_unit)

    def _few_frames(self) -> Iterator[Frame]:
        """Read a few frames around the object, with their given masks only."""
        for position in neighbours(len(self.numbers)):
            # A damaged file is no reason to fail here: the estimate may not use it.
            with suppress(InputError):
                frame = self.read_frame(position)
                yield frame if self.mask == "given" else replace(frame, mask=None)

    def select(
        self, count: int, references: bool, first: int | None = None
    ) -> tuple[list[int], dict[int, Frame]]:
        """Load at most `count` frames from all sides, from the one with the number `first` on.

        Returns the positions of those without a defect, of which there is one if `references` are
        wanted, and the frames by position.
        """
        start = 0
        if first is not None:
            check_choice(f"{self.path}: frame", first, self.numbers)
            start = self.numbers.index(first)
        # By the directions of the cameras, or by the order.
        every = [*range(len(self.numbers))]
        every = every[start:] + every[:start]
        chosen = spread(count, len(every))
        if self.cameras and count:
            chosen = spread_views([self.cameras[position] for position in every], count)
        chosen = [every[k] for k in chosen]
        frames = dict(zip(chosen, self.load(chosen)))
        defects = {position: frame_defect(frame) for position, frame in frames.items()}
        usable = [position for position in chosen if not defects[position]]
        # A reference that the user names must have no defect.
        if references and (not usable or first is not None and defects[start]):
            raise InputError(
                f"{self.path}: no usable reference frame: {defects[start]}, expected another "
                "--reference-frame, --mask or --box"
            )
        return usable, frames


# A path, frames, or what `open_source` returns.
SourceLike = str | Path | Frame | Iterable[Frame] | Source


def list_sources(given: SourceLike | Iterable[SourceLike]) -> list[SourceLike]:
    """List several sources; a path or a frame is a single one."""
    single = isinstance(given, str | Path | Frame | Source)
    return [given] if single else list(given)


def open_source(
    path: SourceLike,
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
    up: Values | Literal["floor"] | None = None,
    recognised: tuple[str, Any] | None = None,
) -> Source:
    """Open a sequence, a capture, an image, or frames of one object in one world.

    Args:
        path: ROOT/CATEGORY/SEQUENCE of a data folder; the folder or zip of a capture (see
            `importers.recognise`); or a JPEG, PNG or WebP file NAME.EXT. Depth of an image is
            NAME_depth.png (16 bit), .npy, .tiff, ..., registered to its colours, and its mask, if
            there is one, NAME_mask.png. Or frames, such as of `Frame.from_arrays`: one, or any
            iterable of several. An open source is returned as it is.
        intrinsics: fx, fy, cx, cy of an image, a recording or TUM RGB-D in pixels, or K as 3 x 3,
            with pixel centres at half-integers (0.5 more than OpenCV's cx and cy).
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
        up: Direction up in the object's world, or zeros if it is not to be used. By default that of
            the format, or "floor": the floor or table around the object tells it (see `upright`).
        recognised: What `recognise` returns for the path, if it is known.

    Raises:
        InputError: The path is none of these, a file cannot be read, or an option is missing or
            does not fit.
    """
    if isinstance(path, Source):
        return path
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
    layout, place = recognised or recognise(path)

    # Refuse options that do not fit the format, or each other.
    if layout == "frames":
        frames = list_frames(path)
        path = frames[0].name or f"{len(frames)} frames"
    path = Path(path)
    for name in options:
        if name not in _TAKEN[layout]:
            # The command line's name of the argument.
            option = {"count": "frames"}.get(name, name.replace("_", "-"))
            raise InputError(f"--{option} does not go with {path}, of the format {layout}")
    ways = ("given", "auto") if box is None else ("box",)
    if mask not in (None, *ways):
        raise InputError(
            f"{path}: mask is {mask!r} and box is {box}, expected --mask given, --mask auto, or "
            "--mask box with --box TOP,LEFT,HEIGHT,WIDTH"
        )

    # The frames with the masks that come with them.
    if layout == "frames":
        source = _from_frames(frames, path)
    elif layout == "sequence":
        source = _from_sequence(path, place)
    else:
        source = _from_capture(path, layout, place, options)

    # Where masks come from.
    some_masked = len(source.missing) < len(source.numbers)
    by_default = "given" if some_masked else "auto"
    mask = mask or ("box" if box else by_default)
    if mask == "given" and not some_masked:
        raise InputError(
            f"{path}: no mask, expected masks named like the images, --mask auto or --box "
            "TOP,LEFT,HEIGHT,WIDTH"
        )
    if up is None:
        up = FORMATS[layout].up if layout in FORMATS else "floor"
    return replace(source, mask=mask, box=box, up=up)


def _from_frames(frames: Sequence[Frame], path: Path) -> Source:
    """Make the source of frames in memory; InputError if they cannot be of one object in one
    world."""
    left_out = []
    used = {}  # by number
    for number, frame in enumerate(frames):
        if frame.defect or frame.depth is None:
            left_out.append(f"frame {number}: {frame_defect(frame)}")
        else:
            used[number] = frame
    if not used:
        raise InputError(f"no frame can be used: {first_three(left_out)}")
    _check_poses([frame.camera for frame in used.values()], "in memory")
    return Source(
        path,
        "frames",
        tuple(used),
        list(used.values()).__getitem__,
        left_out=left_out,
        missing={k: str(number) for k, number in enumerate(used) if used[number].mask is None},
        doubts=[question_intrinsics(frames[0].camera, str(path))],
    )


def _from_sequence(path: Path, folder: Path) -> Source:
    """Make the source of a sequence of a data folder: its frames with camera and depth."""
    dataset = Co3D(folder.parents[1])
    frames = [
        frame
        for frame in dataset.frames(folder.parent.name, folder.name)
        if frame.viewpoint is not None and frame.depth is not None
    ]
    if not frames:
        raise InputError(f"{path}: no frame has a camera and depth, expected some")
    return Source(
        path,
        "sequence",
        tuple(frame.frame_number for frame in frames),
        lambda k: dataset.load(frames[k]),
        missing={
            k: str(frame.frame_number) for k, frame in enumerate(frames) if frame.mask is None
        },
    )


def _from_capture(path: Path, layout: str, place: Path, options: dict[str, Any]) -> Source:
    """Make the source of a capture, whose reader takes `place`, or of an image."""
    left_out = ()
    attributes = {name: options.pop(name) for name in _ATTRIBUTES if name in options}
    if layout == "image":
        frames = [replace(_open_image(path, **options), **attributes)]
    else:
        frames, left_out = open_capture(place, layout, attributes=attributes, **options)
    cameras = tuple(frame.camera for frame in frames)
    _check_poses(cameras, path)
    # Intrinsics may differ from frame to frame: a doubt about them is said once.
    questioned = [question_intrinsics(camera, str(path)) for camera in cameras]
    doubts = [next(filter(None, questioned), ""), *{frame.doubt for frame in frames}]
    return Source(
        path,
        layout,
        tuple(frame.number for frame in frames),
        lambda k: frames[k].load(),
        cameras=cameras,
        left_out=left_out,
        missing={k: frame.image.name for k, frame in enumerate(frames) if frame.mask is None},
        doubts=doubts,
        depth_unit=frames[0].depth_unit,
    )


def open_pair(
    reference: SourceLike,
    target: SourceLike,
    options: Mapping[str, Sequence],
    helpers: Iterable[SourceLike] = (),
) -> list[Source]:
    """Open two sources and helpers with the options of a command line.

    Options have the names of arguments of `open_source`. Each has one value for each path that
    takes it (`depth`: each image), or one for all of them. There may be fewer values, for the
    reference and the target alone. A single `box` is for the first path whose `mask` is "box", if
    any, or the first of all. An open source takes none. InputError if helpers are there and two
    paths are of one object.
    """
    sides = (reference, target, *helpers)
    recognised = [("open", side) if isinstance(side, Source) else recognise(side) for side in sides]
    formats = [layout for layout, _ in recognised]
    options_of_side: list[dict] = [{"recognised": found} for found in recognised]
    for name, values in options.items():
        takers = [k for k, layout in enumerate(formats) if name in _TAKEN[layout]]
        # There is a value for each path that takes the option, or only for those of the reference
        # and the target, which are the first two paths.
        counts = {len(takers), sum(k < 2 for k in takers)}
        if takers and name != "depth":  # each image has its own depth
            counts.add(1)
        if values and len(values) not in counts:
            raise InputError(
                f"--{name.replace('_', '-')}: {len(values)} values with {' and '.join(formats)}, "
                f"expected {' or '.join(map(str, sorted(counts)))}"
            )
        if len(values) == 1 and name == "box":
            boxed = [
                k for k, way in enumerate(options.get("mask", ())) if way == "box" and k in takers
            ]
            takers = (boxed or takers)[:1]
        if len(values) == 1 and name != "depth":
            values = [*values] * len(takers)
        for k, value in zip(takers, values):
            options_of_side[k][name] = value
    sources = [open_source(side, **own) for side, own in zip(sides, options_of_side)]
    # The names of frames in memory may be equal.
    paths = [source.path.resolve() for source in sources if source.format != "frames"]
    if len(sides) > 2 and len(set(paths)) < len(paths):
        named = ", ".join(str(source.path) for source in sources)
        raise InputError(f"{named}: expected different objects")
    return sources


def _check_poses(cameras: Sequence[Camera], where: str | Path) -> None:
    """Raise InputError if several frames have one pose, as from a program without tracking."""
    if len({camera.matrix.tobytes() for camera in cameras}) == 1 < len(cameras):
        raise InputError(
            f"{where}: all {len(cameras)} frames have one camera pose, expected their poses "
            "in one world"
        )


def _open_image(
    path: Path, intrinsics: Values | None = None, depth: str | Path | None = None
) -> CaptureFrame:
    """Return the files and the camera of an image, whose world is its camera's frame."""
    if intrinsics is None:
        raise InputError(
            f"image {path}: no intrinsics, expected --intrinsics FX,FY,CX,CY in pixels"
        )
    depth = _beside(path, "depth", DEPTHS) if depth is None else Path(depth)
    if depth is None:
        raise InputError(
            f"image {path}: no {path.stem}_depth.png or {path.stem}_depth.npy beside it, expected "
            "its depth there or as --depth FILE"
        )
    depth_unit = 1.0 if depth.name.endswith(CO3D_DEPTH) else 0.001
    rgb, orientation = read_picture(path)
    camera = camera_from_pose(np.eye(4), intrinsics, rgb.shape[:2], f"image {path}")
    # If the orientation exchanges the sides, the intrinsics are for the form, stored or displayed,
    # whose middle is nearer to the principal point.
    stored = np.linalg.norm(2 * camera.principal_point - camera.size[::-1])
    displayed = np.linalg.norm(2 * camera.principal_point - camera.size)
    if orientation > 4 and displayed < stored:
        camera = replace(camera, size=camera.size[::-1])
    return CaptureFrame(
        path, depth, camera, depth_unit, mask=_beside(path, "mask", MASKS), posed=False
    )


def _beside(path: Path, kind: str, suffixes: Sequence[str]) -> Path | None:
    """Find the file of a kind, such as NAME_depth.png, beside an image."""
    files = [path.with_name(f"{path.stem}_{kind}{suffix}") for suffix in suffixes]
    return next((file for file in files if file.is_file()), None)


def spread_views(cameras: Sequence[Camera], count: int) -> list[int]:
    """Return positions of at most `count` cameras with evenly spread directions to an object.

    The first camera is chosen, and others that spread like charges which repel each other.
    """
    if len(cameras) <= count:
        return list(range(len(cameras)))
    # The object is at the point that is nearest to all optical axes.
    matrix, right_side = axes_equation(cameras)
    point = np.linalg.lstsq(matrix, right_side, rcond=None)[0]
    directions = np.stack([camera.centre for camera in cameras]) - point
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-9)
    # Sorted, so that the choice is the same for every order of the other cameras.
    order = [0, *(1 + np.lexsort(directions[1:].T.round(6)))]
    # The energy of each pair of charges, (n, n).
    gaps = directions[order][:, None] - directions[order]
    energy = 1 / (np.sum(gaps**2, axis=-1) + 1e-9)
    np.fill_diagonal(energy, np.inf)  # no camera is chosen twice
    # Each chosen camera but the first moves in turn to where its energy with the others is least.
    chosen = [0]
    for _ in range(_SWEEPS):
        for k in range(1, count):
            others = chosen[:k] + chosen[k + 1 :]
            # In the first sweep, the camera is added at the end of the list.
            chosen[k : k + 1] = [int(energy[others].sum(axis=0).argmin())]
    return sorted(int(order[k]) for k in chosen)
