"""One's own pair, from files or frames to files: open, load (see `scan`), estimate, write.

A source is a sequence of a data folder, a folder with a capture, an image with depth, or frames in
memory.

The way of a pair: `estimate_pose` opens the sources and loads a `Scan` of each. One reference frame
is solved by `ZeroShotPose`. Several frames are solved in `_by_all`: `judge.judge_pairs` asks them,
and `_answer` makes an estimate of the pose that they tell. `_pair_result` collects all,
`write_pair` writes it.
"""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import DEFAULT
from zsp_lite.backbones.named import BackboneLike, as_backbone
from zsp_lite.choices import SOLVERS
from zsp_lite.data.cameras import Values
from zsp_lite.errors import NoPoseError, check_choice, check_integer
from zsp_lite.estimates import Hypothesis, PoseEstimate, timed
from zsp_lite.importers.sources import SourceLike, list_sources, open_pair
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import write_ply
from zsp_lite.matching import Matches
from zsp_lite.metrics import SAME_ANGLE, rotation_angle, rotation_error, vector_angle
from zsp_lite.objects.scan import Scan, scan_flags, stood_up
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import world_cloud
from zsp_lite.scans.category import PairHypotheses, synchronise, world_hypotheses
from zsp_lite.scans.judge import REFERENCES, Question, judge_pairs
from zsp_lite.scans.pair_result import PairResult, Vote, label_errors
from zsp_lite.verified.confidence import reliability_flags
from zsp_lite.verified.solver import measured_inliers
from zsp_lite.views import usable_targets

_TARGETS = 5  # target views by default, as in the paper
# What follows is chosen, not fitted.
_LEAST_CONFIDENT = 0.3  # with less, a flag says that the images may be turned
_LEAST_PROBABLE = 0.005  # an alternative is named above this, where two decimals show 0.01
_TILTED = 45.0  # degrees between two verticals from which objects lie differently


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
    helpers: Iterable[SourceLike] = (),
    workers: int = 1,
    report: bool = True,
    options: Mapping[str, Sequence[Any]] = {},
) -> PairResult:
    """Estimate the pose between two objects of one category, given as paths or frames; no label is
    needed.

    The paper takes one frame of the reference. The verified solver takes several frames of both:
    the pose is what their votes, both shapes and the vertical tell together (see `judge`).
    `open_source` explains the paths, and takes the settings that only one of the two has, such as a
    box around the object. Flags name implausible lengths, doubtful masks, objects seen from one
    side only, frames that disagree, and two categories.

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
        references: Largest number of frames of each object that are solved against views of the
            other: two first, more only if these leave doubt; 1 is the paper's setting. By default
            4, at most `targets`; 1 with a `reference_frame` and no helpers.
        helpers: Other objects of the category: what two objects cannot tell, all together mostly
            can.
        workers: Number of frames that are solved at once, by threads.
        report: Whether `out` gets the report beside the point clouds.
        options: Options of `open_source` by name, each with its values (see `open_pair`).

    Raises:
        InputError: An input or an option is missing or wrong, or the pose cannot be estimated.
    """
    helpers = list_sources(helpers)
    check_choice("solver", solver, SOLVERS)
    solvers = SOLVERS[solver]
    n_targets = _TARGETS if targets is None else targets
    check_integer("targets", n_targets, 1)
    check_integer("workers", workers, 1)
    if references is None:
        single = reference_frame is not None and not helpers
        references = 1 if single else min(REFERENCES, n_targets)
    check_integer("references", references, 1)
    several = "verified" in solvers and (references > 1 or bool(helpers))

    # A folder that cannot be written is an error at once.
    with nullcontext() if out is None else writing(out):
        for name, value in (("mask", mask), ("intrinsics", intrinsics)):
            if value is not None:
                options = {**options, name: (value,)}
        sources = open_pair(reference, target, options, helpers)
        model = as_backbone(backbone)
        foreground = "saliency" if getattr(model, "has_saliency", True) else "mask"
        # The last solver finds turns and votes: of "both" it is the verified one.
        method = ZeroShotPose(model, foreground=foreground, solver=solvers[-1])

        # The frames of all objects. Only where frames vote, the reference also has target views,
        # and the other objects have reference frames.
        counts = (references, n_targets) if several else (1, 0)
        other_counts = (references if several else 0, n_targets)
        shared: dict[str, float] = {}  # seconds of the stages that all solvers share
        with timed(shared, "features"):
            scans = [Scan.of(sources[0], method, *counts, reference_frame)]
            scans += [Scan.of(source, method, *other_counts) for source in sources[1:]]
        flags = scan_flags(scans)
        available = len(scans[1].targets)
        if targets and targets > available:
            flags = (
                *flags,
                f"number of target views: {available}, all that there are, not {targets}",
            )
        if not upright:
            with timed(shared, "turns"):
                scans[0], turn = stood_up(scans[0], scans[1], method)
            turned = f"the reference is turned by {turn}° counterclockwise"
            flags = (*flags, f"{turned}: the pose is that of the turned image")

        # The pose.
        first = scans[0].references[0]
        estimates = {
            name: replace(method, solver=name).estimate_from_views(
                scans[0].views[first], scans[1].target_views
            )
            for name in solvers
            if name == "paper" or not several
        }
        votes = ()
        if several:
            estimates["verified"], votes = _by_all(scans, method, workers, flags)
        for name, estimate in estimates.items():
            notes = flags
            if upright and estimate.hypotheses and estimate.confidence < _LEAST_CONFIDENT:
                notes = (*flags, "low confidence: --not-upright helps if images are turned")
            estimate = replace(estimate, timings=shared | estimate.timings)
            estimates[name] = _flagged(estimate, notes)
        result = _pair_result(scans, estimates, votes, getattr(model, "name", str(backbone)))
        if out is not None:
            result = replace(result, files=tuple(write_pair(result, out, report)))
    return result


