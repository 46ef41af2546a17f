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
from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.backbones.pretrained import DEFAULT
from zsp_lite.choices import MASKS, SOLVERS
from zsp_lite.data.annotations import FRAMES_FILE
from zsp_lite.data.cameras import Box, view_span
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame, frame_defect, read_image
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError, check_integer
from zsp_lite.estimates import SEQUENCE_FRAMES, PairResult, PoseEstimate, label_error
from zsp_lite.features import FeatureExtractor
from zsp_lite.importers.capture import CaptureFrame, camera_from_pose
from zsp_lite.importers.convert import READERS, capture_format
from zsp_lite.importers.fusion import scale_frame
from zsp_lite.importers.geometry_masks import masks_from_depth
from zsp_lite.importers.mask_flags import mask_flags
from zsp_lite.importers.masks import masks_from_box
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import write_ply
from zsp_lite.pipeline import ZeroShotPose, solve_pair
from zsp_lite.points import object_pixels, unit_scale, world_cloud
from zsp_lite.views import View, has_saliency

_IMAGES = (".jpg", ".jpeg", ".png")
# What each format of `_format` is, and the options that it takes.
_WHAT = {"image": "an image", "sequence": "a sequence of a data folder"} | {
    name: f"a capture of the format {name}" for name in READERS
}
_TAKEN = {"image": ("intrinsics", "depth", "depth_unit"), "lists": ("depth_unit",)}
# What to do where the depth of a format seems to have another unit. Lengths are metres, if they are known at all.
_UNIT_OPTION = "give the unit of its depth as --depth-unit (0.001: millimetres, 1: metres)"
_UNITS = {"nerfstudio": "set depth_unit_scale_factor in transforms.json"}
_NEAREST, _FARTHEST = 0.05, 20.0  # plausible distance of an object, metres
_ALL_SIDES = 120.0  # target views that span less, in degrees, show one side of the object
_CONTEXT = 8  # frames of a source that are segmented together with the reference frame, or tried as the reference


@dataclass(frozen=True, eq=False)
class Source:
    """Frames of one object in one world, read when needed.

    Attributes:
        path: The sequence, the capture or the image.
        format: "sequence", "image", or the format of a capture.
        numbers: Number of each frame: that of the annotations, or its position in the capture.
        read: Reads the frame at a position of `numbers`, with the mask that comes with it, if any.
        mask: Where masks come from: "given" with the frames, "box" (GrabCut) or "auto" (depth and colours).
        box: Bounding box of the object in the first frame, for "box".
        unit_given: Whether the unit of the depth is not the default, but the user's or the format's.
    """

    path: Path
    format: str
    numbers: tuple[int, ...]
    read: Callable[[int], Frame]
    mask: str
    box: Box | None = None
    unit_given: bool = True

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
        ordered = set(positions)
        if self.mask == "box":
            ordered |= {0}  # the box is that of the first frame
        elif self.mask == "auto":
            ordered |= set(np.linspace(0, len(self.numbers) - 1, _CONTEXT).round().astype(int).tolist())
        frames = {position: self.read(position) for position in sorted(ordered)}
        if not self.unit_given and (flags := self.unit_flags(list(frames.values()))):
            raise InputError(flags[0])
        if self.mask != "given":
            some = list(frames.values())
            frames = dict(zip(frames, masks_from_box(some, self.box) if self.box else masks_from_depth(some)))
        for position, frame in frames.items():
            if frame.mask is None:
                where = f"{self.path}, frame {self.numbers[position]}"
                raise InputError(f"{where}: no mask, expected --mask auto or --box TOP,LEFT,HEIGHT,WIDTH")
        return [frames[position] for position in positions]

    def unit_flags(self, frames: Sequence[Frame]) -> tuple[str, ...]:
        """Question the unit of length if the object, or what is near in frames without masks, is implausibly far."""
        if self.format == "sequence":
            return ()
        depth = np.concatenate([frame.depth[object_pixels(frame)] for frame in frames])
        distance = float(np.quantile(depth, 0.25)) if len(depth) else _NEAREST
        if _NEAREST <= distance <= _FARTHEST:
            return ()
        cure = f"expected {_NEAREST:g} to {_FARTHEST:g} m; {_UNITS.get(self.format, _UNIT_OPTION)}"
        return (f"{self.path}: the object is {distance:.3g} m from the camera, {cure}",)

    def flags(self, frames: Sequence[Frame]) -> tuple[str, ...]:
        """Question the unit of length, and the masks of frames if they were not given."""
        masks = () if self.mask == "given" else mask_flags(frames)
        return *self.unit_flags(frames), *(f"{self.path}: {flag}" for flag in masks)

    def reference(self, number: int | None) -> tuple[int, Frame]:
        """Return the position and the frame of a number; by default, of the first usable one among some."""
        if number not in (None, *self.numbers):
            known = f"{len(self.numbers)} from {min(self.numbers)} to {max(self.numbers)}"
            raise InputError(f"{self.path} has no frame {number}, expected one of {known}")
        for position in self.spread(_CONTEXT) if number is None else [self.numbers.index(number)]:
            (frame,) = self.load([position])
            if not (defect := frame_defect(frame)):
                return position, frame
        raise InputError(
            f"{self.path}: no usable reference frame: {defect}, expected another --reference-frame, --mask or --box"
        )


