"""Dense RootSIFT agrees with OpenCV's SIFT, and is used like a backbone."""

import cv2
import numpy as np
import pytest
import torch

from zsp_lite.baselines import rootsift
from zsp_lite.baselines.rootsift import RootSift, dense_sift
from zsp_lite.matching import match


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (28, 28, 3), dtype=np.uint8)
    return cv2.resize(noise, (224, 224), interpolation=cv2.INTER_CUBIC)


def test_every_patch_is_salient_and_has_a_descriptor_of_unit_length(picture):
    features = RootSift()([picture, np.full((100, 150, 3), 0.5)])
    assert [f.keys.shape for f in features] == [(28, 28, 128)] * 2
    assert bool((features[0].saliency == 1).all()) and features[0].global_feature.shape == (128,)
    torch.testing.assert_close(features[0].keys.square().sum(-1), torch.ones(28, 28))
    assert bool(features[1].keys.isfinite().all())


def test_a_key_describes_the_patch_at_its_grid_position(picture):
    # OpenCV's descriptor of one keypoint at the centre of the patch in row 9, column 17.
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    _, histogram = cv2.SIFT_create().compute(grey, [cv2.KeyPoint(17 * 8 + 3.5, 9 * 8 + 3.5, 24.0, 0.0)])
    root = np.sqrt(histogram[0] / histogram[0].sum())
    np.testing.assert_allclose(RootSift()([picture])[0].keys[9, 17], root, atol=1e-6)


def test_a_shifted_picture_matches_at_the_shift(picture, monkeypatch):
    monkeypatch.setattr(rootsift, "KEYPOINT_SIZE", 4.0)  # small, because the shift is cyclic
    shifted = np.roll(picture, (16, 24), axis=(0, 1))  # two patches down, three to the right
    ref, target = RootSift()([picture, shifted])
    inner = torch.zeros(28, 28, dtype=torch.bool)
    inner[6:20, 6:20] = True
    matches = match(ref, target, k=30, ref_foreground=inner)
    moved = (matches.target - matches.reference == (2, 3)).all(axis=1)
    assert moved.mean() > 0.9


def test_the_descriptors_are_those_of_opencv():
    rng = np.random.default_rng(0)
    grey = cv2.resize(rng.integers(0, 256, (28, 28)).astype(np.uint8), (224, 224), interpolation=cv2.INTER_CUBIC)
    for size, centres in ((24.0, np.arange(3.5, 224, 32)), (7.0, np.array([0.5, 100.3, 223.0]))):
        keypoints = [cv2.KeyPoint(float(x), float(y), size, 0.0) for y in centres for x in centres]
        _, expected = cv2.SIFT_create().compute(grey, keypoints)
        found = dense_sift(grey, centres, size).reshape(expected.shape)
        assert np.abs(found - expected).max() <= 1 and (found != expected).mean() < 1e-3
