"""The rows of the benchmark's tables as plain data, groups of rows, and rows of one's own."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Literal

from zsp_lite.baselines.sift import RootSift, Sift
from zsp_lite.benchmark import baseline_rows
from zsp_lite.benchmark.own import Estimator, KeypointMatcher, StoredPoses, kind_of
from zsp_lite.benchmark.runs import described
from zsp_lite.data.exchange import read_stored_poses
from zsp_lite.errors import InputError, check_number
from zsp_lite.features import FeatureExtractor
from zsp_lite.io.modules import import_object


@dataclass(frozen=True)
class Method:
    """A row of the tables: the paper's method with some settings changed, or a function of one's
    own."""

    features: str = "backbone"  # name of the feature extractor in `make_extractors`
    # The fitted pose; the best view without a fit ("Ours-BV"); the pose fitted in the target view
    # that is nearest in rotation to the ground truth; or the rotation between the reference and the
    # best view without depth.
    answer: Literal["pose", "best view", "true view", "essential matrix"] = "pose"
    # settings of `ZeroShotPose` that differ from the paper's
    settings: Mapping[str, Any] = field(default_factory=dict)
    targets: int | None = None  # number of target views per pair; None for that of the run
    # Function of a `Problem` that replaces the paper's method; `features` is then the extractor
    # that it uses.
    solve: Callable[[Any], Any] | None = None


def _ours(**settings: Any) -> Method:
    """Return the paper's method with some settings changed."""
    return Method(settings=settings)


METHODS: dict[str, Method] = {
    "ours": _ours(),
    "ours-bv": Method(answer="best view"),
    # SIFT has no saliency and uses the true mask. Other rows use the mask only if their name says
    # so.
    "rootsift": Method(features="rootsift", settings={"foreground": "mask"}),
    "ours-mask": _ours(foreground="mask"),
    "oracle-view": Method(answer="true view"),
    # Supplement, "Number and diversity of correspondences"; K = 50 with k-means is "ours".
    "ours-k30": _ours(k=30),
    "ours-k70": _ours(k=70),
    "ours-k30-nokmeans": _ours(k=30, kmeans=False),
    "ours-k50-nokmeans": _ours(kmeans=False),
    "ours-k70-nokmeans": _ours(k=70, kmeans=False),
    # Table 3: the other view selectors.
    "ours-globalsim": _ours(view_selector="global"),
    "ours-saliencyiou": _ours(view_selector="saliency"),
    "ours-cyclicaliou": _ours(view_selector="cyclical"),
    # Supplement, "Design of correspondence method", "RANSAC parameters", "Depth-free methods".
    "ours-dualsoftmax": _ours(matcher="dual softmax"),
    "ours-transport": _ours(matcher="optimal transport"),
    "ours-trials500": _ours(trials=500),
    "ours-trials2000": _ours(trials=2000),
    "ours-nodepth": Method(answer="essential matrix"),
    # Cycles, clusters and saliency of the target view, as in the published code.
    "ours-published": _ours(cycle_from="target"),
    # Without log-binning, without the way back of the cycles, and without RANSAC.
    "ours-keys": _ours(binning=False),
    "ours-nearest": _ours(matcher=baseline_rows.nearest_patches),
    "ours-least-squares": Method(solve=baseline_rows.least_squares),
    # Table 1, the baselines; SWaV and PoseContrast have published figures only.
    "icp": Method(features="none", solve=baseline_rows.icp),
    "icp-bv": Method(solve=baseline_rows.icp_best_view),
    "sift": Method(features="sift", solve=baseline_rows.sift),
    # Beyond the paper.
    "verified": _ours(solver="verified"),
    "verified-mask": _ours(solver="verified", foreground="mask"),
    # These rows see more than the pair, without labels, and have tables of their own: scans-R and
    # shape-upright frames all around both objects, "category" all objects of the category.
    **{f"scans-{count}": Method(solve=baseline_rows.Scans(count)) for count in (2, 4, 8)},
    "shape-upright": Method(solve=baseline_rows.shape_upright),
    "category": Method(solve=baseline_rows.category),
}


@cache
def read_paper_tables() -> list[dict[str, Any]]:
    """Read which rows stand in which table of the paper, with its published figures."""
    return json.loads(Path(__file__).with_name("paper_tables.json").read_text(encoding="utf-8"))


# Rows or other groups: the tables of the paper, one by one and together, and what goes beyond them.
# In no group is "category".
GROUPS: dict[str, list[str]] = {
    "default": "ours ours-bv rootsift".split(),
    **{
        table["group"]: [line["row"] for line in table["rows"] if line["row"]]
        for table in read_paper_tables()
        if "group" in table
    },
    "scans": "shape-upright scans-2 scans-4 scans-8".split(),
    "verified-views": "verified verified-n1 verified-n3 verified-n10 verified-mask".split(),
    # all at the run's number of target views
    "ablations": "ours table3 matchers correspondences trials depth published parts".split(),
    "paper": "ours ours-bv table1 ablations views rootsift ours-mask".split(),
    "all": "paper verified-views oracle-view".split(),
}


