"""A category in one frame, from a folder to labels: the run, what is written, one's own pair with
helpers."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import permutations

import msgspec
import numpy as np
import pytest
from benchmark_folder import SEQUENCES, SlowBackbone, run_rows, small_folder
from numpy.testing import assert_allclose
from refusals import refused

from zsp_lite import Co3D, InputError, ZeroShotPose, align_category, estimate_pose
from zsp_lite.align import read_hypotheses, write_labels
from zsp_lite.benchmark.problem import PairProblem
from zsp_lite.benchmark.run import evaluate
from zsp_lite.category import synchronise
from zsp_lite.cli import main as cli
from zsp_lite.course.labelling.session import Labelling
from zsp_lite.data.frames import resize_frame
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import NoPoseError
from zsp_lite.metrics import rotation_error
from zsp_lite.viz.category_sheet import objects_figure

BACKBONE = SlowBackbone(grid=8, _seconds=0)
A, B, C = SEQUENCES
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("align")
    return out, align_category(Co3D(small_folder()), "lump", BACKBONE, targets=3, out=out)


def turns(root):
    labels = read_labels(root, "lump")
    return {
        (a, b): labels[b].trans[:3, :3] @ labels[a].trans[:3, :3].T
        for a, b in permutations(SEQUENCES, 2)
    }


def test_objects_are_aligned_as_their_labels_and_the_written_labels_say(run, tmp_path):
    _, found = run
    write_labels(found, tmp_path, "lump")
    written = turns(tmp_path)
    for pair, true in turns(small_folder()).items():
        assert rotation_error(found.between(*pair).R, true) < 15
        assert_allclose(written[pair], found.between(*pair).R, atol=1e-6)
    with pytest.raises(InputError, match="would be replaced by other content"):
        write_labels(
            replace(found, objects=dict(reversed(found.objects.items()))), tmp_path, "lump"
        )


def test_the_row_of_the_benchmark_takes_the_pose_from_the_alignment_of_all_objects(tmp_path):
    found = run_rows(["verified", "category"], tmp_path, 2, 3)
    assert found["category"]["n"] == 2
    assert found["category"]["median"] < 20


def test_a_killed_run_is_continued_where_it_was_and_by_other_workers(run, tmp_path, monkeypatch):
    out, whole = run
    lines = (out / "run.jsonl").read_text().splitlines(keepends=True)
    assert len(lines) == 5 * 6
    (tmp_path / "run.json").write_text((out / "run.json").read_text())
    (tmp_path / "run.jsonl").write_text("".join(lines[:14]) + lines[14][:30])
    with ThreadPoolExecutor(2) as executor:
        found = align_category(
            Co3D(small_folder()), "lump", BACKBONE, targets=3, out=tmp_path, executor=executor
        )
    assert sorted((tmp_path / "run.jsonl").read_text().splitlines(keepends=True)) == sorted(lines)
    monkeypatch.setattr(PairProblem, "hypotheses", None)  # nothing is left to compute
    again = align_category(Co3D(small_folder()), "lump", BACKBONE, targets=3, out=tmp_path)
    for one in (found, again, synchronise(list(read_hypotheses(tmp_path).values()))):
        assert {name: pose.sim3.matrix.tolist() for name, pose in one.objects.items()} == {
            name: pose.sim3.matrix.tolist() for name, pose in whole.objects.items()
        }
    with pytest.raises(InputError, match="holds a run with command align, this is benchmark"):
        evaluate(small_folder(), BACKBONE, ["ours"], 1, 3, tmp_path)
    with pytest.raises(InputError, match="holds a run with targets 3, this is 2"):
        align_category(Co3D(small_folder()), "lump", BACKBONE, targets=2, out=tmp_path)


def test_pairs_without_a_pose_are_left_out_until_none_is_left(monkeypatch):
    def fail(problem):
        if C in (problem.pair.reference_sequence, problem.pair.target_sequence) or everything:
            raise NoPoseError("no pose")
        return solve(problem)

    solve = PairProblem.hypotheses
    everything = False
    monkeypatch.setattr(PairProblem, "hypotheses", fail)
    assert list(
        align_category(Co3D(small_folder()), "lump", BACKBONE, SEQUENCES, targets=3).objects
    ) == [A, B]
    everything = True
    refused(
        "none of 30 pairs determines a pose",
        align_category,
        Co3D(small_folder()),
        "lump",
        BACKBONE,
        targets=3,
    )


def test_the_command_writes_labels_a_report_and_proposals_which_labelling_takes(
    run, tmp_path, monkeypatch, capsys
):
    root = tmp_path / "data"
    out = tmp_path / "out"
    shutil.copytree(small_folder(), root)
    found = replace(run[1], disagreements={(A, C): 179.96})
    monkeypatch.setattr("zsp_lite.align.align_category", lambda *_, **__: found)
    assert cli.main(f"align {root} --category lump --out {out} --propose".split()) == 0
    text = capsys.readouterr().out
    assert "lump: 3 objects in one frame" in text
    assert "100.0% of 6 ordered pairs are within 30°" in text
    assert f"{A} to {C}: the best pose of the pair alone is 180° away" in text
    assert (out / "report.html").read_bytes().count(b"<img") == 1
    assert (out / "objects.jpg").stat().st_size > 1000
    alignment = json.loads((out / "alignment.json").read_text())
    assert alignment["disagreements"] == [{"pair": [A, C], "degrees": 179.96}]
    assert_allclose(alignment["objects"][B]["world_to_frame"], run[1].objects[B].sim3.matrix)
    labelling = Labelling(root, "lump")
    assert rotation_error(labelling.proposal(C).R, run[1].between(A, C).R) < 0.01
    assert cli.main(["align", str(root), "--category", "lump", "--out", str(out)]) == 0
    assert "By the proposals, 100.0% of 6 ordered pairs" in capsys.readouterr().out


def test_the_objects_of_a_category_without_masks_are_shown_in_whole_frames(run, monkeypatch):
    dataset, frames = Co3D(small_folder()), Co3D.frames
    monkeypatch.setattr(
        Co3D, "frames", lambda *of: [msgspec.structs.replace(one, mask=None) for one in frames(*of)]
    )
    shown = [axis.images[0].get_array() for axis in objects_figure(dataset, "lump", run[1]).axes]
    assert len(shown) == 6
    whole = [
        resize_frame(dataset.load(one), (224, 224)).rgb.tolist()
        for one in dataset.frames("lump", A)
    ]
    assert shown[0].tolist() in whole


def test_helpers_settle_what_the_pair_gets_wrong(monkeypatch):
    """Every frame of the pair itself votes for a half turn, which the third object shows to be
    wrong."""

    def misled(method, reference, targets, matched=None):
        one = estimate(method, reference, targets, matched)
        ends = [name.split("/")[0] for name in (reference.frame.name, targets[0].frame.name)]
        if set(ends) != {A, B}:
            return one
        best = one.hypotheses[0]
        # the half turn is that of A's world
        turn = reference.frame.camera.R
        other = targets[best.view].frame.camera.R
        turned = (
            best.sim3.R @ turn @ HALF_TURN @ turn.T
            if ends[0] == A
            else other @ HALF_TURN @ other.T @ best.sim3.R
        )
        wrong = replace(best, sim3=replace(best.sim3, R=turned))
        return replace(
            one,
            sim3=wrong.sim3,
            hypotheses=(replace(wrong, confidence=0.6), replace(best, confidence=0.3)),
        )

    estimate = ZeroShotPose.estimate_from_views
    monkeypatch.setattr(ZeroShotPose, "estimate_from_views", misled)
    sources = [small_folder() / "lump" / name for name in SEQUENCES]
    settings = {"backbone": BACKBONE, "targets": 3, "references": 2}
    assert estimate_pose(*sources[:2], **settings).errors["verified"] > 150
    found = estimate_pose(*sources[:2], helpers=sources[2:], **settings)
    one = found.estimates["verified"]
    assert found.errors["verified"] < 15
    assert one.confidence > 0.5
    assert not one.one_of_two
    assert found.sources[1].endswith(f"helpers: {sources[2]}")
    assert one.flags[-1].startswith("4 of 4 frames vote for another pose: frame 0 of")
    refused(
        "expected different objects", estimate_pose, *sources[:2], helpers=sources[1:], **settings
    )
