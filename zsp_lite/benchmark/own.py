"""Rows of one's own: which kind of row an object is, the problem that it gets, and poses that
another program computed."""

import ctypes
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import chdir, contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from inspect import Parameter
from typing import Any

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import SCALE_RANGE, ransac
from zsp_lite.baselines.sift import unproject_pixels
from zsp_lite.benchmark.problem import Answer, Crop, PairProblem, Problem, parameters, seeded
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.exchange import StoredPose, check_poses
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, describe_failure, ends_the_run, real_array
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.views import object_crop

# Functions of one, two and three arguments, and a solver.
KINDS = ("problem", "keypoints", "matcher", "solver")


def kind_of(name: str, thing: Any) -> str:
    """Return the kind of what a row was given: "estimator", which has `estimate`, or one of
    `KINDS`.

    An attribute `kind` names the kind of a function. Otherwise the number of arguments without a
    default tells it, `seed` and `threshold` not counted; of the functions of three arguments, a
    solver has both. InputError for any other thing.
    """
    if not isinstance(thing, type):
        if callable(getattr(thing, "estimate", None)):
            return "estimator"
        if getattr(thing, "kind", None) in KINDS:
            return thing.kind
        known = parameters(thing)
        positional = Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD
        needed = [
            argument
            for argument, parameter in known.items()
            if argument not in ("seed", "threshold")
            and parameter.default is Parameter.empty
            and parameter.kind in positional
        ]
        if len(needed) == 3 and known.keys() >= {"seed", "threshold"}:
            return "solver"
        if 1 <= len(needed) <= 3:
            return KINDS[len(needed) - 1]
    raise InputError(
        f"method {name!r} is of type {type(thing).__name__}, expected a function of one argument "
        "(problem), two (two images) or three (similarities, two foregrounds), a solver, or an "
        "object with estimate(reference, targets)"
    )


class OutOfTime(BaseException):
    """Raised in a row of one's own that takes too long; no Exception, since rows catch these."""


@contextmanager
def fails_alone(seconds: int) -> Iterator[None]:
    """Turn an error of the block into an InputError, and end a block that takes too long.

    Compiled code is not interrupted: the block ends when its call returns.
    """
    thread = ctypes.c_ulong(threading.get_ident())
    ended = threading.Lock()

    def watch() -> None:
        wait = seconds
        while not ended.acquire(timeout=wait):
            ctypes.pythonapi.PyThreadState_SetAsyncExc(thread, ctypes.py_object(OutOfTime))
            wait = 1  # second, for a block that has caught the exception and goes on

    ended.acquire()
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        try:
            with chdir("."):  # returns to the present folder, wherever the block goes
                yield
        finally:
            # Compiled: OutOfTime cannot be raised in it, only before it or after it.
            ended.release()
            watcher.join()  # an OutOfTime of the watcher is raised here at the latest
    except (InputError, KeyboardInterrupt):
        raise
    except OutOfTime as error:
        raise InputError(f"takes more than {seconds} s") from error
    except BaseException as error:
        raise InputError(describe_failure(error)) from error


def problem_of_own(solve: Any, problem: PairProblem) -> Problem:
    """Return the problem that a row of one's own gets: copies that do not lead to the data set and
    its labels. For stored poses, and for a matcher or solver inside the paper's method, which does
    not see the problem, it is `problem` itself."""
    if solve is None or isinstance(solve, StoredPoses):
        return problem
    if not isinstance(solve, Estimator | KeypointMatcher):
        return Problem(problem.seed, deepcopy(problem.crops), problem.store.extractors, {})
    with ends_the_run("reading frames"):
        reference, targets = problem.store.dataset.load_pair(problem.pair)
    # The frames get the names of the crops, which do not tell the object.
    frames = [
        replace(frame, name=crop.name)
        for frame, crop in zip([reference, *targets], problem.frames())
    ]
    if isinstance(solve, KeypointMatcher):
        frames = [object_crop(frame, size=None) for frame in frames]
    # Without extractors, and with timings of its own, which nobody reads.
    return Problem(problem.seed, [Crop(frame) for frame in frames], {}, {})


