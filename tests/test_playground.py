"""What `docs.playground.build` writes for the page docs/playground.md; tests/browser/ tests the
page itself."""

import json
import zlib
from base64 import b64decode

import numpy as np
import pytest
import torch

from docs.playground.build import KEY_STEP, pair_data, stored_pairs
from zsp_lite import Co3D, ZeroShotPose, load_backbone
from zsp_lite.course.samples import sample_data
from zsp_lite.matching import key_similarities, similarity


@pytest.mark.slow
def test_a_stored_pair_is_small_accurate_and_has_the_similarities_of_the_originals():
    dataset, method = Co3D(sample_data()), ZeroShotPose(load_backbone("zsp-tiny", "cpu"))
    pairs = stored_pairs(dataset)
    reference, targets = dataset.load_pair(pairs[3])
    views, error = pair_data(dataset, pairs[3], method)
    assert len(pairs) == 8
    assert error < 15  # degrees
    assert len(json.dumps(views)) < 740_000  # characters: what a reader downloads for a pair
    originals = [view.features for view in method.views([reference, targets[0]])]
    packed = [np.frombuffer(zlib.decompress(b64decode(view["keys"])), "<i2") for view in views[:2]]
    keys = [
        torch.from_numpy(KEY_STEP * one.reshape(-1, 28, 28).transpose(1, 2, 0).astype(np.float32))
        for one in packed
    ]
    assert (similarity(*keys) - similarity(*originals)).abs().max() < 5e-4
    (stored,) = key_similarities(keys[0], keys[1:])
    (original,) = key_similarities(originals[0], originals[1:])
    # 2e-3 by the comment at KEY_STEP, and a margin for rounding.
    assert (stored - original).abs().max() < 2.5e-3
