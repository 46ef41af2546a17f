"""Labelling by keypoints: labels agree with known ones, sessions survive a restart, bad picks are
refused."""

import numpy as np
import pytest
from co3d_folders import write_category, write_identities
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation

from zsp_lite.course.labelling import Labelling
from zsp_lite.course.labelling.session import MAX_RESIDUAL
from zsp_lite.data.labels import PoseLabel, read_labels
from zsp_lite.data.writing import label_bytes, write_label
from zsp_lite.io.files import write_atomic


@pytest.fixture
def root(tmp_path):
    """A data folder of three sequences, with the best cloud first."""
    write_category(tmp_path, "chair", ["best"], quality=3.0)
    write_category(tmp_path, "chair", "ab")
    return tmp_path


def pick_all(labelling: Labelling, sequence: str, points: np.ndarray) -> None:
    """Pick points one after the other."""
    for point in points:
        labelling.pick(sequence, point)


def corners(sequence: str = "best") -> np.ndarray:
    """Keypoints, (5, 3), at a place that depends on the sequence."""
    return np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0.5)]) + len(sequence)


def test_accepting_writes_the_similarity_of_the_picks_and_the_references_identity(root):
    labelling = Labelling(root, "chair")
    pick_all(labelling, "best", corners())
    turn = Rotation.random(random_state=5).as_matrix()
    pick_all(labelling, "a", 1.3 * corners() @ turn.T + 2)
    labelling.accept("a")
    labels = read_labels(root, "chair")
    assert_allclose(labels["a"].trans[:3, :3], turn, atol=1e-9)
    # The label maps the centre of the reference to its place on the object.
    centre = labelling.cloud("best")[0].mean(axis=0)
    assert_allclose(labels["a"].trans @ [*centre, 1], [*(1.3 * turn @ centre + 2), 1])
    assert_array_equal(labels["best"].trans, np.eye(4))


def test_picks_are_undone_moved_and_cleared(root):
    labelling = Labelling(root, "chair")
    pick_all(labelling, "best", corners())
    pick_all(labelling, "a", corners())
    refused("all 5 keypoints are picked", labelling.pick, "a", (0, 0, 0))
    labelling.undo("a")
    assert len(labelling.picks("a")) == 4
    refused(
        "keypoints of the reference best are in use on a; clear those first", labelling.undo, "best"
    )
    labelling.put("a", [])
    labelling.undo("a")
    labelling.undo("best")
    assert len(labelling.names) == 4


def test_invalid_categories_sequences_and_picks_are_refused(root):
    labelling = Labelling(root, "chair")
    pick_all(labelling, "best", corners())
    pick_all(labelling, "a", corners()[:3])
    refused("a has 3 of 5 keypoints, expected all, at least 4", labelling.accept, "a")
    unknown = "sequence is 'none', expected one of best, a, b"
    refused(unknown, labelling.pick, "none", (0, 0, 0))
    refused("picks on a holds nan, expected finite", labelling.pick, "a", (0, np.nan, 0))
    flat = "picks on a is .*, expected real numbers of shape .n, 3."
    refused(flat, labelling.pick, "a", (0, 1))
    refused("category is 'stool', expected one of", Labelling, root, "stool")
    assert read_labels(root, "chair") == {}
    assert_array_equal(Labelling(root, "chair").picks("a"), corners()[:3])


def test_a_label_of_another_reference_or_of_no_sequence_is_refused(root):
    Labelling(root, "chair").pick("best", (0, 0, 0))
    write_identities(root, "chair", "a")
    refused("expected one reference sequence", Labelling, root, "chair")
    (root / "class_labels/chair/a.json").unlink()
    (root / "label_picks/chair.json").unlink()
    write_identities(root, "chair", "c")
    refused("c has no point cloud", Labelling, root, "chair")


def test_broken_picks_are_named(root):
    labelling = Labelling(root, "chair")
    labelling.pick("best", (0, 0, 0))
    labelling.path.write_text(labelling.path.read_text().replace('"keypoint 1"', '"seat", "back"'))
    refused("2 names, but 1 picks on the reference", Labelling, root, "chair")
    labelling.path.write_text("{")
    refused("label_picks.chair.json", Labelling, root, "chair")


def test_a_large_residual_is_accepted_only_if_confirmed(root):
    labelling = Labelling(root, "chair")
    pick_all(labelling, "best", 4 * corners())
    assert labelling.doubt("a") == ""
    pick_all(labelling, "a", 4 * corners("a"))  # they differ from those of "best" by a shift
    assert labelling.doubt("a") == ""
    labelling.put("a", 4 * corners("a")[[1, 0, 2, 3, 4]])  # the first two are confused
    # The longest side of the cloud, without the points beyond the 1st and 99th percentile.
    size = max(np.ptp(np.percentile(labelling.cloud("a")[0], [1, 99], axis=0), axis=0))
    distance = labelling.alignment("a").sim3.apply(labelling.picks("best")) - labelling.picks("a")
    expected = np.linalg.norm(distance, axis=1) / size
    rms = np.sqrt(np.square(expected).mean())
    assert rms > MAX_RESIDUAL == 0.15  # 15 % below
    assert labelling.doubt("a") == (
        f"residual of {100 * rms:.0f} % of the object's size, above 15 %; the worst keypoint is "
        f"{labelling.names[expected.argmax()]} with {100 * expected.max():.0f} %"
    )
    refused(
        "sequence a has a residual .* expected a smaller one, or confirmed=True",
        labelling.accept,
        "a",
    )
    assert "a" not in read_labels(root, "chair")
    labelling.accept("a", confirmed=True)
    assert "a" in read_labels(root, "chair")


def test_the_reference_is_that_of_the_labels(root):
    write_label(root, "chair", PoseLabel(np.eye(4), "b", "b"))
    assert Labelling(root, "chair").reference == "b"


def test_a_proposal_becomes_the_label_where_nothing_is_picked(root):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 70, degrees=True).as_matrix()
    # The reference of proposals may be another one than that of the labels.
    for name, trans in (("a", np.eye(4)), ("best", turn)):
        proposal = label_bytes(PoseLabel(trans, name, "a"))
        write_atomic(root / f"label_proposals/chair/{name}.json", proposal)
    labelling = Labelling(root, "chair")
    assert labelling.reference == "best"
    assert labelling.proposal("b") is None
    assert_allclose(labelling.proposal("a").R, turn[:3, :3].T)
    refused("sequence b has 0 of 0 keypoints", labelling.accept, "b")
    labelling.accept("a")
    assert_allclose(read_labels(root, "chair")["a"].trans[:3, :3], turn[:3, :3].T, atol=1e-12)
    write_atomic(root / "label_proposals/chair/b.json", b"{}")
    refused("proposal .*b.json|label .*b.json", Labelling, root, "chair")