@dataclass(frozen=True)
class Estimator:
    """Row of an object with `estimate(reference, targets)`, which gets the whole frames."""

    own: Any

    def __call__(self, problem: Problem) -> Any:
        reference, *targets = problem.frames()
        own = self.own
        if isinstance(own, ZeroShotPose):
            own = replace(own, seed=problem.seed)
        return seeded(own.estimate, problem.seed)(reference, targets)


@dataclass(frozen=True)
class KeypointMatcher:
    """Row of a matcher of keypoints in two images, followed by RANSAC; docs/benchmark_your_own.md
    has its protocol."""

    own: Callable[[np.ndarray, np.ndarray], tuple[Any, Any, Any]]
    threshold: float = 0.2  # of RANSAC, the paper's

    def __call__(self, problem: Problem) -> Answer:
        reference, *targets = problem.frames()
        own = seeded(self.own, problem.seed)
        matches = []
        sums = []
        for target in targets:
            # A matcher may change its images, and the next target needs the reference again.
            first, second, scores = own(reference.rgb.copy(), target.rgb)
            first = _points_in(reference, first)
            second = _points_in(target, second, len(first))
            scores = real_array("scores of matches", scores)
            if not (scores >= 0).all():
                raise InputError("scores of matches are negative or NaN, expected 0 or more")
            sums.append(scores.sum())
            matches.append((first, second))
        view = int(np.argmax(sums))
        return fit_keypoints(problem, view, *matches[view], self.threshold)


def _points_in(crop: Frame, points: Any, count: int | None = None) -> Float[np.ndarray, "n 2"]:
    """Convert a matcher's points; InputError if one is not in the crop, or for another count."""
    points = real_array("matched points", points if len(points) else np.zeros((0, 2)), (count, 2))
    height, width = crop.camera.size
    inside = ((points >= 0) & (points <= (width, height))).all(axis=1)  # NaN is not
    if not inside.all():
        x, y = points[~inside][0]
        raise InputError(
            f"matched point ({x:g}, {y:g}) is outside the crop of {width} x {height} pixels"
        )
    return points


def fit_keypoints(
    problem: Problem,
    view: int,
    first: Float[np.ndarray, "n 2"],
    second: Float[np.ndarray, "n 2"],
    threshold: float = 0.2,
) -> Answer:
    """Fit the pose to matched pixels of the crops of the reference and of a target: unproject them,
    then RANSAC (sec. 4.3) with a `threshold`, by default the paper's."""
    reference, *targets = problem.frames(depth=True)
    try:
        points = unproject_pixels(reference, first), unproject_pixels(targets[view], second)
        sim3, inliers = ransac(
            *points, threshold=threshold, seed=problem.seed, scale_range=SCALE_RANGE
        )
    except InputError as error:
        return Answer(
            np.eye(3), view, note=f"pose is the best view's, not a fit: {error}", inliers=0
        )
    return Answer(sim3.R, view, sim3.t, sim3.scale, inliers=int(inliers.sum()))


@dataclass(frozen=True)
class StoredPoses:
    """Row of poses that another program computed (see `exchange`)."""

    path: str
    _poses: Mapping[
        str, StoredPose
    ]  # by the key of the pair; private, so that `described` leaves it out
    digest: str  # of the file

    def __call__(self, problem: PairProblem) -> Answer:
        pose = self._poses.get(problem.pair.key)
        if pose is None:
            raise InputError(f"{self.path} has no pose")
        view = problem.pair.target_frames.index(pose.target_frame)
        return Answer(pose.rotation, view, pose.translation, pose.scale)

    def remark(self, name: str, dataset: Co3D, work: Mapping[Pair, list[str]]) -> str:
        """Remark on the poses of the row's pairs (see `exchange.check_poses`); "" is no remark."""
        asked = [pair for pair, names in work.items() if name in names]
        remark = check_poses(self.path, self._poses, dataset, asked)
        return f"{name}: {remark}." if remark else ""
