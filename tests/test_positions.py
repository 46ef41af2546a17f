"""The position head: what it attends to, its file beside the backbone's, and its training on made-up positions."""

import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tools.position_head import Example, accuracy, collate, train
from zsp_lite.backbones import pretrained
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.positions import SUFFIX, PositionHead, load_position_head, patch_places
from zsp_lite.backbones.pretrained import EMBEDDED, SUMS, TINY, WEIGHTS
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap

DIM, CHANNELS = 12, 7
HEAD = EMBEDDED["zsp-tiny-photo"].with_name("zsp-tiny-photo" + SUFFIX)
IMAGE = np.random.default_rng(0).integers(0, 255, (60, 60, 3), np.uint8)


def test_places_are_those_of_the_centres_of_patches():
    expected = [(-0.5, -2 / 3), (-0.5, 0), (-0.5, 2 / 3), (0.5, -2 / 3), (0.5, 0), (0.5, 2 / 3)]
    np.testing.assert_allclose(patch_places((2, 3)), expected, atol=1e-6)


def test_coordinates_do_not_depend_on_the_background():
    torch.manual_seed(0)
    head = PositionHead(DIM, CHANNELS).eval()
    keys, photo, image = torch.randn(1, 6, DIM), torch.randn(1, 6, CHANNELS), torch.randn(1, DIM)
    foreground = torch.tensor([[True, True, False, True, False, False]])
    changed = torch.where(foreground[..., None], keys, torch.randn_like(keys))
    places = patch_places((2, 3))[None]
    with torch.no_grad():
        first, second = (head(one, photo, places, image, foreground) for one in (keys, changed))
    torch.testing.assert_close(first[foreground], second[foreground])
    assert (first - second)[~foreground].norm(dim=-1).min() > 1e-3


def test_the_default_backbone_predicts_positions_and_others_do_not():
    assert load_backbone("zsp-tiny-photo", "cpu")([IMAGE])[0].positions.shape == (28, 28, 3)
    assert load_backbone("zsp-tiny", "cpu")([IMAGE])[0].positions is None
    # The head is for the default descriptors.
    for options in ({"layer": 8}, {"facet": "value"}, {"image_size": 224}):
        assert load_backbone("zsp-tiny-photo", "cpu", **options)([IMAGE])[0].positions is None
    found = load_backbone("effnet-lite0+zsp-tiny-photo", "cpu")([IMAGE])[0]
    assert found.positions.shape == (*found.grid, 3)


def test_a_damaged_head_is_refused(monkeypatch, tmp_path):
    for path in [EMBEDDED["zsp-tiny-photo"], TINY, HEAD, WEIGHTS / SUMS]:
        shutil.copy(path, tmp_path)
    monkeypatch.setattr(pretrained, "WEIGHTS", tmp_path)
    for name in ("zsp-tiny-photo", "zsp-tiny"):
        monkeypatch.setitem(EMBEDDED, name, tmp_path / EMBEDDED[name].name)
    load_backbone("zsp-tiny-photo", "cpu")
    save_file(load_file(HEAD) | {"key.bias": torch.zeros(3)}, tmp_path / HEAD.name)
    with pytest.raises(InputError, match=f"^[^\n]*{HEAD.name} is damaged: its SHA-256 is [^\n]*$"):
        load_backbone("zsp-tiny-photo", "cpu")
    with pytest.raises(InputError, match="1 weights do not fit the architecture, first key.bias"):
        load_position_head(tmp_path / HEAD.name, 192, 112)


def test_positions_of_another_grid_are_refused():
    with pytest.raises(InputError, match=r"positions have shape \(2, 2, 3\), expected \(2, 3, 3\)"):
        FeatureMap(torch.zeros(2, 3, 4), torch.zeros(2, 3), torch.zeros(4), torch.zeros(2, 2, 3))


def made_up_examples(n: int, rng: np.random.Generator) -> list[Example]:
    """Pictures whose keys are a fixed linear function of the positions."""
    mixing = np.random.default_rng(1).normal(size=(3, DIM))
    found = []
    for index in range(n):
        positions = rng.normal(size=(40, 3))
        keys, photo = torch.from_numpy(positions @ mixing).half(), torch.zeros(40, CHANNELS).half()
        positions = torch.from_numpy(positions).float()
        places, name = torch.zeros(40, 2), f"folder/{index % 2}"
        found.append(Example(name, str(index), keys, photo, torch.zeros(DIM), places, positions))
    return found


@pytest.mark.slow
def test_a_trained_head_predicts_the_axes_of_new_pictures():
    rng = np.random.default_rng(2)
    new = made_up_examples(6, rng)
    head = train(made_up_examples(60, rng), new, steps=60)
    assert accuracy(head, new).startswith("axes within 45 degrees: 100 %")
    keys, photo, places, image, foreground, positions = collate(new)
    with torch.no_grad():
        found = head.eval()(keys, photo, places, image, foreground)
    assert (found - positions).norm(dim=-1).mean() < 0.5 * positions.norm(dim=-1).mean()