def _pair_result(
    scans: Sequence[Scan],
    estimates: dict[str, PoseEstimate],
    votes: tuple[Vote, ...],
    backbone: str,
) -> PairResult:
    """Collect the result, with its errors if both objects are labelled sequences of one folder."""
    first, second, *helpers = scans
    shown = second.source.describe(second.targets, second.frames)
    if helpers:
        shown += f"; helpers: {', '.join(str(helper.source.path) for helper in helpers)}"
    result = PairResult(
        f"{first.source.name} to {second.source.name}",
        (first.source.describe(first.references, first.frames), shown),
        first.frames[first.references[0]],
        tuple(second.frames[position] for position in second.targets),
        estimates,
        errors={},
        masks=(first.source.mask, second.source.mask),
        backbone=backbone,
        votes=votes,
        frames={first.source.numbers[k]: frame for k, frame in first.frames.items()},
        views=([*first.views.values()], [*second.views.values()]),
    )
    path = first.source.path.resolve()
    target_path = second.source.path.resolve()
    sequences = first.source.format == second.source.format == "sequence"
    if sequences and path.parent == target_path.parent:
        errors = label_errors(result, path.parent, (path.name, target_path.name))
        result = replace(result, errors=errors)
    return result


def _by_all(
    scans: Sequence[Scan], method: ZeroShotPose, workers: int, scan_doubts: tuple[str, ...]
) -> tuple[PoseEstimate, tuple[Vote, ...]]:
    """Estimate the pose by all frames of all objects, in the camera of the first reference frame,
    and return the votes of the two objects' frames."""
    timings: dict[str, float] = {}
    names = [f"{k} {scan.source.name}" for k, scan in enumerate(scans)]
    of_name = dict(zip(names, scans))
    estimates: dict[Question, PoseEstimate] = {}
    matches: dict[Question, list[Matches]] = {}  # with each target view
    problems: list[NoPoseError] = []

    def solve(question: Question) -> PairHypotheses | None:
        scan = of_name[question.reference]
        view = scan.views[scan.references[question.rank]]
        targets = of_name[question.target].target_views
        try:
            matched = method.match_views(view, targets)
            # Also where the views determine no pose: the answer shows those of its frame.
            matches[question] = [one.matches for one in matched]
            found = method.estimate_from_views(view, targets, matched)
        except NoPoseError as error:
            problems.append(error)
            return None
        estimates[question] = found
        return world_hypotheses(question.reference, question.target, found)

    def ask(questions: list[Question]) -> list[PairHypotheses | None]:
        with ThreadPoolExecutor(workers) as pool:
            answers = pool.map(solve, questions)
            # `disable=None` shows the bar in a terminal only.
            bar = tqdm(answers, total=len(questions), unit="frame", delay=1, disable=None)
            return list(bar)

    with timed(timings, "frames"):
        shapes = {}
        flags = []
        for name, scan in of_name.items():
            shapes[name], problem = scan.shape()
            if problem:
                flags.append(f"{scan.source.path}: {problem}")
        counts = {name: len(scan.references) for name, scan in of_name.items()}
        judged = judge_pairs(shapes, counts, ask, list(combinations(names, 2)))
    if not judged:
        raise problems[0]

    # The answers: poses between the worlds of the two objects, with their probabilities.
    if len(scans) == 2:
        answers = list(zip(judged[0].sim3s, judged[0].probabilities.tolist()))
    else:
        agreement = synchronise(judged)
        reference, target = (agreement.objects[name] for name in names[:2])
        probability = min(reference.probability, target.probability)
        answers = [(agreement.between(*names[:2]), probability)]
        if target.alternative:
            other = target.alternative.inverse() @ reference.sim3
            answers.append((other, target.alternative_probability))
    best = answers[0][0]
    answers = [answers[0], *(one for one in answers[1:] if one[1] > _LEAST_PROBABLE)]

    # The votes of the frames of the two objects, not of helpers.
    votes = []
    for question in sorted(estimates):  # by the names of the objects, which begin with a number
        estimate = estimates[question]
        if {question.reference, question.target} == {*names[:2]}:
            backward = question.reference == names[1]
            scan = of_name[question.reference]
            number = scan.source.numbers[scan.references[question.rank]]
            name = f"frame {number} of {scan.source.name}"
            agreed = best.R.T if backward else best.R
            degrees = float(rotation_error(estimate.world_sim3.R, agreed))
            votes.append(Vote(name, _flagged(estimate, scan_doubts), degrees, backward))
    flags += dissent(votes)
    first, second = (shapes[name] for name in names[:2])
    if first.upright and second.upright:
        # The last row of a shape's rotation is up in its world.
        up = best.R @ first.from_world.R[2]
        tilt = vector_angle(up, second.from_world.R[2])
        if tilt > _TILTED:
            flags.append(
                f"the objects lie differently: their verticals are {tilt:.0f} degrees apart"
            )
    asked = Question(names[0], 0, names[1])
    answer = _answer(scans, method, answers, matches[asked], flags)
    return replace(answer, timings=timings), tuple(votes)


