"""One's own pair, from files or frames to files: open, load and mask, estimate, write.

A source is a sequence of a data folder, a folder with a capture, an image with depth, or frames in memory.
"""

import os
import reprlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import DEFAULT, BackboneLike, as_backbone
from zsp_lite.category import SAME_ANGLE, references_per_pair, synchronise, world_hypotheses
from zsp_lite.choices import SOLVERS
from zsp_lite.data.annotations import FRAMES_FILE
from zsp_lite.data.cameras import Box, Camera, Values, camera_from_pose, view_span
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame, frame_defect, turn_frame
from zsp_lite.errors import InputError, NoPoseError, check_choice, check_integer
from zsp_lite.estimates import Hypothesis, PairResult, PoseEstimate, Vote, label_errors, timed
from zsp_lite.importers import FORMATS, open_capture, recognise
from zsp_lite.importers.agreement import disagreement, neighbours
from zsp_lite.importers.capture import CaptureFrame, left_out_flags
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.files import CO3D_DEPTH, DEPTHS, MASKS, PICTURES, question_intrinsics, read_picture
from zsp_lite.importers.masks import (
    DOUBTFUL,
    depth_flags,
    given_mask_flags,
    mask_flags,
    masks_from_box,
    masks_from_depth,
)
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import write_ply
from zsp_lite.metrics import rotation_angle, rotation_error
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import axis_deviation, object_pixels, world_cloud
from zsp_lite.verified.confidence import reliability_flags
from zsp_lite.verified.solver import measured_inliers
from zsp_lite.views import View

# Options that each format takes; "open" is a source that is open already.
_MASKED = ("mask", "box")
_FILES = (*_MASKED, "label", "orientation")
_TAKEN = {"open": (), "image": (*_FILES, "intrinsics", "depth", "depth_unit"), "sequence": _MASKED, "frames": _MASKED}
_TAKEN |= {name: (*_FILES, *one.options) for name, one in FORMATS.items()}
_NEAREST, _FARTHEST = 0.05, 20.0  # plausible distance of an object, metres
_ALL_SIDES = 120.0  # target views that span less, in degrees, show one side of the object
_TARGETS = 5
_REFERENCES = 4  # frames of each object that are solved against views of the other
_MOST_DOUBTFUL = 0.8  # largest confidence by masks that are flagged
_LEAST_PROBABLE = 0.005  # an alternative is named above this
_Ends = tuple[int, int, int]  # numbers of two objects, and the position of a frame of the first
_SWEEPS = 20  # over the chosen views, which mostly stay after ten
_CONTEXT = 8  # frames of a source that are segmented together with the reference frame, or tried as the reference


