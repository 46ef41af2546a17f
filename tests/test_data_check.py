"""The check of a data folder counts its content and names the problems."""

import cv2
import numpy as np
import pytest
from co3d_folders import contents, convert_to_v2, edit_json, write_category, write_identities
from refusals import refused

from zsp_lite.data.check import check_folder
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.evaluation import sample_pairs
from zsp_lite.data.labels import PoseLabel
from zsp_lite.data.writing import pairs_path, write_label, write_published_pairs


@pytest.fixture
def root(tmp_path):
    """A labelled data folder of two sequences of four frames."""
    write_category(tmp_path, "chair", "ab")
    write_identities(tmp_path, "chair", "ab")
    return tmp_path


def frame_file(root, part, sequence="a"):
    """The first file of a part of the frames of a sequence."""
    return sorted((root / "chair" / sequence / part).iterdir())[0]


def test_a_complete_folder_has_no_problems(root):
    dataset = Co3D(root)
    write_published_pairs(
        pairs_path(root, "chair", 3, 2), sample_pairs(dataset, "chair", 3, 2), dataset
    )
    write_category(root, "stool", "c")
    convert_to_v2(root / "stool")
    check, stool = check_folder(root, deep=True)
    assert not check.problems
    assert stool.layout == "v2"
    assert (check.category, check.layout, check.sequences, check.frames) == ("chair", "v1", 2, 8)
    assert (check.complete, check.labelled, check.usable, check.pairs) == (2, 2, 2, 1)
    files = contents(root / "chair")  # the annotations do not count
    assert check.size == sum(len(files[name]) for name in files if not name.endswith(".jgz"))


@pytest.mark.parametrize("part", ["images", "masks", "depths", "depth_masks"])
def test_a_missing_and_an_empty_file_are_named(root, part):
    gone, empty = frame_file(root, part), frame_file(root, part, "b")
    gone.unlink()
    empty.write_bytes(b"")
    (check,) = check_folder(root)
    assert check.problems == [
        f"{gone.relative_to(root).as_posix()} is missing",
        f"{empty.relative_to(root).as_posix()} is empty",
    ]
    # Three whole frames of a sequence are enough for the evaluation.
    assert (check.complete, check.usable) == (0, 2)


def test_a_broken_file_is_found_by_a_deep_check_alone(root):
    for path in (frame_file(root, "images"), root / "chair/b/pointcloud.ply"):
        path.write_bytes(path.read_bytes()[:60])
    assert not check_folder(root)[0].problems
    problems = check_folder(root, deep=True)[0].problems
    assert len(problems) == 2
    assert "cannot be decoded" in problems[0]
    assert "point cloud" in problems[1]


def test_black_and_empty_frames_are_counted_by_a_deep_check(root, run):
    images, masks = (sorted((root / "chair/a" / part).iterdir()) for part in ("images", "masks"))
    for path in (*images[:2], masks[2]):
        cv2.imwrite(str(path), np.zeros((24, 32), np.uint8))
    (shallow,) = check_folder(root)
    assert (shallow.defects, shallow.usable) == ({}, 2)
    (deep,) = check_folder(root, deep=True)
    # One of the four frames of a is left.
    assert (deep.defects, deep.problems, deep.usable) == (
        {"black image": 2, "empty object mask": 1},
        [],
        1,
    )
    text = run(f"data check {root} --deep")
    assert "chair: 3 of 8 frames cannot be used (black image 2, empty object mask 1)" in text


def test_sequences_without_a_point_cloud_are_counted(root, run):
    """A cloud that the annotations lack is no problem, a file that is missing is one."""
    annotations = root / "chair/sequence_annotations.jgz"
    edit_json(annotations, lambda sequences: sequences[0].update(point_cloud=None))
    write_category(root, "stool", "c")
    check, stool = check_folder(root)
    assert (check.cloudless, check.problems, check.complete, stool.cloudless) == (1, [], 2, 0)
    assert "No problems" in run(f"data check {root}")
    (root / "chair/b/pointcloud.ply").unlink()
    text = run(f"data check {root}", 1)
    assert "chair: 2 of 2 sequences have no point cloud" in text
    assert "chair: chair/b/pointcloud.ply is missing" in text


def test_an_invalid_camera_is_named(root):
    edit_json(
        root / "chair/frame_annotations.jgz",
        lambda frames: frames[1]["viewpoint"].update(T=[0, None, 1]),
    )
    (check,) = check_folder(root)
    assert len(check.problems) == 1
    assert "viewpoint" in check.problems[0]


def test_labels_of_unknown_sequences_and_of_two_references_are_named(root):
    write_label(root, "chair", PoseLabel(np.eye(4), "z", "q"))
    (check,) = check_folder(root)
    assert len(check.problems) == 1
    assert "reference sequences a, q, expected one" in check.problems[0]
    write_label(root, "chair", PoseLabel(np.eye(4), "z", "a"))
    (check,) = check_folder(root)
    assert check.problems == ["label of z is of a sequence that is not in the annotations"]
    assert check.labelled == 3
    assert check.usable == 2


def test_annotations_that_cannot_be_read_are_a_problem_of_their_category(root, tmp_path_factory):
    write_category(root, "stool", "c")
    (root / "chair/frame_annotations.jgz").write_bytes(b"no gzip")
    chair, stool = check_folder(root)
    assert len(chair.problems) == 1
    assert chair.frames == 0
    assert not stool.problems
    assert stool.frames == 4
    refused("holds no category", lambda: check_folder(tmp_path_factory.mktemp("empty")))
