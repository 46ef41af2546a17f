"""A user's own methods: what they may be and may return, poses from a file, and what tells a row
from another."""

import csv
import os
import re
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import benchmark_folder
import cloudpickle
import numpy as np
import pytest
import torch
from benchmark_folder import (
    BACKBONE,
    SEQUENCES,
    own_matcher,
    own_method,
    placement,
    run_rows,
    small_folder,
)
from numpy.testing import assert_allclose
from refusals import refused
from scipy.spatial import KDTree
from synthetic_views import CoordinateBackbone, true_pose

from zsp_lite import Backbone, Camera, Co3D, InputError, Sim3, ZeroShotPose, align_category
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.benchmark import own, runs
from zsp_lite.benchmark.methods import (
    METHODS,
    description,
    resolve,
)
from zsp_lite.benchmark.own import kind_of
from zsp_lite.benchmark.problem import Answer
from zsp_lite.benchmark.run import evaluate, open_evaluator
from zsp_lite.benchmark.runs import LINES, Run, fingerprint, read_run
from zsp_lite.benchmark.tables import every_table
from zsp_lite.data.co3d import Pair
from zsp_lite.data.exchange import write_questions
from zsp_lite.data.pairs import category_pairs
from zsp_lite.errors import FatalError
from zsp_lite.verified import VerifiedSolver
from zsp_lite.views import object_crop

NONE = np.zeros((0, 2)), np.zeros((0, 2)), 0.0  # no keypoints
OWN = ("own_method", "own_estimator", "own_matcher", "own_keypoints", "own_solver")
LIBRARY = {"pipeline": ZeroShotPose(BACKBONE), "ours": "ours"}


@pytest.fixture(scope="module")
def own_run(tmp_path_factory) -> Run:
    """A run of a row of every kind, each given by its name."""
    out = tmp_path_factory.mktemp("own")
    run_rows({name: f"benchmark_folder:{name}" for name in OWN} | LIBRARY, out, pairs=3)
    return read_run(out)


def test_rows_of_every_kind_answer_every_pair(own_run):
    methods = own_run.summary["methods"]
    assert list(methods) == [*OWN, *LIBRARY]
    assert [row["failed"] for row in methods.values()] == [0] * len(methods)
    assert [set(own_run.row(name)["view"]) for name in OWN[:2]] == [{0}, {1}]
    # The pixels of two views are no matches: what they fit is far from the truth, but is fitted.
    for name in ("own_solver", "own_keypoints"):
        assert (own_run.row(name)["inliers"] > 3).all()  # three points determine a pose


@pytest.mark.parametrize(
    "thing, told",
    [
        (ZeroShotPose, "'mine' is of type type, expected"),
        (lambda: 0, "a function of one"),
        (lambda a, b, c, d: 0, "a function of one"),
        ("benchmark_folder:nothing", "has no attribute 'nothing'"),
        ("nowhere:nothing", "No module named 'nowhere'"),
        ("our-bv", "'our-bv' is unknown; `zsp-lite benchmark --list`"),
        ("no/such.csv", "no/such.csv"),
        ("ours-n3", "'mine' is .* another name for one of its rows"),
    ],
)
def test_what_is_no_method_is_refused_by_one_line_before_anything_is_computed(
    thing, told, tmp_path
):
    refused(told, run_rows, {"mine": thing}, tmp_path / "out")
    assert not (tmp_path / "out").exists()


class Network(torch.nn.Module):
    """Takes two arguments."""

    def forward(self, first, second):
        return first


class NetworkOfProblems(Network):
    """Takes two arguments, but says that it takes a problem."""

    kind = "problem"


