"""The objects of a category in one frame, from a folder to labels: the run, what it writes, and a
user's own pair with helpers."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import permutations

import msgspec
import numpy as np
import pytest
from benchmark_folder import QUICK, SEQUENCES, run_rows, small_folder
from numpy.testing import assert_allclose
from refusals import refused

from zsp_lite import Co3D, Sim3, align_category, estimate_pose
from zsp_lite.benchmark.problem import FrameStore
from zsp_lite.benchmark.run import evaluate
from zsp_lite.course.labelling.session import Labelling
from zsp_lite.data.labels import read_labels
from zsp_lite.importers.convert import scale_frame
from zsp_lite.metrics import rotation_error
from zsp_lite.objects.align import read_hypotheses, write_labels
from zsp_lite.scans.category import PairHypotheses, synchronise, world_hypotheses
from zsp_lite.viz.category_sheet import objects_figure

A, B, C = SEQUENCES
HALF_TURN = Sim3(1.0, np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
PAIRS = 12  # lines of run.jsonl: six ordered pairs of objects, two frames of the first in each
align_lumps = partial(align_category, Co3D(small_folder()), "lump", QUICK)


@pytest.fixture(scope="module")
def aligned_run(tmp_path_factory):
    """The folder of a run, and the alignment that it returned."""
    out = tmp_path_factory.mktemp("align")
    return out, align_lumps(targets=3, out=out)


def test_sources_in_place_of_a_data_set_are_aligned_in_their_own_lengths():
    dataset = Co3D(small_folder())
    frames = [scale_frame(dataset.load(one), 1000.0) for one in dataset.frames("lump", B)]
    sources = (dataset.root / "lump" / A, iter(frames))
    found = align_category(iter(sources), backbone=QUICK, targets=3)
    pose = found.between(A, "2")  # objects in memory are named by their position, from 1
    assert rotation_error(pose.R, turns(dataset.root)[A, B]) < 15
    assert_allclose(pose.scale, 1000, rtol=0.1)
    refused("two objects are named 100_a", align_category, sources[:1] * 2)


def turns(root):
    """The rotation between the worlds of each ordered pair of objects, by the labels."""
    labels = read_labels(root, "lump")
    return {
        (a, b): labels[b].trans[:3, :3] @ labels[a].trans[:3, :3].T
        for a, b in permutations(SEQUENCES, 2)
    }


def test_objects_are_aligned_as_their_labels_and_the_written_labels_say(aligned_run, tmp_path):
    _, alignment = aligned_run
    write_labels(alignment, tmp_path, "lump")
    written = turns(tmp_path)
    for pair, true in turns(small_folder()).items():
        rotation = alignment.between(*pair).R
        assert rotation_error(rotation, true) < 15  # degrees: a patch of the small grid
        assert_allclose(written[pair], rotation, atol=1e-6)


def test_the_row_of_the_benchmark_takes_the_pose_from_the_alignment_of_all_objects(tmp_path):
    row = run_rows(["category"], tmp_path, pairs=2, targets=3)["category"]
    assert row["n"] == 2
    assert row["median"] < 20  # degrees


def poses(alignment) -> dict[str, list]:
    """The matrix of each object."""
    return {name: pose.sim3.matrix.tolist() for name, pose in alignment.objects.items()}


def test_a_killed_run_is_continued_where_it_was_and_by_other_workers(
    aligned_run, tmp_path, monkeypatch
):
    out, whole = aligned_run
    lines = (out / "run.jsonl").read_text().splitlines(keepends=True)
    assert len(lines) == PAIRS
    # The run was killed while it wrote its 8th line.
    shutil.copy(out / "run.json", tmp_path)
    (tmp_path / "run.jsonl").write_text("".join(lines[:7]) + lines[7][:30])
    with ThreadPoolExecutor(2) as executor:
        continued = align_lumps(targets=3, out=tmp_path, executor=executor)
    assert sorted((tmp_path / "run.jsonl").read_text().splitlines(keepends=True)) == sorted(lines)
    monkeypatch.setattr(FrameStore, "_hypotheses", pytest.fail)  # nothing is left to compute
    read = align_lumps(targets=3, out=tmp_path)
    assert poses(continued) == poses(read) == poses(whole)
    answers = read_hypotheses(tmp_path).values()
    assert synchronise([*answers]).objects.keys() == whole.objects.keys()


def test_a_run_is_continued_by_its_own_command_and_settings_alone(aligned_run):
    out, _ = aligned_run
    message = "holds a run with command align, this is benchmark"
    refused(message, evaluate, small_folder(), QUICK, ["ours"], 1, 3, out)
    refused("holds a run with targets 3, this is 2", align_lumps, targets=2, out=out)


@pytest.fixture
def without_vertical(monkeypatch):
    """Shapes whose vertical is known would be aligned without any hypothesis."""
    monkeypatch.setattr("zsp_lite.benchmark.problem.find_up", lambda frames: (None, ""))


def test_an_object_without_a_pose_is_left_out(monkeypatch, without_vertical):
    def fail_for_c(store, pair):
        if C not in (pair.reference_sequence, pair.target_sequence):
            return solve(store, pair)

    solve = FrameStore._hypotheses
    monkeypatch.setattr(FrameStore, "_hypotheses", fail_for_c)
    assert list(align_lumps(SEQUENCES, targets=3).objects) == [A, B]


def test_objects_without_any_pose_are_refused(monkeypatch, without_vertical):
    monkeypatch.setattr(FrameStore, "_hypotheses", lambda store, pair: None)
    refused("nothing tells the pose between any two objects", align_lumps, targets=3)


def test_the_command_writes_labels_a_report_and_proposals_which_labelling_takes(
    aligned_run, tmp_path, monkeypatch, run
):
    root = tmp_path / "data"
    out = tmp_path / "out"
    shutil.copytree(small_folder(), root)
    _, alignment = aligned_run
    turned = alignment.between(A, C) @ HALF_TURN
    wrong = PairHypotheses(A, C, (turned,), np.ones(1), np.zeros(3))
    disagreeing = replace(alignment, pairs=(wrong,))
    monkeypatch.setattr("zsp_lite.objects.align.align_category", lambda *_, **__: disagreeing)
    line = f"align {root} --category lump --out {out}"
    text = run(f"{line} --propose")
    assert "lump: 3 objects in one frame" in text
    assert "100.0% of 6 ordered pairs are within 30°" in text
    assert f"{A} to {C}: the best pose of the pair alone is 180° away" in text
    assert (out / "report.html").read_bytes().count(b"<img") == 1
    assert (out / "objects.jpg").stat().st_size > 1000  # bytes: more than a blank picture
    content = json.loads((out / "alignment.json").read_text())
    assert content["disagreements"] == [{"pair": [A, C], "degrees": 180.0}]
    assert_allclose(content["objects"][B]["world_to_frame"], alignment.objects[B].sim3.matrix)
    labelling = Labelling(root, "lump")
    assert rotation_error(labelling.proposal(C).R, alignment.between(A, C).R) < 0.01
    # A later call compares with the proposals as well.
    assert "By the proposals, 100.0% of 6 ordered pairs" in run(line)


def test_the_objects_of_a_category_without_masks_are_shown_in_whole_frames(
    aligned_run, monkeypatch
):
    frames = Co3D.frames

    def without_masks(*names) -> list:
        return [msgspec.structs.replace(frame, mask=None) for frame in frames(*names)]

    monkeypatch.setattr(Co3D, "frames", without_masks)
    panels = objects_figure(Co3D(small_folder()), "lump", aligned_run[1]).axes
    assert len(panels) == 6  # three objects, as they were scanned and aligned
    # The object fills a crop; in a whole frame the corners are black.
    assert not panels[0].images[0].get_array()[:40, :40].any()


def test_helpers_settle_what_the_pair_gets_wrong(monkeypatch):
    """Every frame of the pair itself votes for a half turn, which the third object shows to be
    wrong."""

    def misled(reference, target, estimate):
        """Prefer a half turn in A's world to the best pose, if the objects are A and B."""
        found = world_hypotheses(reference, target, estimate)
        best = found.sim3s[0]
        doubtful = np.array([0.97, 0.01])
        if A in reference and B in target:
            return replace(found, sim3s=(best @ HALF_TURN, best), probabilities=doubtful)
        if B in reference and A in target:
            return replace(found, sim3s=(HALF_TURN @ best, best), probabilities=doubtful)
        return found

    monkeypatch.setattr("zsp_lite.objects.estimate.world_hypotheses", misled)
    # The vertical and the shapes, which show the error too, tell nothing.
    monkeypatch.setattr("zsp_lite.objects.scan.find_up", lambda frames: (None, ""))
    monkeypatch.setattr(
        "zsp_lite.scans.judge.chamfer_distance", lambda first, second, poses: np.ones(len(poses))
    )
    *pair, helper = [small_folder() / "lump" / name for name in SEQUENCES]
    settings = {"backbone": QUICK, "targets": 3, "references": 2}
    assert estimate_pose(*pair, **settings).errors["verified"] > 150
    result = estimate_pose(*pair, helpers=[helper], **settings)
    assert result.errors["verified"] < 15
    assert result.estimate.confidence > 0.4
    assert result.sources[1].endswith(f"helpers: {helper}")


def test_a_helper_is_another_object():
    *pair, helper = [small_folder() / "lump" / name for name in SEQUENCES]
    helpers = [pair[1], helper]
    refused("expected different objects", estimate_pose, *pair, helpers=helpers, backbone=QUICK)