def dissent(votes: Sequence[Vote]) -> list[str]:
    """Name the frames that vote for another pose."""
    against = [vote.name for vote in votes if vote.degrees > SAME_ANGLE]
    if not against:
        return []
    named = ", ".join(against)
    return [f"{len(against)} of {len(votes)} frames vote for another pose: {named}"]


def _answer(
    scans: Sequence[Scan],
    method: ZeroShotPose,
    answers: Sequence[tuple[Sim3, float]],
    matches: Sequence[Matches],
    flags: Sequence[str],
) -> PoseEstimate:
    """Make an estimate of the first reference frame from similarities between the worlds, each with
    its probability, and its matches with the target views."""
    reference = scans[0].views[scans[0].references[0]]
    targets = scans[1].target_views
    usable, views_left_out = usable_targets(targets)
    penalty = np.full(len(targets), np.inf)  # of the views that are left out
    penalty[usable] = 0.0
    to_reference, *to_targets = [view.frame.camera.sim3 for view in (reference, *targets)]
    # Each answer becomes a hypothesis in the usable target view that is nearest to the reference.
    hypotheses = []
    view_angles = []  # of each hypothesis, in degrees by target view
    for mode, (sim3, probability) in enumerate(answers):
        poses = [camera @ sim3 @ to_reference.inverse() for camera in to_targets]
        angles = rotation_angle(np.stack([pose.R for pose in poses]), np.eye(3)) + penalty
        nearest = int(angles.argmin())
        score = float(np.log(max(probability, 1e-9)))  # finite for a probability of 0
        # The score has no terms: these are of a solver's score.
        hypotheses.append(Hypothesis(poses[nearest], nearest, score, {}, probability, mode))
        view_angles.append(angles)

    # The first is the pose of the estimate.
    best = hypotheses[0]
    target = targets[best.view]
    found = matches[best.view]
    threshold = method.threshold * target.size
    turns = np.stack([sim3.R for sim3, _ in answers])
    between = rotation_angle(turns[:, None], turns)
    doubts, one_of_two = reliability_flags(hypotheses, between)
    return PoseEstimate(
        best.sim3,
        best.view,
        found,
        measured_inliers(reference, target, found, best.sim3, threshold),
        -view_angles[0],
        reference,
        tuple(targets),
        flags=(*doubts, *flags, *views_left_out),
        hypotheses=tuple(hypotheses),
        one_of_two=one_of_two,
    )


