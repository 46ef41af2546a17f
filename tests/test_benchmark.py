"""The benchmark on a small CO3D folder whose features are perfect, so that every figure is known."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from benchmark_folder import small_folder
from synthetic_views import CoordinateBackbone

import zsp_lite
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.benchmark.extractors import random_backbone
from zsp_lite.benchmark.methods import METHODS
from zsp_lite.benchmark.records import read_records
from zsp_lite.benchmark.run import category_pairs, evaluate
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import write_mask
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import sample_pairs, write_published_pairs
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error

BACKBONE = CoordinateBackbone(grid=8)
ROWS = ("ours", "ours-bv", "oracle-view")


@pytest.fixture(scope="module")
def folder():
    return small_folder()


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    seen = []
    summary = evaluate(folder, BACKBONE, ROWS, 6, 5, out=out, progress=lambda *step: seen.append(step))
    return out, summary, seen


def test_the_summary_has_the_fixed_form_and_is_what_the_call_returned(run):
    out, summary, seen = run
    assert json.loads((out / "summary.json").read_text()) == summary
    assert seen == [(i, 12) for i in range(1, 13)]  # progress counts every pair
    # Perfect features solve nearly every pair, and the best view alone does not.
    ours = summary["methods"]["ours"]
    assert ours["acc30"] >= 90 and ours["median"] < 10 and ours["failed"] == 0
    assert summary["methods"]["ours-bv"]["median"] > ours["median"]
    errors = np.array([found["error"] for found in read_records(out).rows["ours"].values()])
    assert summary["methods"]["ours"]["median"] == np.median(errors)
    assert summary["methods"]["ours"]["acc15"] == pytest.approx(100 * np.mean(errors < 15))
    assert {"data", "backbone", "methods", "timings", "saliency_iou"} <= summary.keys()
    for row in summary["methods"].values():
        assert {"n", "median", "acc30", "acc15", "acc30_ci", "per_category"} <= row.keys()
        assert row["n"] == 12 and row["per_category"].keys() == {"lump", "pebble"}
        assert row["per_category"]["lump"]["n"] == 6
        assert row["acc30_ci"][0] <= row["acc30"] <= row["acc30_ci"][1]
    assert {"matching", "view", "alignment", "features_per_frame"} <= summary["timings"].keys()
    # The painted foregrounds agree with the masks.
    assert summary["saliency_iou"].keys() == {"lump", "pebble", "mean"}
    assert all(value > 0.8 for value in summary["saliency_iou"].values())


def test_a_second_run_computes_nothing_again_and_says_the_same(run, folder, monkeypatch):
    out, summary, _ = run

    def never(*arguments):
        raise AssertionError("nothing is left to compute")

    monkeypatch.setattr("zsp_lite.benchmark.execution.evaluate_pair", never)
    before = read_records(out)
    assert evaluate(folder, BACKBONE, ROWS, 6, 5, out=out) == summary
    after = read_records(out)
    assert after.rows == before.rows and after.evaluations == before.evaluations


def test_a_method_added_later_leaves_the_others_as_they_were(folder, tmp_path):
    settings = {"pairs": 3, "targets": 2, "out": tmp_path / "run", "categories": ["lump"]}
    alone = evaluate(folder, BACKBONE, ("ours",), **settings)
    both = evaluate(folder, BACKBONE, ("ours", "rootsift"), **settings)
    every = evaluate(folder, BACKBONE, ("ours",), **settings | {"out": tmp_path / "every", "categories": None})
    assert every["methods"]["ours"]["per_category"]["lump"] == alone["methods"]["ours"]["per_category"]["lump"]
    assert both["methods"]["ours"] == alone["methods"]["ours"]
    assert both["timings"]["features_per_frame"] == alone["timings"]["features_per_frame"]
    assert both["methods"]["rootsift"]["n"] == 3
    assert both["against_ours"]["rootsift"]["accuracy_gain"] == pytest.approx(
        both["methods"]["ours"]["acc30"] - both["methods"]["rootsift"]["acc30"]
    )


def test_the_oracle_takes_the_view_that_is_truly_nearest_in_rotation(run, folder):
    dataset = Co3D(folder)
    rows = read_records(run[0]).rows
    for category in ("lump", "pebble"):
        labels = read_labels(folder, category)
        for pair in sample_pairs(dataset, category, 6, 5):
            a, b = pair.reference_sequence, pair.target_sequence
            frame, targets = dataset.load_pair(pair)
            reference, cameras = frame.camera, [target.camera for target in targets]
            # The object's axes as each camera sees them.
            turns = [camera.R @ labels[b].trans[:3, :3] for camera in cameras]
            angles = [rotation_error(turn, reference.R @ labels[a].trans[:3, :3]) for turn in turns]
            assert rows["oracle-view"][pair.key]["view"] == np.argmin(angles)
            best_view = rows["ours-bv"][pair.key]
            assert best_view["error"] == pytest.approx(angles[best_view["view"]], abs=1e-6)
    assert run[1]["methods"]["oracle-view"]["acc30"] >= 90


def test_shipped_pairs_come_first_and_only_where_there_are_enough(folder, tmp_path):
    dataset = Co3D(shutil.copytree(folder, tmp_path / "copy"))
    sampled = sample_pairs(dataset, "lump", 4, 3, seed=9)
    path = dataset.root / "determ_eval" / "4samples_3tgt" / "lump.pt"
    write_published_pairs(path, sampled, dataset)
    assert category_pairs(dataset, "lump", 3, 3) == sampled[:3]
    assert category_pairs(dataset, "lump", 5, 3, seed=1) == sample_pairs(dataset, "lump", 5, 3, seed=1)


def test_frames_that_cannot_be_used_count_as_failures(folder, tmp_path):
    class Blind(CoordinateBackbone):
        def features(self, image):
            raise InputError("blind")

    summary = evaluate(folder, Blind(grid=8), ("ours",), 2, 5, out=tmp_path, categories=["lump"])
    row = summary["methods"]["ours"]
    assert row["failed"] == row["n"] == 2 and row["acc30"] == 0 and row["median"] == 180


def test_a_target_view_with_an_empty_mask_is_left_out_and_the_pair_is_not_lost(folder, tmp_path):
    dataset = Co3D(shutil.copytree(folder, tmp_path / "copy"))
    (pair,) = sample_pairs(dataset, "lump", 1, 3)
    path = dataset.root / dataset.frame("lump", pair.target_sequence, pair.target_frames[0]).mask.path
    write_mask(path, np.zeros((90, 100), np.float32))
    evaluate(dataset.root, BACKBONE, ("ours", "verified"), 1, 3, out=tmp_path / "run", categories=["lump"])
    for row in ("ours", "verified"):
        (found,) = read_records(tmp_path / "run").rows[row].values()
        assert "failed" not in found and found["error"] < 30 and "mask" in found["note"] and found["view"] > 0


def test_unknown_methods_categories_and_folders_and_the_folder_of_another_run_are_refused(run, folder, tmp_path):
    class Renamed(CoordinateBackbone):
        pass

    for root, backbone, options, told in (
        (folder, BACKBONE, {"out": run[0], "pairs": 7}, "pairs"),
        (folder, Renamed(grid=8), {"out": run[0], "pairs": 6}, "backbone"),
        (folder, BACKBONE, {"out": tmp_path, "methods": ("nonesuch",)}, "nonesuch"),
        (folder, BACKBONE, {"out": tmp_path, "categories": ["teapot"]}, "teapot"),
        (tmp_path / "nowhere", BACKBONE, {"out": tmp_path}, "nowhere"),
    ):
        with pytest.raises(InputError, match=told):
            evaluate(root, backbone, **options)


def test_every_method_is_a_valid_configuration():
    for method in METHODS.values():
        replace(zsp_lite.ZeroShotPose(BACKBONE), **method.settings)


def test_a_random_backbone_has_the_shape_of_the_other_and_its_own_weights():
    like = Backbone(VisionTransformer(32, 8, 12, 2, 3), "small", layer=1)
    first, second = random_backbone(like), random_backbone(like)
    shapes = {key: value.shape for key, value in like.model.state_dict().items()}
    assert {key: value.shape for key, value in first.model.state_dict().items()} == shapes
    weight = "blocks.0.attn.qkv.weight"
    assert (first.model.state_dict()[weight] == second.model.state_dict()[weight]).all()
    assert (first.model.state_dict()[weight] != like.model.state_dict()[weight]).any()
    with pytest.raises(InputError, match="random"):
        random_backbone(BACKBONE)
