"""One's own pair, from files to files: open, load and mask, estimate, write.

A source is a sequence of a data folder, a folder with a capture, or an image with depth.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import DEFAULT, BackboneLike, as_backbone
from zsp_lite.choices import SOLVERS
from zsp_lite.data.annotations import FRAMES_FILE
from zsp_lite.data.cameras import Box, view_span
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame, frame_defect, read_image
from zsp_lite.errors import InputError, check_choice, check_integer
from zsp_lite.estimates import PairResult, PoseEstimate, label_errors
from zsp_lite.importers.capture import READERS, SIGNS, CaptureFrame, camera_from_pose
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.masks import mask_flags, masks_from_box, masks_from_depth
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import write_ply
from zsp_lite.pipeline import ZeroShotPose, solve_pair
from zsp_lite.points import axis_deviation, object_pixels, world_cloud

_IMAGES = (".jpg", ".jpeg", ".png")
# Options that each format takes; "open" is a source that is open already.
_TAKEN = {"open": (), "image": ("mask", "box", "intrinsics", "depth", "depth_unit")}
_TAKEN |= {"sequence": ("mask", "box"), "nerfstudio": ("mask", "box"), "lists": ("mask", "box", "depth_unit")}
_UNIT_GIVEN_BY = {"nerfstudio": "depth_unit_scale_factor in transforms.json"}  # for others by --depth-unit
_NEAREST, _FARTHEST = 0.05, 20.0  # plausible distance of an object, metres
_ALL_SIDES = 120.0  # target views that span less, in degrees, show one side of the object
_CONTEXT = 8  # frames of a source that are segmented together with the reference frame, or tried as the reference


@dataclass(frozen=True, eq=False)
class Source:
    """Frames of one object in one world, read when needed."""

    path: Path  # the sequence, the capture or the image
    format: str  # "sequence", "image", or the format of a capture
    numbers: tuple[int, ...]  # number of each frame: that of the annotations, or its position in the capture
    read: Callable[[int], Frame]  # reads the frame at a position of `numbers`, with the mask that comes with it, if any
    mask: str  # where masks come from: "given" with the frames, "box" (GrabCut) or "auto" (depth and colours)
    box: Box | None = None  # bounding box of the object in the first frame, for "box"

    @property
    def name(self) -> str:
        """Name of the sequence, the capture or the image; that of the folder itself where the path is "."."""
        return Path(os.path.abspath(self.path)).name

    def describe(self, positions: Sequence[int]) -> str:
        """Name the source and its frames at some positions."""
        if self.format == "image":
            return f"image {self.path}"
        kind = "sequence" if self.format == "sequence" else "capture"
        frames = ", ".join(str(self.numbers[position]) for position in positions)
        return f"{kind} {self.path}, frame{'s' if len(positions) > 1 else ''} {frames}"

    def spread(self, count: int) -> list[int]:
        """Return the positions of at most `count` evenly spaced frames."""
        return sorted(set((np.arange(count) * len(self.numbers) // count).tolist()))

    def load(self, positions: Sequence[int]) -> list[Frame]:
        """Load frames with masks of the object; InputError if a file cannot be read, or no frame shows the object."""
        # The box is that of the first frame, and automatic masks are better with more frames.
        others = {"given": [], "box": [0], "auto": np.linspace(0, len(self.numbers) - 1, _CONTEXT).round()}[self.mask]
        frames = {position: self.read(position) for position in sorted({*positions, *map(int, others)})}
        some = list(frames.values())
        if self.mask != "given":
            masked = masks_from_box(some, self.box) if self.box else masks_from_depth(some)
            frames = dict(zip(frames, masked, strict=True))
        elif without := [self.numbers[k] for k, frame in frames.items() if frame.mask is None]:
            where = f"{self.path}, frame {without[0]}"
            raise InputError(f"{where}: no mask, expected --mask auto or --box TOP,LEFT,HEIGHT,WIDTH")
        return [frames[position] for position in positions]

    def flags(self, frames: Sequence[Frame]) -> tuple[str, ...]:
        """Question the unit of length where the object is implausibly far, and the masks of frames if not given."""
        found = [] if self.mask == "given" else list(mask_flags(frames))
        depth = np.concatenate([frame.depth[object_pixels(frame)] for frame in frames])
        distance = float(np.quantile(depth, 0.25)) if len(depth) else _NEAREST
        if self.format != "sequence" and not _NEAREST <= distance <= _FARTHEST:
            cure = _UNIT_GIVEN_BY.get(self.format, "--depth-unit (0.001: millimetres, 1: metres)")
            expected = f"expected {_NEAREST:g} to {_FARTHEST:g} m; the unit of its depth is given by {cure}"
            found.insert(0, f"the object is {distance:.3g} m from the camera, {expected}")
        return tuple(f"{self.path}: {flag}" for flag in found)

    def reference(self, number: int | None) -> tuple[int, Frame]:
        """Return the position and the frame of a number; by default, of the first usable one among some."""
        if number not in (None, *self.numbers):
            known = f"{len(self.numbers)} from {min(self.numbers)} to {max(self.numbers)}"
            raise InputError(f"{self.path} has no frame {number}, expected one of {known}")
        for position in self.spread(_CONTEXT) if number is None else [self.numbers.index(number)]:
            (frame,) = self.load([position])
            if not (defect := frame_defect(frame)):
                return position, frame
        expected = "another --reference-frame, --mask or --box"
        raise InputError(f"{self.path}: no usable reference frame: {defect}, expected {expected}")


def estimate_pose(
    reference: str | Path | Source,
    target: str | Path | Source,
    solver: str = "verified",
    reference_frame: int | None = None,
    targets: int = 5,
    mask: str | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    backbone: BackboneLike = DEFAULT,
    out: str | Path | None = None,
    upright: bool = True,
) -> PairResult:
    """Estimate the pose between two objects of one category, each named by a path; no label is needed.

    `open_source` explains the paths, and takes the settings that only one of the two has, such as a box around the
    object. Flags name implausible lengths, doubtful masks, target views of one side only, and two categories.

    Args:
        reference: The reference object.
        target: The target object.
        solver: "verified", "paper" or "both".
        reference_frame: Frame number of the reference; by default its first frame with known depth and an object.
        targets: Number of target views, evenly spaced over the target's frames.
        mask: Where the masks of both come from: "given", "auto", or as `open_source` decides.
        intrinsics: Camera intrinsics of both, where they are images (see `open_source`).
        backbone: Backbone, or what `load_backbone` takes.
        out: Folder for the report and the point clouds (see `write_pair`); None writes nothing.
        upright: Whether the reference image is upright; False tries its four turns by 90 degrees (see `ZeroShotPose`).

    Raises:
        InputError: An input or an option is missing or wrong, or the pose cannot be estimated.
    """
    check_choice("solver", solver, SOLVERS)
    check_integer("targets", targets, 1)
    given = {name: (one,) for name, one in (("mask", mask), ("intrinsics", intrinsics)) if one is not None}
    with nullcontext() if out is None else writing(out):  # a folder that cannot be written is an error at once
        first, second = sources = open_pair(reference, target, given)
        position, frame = first.reference(reference_frame)
        positions = second.spread(targets)
        frames = second.load(positions)
        model = as_backbone(backbone)
        foreground = "saliency" if getattr(model, "has_saliency", True) else "mask"
        method = ZeroShotPose(model, foreground=foreground, upright=upright)
        clouds = world_cloud([frame])[0], world_cloud(frames)[0]
        # The method expects objects of about unit standard deviation. Sequences of data folders have it.
        unscaled = [one.format == "sequence" or not len(cloud) for one, cloud in zip(sources, clouds)]
        scales = [1.0 if done else 1 / (axis_deviation(cloud) or 1) for done, cloud in zip(unscaled, clouds)]
        scaled = [scale_frame(one, scales[1]) for one in frames]
        flags = *first.flags([frame]), *second.flags(frames), *_side_flags(frames, clouds[1])
        kinds = sorted({one.path.resolve().parent.name for one in sources if one.format == "sequence"})
        if len(kinds) > 1:
            flags = f"the objects are of different categories: {', '.join(kinds)}", *flags
        solved = solve_pair(method, scale_frame(frame, scales[0]), scaled, SOLVERS[solver])
        estimates = {name: _in_units(one, *scales, flags) for name, one in solved.items()}
        result = PairResult(
            f"{first.name} to {second.name}", (first.describe([position]), second.describe(positions)), frame,
            tuple(frames), estimates, {}, masks=(first.mask, second.mask),
            backbone=getattr(model, "name", str(backbone)),
        )  # fmt: skip
        result = replace(result, errors=known_errors(first, second, result, estimates))
        if out is not None:
            write_pair(result, out)
    return result


def write_pair(result: PairResult, out: str | Path) -> list[Path]:
    """Write the report and the point clouds of a result of `estimate_pose` to a folder, and return the paths.

    They are `report.html`; `target.ply`, the points of the target object in all its views; and for each solver
    `aligned_SOLVER.ply`, the points of the reference object after the pose, and `aligned_SOLVER_2.ply`, after the first
    alternative, where the answer is one of two. The clouds are in the world of the target views, which for an image is
    its camera's frame.
    """
    from zsp_lite.viz.report import write_pair_report

    out = Path(out)
    paths = [out / "target.ply"]
    write_ply(paths[0], *world_cloud(result.targets))
    points, colours = world_cloud([result.reference])
    points = result.reference.camera.to_camera(points)
    for solver, estimate in result.estimates.items():
        poses = [estimate, *estimate.alternatives[:1]] if estimate.one_of_two else [estimate]
        for name, pose in zip((f"aligned_{solver}.ply", f"aligned_{solver}_2.ply"), poses):
            paths.append(out / name)
            write_ply(paths[-1], result.targets[pose.view].camera.to_world(pose.sim3.apply(points)), colours)
    return [write_pair_report(out / "report.html", result), *paths]


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
            JPEG or PNG file NAME.EXT. Depth of an image is NAME_depth.png (16 bit) or NAME_depth.npy, registered to
            its colours, and its mask, if there is one, NAME_mask.png.
        intrinsics: fx, fy, cx, cy of an image in pixels, with pixel centres at half-integers (0.5 more than OpenCV's
            cx and cy).
        depth: Depth file of an image, if it is named otherwise.
        depth_unit: World units per stored depth value, for an image and for a capture of plain lists; 0.001 by default.
        mask: "given", "box" or "auto". By default "box" if there is a box, "given" if the first frame has a mask, and
            "auto" otherwise.
        box: Bounding box (top, left, height, width) of the object in the first frame, pixels.

    Raises:
        InputError: The path is none of these, a file cannot be read, or an option is missing or does not fit.
    """
    path, options = Path(path), {"intrinsics": intrinsics, "depth": depth, "depth_unit": depth_unit}
    layout, options = _format(path), {name: value for name, value in options.items() if value is not None}
    for name in options:
        if name not in _TAKEN[layout]:
            raise InputError(f"--{name.replace('_', '-')} does not go with {path}, of the format {layout}")
    if mask not in (None, *(("box",) if box is not None else ("given", "auto"))):
        expected = "--mask given, --mask auto, or --mask box with --box TOP,LEFT,HEIGHT,WIDTH"
        raise InputError(f"{path}: mask is {mask!r} and box is {box}, expected {expected}")
    if layout == "sequence":
        folder = Path(os.path.abspath(path))
        dataset = Co3D(folder.parents[1])
        every = dataset.frames(folder.parent.name, folder.name)
        if not (frames := [one for one in every if one.viewpoint is not None and one.depth is not None]):
            raise InputError(f"{path}: no frame has a camera and depth, expected some")
        numbers, read = tuple(one.frame_number for one in frames), lambda k: dataset.load(frames[k])
    else:
        capture = [_open_image(path, **options)] if layout == "image" else READERS[layout](path, **options)
        numbers, read = tuple(range(len(capture))), lambda k: capture[k].load()
    if mask is None:
        mask = "box" if box is not None else "auto" if read(0).mask is None else "given"
    return Source(path, layout, numbers, read, mask, box)


