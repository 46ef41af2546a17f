"""Log-binned descriptors carry gradients, and a FeatureMap checks its parts."""

import pytest
import torch
from refusals import refused

from zsp_lite.features import FeatureMap, log_bin


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


@pytest.mark.parametrize("part", ["keys", "saliency"])
def test_a_feature_map_refuses_what_is_not_finite(part):
    parts = {
        "keys": torch.zeros(2, 3, 4),
        "saliency": torch.zeros(2, 3),
        "global_feature": torch.zeros(4),
    }
    parts[part][1, 2] = torch.nan
    refused("not finite", FeatureMap, **parts)


@pytest.mark.parametrize(
    "keys, saliency", [((2, 3), (2, 3)), ((2, 3, 4), (3, 2)), ((0, 3, 4), (0, 3))]
)
def test_a_feature_map_refuses_parts_that_do_not_fit(keys, saliency):
    refused(
        "FeatureMap", lambda: FeatureMap(torch.zeros(keys), torch.zeros(saliency), torch.zeros(4))
    )
