"""The rows of the paper's tables on a folder whose features are perfect."""

from dataclasses import replace

import pytest
from benchmark_folder import BACKBONE, run_rows, small_folder
from refusals import refused

from zsp_lite import Co3D, InputError, ZeroShotPose
from zsp_lite.baselines.sift import Sift
from zsp_lite.benchmark.methods import GROUPS, METHODS, resolve
from zsp_lite.benchmark.problem import FrameStore, PairProblem
from zsp_lite.benchmark.runs import Run, read_run
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import category_pairs
from zsp_lite.metrics import rotation_error

pytestmark = pytest.mark.slow

TARGETS = 5
ROWS = (
    *resolve("ablations"),
    "ours-n1",
    "ours-n3",
    f"ours-n{TARGETS}",
    "ours-bv-n3",
    "icp",
    "icp-bv",
    "sift",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    """Six pairs by all these rows."""
    out = tmp_path_factory.mktemp("rows")
    run_rows(ROWS, out, 6, TARGETS, "pebble")
    return read_run(out)


def test_every_row_answers_every_pair(run):
    answered = {name: (one["n"], one["failed"]) for name, one in run.summary["methods"].items()}
    assert answered == dict.fromkeys(ROWS, (6, 0))


@pytest.mark.parametrize("group", ["correspondences", "matchers", "trials", "published"])
def test_with_perfect_features_every_way_to_match_and_fit_is_right(run, group):
    accuracies = {name: run.summary["methods"][name]["acc30"] for name in GROUPS[group]}
    assert min(accuracies.values()) >= 80, accuracies


def test_a_row_of_fewer_views_sees_the_first_ones(run):
    methods = run.summary["methods"]
    assert methods[f"ours-n{TARGETS}"] == methods["ours"]
    assert run.row(f"ours-n{TARGETS}")["error"].equals(run.row("ours")["error"])
    # A key ends with the numbers of the target frames.
    numbers = [len(key.rpartition(":")[2].split(",")) for key in run.row("ours-n3").index]
    assert numbers == [3] * 6
    few, some, all_views = [methods[f"ours-n{count}"]["acc30"] for count in (1, 3, TARGETS)]
    # No law, but with perfect features more views can only help.
    assert few <= some <= all_views


@pytest.mark.parametrize(
    "name", "ours ours-published ours-k70-nokmeans ours-transport ours-saliencyiou".split()
)
def test_a_row_is_the_method_with_its_settings_on_the_frames_themselves(run, name):
    dataset = Co3D(small_folder())
    (pair, *_) = category_pairs(dataset, "pebble", 6, TARGETS)
    method = ZeroShotPose(BACKBONE, **METHODS[name].settings, seed=pair.seed)
    estimate = method.estimate(*dataset.load_pair(pair))
    labels = read_labels(small_folder(), "pebble")
    # Through the worlds of both sequences, from the reference's camera to the target's.
    to_target = estimate.target_camera.R @ labels[pair.target_sequence].trans[:3, :3]
    to_reference = (
        estimate.reference_view.frame.camera.R @ labels[pair.reference_sequence].trans[:3, :3]
    )
    result = run.row(name).loc[pair.key]
    error = rotation_error(estimate.sim3.R, to_target @ to_reference.T)
    assert result["error"] == pytest.approx(error, abs=1e-4)
    assert (result["view"], result["inliers"]) == (estimate.view, estimate.inliers.sum())


def test_the_row_without_depth_fits_rotations_only(run):
    rows = run.row("ours-nodepth")
    fitted = rows[rows["note"] == ""]
    assert len(fitted) >= 4
    assert fitted["translation"].isna().all()
    assert (fitted["inliers"] >= 5).all()  # the smallest number that determines a rotation


def test_a_row_with_depth_fits_translation_and_scale(run):
    medians = run.row("ours")[["translation", "scale"]].median()
    assert medians["translation"] < 0.2
    assert medians["scale"] == pytest.approx(1, abs=0.1)


def test_icp_takes_the_first_view_or_the_best_one(run):
    assert set(run.row("icp")["view"]) == {0}
    assert run.row("icp-bv")["view"].equals(run.row("ours")["view"])


@pytest.mark.parametrize("row", ["icp", "sift"])
def test_a_pair_without_depth_fails(row, monkeypatch):
    dataset, load = Co3D(small_folder()), Co3D.load
    monkeypatch.setattr(Co3D, "load", lambda *frame: replace(load(*frame), depth=None))
    (pair,) = category_pairs(dataset, "pebble", 1, 2)
    problem = PairProblem(pair, FrameStore(dataset, {"sift": Sift()}), ["sift"])
    refused("no depth map: frame ", METHODS[row].solve, problem)
    assert [frame.depth for frame in problem.frames()] == [None] * 3  # one reference, two targets


def test_poses_without_a_fit_are_counted(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise InputError("too few points")

    for fit in ("pipeline.ransac", "benchmark.own.ransac", "baselines.geometry.icp"):
        monkeypatch.setattr(f"zsp_lite.{fit}", fails)
    monkeypatch.setattr("cv2.findEssentialMat", lambda *_, **__: (None, None))
    rows = ["ours", "sift", "icp", "ours-nodepth"]
    run_rows(rows, tmp_path, 2)
    failures = read_run(tmp_path).failures
    for row in rows:
        assert f"{row} has no fit on 2 of 2 pairs; the first, lump/" in failures[row]