@dataclass(frozen=True, eq=False)
class Source:
    """Frames of one object in one world, read when needed."""

    path: Path  # the sequence, the capture or the image; a name for frames in memory
    format: str  # "sequence", "image", "frames", or the format of a capture
    numbers: tuple[int, ...]  # number of each frame: that of the annotations, or its position in the capture
    read: Callable[[int], Frame]  # reads the frame at a position of `numbers`, with the mask that comes with it, if any
    mask: str  # where masks come from: "given" with the frames, "box" (GrabCut) or "auto" (depth and colours)
    box: Box | None = None  # bounding box of the object in the first frame, for "box"
    cameras: tuple[Camera, ...] = ()  # of the frames, where these are chosen by their directions, not by their order
    left_out: tuple[str, ...] = ()  # what is wrong with each frame that cannot be used
    missing: tuple[int, ...] = ()  # numbers of frames without a mask where others have one; it is made by depth
    doubts: tuple[str, ...] = ()  # what speaks against the intrinsics
    depth_unit: float | None = None  # world units per stored depth value, of an image or a capture

    @property
    def name(self) -> str:
        """Name of the sequence, the capture or the image; that of the folder itself where the path is "."."""
        return Path(os.path.abspath(self.path)).name

    def describe(self, positions: Sequence[int]) -> str:
        """Name the source and its frames at some positions."""
        if self.format == "image":
            return f"image {self.path}"
        kind = self.format if self.format in ("sequence", "frames") else "capture"
        frames = ", ".join(str(self.numbers[position]) for position in positions)
        return f"{kind} {self.path}, frame{'s' if len(positions) > 1 else ''} {frames}"

    def load(self, positions: Sequence[int]) -> list[Frame]:
        """Load frames with masks of the object; InputError if a file cannot be read, or no frame shows the object."""
        # The box is that of the first frame, and automatic masks are better with more frames.
        others = {"given": [], "box": [0], "auto": np.linspace(0, len(self.numbers) - 1, _CONTEXT).round()}[self.mask]
        frames = {position: self.read(position) for position in sorted({*positions, *map(int, others)})}
        some = list(frames.values())
        if self.mask != "given":
            try:
                masked = list(masks_from_box(some, self.box) if self.box else masks_from_depth(some))
            except InputError as error:
                raise InputError("; ".join(filter(None, (str(error), self._disagreement(some))))) from error
            frames = dict(zip(frames, masked, strict=True))
        elif any(frame.mask is None for frame in some):
            made = dict(zip(frames, replace(self, mask="auto").load(list(frames)), strict=True))
            frames = {k: made[k] if frame.mask is None else frame for k, frame in frames.items()}
        return [frames[position] for position in positions]

    def flags(self, frames: Sequence[Frame]) -> tuple[str, ...]:
        """Question units, intrinsics, depth and poses of frames and of some more, and masks."""
        found = [*self.doubts]
        found += given_mask_flags(frames, self.missing) if self.mask == "given" else mask_flags(frames)
        found += depth_flags(frames)
        more = []
        for position in neighbours(len(self.numbers)):
            with suppress(InputError):  # a damaged file that the estimate does not use
                more.append(self.read(position))
        found += filter(None, [self._disagreement(more)])
        depth = np.concatenate([frame.depth[object_pixels(frame)] for frame in frames])
        distance = float(np.quantile(depth, 0.25)) if len(depth) else _NEAREST
        if self.format not in ("sequence", "frames") and not _NEAREST <= distance <= _FARTHEST:
            cure = "the unit of its depth is given by --depth-unit (0.001: millimetres, 1: metres)"
            expected = f"expected {_NEAREST:g} to {_FARTHEST:g} m; {cure}"
            found.insert(0, f"the object is {distance:.3g} m from the camera, {expected}")
        return tuple(f"{self.path}: {flag}" for flag in (*left_out_flags(self.left_out), *found))

    def _disagreement(self, frames: Sequence[Frame]) -> str:
        """Say how depth and poses of frames contradict each other (see `disagreement`)."""
        if self.mask != "given":  # masks that follow from wrong poses are wrong
            frames = [replace(frame, mask=None) for frame in frames]
        return disagreement(frames, self.depth_unit)

    def select(
        self, references: int, targets: int, first: int | None = None
    ) -> tuple[list[int], list[int], dict[int, Frame]]:
        """Load frames from all sides; return the positions of reference frames and of target views, and the frames.

        Frames with a defect are no references. The first reference frame is that with the number `first`.
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
            raise InputError(f"{self.path}: no usable reference frame: {defects[start]}, expected {expected}")
        return self._spread(references, usable), views, frames

    def _spread(self, count: int, positions: Sequence[int]) -> list[int]:
        """Choose at most `count` positions with the first, evenly by the directions of the cameras, or by the order."""
        if not self.cameras or count == 0:
            return [positions[k] for k in spread(count, len(positions))]
        return [positions[k] for k in spread_views([self.cameras[position] for position in positions], count)]


_Object = str | Path | Frame | Sequence[Frame] | Source  # a path, frames, or what `open_source` returns


@dataclass(frozen=True, eq=False)
class _Scan:
    """The frames of a source that an estimate uses, whole and as views of an object of unit standard deviation."""

    source: Source
    references: list[int]  # positions of the frames that are solved against target views of other objects
    targets: list[int]  # positions of the target views
    frames: dict[int, Frame]
    views: dict[int, View]
    scale: float  # from the lengths of the frames to those of the views
    cloud: Float[np.ndarray, "n 3"]

    @classmethod
    def of(
        cls, source: Source, method: ZeroShotPose, references: int, targets: int, first: int | None = None
    ) -> "_Scan":
        """Load frames of a source (see `Source.select`), and extract their features."""
        chosen, shown, frames = source.select(references, targets, first)
        cloud = world_cloud([frames[position] for position in shown or chosen])[0]
        # The method expects objects of about unit standard deviation. Sequences of data folders have it.
        scale = 1.0 if source.format == "sequence" or not len(cloud) else 1 / (axis_deviation(cloud) or 1)
        used = dict.fromkeys([*chosen, *shown])
        views = method.views([scale_frame(frames[position], scale) for position in used])
        return cls(source, chosen, shown, frames, dict(zip(used, views, strict=True)), scale, cloud)

    @property
    def target_views(self) -> list[View]:
        """The views that reference frames of other objects are solved against."""
        return [self.views[position] for position in self.targets]

    @property
    def seen(self) -> tuple[int, float]:
        """Number of usable target views, and the angle in degrees that they span around the object."""
        cameras = [self.frames[k].camera for k in self.targets if not frame_defect(self.frames[k])]
        return len(cameras), view_span(cameras, np.median(self.cloud, axis=0)) if len(self.cloud) else 0.0


def estimate_pose(
    reference: _Object,
    target: _Object,
    solver: str = "verified",
    reference_frame: int | None = None,
    targets: int | None = None,
    mask: str | None = None,
    intrinsics: Values | None = None,
    backbone: BackboneLike = DEFAULT,
    out: str | Path | None = None,
    upright: bool = True,
    references: int | None = None,
    helpers: Sequence[_Object] = (),
    workers: int = 1,
) -> PairResult:
    """Estimate the pose between two objects of one category, given as paths or frames; no label is needed.

    The paper takes one frame of the reference. The verified solver takes several, and where the target has several
    frames, these against views of the reference, too: the pose is what most frames agree on (see `category`).
    `open_source` explains the paths, and takes the settings that only one of the two has, such as a box around the
    object. Flags name implausible lengths, doubtful masks, objects seen from one side only, frames that disagree, and
    two categories.

    Args:
        reference: The reference object.
        target: The target object. The frames of one object are in one world.
        solver: "verified", "paper" or "both".
        reference_frame: Frame number of the reference, in whose camera the pose is; by default its first frame with
            known depth and an object.
        targets: Number of target views, evenly spaced over the target's frames; 5 by default, or as many as there are.
        mask: Where the masks of all come from: "given", "auto", or as `open_source` decides.
        intrinsics: Camera intrinsics of all images (see `open_source`).
        backbone: Backbone, or what `load_backbone` takes.
        out: Folder for the report and the point clouds (see `write_pair`); None writes nothing.
        upright: Whether the reference images are upright; False tries four turns by 90 degrees, since phones may store
            images turned, and keeps the best. The pose is then that of the turned image, and a flag says so.
        references: Number of reference frames of each object, evenly spaced; 1 is the paper's setting. By default 4,
            or 1 with a `reference_frame`, or more with helpers (see `category.references_per_pair`).
        helpers: Other objects of the category: what two objects cannot tell, all together mostly can.
        workers: Number of frames that are solved at once, by threads.

    Raises:
        InputError: An input or an option is missing or wrong, or the pose cannot be estimated.
    """
    check_choice("solver", solver, SOLVERS)
    wanted, targets = targets, _TARGETS if targets is None else targets
    check_integer("targets", targets, 1)
    check_integer("workers", workers, 1)
    if references is None:
        alone = _REFERENCES if reference_frame is None else 1
        references = references_per_pair(2 + len(helpers)) if helpers else alone
    check_integer("references", references, 1)
    several = "verified" in SOLVERS[solver] and (references > 1 or bool(helpers))
    given = {name: (one,) for name, one in (("mask", mask), ("intrinsics", intrinsics)) if one is not None}
    with nullcontext() if out is None else writing(out):  # a folder that cannot be written is an error at once
        sources = open_pair(reference, target, given, helpers)
        if helpers and len({one.path.resolve() for one in sources}) < len(sources):
            raise InputError(f"{', '.join(str(one.path) for one in sources)}: expected different objects")
        model = as_backbone(backbone)
        foreground = "saliency" if getattr(model, "has_saliency", True) else "mask"
        method = ZeroShotPose(model, foreground=foreground, solver="verified")
        counts = (references, targets) if several else (1, 0)
        before: dict[str, float] = {}
        with timed(before, "features"):
            scans = [_Scan.of(sources[0], method, *counts, reference_frame)]
            scans += [_Scan.of(one, method, references if several else 0, targets) for one in sources[1:]]
        flags = _pair_flags(scans)
        if wanted and wanted > len(scans[1].targets):
            flags = *flags, f"the target has {len(scans[1].targets)} frames: these are used, not {wanted}"
        if not upright:
            with timed(before, "turns"):
                scans[0], turn = _stood_up(*scans[:2], replace(method, solver=SOLVERS[solver][-1]))
            flags = *flags, f"the reference is turned by {turn}° counterclockwise: the pose is that of the turned image"
        first, second, position = *scans[:2], scans[0].references[0]
        views = first.views[position], second.target_views
        solved = {name: replace(method, solver=name).estimate_from_views(*views) for name in SOLVERS[solver]}
        votes = ()
        if several:
            timings = dict(solved["verified"].timings)
            with timed(timings, "other frames"):
                found = {(0, 1, position): solved["verified"], **_solve_others(scans, method, workers)}
                agreed, votes = _agreed_pose(scans, method, found)
            solved["verified"] = replace(agreed, timings=timings)
        estimates = {
            name: _in_units(replace(one, timings=before | one.timings), first.scale, second.scale, flags)
            for name, one in solved.items()
        }
        where = first.source.describe(first.references), second.source.describe(second.targets)
        if helpers:
            where = where[0], f"{where[1]}; helpers: {', '.join(str(one.path) for one in sources[2:])}"
        result = PairResult(
            f"{sources[0].name} to {sources[1].name}", where, first.frames[position],
            tuple(second.frames[k] for k in second.targets), estimates, {},
            masks=(sources[0].mask, sources[1].mask), backbone=getattr(model, "name", str(backbone)), votes=votes,
        )  # fmt: skip
        one, other = (source.path.resolve() for source in sources[:2])
        if first.source.format == second.source.format == "sequence" and one.parent == other.parent:
            result = replace(result, errors=label_errors(result, one.parent, (one.name, other.name)))
        if out is not None:
            write_pair(result, out)
    return result


def _stood_up(scan: _Scan, target: _Scan, method: ZeroShotPose) -> tuple[_Scan, int]:
    """Turn the frames of a scan by the quarter turns that suit its first reference frame best; return the degrees."""
    scores, position = {}, scan.references[0]
    for quarters in range(4):
        (view,) = method.views([turn_frame(scale_frame(scan.frames[position], scan.scale), quarters)])
        with suppress(NoPoseError):
            one = method.estimate_from_views(view, target.target_views)
            scores[quarters] = one.hypotheses[0].score if one.hypotheses else one.view_scores[one.view]
    quarters = max(scores, key=scores.get, default=0)
    frames = {key: turn_frame(frame, quarters) for key, frame in scan.frames.items()}
    views = method.views([scale_frame(frames[key], scan.scale) for key in scan.views])
    return replace(scan, frames=frames, views=dict(zip(scan.views, views, strict=True))), 90 * quarters


def _solve_others(scans: Sequence[_Scan], method: ZeroShotPose, workers: int) -> dict[_Ends, PoseEstimate]:
    """Solve every reference frame of each object against the views of each other one, but for the first of all."""
    ends = [(a, b, position) for a, b in permutations(range(len(scans)), 2) for position in scans[a].references]

    def solve(a: int, b: int, position: int) -> PoseEstimate | None:
        with suppress(NoPoseError):
            return method.estimate_from_views(scans[a].views[position], scans[b].target_views)

    with ThreadPoolExecutor(workers) as pool:
        solved = list(tqdm(pool.map(solve, *zip(*ends[1:])), total=len(ends) - 1, unit="frame", delay=1, disable=None))
    return {end: one for end, one in zip(ends[1:], solved, strict=True) if one}


def _agreed_pose(
    scans: Sequence[_Scan], method: ZeroShotPose, found: Mapping[_Ends, PoseEstimate]
) -> tuple[PoseEstimate, tuple[Vote, ...]]:
    """Find the pose that the hypotheses of all frames agree on, in the first frame's camera, and their votes."""
    names = [f"{k} {scan.source.name}" for k, scan in enumerate(scans)]
    agreement = synchronise([world_hypotheses(names[a], names[b], one) for (a, b, _), one in found.items()])
    one, other = (agreement.objects[name] for name in names[:2])
    answers = [(agreement.between(*names[:2]), min(one.probability, other.probability))]
    if other.alternative and other.alternative_probability > _LEAST_PROBABLE:
        answers.append((other.alternative.inverse() @ one.sim3, other.alternative_probability))
    votes = []
    for (a, b, position), estimate in found.items():
        if max(a, b) < 2:
            name = f"frame {scans[a].source.numbers[position]} of {scans[a].source.name}"
            degrees = float(rotation_error(estimate.world_sim3.R, agreement.between(names[a], names[b]).R))
            votes.append(Vote(name, _in_units(estimate, scans[a].scale, scans[b].scale, ()), degrees, a > b))
    against = [vote.name for vote in votes if vote.degrees > SAME_ANGLE]
    flags = [f"{len(against)} of {len(votes)} frames vote for another pose: {', '.join(against)}"] if against else []
    return _answer(next(iter(found.values())), method, answers, flags), tuple(votes)


