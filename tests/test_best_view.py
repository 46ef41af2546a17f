"""The four view scores against values worked out by hand."""

import numpy as np
import pytest
import torch

from zsp_lite import FeatureMap, Matches
from zsp_lite.best_view import correspondence_score, cyclical_iou, global_score, mask_iou


def matches(similarities) -> Matches:
    k = len(similarities)
    nowhere = np.zeros((k, 2), int)
    return Matches(nowhere, nowhere, np.asarray(similarities, np.float32), np.zeros(k, np.float32))


def test_the_correspondence_score_sums_the_distances_of_eq_3():
    # d = sqrt(2 - 2 cos): cosines 1, 0.5 and -1 are at distances 0, 1 and 2.
    assert correspondence_score(matches([1.0, 0.5, -1.0]), 3) == pytest.approx(-3)


def test_missing_matches_count_as_orthogonal():
    assert correspondence_score(matches([1.0]), 3) == pytest.approx(-2 * np.sqrt(2))
    assert correspondence_score(matches([]), 2) == pytest.approx(-2 * np.sqrt(2))


def feature_map(global_feature) -> FeatureMap:
    return FeatureMap(torch.ones(2, 2, 3), torch.ones(2, 2), torch.tensor(global_feature))


def test_the_global_score_is_the_cosine_whatever_the_lengths():
    assert global_score(feature_map([3.0, 0.0]), feature_map([1.0, 1.0])) == pytest.approx(
        np.sqrt(0.5)
    )


def test_empty_masks_share_nothing():
    empty = torch.zeros(2, 2, dtype=torch.bool)
    assert mask_iou(empty, empty) == 0


def test_cyclical_iou_is_the_share_of_the_foreground_that_comes_back():
    # Six patches in a row. Patches 0 to 2 are each other's nearest neighbours; everything else goes
    # to reference patch 0, and so comes back to target patch 0: that is 3 to 5 patches off, and
    # with the threshold of 1.5 it does not count.
    similarity = torch.zeros(6, 6)
    similarity[[0, 1, 2], [0, 1, 2]] = torch.tensor([3.0, 2.0, 2.0])
    similarity[0, 3:] = 1.0
    everything = torch.ones(1, 6, dtype=torch.bool)
    assert cyclical_iou(similarity, everything, everything) == pytest.approx(3 / 6)
    first_four = everything.clone()
    first_four[0, 4:] = False
    assert cyclical_iou(similarity, everything, first_four) == pytest.approx(3 / 4)
    # Off the reference's foreground a cycle does not count.
    assert cyclical_iou(
        similarity, everything & (torch.arange(6) > 0), first_four
    ) == pytest.approx(2 / 4)
    # Target patch 5 goes to reference patch 0 and comes back: each foreground holds for its own
    # view.
    shifted = torch.eye(6).roll(1, 0)
    first, last = everything & (torch.arange(6) == 0), everything & (torch.arange(6) == 5)
    assert cyclical_iou(shifted, first, last) == 1
    assert cyclical_iou(shifted, last, first) == 0
