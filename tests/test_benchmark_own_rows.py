"""Rows of one's own: what they may be and may return, and how a row, a backbone or a function is told from another."""

import dis
import enum
import functools
import inspect
import json
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from benchmark_folder import own_method, small_folder
from synthetic_views import CoordinateBackbone

from zsp_lite.benchmark import baseline_rows, provenance
from zsp_lite.benchmark.database import read_records
from zsp_lite.benchmark.extractors import EXTRACTORS
from zsp_lite.benchmark.extractors import fingerprint as extractor_fingerprint
from zsp_lite.benchmark.identity import digest_of
from zsp_lite.benchmark.methods import GROUPS, METHODS, Method, fingerprint, resolve
from zsp_lite.benchmark.problem import Answer, as_answer
from zsp_lite.benchmark.robustness import Damaged
from zsp_lite.benchmark.run import evaluate
from zsp_lite.errors import InputError
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.verified import VerifiedSolver

BACKBONE = CoordinateBackbone(grid=8)
TESTS = Path(__file__).parent


def test_your_own_method_is_a_row_like_any_other(tmp_path):
    settings = {"pairs": 3, "targets": 2, "categories": ["lump"]}

    def last_patch(sim, on1, on2):
        return torch.zeros(len(on1), dtype=torch.long), torch.where(on1, 1.0, -torch.inf).double()

    mine = {
        "function": lambda problem: problem.estimate().sim3,
        "object": ZeroShotPose(BACKBONE),
        "matcher": Method(settings={"matcher": last_patch}),
        "imported": "benchmark_folder:own_method",
        "ours": "ours",
    }
    rows = evaluate(small_folder(), BACKBONE, mine, out=tmp_path, **settings)["methods"]
    assert list(rows) == list(mine) and all(row["n"] == 3 for row in rows.values())
    assert all(found["view"] == 0 for found in read_records(tmp_path).rows["imported"].values())
    again = evaluate(small_folder(), BACKBONE, ["benchmark_folder:own_method"], out=tmp_path / "b", **settings)
    named = again["methods"]["benchmark_folder:own_method"]
    assert named == {key: rows["imported"][key] for key in named}


def test_a_method_that_has_changed_does_not_mix_with_its_former_self(tmp_path):
    settings = {"pairs": 1, "targets": 2, "categories": ["lump"], "out": tmp_path}
    evaluate(small_folder(), BACKBONE, {"mine": own_method}, **settings)
    evaluate(small_folder(), BACKBONE, {"mine": own_method, "ours": "ours"}, **settings)
    with pytest.raises(InputError, match="mine.*changed"):
        evaluate(small_folder(), BACKBONE, {"mine": lambda problem: np.eye(3)}, **settings)


def one_way(similarity, on_reference, on_target):
    score, partner = similarity.max(dim=1)
    return partner, score.double()


def turned_by(angle):
    return lambda problem: angle * np.eye(3)


class OwnEstimator:
    def __init__(self, k, weights=None):
        self.k, self.weights, self._cache = k, weights, object()

    def estimate(self, reference, targets):
        raise NotImplementedError


@pytest.mark.parametrize(
    "make",
    [
        lambda k: Method(settings={"matcher": one_way, "k": k}),
        lambda k: Method(solve=functools.partial(own_method, k=k)),
        lambda k: turned_by(k),
        lambda k: OwnEstimator(k),
        lambda k: OwnEstimator(1, np.arange(k)),
        lambda k: ZeroShotPose(BACKBONE, k=k),
        lambda k: ZeroShotPose(CoordinateBackbone(frequencies=k)),
    ],
)
def test_a_row_of_ones_own_is_known_by_all_of_its_settings(make):
    first, again, other = (fingerprint(resolve({"mine": make(k)})["mine"]) for k in (30, 30, 70))
    assert first == again != other


class Mode(enum.Enum):
    A, B = 1, 2


@functools.lru_cache
def first_remembered(problem):
    return problem, 1


@functools.lru_cache
def second_remembered(problem):
    return problem, 2


class Slotted:
    __slots__ = ("k",)

    def __init__(self, k):
        self.k = k


@pytest.mark.parametrize(
    "first, second",
    [
        (Mode.A, Mode.B),
        (first_remembered, second_remembered),
        (Slotted(1), Slotted(2)),
        (torch.zeros(3, dtype=torch.bfloat16), torch.ones(3, dtype=torch.bfloat16)),
        (torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)),
        (np.zeros(4), np.zeros((2, 2))),
        ({"a": {1, 2}}, {"a": {1, 3}}),
    ],
)
def test_what_differs_is_told_apart(first, second):
    assert digest_of(first) == digest_of(first) != digest_of(second)


