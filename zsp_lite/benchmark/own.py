"""Methods of one's own: which kind of method an object is, and poses that another program computed."""

import inspect
import os
import pkgutil
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from zsp_lite.alignment import SCALE_RANGE, ransac
from zsp_lite.baselines.sift import unproject_pixels
from zsp_lite.benchmark.problem import Answer, Problem
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.exchange import StoredPose, check_poses
from zsp_lite.errors import FatalError, InputError, describe_failure, ends_the_run, real_array

KINDS = ("problem", "keypoints", "matcher")  # functions of one, two and three arguments


def kind_of(name: str, thing: Any) -> str:
    """Tell what the thing of a row is: "estimator" (has `estimate`), or the function of one of `KINDS`.

    The number of arguments without a default tells the kinds apart; an attribute `kind` of the thing comes before it.
    InputError if it is none of these.
    """
    if not isinstance(thing, type):
        if callable(getattr(thing, "estimate", None)):
            return "estimator"
        if (kind := getattr(thing, "kind", None)) in KINDS:
            return kind
        with suppress(TypeError, ValueError):  # no function, or one of a compiled module, which has no signature
            parameters = inspect.signature(getattr(thing, "forward", thing)).parameters.values()
            needed = [one for one in parameters if one.default is one.empty and one.kind is not one.VAR_KEYWORD]
            positional = all(one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD) for one in needed)
            if positional and len(needed) in (1, 2, 3):
                return KINDS[len(needed) - 1]
    raise InputError(
        f"method {name!r} is of type {type(thing).__name__}, expected a function of one argument (problem), two (two "
        "images) or three (similarities, two foregrounds), or an object with estimate(reference, targets)"
    )


def import_object(path: str) -> Any:
    """Import the object "module:name" from an installed module or a module in the current folder."""
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # the path of a console script lacks the current folder
    try:
        return pkgutil.resolve_name(path)
    except (Exception, SystemExit) as error:  # a module may raise anything
        raise InputError(f"{path!r} cannot be imported: {describe_failure(error)}") from error


@dataclass(frozen=True)
class Estimator:
    """Row of an object with `estimate(reference, targets)`, which gets the whole frames."""

    own: Any

    def __call__(self, problem: Problem) -> Any:
        with ends_the_run("reading frames"):
            frames = problem.store.dataset.load_pair(problem.pair)
        return self.own.estimate(*frames)


@dataclass(frozen=True)
class KeypointMatcher:
    """Row of a matcher of keypoints in two images, followed by RANSAC; docs/benchmark_your_own.md has its protocol."""

    own: Callable[[np.ndarray, np.ndarray], tuple[Any, Any, Any]]

    def __call__(self, problem: Problem) -> Answer:
        reference, *targets = problem.frames()
        found = [self.own(reference.rgb.copy(), target.rgb) for target in targets]
        scores = [real_array("scores of matches", score) for _, _, score in found]
        if any((one < 0).any() for one in scores):  # the view of the highest sum is chosen
            raise FatalError("scores of matches are negative, expected 0 or more")
        view = int(np.argmax([one.sum() for one in scores]))
        return fit_keypoints(problem, view, *found[view][:2])


def fit_keypoints(problem: Problem, view: int, first: Any, second: Any) -> Answer:
    """Fit the pose to matched pixels of the reference's crop and of a target's: depth, then RANSAC (sec. 4.3)."""
    reference, *targets = problem.frames(depth=True)
    first, second = (real_array("matched points", points).reshape(-1, 2) for points in (first, second))
    if len(first) != len(second):
        raise InputError(f"matched points are {len(first)} and {len(second)}, expected as many in both images")
    try:
        points = unproject_pixels(reference, first), unproject_pixels(targets[view], second)
        sim3, inliers = ransac(*points, seed=problem.seed, scale_range=SCALE_RANGE)
    except InputError as error:
        return Answer(np.eye(3), view, note=f"pose is the best view's, not a fit: {error}", inliers=0)
    return Answer(sim3.R, view, sim3.t, sim3.scale, inliers=int(inliers.sum()))


@dataclass(frozen=True)
class StoredPoses:
    """Row of poses that another program computed (see `exchange`)."""

    path: str
    _poses: Mapping[str, StoredPose]  # by the key of the pair
    digest: str  # of the file

    def __call__(self, problem: Problem) -> Answer:
        if (pose := self._poses.get(problem.pair.key)) is None:
            raise InputError(f"{self.path} has no pose")
        view = problem.pair.target_frames.index(pose.target_frame)
        return Answer(pose.rotation, view, pose.translation, pose.scale)

    def remark(self, dataset: Co3D, pairs: Sequence[Pair]) -> str:
        """Return what is to be said of the poses of pairs (see `exchange.check_poses`)."""
        return check_poses(self.path, self._poses, dataset, pairs)
