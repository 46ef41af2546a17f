"""Methods of the benchmark: the rows of its tables as plain data, groups of rows, and user-defined methods.

A row is the paper's method with some settings changed, or a function (`solve`). `problem` defines the argument and the
results of such functions.
"""

import importlib
import operator
import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from zsp_lite.benchmark import baseline_rows
from zsp_lite.benchmark.identity import described
from zsp_lite.errors import InputError


@dataclass(frozen=True)
class Method:
    """A row of the tables."""

    features: str = "backbone"  # name of the feature extractor in `extractors.EXTRACTORS`
    # The fitted pose; the best view without a fit ("Ours-BV"); the pose fitted in the target view that is nearest in
    # rotation to the ground truth; or the rotation between the reference and the best view without depth.
    answer: Literal["pose", "best view", "true view", "essential matrix"] = "pose"
    settings: Mapping[str, Any] = field(default_factory=dict)  # settings of `ZeroShotPose` that differ from the paper's
    targets: int | None = None  # number of target views per pair; None for that of the run
    # Function of a `Problem` that replaces the paper's method; `features` is then the extractor that it uses.
    solve: Callable[[Any], Any] | None = None


def describe_failure(error: BaseException) -> str:
    """Describe an exception of somebody else's code in one line: where it was raised, its type and its message."""
    *_, last = traceback.extract_tb(error.__traceback__)
    return " ".join(f"{last.filename}, line {last.lineno}: {type(error).__name__}: {error}".split())


_MASK = {"foreground": "mask"}
_MUTUAL = {"foreground": "mask", "matcher": "mutual", "kmeans": False, "binning": False}
_VERIFIED = {"solver": "verified"}


def _by_number_of_views(row: str, method: Method, *numbers: int) -> dict[str, Method]:
    """Return a row at fixed numbers of target views: ROW-n1, ROW-n3 and so on."""
    return {f"{row}-n{n}": replace(method, targets=n) for n in numbers}


METHODS: dict[str, Method] = {
    "ours": Method(),
    "ours-bv": Method(answer="best view"),
    # SIFT has no saliency and uses the true mask. Other rows use the mask only if their name says so.
    "rootsift": Method("rootsift", settings=_MASK),
    "rootsift-bv": Method("rootsift", "best view", _MASK),
    "ours-mask": Method(settings=_MASK),
    "oracle-view": Method(answer="true view"),
    "random": Method("random"),
    # Supplement, "Number and diversity of correspondences"; K = 50 with k-means is "ours".
    "ours-k30": Method(settings={"k": 30}),
    "ours-k70": Method(settings={"k": 70}),
    "ours-k30-nokmeans": Method(settings={"k": 30, "kmeans": False}),
    "ours-k50-nokmeans": Method(settings={"kmeans": False}),
    "ours-k70-nokmeans": Method(settings={"k": 70, "kmeans": False}),
    # Table 3: the other view selectors.
    "ours-globalsim": Method(settings={"view_selector": "global"}),
    "ours-saliencyiou": Method(settings={"view_selector": "saliency"}),
    "ours-cyclicaliou": Method(settings={"view_selector": "cyclical"}),
    # Supplement, "Design of correspondence method", "RANSAC parameters", "Depth-free methods".
    "ours-dualsoftmax": Method(settings={"matcher": "dual softmax"}),
    "ours-transport": Method(settings={"matcher": "optimal transport"}),
    "ours-trials500": Method(settings={"trials": 500}),
    "ours-trials2000": Method(settings={"trials": 2000}),
    "ours-nodepth": Method(answer="essential matrix"),
    # Cycles, clusters and saliency of the target view, as in the published code.
    "ours-published": Method(settings={"cycle_from": "target"}),
    # Table 1, the baselines. SwAV has no saliency: it uses the true mask, and is matched as mutual neighbours.
    "icp": Method("none", solve=baseline_rows.icp),
    "icp-bv": Method(solve=baseline_rows.icp_best_view),
    "sift": Method("sift", solve=baseline_rows.sift),
    "swav": Method("swav", settings=_MUTUAL),
    "posecontrast": Method("posecontrast", solve=baseline_rows.posecontrast),
    # Table 2 and supplement, "Number of target views".
    **_by_number_of_views("ours", Method(), 1, 3, 5, 10, 20),
    **_by_number_of_views("ours-bv", Method(answer="best view"), 1, 3, 5, 10, 20),
    # Beyond the paper.
    "verified": Method(settings=_VERIFIED),
    "verified-mask": Method(settings=_VERIFIED | _MASK),
    **_by_number_of_views("verified", Method(settings=_VERIFIED), 1, 3, 10),
    **_by_number_of_views("verified-mask", Method(settings=_VERIFIED | _MASK), 1, 3, 10),
}