def test_a_class_that_was_typed_in_is_known_by_its_members():
    made = []
    for k in (30, 30, 70):
        space = {}
        exec(f"class Typed:\n    k = {k}\n    @staticmethod\n    def solve(problem):\n        return problem", space)
        made.append(digest_of(space["Typed"]()))
    assert made[0] == made[1] != made[2]


def test_comments_and_docstrings_do_not_make_another_function():
    made = []
    for text, result in (("'One.'", 1), ("'Two.'  # three", 1), ("'One.'", 2)):
        space = {}
        exec(f"def own(problem):\n    {text}\n    return problem, {result}", space)
        made.append(digest_of(space["own"]))
    assert made[0] == made[1] != made[2]


def compile_otherwise(monkeypatch, function):
    """Give a function other bytecode, as another version of Python does."""
    function = inspect.unwrap(function)
    code = function.__code__
    monkeypatch.setattr(function, "__code__", code.replace(co_code=code.co_code + bytes([dis.opmap["NOP"], 0])))


def test_a_function_with_source_is_known_by_it_whatever_the_bytecode(monkeypatch):
    before = digest_of(own_method)
    compile_otherwise(monkeypatch, own_method)
    assert digest_of(own_method) == before != digest_of(one_way)
    first, second = lambda problem: 1, lambda problem: 2
    assert digest_of(first) != digest_of(second)
    monkeypatch.setattr(own_method, "kmeans", False, raising=False)
    assert digest_of(own_method) != before


@dataclass(frozen=True)
class Settled:
    k: int

    def estimate(self, reference, targets):
        return self.k


def test_what_dataclass_generates_does_not_tell_classes_apart(monkeypatch):
    before = digest_of(Settled(1))
    compile_otherwise(monkeypatch, Settled.__init__)
    assert digest_of(Settled(1)) == before != digest_of(Settled(2))


def test_the_code_of_the_library_is_known_by_its_version_not_by_the_row(monkeypatch):
    names = ("icp", "sift", "posecontrast", "ours-holes", "verified-noicp")
    before = {name: fingerprint(METHODS[name]) for name in names}
    assert len(set(before.values())) == len(names)
    for name in ("icp", "sift", "posecontrast"):
        compile_otherwise(monkeypatch, getattr(baseline_rows, name))
    monkeypatch.setattr(Damaged, "__call__", lambda self, problem: 3)
    monkeypatch.setattr(VerifiedSolver, "code_of_another_version", lambda self: 3, raising=False)
    assert {name: fingerprint(METHODS[name]) for name in names} == before
    assert digest_of(Damaged("holes")) != digest_of(Damaged("holes", {"k": 30}))


def git(folder, *arguments):
    author = ["-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run(["git", "-C", str(folder), *author, *arguments], check=True, capture_output=True)


def test_the_revision_is_that_of_the_librarys_folder(tmp_path, monkeypatch):
    package, docs = tmp_path / "package", tmp_path / "docs"
    monkeypatch.setattr(provenance, "_PACKAGE", package)
    revision = provenance.git_revision.__wrapped__
    for path in (package, docs):
        path.mkdir()
        (path / "__init__.py").write_text("a = 1\n")
    git(tmp_path, "init")
    assert revision() is None
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "first")
    first = revision()
    assert first and "modified" not in first

    (docs / "__init__.py").write_text("a = 2\n")
    git(tmp_path, "commit", "-am", "docs")
    (docs / "__init__.py").write_text("a = 3\n")
    assert revision() == first

    found = [first]
    for name, text in (("new.py", "b = 1\n"), ("new.py", "b = 2\n"), ("__init__.py", "a = 2\n")):
        (package / name).write_text(text)
        found.append(revision())
    assert len(set(found)) == 4 and all(one.startswith(f"{first}-modified-") for one in found[1:])
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-m", "library")
    assert revision() not in found and "modified" not in revision()


@pytest.mark.slow
def test_another_process_finds_the_same_identity():
    code = """
import logging
import cv2
from benchmark_folder import own_method
from zsp_lite.benchmark.identity import digest_of
class Own:
    def __init__(self):
        self.sift, self.log, self.also = cv2.SIFT_create(), logging.getLogger("x"), lambda: (own_method, cv2)
digest = digest_of(Own())
"""
    here = {"__name__": "__main__"}
    exec(code, here)
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    command = [sys.executable, "-c", f"{code}print(digest)"]
    environment = os.environ | {"PYTHONPATH": paths, "PYTHONHASHSEED": "1"}
    there = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    assert there.strip() == here["digest"] and len(here["digest"]) == 16