def _members(name: str) -> list[str]:
    """Return the rows of a group, or the name of a row itself."""
    if name not in GROUPS:
        return [name]
    return [row for member in GROUPS[name] for row in _members(member)]


def resolve(
    methods: str | Sequence[str] | Mapping[str, Any], sweep: Sequence[float] = ()
) -> dict[str, Method]:
    """Resolve names to rows, in order and without duplicates.

    Names are those of rows or groups (`METHODS`, `GROUPS`), ROW-nN for a row at N target views, or
    NAME=module:thing or NAME=poses.csv, also without NAME=. A mapping leads from names to these, to
    a `Method`, or to objects of one's own. Each RANSAC threshold V of a sweep makes a row
    NAME@threshold=V of each. InputError if a name is unknown or another row's, or a thing cannot be
    imported or read, or is of no kind.
    """
    if not isinstance(methods, Mapping):
        names = [methods] if isinstance(methods, str) else methods
        methods = {}
        for row in [row for name in names for row in _members(name)]:
            # "NAME=MEANING", or a name that means itself.
            name, _, meaning = row.partition("=")
            meaning = meaning or name
            if methods.setdefault(name, meaning) != meaning:
                raise InputError(
                    f"methods {', '.join(names)} are two of one name, expected one of each"
                )
    if not methods:
        raise InputError("no methods, expected some; `zsp-lite benchmark --list` lists them")
    # "alignment" is the row that `align` stores.
    taken = {*METHODS, *GROUPS, "alignment"}
    for name, meant in methods.items():
        # A row is one line of a table. matplotlib's legends leave out labels that begin with _.
        if not name.isprintable() or name.startswith("_"):
            raise InputError(f"method {name!r}: expected a printable name, not with _ first")
        text = meant if isinstance(meant, str) else ""
        if text != name and taken & {base_name(name), base_name(text)}:
            raise InputError(
                f"method {name!r} is a name of the library's, or another name for one of its rows"
            )
    rows = {name: _method(name, meant) for name, meant in methods.items()}
    return _swept(rows, sweep) if sweep else rows


def _method(name: str, meant: Any) -> Method:
    """Return the row that a name, an object or a function means."""
    if isinstance(meant, str):
        row, views = re.fullmatch(r"(.*?)(?:-n([1-9][0-9]{0,3}))?", meant, re.DOTALL).groups()
        if row in METHODS:
            return replace(METHODS[row], targets=int(views)) if views else METHODS[row]
        if meant.endswith(".csv"):
            return Method(features="none", solve=StoredPoses(meant, *read_stored_poses(meant)))
        if ":" not in meant:
            raise InputError(
                f"method {meant!r} is unknown; `zsp-lite benchmark --list` lists all, "
                "NAME=module:thing and NAME=poses.csv are your own"
            )
        meant = import_object(meant)
    elif isinstance(meant, Method):
        return meant
    kind = kind_of(name, meant)
    if kind == "estimator":
        return Method(features="none", solve=Estimator(meant))
    if kind == "keypoints":
        return Method(features="none", solve=KeypointMatcher(meant))
    if kind == "problem":
        return Method(solve=meant)
    return Method(settings={kind: meant})  # a matcher or a solver


def base_name(name: str) -> str:
    """Return ROW of "ROW-nN@threshold=V"."""
    return re.sub(r"(-n\d+)?(@.*)?$", "", name)


def is_own(name: str) -> bool:
    """Tell whether a row is not the library's, with any number of target views (see `resolve`)."""
    return base_name(name) not in METHODS


def _swept(rows: Mapping[str, Method], thresholds: Sequence[float]) -> dict[str, Method]:
    """Return each row with each RANSAC threshold; InputError for a row that has none."""
    swept = {}
    for (name, row), value in product(rows.items(), thresholds):
        check_number("threshold", value, above=0)
        if row.solve is None:
            changed = replace(row, settings={**row.settings, "threshold": value})
        elif isinstance(row.solve, KeypointMatcher):
            changed = replace(row, solve=replace(row.solve, threshold=value))
        else:
            raise InputError(f"method {name!r} has no threshold, expected a matcher or a solver")
        swept[f"{name}@threshold={value}"] = changed
    return swept


def make_extractors(backbone: FeatureExtractor, methods: Mapping[str, Method]) -> dict[str, Any]:
    """Make the feature extractors of rows, by name.

    They are called on images, or `describe` frames.
    """
    every = {"none": None, "backbone": backbone, "rootsift": RootSift(), "sift": Sift()}
    return {method.features: every[method.features] for method in methods.values()}


def description(method: Method) -> str:
    """Describe a row as text; rows with the same name and other descriptions are not stored in one
    run."""
    settings = ", ".join(
        f"{name}={described(value)}" for name, value in sorted(method.settings.items())
    )
    views = f"{method.targets} views" if method.targets else ""
    solve = described(method.solve) if method.solve else ""
    return "; ".join(filter(None, [method.features, method.answer, settings, views, solve]))
