"""Methods of one's own: what they may be and may return, poses from a file, and how a row is told
from another."""

import csv
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace

import benchmark_folder
import numpy as np
import pytest
import torch
from benchmark_folder import (
    BACKBONE,
    exact_keypoints,
    own_matcher,
    own_method,
    placement,
    run_rows,
    small_folder,
)
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic_views import CoordinateBackbone, true_pose

from zsp_lite.align import align_category
from zsp_lite.alignment import Sim3
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.benchmark import own, runs
from zsp_lite.benchmark.methods import (
    GROUPS,
    METHODS,
    Method,
    description,
    make_extractors,
    resolve,
)
from zsp_lite.benchmark.own import StoredPoses, kind_of
from zsp_lite.benchmark.problem import Answer, FrameStore
from zsp_lite.benchmark.run import evaluate, evaluate_pair
from zsp_lite.benchmark.runs import LINES, fingerprint, read_run
from zsp_lite.benchmark.tables import every_table
from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.exchange import write_questions
from zsp_lite.data.frames import mask_to_bbox
from zsp_lite.data.labels import PoseLabel
from zsp_lite.data.pairs import category_pairs
from zsp_lite.errors import FatalError, InputError
from zsp_lite.pipeline import ZeroShotPose, align_best_view
from zsp_lite.verified import VerifiedSolver
from zsp_lite.views import object_crop

OWN = ("own_method", "own_estimator", "own_matcher", "own_keypoints", "own_solver")


def test_ones_own_things_of_every_kind_are_rows_by_object_and_by_name(tmp_path):
    by_object = {name: getattr(benchmark_folder, name) for name in OWN}
    assert [kind_of(*own) for own in by_object.items()] == [
        "problem",
        "estimator",
        "matcher",
        "keypoints",
        "solver",
    ]
    more = {
        "pipeline": ZeroShotPose(BACKBONE),
        "row": Method(settings={"matcher": own_matcher}),
        "ours": "ours",
    }
    methods, found = run_rows(by_object | more, tmp_path / "a", 3), read_run(tmp_path / "a")
    assert list(methods) == [*OWN, *more] and all(row["failed"] == 0 for row in methods.values())
    assert set(found.row("own_method")["view"]) == {0} and set(
        found.row("own_estimator")["view"]
    ) == {1}
    assert found.row("own_matcher")["error"].equals(found.row("row")["error"])
    assert (
        set(found.row("own_solver")["view"]) == {0}
        and (found.row("own_solver")["inliers"] > 3).all()
    )
    # The pixels of two views are no matches: what they fit is far from the truth, but is fitted.
    assert (found.row("own_keypoints")["inliers"] > 3).all()
    run_rows([f"{name}=benchmark_folder:{name}" for name in OWN], tmp_path / "b", 3)
    named = read_run(tmp_path / "b")
    assert all(named.row(name)["error"].equals(found.row(name)["error"]) for name in OWN)
    assert list(run_rows(["benchmark_folder:own_method"], tmp_path / "c")) == [
        "benchmark_folder:own_method"
    ]


