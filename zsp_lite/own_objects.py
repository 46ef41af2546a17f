"""One's own pair, from files or frames to files: open, load and mask, estimate, write.

A source is a sequence of a data folder, a folder with a capture, an image with depth, or frames in
memory.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import DEFAULT, BackboneLike, as_backbone
from zsp_lite.category import SAME_ANGLE, references_per_pair, synchronise, world_hypotheses
from zsp_lite.choices import SOLVERS
from zsp_lite.data.cameras import Values, view_span
from zsp_lite.data.frames import Frame, frame_defect, turn_frame
from zsp_lite.errors import InputError, NoPoseError, check_choice, check_integer
from zsp_lite.estimates import Hypothesis, PoseEstimate, timed
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.masks import DOUBTFUL
from zsp_lite.importers.sources import Source, SourceLike, open_pair
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import write_ply
from zsp_lite.metrics import rotation_angle, rotation_error
from zsp_lite.pair_result import PairResult, Vote, label_errors
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import axis_deviation, world_cloud
from zsp_lite.verified.confidence import reliability_flags
from zsp_lite.verified.solver import measured_inliers
from zsp_lite.views import View

_ALL_SIDES = 120.0  # target views that span less, in degrees, show one side of the object
_TARGETS = 5
_REFERENCES = 4  # frames of each object that are solved against views of the other
_MOST_DOUBTFUL = 0.8  # largest confidence by masks that are flagged
_LEAST_PROBABLE = 0.005  # an alternative is named above this
_Ends = tuple[int, int, int]  # numbers of two objects, and the position of a frame of the first


@dataclass(frozen=True, eq=False)
class _Scan:
    """The frames of a source that an estimate uses, whole and as views of an object of unit
    standard deviation."""

    source: Source
    references: list[
        int
    ]  # positions of the frames that are solved against target views of other objects
    targets: list[int]  # positions of the target views
    frames: dict[int, Frame]
    views: dict[int, View]
    scale: float  # from the lengths of the frames to those of the views
    cloud: Float[np.ndarray, "n 3"]

    @classmethod
    def of(
        cls,
        source: Source,
        method: ZeroShotPose,
        references: int,
        targets: int,
        first: int | None = None,
    ) -> "_Scan":
        """Load frames of a source (see `Source.select`), and extract their features."""
        chosen, shown, frames = source.select(references, targets, first)
        cloud = world_cloud([frames[position] for position in shown or chosen])[0]
        # The method expects objects of about unit standard deviation. Sequences of data folders
        # have it.
        scale = (
            1.0
            if source.format == "sequence" or not len(cloud)
            else 1 / (axis_deviation(cloud) or 1)
        )
        used = dict.fromkeys([*chosen, *shown])
        views = method.views([scale_frame(frames[position], scale) for position in used])
        return cls(source, chosen, shown, frames, dict(zip(used, views, strict=True)), scale, cloud)

    @property
    def target_views(self) -> list[View]:
        """The views that reference frames of other objects are solved against."""
        return [self.views[position] for position in self.targets]

    @property
    def seen(self) -> tuple[int, float]:
        """Number of usable target views, and the angle in degrees that they span around the
        object."""
        cameras = [self.frames[k].camera for k in self.targets if not frame_defect(self.frames[k])]
        return len(cameras), view_span(cameras, np.median(self.cloud, axis=0)) if len(
            self.cloud
        ) else 0.0


def estimate_pose(
    reference: SourceLike,
    target: SourceLike,
    solver: str = "verified",
    reference_frame: int | None = None,
    targets: int | None = None,
    mask: str | None = None,
    intrinsics: Values | None = None,
    backbone: BackboneLike = DEFAULT,
    out: str | Path | None = None,
    upright: bool = True,
    references: int | None = None,
    helpers: Sequence[SourceLike] = (),
    workers: int = 1,
) -> PairResult:
    """Estimate the pose between two objects of one category, given as paths or frames; no label is
    needed.

    The paper takes one frame of the reference. The verified solver takes several, and where the
    target has several frames, these against views of the reference, too: the pose is what most
    frames agree on (see `category`). `open_source` explains the paths, and takes the settings that
    only one of the two has, such as a box around the object. Flags name implausible lengths,
    doubtful masks, objects seen from one side only, frames that disagree, and two categories.

    Args:
        reference: The reference object.
        target: The target object. The frames of one object are in one world.
        solver: "verified", "paper" or "both".
        reference_frame: Frame number of the reference, in whose camera the pose is; by default its
            first frame with known depth and an object.
        targets: Number of target views, evenly spaced over the target's frames; 5 by default, or as
            many as there are.
        mask: Where the masks of all come from: "given", "auto", or as `open_source` decides.
        intrinsics: Camera intrinsics of all images (see `open_source`).
        backbone: Backbone, or what `load_backbone` takes.
        out: Folder for the report and the point clouds (see `write_pair`); None writes nothing.
        upright: Whether the reference images are upright; False tries four turns by 90 degrees,
            since phones may store images turned, and keeps the best. The pose is then that of the
            turned image, and a flag says so.
        references: Number of reference frames of each object, evenly spaced; 1 is the paper's
            setting. By default 4, or 1 with a `reference_frame`, or more with helpers (see
            `category.references_per_pair`).
        helpers: Other objects of the category: what two objects cannot tell, all together mostly
            can.
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
    given = {
        name: (one,)
        for name, one in (("mask", mask), ("intrinsics", intrinsics))
        if one is not None
    }
    with (
        nullcontext() if out is None else writing(out)
    ):  # a folder that cannot be written is an error at once
        sources = open_pair(reference, target, given, helpers)
        if helpers and len({one.path.resolve() for one in sources}) < len(sources):
            raise InputError(
                f"{', '.join(str(one.path) for one in sources)}: expected different objects"
            )
        model = as_backbone(backbone)
        foreground = "saliency" if getattr(model, "has_saliency", True) else "mask"
        method = ZeroShotPose(model, foreground=foreground, solver="verified")
        counts = (references, targets) if several else (1, 0)
        before: dict[str, float] = {}
        with timed(before, "features"):
            scans = [_Scan.of(sources[0], method, *counts, reference_frame)]
            scans += [
                _Scan.of(one, method, references if several else 0, targets) for one in sources[1:]
            ]
        flags = _pair_flags(scans)
        if wanted and wanted > len(scans[1].targets):
            flags = (
                *flags,
                f"number of target views: {len(scans[1].targets)}, all that there are, not "
                f"{wanted}",
            )
        if not upright:
            with timed(before, "turns"):
                scans[0], turn = _stood_up(*scans[:2], replace(method, solver=SOLVERS[solver][-1]))
            flags = (
                *flags,
                f"the reference is turned by {turn}° counterclockwise: the pose is that of "
                "the turned image",
            )
        first, second, position = *scans[:2], scans[0].references[0]
        views = first.views[position], second.target_views
        solved = {
            name: replace(method, solver=name).estimate_from_views(*views)
            for name in SOLVERS[solver]
        }
        votes = ()
        if several:
            timings = dict(solved["verified"].timings)
            with timed(timings, "other frames"):
                found = {
                    (0, 1, position): solved["verified"],
                    **_solve_others(scans, method, workers),
                }
                agreed, votes = _agreed_pose(scans, method, found)
            solved["verified"] = replace(agreed, timings=timings)
        estimates = {
            name: _in_units(
                replace(one, timings=before | one.timings), first.scale, second.scale, flags
            )
            for name, one in solved.items()
        }
        where = first.source.describe(first.references), second.source.describe(second.targets)
        if helpers:
            where = (
                where[0],
                f"{where[1]}; helpers: {', '.join(str(one.path) for one in sources[2:])}",
            )
        result = PairResult(
            f"{sources[0].name} to {sources[1].name}",
            where,
            first.frames[position],
            tuple(second.frames[k] for k in second.targets),
            estimates,
            {},
            masks=(sources[0].mask, sources[1].mask),
            backbone=getattr(model, "name", str(backbone)),
            votes=votes,
        )
        one, other = (source.path.resolve() for source in sources[:2])
        if first.source.format == second.source.format == "sequence" and one.parent == other.parent:
            result = replace(
                result, errors=label_errors(result, one.parent, (one.name, other.name))
            )
        if out is not None:
            write_pair(result, out)
    return result