def open_pair(
    reference: str | Path | Source, target: str | Path | Source, options: Mapping[str, Sequence]
) -> list[Source]:
    """Open two sources with the options of a command line, by the names of arguments of `open_source`.

    An option has one value for each path that takes it (`depth`: each image), or one for all of them. A single `box` is
    for the first path whose `mask` is "box", if any, or the first of both. An open source takes none.
    """
    sides = reference, target
    formats = ["open" if isinstance(side, Source) else _format(Path(side)) for side in sides]
    given: list[dict] = [{}, {}]
    for name, values in options.items():
        takers = [k for k in (0, 1) if name in _TAKEN[formats[k]]]
        counts = sorted({len(takers), len(takers) if name == "depth" else min(len(takers), 1)})
        if values and len(values) not in counts:
            option, expected = f"--{name.replace('_', '-')}", " or ".join(map(str, counts))
            raise InputError(f"{option}: {len(values)} values with {' and '.join(formats)}, expected {expected}")
        if len(values) == 1 and name == "box":
            boxed = [k for k, way in enumerate(options.get("mask", ())) if way == "box" and k in takers]
            takers = (boxed or takers)[:1]
        for k, value in zip(takers, values if len(values) == 2 else [*values] * 2):
            given[k][name] = value
    return [side if isinstance(side, Source) else open_source(side, **some) for side, some in zip(sides, given)]