@pytest.mark.parametrize(
    ("thing", "told"),
    [
        (3, "'mine' is of type int, expected"),
        (ZeroShotPose, "'mine' is of type type, expected"),
        (lambda: 0, "a function of one"),
        (lambda a, b, c, d: 0, "a function of one"),
        (lambda *all: 0, "of one"),
        (lambda one, *, other: 0, "a function of one"),
        ("benchmark_folder:nothing", "has no attribute 'nothing'"),
        ("nowhere:nothing", "No module named 'nowhere'"),
        ("./here.py:x", "cannot be imported"),
        ("", "''|no methods"),
        ("our-bv", "'our-bv' is unknown; `zsp-lite benchmark --list`"),
        ("no/such.csv", "no/such.csv"),
        ("ours-n0", "a library row another name"),
    ],
)
def test_what_is_no_method_is_refused_by_one_line_before_anything_is_computed(
    thing, told, tmp_path
):
    refused(told, run_rows, {"mine": thing}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_number_of_arguments_without_a_default_or_the_attribute_kind_tells_what_a_function_is():
    class Network(torch.nn.Module):
        def forward(self, first, second):
            return first

    problem = Network()
    problem.kind = "problem"  # comes before the two arguments
    found = (
        lambda one, other=None, *, third=3: 0,
        lambda one, two, three=3, **options: 0,
        Network(),
        problem,
    )
    assert [kind_of("mine", one) for one in found] == [
        "problem",
        "keypoints",
        "keypoints",
        "problem",
    ]
    solvers = align_best_view, VerifiedSolver(), lambda one, two, three, seed, threshold: 0
    assert [kind_of("mine", one) for one in solvers] == ["solver"] * 3
    assert kind_of("mine", lambda one, two, three, *, seed, level=0.2: 0) == "matcher"
    refused("no methods, expected some", resolve, [])
    for name in ("ours-n0", "ours-n99999"):
        refused(f"{name!r} is unknown", resolve, [name])
    views = resolve(["ours-n4", "ours-bv-n2", "far=benchmark_folder:own_method"])
    assert [(name, row.targets) for name, row in views.items()] == [
        ("ours-n4", 4),
        ("ours-bv-n2", 2),
        ("far", None),
    ]


def test_a_method_that_has_changed_does_not_mix_with_its_former_self(tmp_path):
    run_rows({"mine": own_method}, tmp_path)
    run_rows({"mine": own_method, "ours": "ours"}, tmp_path)
    with pytest.raises(
        InputError, match="methods of mine .*:own_method, this is .*<lambda>; choose"
    ):
        run_rows({"mine": lambda problem: np.eye(3)}, tmp_path)


TAKEN = [
    "ours",
    "sift",
    "ours-n3",
    "verified-n0",
    "category",
    "table1",
    "SIFT",
    "Ours (K=50)",
    "ours@threshold=0.1",
    "verified-n3@threshold=0.1",
    "alignment",
    " ours",
    "Sift",
    "OURS (k=50)",
]


class Posing(StoredPoses):
    """A row that equals every row of the library, and is poses of a file, too."""

    def __eq__(self, other):
        return True

    def __call__(self, problem):
        return keep(self._poses, "posing", np.eye(3), problem)

    def remark(self, dataset, pairs):
        return ""


@pytest.mark.parametrize("name", TAKEN)
def test_nothing_takes_the_name_of_a_row_of_the_library_or_the_paper(name):
    told = re.escape(
        f"method {name!r} gives a library row another name, or a name of its or the paper's away"
    )
    for thing in (
        "benchmark_folder:own_method",
        own_method,
        "ours-k30",
        Method(settings={"k": 3}),
        Posing("", {}, ""),
    ):
        refused(told, resolve, {name: thing})
    refused("or a name of its", resolve, [" sift=benchmark_folder:own_method"])
    refused("'mine' gives a library row another name", resolve, ["mine=oracle-view-n3"])
    assert list(resolve(["ours", "default", "verified-n3"])) == [
        "ours",
        "ours-bv",
        "rootsift",
        "verified-n3",
    ]


def test_of_two_methods_with_one_name_none_is_lost():
    refused(
        "mine=.*own_method, mine=.* are two of one name",
        resolve,
        [f"mine=benchmark_folder:{one}" for one in OWN],
    )


def test_exact_keypoints_give_the_exact_pose_in_the_view_with_most_of_them():
    dataset = Co3D(small_folder())
    store = FrameStore(dataset, {"backbone": BACKBONE})
    exact = exact_keypoints(dataset, "lump")
    rows = resolve(
        {"exact": exact, "one score": lambda first, second: (*exact(first, second)[:2], 0.5)}
    )
    for pair in category_pairs(dataset, "lump", 4, 3):
        found = evaluate_pair(pair, rows, rows, store)["results"]
        reference, targets = dataset.load_pair(pair)
        reference, *targets = (object_crop(frame, None).rgb for frame in (reference, *targets))
        counts = [len(exact(reference, target)[0]) for target in targets]
        one = found["exact"]
        assert one["view"] == np.argmax(counts) and one["inliers"] == max(counts) > 20
        assert (
            one["error"] < 0.1
            and one["scale"] == pytest.approx(1, abs=1e-3)
            and one["translation"] < 1e-3
        )
        assert found["one score"]["view"] == 0 and found["one score"]["inliers"] == counts[0]


def test_a_matcher_of_keypoints_gets_the_crops_at_the_resolution_of_the_frames(tmp_path):
    seen, dataset = {}, Co3D(small_folder())
    run_rows(
        {"mine": lambda first, second: keep(seen, len(seen), NONE, first, second)}, tmp_path, 1, 1
    )
    (pair,) = category_pairs(dataset, "lump", 1, 1)
    reference, (target,) = dataset.load_pair(pair)
    for image, frame in zip(seen[0], (reference, target), strict=True):
        top, left, height, width = mask_to_bbox(frame.mask)
        np.testing.assert_array_equal(image, frame.rgb[top : top + height, left : left + width])


def test_a_sweep_makes_a_row_of_each_threshold_and_says_where_it_belongs(tmp_path):
    keypoints, solver, values = (
        benchmark_folder.own_keypoints,
        benchmark_folder.own_solver,
        [0.001, 0.2],
    )
    rows = {"mine": keypoints, "solved": solver, "verified-n2": "verified-n2"}
    assert list(resolve(rows, values)) == [
        f"{name}@threshold={value}" for name in rows for value in values
    ]
    evaluate(small_folder(), BACKBONE, rows, {"lump": 2}, 2, tmp_path, sweep=values)
    found = read_run(tmp_path)
    for name in ("mine", "solved"):
        few, many = (found.row(f"{name}@threshold={value}")["inliers"] for value in values)
        assert (few < many).all(), name
    assert (
        "on validation categories, never on those that are evaluated"
        in next(iter(every_table(found.summary))).note
    )
    run_rows(rows, tmp_path / "default", 2)
    for name in rows:
        default = read_run(tmp_path / "default").row(name)["error"]
        assert default.equals(found.row(f"{name}@threshold=0.2")["error"]), name
    refused(
        "'own' has no threshold, expected a matcher or a solver",
        resolve,
        {"own": own_method},
        [0.1],
    )
    refused("threshold is -1, expected", resolve, {"mine": keypoints}, [-1])


def test_keypoints_that_fit_no_pose_are_noted_and_those_that_are_none_fail(tmp_path):
    none, ones = np.zeros((0, 2)), np.ones((9, 2))
    rows = {
        "none": lambda first, second: (none, none, none[:, 0]),
        "empty": lambda first, second: ([], [], []),
        "words": lambda first, second: ("a", "b", [1]),
        "uneven": lambda first, second: (ones, ones[1:], ones[:, 0]),
    }
    found = run_rows(rows, tmp_path)
    assert [row["failed"] for row in found.values()] == [0, 0, 1, 1]
    assert (
        read_run(tmp_path)
        .row("none")["note"]
        .iloc[0]
        .startswith("pose is the best view's, not a fit: ")
    )
    told = "matched points are 9 and 8, expected as many in both images"
    assert read_run(tmp_path).row("uneven")["failed"].iloc[0] == told
    for number in (-1.0, np.nan):
        run_rows({f"{number}": lambda first, second, number=number: (ones, ones, number)}, tmp_path)
        told = "scores of matches are negative or NaN, expected 0 or more"
        assert read_run(tmp_path).row(f"{number}")["failed"].iloc[0] == told
    run_rows({"turned": lambda first, second: (ones.T, ones.T, ones[:, 0])}, tmp_path)
    assert (
        read_run(tmp_path)
        .row("turned")["failed"]
        .str.contains("matched points has shape .2, 9., expected")
        .all()
    )


COLUMNS = "pair,target_frame,rotation,translation,scale"


def exact_pose(dataset, pair):
    """The true pose of a pair in its second target view."""
    ends = (
        (pair.reference_sequence, pair.reference_frame),
        (pair.target_sequence, pair.target_frames[1]),
    )
    known = (
        (dataset.camera(dataset.frame("lump", *end)), placement("lump", end[0])) for end in ends
    )
    return true_pose(*(part for one in known for part in one))


def test_poses_from_a_file_are_measured_like_any_others(tmp_path):
    """As another program would: it reads the questions, and answers in any of the target views."""
    dataset, lines = Co3D(small_folder()), [COLUMNS]
    pairs = category_pairs(dataset, "lump", 4, 3)
    for pair in pairs[:3]:
        pose = exact_pose(dataset, pair)
        numbers = (" ".join(map(repr, part.ravel().tolist())) for part in (pose.R, pose.t))
        lines.append(f'"{pair.key}",{pair.target_frames[1]},{",".join(numbers)},1.0')
    (tmp_path / "exact.csv").write_text("\n".join(lines))
    (tmp_path / "rotations.csv").write_text("\r\n".join(line.rsplit(",", 2)[0] for line in lines))
    rows = {name: f"{tmp_path / name}.csv" for name in ("exact", "rotations")}
    run_rows(rows, tmp_path / "run", 4, 3)
    for name, path in rows.items():
        found = read_run(tmp_path / "run").row(name)
        answered = found.loc[[pair.key for pair in pairs[:3]]]
        assert (answered["error"] < 1e-5).all() and (answered["view"] == 1).all()
        known = answered[["translation", "scale"]].to_numpy(float)
        assert (
            np.isnan(known).all() if name == "rotations" else np.allclose(known, (0, 1), atol=1e-9)
        )
        assert found.loc[pairs[3].key, ["error", "failed"]].tolist() == [180, f"{path} has no pose"]
    (tmp_path / "exact.csv").write_text("\n".join(lines[:2]))  # other poses under the same name
    refused("a run with methods of exact", run_rows, rows, tmp_path / "run", 4, 3)
    refused(
        "exact.csv has no pose for any of the pairs",
        run_rows,
        rows,
        tmp_path / "other",
        6,
        2,
        "pebble",
    )
    (tmp_path / "views.csv").write_text(
        "\n".join(lines).replace(f'",{pairs[0].target_frames[1]},', '",99,', 1)
    )
    view = [f"view={tmp_path / 'views.csv'}"]
    refused(
        "views.csv, line 2: target_frame is 99, expected one of .*, ",
        run_rows,
        view,
        tmp_path / "other",
        4,
        3,
    )


def test_each_pair_has_its_own_pose_and_missing_ones_are_told(tmp_path, monkeypatch):
    """Here the pairs differ in a target frame, and both are answered in the frame that they
    share."""
    pairs = [Pair("lump", "100_a", 0, "200_b", (3, last)) for last in (4, 5)]
    monkeypatch.setattr(
        "zsp_lite.benchmark.run.pairs_of_rows", lambda *_: dict.fromkeys(pairs, ["both", "one"])
    )
    turns = "1 0 0 0 1 0 0 0 1", "0 -1 0 1 0 0 0 0 1"
    lines = [COLUMNS, *(f'"{pair.key}",3,{turn},,' for pair, turn in zip(pairs, turns))]
    for name, text in (("both", lines), ("one", lines[:2])):
        (tmp_path / f"{name}.csv").write_text("\n".join(text))
    rows = run_rows(
        {name: f"{tmp_path / name}.csv" for name in ("both", "one")}, tmp_path / "run", 2
    )
    found = read_run(tmp_path / "run")
    assert [(row["n"], row["failed"]) for row in rows.values()] == [(2, 0), (2, 1)]
    assert found.row("both")["error"].nunique() == 2
    note = next(iter(every_table(found.summary))).note
    assert re.match(
        "one failed on 1 of 2 pairs, counted as 180°; the first: .*one.csv has no pose", note
    )
    assert "both" not in note


FLIP = np.diag([1.0, -1.0, -1.0])
CONVENTIONS = {
    "": lambda R: R,
    "inverted": lambda R: R.T,
    "conjugated by diag(1, -1, -1)": lambda R: FLIP @ R @ FLIP,
    "inverted and conjugated by diag(1, -1, -1)": lambda R: FLIP @ R.T @ FLIP,
    "conjugated by diag(-1, -1, 1)": lambda R: R * np.outer((-1, -1, 1), (-1, -1, 1)),
}


@pytest.mark.parametrize("convention", [*CONVENTIONS, "none", "inverted in eight of twelve"])
def test_a_spreadsheets_poses_are_read_and_the_note_names_their_convention(
    tmp_path, caplog, convention
):
    dataset, lines = (
        Co3D(small_folder()),
        [COLUMNS.replace(",", ";"), "lump/x:1/y:2;2;1 0 0 0 1 0 0 0 1;;"],
    )
    for pair in category_pairs(dataset, "lump", 12, 3):
        pose = exact_pose(dataset, pair)
        # as of a method that confuses left and right
        mixed = pose.R.T if len(lines) < 10 else pose.R
        other = (
            Rotation.random(random_state=len(lines)).as_matrix() if convention == "none" else mixed
        )
        rotation = CONVENTIONS.get(convention, lambda R, other=other: other)(pose.R)
        numbers = " ".join(f"{value:.4f}".replace(".", ",") for value in rotation.ravel())
        lines.append(f"{pair.key};{pair.target_frames[1]};{numbers};;")
    (tmp_path / "mine.csv").write_text("\ufeff" + "\r\n".join(lines), encoding="utf-8")
    run_rows({"mine": str(tmp_path / "mine.csv")}, tmp_path / "run", 12, 3)
    found = read_run(tmp_path / "run")
    told = "mine: 1 of 13 poses fit no pair"
    if convention in [*CONVENTIONS][1:]:
        told += f"; rotations agree with the labels if {convention}: median 0° in place of "
    run_rows(["oracle-view"], tmp_path / "run", 12, 3)  # the note stays with the row
    for note in (found.summary["note"], caplog.text, read_run(tmp_path / "run").summary["note"]):
        assert told in note and ("agree with" in note) == ("agree with" in told)
    assert (found.row("mine")["error"].max() < 0.01) == (convention == "")


RIGHT = '"lump/a:0/b:1,5",1,1 0 0 0 1 0 0 0 1,0 0 1,1'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "a CSV file"),
        ("\xff", "codec.* a CSV file"),
        (f"{COLUMNS}\nlump/a:0/b:1", "line 2: "),
        ("pair,scale", "columns target_frame, rotation"),
        (f"{COLUMNS}\n{RIGHT}x", "line 2: .*1x"),
        (
            f"{COLUMNS}\n{RIGHT}\n{RIGHT.replace('0 0 0 1,', '0 0 0,')}",
            "line 3: rotation has shape .8,., exp",
        ),
        (f"{COLUMNS}\n\n{RIGHT.replace(',1 0', ',nan 0')}", "line 3: rotation holds nan"),
        (f"{COLUMNS}\n{RIGHT.replace(',1 0', ',-1 0')}", "line 2: "),
        (f"{COLUMNS}\n{RIGHT[:-1]}0", "scale is 0.0"),
        (f"{COLUMNS}\n{RIGHT.replace(',1,', ',1.000,')}", "line 2: .*'1.000'"),  # or a thousand
        (
            f"{COLUMNS}\n{RIGHT.replace(',0 0 1,', ',0 0,')}",
            "line 2: translation has shape .2,., expected",
        ),
        (
            f"{COLUMNS}\n{RIGHT}\n\n{RIGHT.replace(',1,1', ',5,1')}",
            "line 4: second pose of the pair of line 2",
        ),
        (f"{COLUMNS}\n{RIGHT},surplus", "line 2: more fields than the header"),
        (
            f"{COLUMNS}\n{RIGHT}".replace('"', ""),
            "line 2: more fields than the header; a pair has commas and needs quotes",
        ),
        (f"{COLUMNS},Scale,ROTATION\n{RIGHT},,", "columns rotation"),
    ],
)
def test_wrong_files_of_poses_are_refused_with_path_and_line(text, told, tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text(text, encoding="latin-1")
    refused(f"poses {re.escape(str(path))}.*{told}", resolve, [f"theirs={path}"])
    saved = f"{COLUMNS.title()},,\n,,,,,,\n{RIGHT},,\n".replace("_", " ")
    path.write_text(saved, encoding="utf-16")
    assert resolve([f"theirs={path}"])["theirs"].solve._poses.keys() == {"lump/a:0/b:1,5"}


def test_the_questions_have_a_line_for_each_frame_with_its_files_and_camera(tmp_path):
    dataset = Co3D(small_folder())
    pairs = [*category_pairs(dataset, "lump", 2, 3), *category_pairs(dataset, "pebble", 1, 3)]
    with open(write_questions(tmp_path / "pairs.csv", dataset, pairs), newline="") as file:
        lines = list(csv.DictReader(file))
    asked = []
    for pair in pairs:
        asked += [
            (
                pair.key,
                "reference",
                pair.category,
                pair.reference_sequence,
                f"{pair.reference_frame}",
            )
        ]
        asked += [
            (pair.key, "target", pair.category, pair.target_sequence, f"{n}")
            for n in pair.target_frames
        ]
    assert [tuple(line.values())[:5] for line in lines] == asked
    points = np.random.default_rng(0).normal(size=(20, 3))
    for line in lines:
        assert all((dataset.root / line[name]).is_file() for name in ("image", "depth", "mask"))
        assert float(line["depth_scale"]) > 0
        numbers = {
            name: np.array(line[name].split(), float) for name in ("fx", "fy", "cx", "cy", "R", "t")
        }
        focal, middle = (
            np.array([*numbers["fx"], *numbers["fy"]]),
            np.array([*numbers["cx"], *numbers["cy"]]),
        )
        frame = dataset.load(dataset.frame(line["category"], line["sequence"], int(line["frame"])))
        camera = Camera(numbers["R"].reshape(3, 3), numbers["t"], focal, middle, frame.camera.size)
        np.testing.assert_allclose(
            camera.project(points)[0], frame.camera.project(points)[0], atol=1e-9
        )


def test_a_row_is_remembered_by_its_settings_and_the_names_of_its_functions():
    assert description(METHODS["ours-k30"]) == "backbone; pose; k=30"
    (views,) = resolve(["verified-mask-n3"]).values()
    assert description(views) == "backbone; pose; foreground=mask, solver=verified; 3 views"
    rows = resolve(
        {"own": own_method, "matcher": own_matcher, "object": ZeroShotPose(BACKBONE, k=7)}
    )
    own, matcher, estimator = map(description, rows.values())
    assert own == "backbone; pose; benchmark_folder:own_method"
    assert matcher == "backbone; pose; matcher=benchmark_folder:own_matcher"
    assert "zsp_lite.pipeline:ZeroShotPose" in estimator and "k=7" in estimator
    assert len(set(map(description, METHODS.values()))) == len(METHODS)


def test_a_module_in_the_current_folder_is_found(tmp_path, monkeypatch):
    (tmp_path / "rows_of_my_own.py").write_text(
        "import os\nos.chdir('/')\ndef still(problem):\n    return None\n"
    )
    monkeypatch.chdir(tmp_path)
    # as a console script has it
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    (tmp_path / "row_that_exits.py").write_text("raise SystemExit(3)")
    refused(
        "'row_that_exits:a' cannot be imported: .*py, line 1: SystemExit: 3",
        resolve,
        ["row_that_exits:a"],
    )
    assert resolve(["rows_of_my_own:still"])["rows_of_my_own:still"].solve.__name__ == "still"
    assert Path.cwd() == tmp_path


def test_an_answer_is_a_rotation_in_a_view_or_the_pair_fails_and_its_numbers_can_be_stored(
    tmp_path, caplog
):
    rows = {
        "large": lambda problem: Answer(2 * np.eye(3)),
        "words": lambda problem: "north",
        "mirror": lambda problem: np.diag([1.0, 1.0, -1.0]),
        "far view": lambda problem: (np.eye(3), 2),
        "nowhere": lambda problem: Answer(np.eye(3), translation=np.full(3, np.nan)),
    }
    assert all(
        row["failed"] == 1 and row["median"] == 180 for row in run_rows(rows, tmp_path).values()
    )
    told = "large failed on 1 of 1 pairs, counted as 180°; the first: Sim3: R is [[2.0, 0.0, 0.0], "
    assert told in caplog.text and told in next(iter(every_table(read_run(tmp_path).summary))).note
    run_rows(
        {"sure": lambda problem: Answer(np.eye(3), note="x" * 10**6, inliers=4, confidence=1 / 3)},
        tmp_path,
    )
    found = read_run(tmp_path).row("sure")
    assert (
        found[["inliers", "confidence"]].to_numpy().tolist() == [[4, 0.3333]]
        and len(found["note"].iloc[0]) == 1000
    )
    for wrong in ({"inliers": "many"}, {"confidence": 2.0}, {"note": "\udcff"}, {"view": 0.5}):
        (name,) = wrong
        run_rows({name: lambda problem, wrong=wrong: Answer(np.eye(3), **wrong)}, tmp_path)
        assert read_run(tmp_path).row(name)["failed"].str.contains("Error: ").all()


def test_a_row_may_answer_in_few_digits(tmp_path):
    exact = Rotation.from_rotvec([0.3, 0.5, -0.2]).as_matrix()
    rows = {
        "exact": lambda problem: exact,
        "half": lambda problem: exact.astype(np.float16),
        "decimals": lambda problem: Answer(exact.round(4)),
        "sim3": lambda problem: Sim3(1.0, exact.round(3), np.ones(3)),
    }
    found = run_rows(rows, tmp_path, 2)
    assert [row["failed"] for row in found.values()] == [0] * 4
    assert [row["median"] for row in found.values()] == pytest.approx(
        [found["exact"]["median"]] * 4, abs=0.1
    )


def overwrite(*frames):
    for frame in frames:
        frame.rgb[:], frame.depth[:], frame.mask[:] = 0, 1, 1


class Vandal:
    """Rows of every kind that overwrite all that they get."""

    def problem(self, problem):
        found = problem.estimate(settings={"solver": "verified"})
        found.matches.reference[:], found.sim3.R[:] = 0, np.eye(3)
        for view in (*problem.views(), *problem.estimate().target_views):
            view.features.keys[:], view.features.saliency[:], view.foreground[:] = 0, 0, False
        overwrite(*problem.frames())
        return np.eye(3)

    def matcher(self, similarity, first, second):
        similarity[:], first[:], second[:] = 0, False, False
        return torch.zeros(len(first), dtype=torch.long), torch.zeros(len(first))

    def keypoints(self, first, second):
        first[:], second[:] = 0, 0
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)

    def estimate(self, reference, targets):
        overwrite(reference, *targets)
        return np.eye(3)