def test_a_backbone_of_ones_own_is_known_by_more_than_its_name():
    def grey(images):
        return BACKBONE([image // 2 for image in images])

    first, again, other = (extractor_fingerprint(one) for one in (BACKBONE, CoordinateBackbone(grid=8), grey))
    assert first == again != other
    assert len({extractor_fingerprint(CoordinateBackbone(frequencies=n)) for n in (8, 32)}) == 2


def test_a_module_in_the_current_folder_is_found(tmp_path, monkeypatch):
    (tmp_path / "rows_of_my_own.py").write_text("def still(problem):\n    return None\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])  # as a console script has it
    assert resolve(["rows_of_my_own:still"])["rows_of_my_own:still"].solve.__name__ == "still"


@pytest.mark.parametrize(
    "answer, told",
    [
        (Answer(2 * np.eye(3)), "not a rotation"),
        (Answer(np.eye(3), details={"error": 1.0}), "details have reserved names: error"),
        (Answer(np.eye(3), details={"matches": np.arange(3)}), "matches is a ndarray"),
    ],
)
def test_an_answer_that_says_too_much_is_refused(answer, told):
    with pytest.raises(InputError, match=told):
        as_answer(answer)


def test_numbers_of_numpy_are_kept_as_numbers():
    assert json.dumps(dict(as_answer(Answer(np.eye(3), details={"inliers": np.int64(3)})).details)) == '{"inliers": 3}'


def test_answers_that_are_none_are_refused_or_fail(tmp_path):
    settings = {"pairs": 1, "targets": 2, "categories": ["lump"], "out": tmp_path}
    rows = {
        "large": lambda problem: Answer(2 * np.eye(3)),
        "words": lambda problem: "north",
        "mirror": lambda problem: np.diag([1.0, 1.0, -1.0]),
        "far view": lambda problem: (np.eye(3), 2),
    }
    summary = evaluate(small_folder(), BACKBONE, rows, **settings)
    assert all(row["failed"] == 1 and row["median"] == 180 for row in summary["methods"].values())
    for methods in ([], {"a": 3}, ["nowhere:nothing"], ["./here.py:nothing"], "nonesuch"):
        with pytest.raises(InputError):
            resolve(methods)


def fails(problem):
    raise KeyError("angle")


class NotANumber(CoordinateBackbone):
    def __call__(self, images):
        return [replace(one, keys=one.keys * float("nan")) for one in super().__call__(images)]


def test_a_row_with_a_bug_ends_the_run_with_one_line_that_says_where(tmp_path):
    settings = {"pairs": 1, "targets": 2, "categories": ["lump"], "out": tmp_path}
    where = r"failed: .*test_benchmark_own_rows.py, line \d+: KeyError: 'angle'"
    rows = {
        "function": (fails, where),
        "object": (type("Estimator", (), {"estimate": lambda self, reference, targets: fails(None)})(), where),
        "view": (lambda problem: (np.eye(3), "first"), "ValueError: invalid literal"),
    }
    for name, (row, told) in rows.items():
        with pytest.raises(InputError, match=told):
            evaluate(small_folder(), BACKBONE, {name: row}, **settings)
    assert read_records(tmp_path).rows == {}


def test_a_backbone_that_answers_nan_ends_the_run_instead_of_counting_pairs_as_failed(tmp_path):
    settings = {"pairs": 1, "targets": 2, "categories": ["lump"], "out": tmp_path}
    with pytest.raises(InputError, match="keys, .* hold values that are not finite"):
        evaluate(small_folder(), NotANumber(grid=8), ["ours"], **settings)
    assert read_records(tmp_path).rows == {}


def test_a_module_that_fails_to_import_is_refused_in_one_line(tmp_path, monkeypatch):
    (tmp_path / "row_that_exits.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match="'row_that_exits:a' cannot be imported: .*py, line 1: SystemExit: 3"):
        resolve(["row_that_exits:a"])


def test_groups_are_made_of_rows_and_rows_of_known_features():
    assert all(name in METHODS for names in GROUPS.values() for name in names)
    assert all(method.features in EXTRACTORS for method in METHODS.values())
    assert list(resolve(["table3", "ours"])) == list(GROUPS["table3"])
    assert not GROUPS.keys() & METHODS.keys()  # a name is a row or a group, never both
    assert set(GROUPS["paper"]) | set(GROUPS["verified-views"]) <= set(GROUPS["all"])
    assert {METHODS[name].targets for name in GROUPS["verified-views"]} == {None, 1, 3, 10}
    assert GROUPS["default"] == ("ours", "ours-bv", "rootsift")