def _answer(
    estimate: PoseEstimate, method: ZeroShotPose, answers: Sequence[tuple[Sim3, float]], flags: Sequence[str]
) -> PoseEstimate:
    """Replace the hypotheses of an estimate by similarities between the worlds, each with its probability."""
    reference, targets = estimate.reference_view, estimate.target_views
    to_reference, *to_targets = (Sim3(1.0, one.frame.camera.R, one.frame.camera.t) for one in (reference, *targets))
    hypotheses, left_out = [], np.where(np.isfinite(estimate.view_scores), 0.0, np.inf)
    for mode, (sim3, probability) in reversed([*enumerate(answers)]):
        poses = [camera @ sim3 @ to_reference.inverse() for camera in to_targets]
        angles = rotation_angle(np.stack([pose.R for pose in poses]), np.eye(3)) + left_out
        view = int(angles.argmin())
        score = float(np.log(max(probability, 1e-9)))
        hypotheses.insert(0, Hypothesis(poses[view], view, score, {}, probability, mode))
    (matched,) = method.match_views(reference, [targets[view]])
    turns = np.stack([sim3.R for sim3, _ in answers])
    between = rotation_angle(turns[:, None], turns)
    doubts, one_of_two = reliability_flags(hypotheses, between)
    kept = [flag for flag in estimate.flags if "left out" in flag]
    return replace(
        estimate, sim3=poses[view], view=view, matches=matched.matches, view_scores=-angles,
        inliers=measured_inliers(reference, targets[view], matched.matches, poses[view], method.threshold),
        hypotheses=tuple(hypotheses), one_of_two=one_of_two, flags=(*doubts, *flags, *kept),
    )  # fmt: skip