def _stood_up(scan: _Scan, target: _Scan, method: ZeroShotPose) -> tuple[_Scan, int]:
    """Turn the frames of a scan by the quarter turns that suit its first reference frame best;
    return the degrees."""
    scores, position = {}, scan.references[0]
    for quarters in range(4):
        (view,) = method.views(
            [turn_frame(scale_frame(scan.frames[position], scan.scale), quarters)]
        )
        with suppress(NoPoseError):
            one = method.estimate_from_views(view, target.target_views)
            scores[quarters] = (
                one.hypotheses[0].score if one.hypotheses else one.view_scores[one.view]
            )
    quarters = max(scores, key=scores.get, default=0)
    frames = {key: turn_frame(frame, quarters) for key, frame in scan.frames.items()}
    views = method.views([scale_frame(frames[key], scan.scale) for key in scan.views])
    return replace(
        scan, frames=frames, views=dict(zip(scan.views, views, strict=True))
    ), 90 * quarters


def _solve_others(
    scans: Sequence[_Scan], method: ZeroShotPose, workers: int
) -> dict[_Ends, PoseEstimate]:
    """Solve every reference frame of each object against the views of each other one, but for the
    first of all."""
    ends = [
        (a, b, position)
        for a, b in permutations(range(len(scans)), 2)
        for position in scans[a].references
    ]

    def solve(a: int, b: int, position: int) -> PoseEstimate | None:
        with suppress(NoPoseError):
            return method.estimate_from_views(scans[a].views[position], scans[b].target_views)

    with ThreadPoolExecutor(workers) as pool:
        solved = list(
            tqdm(
                pool.map(solve, *zip(*ends[1:])),
                total=len(ends) - 1,
                unit="frame",
                delay=1,
                disable=None,
            )
        )
    return {end: one for end, one in zip(ends[1:], solved, strict=True) if one}


