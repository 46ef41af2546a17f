"""ResNet-50 (He et al. 2016) with torchvision's parameter names.

Written here because no CPU build of torchvision matches the pinned torch.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

CHANNELS = (256, 512, 1024, 2048)  # at the output of each layer
_BLOCKS = (3, 4, 6, 3)


class ResNet50(nn.Module):
    """Residual network without classifier.

    Args:
        outputs: Outputs of a final linear layer that checkpoints of PoseContrast have and `forward` does not use; 0 for
            none.
    """

    def __init__(self, outputs: int = 0):
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        inputs = 64
        for i, (blocks, channels) in enumerate(zip(_BLOCKS, CHANNELS)):
            first = _Block(inputs, channels, stride=1 if i == 0 else 2)
            others = [_Block(channels, channels, stride=1) for _ in range(blocks - 1)]
            setattr(self, f"layer{i + 1}", nn.Sequential(first, *others))
            inputs = channels
        if outputs:
            self.fc = nn.Linear(inputs, outputs)

    def layers(self, images: Float[Tensor, "b 3 h w"]) -> list[Float[Tensor, "b _ _ _"]]:
        """Compute the outputs of all layers, the finest resolution first."""
        x = nn.functional.max_pool2d(torch.relu(self.bn1(self.conv1(images))), 3, stride=2, padding=1)
        outputs = []
        for layer in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = layer(x)
            outputs.append(x)
        return outputs

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 2048"]:
        """Compute the mean of the last layer's output over the image."""
        return self.layers(images)[-1].mean((2, 3))


class _Block(nn.Module):
    """Three convolutions and a shortcut; the second convolution has the stride."""

    def __init__(self, inputs: int, outputs: int, stride: int):
        super().__init__()
        width = outputs // 4
        self.conv1 = nn.Conv2d(inputs, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.downsample = None
        if inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        shortcut = x if self.downsample is None else self.downsample(x)
        x = torch.relu(self.bn1(self.conv1(x)))
        x = torch.relu(self.bn2(self.conv2(x)))
        return torch.relu(self.bn3(self.conv3(x)) + shortcut)
