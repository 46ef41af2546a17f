"""ResNet-50 (He et al. 2016) with torchvision's parameter names, the network of SwAV and PoseContrast.

Written here because no CPU build of torchvision matches the pinned torch.
"""

import os
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder


class ResNet50(nn.Module):
    """Residual network without its last linear layer; returns the outputs of its four layers, the finest first."""

    def __init__(self):
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False), nn.BatchNorm2d(64)
        self.layer1 = _layer(64, 256, blocks=3, stride=1)
        self.layer2 = _layer(256, 512, blocks=4)
        self.layer3 = _layer(512, 1024, blocks=6)
        self.layer4 = _layer(1024, 2048, blocks=3)
        self.eval().requires_grad_(False)

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> list[Float[Tensor, "b _ _ _"]]:
        x = nn.functional.max_pool2d(torch.relu(self.bn1(self.conv1(images))), 3, stride=2, padding=1)
        outputs = []
        for layer in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = layer(x)
            outputs.append(x)
        return outputs


class _Block(nn.Module):
    """Three convolutions and a shortcut; the second convolution has the stride."""

    def __init__(self, inputs: int, outputs: int, stride: int):
        super().__init__()
        width = outputs // 4
        self.conv1, self.bn1 = nn.Conv2d(inputs, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
        self.downsample = nn.Sequential()
        if inputs != outputs:
            self.downsample.extend([nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)])

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.bn1(self.conv1(x)))
        y = torch.relu(self.bn2(self.conv2(y)))
        return torch.relu(self.bn3(self.conv3(y)) + self.downsample(x))


def _layer(inputs: int, outputs: int, blocks: int, stride: int = 2) -> nn.Sequential:
    return nn.Sequential(_Block(inputs, outputs, stride), *(_Block(outputs, outputs, 1) for _ in range(blocks - 1)))


def checkpoint_path(url: str, variable: str, name: str) -> Path:
    """Return the path of a checkpoint that is not part of this library: $VARIABLE, else `name` in the cache folder."""
    path = Path(os.environ.get(variable) or cache_folder() / name)
    if not path.is_file():
        raise InputError(f"checkpoint {path} is no file; download it from {url}, and set {variable} to its path")
    return path