def test_rows_do_not_reach_each_other_in_any_order(tmp_path):
    vandal = Vandal()
    own = {
        "problem": vandal.problem,
        "matcher": vandal.matcher,
        "keypoints": vandal.keypoints,
        "estimator": vandal,
    }
    library = {name: name for name in ("ours", "verified", "sift", "ours-mask", "icp", "scans-2")}
    for name, rows in (("alone", library), ("last", own | library), ("first", library | own)):
        run_rows(rows, tmp_path / name, 2)
    alone, *others = (read_run(tmp_path / name) for name in ("alone", "last", "first"))
    times = ["seconds", "milliseconds"]
    for name in library:
        for run in others:
            found, expected = run.row(name), alone.row(name)
            assert found.drop(columns=times).equals(expected.drop(columns=times)), name


@pytest.mark.slow
def test_workers_may_have_another_current_folder_than_the_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with ProcessPoolExecutor(1, get_context("spawn"), os.chdir, ("/",)) as executor:
        found = evaluate(small_folder(), "zsp-tiny", ["icp"], {"lump": 2}, 2, "run", executor)
    assert found["methods"]["icp"]["n"] == 2


def fails(problem):
    raise KeyError("angle")


class Untold(Exception):
    def __str__(self):
        return None


def untold(problem):
    raise Untold


