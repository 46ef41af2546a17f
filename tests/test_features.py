"""Log-binned descriptors against loops that follow their definition, and the FeatureMap's own checks."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap, log_bin


def log_bin_by_loops(x: np.ndarray) -> np.ndarray:
    """(H, W, D) -> (H, W, 17 D), one patch and one bin at a time."""
    height, width, _ = x.shape
    pooled = np.empty_like(x)
    for row in range(height):
        for column in range(width):
            pooled[row, column] = x[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].mean((0, 1))
    result = []
    for row in range(height):
        for column in range(width):
            bins = []
            for source, step in ((x, 1), (pooled, 3)):
                for dy in (-step, 0, step):
                    for dx in (-step, 0, step):
                        if step == 3 and dy == dx == 0:
                            continue
                        there = min(max(row + dy, 0), height - 1), min(max(column + dx, 0), width - 1)
                        bins.append(source[there])
            result.append(np.concatenate(bins))
    return np.stack(result).reshape(height, width, -1)


@settings(max_examples=30)
@given(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_log_bin_is_its_definition_on_any_grid(height, width, channels, seed):
    x = np.random.default_rng(seed).normal(size=(2, height, width, channels))
    binned = log_bin(x)
    assert binned.shape == (2, height, width, 17 * channels)
    for one, expected in zip(binned.numpy(), x):
        np.testing.assert_allclose(one, log_bin_by_loops(expected), atol=1e-12)


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
    assert features.foreground(0.25).tolist() == [[False, False, False], [True, True, False]]


@pytest.mark.parametrize("part", ["keys", "saliency"])
def test_a_feature_map_refuses_what_is_not_finite(part):
    parts = {"keys": torch.zeros(2, 3, 4), "saliency": torch.zeros(2, 3), "global_feature": torch.zeros(4)}
    parts[part][1, 2] = torch.nan
    with pytest.raises(InputError, match="not finite"):
        FeatureMap(**parts)


@pytest.mark.parametrize("keys, saliency", [((2, 3), (2, 3)), ((2, 3, 4), (3, 2)), ((0, 3, 4), (0, 3))])
def test_a_feature_map_refuses_parts_that_do_not_fit(keys, saliency):
    with pytest.raises(InputError, match="FeatureMap"):
        FeatureMap(torch.zeros(keys), torch.zeros(saliency), torch.zeros(4))
