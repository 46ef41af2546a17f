"""The parts of the method that a student writes: `check` tests a part on small arrays, says which
known mistake it has, and keeps a right one in `my_method.py`.

A part is kept as its source, so that the file can be read and imported, and a restart of the kernel
loses nothing. `your_turn.json` has the arrays, and the known mistakes as changes of the library's
source.
"""

import ast
import builtins
import copy
import inspect
import json
import math
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch

from zsp_lite import minimal
from zsp_lite.alignment import Sim3
from zsp_lite.errors import InputError
from zsp_lite.io.files import write_atomic
from zsp_lite.minimal import (
    Crop,
    cycle,
    descriptor,
    pixel_depths,
    ransac,
    umeyama,
    unproject,
    view_score,
)

FILE = "my_method.py"  # in the current folder
SECONDS = 10.0  # of computing, that a part has for all its tests
TRIALS = 1000  # of the library's RANSAC
# What a kept file begins with: the library's parts, which those of the student replace.
HEADER = '''\
"""My method: the parts that I wrote. For the others it takes the library's."""

import numpy as np

from zsp_lite.alignment import Sim3
from zsp_lite.course.your_turn import choose, composed, crops, draws, interval, kmeans
from zsp_lite.course.your_turn import patches, rotation_error
from zsp_lite.minimal import cycle, descriptor, pixel_depths
from zsp_lite.minimal import ransac, umeyama, unproject, view_score
'''
# What stands at its end until the student's own `estimate` does.
COMPOSED = "estimate = composed(globals())  # the library's, of the parts above\n"

# Set by `crops` and read by `kmeans`, which a student's code calls without a seed.
_seed = ContextVar("seed of the pair", default=0)


class Patches(NamedTuple):
    """The n patches of a crop, row by row."""

    descriptors: np.ndarray  # (n, 17 d), of length 1
    place: np.ndarray  # (n, 2), row and column
    salience: np.ndarray  # (n,)
    on: np.ndarray  # (n,) bool, on the object


def crops(problem: Any) -> list[Crop]:
    """Return the crops of a pair, the reference's first: features, depth, intrinsics.

    A pair is whatever has `views()` and a `seed`, as the benchmark's problems. `kmeans` draws by
    the seed from now on.
    """
    _seed.set(problem.seed)
    views = [(view.features, view.frame) for view in problem.views()]
    return [
        Crop(features.keys.numpy(), features.saliency.numpy(), frame.depth, frame.camera.K)
        for features, frame in views
    ]


def kmeans(vectors: np.ndarray, k: int) -> np.ndarray:
    """Assign n vectors to k clusters, as the library does for this pair: labels (n,)."""
    return minimal.kmeans(vectors, k, _seed.get())


choose = partial(minimal.choose, kmeans=kmeans)


def patches(crop: Crop, descriptor: Callable) -> Patches:
    """Describe each patch of a crop by 17 bins, taken by a function `descriptor`."""
    coarse = minimal.means(torch.from_numpy(crop.keys)).numpy()
    place = np.argwhere(np.ones(crop.saliency.shape))
    # The library's function takes all patches at once.
    rows = [*minimal.log_bin(crop.keys).numpy()] if descriptor is minimal.descriptor else []
    for row, column in place[len(rows) :]:
        far = list(descriptor(coarse, row, column, 3))  # the fifth is the patch itself
        rows.append(np.concatenate([*descriptor(crop.keys, row, column, 1), *far[:4], *far[5:]]))
    salience = crop.saliency.ravel()
    descriptors = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return Patches(descriptors, place, salience, salience > minimal.SALIENT)


