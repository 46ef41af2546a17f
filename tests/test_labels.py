"""Labels: relative poses, files, import of published labels and pairs, transfer between
data sets."""

import json
from dataclasses import replace

import numpy as np
import pytest
from co3d_folders import (
    contents,
    convert_to_v2,
    random_camera,
    seeds,
    sequence_data,
    write_category,
    write_identities,
)
from hypothesis import given
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation

from zsp_lite import Co3D, Sim3
from zsp_lite.data.co3d import Pair
from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.data.pairs import shipped_pairs
from zsp_lite.data.published import import_labels, transfer_labels
from zsp_lite.data.writing import SequenceData, write_co3d, write_label, write_published_pairs
from zsp_lite.metrics import rotation_error


@pytest.fixture
def root(tmp_path):
    """A data set without labels: two sequences of chairs."""
    folder = tmp_path / "data"
    write_category(folder, "chair", "ab")
    return folder


@pytest.fixture
def clone(tmp_path, root):
    """A folder with the layout of the published repository: labels, two pairs, and a text."""
    folder = tmp_path / "clone"
    write_identities(folder / "data", "chair", "ab")
    pairs = [Pair("chair", "a", 0, "b", (1, 3)), Pair("chair", "b", 2, "a", (0, 2))]
    write_published_pairs(folder / "data/determ_eval/200samples_2tgt/chair.pt", pairs, Co3D(root))
    (folder / "README.md").write_text("code")
    return folder


def test_labels_and_pairs_alone_are_imported(clone, root, run):
    assert "2 labels, 1 files of pairs" in run(f"data labels {clone} --root {root}")
    assert list(read_labels(root, "chair")) == ["a", "b"]
    assert len(shipped_pairs(Co3D(root), "chair", 2)) == 2
    assert not (root / "README.md").exists()
    before = contents(root)
    run(f"data labels {clone} --root {root}")
    assert contents(root) == before


# Of sequence b, relative to a: a half turn about z.
OTHER_LABEL = PoseLabel(np.diag([-1.0, -1, 1, 1]), "b", "a")


def test_a_label_of_the_users_is_replaced_only_on_request(clone, root, run):
    write_label(root, "chair", OTHER_LABEL)
    before = contents(root)
    command = f"data labels {clone} --root {root}"
    assert "b.json would be replaced by other content, expected --replace" in run(command, 2)
    assert contents(root) == before
    run(f"{command} --replace")
    assert_array_equal(read_labels(root, "chair")["b"].trans, np.eye(4))


def test_nothing_is_written_if_one_file_is_bad(clone, root):
    (clone / "data/determ_eval/200samples_2tgt/chair.pt").write_bytes(b"pickle")
    before = contents(root)
    refused("contains more than tensors", import_labels, clone, root)
    assert contents(root) == before
    # Nor if the labels that are there have another reference.
    write_label(root, "chair", PoseLabel(np.eye(4), "z", "z"))
    before = contents(root)
    refused("have reference sequences a, z, expected one", import_labels, clone, root)
    assert contents(root) == before


@pytest.mark.parametrize("source", ["a missing folder", "labels.zip"])
def test_a_source_without_labels_is_refused(root, tmp_path, source):
    (tmp_path / "labels.zip").write_bytes(b"text")
    message = f"{source} holds no class_labels.*, expected a clone"
    refused(message, import_labels, tmp_path / source, root)


def test_a_missing_data_set_is_refused(clone, tmp_path):
    refused("does not exist", import_labels, clone, tmp_path / "nowhere")


def test_a_transfer_without_labels_is_refused(root):
    refused("has no labels of category chair", transfer_labels, root, root, "chair")


def moved(sequence: SequenceData, world: Sim3, noise: float) -> SequenceData:
    """The same sequence in another world, with noise in the positions of its cameras."""
    rng = default_rng(0)
    frames = []
    for frame in sequence.frames:
        rotation = frame.camera.R @ world.R.T
        centre = world.apply(frame.camera.centre) + noise * rng.normal(size=3)
        frames.append(
            replace(frame, camera=replace(frame.camera, R=rotation, t=-rotation @ centre))
        )
    return replace(sequence, frames=frames, points=world.apply(sequence.points))