def write_pair(result: PairResult, out: str | Path) -> list[Path]:
    """Write the report and the point clouds of a result of `estimate_pose` to a folder, and return the paths.

    They are `report.html`; `target.ply`, the points of the target object in all its views; and for each solver
    `aligned_SOLVER.ply`, the points of the reference object after the pose, and `aligned_SOLVER_2.ply`, after the first
    alternative, where the answer is one of two. The clouds are in the world of the target views, which for an image is
    its camera's frame. Files of these names that an earlier run left are removed.
    """
    from zsp_lite.viz.report import write_pair_report

    out = Path(out)
    for solver in SOLVERS["both"]:
        for name in (f"aligned_{solver}.ply", f"aligned_{solver}_2.ply"):
            (out / name).unlink(missing_ok=True)
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
    path: str | Path | Frame | Sequence[Frame],
    intrinsics: Values | None = None,
    depth: str | Path | None = None,
    depth_unit: float | None = None,
    mask: str | None = None,
    box: Box | None = None,
    label: int | None = None,
    orientation: str | None = None,
    object: int | None = None,
) -> Source:
    """Open a sequence of a data folder, a folder with a capture, an image, or frames of one object in one world.

    Args:
        path: ROOT/CATEGORY/SEQUENCE of a data folder; the folder or zip of a capture (see `importers.recognise`); or a
            JPEG, PNG, WebP or HEIC file NAME.EXT. Depth of an image is NAME_depth.png (16 bit), .npy, .tiff, ...,
            registered to its colours, and its mask, if there is one, NAME_mask.png. Or frames, such as of
            `Frame.from_arrays`.
        intrinsics: fx, fy, cx, cy of an image or of TUM RGB-D in pixels, or K as 3 x 3, with pixel centres at
            half-integers (0.5 more than OpenCV's cx and cy).
        depth: Depth file of an image, if it is named otherwise.
        depth_unit: World units per stored depth value; by default the format's own, and 0.001 of an image.
        mask: "given", "box" or "auto". By default "box" if there is a box, "given" if some frame has a mask, and
            "auto" otherwise.
        box: Bounding box (top, left, height, width) of the object in the first frame, pixels.
        label: Number of the object in masks that label several.
        orientation: "stored" or "displayed": how depth, mask and intrinsics refer to an image that its EXIF
            orientation turns, where their sizes do not tell. Frames are as displayed.
        object: Number of the object in a scene of BOP.

    Raises:
        InputError: The path is none of these, a file cannot be read, or an option is missing or does not fit.
    """
    layout, unit = _format(path), None
    options = {"intrinsics": intrinsics, "depth": depth, "depth_unit": depth_unit, "object": object}
    options |= {"label": label, "orientation": orientation}
    options = {name: value for name, value in options.items() if value is not None}
    if layout == "frames":
        frames = _check_frames([path] if isinstance(path, Frame) else path)
        path = frames[0].name or f"{len(frames)} frames"
    path = Path(path)
    for name in options:
        if name not in _TAKEN[layout]:
            raise InputError(f"--{name.replace('_', '-')} does not go with {path}, of the format {layout}")
    if mask not in (None, *(("box",) if box is not None else ("given", "auto"))):
        expected = "--mask given, --mask auto, or --mask box with --box TOP,LEFT,HEIGHT,WIDTH"
        raise InputError(f"{path}: mask is {mask!r} and box is {box}, expected {expected}")
    cameras, left_out = (), ()
    if layout == "frames":
        numbers, read = tuple(range(len(frames))), frames.__getitem__
        masked, doubts = [frame.mask is not None for frame in frames], question_intrinsics(frames[0].camera, str(path))
    elif layout == "sequence":
        folder = _sequence_folder(path)
        dataset = Co3D(folder.parents[1])
        every = dataset.frames(folder.parent.name, folder.name)
        if not (frames := [one for one in every if one.viewpoint is not None and one.depth is not None]):
            raise InputError(f"{path}: no frame has a camera and depth, expected some")
        numbers, read = tuple(one.frame_number for one in frames), lambda k: dataset.load(frames[k])
        masked, doubts = [one.mask is not None for one in frames], ()
    else:
        files = {name: options.pop(name) for name in ("label", "orientation") if name in options}
        if layout == "image":
            capture = [_open_image(path, **options)]
        else:
            _, capture, left_out = open_capture(path, **options)
        capture = [replace(frame, **files) for frame in capture]
        numbers, read, unit = tuple(range(len(capture))), lambda k: capture[k].load(), capture[0].depth_unit
        cameras = tuple(frame.camera for frame in capture)
        masked, doubts = [frame.has_mask for frame in capture], question_intrinsics(capture[0].camera, str(path))
    if mask is None:
        mask = "box" if box is not None else "given" if any(masked) else "auto"
    if mask == "given" and not any(masked):
        raise InputError(f"{path}: no mask, expected --mask auto or --box TOP,LEFT,HEIGHT,WIDTH")
    missing = tuple(number for number, has_mask in zip(numbers, masked) if not has_mask)
    return Source(path, layout, numbers, read, mask, box, cameras, tuple(left_out), missing, doubts, unit)