@pytest.mark.parametrize(
    "thing, kind",
    [
        (lambda one, other=None, *, third=3: 0, "problem"),
        (lambda one, two, three=3, **options: 0, "keypoints"),
        (Network(), "keypoints"),
        (NetworkOfProblems(), "problem"),
        (VerifiedSolver(), "solver"),
        (lambda one, two, three, seed, threshold: 0, "solver"),
        (lambda one, two, three, *, seed, level=0.2: 0, "matcher"),
    ],
)
def test_arguments_without_a_default_or_the_attribute_kind_tell_the_kind(thing, kind):
    assert kind_of("mine", thing) == kind


@pytest.mark.parametrize(
    "rows, message",
    [
        ([], "no methods, expected some"),
        (["ours-n0"], "'ours-n0' is unknown"),
        ({"two\nlines": "ours"}, r"'two\\nlines'.* expected a printable name"),
        (["_hidden:row"], "'_hidden:row'.* not with _ first"),
        (
            [f"mine=benchmark_folder:{one}" for one in OWN],
            "mine=.*own_method, mine=.* are two of one name",
        ),
        *(
            ({name: own_method}, f"{name}' is a name of the library's")
            for name in ("sift", "ours-n3", "ours@threshold=0.1", "table1", "alignment")
        ),
    ],
)
def test_rows_that_cannot_be_are_refused(rows, message):
    refused(message, resolve, rows)


def test_sweeps_that_cannot_be_are_refused():
    told = "'mine' has no threshold, expected a matcher or a solver"
    refused(told, resolve, {"mine": own_method}, [0.1])
    refused("threshold is -1, expected", resolve, {"mine": benchmark_folder.own_keypoints}, [-1])


@pytest.mark.parametrize(
    "thing, described",
    [(own_method, "benchmark_folder:own_method"), (LIBRARY["pipeline"], ".*ZeroShotPose.*")],
)
def test_a_method_that_has_changed_does_not_mix_with_its_former_self(tmp_path, thing, described):
    run_rows({"mine": thing}, tmp_path)
    run_rows({"mine": thing, "ours": "ours"}, tmp_path)
    told = f"methods of mine .*{described}, this is .*<lambda>; choose"
    refused(told, run_rows, {"mine": lambda problem: np.eye(3)}, tmp_path)


def by_colour(first: np.ndarray, second: np.ndarray) -> tuple:
    """Match the pixels of two crops of the object whose colours, its coordinates, are alike."""
    here, there = [np.argwhere(image.min(axis=-1) > 0) for image in (first, second)]
    distance, partner = KDTree(second[tuple(there.T)]).query(first[tuple(here.T)])
    alike = distance < 2
    pixels = here[alike], there[partner[alike]]
    return *(one[:, ::-1] + 0.5 for one in pixels), np.ones(alike.sum())


def test_right_keypoints_give_the_pose_in_the_view_with_most_of_them():
    dataset = Co3D(small_folder())
    rows = resolve({"colours": by_colour})
    evaluator = open_evaluator(str(dataset.root), rows, BACKBONE, row_seconds=60, threads=1)
    for pair in category_pairs(dataset, "lump", 4, 3):
        found = evaluator(pair, rows).results["colours"]
        reference, targets = dataset.load_pair(pair)
        first, *others = [object_crop(frame, None).rgb for frame in (reference, *targets)]
        counts = [len(by_colour(first, other)[0]) for other in others]
        assert found.view == np.argmax(counts)
        assert found.error < 1  # degree; a colour is the place up to a few thousandths
        assert_allclose((found.scale, found.translation), (1, 0), atol=0.01)


SWEPT = {
    "mine": benchmark_folder.own_keypoints,
    "solved": benchmark_folder.own_solver,
    "verified-n2": "verified-n2",
}
DEFAULT = 0.2  # the threshold of rows without a sweep
THRESHOLDS = [0.001, DEFAULT]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory) -> Run:
    """A run with a row of each threshold."""
    out = tmp_path_factory.mktemp("sweep")
    evaluate(small_folder(), BACKBONE, SWEPT, {"lump": 2}, 2, out, sweep=THRESHOLDS)
    return read_run(out)


