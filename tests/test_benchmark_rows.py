"""The rows of the paper's tables on a folder whose features are perfect."""

from dataclasses import replace

import pytest
import torch
from benchmark_folder import small_folder
from synthetic_views import CoordinateBackbone

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.baselines.posecontrast import Viewpoint
from zsp_lite.baselines.sift import Sift
from zsp_lite.benchmark import extractors
from zsp_lite.benchmark.identity import fingerprint
from zsp_lite.benchmark.methods import GROUPS, METHODS, resolve
from zsp_lite.benchmark.problem import Problem
from zsp_lite.benchmark.records import read_records
from zsp_lite.benchmark.run import evaluate, pairs_of_rows
from zsp_lite.benchmark.store import FrameStore
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose

pytestmark = pytest.mark.slow

BACKBONE = CoordinateBackbone(grid=8)
ROWS = (*GROUPS["ablations"], "ours-n1", "ours-n3", "ours-n5", "ours-bv-n3", "icp", "icp-bv", "sift")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("rows")
    summary = evaluate(small_folder(), BACKBONE, ROWS, 6, 5, out=out, categories=["pebble"])
    return summary["methods"], read_records(out).rows


def test_every_row_answers_every_pair_and_with_perfect_features_every_way_to_match_and_fit_is_right(run):
    rows, _ = run
    assert set(rows) == set(ROWS)
    assert all(row["n"] == 6 and row["failed"] == 0 for row in rows.values())
    exact = [*GROUPS["correspondences"], *GROUPS["matchers"], *GROUPS["trials"], *GROUPS["published"]]
    assert all(rows[name]["acc30"] >= 80 for name in exact)
    assert rows["ours-n1"]["acc30"] <= rows["ours-n3"]["acc30"] <= rows["ours-n5"]["acc30"]


def test_a_row_with_the_runs_number_of_views_is_the_row_without_a_number(run):
    rows, records = run
    assert len(records["ours"]) == 6 and rows["ours-n5"] == rows["ours"]
    assert all(records["ours-n5"][key]["error"] == found["error"] for key, found in records["ours"].items())
    assert len(records["ours-n3"]) == 6 and all(key.count(",") == 2 for key in records["ours-n3"])


def test_a_row_is_the_method_with_its_settings_on_the_frames_themselves(run):
    _, records = run
    dataset, labels = Co3D(small_folder()), read_labels(small_folder(), "pebble")
    (pair, *_) = pairs_of_rows(small_folder(), resolve(["ours"]), 6, 5, categories=["pebble"])["ours"]
    reference, targets = dataset.load_pair(pair)
    for name in ("ours", "ours-published", "ours-k70-nokmeans", "ours-transport", "ours-saliencyiou"):
        estimate = ZeroShotPose(BACKBONE, **METHODS[name].settings, seed=pair.seed).estimate(reference, targets)
        camera = estimate.target_camera
        truth = camera.R @ labels[pair.target_sequence].trans[:3, :3]
        truth = truth @ labels[pair.reference_sequence].trans[:3, :3].T @ reference.camera.R.T
        found = records[name][pair.key]
        assert found["error"] == pytest.approx(rotation_error(estimate.sim3.R, truth), abs=1e-9)
        assert found["view"] == estimate.view and found["inliers"] == estimate.inliers.sum()


def test_rows_differ_as_their_names_say(run):
    _, records = run
    fitted = [one for one in records["ours-nodepth"].values() if one["note"] == ""]
    assert len(fitted) >= 4 and all("translation_error" not in one and one["inliers"] >= 5 for one in fitted)
    for key, found in records["ours"].items():
        assert records["icp"][key]["view"] == 0 and records["icp-bv"][key]["view"] == found["view"]