def leaves_a_thread(problem):
    threading.Thread(target=time.sleep, args=[600]).start()


def never_ends(problem):
    with suppress(BaseException):  # catches what ends it, the first time
        while True:
            pass
    while True:
        pass


def keep(handed, name, answer, *things):
    """A row that keeps what it gets."""
    handed.setdefault(name, things)
    return answer


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_row_that_fails_does_not_stop_the_others(workers, tmp_path, monkeypatch, caplog):
    rows = {
        "problem": (fails, r"/.*test_benchmark_own_rows.py, line \d+: KeyError: 'angle'"),
        "estimator": (
            SimpleNamespace(estimate=lambda reference, targets: fails(None)),
            ".*KeyError",
        ),
        "keypoints": (lambda first, second: fails(None), ".*KeyError"),
        "matcher": (lambda similarity, first, second: fails(None), ".*KeyError"),
        "solver": (lambda reference, targets, matched, seed, threshold: fails(None), ".*KeyError"),
        "no estimate": (
            lambda reference, targets, matched, seed, threshold: np.eye(3),
            ".*AttributeError",
        ),
        "answer": (lambda problem: (np.eye(3), "first"), ".*ValueError: invalid literal"),
        "exit": (lambda problem: sys.exit("\udcff"), r".*SystemExit: \?"),
        "backbone": (ZeroShotPose(lambda images: []), ".*FatalError: backbone .* returned 0"),
        "endless": (never_ends, "takes more than 1 s"),
        "untold": (untold, ".*Untold: <exception str"),
        "memory": (lambda problem: np.zeros(10**15), ".*MemoryError: "),
        "else": (lambda problem: os.chdir("/"), ""),
        "unsure": (
            lambda problem: Answer(np.eye(3), confidence=np.nan),
            ".*Error: Expected `float`",
        ),
        **({"thread": (leaves_a_thread, "pose of the row is None")} if workers > 1 else {}),
    }
    monkeypatch.chdir(tmp_path)
    every = {name: row for name, (row, _) in rows.items()} | {"ours": "ours"}
    found = evaluate(
        small_folder(), BACKBONE, every, {"lump": 2}, 2, "run", workers, row_seconds=1
    )["methods"]
    assert found.pop("ours") == run_rows(["ours"], tmp_path / "alone", 2)["ours"]
    for name, (_, told) in rows.items():
        assert (
            re.match(told, read_run("run").row(name)["failed"].iloc[0])
            and found[name]["median"] == 180
        )
        assert f"{name} failed on 2 of 2 pairs" in caplog.text