def open_pair(
    reference: _Object, target: _Object, options: Mapping[str, Sequence], helpers: Sequence[_Object] = ()
) -> list[Source]:
    """Open two sources and helpers with the options of a command line, by the names of arguments of `open_source`.

    An option has one value for each path that takes it (`depth`: each image), or one for all of them. There may be
    fewer values, for the reference and the target alone. A single `box` is for the first path whose `mask` is "box", if
    any, or the first of all. An open source takes none.
    """
    sides = reference, target, *helpers
    formats = [_format(side) for side in sides]
    given: list[dict] = [{} for _ in sides]
    for name, values in options.items():
        takers = [k for k, one in enumerate(formats) if name in _TAKEN[one]]
        pair = [k for k in takers if k < 2]
        counts = sorted({len(takers), len(pair), len(takers) if name == "depth" else min(len(takers), 1)})
        if values and len(values) not in counts:
            option, expected = f"--{name.replace('_', '-')}", " or ".join(map(str, counts))
            raise InputError(f"{option}: {len(values)} values with {' and '.join(formats)}, expected {expected}")
        if len(values) == 1 and name == "box":
            boxed = [k for k, way in enumerate(options.get("mask", ())) if way == "box" and k in takers]
            takers = (boxed or takers)[:1]
        for k, value in zip(takers, values if len(values) > 1 or name == "depth" else [*values] * len(takers)):
            given[k][name] = value
    return [_opened(side, **some) for side, some in zip(sides, given)]