def write_pair(result: PairResult, out: str | Path, report: bool = True) -> list[Path]:
    """Write the report and the point clouds of a result of `estimate_pose` to a folder, and return
    the paths.

    They are `report.html`, unless `report` is false; `target.ply`, the points of the target object
    in all its views; and for each solver `aligned_SOLVER.ply`, the points of the reference object
    after the pose, and `aligned_SOLVER_2.ply`, after the first alternative, where the answer is one
    of two. The clouds are in the world of the target views, which for an image is its camera's
    frame. Files of these names that an earlier run left are removed.
    """
    out = Path(out)
    for solver in SOLVERS["both"]:
        for name in ("report.html", f"aligned_{solver}.ply", f"aligned_{solver}_2.ply"):
            (out / name).unlink(missing_ok=True)
    paths = [out / "target.ply"]
    write_ply(paths[0], *world_cloud(result.targets))
    points, colours = world_cloud([result.reference])
    points = result.reference.camera.to_camera(points)
    for solver, estimate in result.estimates.items():
        poses = [estimate, *estimate.alternatives[:1]] if estimate.one_of_two else [estimate]
        for name, pose in zip((f"aligned_{solver}.ply", f"aligned_{solver}_2.ply"), poses):
            paths.append(out / name)
            moved = pose.sim3.apply(points)
            write_ply(paths[-1], result.targets[pose.view].camera.to_world(moved), colours)
    if report:
        # Imported here: it takes matplotlib and plotly, which nothing else here needs.
        from zsp_lite.viz.report import write_pair_report

        paths.insert(0, write_pair_report(out / "report.html", result))
    return paths


def _flagged(estimate: PoseEstimate, flags: tuple[str, ...]) -> PoseEstimate:
    """Add flags to an estimate; doubts limit its confidence."""
    most = min([getattr(flag, "most", 1.0) for flag in flags], default=1.0)
    factor = min(1.0, most / (estimate.confidence or 1.0))
    return replace(
        estimate,
        flags=(*estimate.flags, *flags),
        hypotheses=tuple(
            replace(hypothesis, confidence=factor * hypothesis.confidence)
            for hypothesis in estimate.hypotheses
        ),
    )