def two_layouts(tmp_path, noise=0.0):
    """Write a labelled folder "v1", and "v2" with the same sequences, each in a world of its own.

    Returns the maps from the worlds of v1 to those of v2 by sequence, and the label of "b".
    """
    sequences = {name: sequence_data(name, frames=6) for name in "ab"}
    worlds = {}
    for seed, name in enumerate("ab", 1):
        turn = Rotation.random(random_state=seed).as_matrix()
        worlds[name] = Sim3(0.5 + seed, turn, np.full(3, float(seed)))
    write_co3d(tmp_path / "v1", "chair", sequences.values())
    write_co3d(
        tmp_path / "v2", "chair", [moved(sequences[name], worlds[name], noise) for name in "ab"]
    )
    convert_to_v2(tmp_path / "v2/chair")
    trans = np.eye(4)
    trans[:3, :3] = Rotation.random(random_state=9).as_matrix()
    write_label(tmp_path / "v1", "chair", PoseLabel(np.eye(4), "a", "a"))
    # Labels may be texts of few decimals, and are rotations only up to these.
    write_label(tmp_path / "v1", "chair", PoseLabel(trans.round(4), "b", "a"))
    return worlds, trans


def test_labels_are_transferred_between_worlds(tmp_path, run):
    worlds, trans = two_layouts(tmp_path)
    write_label(tmp_path / "v2", "chair", OTHER_LABEL)
    command = f"data transfer {tmp_path}/v1 {tmp_path}/v2 chair"
    assert "expected --replace" in run(command, 2)
    assert run(f"{command} --replace").count("camera centres differ by 0.00 %") == 2
    labels = read_labels(tmp_path / "v2", "chair")
    assert_array_equal(labels["a"].trans, np.eye(4))
    rotation = labels["b"].trans[:3, :3]
    translation = labels["b"].trans[:3, 3]
    expected = worlds["b"].R @ trans[:3, :3] @ worlds["a"].R.T
    assert rotation_error(rotation, expected) < 0.01  # degrees, of the label's few decimals
    # Both labels map the centre of the reference cloud to the same point of the other object.
    centre = Co3D(tmp_path / "v2").point_cloud("chair", "a")[0].mean(axis=0)
    in_v1 = trans[:3, :3] @ worlds["a"].inverse().apply(centre)
    assert_allclose(rotation @ centre + translation, worlds["b"].apply(in_v1), atol=1e-3)


def test_worlds_that_differ_by_more_than_a_similarity_are_refused(tmp_path):
    two_layouts(tmp_path, noise=0.5)
    old, new = tmp_path / "v1", tmp_path / "v2"
    # The best similarity leaves less than the noise, and more than the limit.
    message = r"centres differ by 0\.[0-4]\d+ of .*, expected at most 0.05"
    refused(message, transfer_labels, old, new, "chair")
    assert read_labels(new, "chair") == {}


def random_label(seed: int, name: str = "a") -> PoseLabel:
    """A label with a random pose of a sequence, relative to a sequence "zero"."""
    trans = np.eye(4)
    # A random state has 32 bits at most.
    trans[:3, :3] = Rotation.random(random_state=seed % 2**31).as_matrix()
    trans[:3, 3] = default_rng(seed).normal(size=3)
    return PoseLabel(trans, name, "zero")


@given(seeds)
def test_the_relative_pose_takes_what_one_camera_sees_to_what_the_other_sees(seed):
    label_a, label_b = random_label(seed), random_label(seed + 1, "b")
    camera_a, camera_b = random_camera(seed), random_camera(seed + 1)
    # Points in the world of the reference sequence.
    canonical = default_rng(seed).normal(size=(6, 3))
    seen_a = camera_a.to_camera(Sim3.from_matrix(label_a.trans).apply(canonical))
    seen_b = camera_b.to_camera(Sim3.from_matrix(label_b.trans).apply(canonical))
    pose = relative_pose(label_a, camera_a, label_b, camera_b)
    assert_allclose(Sim3.from_matrix(pose).apply(seen_a), seen_b, atol=1e-9)


def test_a_label_is_read_back_from_a_file_in_the_published_format(tmp_path):
    label = random_label(0, "b")
    path = write_label(tmp_path, "chair", label)
    assert path == tmp_path / "class_labels/chair/b.json"
    content = {"trans": label.trans.tolist(), "seq": "b", "reference_seq": "zero"}
    assert json.loads(path.read_text()) == content
    read = read_labels(tmp_path, "chair")["b"]
    assert_array_equal(read.trans, label.trans)
    assert (read.seq, read.reference_seq) == ("b", "zero")


@pytest.mark.parametrize(
    "change, message",
    [
        (
            {"trans": np.diag([2.0, 2, 2, 1]).tolist()},
            "a.json: trans is .*, 1 off the nearest rotation",
        ),
        ({"seq": "b"}, "has seq 'b', expected seq as in its name"),
        ({"seq": None}, r"got `null` - at `\$.seq`"),
    ],
)
def test_an_invalid_label_is_refused_with_its_file(tmp_path, change, message):
    path = write_label(tmp_path, "chair", PoseLabel(np.eye(4), "a", "a"))
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    assert str(path) in refused(message, read_labels, tmp_path, "chair")