@pytest.mark.parametrize("name", ["mine", "solved"])
def test_a_larger_threshold_of_a_sweep_gives_more_inliers(sweep, name):
    few, many = [sweep.row(f"{name}@threshold={value}")["inliers"] for value in THRESHOLDS]
    assert (few < many).all()


def test_the_default_threshold_in_a_sweep_gives_the_row_without_a_sweep(sweep, tmp_path):
    run_rows(SWEPT, tmp_path, pairs=2)
    default = read_run(tmp_path)
    for name in SWEPT:
        swept = sweep.row(f"{name}@threshold={DEFAULT}")["error"]
        assert default.row(name)["error"].equals(swept), name


ONES = np.ones((9, 2))


@pytest.mark.parametrize(
    "keypoints, message",
    [
        (("a", "b", [1]), "matched points is .a., expected real numbers"),
        ((ONES, ONES[1:], ONES[:, 0]), r"points has shape \(8, 2\), expected .* \(9, 2\)"),
        ((ONES, ONES, np.nan), "scores of matches are negative or NaN, expected 0 or more"),
        ((5000 * ONES, ONES, 1), r"point \(5000, 5000\) is outside the crop of \d+ x \d+"),
        ((ONES, np.nan * ONES, 1), r"point \(nan, nan\) is outside"),
    ],
)
def test_what_is_no_keypoints_fails_with_the_reason(tmp_path, keypoints, message):
    run_rows({"mine": lambda first, second: keypoints}, tmp_path)
    (reason,) = read_run(tmp_path).row("mine")["failed"]
    assert re.search(message, reason)


COLUMNS = "pair,target_frame,rotation,translation,scale"


def exact_pose(dataset: Co3D, pair: Pair) -> Sim3:
    """The true pose of a pair in its second target view."""
    reference = dataset.frame("lump", pair.reference_sequence, pair.reference_frame)
    target = dataset.frame("lump", pair.target_sequence, pair.target_frames[1])
    return true_pose(
        dataset.camera(reference),
        placement("lump", pair.reference_sequence),
        dataset.camera(target),
        placement("lump", pair.target_sequence),
    )


@pytest.fixture
def answers(tmp_path):
    """The lines of exact.csv, of another program that answers three of four pairs, each in the
    second target view."""
    dataset = Co3D(small_folder())
    lines = [COLUMNS]
    for pair in category_pairs(dataset, "lump", 4, 3)[:3]:
        pose = exact_pose(dataset, pair)
        rotation = " ".join(map(repr, pose.R.ravel().tolist()))
        translation = " ".join(map(repr, pose.t.tolist()))
        lines.append(f'"{pair.key}",{pair.target_frames[1]},{rotation},{translation},1.0')
    (tmp_path / "exact.csv").write_text("\n".join(lines))
    return lines


def test_poses_from_a_file_are_measured_like_any_others(answers, tmp_path):
    path = tmp_path / "exact.csv"
    run_rows({"exact": str(path)}, tmp_path / "run", 4, 3)
    found = read_run(tmp_path / "run").row("exact")
    *answered, missing = [pair.key for pair in category_pairs(Co3D(small_folder()), "lump", 4, 3)]
    assert (found.loc[answered, "error"] < 1e-5).all()  # degrees: equal but for rounding
    assert set(found.loc[answered, "view"]) == {1}
    similarity = found.loc[answered, ["translation", "scale"]].to_numpy(float)
    assert_allclose(similarity, [[0, 1]] * 3, atol=1e-9)
    assert found.loc[missing, ["error", "failed"]].tolist() == [180, f"{path} has no pose"]
    path.write_text("\n".join(answers[:2]))  # with other poses it is another row
    refused("a run with methods of exact", run_rows, {"exact": str(path)}, tmp_path / "run", 4, 3)