@pytest.mark.parametrize("row", ["icp", "sift"])
def test_a_pair_without_depth_fails(row, monkeypatch):
    (pair,) = pairs_of_rows(small_folder(), resolve([row]), 1, 2, categories=["pebble"])[row]
    problem = Problem(pair, FrameStore(Co3D(small_folder()), "pebble", {"sift": Sift()}))
    frames = [replace(frame, depth=None) for frame in problem.frames()]
    monkeypatch.setattr(problem, "frames", lambda: frames)
    with pytest.raises(InputError, match="no depth map: 100_a"):
        METHODS[row].solve(problem)


def test_stages_that_rows_have_in_common_are_done_once(tmp_path, monkeypatch):
    calls = []
    match_views = ZeroShotPose.match_views
    monkeypatch.setattr(ZeroShotPose, "match_views", lambda *args: (calls.append(1), match_views(*args))[1])
    rows = ("ours", "ours-bv", "ours-globalsim", "ours-trials500", "ours-nodepth", "ours-n3", "icp-bv")
    evaluate(small_folder(), BACKBONE, rows, 2, 3, out=tmp_path, categories=["pebble"])
    assert len(calls) == 2 * 3


def test_rows_whose_matches_differ_do_not_share_them(tmp_path, monkeypatch):
    """The verified solver takes the best matches, the paper's those that k-means selects."""
    calls, match_views = [], ZeroShotPose.match_views

    def record(method, *args):
        calls.append(method.clusters)
        return match_views(method, *args)

    monkeypatch.setattr(ZeroShotPose, "match_views", record)
    evaluate(small_folder(), BACKBONE, ["ours", "verified"], 1, 2, out=tmp_path, categories=["pebble"])
    assert sorted(calls) == [False, False, True, True]


class TrueViewpoints:
    """Says of each frame the pose that its label says."""

    name = "true viewpoints"

    def describe(self, frames):
        return [self.viewpoint(frame) for frame in frames]

    def viewpoint(self, frame):
        label = read_labels(small_folder(), "pebble")[frame.name.split("/")[0]]
        return Viewpoint(frame.camera.R @ label.trans[:3, :3], torch.from_numpy(frame.camera.R[2].copy()))


def test_two_right_absolute_poses_make_a_right_relative_one(tmp_path, monkeypatch):
    monkeypatch.setitem(extractors.EXTRACTORS, "posecontrast", lambda backbone: TrueViewpoints())
    summary = evaluate(small_folder(), BACKBONE, ["posecontrast"], 4, 3, out=tmp_path, categories=["pebble"])
    assert summary["methods"]["posecontrast"]["median"] < 1e-5


def test_swav_is_matched_as_mutual_neighbours(tmp_path, monkeypatch):
    monkeypatch.setitem(extractors.EXTRACTORS, "swav", lambda backbone: BACKBONE)
    summary = evaluate(small_folder(), BACKBONE, ["swav"], 4, 5, out=tmp_path, categories=["pebble"])
    assert summary["methods"]["swav"]["acc30"] >= 75


def test_a_row_whose_weights_are_missing_says_so_before_anything_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path / "cache"))
    with pytest.raises(InputError, match="posecontrast"):
        evaluate(small_folder(), BACKBONE, ["posecontrast"], 1, 2, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_fingerprint_tells_apart_whatever_changes_the_features():
    torch.manual_seed(0)
    vit = VisionTransformer(32, 8, embed_dim=12, depth=3, num_heads=2)

    def of(**options):
        return fingerprint(Backbone(vit, "same name", device="cpu", **options))

    plain = of()
    assert plain == of(layer=2, facet="key", mean=[0.485, 0.456, 0.406])  # the defaults, said aloud
    changes = {"layer": 1, "facet": "query", "saliency_heads": [1], "image_size": 64, "mean": (0,) * 3, "std": (1,) * 3}
    assert len({plain, *(of(**{name: value}) for name, value in changes.items())}) == 1 + len(changes)
    with torch.no_grad():
        vit.cls_token += 1
    assert of() != plain
    facet = extractors.random_backbone(Backbone(vit, "same name", device="cpu", facet="value", image_size=64))
    assert (facet.facet, facet.image_size) == ("value", 64)
