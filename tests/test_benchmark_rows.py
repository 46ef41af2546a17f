"""The rows of the paper's tables on a folder whose features are perfect."""

from dataclasses import replace

import pytest
import torch
from benchmark_folder import BACKBONE, run_rows, small_folder
from refusals import refused

from zsp_lite import Co3D, InputError, ZeroShotPose, minimal
from zsp_lite.baselines.sift import Sift
from zsp_lite.benchmark.methods import GROUPS, METHODS, resolve
from zsp_lite.benchmark.problem import FrameStore, PairProblem
from zsp_lite.benchmark.runs import Run, read_run
from zsp_lite.data.pairs import category_pairs

pytestmark = pytest.mark.slow

TARGETS = 5
ROWS = tuple(resolve(["ablations", "table1", "table2"]))


@pytest.fixture(scope="module")
def of_rows(tmp_path_factory) -> Run:
    """Six pairs by all these rows, those of table 2 with 1, 3 and 5 target views."""
    out = tmp_path_factory.mktemp("rows")
    run_rows(ROWS, out, 6, TARGETS, "pebble")
    return read_run(out)


def test_every_row_answers_every_pair(of_rows):
    answered = {name: (one["n"], one["failed"]) for name, one in of_rows.summary["methods"].items()}
    assert answered == dict.fromkeys(ROWS, (6, 0))


@pytest.mark.parametrize("group", ["correspondences", "matchers", "trials", "published", "parts"])
def test_with_perfect_features_every_way_to_match_and_fit_is_right(of_rows, group):
    accuracies = {name: of_rows.summary["methods"][name]["acc30"] for name in GROUPS[group]}
    assert min(accuracies.values()) >= 80, accuracies


def test_a_row_of_fewer_views_sees_the_first_ones(of_rows):
    assert of_rows.row("ours-n5")["error"].equals(of_rows.row("ours")["error"])
    # A key ends with the numbers of the target frames, here with the only commas of the key.
    assert [key.count(",") for key in of_rows.row("ours-n3").index] == [2] * 6
    methods = of_rows.summary["methods"]
    few, some, all_views = [methods[f"ours-n{count}"]["acc30"] for count in (1, 3, TARGETS)]
    # No law, but with perfect features more views can only help.
    assert few <= some <= all_views


def first_estimate(name):
    """Return what the method with a row's settings estimates on the frames of the first pair, and
    the pair's key."""
    dataset = Co3D(small_folder())
    pair = category_pairs(dataset, "pebble", 6, TARGETS)[0]
    method = ZeroShotPose(BACKBONE, **METHODS[name].settings, seed=pair.seed)
    return method.estimate(*dataset.load_pair(pair)), pair.key


@pytest.mark.parametrize(
    "name",
    "ours ours-published ours-k70-nokmeans ours-transport ours-saliencyiou ours-keys "
    "ours-nearest".split(),
)
def test_a_row_is_the_method_with_its_settings_on_the_frames_themselves(of_rows, name):
    estimate, key = first_estimate(name)
    result = of_rows.row(name).loc[key]
    assert result["rotation"] == pytest.approx(estimate.sim3.R.ravel(), abs=1e-6)
    assert (result["view"], result["inliers"]) == (estimate.view, estimate.inliers.sum())


def test_the_row_of_keys_compares_the_keys_of_two_patches_alone():
    estimate, _ = first_estimate("ours-keys")
    matches = estimate.matches
    first = estimate.reference_view.features.keys[tuple(matches.reference.T)]
    second = estimate.target_views[estimate.view].features.keys[tuple(matches.target.T)]
    assert matches.similarity == pytest.approx(
        torch.cosine_similarity(first, second).numpy(), abs=1e-5
    )


def test_the_row_of_nearest_neighbours_needs_no_way_back_but_both_objects():
    # The first two patches have the same neighbour. That of the third one is off the object, and so
    # is the last one.
    cosines = torch.tensor([[0.75, 0], [0.5, 0], [0.25, 1], [1, 0]])
    on_object = torch.arange(4) < 3
    _, score = METHODS["ours-nearest"].settings["matcher"](cosines, on_object, on_object[2:])
    assert score.tolist() == [0.75, 0.5, -torch.inf, -torch.inf]


def test_the_row_of_least_squares_fits_all_matches_of_the_best_view(of_rows):
    ours, key = first_estimate("ours")
    result = of_rows.row("ours-least-squares").loc[key]
    assert result["rotation"] == pytest.approx(minimal.umeyama(*ours.points)[1].ravel(), abs=1e-6)
    assert result["view"] == ours.view


def test_the_row_without_depth_fits_rotations_only(of_rows):
    rows = of_rows.row("ours-nodepth")
    fitted = rows[rows["note"] == ""]
    assert len(fitted) >= 4  # of six pairs
    assert fitted["translation"].isna().all()
    assert (fitted["inliers"] >= 5).all()  # the smallest number that determines a rotation


def test_icp_takes_the_first_view_or_the_best_one(of_rows):
    assert set(of_rows.row("icp")["view"]) == {0}
    assert of_rows.row("icp-bv")["view"].equals(of_rows.row("ours")["view"])


@pytest.mark.parametrize("row", ["icp", "sift"])
def test_a_pair_without_depth_fails(row, monkeypatch):
    dataset = Co3D(small_folder())
    load = Co3D.load
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
    rows = {name: name for name in ("ours", "sift", "icp", "ours-nodepth")}
    rows["mine"] = lambda first, second: ([], [], [])
    run_rows(rows, tmp_path, 2)
    note = read_run(tmp_path).summary["note"]
    for row in rows:
        assert f"{row} has no fit on 2 of 2 pairs; the first, lump/" in note
