"""What `docs.playground` writes for docs/playground.md and docs/find_on_all.md; tests/browser/
tests the pages themselves."""

import json

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from stored_places import stored_objects, unpacked

from docs.playground.build import KEY_STEP, pair_data, stored_pairs
from docs.playground.found import HIDDEN, PICTURE, RENDERED, STEP, shown_object
from zsp_lite import Co3D, ZeroShotPose, load_backbone
from zsp_lite.alignment import Sim3
from zsp_lite.course.samples import sample_data
from zsp_lite.course.synthetic.export import export_categories
from zsp_lite.matching import key_similarities, similarity
from zsp_lite.scans.category import AlignedObject, CategoryAlignment
from zsp_lite.scans.transfer import FOUND, surface_views, transfer


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
    packed = [unpacked(view["keys"], "<i2") for view in views[:2]]
    keys = [
        torch.from_numpy(KEY_STEP * one.reshape(-1, 28, 28).transpose(1, 2, 0).astype(np.float32))
        for one in packed
    ]
    assert (similarity(*keys) - similarity(*originals)).abs().max() < 5e-4
    (stored,) = key_similarities(keys[0], keys[1:])
    (original,) = key_similarities(originals[0], originals[1:])
    # 2e-3 by the comment at KEY_STEP, and a margin for rounding.
    assert (stored - original).abs().max() < 2.5e-3


@pytest.mark.slow
def test_the_stored_places_of_chairs_are_those_that_the_library_finds(tmp_path):
    """Others are of an earlier renderer, network or `transfer`: docs/rebuild.md writes new ones."""
    stored = {one["name"]: one for one in stored_objects("chair")[:2]}
    export_categories(["chair"], tmp_path, 2, **RENDERED)
    dataset, backbone = Co3D(tmp_path), load_backbone("zsp-tiny", "cpu")
    sim3s = {name: Sim3.from_matrix(np.array(one["pose"])) for name, one in stored.items()}
    poses = {name: AlignedObject(sim3, np.zeros(3), 1.0, None, 0.0) for name, sim3 in sim3s.items()}
    alignment = CategoryAlignment(poses, ())
    views = [surface_views(alignment, dataset, "chair", name, backbone) for name in stored]
    directions = [view.direction for view in views[0][::2]]
    source, target = [
        shown_object(dataset, "chair", name, several, directions)
        for name, several in zip(stored, views)
    ]
    old, other = stored.values()
    found = transfer(source.surface[: old["starts"][-1]], *views)
    confidence = old["confidences"][1] / 256
    assert_allclose(confidence, found.confidence, atol=0.005)
    # Places that are found are where a picture shows them, if they are not hidden there.
    pixels = other["pixels"][old["places"][1], 0]
    visible = (confidence >= FOUND) & (pixels[:, 0] != HIDDEN)
    steps = target.pictures[0].camera.project(found.world[visible])[0] / PICTURE / STEP
    error = abs(pixels[visible] - steps).max(axis=1)
    # Another processor may round a few values to another point.
    assert (error < 0.51).mean() > 0.99
