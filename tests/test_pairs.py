"""Evaluation pairs: sampled ones, those of published files, and a folder's own."""

from itertools import permutations

import numpy as np
import pytest
import torch
from co3d_folders import edit_json, sequence_data, write_category, write_identities
from refusals import refused

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.evaluation import sample_pairs
from zsp_lite.data.labels import PoseLabel
from zsp_lite.data.pairs import category_pairs, read_published_pairs, shipped_pairs
from zsp_lite.data.writing import pairs_path, write_co3d, write_label, write_published_pairs

NAMES = ["s3", "s1", "s2"]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two categories of three labelled sequences and one without a label, of 12 frames each."""
    root = tmp_path_factory.mktemp("data")
    for category in ("chair", "lamp"):
        write_category(root, category, [*NAMES, "unlabelled"], frames=12)
        for name in NAMES:
            write_label(root, category, PoseLabel(np.eye(4), name, "s1"))
    # Frame numbers are not positions: the list is shuffled, and numbers start at 100.
    path = root / "chair/frame_annotations.jgz"

    def shuffle(frames):
        for frame in frames:
            frame["frame_number"] += 100
        return [frames[position] for position in np.random.default_rng(0).permutation(len(frames))]

    edit_json(path, shuffle)
    return Co3D(root)


@pytest.fixture
def item(dataset, tmp_path):
    """A pair as the published files hold it."""
    pair = Pair("chair", "s1", 103, "s2", (101, 110, 107))
    write_published_pairs(tmp_path / "chair.pt", [pair], dataset)
    return torch.load(tmp_path / "chair.pt")[0]


def test_references_go_round_and_every_other_sequence_and_frame_gets_its_turn(dataset):
    pairs = sample_pairs(dataset, "chair", 300, 1, seed=0)
    assert [pair.reference_sequence for pair in pairs] == ["s1", "s2", "s3"] * 100
    assert {(pair.reference_sequence, pair.target_sequence) for pair in pairs} == {
        *permutations(NAMES, 2)
    }
    assert {pair.reference_frame for pair in pairs} == set(range(100, 112))
    assert {pair.target_frames for pair in pairs} == {(number,) for number in range(100, 112)}


@pytest.mark.parametrize("n_targets", [1, 3, 4, 5, 12])
def test_target_frames_are_evenly_spaced_round_the_sequence(dataset, n_targets):
    for pair in sample_pairs(dataset, "chair", 20, n_targets, seed=3):
        assert len(set(pair.target_frames)) == n_targets
        steps = np.diff([*pair.target_frames, pair.target_frames[0] + 12])
        # 12 / n, rounded down or up. A single frame is 12 from itself, once round.
        assert set(steps % 12) <= {12 // n_targets % 12, -(-12 // n_targets) % 12}


def test_sampling_depends_on_seed_and_category_alone(dataset):
    pairs = sample_pairs(dataset, "chair", 20, 5, seed=1)
    assert pairs == sample_pairs(Co3D(dataset.root), "chair", 20, 5, seed=1)
    assert pairs != sample_pairs(dataset, "chair", 20, 5, seed=2)
    other = sample_pairs(dataset, "lamp", 20, 5, seed=1)
    assert [pair.target_sequence for pair in pairs] != [pair.target_sequence for pair in other]


def test_all_pairs_are_different_and_too_large_a_number_gives_all_there_are(tmp_path, caplog):
    lengths = {"a": 2, "b": 3, "c": 5}
    write_co3d(
        tmp_path, "chair", [sequence_data(name, frames=length) for name, length in lengths.items()]
    )
    write_identities(tmp_path, "chair", [*lengths])
    total = 62  # both directions of every two sequences: 2 * (2 * 3 + 2 * 5 + 3 * 5)
    every = sample_pairs(Co3D(tmp_path), "chair", total, 2)
    assert len({pair.key for pair in every}) == total
    assert {pair.reference_sequence for pair in every[-4:]} == {"c"}
    assert all(sample_pairs(Co3D(tmp_path), "chair", n, 2) == every[:n] for n in range(total))
    assert not caplog.text
    assert sample_pairs(Co3D(tmp_path), "chair", 10**9, 2) == every
    assert "category chair has 62 different pairs of 2 targets, not 1000000000" in caplog.text


def test_missing_labels_and_frames_are_refused(dataset, tmp_path):
    refused(
        "labelled sequence chair/.* has 12 frames, expected at least 13",
        sample_pairs,
        dataset,
        "chair",
        1,
        13,
    )
    write_category(tmp_path, "chair", ["s1"])
    refused("has 0 labelled sequences", lambda: sample_pairs(Co3D(tmp_path), "chair", 1, 1))


def test_a_pairs_seed_is_a_function_of_its_key():
    pair = Pair("chair", "a", 1, "b", (2, 3))
    assert (pair.key, pair.seed) == ("chair/a:1/b:2,3", 1587145652271358322)  # on every machine


def test_pairs_are_read_back_from_the_published_format(dataset, tmp_path):
    pairs = sample_pairs(dataset, "chair", 10, 5)
    path = pairs_path(tmp_path, "chair", 10, 5)
    assert path == tmp_path / "determ_eval/10samples_5tgt/chair.pt"
    write_published_pairs(path, pairs, dataset)
    assert read_published_pairs(path, dataset) == pairs
    before = path.read_bytes()
    write_published_pairs(path, pairs, dataset)
    assert path.read_bytes() == before


@pytest.mark.parametrize("form", [list, torch.tensor])
def test_published_ids_are_positions_in_the_frame_list(dataset, tmp_path, item, form):
    targets = item["all_target_id"]
    torch.save([item | {"all_target_id": form(targets)}], tmp_path / "chair.pt")
    (pair,) = read_published_pairs(tmp_path / "chair.pt", dataset)
    frames = dataset.frame_list("chair")
    assert pair.reference_frame == frames[item["reference_frame_id"]].frame_number
    assert pair.target_frames == tuple(frames[position].frame_number for position in targets)


def test_a_folders_own_pairs_are_found(tmp_path, caplog):
    write_category(tmp_path, "chair", "ab")
    dataset = Co3D(tmp_path)
    assert shipped_pairs(dataset, "chair", 2) == []
    # The fifth pair is the first one again.
    pairs = [Pair("chair", "a", number % 4, "b", (0, 2)) for number in range(5)]
    for n in (3, 5):
        write_published_pairs(pairs_path(tmp_path, "chair", n, 2), pairs[:n], dataset)
    assert shipped_pairs(dataset, "chair", 2) == pairs[:3]
    assert shipped_pairs(dataset, "chair", 2, at_least=4) == pairs[:4]
    assert category_pairs(dataset, "chair", 5, 2) == pairs[:4]
    assert "category chair: 4 of 5 stored pairs are different" in caplog.text
    assert shipped_pairs(dataset, "chair", 2, at_least=6) == []
    assert shipped_pairs(dataset, "chair", 1) == []


@pytest.mark.parametrize(
    "changes, message",
    [
        (
            {"reference_frame_id": 48},
            # four sequences of 12 frames
            "frame id 48 is not of s1, expected a position in the list of 48 frames",
        ),
        ({"all_target_id": []}, "all_target_id"),
        ({"target_seq_name": "s3"}, "is not of s3"),
        ({"class": "sofa"}, "category is 'sofa'"),
        ({"reference_frame_id": True}, "Expected `int`, got `bool`"),
    ],
)
def test_ids_of_other_data_are_refused(dataset, tmp_path, item, changes, message):
    torch.save([item | changes], tmp_path / "chair.pt")
    refused(message, read_published_pairs, tmp_path / "chair.pt", dataset)
