"""Methods of one's own: which kind of method an object is, and poses that another program computed."""

import inspect
import io
import os
import pkgutil
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from zsp_lite.alignment import SCALE_RANGE, ransac
from zsp_lite.baselines.sift import unproject_pixels
from zsp_lite.benchmark.identity import digest
from zsp_lite.benchmark.problem import Answer, Problem, as_answer
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.errors import FatalError, InputError, real_array
from zsp_lite.io.files import read_bytes, write_atomic

KINDS = ("problem", "keypoints", "matcher")  # functions of one, two and three arguments
_QUESTION = ("category", "reference_sequence", "reference_frame", "target_sequence", "target_frame")
_POSE = {"rotation": 9, "translation": 3, "scale": 1}  # how many numbers


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
            if all(one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD) for one in needed):
                return KINDS[range(1, 4).index(len(needed))]
    raise InputError(
        f"method {name!r} is of type {type(thing).__name__}, expected a function of one argument (problem), two (two "
        "images) or three (similarities, two foregrounds), or an object with estimate(reference, targets)"
    )


def describe_failure(error: BaseException) -> str:
    """Describe an exception of somebody else's code in one line: where it was raised, its type and its message."""
    *_, last = traceback.extract_tb(error.__traceback__)
    return " ".join(f"{last.filename}, line {last.lineno}: {type(error).__name__}: {error}".split())


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
        return self.own.estimate(*problem.store.dataset.load_pair(problem.pair))


@dataclass(frozen=True)
class KeypointMatcher:
    """Row of a matcher of keypoints in two images, followed by RANSAC; docs/benchmark_your_own.md has its protocol."""

    own: Callable[[np.ndarray, np.ndarray], tuple[Any, Any, Any]]

    def __call__(self, problem: Problem) -> Answer:
        reference, *targets = problem.frames()
        found = [self.own(reference.rgb, target.rgb) for target in targets]
        scores = [real_array("scores of matches", score) for _, _, score in found]
        if any((one < 0).any() for one in scores):  # the view of the highest sum is chosen
            raise FatalError("scores of matches are negative, expected 0 or more")
        view = int(np.argmax([one.sum() for one in scores]))
        return fit_keypoints(problem, view, *found[view][:2])


def fit_keypoints(problem: Problem, view: int, first: Any, second: Any) -> Answer:
    """Fit the pose to matched pixels of the reference's crop and of a target's: depth, then RANSAC (sec. 4.3)."""
    reference, *targets = problem.frames(depth=True)
    first, second = (real_array("matched points", points).reshape(-1, 2) for points in (first, second))
    try:
        points = unproject_pixels(reference, first), unproject_pixels(targets[view], second)
        sim3, inliers = ransac(*points, seed=problem.seed, scale_range=SCALE_RANGE)
    except InputError as error:
        return Answer(np.eye(3), view, note=f"pose is the best view's, not a fit: {error}", inliers=0)
    return Answer(sim3.R, view, sim3.t, sim3.scale, inliers=int(inliers.sum()))


@dataclass(frozen=True)
class StoredPoses:
    """Row of poses that another program computed, by category, sequences and frames."""

    path: str
    digest: str  # of the file
    _poses: Mapping[tuple, Answer]

    def __call__(self, problem: Problem) -> Answer:
        pair, found = problem.pair, self.of(problem.pair)
        if not found:
            raise InputError(f"{self.path} has no pose")
        if len(found) > 1:
            raise FatalError(f"{self.path} has {len(found)} poses of the pair {pair.key}, expected one")
        return found[0]

    def of(self, pair: Pair) -> list[Answer]:
        """Look up the poses of a pair."""
        key = pair.category, pair.reference_sequence, pair.reference_frame, pair.target_sequence
        found = [(view, self._poses.get((*key, frame))) for view, frame in enumerate(pair.target_frames)]
        return [replace(answer, view=view) for view, answer in found if answer]


def read_poses(path: str | Path) -> StoredPoses:
    """Read a CSV file of poses, with a line for each pair; docs/benchmark_your_own.md has its columns."""
    data, poses = read_bytes(path, "poses"), {}
    try:
        lines = pd.read_csv(io.BytesIO(data), dtype=str, keep_default_na=False, index_col=False).fillna("")
    except ValueError as error:
        raise InputError(f"poses {path}: {error}, expected a CSV file") from error
    if missing := [name for name in (*_QUESTION, "rotation") if name not in lines]:
        raise InputError(f"poses {path}: no column {', '.join(missing)}")
    for number, line in enumerate(lines.to_dict("records"), 2):
        try:
            rotation, translation, scale = (_numbers(name, line.get(name, ""), size) for name, size in _POSE.items())
            key = tuple(int(line[name]) if name.endswith("frame") else line[name] for name in _QUESTION)
            if key in poses:
                raise ValueError("second pose of the same frames")
            poses[key] = as_answer(Answer(rotation.reshape(3, 3), 0, translation, None if scale is None else scale[0]))
        except ValueError as error:  # an InputError is one, too
            raise InputError(f"poses {path}, line {number}: {error}") from error
    return StoredPoses(str(path), digest(data), poses)


def _numbers(name: str, text: str, size: int) -> np.ndarray | None:
    """Read the numbers of a column; None where it is empty."""
    if not text and name != "rotation":
        return None
    values = np.array([float(part) for part in text.split()])
    if len(values) != size or not np.isfinite(values).all():
        raise ValueError(f"{name} is {text!r}, expected {size} numbers separated by spaces")
    return values


def write_questions(path: str | Path, dataset: Co3D, pairs: Sequence[Pair]) -> Path:
    """Write pairs as a CSV file for another program; docs/benchmark_your_own.md has its columns."""
    lines = []
    for number, pair in enumerate(pairs):
        targets = [("target", pair.target_sequence, frame) for frame in pair.target_frames]
        for role, sequence, frame in [("reference", pair.reference_sequence, pair.reference_frame), *targets]:
            found = dataset.frame(pair.category, sequence, frame)
            camera, depth, mask = dataset.camera(found), found.depth, found.mask
            (fx, fy), (cx, cy) = camera.focal_length.tolist(), camera.principal_point.tolist()
            R, t = (" ".join(map(repr, part.ravel().tolist())) for part in (camera.R, camera.t))
            lines.append({
                "pair": number, "role": role, "category": pair.category, "sequence": sequence, "frame": frame,
                "image": found.image.path, "depth": depth and depth.path,
                "depth_scale": depth and depth.scale_adjustment, "mask": mask and mask.path,
                "fx": fx, "fy": fy, "cx": cx, "cy": cy, "R": R, "t": t,
            })  # fmt: skip
    write_atomic(path, pd.DataFrame(lines).to_csv(index=False).encode())
    return Path(path)