def estimate_pose(
    reference: str | Path | Source,
    target: str | Path | Source,
    solver: str = "verified",
    reference_frame: int | None = None,
    targets: int = 5,
    mask: str | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    backbone: str | BackboneConfig | FeatureExtractor = DEFAULT,
    out: str | Path | None = None,
    upright: bool = True,
) -> PairResult:
    """Estimate the pose between two objects of one category, each named by a path.

    Each path is a sequence of a data folder, a folder with a capture, or an image with depth. `open_source` explains
    them, and takes the settings that only one of the two has, such as a box around the object. No label is needed.
    Implausible lengths, doubtful masks, and target views that show one side of the object, are flags of the estimates.

    Args:
        reference: The reference object.
        target: The target object.
        solver: "verified", "paper" or "both".
        reference_frame: Frame number of the reference; by default its first frame with known depth and an object.
        targets: Number of target views, evenly spaced over the target's frames.
        mask: Where the masks of both come from: "given", "auto", or as `open_source` decides. For "box", open the
            sources, which take a box each.
        intrinsics: Camera intrinsics of both, where they are images (see `open_source`).
        backbone: Backbone, or what `load_backbone` takes.
        out: Folder for the report and the point clouds (see `write_pair`); None writes nothing.
        upright: Whether the reference image is upright; False tries its four turns by 90 degrees (see `ZeroShotPose`).

    Raises:
        InputError: An input cannot be read, an option is missing, `out` cannot be written, or the pose cannot be
            estimated.
    """
    if solver not in SOLVERS:
        raise InputError(f"solver is {solver!r}, expected one of {', '.join(SOLVERS)}")
    check_integer("targets", targets, 1)
    given = {"mask": mask, "intrinsics": intrinsics}
    with nullcontext() if out is None else writing(out):  # a folder that cannot be written is an error at once
        first, second = open_pair(reference, target, {name: (one,) for name, one in given.items() if one is not None})
        position, frame = first.reference(reference_frame)
        positions, shown = second.spread(targets), second.spread(SEQUENCE_FRAMES)
        wanted = sorted({*positions, *shown})
        loaded = dict(zip(wanted, second.load(wanted)))
        frames = [loaded[k] for k in positions]
        model = load_backbone(backbone) if isinstance(backbone, str | BackboneConfig) else backbone
        method = ZeroShotPose(model, foreground="saliency" if has_saliency(model) else "mask", upright=upright)
        clouds = world_cloud([frame])[0], world_cloud(frames)[0]
        # The method expects objects of about unit standard deviation. Sequences of data folders have it.
        scales = [
            1.0 if source.format == "sequence" or len(cloud) < 2 else unit_scale(cloud)
            for source, cloud in zip((first, second), clouds)
        ]
        scaled = [scale_frame(one, scales[1]) for one in frames]
        estimates = solve_pair(method, scale_frame(frame, scales[0]), scaled, SOLVERS[solver])
        flags = *first.flags([frame]), *second.flags(frames), *_side_flags(frames, clouds[1])
        estimates = {
            name: replace(_in_units(one, *scales), flags=(*one.flags, *flags)) for name, one in estimates.items()
        }
        result = PairResult(
            f"{first.name} to {second.name}", (first.describe([position]), second.describe(positions)), frame,
            tuple(frames), estimates, _errors(first, second, frame, frames, estimates),
            tuple(loaded[k] for k in shown), masks=(first.mask, second.mask),
            backbone=getattr(model, "name", str(backbone)),
        )  # fmt: skip
        if out is not None:
            write_pair(result, out)
    return result