def test_a_row_that_ends_at_its_time_limit_leaves_nothing_behind():
    threads = threading.active_count()
    for delay in np.linspace(0.998, 1.002, 7):
        with suppress(InputError), own.fails_alone(1):
            time.sleep(delay)
    assert threading.active_count() == threads and sum(range(100_000))
    # Python 3.11 never enters a function under a profiler or debugger while it waits for what was
    # raised from outside.
    profiled = "import sys; sys.setprofile(lambda *_: None); (lambda: None)()"
    watched = (
        f"from zsp_lite.benchmark.own import fails_alone\nwith fails_alone(1): pass\n{profiled}"
    )
    subprocess.run([sys.executable, "-c", watched], check=True, timeout=60)


INNER = (
    "__dict__",
    "__self__",
    "__func__",
    "__wrapped__",
    "func",
    "args",
    "keywords",
    "__closure__",
    "cell_contents",
    "__defaults__",
    "__kwdefaults__",
)
ENDS = ModuleType | type | torch.nn.Module | torch.Tensor | np.ndarray


def reached(thing) -> list:
    """Return all that an object leads to, up to torch's modules, arrays and functions of installed
    packages."""
    seen, todo = {}, [thing]
    while todo:
        thing = todo.pop()
        if id(thing) in seen or isinstance(thing, ENDS):
            continue
        seen[id(thing)] = thing
        if not isinstance(thing, FunctionType) or "site-packages" not in thing.__code__.co_filename:
            names = *INNER, *getattr(thing, "__slots__", ())
            todo += [getattr(thing, name) for name in names if hasattr(thing, name)]
            todo += [*thing.keys(), *thing.values()] if isinstance(thing, Mapping) else []
            todo += thing if isinstance(thing, list | tuple | set) else []
    return list(seen.values())


