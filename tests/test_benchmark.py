"""The benchmark on a small CO3D folder whose features are perfect, so that every figure is
known."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from benchmark_folder import BACKBONE, SEQUENCES, own_method, run_rows, small_folder
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from synthetic_views import CoordinateBackbone

from zsp_lite import Co3D, InputError
from zsp_lite.benchmark.run import evaluate, write_reports
from zsp_lite.benchmark.runs import Run, add_lines, read_lines, read_run
from zsp_lite.benchmark.tables import pair_figure
from zsp_lite.data.evaluation import sample_pairs, true_poses
from zsp_lite.data.ground_truth import POSES_FILE, ObjectPose, object_poses
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import category_pairs
from zsp_lite.metrics import rotation_error
from zsp_lite.views import object_crop
from zsp_lite.viz.plots import pale

ROWS = ("ours", "ours-bv", "oracle-view")


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory):
    """The folder of a run and what the call returned."""
    out = tmp_path_factory.mktemp("out")
    # Six pairs of each of two categories, with five target views.
    return out, evaluate(small_folder(), BACKBONE, ROWS, 6, 5, out)


def test_perfect_features_solve_nearly_every_pair_and_the_best_view_alone_does_not(evaluated):
    _, summary = evaluated
    ours = summary["methods"]["ours"]
    assert ours["acc30"] >= 90
    assert ours["median"] < 10
    assert ours["failed"] == 0
    assert summary["methods"]["ours-bv"]["median"] > ours["median"]


def test_the_summary_has_the_fixed_form(evaluated):
    out, summary = evaluated
    assert read_run(out).summary == summary
    assert summary["data"] == {
        "root": str(small_folder()),
        "categories": ["lump", "pebble"],
        "pairs": 12,
        "targets": 5,
    }
    stages = {"reading", "backbone", "similarity", "matching", "view", "alignment"}
    assert stages <= summary["timings"].keys()
    for row in summary["methods"].values():
        numbers = {name: figures["n"] for name, figures in row["per_category"].items()}
        assert (row["n"], numbers) == (12, {"lump": 6, "pebble": 6})
        low, high = row["acc30_ci"]
        assert low <= row["acc30"] <= high


def test_a_method_added_later_leaves_the_others_as_they_were(tmp_path):
    alone = evaluate(small_folder(), BACKBONE, ("ours",), {"lump": 3}, 2, tmp_path)
    both = evaluate(small_folder(), BACKBONE, ("ours", "rootsift"), {"lump": 3}, 2, tmp_path)
    assert both["methods"]["ours"] == alone["methods"]["ours"]
    assert both["timings"]["backbone"] == alone["timings"]["backbone"]
    assert both["methods"]["rootsift"]["n"] == 3


def test_the_oracle_takes_the_view_that_is_truly_nearest_in_rotation(evaluated):
    dataset = Co3D(small_folder())
    found = read_run(evaluated[0])
    for category in ("lump", "pebble"):
        labels = read_labels(small_folder(), category)
        for pair in sample_pairs(dataset, category, 6, 5):
            a, b = pair.reference_sequence, pair.target_sequence
            reference, targets = dataset.load_pair(pair)
            # The object's axes as each camera sees them.
            seen = reference.camera.R @ labels[a].trans[:3, :3]
            turns = [target.camera.R @ labels[b].trans[:3, :3] for target in targets]
            angles = [rotation_error(turn, seen) for turn in turns]
            assert found.row("oracle-view")["view"][pair.key] == np.argmin(angles)


def test_stored_poses_give_the_errors_again(evaluated):
    found = read_run(evaluated[0])
    for name in ROWS:
        pairs, views, rotations, positions = found.poses(name)
        truths = true_poses(small_folder(), pairs, views)
        errors = found.row(name)["error"][[pair.key for pair in pairs]]
        # Errors are stored with four decimals, rotations with fewer digits than a double has.
        assert_allclose(rotation_error(rotations, truths[:, :3, :3]), errors, atol=2e-4)
    solved = errors < 1  # of "oracle-view", the last row
    assert_allclose(positions[solved], truths[solved, :3, 3], atol=0.1)


@pytest.fixture(scope="module")
def pictured(tmp_path_factory) -> Run:
    """A run of one pair, by rows that see it, turn it and fail."""

    def blind(problem):
        raise InputError("sees nothing")

    out = tmp_path_factory.mktemp("pictured")
    run_rows({"ours": "ours", "turned": own_method, "blind": blind}, out)
    return read_run(out)


def test_the_picture_of_a_pair_shows_each_rows_pose_in_its_target_view(pictured, closed_figures):
    dataset = Co3D(small_folder())
    (pair,), (view,), _, _ = pictured.poses("ours")
    axes = pair_figure(pictured, pair.key, dataset, ["turned", "ours", "blind"]).axes
    errors = [pictured.row(name)["error"][pair.key] for name in ("turned", "ours")]
    titles = ["reference", f"turned, {errors[0]:.0f}° off", f"ours, {errors[1]:.0f}° off"]
    assert [axis.get_title() for axis in axes] == titles
    crop = object_crop(dataset.load_pair(pair)[1][view])
    assert_array_equal(axes[2].get_images()[0].get_array(), pale(crop.rgb))
    turned, drawn = [axis.collections[0].get_offsets() for axis in axes[1:]]
    x, y = np.floor(drawn.data).astype(int).clip(0, 223).T
    assert np.mean(crop.mask[y, x] > 0.5) > 0.9  # the pose is nearly exact
    # A rotation alone is drawn in the middle of the object; the crop is 224 pixels wide.
    assert np.abs(turned.mean(axis=0) - 112).max() < 40


def test_a_pair_or_a_row_without_a_pose_has_no_picture(pictured):
    key = pictured.poses("ours")[0][0].key
    for pair, rows in (("lump", None), (key, ["blind"]), (key, ["nobody"])):
        message = f"pair '{pair}' has no pose in the run, expected a key such as {key}"
        refused(message, pair_figure, pictured, pair, Co3D(small_folder()), rows)


class Renamed(CoordinateBackbone):
    """A backbone with the name of another class."""


@pytest.mark.parametrize(
    "backbone, options, message",
    [
        (BACKBONE, {"targets": 3}, "a run with targets 5, this is 3"),
        (Renamed(grid=8), {}, "a run with backbone .*Renamed"),
    ],
)
def test_the_folder_of_another_run_is_refused(evaluated, backbone, options, message):
    refused(message, evaluate, small_folder(), backbone, out=evaluated[0], **options)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"pairs": {"teapot": 1}}, "category is 'teapot', expected one of lump"),
        ({"pairs": {"lump": 0}}, "pairs of lump is 0"),
        ({"targets": 0}, "targets is 0"),
    ],
)
def test_categories_and_numbers_that_are_not_there_are_refused(tmp_path, options, message):
    refused(message, evaluate, small_folder(), BACKBONE, out=tmp_path / "a", **options)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("turns, expected", [((180,), 0), ((90,), 90), ((), 180)])
def test_an_error_up_to_symmetries_forgives_turns_that_both_objects_allow(
    tmp_path, monkeypatch, turns, expected
):
    dataset = Co3D(small_folder())
    lines = ["pair,target_frame,rotation"]
    for pair in category_pairs(dataset, "lump", 2, 1):
        (truth,) = true_poses(dataset.root, [pair], np.array([0]))
        _, (target,) = dataset.load_pair(pair)
        half_turn = target.camera.R @ np.diag([-1.0, -1, 1]) @ target.camera.R.T
        rotation = " ".join(map(repr, (half_turn @ truth[:3, :3]).ravel().tolist()))
        lines.append(f'"{pair.key}",{pair.target_frames[0]},{rotation}')
    half_turned = tmp_path / "half_turned.csv"
    half_turned.write_text("\n".join(lines))
    pose = ObjectPose(np.eye(4)[:3].tolist(), 1.0, (0, 0, 0), (1, 1, 1), turns)
    poses = dict.fromkeys(SEQUENCES, pose)
    monkeypatch.setattr("zsp_lite.data.evaluation.read_poses", lambda *_: poses)
    mine = run_rows({"mine": str(half_turned)}, tmp_path, pairs=2, targets=1)["mine"]
    found = read_run(tmp_path).row("mine")[["symmetric_error", "error"]]
    assert_allclose(found, [[expected, 180]] * 2, atol=1e-5)
    assert mine["symmetric_acc30"] == 100 * (expected < 30)


def test_object_poses_of_another_layout_cost_a_warning_and_their_figure(tmp_path, caplog):
    dataset = Co3D(shutil.copytree(small_folder(), tmp_path / "copy"))
    path = dataset.root / "lump" / POSES_FILE
    stretched = np.diag([1.05, 1.05, 1.05, 1]).tolist()
    pose = {"trans": stretched, "scale": 1, "low": [0, 0, 0], "high": [1, 1, 1]}
    path.write_text(json.dumps({"100_a": pose}))
    rows = {"mine": own_method}
    summary = evaluate(dataset.root, BACKBONE, rows, {"lump": 3}, 2, tmp_path / "out")
    mine = summary["methods"]["mine"]
    assert (mine["n"], mine["failed"]) == (3, 0)
    assert "symmetric_acc30" not in mine
    (warning,) = caplog.messages
    ending = ": without it there is no symmetric_acc30"
    assert re.fullmatch(f".*{re.escape(str(path))}.*100_a is.*{ending}", warning, re.DOTALL)
    refused(POSES_FILE, object_poses, dataset, "lump")


REPEATED = {"ours": "ours", "none": lambda problem: None}  # "none" fails on every pair


@pytest.fixture(scope="module")
def seeded(tmp_path_factory) -> Path:
    """The folder of a run with three seeds, in which "ours-mask" has the first seed only, and one
    result of a call with more seeds that was interrupted.

    It has three pairs of each of two categories.
    """
    out = tmp_path_factory.mktemp("seeded")
    evaluate(small_folder(), BACKBONE, ["ours-mask"], 3, 3, out)
    first = read_lines(out)[0].pair
    add_lines(out, [{"pair": first, "repeat": 1, "results": {"ours-mask": {"error": 0.0}}}])
    evaluate(small_folder(), BACKBONE, REPEATED, 3, 3, out)
    evaluate(small_folder(), BACKBONE, REPEATED, 3, 3, out, seeds=3)
    return out


def test_seeds_repeat_every_pair_with_other_draws_of_which_the_first_are_those_of_one_seed(
    seeded, tmp_path
):
    evaluate(small_folder(), BACKBONE, ["ours"], 3, 3, tmp_path)
    ours = read_run(seeded).row("ours")
    first = ours[ours["repeat"] == 0]["error"]
    assert first.tolist() == read_run(tmp_path).row("ours")["error"].tolist()
    assert set(ours.groupby("pair").size()) == {3}
    assert ours.groupby("pair")["error"].nunique().max() > 1


def test_the_pairs_and_failures_of_several_seeds_count_once(seeded):
    summary = read_run(seeded).summary
    assert summary["data"]["pairs"] == 6
    assert [row["n"] for row in summary["methods"].values()] == [6, 6, 6]
    assert summary["methods"]["none"]["failed"] == 6
    assert "none failed on 6 of 6 pairs" in summary["note"]


def test_tables_average_over_the_seeds(seeded):
    found = read_run(seeded)
    ours = found.summary["methods"]["ours"]
    errors = found.row("ours").groupby("repeat")["error"]
    by_seed = [100 * (of_seed < 30).mean() for _, of_seed in errors]
    assert ours["acc30"] == pytest.approx(np.mean(by_seed))
    assert ours["acc30_sd_of_seeds"] == pytest.approx(np.std(by_seed, ddof=1))
    first = found.row("ours").query("repeat == 0")["error"]
    gain = 100 * ((found.row("ours-mask")["error"] < 30).mean() - (first < 30).mean())
    assert found.summary["against"]["ours-mask"]["accuracy_gain"] == pytest.approx(gain)
    write_reports(seeded)
    table = (seeded / "tables/all_rows.md").read_text()
    assert "by seed, Acc30 of ours has a standard deviation of" in table
