"""Methods of one's own: which kind of method an object is, and poses that another program computed."""

import csv
import importlib
import inspect
import io
import operator
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from zsp_lite.alignment import SCALE_RANGE, ransac
from zsp_lite.baselines.sift import unproject_pixels
from zsp_lite.benchmark.identity import digest
from zsp_lite.benchmark.problem import Answer, Problem, as_answer
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.errors import InputError, real_array
from zsp_lite.io.files import read_bytes, write_atomic

KINDS = ("problem", "keypoints", "matcher")  # functions of one, two and three arguments
_QUESTION = ("category", "reference_sequence", "reference_frame", "target_sequence", "target_frame")
_POSE = {"rotation": 9, "translation": 3, "scale": 1}  # how many numbers


def kind_of(thing: Any) -> str:
    """Tell what a thing is: "estimator" (has `estimate`), or the function of one of `KINDS`.

    The number of arguments without a default tells the kinds apart; an attribute `kind` of the thing comes before it.
    InputError if it is none of these.
    """
    if callable(getattr(thing, "estimate", None)) and not isinstance(thing, type):
        return "estimator"
    if (kind := getattr(thing, "kind", None)) in KINDS:
        return kind
    found = f"a {type(thing).__name__}, which is no function"
    if callable(thing) and not isinstance(thing, type):
        try:
            signature = inspect.signature(thing.forward if isinstance(thing, nn.Module) else thing)
        except (TypeError, ValueError):
            signature = inspect.Signature()
        parameters = signature.parameters.values()
        positional = [one for one in parameters if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]
        needed = [one for one in parameters if one.default is one.empty and one.kind is not one.VAR_KEYWORD]
        if positional and needed == positional[: len(needed)] and 1 <= len(needed) <= 3:
            return KINDS[len(needed) - 1]
        found = f"a function of {signature}"
    raise InputError(
        f"{found}: expected an object with estimate(reference, targets), or a function of a problem, of two images, or "
        f"of similarities and two foregrounds (its attribute `kind`, one of {', '.join(KINDS)}, may say which)"
    )


def describe_failure(error: BaseException) -> str:
    """Describe an exception of somebody else's code in one line: where it was raised, its type and its message."""
    *_, last = traceback.extract_tb(error.__traceback__)
    return " ".join(f"{last.filename}, line {last.lineno}: {type(error).__name__}: {error}".split())


def import_object(path: str) -> Any:
    """Import the object "module:name" from an installed module or a module in the current folder."""
    module, _, name = path.partition(":")
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # the path of a console script lacks the current folder
    try:
        return operator.attrgetter(name)(importlib.import_module(module))
    except (Exception, SystemExit) as error:  # a module may raise anything
        reason = error if isinstance(error, ImportError | AttributeError) else describe_failure(error)
        raise InputError(f"{path!r} cannot be imported: {reason}") from error


@dataclass(frozen=True)
class Estimator:
    """Row of an object with `estimate(reference, targets)`, which gets the whole frames."""

    own: Any

    def __call__(self, problem: Problem) -> Any:
        reference, *targets = problem.full_frames()
        return self.own.estimate(reference, targets)


@dataclass(frozen=True)
class KeypointMatcher:
    """Row of a matcher of keypoints, such as LightGlue, LoFTR or RoMa, followed by RANSAC as in the paper.

    The matcher gets the object crops of the reference and of a target view, (H, W, 3) uint8, and returns points in the
    first and in the second image, (n, 2) as (x, y) in pixels with pixel centres at half-integers, and a score of each
    match, (n,), or one of all. The view of the highest sum of scores is the best view.
    """

    own: Callable[[np.ndarray, np.ndarray], tuple[Any, Any, Any]]

    def __call__(self, problem: Problem) -> Answer:
        reference, *targets = problem.frames()
        found = [self.own(reference.rgb, target.rgb) for target in targets]
        view = int(np.argmax([np.sum(real_array("scores of matches", score)) for _, _, score in found]))
        return fit_keypoints(problem, view, *found[view][:2])