def _agreed_pose(
    scans: Sequence[_Scan], method: ZeroShotPose, found: Mapping[_Ends, PoseEstimate]
) -> tuple[PoseEstimate, tuple[Vote, ...]]:
    """Find the pose that the hypotheses of all frames agree on, in the first frame's camera, and
    their votes."""
    names = [f"{k} {scan.source.name}" for k, scan in enumerate(scans)]
    agreement = synchronise(
        [world_hypotheses(names[a], names[b], one) for (a, b, _), one in found.items()]
    )
    one, other = (agreement.objects[name] for name in names[:2])
    answers = [(agreement.between(*names[:2]), min(one.probability, other.probability))]
    if other.alternative and other.alternative_probability > _LEAST_PROBABLE:
        answers.append((other.alternative.inverse() @ one.sim3, other.alternative_probability))
    votes = []
    for (a, b, position), estimate in found.items():
        if max(a, b) < 2:
            name = f"frame {scans[a].source.numbers[position]} of {scans[a].source.name}"
            degrees = float(
                rotation_error(estimate.world_sim3.R, agreement.between(names[a], names[b]).R)
            )
            votes.append(
                Vote(name, _in_units(estimate, scans[a].scale, scans[b].scale, ()), degrees, a > b)
            )
    against = [vote.name for vote in votes if vote.degrees > SAME_ANGLE]
    flags = (
        [f"{len(against)} of {len(votes)} frames vote for another pose: {', '.join(against)}"]
        if against
        else []
    )
    return _answer(next(iter(found.values())), method, answers, flags), tuple(votes)