def _format(path: Path) -> str:
    """Tell a "sequence" from an "image" and from a capture, of which the format is returned."""
    if path.is_file() and path.suffix.lower() in _IMAGES:
        return "image"
    whole = Path(os.path.abspath(path))  # for the names of "." and of "mine/cup/.."
    if path.is_dir() and (whole.parent / FRAMES_FILE).is_file():
        return "sequence"
    for name, sign in SIGNS.items():
        if (path / sign).is_file():
            return name
    found = "has another format" if path.exists() else "does not exist"
    signs = " or ".join(f"{sign} ({name})" for name, sign in SIGNS.items())
    raise InputError(
        f"{path} {found}, expected a JPEG or PNG file, CATEGORY/SEQUENCE of a data folder, or a folder with {signs}; "
        "`zsp-lite data import --help` lists what each format holds"
    )


def _open_image(
    path: Path, intrinsics: tuple[float, ...] | None = None, depth: str | Path | None = None, depth_unit: float = 0.001
) -> CaptureFrame:
    """Name the files and the camera of an image, whose world is its camera's frame."""
    if intrinsics is None:
        raise InputError(f"image {path}: no intrinsics, expected --intrinsics FX,FY,CX,CY in pixels")
    beside = [path.with_name(f"{path.stem}_depth{suffix}") for suffix in (".png", ".npy")]
    found = [Path(depth)] if depth is not None else [file for file in beside if file.is_file()]
    if not found:
        names = " or ".join(file.name for file in beside)
        raise InputError(f"image {path}: no {names} beside it, expected its depth there or as --depth FILE")
    camera = camera_from_pose(np.eye(4), intrinsics, read_image(path).shape[:2], f"image {path}")
    if not all(0 < place < side for place, side in zip(camera.principal_point, camera.size[::-1])):
        expected = f"a point inside its {camera.size[::-1]} pixels"
        raise InputError(f"image {path}: CX,CY is {intrinsics[2:]}, expected {expected}")
    mask = path.with_name(f"{path.stem}_mask.png")
    return CaptureFrame(path, found[0], camera, depth_unit, mask=mask if mask.is_file() else None)