def rotation_error(first, second):
    """Compute the angle between two rotations (3, 3) in degrees."""
    cosine = (np.trace(first.T @ second) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def interval(right, first, second, rng):
    """Compute the 95 % interval of the share of right pairs (n,), as objects are drawn again.

    A pair counts as often as its objects, numbers `first` and `second` (n,), are drawn.
    """
    shares = []
    n = max(*first, *second) + 1  # objects
    while len(shares) < 2000:
        times = np.bincount(rng.integers(n, size=n), minlength=n)
        weight = times[first] * times[second]
        if weight.any():
            shares.append(weight @ right / weight.sum())
    return np.percentile(shares, [2.5, 97.5])


class _Draws(np.random.Generator):
    """A random generator that gives one by one the samples of 4 that the library draws at once."""

    _samples: Sequence[np.ndarray] = ()  # that are left; the next one is the last

    def choice(self, a: Any, size: Any = None, replace: bool = True, **others: Any) -> Any:
        """Return the next sample of 4 of `a` matches without replacement; else what NumPy does."""
        if replace or size != 4:
            return super().choice(a, size, replace, **others)
        if not len(self._samples):
            self._samples = minimal.draw_samples(a, TRIALS, self)[::-1]
        *self._samples, sample = self._samples
        return sample


def draws(seed: int) -> np.random.Generator:
    """Return a random generator whose `choice` gives the samples of the library's RANSAC."""
    return _Draws(np.random.PCG64(seed))


def composed(parts: dict[str, Any]) -> Callable[[Any], tuple[Sim3, int]]:
    """Return the library's `estimate` with other parts."""
    return _define("estimate", inspect.getsource(estimate), parts)


def estimate(problem):
    """Estimate the pose of the reference object in the best of the target views."""
    reference, *targets = crops(problem)
    one = patches(reference, descriptor)
    found = []
    for target in targets:
        other = patches(target, descriptor)
        cosine = one.descriptors @ other.descriptors.T
        v, distance = cycle(cosine, one.place, one.on, other.on)
        nearest = cosine.max(axis=1)
        u = choose(distance, nearest, one.descriptors, one.salience, 50)  # K
        found.append((one.place[u], other.place[v[u]], nearest[u]))
    view = int(np.argmax([view_score(cosine, 50) for _, _, cosine in found]))
    x = unproject(*pixel_depths(reference, found[view][0]))
    y = unproject(*pixel_depths(targets[view], found[view][1]))
    (scale, R, t), _ = ransac(x, y, 1000, 0.2, draws(problem.seed))  # trials, threshold
    return Sim3(scale, R, t), view


# In the order of the lessons. The name of the partial `choose` is that of `minimal`'s function.
_OF_MINIMAL = descriptor, cycle, minimal.choose, view_score, unproject, umeyama, ransac
_PARTS = {part.__name__: part for part in (*_OF_MINIMAL, rotation_error, interval, estimate)}
_TESTS = json.loads(Path(__file__).with_suffix(".json").read_text("utf-8"))


def check(function: Callable) -> None:
    """Test a part of the method on small arrays, and print what is right or wrong.

    A right part is kept in `my_method.py` in the current folder. A part whose body is `...` is not
    tested.

    Raises:
        InputError: if the `my_method.py` that is there is no Python, or has no `estimate`.
    """
    name = getattr(function, "__name__", "?")
    reason = f"{name} is no part of the method, expected one of {', '.join(_PARTS)}"
    if name in _PARTS:
        reason = _refusal(name, function) or _defect(name, _source(function))
    if reason:
        print(reason)
    else:
        print(f"right: {_keep(name, _source(function))} of {len(_PARTS)} parts are yours")


def my_method() -> Callable[[Any], tuple[Sim3, int]]:
    """Return the `estimate` of `my_method.py`; without this file the library's."""
    return _executed(_kept())["estimate"]


def _source(function: Callable) -> str:
    """Return the source of a function, at the left margin."""
    return textwrap.dedent(inspect.getsource(function))


def _refusal(name: str, function: Callable) -> str:
    """Say why a part is not tested: it is not written, or not on its own; "" if it is."""
    if function.__module__.partition(".")[0] == "zsp_lite":
        return f"{name} is the library's own: write yours"
    (written,) = ast.parse(_source(function)).body
    body = [
        one
        for one in written.body
        if not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant))
    ]
    if all(isinstance(one, ast.Pass) for one in body):
        return f"{name} is not written yet: the lesson goes on with the library's"
    nodes = [*ast.walk(written)]
    if any(isinstance(one, ast.Import | ast.ImportFrom) for one in nodes):
        return f"{name} imports something: np and the parts of the method are there"
    # Known are the names that the part binds itself, those of the file, and Python's own.
    names = [one for one in nodes if isinstance(one, ast.Name)]
    known = {one.id for one in names if not isinstance(one.ctx, ast.Load)}
    known |= {one.arg for one in nodes if isinstance(one, ast.arg)}
    known |= {one.name for one in nodes if isinstance(one, ast.FunctionDef)}
    unknown = {one.id for one in names} - known - {*_executed(_kept()), *dir(builtins)}
    if unknown:
        return f"{name} uses {min(unknown)}, which {FILE} does not have, only np and the parts"
    return ""