NONE = np.zeros((0, 2)), np.zeros((0, 2)), 0.0  # no keypoints


def test_nothing_that_a_row_of_ones_own_gets_leads_to_a_label(tmp_path):
    handed, solve = {}, benchmark_folder.own_solver
    rows = {
        "problem": lambda one: keep(
            handed, "problem", np.eye(3), one, one.frames(), one.views(), one.estimate()
        ),
        "method": Method(solve=lambda one: keep(handed, "method", np.eye(3), one)),
        "posing": Method(solve=Posing("", handed, "")),
        "estimator": SimpleNamespace(
            estimate=lambda *frames: keep(handed, "estimator", np.eye(3), frames)
        ),
        "keypoints": lambda one, two: keep(handed, "keypoints", NONE, one, two),
        "matcher": lambda one, two, three: keep(
            handed, "matcher", own_matcher(one, two, three), one, two, three
        ),
        "solver": lambda a, b, c, seed, threshold: keep(handed, "solver", solve(a, b, c), a, b, c),
    }
    found = run_rows({"icp": "icp", "scans-2": "scans-2"} | rows, tmp_path)
    assert not any(row["failed"] for row in found.values()) and handed.keys() == rows.keys()
    for thing in reached(handed):
        assert not isinstance(thing, Co3D | Path | PoseLabel | Pair), thing
        assert not (isinstance(thing, str) and str(small_folder()) in thing), thing