GROUPS: dict[str, tuple[str, ...]] = {
    "default": ("ours", "ours-bv", "rootsift"),
    "table1": ("icp", "sift", "icp-bv", "ours-k30", "ours"),
    "table2": tuple(f"{row}-n{n}" for row in ("ours-bv", "ours") for n in (1, 3, 5)),
    "table3": ("ours-cyclicaliou", "ours-globalsim", "ours-saliencyiou", "ours"),
    "views": tuple(f"{row}-n{n}" for row in ("ours-bv", "ours") for n in (1, 3, 5, 10, 20)),
    "matchers": ("ours-transport", "ours-dualsoftmax", "ours"),
    "correspondences": (*(f"ours-k{k}-nokmeans" for k in (30, 50, 70)), "ours-k30", "ours", "ours-k70"),
    "trials": ("ours-trials500", "ours", "ours-trials2000"),
    "depth": ("ours-nodepth", "ours-bv", "ours"),
    "published": ("ours", "ours-published"),
    "verified-views": tuple(f"verified{mask}{n}" for n in ("", "-n1", "-n3", "-n10") for mask in ("", "-mask")),
}


def _union(*names: str) -> tuple[str, ...]:
    """Return the rows of several groups without duplicates."""
    return tuple(dict.fromkeys(member for name in names for member in GROUPS.get(name, (name,))))


# All ablations of the paper at one number of views, and all its tables. "swav" and "posecontrast" are in no group: they
# need checkpoints that have to be downloaded.
GROUPS["ablations"] = _union("ours", "table3", "matchers", "correspondences", "trials", "depth", "published")
GROUPS["paper"] = _union("ours", "ours-bv", "table1", "ablations", "views", "rootsift", "rootsift-bv", "ours-mask")
# The paper's tables and the rows beyond the paper.
GROUPS["all"] = _union("paper", "verified-views", "oracle-view")
_EXPECTED = (
    f"one of {', '.join((*GROUPS, *METHODS))}, module:name, a Method, a function of a problem, or an object with "
    "estimate(reference, targets)"
)


def resolve(methods: str | Sequence[str] | Mapping[str, Any]) -> dict[str, Method]:
    """Resolve names to rows, in order and without duplicates.

    Args:
        methods: Names in `METHODS` or `GROUPS`, or "module:name"; or a mapping from names for the tables to such names,
            `Method`s, functions of a `Problem`, or objects with the method `estimate(reference, targets)`.

    Raises:
        InputError: A name is unknown or cannot be imported, or an object is none of these.
    """
    if not isinstance(methods, Mapping):
        names = [methods] if isinstance(methods, str) else methods
        methods = {member: member for name in names for member in GROUPS.get(name, (name,))}
    if not methods:
        raise InputError(f"no methods, expected {_EXPECTED}")
    return {str(name): _method(str(name), meant) for name, meant in methods.items()}


def description(method: Method) -> str:
    """Describe a row as text: its extractor, answer, settings, number of views, and its function as "module:name".

    Rows with the same name and different descriptions must not be stored in one run.
    """
    settings = ", ".join(f"{name}={described(value)}" for name, value in sorted(method.settings.items()))
    parts = [method.features, method.answer, settings, f"{method.targets} views" if method.targets else ""]
    return "; ".join(filter(None, [*parts, "" if method.solve is None else described(method.solve)]))


def _method(name: str, meant: Any) -> Method:
    if isinstance(meant, str):
        meant = METHODS.get(meant) or (import_object(meant) if ":" in meant else meant)
    if isinstance(meant, Method):
        return meant
    if callable(getattr(meant, "estimate", None)):
        return Method(solve=_Estimator(meant))
    if callable(meant):
        return Method(solve=meant)
    what = "unknown" if isinstance(meant, str) else f"a {type(meant).__name__}"
    raise InputError(f"method {name!r} is {what}, expected {_EXPECTED}")


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
class _Estimator:
    """Adapter of a user-defined object with `estimate(reference, targets)`, which gets the whole frames."""

    estimator: Any

    def __call__(self, problem: Any) -> Any:
        reference, *targets = problem.full_frames()
        return self.estimator.estimate(reference, targets)
