"""The benchmark on a small CO3D folder whose features are perfect, so that every figure is
known."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from benchmark_folder import BACKBONE, own_method, run_rows, small_folder
from refusals import refused
from synthetic_views import CoordinateBackbone

from zsp_lite.benchmark.run import evaluate, write_reports
from zsp_lite.benchmark.runs import add_lines, read_lines, read_run
from zsp_lite.benchmark.tables import pair_figure
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import write_mask
from zsp_lite.data.ground_truth import POSES_FILE, ObjectPose, object_poses
from zsp_lite.data.labels import read_labels, relative_pose
from zsp_lite.data.pairs import category_pairs, sample_pairs, true_poses, write_published_pairs
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.views import object_crop

ROWS = ("ours", "ours-bv", "oracle-view")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    return out, evaluate(small_folder(), BACKBONE, ROWS, 6, 5, out)


def test_the_summary_has_the_fixed_form_and_is_what_the_call_returned(run):
    out, summary = run
    assert json.loads((out / "summary.json").read_text()) == summary == read_run(out).summary
    # Perfect features solve nearly every pair, and the best view alone does not.
    ours = summary["methods"]["ours"]
    assert ours["acc30"] >= 90 and ours["median"] < 10 and ours["failed"] == 0
    assert summary["methods"]["ours-bv"]["median"] > ours["median"]
    errors = read_run(out).row("ours")["error"]
    assert ours["median"] == np.median(errors) and ours["acc15"] == pytest.approx(
        100 * np.mean(errors < 15)
    )
    assert summary["data"] == {
        "root": str(small_folder()),
        "categories": ["lump", "pebble"],
        "pairs": 12,
        "targets": 5,
    }
    for row in summary["methods"].values():
        assert row["n"] == 12 and row["per_category"].keys() == {"lump", "pebble"}
        assert row["per_category"]["lump"]["n"] == 6
        assert row["acc30_ci"][0] <= row["acc30"] <= row["acc30_ci"][1]
    assert {"reading", "backbone", "similarity", "matching", "view", "alignment"} <= summary[
        "timings"
    ].keys()
    settings = read_run(out).settings
    (call,) = settings.calls
    assert call.versions["numpy"] == np.__version__ and (call.rows, call.pairs) == (
        [*ROWS],
        {"lump": 6, "pebble": 6},
    )


def test_a_method_added_later_leaves_the_others_as_they_were(tmp_path):
    alone = evaluate(small_folder(), BACKBONE, ("ours",), {"lump": 3}, 2, tmp_path / "run")
    both = evaluate(
        small_folder(), BACKBONE, ("ours", "rootsift"), {"lump": 3}, 2, tmp_path / "run"
    )
    every = evaluate(small_folder(), BACKBONE, ("ours",), 3, 2, tmp_path / "every")
    assert (
        every["methods"]["ours"]["per_category"]["lump"]
        == alone["methods"]["ours"]["per_category"]["lump"]
    )
    assert both["methods"]["ours"] == alone["methods"]["ours"]
    assert both["timings"]["backbone"] == alone["timings"]["backbone"]
    assert both["methods"]["rootsift"]["n"] == 3
    assert both["against"]["rootsift"]["accuracy_gain"] == pytest.approx(
        both["methods"]["rootsift"]["acc30"] - both["methods"]["ours"]["acc30"]
    )


def test_the_oracle_takes_the_view_that_is_truly_nearest_in_rotation(run):
    dataset, found = Co3D(small_folder()), read_run(run[0])
    for category in ("lump", "pebble"):
        labels = read_labels(small_folder(), category)
        for pair in sample_pairs(dataset, category, 6, 5):
            a, b = pair.reference_sequence, pair.target_sequence
            frame, targets = dataset.load_pair(pair)
            reference, cameras = frame.camera, [target.camera for target in targets]
            # The object's axes as each camera sees them.
            turns = [camera.R @ labels[b].trans[:3, :3] for camera in cameras]
            angles = [rotation_error(turn, reference.R @ labels[a].trans[:3, :3]) for turn in turns]
            assert found.row("oracle-view")["view"][pair.key] == np.argmin(angles)
            best_view = found.row("ours-bv").loc[pair.key]
            assert best_view["error"] == pytest.approx(angles[int(best_view["view"])], abs=1e-4)
    assert run[1]["methods"]["oracle-view"]["acc30"] >= 90


def test_stored_poses_give_the_errors_again(run):
    found = read_run(run[0])
    for name in ROWS:
        pairs, views, rotations, positions = found.poses(name)
        truths = true_poses(small_folder(), pairs, views)
        errors = found.row(name)["error"][[pair.key for pair in pairs]]
        np.testing.assert_allclose(rotation_error(rotations, truths[:, :3, :3]), errors, atol=2e-4)
    solved = errors < 1  # of "oracle-view"
    np.testing.assert_allclose(positions[solved], truths[solved, :3, 3], atol=0.1)


def test_the_picture_of_a_pair_shows_each_rows_pose_in_its_target_view(tmp_path, closed_figures):
    def blind(problem):
        raise InputError("sees nothing")

    run_rows({"ours": "ours", "turned": own_method, "blind": blind}, tmp_path)
    found, dataset = read_run(tmp_path), Co3D(small_folder())
    (pair,), (view,), _, _ = found.poses("ours")
    figure = pair_figure(found, pair.key, dataset)
    error, other = (f"{found.row(name)['error'][pair.key]:.0f}° off" for name in ("ours", "turned"))
    assert [one.get_title() for one in figure.axes] == [
        "reference",
        "ours",
        "turned",
        "its points",
        error,
        other,
    ]
    crop = object_crop(dataset.load_pair(pair)[1][view])
    assert np.array_equal(figure.axes[1].get_images()[0].get_array(), crop.rgb)
    drawn, turned = (axis.collections[0].get_offsets() for axis in figure.axes[4:])
    x, y = np.floor(drawn.data).astype(int).clip(0, 223).T
    assert np.mean(crop.mask[y, x] > 0.5) > 0.9  # the pose is nearly exact
    # a rotation alone is drawn in the middle of the object
    assert np.abs(turned.mean(axis=0) - 112).max() < 40
    refused(
        "pair 'lump' has no pose in the run, expected a key such as lump/",
        pair_figure,
        found,
        "lump",
        dataset,
    )
    refused("has no pose in the run", pair_figure, found, pair.key, dataset, ["blind"])
    refused("row 'nobody' is not in the run", pair_figure, found, pair.key, dataset, ["nobody"])


def test_shipped_pairs_come_first_and_only_where_there_are_enough(tmp_path):
    dataset = Co3D(shutil.copytree(small_folder(), tmp_path / "copy"))
    shipped = sample_pairs(dataset, "lump", 4, 3, seed=9)
    write_published_pairs(
        dataset.root / "determ_eval" / "4samples_3tgt" / "lump.pt", shipped, dataset
    )
    assert category_pairs(dataset, "lump", 3, 3) == shipped[:3]
    assert category_pairs(dataset, "lump", 5, 3) == sample_pairs(dataset, "lump", 5, 3)


def test_frames_that_cannot_be_used_count_as_failures(tmp_path):
    class Blind(CoordinateBackbone):
        def features(self, image):
            found = super().features(image)
            return replace(found, saliency=0 * found.saliency)

    row = run_rows(["ours"], tmp_path, 2, 5, backbone=Blind(grid=8))["ours"]
    assert row["failed"] == row["n"] == 2 and row["acc30"] == 0 and row["median"] == 180
    assert (
        read_run(tmp_path)
        .row("ours")["failed"]
        .str.contains("all 5 target views were left out")
        .all()
    )


def test_a_target_view_with_an_empty_mask_is_left_out_and_the_pair_is_not_lost(tmp_path):
    dataset = Co3D(shutil.copytree(small_folder(), tmp_path / "copy"))
    (pair,) = sample_pairs(dataset, "lump", 1, 3)
    path = (
        dataset.root / dataset.frame("lump", pair.target_sequence, pair.target_frames[0]).mask.path
    )
    write_mask(path, np.zeros((90, 100), np.float32))
    evaluate(dataset.root, BACKBONE, ("ours", "verified"), {"lump": 1}, 3, tmp_path / "run")
    for row in ("ours", "verified"):
        found = read_run(tmp_path / "run").row(row).iloc[0]
        assert (
            found["failed"] == ""
            and found["error"] < 30
            and "mask" in found["note"]
            and found["view"] > 0
        )


def test_unknown_methods_categories_and_folders_and_the_folder_of_another_run_are_refused(
    run, tmp_path
):
    class Renamed(CoordinateBackbone):
        pass

    new = {"out": tmp_path / "a"}
    for root, backbone, options, told in (
        (
            small_folder(),
            BACKBONE,
            {"out": run[0], "targets": 3},
            "a run with targets 5, this is 3",
        ),
        (small_folder(), Renamed(grid=8), {"out": run[0]}, "a run with backbone .*Renamed"),
        (
            small_folder(),
            BACKBONE,
            new | {"pairs": {"teapot": 1}},
            "category is 'teapot', expected one of lump",
        ),
        (small_folder(), BACKBONE, new | {"pairs": {"lump": 0}}, "pairs of lump is 0"),
        (small_folder(), BACKBONE, new | {"targets": 0}, "targets is 0"),
        (tmp_path / "nowhere", BACKBONE, new, "nowhere"),
    ):
        refused(told, evaluate, root, backbone, **options)
    assert not (tmp_path / "a").exists()


def _object_pose(matrix: np.ndarray) -> dict:
    matrix[3] = 0, 0, 0, 1
    return {"trans": matrix.tolist(), "scale": 1.0, "low": [0, 0, 0], "high": [1, 1, 1]}


def test_an_error_up_to_symmetries_forgives_turns_that_both_objects_allow(tmp_path, monkeypatch):
    labels = read_labels(small_folder(), "lump")

    def half_turned(problem):
        first, second = (
            (labels[frame.name.partition("/")[0]], frame.camera) for frame in problem.frames()
        )
        truth = relative_pose(*first, *second)
        return second[1].R @ np.diag([-1.0, -1, 1]) @ second[1].R.T @ truth[:3, :3]

    for turns, expected in (((180,), 0), ((90,), 90), ((), 180)):
        pose = ObjectPose(np.eye(4)[:3].tolist(), 1.0, (0, 0, 0), (1, 1, 1), turns)
        monkeypatch.setattr(
            "zsp_lite.data.ground_truth.read_poses", lambda *_: dict.fromkeys(labels, pose)
        )
        summary = evaluate(
            small_folder(),
            BACKBONE,
            {"mine": half_turned},
            {"lump": 2},
            1,
            tmp_path / str(expected),
        )
        found = read_run(tmp_path / str(expected)).row("mine")[["symmetric_error", "error"]]
        np.testing.assert_allclose(found, [[expected, 180]] * 2, atol=1e-5)
        assert summary["methods"]["mine"]["symmetric_acc30"] == 100 * (expected < 30)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{"100_a": {"trans": [[1, 0, 0, 0]], "scale": 1}}', "Expected"),
        (json.dumps({"100_a": _object_pose(1.05 * np.eye(4))}), "100_a is"),
    ],
)
def test_object_poses_of_another_layout_cost_a_warning_and_the_figure_that_needs_them(
    tmp_path, caplog, text, expected
):
    dataset = Co3D(shutil.copytree(small_folder(), tmp_path / "copy"))
    path = dataset.root / "lump" / POSES_FILE
    path.write_text(text)
    found = evaluate(
        dataset.root, BACKBONE, {"mine": own_method}, {"lump": 3}, 2, tmp_path / "out"
    )["methods"]["mine"]
    assert found["n"] == 3 and found["failed"] == 0 and "symmetric_acc30" not in found
    (told,) = caplog.messages
    assert (
        str(path) in told
        and expected in told
        and told.endswith(": without it there is no symmetric_acc30")
    )
    refused(POSES_FILE, object_poses, dataset, "lump")


def test_seeds_repeat_every_pair_with_other_draws_and_tables_average_over_them(tmp_path):
    arguments = (small_folder(), BACKBONE, ["ours", "ours-bv"], 3, 3)
    evaluate(
        small_folder(),
        BACKBONE,
        {"ours-mask": "ours-mask", "none": lambda one: None},
        3,
        3,
        tmp_path / "three",
    )
    # and as a call with more seeds that was interrupted
    first = read_lines(tmp_path / "three")[0].pair
    add_lines(
        tmp_path / "three", [{"pair": first, "repeat": 1, "results": {"ours-mask": {"error": 0.0}}}]
    )
    evaluate(*arguments, tmp_path / "one")
    once = read_run(tmp_path / "one")
    evaluate(*arguments, tmp_path / "three")
    summary = evaluate(*arguments, tmp_path / "three", seeds=3)
    found = read_run(tmp_path / "three")
    repeated = found.table[found.table["row"].isin(["ours", "ours-bv"])]
    first = repeated[repeated["repeat"] == 0]["error"].tolist()
    assert first == once.table["error"].tolist(), "the first seed is that of a run with one"
    assert repeated.groupby(["row", "pair"]).size().eq(3).all()
    assert found.table[found.table["row"] == "ours"].groupby("pair")["error"].nunique().max() > 1
    ours, before = (one["methods"]["ours"] for one in (summary, once.summary))
    assert ours["n"] == before["n"] and summary["data"]["pairs"] == once.summary["data"]["pairs"]
    by_seed = [
        100 * (errors < 30).mean() for _, errors in found.row("ours").groupby("repeat")["error"]
    ]
    assert (
        ours["acc30"] == pytest.approx(np.mean(by_seed))
        and summary["methods"]["ours-mask"]["n"] == ours["n"]
    )
    assert ours["acc30_sd_of_seeds"] == pytest.approx(np.std(by_seed, ddof=1))
    write_reports(tmp_path / "three")
    assert (
        "by seed, Acc30 of ours has a standard deviation of"
        in (tmp_path / "three/tables/all_rows.md").read_text()
    )
    summary = evaluate(
        small_folder(), BACKBONE, {"none": lambda one: None}, 3, 3, tmp_path / "three", seeds=2
    )
    assert (
        summary["methods"]["none"]["failed"] == 6
        and "none failed on 6 of 6 pairs" in summary["note"]
    )
    mask = found.row("ours-mask")["error"]
    gain = 100 * ((mask < 30).mean() - (once.row("ours")["error"] < 30).mean())
    assert summary["against"]["ours-mask"]["accuracy_gain"] == pytest.approx(gain), (
        "a row with the first seed only"
    )
    assert len(pair_figure(found, mask.index[0], Co3D(small_folder())).axes) == 8, "all but none"
