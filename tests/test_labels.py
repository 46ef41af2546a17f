import json

import numpy as np
import pytest
from co3d_folders import random_camera, seeds
from hypothesis import given
from scipy.spatial.transform import Rotation

from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose, write_label
from zsp_lite.errors import InputError


def random_label(seed, name="a", reference="zero"):
    trans = np.eye(4)
    trans[:3, :3] = Rotation.random(random_state=seed % 2**31).as_matrix()
    trans[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return PoseLabel(trans, name, reference)


def transform(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


@given(seeds)
def test_the_relative_pose_takes_what_one_camera_sees_to_what_the_other_sees(seed):
    label_a, label_b = random_label(seed), random_label(seed + 1, "b")
    camera_a, camera_b = random_camera(seed), random_camera(seed + 1)
    canonical = np.random.default_rng(seed).normal(size=(6, 3))  # points of the reference sequence's cloud
    seen_a = camera_a.to_camera(transform(label_a.trans, canonical))
    seen_b = camera_b.to_camera(transform(label_b.trans, canonical))
    pose = relative_pose(label_a, camera_a, label_b, camera_b)
    np.testing.assert_allclose(transform(pose, seen_a), seen_b, atol=1e-9)
    np.testing.assert_allclose(pose @ relative_pose(label_b, camera_b, label_a, camera_a), np.eye(4), atol=1e-9)


@pytest.mark.parametrize("folder", ["class_labels", "data/class_labels"])
def test_labels_are_read_back_from_either_folder(tmp_path, folder):
    (tmp_path / folder / "chair").mkdir(parents=True)
    written = {name: random_label(number, name) for number, name in enumerate("ba")}
    for label in written.values():
        assert write_label(tmp_path, "chair", label).parent == tmp_path / folder / "chair"
    read = read_labels(tmp_path, "chair")
    assert list(read) == ["a", "b"]
    for name, label in read.items():
        np.testing.assert_array_equal(label.trans, written[name].trans)
        assert (label.seq, label.reference_seq) == (name, "zero")


def test_a_label_file_has_the_published_format(tmp_path):
    path = write_label(tmp_path, "chair", PoseLabel(np.eye(4), "a", "a"))
    assert path == tmp_path / "class_labels" / "chair" / "a.json"
    assert json.loads(path.read_text()) == {"trans": np.eye(4).tolist(), "seq": "a", "reference_seq": "a"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"trans": np.diag([2.0, 2, 2, 1]).tolist()}, "expected a rigid transform"),
        ({"trans": np.diag([1.0, 1, -1, 1]).tolist()}, "expected a rigid transform"),
        ({"trans": np.diag([1.0, 1, 1, 2]).tolist()}, "expected a rigid transform"),
        ({"trans": [[1.0, 0], [0, 1]]}, r"of length 4 - at `\$.trans"),
        ({"seq": "b"}, "has seq 'b' .* seq as in its name"),
        ({"seq": None}, r"got `null` - at `\$.seq`"),
    ],
)
def test_an_invalid_label_is_refused_with_its_file(tmp_path, change, message):
    path = write_label(tmp_path, "chair", PoseLabel(np.eye(4), "a", "a"))
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=message) as caught:
        read_labels(tmp_path, "chair")
    assert str(path) in str(caught.value)
