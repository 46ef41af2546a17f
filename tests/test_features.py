"""Log-binned descriptors carry gradients, and a FeatureMap checks its parts; the
view scores against values worked out by hand."""

import pytest
import torch
from refusals import refused

from zsp_lite import FeatureMap
from zsp_lite.best_view import cyclical_iou, global_score, mask_iou, score_from_cosines
from zsp_lite.features import log_bin


def test_log_bin_after_inference_mode_still_carries_gradients():
    with torch.inference_mode():
        log_bin(torch.zeros(1, 4, 11, 2))
    x = torch.randn(1, 4, 11, 2, requires_grad=True)
    log_bin(x).sum().backward()
    # Every bin is read once per patch, so the gradients of a sum count bins.
    assert x.grad.sum().item() == pytest.approx(17 * 4 * 11 * 2)


def test_foreground_is_saliency_above_the_threshold():
    saliency = torch.tensor([[0.0, 0.05, 0.051], [0.3, 1.0, 0.2]])
    features = FeatureMap(torch.zeros(2, 3, 4), saliency, torch.zeros(4))
    assert features.grid == (2, 3)
    assert features.foreground().tolist() == [[False, False, True], [True, True, True]]


@pytest.mark.parametrize("part", [0, 1])
def test_a_feature_map_refuses_what_is_not_finite(part):
    parts = [torch.zeros(2, 3, 4), torch.zeros(2, 3), torch.zeros(4)]
    parts[part][1, 2] = torch.nan
    refused("not finite", FeatureMap, *parts)


@pytest.mark.parametrize(
    "keys, saliency", [((2, 3), (2, 3)), ((2, 3, 4), (3, 2)), ((0, 3, 4), (0, 3))]
)
def test_a_feature_map_refuses_parts_that_do_not_fit(keys, saliency):
    refused("FeatureMap", FeatureMap, torch.zeros(keys), torch.zeros(saliency), torch.zeros(4))


def test_the_correspondence_score_sums_the_distances_of_eq_3():
    # d = sqrt(2 - 2 cos): cosines 1, 0.5 and -1 are at distances 0, 1 and 2.
    assert score_from_cosines(torch.tensor([1.0, 0.5, -1.0]), 3) == pytest.approx(-3)
    # Missing matches count as orthogonal.
    assert score_from_cosines(torch.tensor([1.0]), 3) == pytest.approx(-2 * 2**0.5)
    assert score_from_cosines(torch.tensor([]), 2) == pytest.approx(-2 * 2**0.5)


def feature_map(global_feature) -> FeatureMap:
    return FeatureMap(torch.ones(2, 2, 3), torch.ones(2, 2), torch.tensor(global_feature))


def test_the_global_score_is_the_cosine_whatever_the_lengths():
    assert global_score(feature_map([3.0, 0.0]), feature_map([1.0, 1.0])) == pytest.approx(0.5**0.5)


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
    first = everything & (torch.arange(6) == 0)
    last = everything & (torch.arange(6) == 5)
    assert cyclical_iou(shifted, first, last) == 1
    assert cyclical_iou(shifted, last, first) == 0