def known_errors(
    first: Source, second: Source, result: PairResult, estimates: dict[str, PoseEstimate]
) -> dict[str, float]:
    """Compute rotation errors if both are labelled sequences of one category; {} otherwise."""
    one, other = (source.path.resolve() for source in (first, second))
    if {first.format, second.format} != {"sequence"} or one.parent != other.parent:
        return {}
    return label_errors(replace(result, estimates=estimates), one.parent, (one.name, other.name))


def _side_flags(targets: Sequence[Frame], points: Float[np.ndarray, "n 3"]) -> tuple[str, ...]:
    """Say where the usable target views do not show all sides of the object, of which some points are known."""
    cameras = [frame.camera for frame in targets if not frame_defect(frame)]
    span = view_span(cameras, np.median(points, axis=0)) if len(points) else 0.0
    if len(cameras) > 2 and span >= _ALL_SIDES:
        return ()
    seen = f"{'two sides' if span >= _ALL_SIDES else 'one side'} only ({span:.0f} degrees)"
    return (f"the target was seen from {seen}: if the reference was taken from another side, this pose is wrong",)


def _in_units(
    estimate: PoseEstimate, reference_scale: float, target_scale: float, flags: tuple[str, ...]
) -> PoseEstimate:
    """Express an estimate on scaled frames in the lengths before scaling, and add flags."""

    def unscaled(sim3: Sim3) -> Sim3:
        return Sim3(sim3.scale * reference_scale / target_scale, sim3.R, sim3.t / target_scale)

    reference, targets = estimate.reference_view, estimate.target_views
    return replace(
        estimate,
        flags=(*estimate.flags, *flags),
        sim3=unscaled(estimate.sim3),
        hypotheses=tuple(replace(one, sim3=unscaled(one.sim3)) for one in estimate.hypotheses),
        reference_view=replace(reference, frame=scale_frame(reference.frame, 1 / reference_scale)),
        target_views=tuple(replace(one, frame=scale_frame(one.frame, 1 / target_scale)) for one in targets),
    )