def fit_keypoints(problem: Problem, view: int, first: Any, second: Any) -> Answer:
    """Fit the pose to matched pixels of the reference's crop and of a target's: depth, then RANSAC (sec. 4.3)."""
    frames = problem.frames_with_depth()
    reference, target = frames[0], frames[1 + view]
    first, second = (real_array("matched points", points).reshape(-1, 2) for points in (first, second))
    details = {"matches": len(first), "inliers": 0}
    try:
        points = unproject_pixels(reference, first), unproject_pixels(target, second)
        sim3, inliers = ransac(*points, seed=problem.seed, scale_range=SCALE_RANGE)
    except InputError as error:
        return Answer(np.eye(3), view, note=f"pose is the best view's, not a fit: {error}", details=details)
    return Answer(sim3.R, view, sim3.t, sim3.scale, "", details | {"inliers": int(inliers.sum())})


@dataclass(frozen=True)
class StoredPoses:
    """Row of poses that another program computed, by category, sequences and frames."""

    path: str
    digest: str  # of the file
    _poses: Mapping[tuple[str, str, int, str, int], Answer]

    def __call__(self, problem: Problem) -> Answer:
        pair = problem.pair
        for view, frame in enumerate(pair.target_frames):
            key = (pair.category, pair.reference_sequence, pair.reference_frame, pair.target_sequence, frame)
            if (found := self._poses.get(key)) is not None:
                return Answer(found.rotation, view, found.translation, found.scale)
        raise InputError(f"{self.path} has no pose")


def read_poses(path: str | Path) -> StoredPoses:
    """Read a CSV file of poses: a line for each pair.

    Its columns are category, reference_sequence, reference_frame, target_sequence, target_frame, rotation (nine
    numbers, row by row) and, if they are known, translation (three numbers) and scale; numbers are separated by spaces.
    The pose leads from camera points of the reference frame to those of the target frame, any of the pair's.
    """
    data = read_bytes(path, "poses")
    try:
        lines = list(csv.DictReader(io.StringIO(data.decode())))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"poses {path}: {error}, expected a CSV file") from error
    if missing := [name for name in (*_QUESTION, "rotation") if not lines or name not in lines[0]]:
        raise InputError(f"poses {path}: no column {', '.join(missing)}, or no line")
    poses = {}
    for number, line in enumerate(lines, 2):
        try:
            rotation, translation, scale = (_numbers(line, name, size) for name, size in _POSE.items())
            category, reference, reference_frame, target, target_frame = (line[name] for name in _QUESTION)
            key = category, reference, int(reference_frame), target, int(target_frame)
            poses[key] = as_answer(Answer(rotation.reshape(3, 3), 0, translation, None if scale is None else scale[0]))
        except (InputError, ValueError, AttributeError, TypeError) as error:
            raise InputError(f"poses {path}, line {number}: {error}") from error
    return StoredPoses(str(path), digest(data), poses)


def _numbers(line: Mapping[str, str], name: str, size: int) -> np.ndarray | None:
    """Read the numbers of a column; None where it is empty."""
    values = np.array([float(text) for text in (line.get(name) or "").split()])
    if len(values) not in (size, 0 if name != "rotation" else size) or not np.isfinite(values).all():
        raise ValueError(f"{name} is {line[name]!r}, expected {size} numbers separated by spaces")
    return values if len(values) else None


def write_questions(path: str | Path, dataset: Co3D, pairs: Sequence[Pair]) -> Path:
    """Write pairs as a CSV file for another program: a line for each frame, the reference's of a pair first.

    Paths are those of the image, the depth map (CO3D's 16-bit format, times depth_scale) and the mask in the data
    folder; empty where there is none. The camera maps x_cam = R @ x_world + t, R row by row, and its intrinsics are in
    pixels with pixel centres at half-integers.
    """
    lines = [["pair", "role", "category", "sequence", "frame", "image", "depth", "depth_scale", "mask", "fx", "fy"]]
    lines[0] += ["cx", "cy", "R", "t"]
    for number, pair in enumerate(pairs):
        ends = [("reference", pair.reference_sequence, pair.reference_frame)]
        ends += [("target", pair.target_sequence, frame) for frame in pair.target_frames]
        for role, sequence, frame in ends:
            found = dataset.frame(pair.category, sequence, frame)
            camera, depth, mask = dataset.camera(found), found.depth, found.mask
            files = [found.image.path, *((depth.path, depth.scale_adjustment) if depth else ("", ""))]
            files += [mask.path if mask else ""]
            values = [*camera.focal_length.tolist(), *camera.principal_point.tolist()]
            values += [" ".join(map(repr, part.ravel().tolist())) for part in (camera.R, camera.t)]
            lines.append([number, role, pair.category, sequence, frame, *files, *values])
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    write_atomic(path, text.getvalue().encode())
    return Path(path)