def _answer(
    estimate: PoseEstimate,
    method: ZeroShotPose,
    answers: Sequence[tuple[Sim3, float]],
    flags: Sequence[str],
) -> PoseEstimate:
    """Replace the hypotheses of an estimate by similarities between the worlds, each with its
    probability."""
    reference, targets = estimate.reference_view, estimate.target_views
    to_reference, *to_targets = (
        Sim3(1.0, one.frame.camera.R, one.frame.camera.t) for one in (reference, *targets)
    )
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
        estimate,
        sim3=poses[view],
        view=view,
        matches=matched.matches,
        view_scores=-angles,
        inliers=measured_inliers(
            reference, targets[view], matched.matches, poses[view], method.threshold
        ),
        hypotheses=tuple(hypotheses),
        one_of_two=one_of_two,
        flags=(*doubts, *flags, *kept),
    )


def write_pair(result: PairResult, out: str | Path) -> list[Path]:
    """Write the report and the point clouds of a result of `estimate_pose` to a folder, and return
    the paths.

    They are `report.html`; `target.ply`, the points of the target object in all its views; and for
    each solver `aligned_SOLVER.ply`, the points of the reference object after the pose, and
    `aligned_SOLVER_2.ply`, after the first alternative, where the answer is one of two. The clouds
    are in the world of the target views, which for an image is its camera's frame. Files of these
    names that an earlier run left are removed.
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
            write_ply(
                paths[-1],
                result.targets[pose.view].camera.to_world(pose.sim3.apply(points)),
                colours,
            )
    return [write_pair_report(out / "report.html", result), *paths]


def _pair_flags(scans: Sequence[_Scan]) -> tuple[str, ...]:
    """Name two categories, and what is doubtful about the frames in use and the sides that they
    show."""
    kinds = sorted(
        {one.source.path.resolve().parent.name for one in scans if one.source.format == "sequence"}
    )
    flags = (
        [f"the objects are of different categories: {', '.join(kinds)}"] if len(kinds) > 1 else []
    )
    for scan in scans:
        found = scan.source.flags([scan.frames[position] for position in scan.views])
        flags += [f"{scan.source.path}: {flag}" for flag in found]
    seen = [scan.seen for scan in scans[:2] if scan.targets]
    count, span = max(seen, key=lambda one: (one[1], one[0]))
    if count < 3 or span < _ALL_SIDES:
        sides = "two sides" if span >= _ALL_SIDES else "one side"
        what, other = (
            ("the target was", "the reference") if len(seen) < 2 else ("each object was", "one")
        )
        seen_from = f"seen from {sides} only ({span:.0f} degrees)"
        flags.append(
            f"{what} {seen_from}: if {other} was taken from another side, this pose is wrong"
        )
    return tuple(flags)


def _in_units(
    estimate: PoseEstimate, reference_scale: float, target_scale: float, flags: tuple[str, ...]
) -> PoseEstimate:
    """Express an estimate on scaled frames in the lengths before scaling, and add flags, which
    limit its confidence."""

    def unscaled(sim3: Sim3) -> Sim3:
        return Sim3(sim3.scale * reference_scale / target_scale, sim3.R, sim3.t / target_scale)

    most = _MOST_DOUBTFUL if any(DOUBTFUL in flag for flag in flags) else 1.0
    reference, targets = estimate.reference_view, estimate.target_views
    return replace(
        estimate,
        flags=(*estimate.flags, *flags),
        sim3=unscaled(estimate.sim3),
        hypotheses=tuple(
            replace(one, sim3=unscaled(one.sim3), confidence=min(one.confidence, most))
            for one in estimate.hypotheses
        ),
        reference_view=replace(reference, frame=scale_frame(reference.frame, 1 / reference_scale)),
        target_views=tuple(
            replace(one, frame=scale_frame(one.frame, 1 / target_scale)) for one in targets
        ),
    )
