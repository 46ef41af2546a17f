"""Rows of one's own: what they may be and may return, and how a row, a backbone or a function is told from another."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from benchmark_folder import own_method, small_folder
from synthetic_views import CoordinateBackbone

from zsp_lite.benchmark import identity
from zsp_lite.benchmark.extractors import EXTRACTORS
from zsp_lite.benchmark.identity import fingerprint as extractor_fingerprint
from zsp_lite.benchmark.methods import GROUPS, METHODS, Method, description, resolve
from zsp_lite.benchmark.problem import Answer, as_answer
from zsp_lite.benchmark.records import read_records
from zsp_lite.benchmark.run import evaluate
from zsp_lite.errors import InputError
from zsp_lite.pipeline import ZeroShotPose

BACKBONE = CoordinateBackbone(grid=8)


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


def test_the_library_is_known_by_its_source(tmp_path, monkeypatch):
    monkeypatch.setattr(identity, "_PACKAGE", tmp_path)
    found = []
    for name, text in (("a.py", "x = 1"), ("a.py", "x = 2"), ("b/c.py", ""), ("notes.md", "no source")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
        found.append(identity.library_version.__wrapped__()["source"])
    assert len(set(found)) == 3 and found[2] == found[3]


def test_a_row_is_remembered_by_its_settings_and_the_names_of_its_functions():
    assert description(METHODS["ours-k30"]) == "backbone; pose; k=30"
    assert description(METHODS["verified-mask-n3"]) == "backbone; pose; foreground=mask, solver=verified; 3 views"
    rows = resolve(
        {"own": own_method, "matcher": Method(settings={"matcher": one_way}), "object": ZeroShotPose(BACKBONE, k=7)}
    )
    own, matcher, estimator = map(description, rows.values())
    assert own == "backbone; pose; benchmark_folder:own_method"
    assert matcher == f"backbone; pose; matcher={__name__}:one_way"
    assert "zsp_lite.pipeline:ZeroShotPose" in estimator and "k=7" in estimator
    assert len(set(map(description, METHODS.values()))) == len(METHODS)


def test_a_backbone_of_ones_own_is_known_by_its_name_and_its_weights():
    def grey(images):
        return BACKBONE([image // 2 for image in images])

    class Weighed:
        name = "weighed"

        def __init__(self, value):
            self.value = value

        def state_dict(self):
            return {"value": torch.tensor(self.value)}

    assert extractor_fingerprint(grey).endswith(
        ":test_a_backbone_of_ones_own_is_known_by_its_name_and_its_weights.<locals>.grey"
    )
    first, again, other = (extractor_fingerprint(Weighed(value)) for value in (1.0, 1.0, 2.0))
    assert first == again != other and first.startswith("weighed ")


def test_a_module_in_the_current_folder_is_found(tmp_path, monkeypatch):
    (tmp_path / "rows_of_my_own.py").write_text("def still(problem):\n    return None\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])  # as a console script has it
    (tmp_path / "row_that_exits.py").write_text("raise SystemExit(3)")
    with pytest.raises(InputError, match="'row_that_exits:a' cannot be imported: .*py, line 1: SystemExit: 3"):
        resolve(["row_that_exits:a"])
    assert resolve(["rows_of_my_own:still"])["rows_of_my_own:still"].solve.__name__ == "still"


def test_an_answers_details_are_numbers_and_texts_under_names_of_their_own():
    assert json.dumps(dict(as_answer(Answer(np.eye(3), details={"inliers": np.int64(3)})).details)) == '{"inliers": 3}'
    for details, told in (
        ({"error": 1.0}, "detail error .* another name"),
        ({"matches": np.arange(3)}, "matches .* ndarray"),
    ):
        with pytest.raises(InputError, match=told):
            as_answer(Answer(np.eye(3), details=details))


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
    class NotANumber(CoordinateBackbone):
        def __call__(self, images):
            return [replace(one, keys=one.keys * float("nan")) for one in super().__call__(images)]

    settings = {"pairs": 1, "targets": 2, "categories": ["lump"], "out": tmp_path}
    with pytest.raises(InputError, match="keys, .* hold values that are not finite"):
        evaluate(small_folder(), NotANumber(grid=8), ["ours"], **settings)
    assert read_records(tmp_path).rows == {}


def test_groups_are_made_of_rows_and_rows_of_known_features():
    assert all(name in METHODS for names in GROUPS.values() for name in names)
    assert all(method.features in EXTRACTORS for method in METHODS.values())
    assert not GROUPS.keys() & METHODS.keys()  # a name is a row or a group, never both
    assert not {"swav", "posecontrast"} & {name for names in GROUPS.values() for name in names}  # need a checkpoint
    assert list(resolve(["table3", "ours"])) == list(GROUPS["table3"])