def _executed(text: str) -> dict[str, Any]:
    """Return the names that a text of Python defines."""
    names: dict[str, Any] = {}
    exec(compile(text, FILE, "exec"), names)
    return names


def _kept() -> str:
    """Return the text of `my_method.py`, or what it begins with."""
    if not Path(FILE).exists():
        return f"{HEADER}\n\n{COMPOSED}"
    text = Path(FILE).read_text("utf-8")
    try:
        places = _places(text)
    except SyntaxError as error:
        raise InputError(f"{FILE}, line {error.lineno}: {error.msg}; mend it or move it away")
    if "estimate" not in places:
        raise InputError(f"{FILE} has no function estimate, expected one; move it away")
    return text


def _defect(name: str, source: str) -> str:
    """Compare a part, among the library's others, with the library's; "" if all is the same."""
    _seed.set(0)
    function = _define(name, source, _executed(HEADER))
    test = _TESTS[name]
    cases = [
        {key: np.array(value) if isinstance(value, list) else value for key, value in case.items()}
        for case in test["cases"]
    ]
    # Of `estimate` the file has none: a toy pair, without noise and with it.
    cases = cases or [{"problem": _toy_problem(noise)} for noise in (0, 0.05)]
    expected = [_outcome(_PARTS[name], case) for case in cases]
    end = time.thread_time() + SECONDS
    found = [_outcome(function, case, end) for case in cases]
    if any(isinstance(came, TimeoutError) for came in found):
        return f"{name} was stopped after {SECONDS:.0f} s: does a loop never end?"
    differ = [one for one in zip(cases, found, expected) if not _same(name, *one[1:])]
    if not differ:
        return ""
    case, came, right = differ[0]
    given = "a pair whose second target view shows the reference at twice its size"
    if name != "estimate":
        given = ", ".join(f"{key} = {_shown([value])}" for key, value in case.items())
    out = f"{type(came).__name__}: {came}" if isinstance(came, Exception) else _shown(came)
    lines = [f"{name} is not right yet.", f"in:       {given}", f"out:      {out}"]
    lines.append(f"expected: {_shown(right)}")
    # The part has a known mistake if its results are those of the library with this mistake.
    for mistake in test["mistakes"]:
        source = inspect.getsource(_PARTS[name])
        for right_one, wrong_one in mistake["change"]:
            source = source.replace(right_one, wrong_one)
        wrong = _define(name, source, vars(sys.modules[_PARTS[name].__module__]))
        if all(_same(name, came, _outcome(wrong, case)) for case, came in zip(cases, found)):
            lines.append(mistake["says"])
            break
    return "\n".join(lines)


def _define(name: str, source: str, names: Mapping[str, Any]) -> Callable:
    """Define a function by its source, among other names."""
    names = dict(names)
    exec(compile(source, f"<{name}>", "exec"), names)
    return names[name]


