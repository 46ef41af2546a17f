"""Residual networks under torchvision's key names (He et al. 2016), small ones too; their features by layer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.errors import InputError


@dataclass(frozen=True)
class Shape:
    """What a residual network looks like; the default is ResNet-50.

    blocks: in each of the four layers.  width: channels of the first, doubled by each.  bottleneck: blocks of three
    convolutions (their output four times as wide) instead of two.  pooled: a max-pooling behind the first convolution,
    without which every layer has twice the resolution.  outputs: of a last linear layer, 0 for none.
    """

    blocks: tuple[int, ...] = (3, 4, 6, 3)
    width: int = 64
    bottleneck: bool = True
    pooled: bool = True
    outputs: int = 0

    @property
    def channels(self) -> tuple[int, ...]:
        """Of each layer's output."""
        expansion = 4 if self.bottleneck else 1
        return tuple(self.width * 2**i * expansion for i in range(len(self.blocks)))


# About 0.3 G multiplications for a picture of 224 pixels; layer3 then has the patches of a ViT with patch size 8.
TINY = Shape((1, 1, 1, 1), 32, bottleneck=False, pooled=False)


class ResNet(nn.Module):
    """Images in, the output of a layer out."""

    def __init__(self, shape: Shape = Shape()):
        super().__init__()
        self.shape = shape
        self.conv1 = nn.Conv2d(3, shape.width, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(shape.width)
        entering = shape.width
        for i, (blocks, leaving) in enumerate(zip(shape.blocks, shape.channels, strict=True)):
            width, stride = shape.width * 2**i, 1 if i == 0 else 2
            layer = [
                _Block(entering if j == 0 else leaving, width, leaving, stride if j == 0 else 1, shape.bottleneck)
                for j in range(blocks)
            ]
            setattr(self, f"layer{i + 1}", nn.Sequential(*layer))
            entering = leaving
        if shape.outputs:
            self.fc = nn.Linear(entering, shape.outputs)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    def layers(self, images: Float[Tensor, "b 3 h w"]) -> list[Float[Tensor, "b _ _ _"]]:
        """The outputs of all layers, finest first."""
        x = torch.relu(self.bn1(self.conv1(images)))
        if self.shape.pooled:
            x = nn.functional.max_pool2d(x, 3, stride=2, padding=1)
        found = []
        for i in range(len(self.shape.blocks)):
            x = getattr(self, f"layer{i + 1}")(x)
            found.append(x)
        return found

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b d"]:
        """The last layer's output, averaged over the picture."""
        return self.layers(images)[-1].mean((2, 3))


class _Block(nn.Module):
    """Two or three convolutions beside a short cut; the stride is in the first one of 3 x 3."""

    def __init__(self, entering: int, width: int, leaving: int, stride: int, bottleneck: bool):
        super().__init__()
        if bottleneck:
            kernels, channels, strides = (1, 3, 1), (entering, width, width, leaving), (1, stride, 1)
        else:
            kernels, channels, strides = (3, 3), (entering, leaving, leaving), (stride, 1)
        self.convolutions = len(kernels)
        for i, kernel in enumerate(kernels):
            convolution = nn.Conv2d(channels[i], channels[i + 1], kernel, strides[i], padding=kernel // 2, bias=False)
            setattr(self, f"conv{i + 1}", convolution)
            setattr(self, f"bn{i + 1}", nn.BatchNorm2d(channels[i + 1]))
        self.downsample = None
        if stride != 1 or entering != leaving:
            self.downsample = nn.Sequential(
                nn.Conv2d(entering, leaving, 1, stride, bias=False), nn.BatchNorm2d(leaving)
            )

    def forward(self, x: Tensor) -> Tensor:
        short = x if self.downsample is None else self.downsample(x)
        for i in range(1, self.convolutions + 1):
            x = getattr(self, f"bn{i}")(getattr(self, f"conv{i}")(x))
            if i < self.convolutions:
                x = torch.relu(x)
        return torch.relu(x + short)


def load_weights(module: nn.Module, weights: Mapping[str, Tensor], name: str, ignored: Sequence[str] = ()) -> None:
    """Load a state dict strictly, but for keys that begin with one of `ignored`, in float32.

    Raises InputError naming the first key that is missing, unknown or of another shape, or holds no finite numbers.
    """
    weights = {key: x for key, x in weights.items() if not key.startswith(tuple(ignored))} if ignored else dict(weights)
    expected = {key: tuple(x.shape) for key, x in module.state_dict().items()}
    found = {key: tuple(x.shape) for key, x in weights.items()}
    # Older checkpoints do not count a batch norm's batches, which nothing needs.
    counters = {key for key in expected.keys() - found.keys() if key.endswith("num_batches_tracked")}
    wrong = sorted(key for key in (expected.keys() | found.keys()) - counters if expected.get(key) != found.get(key))
    if wrong:
        key = wrong[0]
        raise InputError(
            f"{name}: {len(wrong)} weights do not fit, first {key}: expected {expected.get(key, 'none')}, "
            f"got {found.get(key, 'none')}"
        )
    for key, x in weights.items():
        if not bool(x.isfinite().all()):
            raise InputError(f"{name}: {key} holds values that are not finite")
    module.load_state_dict({key: x.to(torch.float32) for key, x in weights.items()}, strict=False)