def _opened(side: _Object, **options: Any) -> Source:
    return side if isinstance(side, Source) else open_source(side, **options)


def _check_frames(frames: Sequence[Frame]) -> list[Frame]:
    """Refuse what cannot be frames of one object in one world."""
    if not frames or not all(isinstance(frame, Frame) for frame in frames):
        raise InputError(f"frames are {reprlib.repr(frames)}, expected a sequence of zsp_lite.Frame")
    for number, frame in enumerate(frames):
        if frame.depth is None:
            raise InputError(f"frame {number} {frame.name} has no depth map, expected one")
    if len({frame.camera.matrix.tobytes() for frame in frames}) == 1 < len(frames):
        raise InputError(f"all {len(frames)} frames have the same camera pose, expected their poses in one world")
    return list(frames)


def _format(side: _Object) -> str:
    """Tell a "sequence" from an "image", from "frames", and from a capture, of which the format is returned."""
    if not isinstance(side, str | Path):
        return "open" if isinstance(side, Source) else "frames"
    path = Path(side)
    if path.is_file() and path.suffix.lower() in PICTURES:
        return "image"
    if _sequence_folder(path):
        return "sequence"
    return recognise(path, "a JPEG or PNG file, CATEGORY/SEQUENCE of a data folder, or ")[0]