def test_a_file_without_a_pose_of_the_pairs_or_of_another_view_is_refused(answers, tmp_path):
    rows = {"exact": str(tmp_path / "exact.csv")}
    out = tmp_path / "run"
    message = "exact.csv has no pose for any of the pairs"
    refused(message, run_rows, rows, out, category="pebble")
    answers[1] = re.sub(r'",\d+,', '",99,', answers[1])
    (tmp_path / "exact.csv").write_text("\n".join(answers))
    message = "exact.csv, line 2: target_frame is 99, expected one of .*, "
    refused(message, run_rows, rows, out, 4, 3)


FLIP = np.diag([1.0, -1.0, -1.0])


@pytest.mark.parametrize(
    "convention, turned",
    [
        ("", lambda R, index: R),
        ("inverted and conjugated by diag(1, -1, -1)", lambda R, index: FLIP @ R.T @ FLIP),
        # As of a method that confuses left and right.
        ("inverted in eight of twelve", lambda R, index: R.T if index < 8 else R),
    ],
)
def test_a_spreadsheets_poses_are_read_and_the_note_names_their_convention(
    tmp_path, caplog, convention, turned
):
    dataset = Co3D(small_folder())
    # As spreadsheets write where numbers have commas; the first pose fits no pair.
    lines = [COLUMNS.replace(",", ";"), "lump/x:1/y:2;2;1 0 0 0 1 0 0 0 1;;"]
    for index, pair in enumerate(category_pairs(dataset, "lump", 12, 3)):
        rotation = turned(exact_pose(dataset, pair).R, index)
        numbers = " ".join(f"{value:.4f}".replace(".", ",") for value in rotation.ravel())
        lines.append(f"{pair.key};{pair.target_frames[1]};{numbers};;")
    (tmp_path / "mine.csv").write_text("\ufeff" + "\r\n".join(lines), "utf-8")
    run_rows({"mine": str(tmp_path / "mine.csv")}, tmp_path / "run", 12, 3)
    found = read_run(tmp_path / "run")
    # A mix of conventions is not named.
    named = convention.startswith("inverted and")
    told = "mine: 1 of 13 poses fit no pair"
    if named:
        told += f"; rotations agree with the labels if {convention}: median 0° in place of "
    for note in (found.summary["note"], caplog.text):
        assert told in note
        assert ("agree with" in note) == named
    assert (found.row("mine")["error"].max() < 0.01) == (convention == "")


RIGHT = '"lump/a:0/b:1,5",1,1 0 0 0 1 0 0 0 1,0 0 1,1'


