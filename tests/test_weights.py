"""The shipped backbone: what is in the package, its log, and what its attention finds."""

from collections import defaultdict

import numpy as np
import pytest
from safetensors import safe_open

from zsp_lite import Co3D, load_backbone
from zsp_lite.backbones.load import TINY
from zsp_lite.best_view import mask_iou
from zsp_lite.course.demo import demo_pairs
from zsp_lite.course.samples import sample_data
from zsp_lite.views import object_crop, patch_mask


def test_the_file_is_small_and_in_half_precision():
    assert TINY.stat().st_size <= 12e6
    with safe_open(TINY, "pt") as file:
        assert {str(file.get_tensor(name).dtype) for name in file.keys()} == {"torch.float16"}


@pytest.mark.slow
def test_its_attention_finds_objects_that_it_has_never_seen():
    """The paper's rule, saliency above 0.05, on two target views of each of the demo's pairs."""
    tiny = load_backbone("zsp-tiny", device="cpu")
    dataset = Co3D(sample_data())
    shares = defaultdict(list)
    for pair in demo_pairs(dataset):
        _, targets = dataset.load_pair(pair)
        crops = [object_crop(frame) for frame in targets[1::2]]
        for crop, features in zip(crops, tiny([crop.rgb for crop in crops]), strict=True):
            mask = patch_mask(crop, features.grid)
            shares[pair.category].append(mask_iou(mask, features.foreground()))
    for category, found in shares.items():
        assert np.mean(found) > 0.7, category