def test_the_pairs_seed_goes_to_every_row_that_takes_one(tmp_path):
    seeds, solve, (pair,) = (
        {},
        benchmark_folder.own_solver,
        category_pairs(Co3D(small_folder()), "lump", 1, 2),
    )
    rows = {
        "problem": lambda problem, seed: (
            keep(seeds, "problem", np.eye(3), seed) if seed == problem.seed else None
        ),
        "estimator": SimpleNamespace(
            estimate=lambda one, others, seed=0: keep(seeds, "estimator", np.eye(3), seed)
        ),
        "keypoints": lambda first, second, *, seed: keep(seeds, "keypoints", NONE, seed),
        "matcher": lambda one, two, three, seed=0: keep(
            seeds, "matcher", own_matcher(one, two, three), seed
        ),
        "solver": lambda a, b, c, *, seed, threshold: keep(seeds, "solver", solve(a, b, c), seed),
    }
    run_rows(rows | {"pipeline": ZeroShotPose(BACKBONE), "ours": "ours"}, tmp_path)
    assert seeds == dict.fromkeys(rows, (pair.seed,))
    assert (
        read_run(tmp_path).row("pipeline")["error"].equals(read_run(tmp_path).row("ours")["error"])
    )


class Broken(CoordinateBackbone):
    """A backbone with what is wrong in its feature maps."""

    wrong = None

    def __call__(self, images):
        return type(self).wrong(super().__call__(images))


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (
            lambda maps: [replace(one, keys=one.keys * float("nan")) for one in maps],
            "values that are not finite",
        ),
        (lambda maps: [replace(one, keys=one.keys[:, :0]) for one in maps], "have shapes"),
        (lambda maps: maps[1:], r"returned \d of"),
        (lambda maps: maps[9], "IndexError"),
    ],
)
@pytest.mark.parametrize(
    "run", ["ours", "category", lambda problem: problem.views() and np.eye(3), own_matcher, "align"]
)
def test_a_broken_backbone_ends_the_run_and_nothing_is_stored(
    tmp_path, monkeypatch, wrong, told, run
):
    monkeypatch.setattr(Broken, "wrong", staticmethod(wrong))
    backbone = Broken(grid=8)
    with pytest.raises(FatalError, match=told):
        if run == "align":
            align_category(Co3D(small_folder()), "lump", backbone, targets=2, out=tmp_path)
        else:
            run_rows([run] if isinstance(run, str) else {"row": run}, tmp_path, backbone=backbone)
    assert not (tmp_path / LINES).read_bytes()


