"""What `docs.playground` writes for docs/playground.md and docs/find_on_all.md; tests/browser/
tests the pages themselves."""

import json

import numpy as np
import pytest
import torch
from stored_places import stored_objects, unpacked, unpacked_object

from docs.playground.build import KEY_STEP, pair_data, stored_pairs
from docs.playground.found import RENDERED, category_data
from zsp_lite import Co3D, ZeroShotPose, load_backbone
from zsp_lite.alignment import Sim3
from zsp_lite.course.samples import sample_data
from zsp_lite.course.synthetic.export import export_categories
from zsp_lite.matching import key_similarities, similarity
from zsp_lite.scans.category import AlignedObject, CategoryAlignment


@pytest.mark.slow
def test_a_stored_pair_is_small_accurate_and_has_the_similarities_of_the_originals():
    dataset, method = Co3D(sample_data()), ZeroShotPose(load_backbone("zsp-tiny", "cpu"))
    pairs = stored_pairs(dataset)
    assert len(pairs) == 8
    pair = pairs[3]  # one of them, for speed
    reference, targets = dataset.load_pair(pair)
    views, error = pair_data(dataset, pair, method)
    assert error < 15  # degrees
    assert len(json.dumps(views)) < 740_000  # characters: what a reader downloads for a pair
    originals = [view.features for view in method.views([reference, targets[0]])]
    packed = [unpacked(view["keys"], "<i2") for view in views[:2]]
    keys = [
        torch.from_numpy(KEY_STEP * one.reshape(-1, 28, 28).transpose(1, 2, 0).astype(np.float32))
        for one in packed
    ]
    # 5e-4 by the comment at KEY_STEP.
    assert (similarity(*keys) - similarity(*originals)).abs().max() < 5e-4
    (stored,) = key_similarities(keys[0], keys[1:])
    (original,) = key_similarities(originals[0], originals[1:])
    # 2e-3 by the same comment, and a margin for rounding.
    assert (stored - original).abs().max() < 2.5e-3


@pytest.mark.slow
def test_the_stored_places_of_chairs_are_those_that_the_library_finds(tmp_path):
    """Places that differ are of another renderer or network: docs/rebuild.md writes new ones."""
    stored = stored_objects("chair")[:2]  # two of them, for speed
    export_categories(["chair"], tmp_path, 2, **RENDERED)
    poses = {
        one["name"]: AlignedObject(
            Sim3.from_matrix(np.array(one["pose"])), np.zeros(3), 1.0, None, 0.0
        )
        for one in stored
    }
    alignment = CategoryAlignment(poses, ())
    found = category_data(Co3D(tmp_path), "chair", alignment, load_backbone("zsp-tiny", "cpu"))
    for old, new in zip(stored, map(unpacked_object, found)):
        for name in ("pixels", "places", "confidences"):
            difference = abs(old[name][: len(new[name])] - new[name].astype(int))
            # Another processor may round a few values to another one.
            assert (difference <= 1).mean() > 0.97
