"""The shipped backbone: what is in the package, its log, and what its attention finds."""

import numpy as np
import pytest
from safetensors import safe_open

from zsp_lite import Co3D, load_backbone
from zsp_lite.backbones.load import TINY
from zsp_lite.course.demo import demo_pairs
from zsp_lite.course.samples import sample_data
from zsp_lite.views import object_crop, patch_mask


def test_the_file_is_small_and_in_half_precision():
    assert TINY.stat().st_size <= 12e6
    with safe_open(TINY, "pt") as file:
        assert {str(file.get_tensor(name).dtype) for name in file.keys()} == {"torch.float16"}


@pytest.fixture(scope="module")
def crops():
    """Two target views of each of the demo's pairs, by category."""
    dataset, found = Co3D(sample_data()), {}
    for pair in demo_pairs(dataset):
        frames = [
            dataset.frame(pair.category, pair.target_sequence, number)
            for number in pair.target_frames[1::2]
        ]
        found.setdefault(pair.category, []).extend(
            object_crop(dataset.load(frame)) for frame in frames
        )
    return found


def iou(backbone, crops) -> float:
    values = []
    for crop, found in zip(crops, backbone([crop.rgb for crop in crops]), strict=True):
        mask, foreground = patch_mask(crop, found.grid), found.foreground()
        values.append(float((mask & foreground).sum() / (mask | foreground).sum()))
    return float(np.mean(values))


@pytest.mark.slow
def test_its_attention_finds_objects_that_it_has_never_seen(crops):
    """The paper's rule, saliency above 0.05, on the sample categories."""
    tiny = load_backbone("zsp-tiny", device="cpu")
    for category in crops:
        assert iou(tiny, crops[category]) > 0.7, category