@pytest.mark.parametrize(
    "text, told",
    [
        ("\xff", "codec.* a CSV file"),
        (f"{COLUMNS}\nlump/a:0/b:1", "line 2: "),
        ("pair,scale", "columns target_frame, rotation"),
        (f"{COLUMNS}\n\n{RIGHT.replace(',1 0', ',nan 0')}", "line 3: rotation holds nan"),
        (f"{COLUMNS}\n{RIGHT.replace(',1 0', ',-1 0')}", "line 2: "),
        (f"{COLUMNS}\n{RIGHT[:-1]}0", "scale is 0.0"),
        (f"{COLUMNS}\n{RIGHT.replace(',1,', ',1.000,')}", "line 2: .*'1.000'"),  # one or a thousand
        (
            f"{COLUMNS}\n{RIGHT.replace(',0 0 1,', ',0 0,')}",
            "line 2: translation has shape .2,., expected",
        ),
        (
            f"{COLUMNS}\n{RIGHT}\n\n{RIGHT.replace(',1,1', ',5,1')}",
            "line 4: second pose of the pair of line 2",
        ),
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


def test_poses_are_read_as_a_spreadsheet_saves_them_as_unicode(tmp_path):
    path = tmp_path / "poses.csv"
    # Other titles of the columns, columns and a line that are empty, and UTF-16.
    saved = f"{COLUMNS.title()},,\n,,,,,,\n{RIGHT},,\n".replace("_", " ")
    path.write_text(saved, encoding="utf-16")
    assert resolve([f"theirs={path}"])["theirs"].solve._poses.keys() == {"lump/a:0/b:1,5"}


def test_the_questions_have_the_files_and_the_camera_of_each_frame(tmp_path):
    dataset = Co3D(small_folder())
    pairs = [*category_pairs(dataset, "lump", 2, 3), *category_pairs(dataset, "pebble", 1, 3)]
    text = write_questions(tmp_path / "pairs.csv", dataset, pairs).read_text()
    asked = [*csv.DictReader(text.splitlines())]
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert [line["pair"] for line in asked] == [pair.key for pair in pairs for _ in pair.frames]
    assert [line["role"] for line in asked] == 3 * ["reference", *3 * ["target"]]
    for line in asked:
        assert all((dataset.root / line[name]).is_file() for name in ("image", "depth", "mask"))
        assert float(line["depth_scale"]) > 0
        rotation = np.array(line["R"].split(), float).reshape(3, 3)
        translation = np.array(line["t"].split(), float)
        focal = np.array([line["fx"], line["fy"]], float)
        middle = np.array([line["cx"], line["cy"]], float)
        frame = dataset.load(dataset.frame(line["category"], line["sequence"], int(line["frame"])))
        camera = Camera(rotation, translation, focal, middle, frame.camera.size)
        expected, _ = frame.camera.project(points)
        assert_allclose(camera.project(points)[0], expected, atol=1e-9)


def test_no_two_rows_of_the_library_have_one_description():
    assert len(set(map(description, METHODS.values()))) == len(METHODS)


def test_a_module_in_the_current_folder_is_found(tmp_path, monkeypatch):
    # A module that leaves the folder when it is imported.
    (tmp_path / "rows_of_my_own.py").write_text(
        "import os\nos.chdir('/')\ndef still(problem):\n    return None\n"
    )
    monkeypatch.chdir(tmp_path)
    # A console script has no "" in its path, which stands for the current folder.
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    (tmp_path / "row_that_exits.py").write_text("raise SystemExit(3)")
    refused(
        "'row_that_exits:a' cannot be imported: .*py, line 1: SystemExit: 3",
        resolve,
        ["row_that_exits:a"],
    )
    assert resolve(["rows_of_my_own:still"])["rows_of_my_own:still"].solve.__name__ == "still"
    assert Path.cwd() == tmp_path


@pytest.mark.parametrize(
    "row",
    [
        lambda problem: "north",
        lambda problem: np.diag([1.0, 1.0, -1.0]),  # a mirror
        lambda problem: Answer(2 * np.eye(3)),
        lambda problem: (np.eye(3), 2),  # there are two views, 0 and 1
        lambda problem: Answer(np.eye(3), translation=np.full(3, np.nan)),
        lambda problem: Answer(np.eye(3), inliers="many"),
        lambda problem: Answer(np.eye(3), confidence=2.0),
        lambda problem: Answer(np.eye(3), view=0.5),
    ],
)
def test_an_answer_is_a_rotation_in_a_view_or_the_pair_fails(tmp_path, row):
    figures = run_rows({"mine": row}, tmp_path)["mine"]
    assert (figures["failed"], figures["median"]) == (1, 180)


def test_what_an_answer_says_besides_is_stored_rounded_and_cut(tmp_path):
    answer = Answer(np.eye(3), note="x" * 10**6, inliers=4, confidence=1 / 3)
    run_rows({"sure": lambda problem: answer}, tmp_path)
    (found,) = read_run(tmp_path).row("sure")[["inliers", "confidence", "note"]].to_numpy()
    assert found.tolist() == [4, 0.3333, "x" * 1000]


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


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_row_that_fails_does_not_stop_the_others(workers, tmp_path, monkeypatch, caplog):
    rows = {
        "problem": (fails, r"/.*test_benchmark_own_rows.py, line \d+: KeyError: 'angle'"),
        "solver": (
            lambda reference, targets, matched, seed, threshold: np.eye(3),
            ".*AttributeError",
        ),
        "exit": (lambda problem: sys.exit("\udcff"), r".*SystemExit: \?"),
        "backbone": (ZeroShotPose(lambda images: []), ".*FatalError: backbone .* returned 0"),
        "endless": (never_ends, "takes more than 1 s"),
        "untold": (untold, ".*Untold: <exception str"),
        # The second where annotations are checked.
        "else": (lambda problem: os.chdir("/"), "Sim3: R is None|.*TypeCheckError"),
        # Not in this process, which would wait for the thread.
        **({"thread": (leaves_a_thread, "Sim3: R is None")} if workers > 1 else {}),
    }
    monkeypatch.chdir(tmp_path)
    every = {name: row for name, (row, _) in rows.items()} | {"ours": "ours"}
    options = {"executor": workers, "row_seconds": 1}
    summary = evaluate(small_folder(), BACKBONE, every, {"lump": 2}, 2, "run", **options)
    found = summary["methods"]
    assert found.pop("ours") == run_rows(["ours"], tmp_path / "alone", 2)["ours"]
    note = next(iter(every_table(summary))).note
    for name, (_, told) in rows.items():
        assert re.match(told, read_run("run").row(name)["failed"].iloc[0])
        assert found[name]["median"] == 180
        reason = f"{name} failed on 2 of 2 pairs, counted as 180°; the first, lump/"
        assert reason in caplog.text
        assert reason in note


def test_a_row_that_ends_at_its_time_limit_leaves_nothing_behind():
    threads = threading.active_count()
    for delay in np.linspace(0.998, 1.002, 7):  # seconds, just before and after the limit
        with suppress(InputError), own.fails_alone(1):
            time.sleep(delay)
    assert threading.active_count() == threads
    sum(range(100_000))  # long enough for an exception that comes too late


def overwrite(thing) -> None:
    """Overwrite all arrays that something holds."""
    if isinstance(thing, np.ndarray | torch.Tensor):
        thing[...] = 0
    parts = thing if isinstance(thing, list | tuple) else getattr(thing, "__dict__", {}).values()
    for part in parts:
        overwrite(part)


def test_rows_get_the_pairs_seed_and_neither_labels_nor_names_and_do_not_reach_each_other(tmp_path):
    handed = []
    seeds = {}

    def keep(name: str, seed: int, answer, *things):
        """Store what the row `name` was handed, overwrite it, and give the row's answer."""
        seeds.setdefault(name, seed)
        handed.append(cloudpickle.dumps(things))
        overwrite(things)
        return answer

    class Estimator:
        def estimate(self, *frames, seed=0):
            return keep("estimator", seed, np.eye(3), *frames)

    def problem(one, seed):
        assert seed == one.seed
        estimates = one.estimate(), one.estimate(settings={"solver": "verified"})
        return keep("problem", seed, np.eye(3), one, one.frames(), one.views(), *estimates)

    def keypoints(*images, seed):
        return keep("keypoints", seed, NONE, *images)

    def matcher(*arguments, seed=0):
        return keep("matcher", seed, own_matcher(*arguments), *arguments)

    def solver(*arguments, seed, threshold):
        return keep("solver", seed, benchmark_folder.own_solver(*arguments), *arguments)

    rows = {one.__name__: one for one in (problem, keypoints, matcher, solver)}
    for name, function in rows.items():
        function.kind = name
    rows["estimator"] = Estimator()
    library = ("verified", "sift", "ours-mask", "icp", "scans-2")
    run_rows(library, tmp_path / "alone", 2)
    methods = run_rows(rows | dict(zip(library, library)), tmp_path / "after", 2)
    assert {row["failed"] for row in methods.values()} == {0}
    assert seeds == dict.fromkeys(rows, seeds["problem"])
    for word in (*SEQUENCES, str(small_folder()), "Co3D", "PoseLabel"):
        assert word.encode() not in b"".join(handed)
    for name in library:
        results, expected = [read_run(tmp_path / run).row(name) for run in ("after", "alone")]
        assert results.drop(columns="seconds").equals(expected.drop(columns="seconds")), name


def test_a_pipeline_as_a_row_draws_with_the_pairs_seed(own_run):
    assert own_run.row("pipeline")["error"].equals(own_run.row("ours")["error"])


class Broken(CoordinateBackbone):
    """A backbone whose feature maps the function `wrong` changes."""

    wrong = None

    def __call__(self, images):
        return type(self).wrong(super().__call__(images))


@pytest.mark.parametrize(
    "wrong, told",
    [
        (
            lambda maps: [replace(one, keys=one.keys * float("nan")) for one in maps],
            "values that are not finite",
        ),
        (lambda maps: maps[1:], r"returned \d of"),
        (lambda maps: maps[9], "IndexError"),
    ],
)
@pytest.mark.parametrize(
    "row", ["ours", "category", lambda problem: problem.views() and np.eye(3), "align"]
)
def test_a_broken_backbone_ends_the_run_and_nothing_is_stored(
    tmp_path, monkeypatch, wrong, told, row
):
    monkeypatch.setattr(Broken, "wrong", staticmethod(wrong))
    backbone = Broken(grid=8)
    with pytest.raises(FatalError, match=told):
        if row == "align":  # no row, but it computes features too
            align_category(Co3D(small_folder()), "lump", backbone, targets=2, out=tmp_path)
        else:
            run_rows([row] if isinstance(row, str) else {"row": row}, tmp_path, backbone=backbone)
    assert not (tmp_path / LINES).read_bytes()


def test_an_unreadable_frame_ends_the_run_and_nothing_is_stored_for_its_pairs(
    tmp_path, monkeypatch
):
    def read(dataset, annotation):
        if annotation.sequence_name == "300_c":
            raise InputError("image 300_c cannot be decoded")
        return load(dataset, annotation)

    load = Co3D.load
    monkeypatch.setattr(Co3D, "load", read)
    with pytest.raises(FatalError, match="300_c cannot be decoded"):
        run_rows(["category"], tmp_path, targets=2)
    assert "300_c" not in (tmp_path / LINES).read_text()


def test_a_fingerprint_tells_apart_whatever_changes_the_features():
    torch.manual_seed(0)
    vit = VisionTransformer(32, 8, embed_dim=12, depth=3, num_heads=2)

    def of(**options):
        return fingerprint(Backbone(vit, "same name", device="cpu", **options))

    plain = of()
    assert plain.startswith("same name ")
    assert plain == of(layer=2, facet="key", mean=[0.485, 0.456, 0.406])  # the defaults
    changed = [
        of(layer=1),
        of(facet="query"),
        of(saliency_heads=[1]),
        of(image_size=64),
        of(mean=(0,) * 3),
        of(std=(1,) * 3),
    ]
    assert len({plain, *changed}) == 1 + len(changed)
    with torch.no_grad():
        vit.cls_token += 1
    assert of() != plain


def test_the_library_is_known_by_version_and_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "REPOSITORY", tmp_path)
    version = runs.library_version.__wrapped__  # without its cache

    def git(*words: str) -> None:
        user = ["-c", "user.name=a", "-c", "user.email=b"]
        subprocess.run(["git", "-C", tmp_path, *user, *words], check=True, capture_output=True)

    (tmp_path / "__init__.py").touch()
    assert version()["commit"] is None  # no repository
    git("init")
    git("add", ".")
    assert version()["commit"] is None  # no commit
    git("commit", "-m", "x")
    commit = version()["commit"]
    assert len(commit) == 40
    (tmp_path / "__init__.py").write_text("x = 1")
    assert version()["commit"] == f"{commit}-dirty"
