"""The rows of the paper's tables on a folder whose features are perfect."""

from dataclasses import replace

import pytest
from benchmark_folder import BACKBONE, run_rows, small_folder
from refusals import refused

from zsp_lite.baselines.sift import Sift
from zsp_lite.benchmark.methods import GROUPS, METHODS, resolve
from zsp_lite.benchmark.problem import FrameStore, PairProblem
from zsp_lite.benchmark.runs import read_run
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import category_pairs
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose

pytestmark = pytest.mark.slow

ROWS = (
    *resolve("ablations"),
    "ours-n1",
    "ours-n3",
    "ours-n5",
    "ours-bv-n3",
    "icp",
    "icp-bv",
    "sift",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("rows")
    return run_rows(ROWS, out, 6, 5, "pebble"), read_run(out).row


def test_every_row_answers_every_pair_and_with_perfect_features_every_way_to_match_and_fit_is_right(
    run,
):
    rows, row = run
    assert set(rows) == set(ROWS)
    assert all(one["n"] == 6 and one["failed"] == 0 for one in rows.values())
    exact = [
        *GROUPS["correspondences"],
        *GROUPS["matchers"],
        *GROUPS["trials"],
        *GROUPS["published"],
    ]
    assert all(rows[name]["acc30"] >= 80 for name in exact)
    assert rows["ours-n1"]["acc30"] <= rows["ours-n3"]["acc30"] <= rows["ours-n5"]["acc30"]
    assert rows["ours-n5"] == rows["ours"] and row("ours-n5")["error"].equals(row("ours")["error"])
    assert len(row("ours-n3")) == 6 and all(key.count(",") == 2 for key in row("ours-n3").index)


def test_a_row_is_the_method_with_its_settings_on_the_frames_themselves(run):
    _, row = run
    dataset, labels = Co3D(small_folder()), read_labels(small_folder(), "pebble")
    (pair, *_) = category_pairs(dataset, "pebble", 6, 5)
    reference, targets = dataset.load_pair(pair)
    for name in (
        "ours",
        "ours-published",
        "ours-k70-nokmeans",
        "ours-transport",
        "ours-saliencyiou",
    ):
        estimate = ZeroShotPose(BACKBONE, **METHODS[name].settings, seed=pair.seed).estimate(
            reference, targets
        )
        camera = estimate.target_camera
        truth = camera.R @ labels[pair.target_sequence].trans[:3, :3]
        truth = truth @ labels[pair.reference_sequence].trans[:3, :3].T @ reference.camera.R.T
        found = row(name).loc[pair.key]
        assert found["error"] == pytest.approx(rotation_error(estimate.sim3.R, truth), abs=1e-4)
        assert found["view"] == estimate.view and found["inliers"] == estimate.inliers.sum()


def test_rows_differ_as_their_names_say(run):
    _, row = run
    fitted = row("ours-nodepth")[row("ours-nodepth")["note"] == ""]
    assert (
        len(fitted) >= 4 and fitted["translation"].isna().all() and (fitted["inliers"] >= 5).all()
    )
    assert row("ours")["translation"].median() < 0.2 and row("ours")[
        "scale"
    ].median() == pytest.approx(1, abs=0.1)
    assert (row("icp")["view"] == 0).all() and row("icp-bv")["view"].equals(row("ours")["view"])


@pytest.mark.parametrize("row", ["icp", "sift"])
def test_a_pair_without_depth_fails(row, monkeypatch):
    dataset, load = Co3D(small_folder()), Co3D.load
    monkeypatch.setattr(Co3D, "load", lambda *frame: replace(load(*frame), depth=None))
    store = FrameStore(dataset, {"sift": Sift()})
    one = PairProblem(*category_pairs(dataset, "pebble", 1, 2), store, ["sift"])
    refused("no depth map: 100_a", METHODS[row].solve, one)
    assert [frame.depth for frame in one.frames()] == [None] * 3
