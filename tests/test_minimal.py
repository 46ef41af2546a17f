"""The one-page version of the method against the library, on the sample pairs."""

from pathlib import Path

import numpy as np
import pytest
import torch

import zsp_lite
from zsp_lite import minimal
from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import load_backbone
from zsp_lite.data.pairs import labelled_categories, shipped_pairs
from zsp_lite.errors import InputError
from zsp_lite.features import log_bin

SAMPLES = Path(__file__).parent.parent / "data_samples"


@pytest.fixture(scope="module")
def dataset():
    return zsp_lite.Co3D(SAMPLES)


def as_crop(view) -> minimal.Crop:
    return minimal.Crop(
        view.features.keys.numpy(), view.features.saliency.numpy(), view.frame.depth, view.frame.camera.K
    )


def frame_keys(pair) -> list[tuple[str, str, int]]:
    """List the frames of a pair, the reference first: category, sequence and frame number."""
    targets = [(pair.category, pair.target_sequence, number) for number in pair.target_frames]
    return [(pair.category, pair.reference_sequence, pair.reference_frame), *targets]


def check_pairs(dataset, pairs, image_size: int, **settings) -> None:
    """Check that both versions find the same matches, view, inliers and pose."""
    method = zsp_lite.ZeroShotPose(load_backbone(image_size=image_size), **settings)
    keys = {pair.key: frame_keys(pair) for pair in pairs}
    distinct = list(dict.fromkeys(key for one in keys.values() for key in one))
    views = dict(zip(distinct, method.views([dataset.load(dataset.frame(*key)) for key in distinct])))
    for pair in pairs:
        reference, *targets = (views[key] for key in keys[pair.key])
        expected = method.estimate_from_views(reference, targets)
        found = minimal.estimate_pose(as_crop(reference), [as_crop(target) for target in targets], **settings)
        assert found.view == expected.view, pair.key
        np.testing.assert_array_equal(found.matches[0], expected.matches.reference, pair.key)
        np.testing.assert_array_equal(found.matches[1], expected.matches.target, pair.key)
        np.testing.assert_array_equal(found.inliers, expected.inliers, pair.key)
        pose = Sim3(found.scale, found.R, found.t)
        np.testing.assert_allclose(pose.matrix, expected.sim3.matrix, rtol=1e-6, atol=1e-9, err_msg=pair.key)


def test_it_is_one_page():
    source = Path(minimal.__file__).read_text(encoding="utf-8")
    assert len(source.splitlines()) <= 150
    assert [line for line in source.splitlines() if "zsp_lite" in line] == ["from zsp_lite.errors import InputError"]


def test_it_gives_the_librarys_pose_for_two_pairs_at_full_size(dataset):
    pairs = [shipped_pairs(dataset, category, 1)[0] for category in ("chair", "motorcycle")]
    check_pairs(dataset, pairs, 224)


@pytest.mark.slow
def test_it_gives_the_librarys_pose_for_all_sample_pairs(dataset):
    # A coarse grid, fewer matches and fewer trials: 240 pairs, 315 frames.
    pairs = [
        pair
        for category in labelled_categories(dataset)
        for n in (1, 3, 5)
        for pair in shipped_pairs(dataset, category, n)
    ]
    assert len(pairs) == 240
    check_pairs(dataset, pairs, 64, k=12, trials=30)


def test_its_descriptors_are_the_librarys():
    keys = torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(0))
    expected = torch.nn.functional.normalize(log_bin(keys[None].double())[0].flatten(0, 1), dim=1)
    torch.testing.assert_close(minimal.log_bin(keys), expected)


def test_too_few_matches_are_refused():
    crop = minimal.Crop(np.ones((4, 4, 2)), np.zeros((4, 4)), np.ones((32, 32), np.float32), np.eye(3))
    with pytest.raises(InputError, match="0 matches"):
        minimal.estimate_pose(crop, [crop])