def write_pair(result: PairResult, out: str | Path) -> list[Path]:
    """Write the report and the point clouds of a pair.

    Args:
        result: The result of `estimate_pose`.
        out: Folder to write; created if missing.

    Returns:
        `report.html`; `target.ply`, the points of the target object in all its views; and for each solver
        `aligned_SOLVER.ply`, the points of the reference object after the pose, and `aligned_SOLVER_2.ply`, after the
        first alternative, where the answer is one of two. The clouds are in the world of the target views, which for
        an image is its camera's frame.
    """
    from zsp_lite.viz.report import write_pair_report

    out = Path(out)
    paths = [out / "target.ply"]
    write_ply(paths[0], *world_cloud(result.targets))
    points, colours = world_cloud([result.reference])
    points = result.reference.camera.to_camera(points)
    for solver, estimate in result.estimates.items():
        poses = {f"aligned_{solver}.ply": estimate}
        if estimate.one_of_two:
            poses[f"aligned_{solver}_2.ply"] = estimate.alternatives[0]
        for name, pose in poses.items():
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
    given = {"intrinsics": intrinsics, "depth": depth, "depth_unit": depth_unit}
    given = {name: value for name, value in given.items() if value is not None}
    return _open(Path(path), _format(Path(path)), mask, box, **given)


def _open(path: Path, layout: str, mask: str | None = None, box: Box | None = None, **options) -> Source:
    """Open a source whose format is known; `options` are those of `_TAKEN`."""
    if mask not in (None, *MASKS):
        raise InputError(f"mask is {mask!r}, expected one of {', '.join(MASKS)}")
    if mask == "box" and box is None:
        raise InputError(
            f"{path}: --mask box needs the bounding box of the object, expected --box TOP,LEFT,HEIGHT,WIDTH"
        )
    if box is not None and mask not in (None, "box"):
        raise InputError(f"{path}: --box goes with --mask box, got --mask {mask}")
    for name in options:
        if name not in _TAKEN.get(layout, ()):
            raise InputError(f"--{name.replace('_', '-')} does not go with {_WHAT[layout]}")
    if layout == "sequence":
        numbers, read = _open_sequence(path)
    else:
        capture = [_open_image(path, **options)] if layout == "image" else READERS[layout](path, **options)
        numbers, read = tuple(range(len(capture))), lambda k: capture[k].load()
    if mask is None:
        mask = "box" if box is not None else "auto" if read(0).mask is None else "given"
    unit_given = "depth_unit" in options or "depth_unit" not in _TAKEN.get(layout, ())
    return Source(path, layout, numbers, read, mask, box, unit_given)