def _sequence_folder(path: Path) -> Path | None:
    """Return the folder of a sequence in its data folder, also where the path is a link to it; None if it is none."""
    folders = Path(os.path.abspath(path)), path.resolve()  # absolute for the names of "." and of "mine/cup/.."
    return next((one for one in folders if one.is_dir() and (one.parent / FRAMES_FILE).is_file()), None)


def _open_image(
    path: Path, intrinsics: Values | None = None, depth: str | Path | None = None, depth_unit: float | None = None
) -> CaptureFrame:
    """Name the files and the camera of an image, whose world is its camera's frame."""
    if intrinsics is None:
        raise InputError(f"image {path}: no intrinsics, expected --intrinsics FX,FY,CX,CY in pixels")
    depth = _beside(path, "depth", DEPTHS) if depth is None else Path(depth)
    if depth is None:
        names = f"{path.stem}_depth.png or {path.stem}_depth.npy"
        raise InputError(f"image {path}: no {names} beside it, expected its depth there or as --depth FILE")
    if depth_unit is None:
        depth_unit = 1.0 if depth.name.endswith(CO3D_DEPTH) else 0.001
    rgb, orientation = read_picture(path)
    camera = camera_from_pose(np.eye(4), intrinsics, rgb.shape[:2], f"image {path}")
    stored, displayed = (np.linalg.norm(2 * camera.principal_point - side) for side in (camera.size[::-1], camera.size))
    if orientation > 4 and displayed < stored:  # the principal point is nearer to the middle of the displayed form
        camera = replace(camera, size=camera.size[::-1])
    return CaptureFrame(path, depth, camera, depth_unit, mask=_beside(path, "mask", MASKS), posed=False)