@pytest.mark.parametrize("run", ["category", "align"])
def test_an_unreadable_frame_ends_the_run_and_nothing_is_stored_for_its_pairs(
    tmp_path, run, monkeypatch
):
    def read(dataset, annotation):
        if annotation.sequence_name == "300_c":
            raise InputError("image 300_c cannot be decoded")
        return load(dataset, annotation)

    load = Co3D.load
    monkeypatch.setattr(Co3D, "load", read)
    with pytest.raises(FatalError, match="300_c cannot be decoded"):
        if run == "align":
            align_category(Co3D(small_folder()), "lump", BACKBONE, targets=2, out=tmp_path)
        else:
            run_rows(["category"], tmp_path, targets=2)
    assert "300_c" not in (tmp_path / LINES).read_text()


def test_groups_are_made_of_rows_and_rows_of_known_features():
    rows = {name: set(resolve(name)) for name in GROUPS}
    assert all(
        row in METHODS or row.rpartition("-n")[0] in METHODS for row in set().union(*rows.values())
    )
    assert make_extractors(BACKBONE, METHODS)["backbone"] is BACKBONE
    assert not GROUPS.keys() & METHODS.keys()  # a name is a row or a group, never both
    assert list(resolve(["table3", "ours"])) == list(GROUPS["table3"])


def test_a_fingerprint_tells_apart_whatever_changes_the_features():
    torch.manual_seed(0)
    vit = VisionTransformer(32, 8, embed_dim=12, depth=3, num_heads=2)

    def of(**options):
        return fingerprint(Backbone(vit, "same name", device="cpu", **options))

    plain = of()
    assert plain == of(layer=2, facet="key", mean=[0.485, 0.456, 0.406])  # the defaults, said aloud
    changes = {
        "layer": 1,
        "facet": "query",
        "saliency_heads": [1],
        "image_size": 64,
        "mean": (0,) * 3,
        "std": (1,) * 3,
    }
    assert len({plain, *(of(**{name: value}) for name, value in changes.items())}) == 1 + len(
        changes
    )
    with torch.no_grad():
        vit.cls_token += 1
    assert of() != plain


def test_a_backbone_of_ones_own_is_known_by_its_name_and_its_weights():
    def grey(images):
        return BACKBONE([image // 2 for image in images])

    def weighed(value):
        return SimpleNamespace(name="weighed", state_dict=lambda: {"value": torch.tensor(value)})

    assert fingerprint(grey).endswith(
        ":test_a_backbone_of_ones_own_is_known_by_its_name_and_its_weights.<locals>.grey"
    )
    first, again, other = (fingerprint(weighed(value)) for value in (1.0, 1.0, 2.0))
    assert first == again != other and first.startswith("weighed ")


def test_the_library_is_known_by_version_and_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "REPOSITORY", tmp_path)
    version, found = runs.library_version.__wrapped__, []
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=b"]
    (tmp_path / "__init__.py").touch()
    for step in (["init"], ["add", "."], ["commit", "-m", "x"]):
        found.append(version()["commit"])
        subprocess.run([*git, *step], check=True, capture_output=True)
    commit = version()["commit"]
    assert found[:2] == [None, None] and len(commit) == 40
    (tmp_path / "__init__.py").write_text("x = 1")
    assert version()["commit"] == f"{commit}-dirty"