def open_pair(
    reference: str | Path | Source, target: str | Path | Source, options: Mapping[str, Sequence]
) -> tuple[Source, Source]:
    """Open two sources with the options of a command line.

    Args:
        reference: Path of the reference, see `open_source`; or an open source, which takes no options.
        target: The same of the target.
        options: For each argument of `open_source` at most two values: the reference's and the target's. A single one
            is for each path that takes the option; a single box for the first whose mask is "box", if any, or first.

    Raises:
        InputError: See `open_source`; or an option has too many values, or goes with neither path.
    """
    sides = reference, target
    formats = ["open" if isinstance(side, Source) else _format(Path(side)) for side in sides]
    given: list[dict] = [{}, {}]
    for name, values in options.items():
        option = f"--{name.replace('_', '-')}"
        takers = [k for k in (0, 1) if formats[k] != "open"]
        if name not in ("mask", "box"):
            takers = [k for k in takers if name in _TAKEN.get(formats[k], ())]
        if values and not takers:
            raise InputError(f"{option} does not go with {' and '.join(_WHAT.get(one, one) for one in formats)}")
        if len(values) > 2 or (name == "depth" and values and len(values) != len(takers)):
            expected = "one for each image" if name == "depth" else "at most two: the reference's and the target's"
            raise InputError(f"{option} is given {len(values)} times, expected {expected}")
        if len(values) == 2 and name != "depth":
            takers = [0, 1]
        elif name == "box":
            boxed = [k for k, way in enumerate(options.get("mask", ())) if way == "box" and k in takers]
            takers = (boxed or takers)[:1]
        for k, value in zip(takers, values if len(values) == 2 else [*values] * 2):
            given[k][name] = value
    first, second = (
        side if isinstance(side, Source) else _open(Path(side), layout, **some)
        for side, layout, some in zip(sides, formats, given)
    )
    return first, second


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
    size = read_image(path).shape[:2]
    beside = [path.with_name(f"{path.stem}_depth{suffix}") for suffix in (".png", ".npy")]
    found = [Path(depth)] if depth is not None else [file for file in beside if file.is_file()]
    if not found:
        names = " or ".join(file.name for file in beside)
        raise InputError(f"image {path}: no {names} beside it, expected its depth there or as --depth FILE")
    camera = camera_from_pose(np.eye(4), intrinsics, size, f"image {path}")
    mask = path.with_name(f"{path.stem}_mask.png")
    return CaptureFrame(path, found[0], camera, depth_unit, mask=mask if mask.is_file() else None)


def _errors(
    first: Source, second: Source, reference: Frame, targets: Sequence[Frame], estimates: dict[str, PoseEstimate]
) -> dict[str, float]:
    """Compute rotation errors if both are labelled sequences of one category; {} otherwise."""
    one, other = (source.path.resolve() for source in (first, second))
    if {first.format, second.format} != {"sequence"} or one.parent != other.parent:
        return {}
    labels = read_labels(one.parent.parent, one.parent.name)
    if not {one.name, other.name} <= set(labels):
        return {}
    ends = labels[one.name], reference, labels[other.name], targets
    return {solver: label_error(estimate, *ends) for solver, estimate in estimates.items()}


def _side_flags(targets: Sequence[Frame], points: Float[np.ndarray, "n 3"]) -> tuple[str, ...]:
    """Say where the usable target views do not show all sides of the object, of which some points are known."""
    cameras = [frame.camera for frame in targets if not frame_defect(frame)]
    span = view_span(cameras, np.median(points, axis=0)) if len(points) else 0.0
    if len(cameras) > 2 and span >= _ALL_SIDES:
        return ()
    seen = f"{'two sides' if span >= _ALL_SIDES else 'one side'} only ({span:.0f} degrees)"
    return (f"the target was seen from {seen}: if the reference was taken from another side, this pose is wrong",)


def _in_units(estimate: PoseEstimate, reference_scale: float, target_scale: float) -> PoseEstimate:
    """Express an estimate on scaled frames in the lengths before scaling."""

    def unscaled(sim3: Sim3) -> Sim3:
        return Sim3(sim3.scale * reference_scale / target_scale, sim3.R, sim3.t / target_scale)

    def view(one: View, scale: float) -> View:
        return replace(one, frame=scale_frame(one.frame, 1 / scale))

    return replace(
        estimate,
        sim3=unscaled(estimate.sim3),
        hypotheses=tuple(replace(one, sim3=unscaled(one.sim3)) for one in estimate.hypotheses),
        reference_view=view(estimate.reference_view, reference_scale),
        target_views=tuple(view(one, target_scale) for one in estimate.target_views),
    )