def _beside(path: Path, kind: str, suffixes: Sequence[str]) -> Path | None:
    """Find the file of a kind, such as NAME_depth.png, beside an image."""
    files = [path.with_name(f"{path.stem}_{kind}{suffix}") for suffix in suffixes]
    return next((file for file in files if file.is_file()), None)


def spread(count: int, length: int) -> list[int]:
    """Return at most `count` evenly spaced positions among `length`, which go once around an object."""
    return sorted({k * length // count for k in range(count)})


def spread_views(cameras: Sequence[Camera], count: int) -> list[int]:
    """Return the positions of at most `count` cameras, spread evenly over the directions from which they see an object.

    They are the first camera and others that lie as charges which repel each other.
    """
    if len(cameras) <= count:
        return list(range(len(cameras)))
    centres, axes = np.stack([one.centre for one in cameras]), np.stack([one.R[2] for one in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None]  # the point that is nearest to all optical axes is the object
    point = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centres), rcond=None)[0]
    directions = centres - point
    directions /= np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-9)
    order = [0, *(1 + np.lexsort(directions[1:].T.round(6)))]  # the same for every order of the other cameras
    gaps = directions[order][:, None] - directions[order]
    energy = 1 / (np.sum(gaps**2, axis=-1) + 1e-9)
    chosen = [0]
    for _ in range(_SWEEPS):
        for k in range(1, count):  # in the first sweep, they are added
            others = chosen[:k] + chosen[k + 1 :]
            chosen[k : k + 1] = [int(energy[others].sum(axis=0).argmin())]
    return sorted(int(order[k]) for k in chosen)


def _pair_flags(scans: Sequence[_Scan]) -> tuple[str, ...]:
    """Name two categories, and what is doubtful about the frames in use and the sides that they show."""
    kinds = sorted({one.source.path.resolve().parent.name for one in scans if one.source.format == "sequence"})
    flags = [f"the objects are of different categories: {', '.join(kinds)}"] if len(kinds) > 1 else []
    for scan in scans:
        flags += scan.source.flags([scan.frames[position] for position in scan.views])
    seen = [scan.seen for scan in scans[:2] if scan.targets]
    count, span = max(seen, key=lambda one: (one[1], one[0]))
    if count < 3 or span < _ALL_SIDES:
        sides = "two sides" if span >= _ALL_SIDES else "one side"
        what, other = ("the target was", "the reference") if len(seen) < 2 else ("each object was", "one")
        seen_from = f"seen from {sides} only ({span:.0f} degrees)"
        flags.append(f"{what} {seen_from}: if {other} was taken from another side, this pose is wrong")
    return tuple(flags)


def _in_units(
    estimate: PoseEstimate, reference_scale: float, target_scale: float, flags: tuple[str, ...]
) -> PoseEstimate:
    """Express an estimate on scaled frames in the lengths before scaling, and add flags, which limit its confidence."""

    def unscaled(sim3: Sim3) -> Sim3:
        return Sim3(sim3.scale * reference_scale / target_scale, sim3.R, sim3.t / target_scale)

    most = _MOST_DOUBTFUL if any(DOUBTFUL in flag for flag in flags) else 1.0
    reference, targets = estimate.reference_view, estimate.target_views
    return replace(
        estimate,
        flags=(*estimate.flags, *flags),
        sim3=unscaled(estimate.sim3),
        hypotheses=tuple(
            replace(one, sim3=unscaled(one.sim3), confidence=min(one.confidence, most)) for one in estimate.hypotheses
        ),
        reference_view=replace(reference, frame=scale_frame(reference.frame, 1 / reference_scale)),
        target_views=tuple(replace(one, frame=scale_frame(one.frame, 1 / target_scale)) for one in targets),
    )
