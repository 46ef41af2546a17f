"""Residual networks (He et al. 2016) with torchvision's parameter names.

Written here because no CPU build of torchvision matches the pinned torch.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True)
class ResNetConfig:
    """Architecture of a residual network; the default is ResNet-50.

    Attributes:
        blocks: Number of blocks in each layer.
        width: Channels of the first layer; each further layer has twice as many.
        bottleneck: Blocks of three convolutions with four times the channels at the output, instead of two.
        pooled: Max-pooling after the first convolution, which halves the resolution of all layers.
        outputs: Outputs of a final linear layer, in the state dict only; 0 for none.
    """

    blocks: tuple[int, ...] = (3, 4, 6, 3)
    width: int = 64
    bottleneck: bool = True
    pooled: bool = True
    outputs: int = 0

    @property
    def channels(self) -> tuple[int, ...]:
        """Number of output channels of each layer."""
        expansion = 4 if self.bottleneck else 1
        return tuple(self.width * 2**i * expansion for i in range(len(self.blocks)))


# About 0.3 G multiplications for an image of 224 pixels. Layer 3 then has the grid of a ViT with patch size 8.
TINY = ResNetConfig((1, 1, 1, 1), 32, bottleneck=False, pooled=False)


class ResNet(nn.Module):
    """Residual network without classifier."""

    def __init__(self, config: ResNetConfig = ResNetConfig()):
        super().__init__()
        self.config = config
        self.conv1 = nn.Conv2d(3, config.width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(config.width)
        inputs = config.width
        for i, (blocks, outputs) in enumerate(zip(config.blocks, config.channels, strict=True)):
            width, stride = config.width * 2**i, 1 if i == 0 else 2
            layer = [
                _Block(inputs if j == 0 else outputs, width, outputs, stride if j == 0 else 1, config.bottleneck)
                for j in range(blocks)
            ]
            setattr(self, f"layer{i + 1}", nn.Sequential(*layer))
            inputs = outputs
        if config.outputs:
            self.fc = nn.Linear(inputs, config.outputs)  # in checkpoints of PoseContrast; `forward` does not use it
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def layers(self, images: Float[Tensor, "b 3 h w"]) -> list[Float[Tensor, "b _ _ _"]]:
        """Compute the outputs of all layers, the finest resolution first."""
        x = torch.relu(self.bn1(self.conv1(images)))
        if self.config.pooled:
            x = nn.functional.max_pool2d(x, 3, stride=2, padding=1)
        outputs = []
        for i in range(len(self.config.blocks)):
            x = getattr(self, f"layer{i + 1}")(x)
            outputs.append(x)
        return outputs

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        """Compute the mean of the last layer's output over the image."""
        return self.layers(images)[-1].mean((2, 3))


class _Block(nn.Module):
    """Residual block of two or three convolutions; the stride is that of the first 3 x 3 convolution."""

    def __init__(self, inputs: int, width: int, outputs: int, stride: int, bottleneck: bool):
        super().__init__()
        if bottleneck:
            kernels, channels, strides = (1, 3, 1), (inputs, width, width, outputs), (1, stride, 1)
        else:
            kernels, channels, strides = (3, 3), (inputs, outputs, outputs), (stride, 1)
        self.convolutions = len(kernels)
        for i, kernel in enumerate(kernels):
            convolution = nn.Conv2d(channels[i], channels[i + 1], kernel, strides[i], padding=kernel // 2, bias=False)
            setattr(self, f"conv{i + 1}", convolution)
            setattr(self, f"bn{i + 1}", nn.BatchNorm2d(channels[i + 1]))
        self.downsample = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        for i in range(1, self.convolutions + 1):
            x = getattr(self, f"bn{i}")(getattr(self, f"conv{i}")(x))
            if i < self.convolutions:
                x = torch.relu(x)
        return torch.relu(x + shortcut)