def _outcome(
    function: Callable, case: Mapping[str, Any], end: float = math.inf
) -> list[np.ndarray] | Exception:
    """Call a part with copies of arguments, and make arrays of what it gives, or return its error.

    It is stopped by TimeoutError at its first line after the time `end`, in `time.thread_time`.
    """
    name = function.__name__
    arguments = copy.deepcopy(dict(case))
    if "rng" in inspect.signature(function).parameters:
        arguments["rng"] = draws(0)

    # Python calls this at each function, and at each line of the part, whose file is `<name>`.
    def trace(frame, event, value):
        if time.thread_time() > end:
            raise TimeoutError
        return trace if frame.f_code.co_filename == f"<{name}>" else None

    before = sys.gettrace()
    if end < math.inf:
        sys.settrace(trace)
    flat = []
    try:
        result = function(**arguments)
        if name in ("ransac", "estimate") and len(result) != 2:
            raise ValueError(f"{len(result)} values are returned, expected 2")
        # The ends of an interval may stand in one array or not.
        todo = [np.asarray(result) if name == "interval" else result]
        while todo:
            one = todo.pop(0)
            if isinstance(one, Sim3):
                one = one.scale, one.R, one.t
            if isinstance(one, tuple):
                todo = [*one, *todo]
            else:
                flat.append(np.asarray(one, float))
        for key, value in case.items():
            if isinstance(value, np.ndarray) and not np.array_equal(value, arguments[key]):
                raise ValueError(f"{key} is overwritten, which the caller still needs")
    except Exception as error:  # of any kind, as it is the student's
        return error
    finally:
        sys.settrace(before)
    return flat


def _same(
    name: str, one: list[np.ndarray] | Exception, other: list[np.ndarray] | Exception
) -> bool:
    """Say whether two results of a part are the same, or errors of one type."""
    if isinstance(one, Exception) or isinstance(other, Exception):
        return type(one) is type(other)
    atol = 0.05 if name == "interval" else 1e-6  # its draws may differ
    return [part.shape for part in one] == [part.shape for part in other] and all(
        np.allclose(a, b, atol=atol, equal_nan=True) for a, b in zip(one, other)
    )


def _shown(values: Iterable[Any]) -> str:
    """Write arrays in a short form."""
    style = {"precision": 2, "suppress_small": True, "threshold": 60}
    return ", ".join(np.array2string(np.asarray(one), **style).replace("\n", "") for one in values)


def _keep(name: str, source: str) -> int:
    """Put a part into `my_method.py`; return how many are the student's."""
    text = _kept()
    lines = text.splitlines(keepends=True)
    places = _places(text)
    # In place of the one that is there, or else before `estimate`, which calls it.
    start = places["estimate"].start
    lines[places.get(name, slice(start, start))] = [source, "" if name in places else "\n\n"]
    text = "".join(lines)
    write_atomic(FILE, text.encode())
    return len(_places(text)) - (COMPOSED in text)  # this `estimate` is the library's


def _places(text: str) -> dict[str, slice]:
    """Find the parts in the lines of a text."""
    body = ast.parse(text).body
    # A part is a function, or the left side of an assignment, as in `COMPOSED`.
    names = ((one, getattr(one, "name", ast.unparse(one).partition(" = ")[0])) for one in body)
    return {name: slice(one.lineno - 1, one.end_lineno) for one, name in names if name in _PARTS}


def _toy_problem(noise: float) -> Any:
    """Build a pair with three target views: the second shows the reference at twice its size."""
    rng = np.random.default_rng(3)
    keys = rng.normal(size=(12, 12, 8))
    depth = rng.uniform(4, 6, (48, 48)).astype(np.float32)

    def view(keys, depth=depth, middle=24):  # middle: x of the principal point, pixels
        salience = torch.from_numpy(rng.uniform(0, 0.4, (12, 12)))
        features = SimpleNamespace(keys=torch.from_numpy(keys), saliency=salience)
        K = np.array([[80, 0, middle], [0, 80, 24], [0, 0, 1.0]])
        frame = SimpleNamespace(depth=depth, camera=SimpleNamespace(K=K))
        return SimpleNamespace(features=features, frame=frame)

    # The picture moves to the right by one patch, which has 4 pixels, and to twice the depth.
    larger = np.roll(keys, 1, axis=1) + 9 * noise * rng.normal(size=keys.shape)
    farther = np.roll(depth, 4, axis=1) * rng.normal(2, noise, depth.shape).astype(np.float32)
    other = view(rng.normal(size=keys.shape))
    views = [view(keys), other, view(larger, farther, 24 + 4), other]
    return SimpleNamespace(views=lambda: views, seed=1)
