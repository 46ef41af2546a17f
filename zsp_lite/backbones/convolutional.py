"""Convolutional networks as backbones: the output of one block is the grid of keys.

Another network needs the members of `ConvolutionalNetwork`, an entry in `load.CONVOLUTIONAL`, and one in
`pretrained.PACKAGED` if its weights are a file of a package.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from zsp_lite.backbones.backbone import Image, choose_device, image_batches
from zsp_lite.backbones.facets import block_index
from zsp_lite.backbones.huggingface import nearest_multiple
from zsp_lite.backbones.precision import Precision, autocast, supported_precision
from zsp_lite.errors import check_integer
from zsp_lite.features import FeatureMap


@runtime_checkable
class ConvolutionalNetwork(Protocol):
    """A `torch.nn.Module` with these members, such as `efficientnet.EfficientNetLite0`.

    Attributes:
        depth: Number of blocks.
        stride: Height and width of images are multiples of this.
        image_size: Default side of images, pixels.
        key_block: Default block of the keys, counted from 0.
    """

    depth: int
    stride: int
    image_size: int
    key_block: int

    def features(
        self, images: Float[Tensor, "batch 3 height width"], block: int
    ) -> Float[Tensor, "batch channels rows columns"]:
        """Compute the output of a block for RGB images with values in [0, 1]."""
        ...


class ConvolutionalBackbone:
    """Convolutional network as feature extractor. It has no saliency: the object mask must give the foreground.

    Args:
        model: The network.
        name: Name used in tables and reports.
        layer: Block that gives the keys (see `block_index`). Default: the network's.
        device: Default: the GPU if there is one, else the CPU.
        precision: See `Backbone`.
        batch_size: Number of images in one forward pass.
        image_size: Side in pixels to which images are resized, rounded to a multiple of the stride. Default: the
            network's.

    Attributes:
        layer: Index of the block, counted from 0.

    Raises:
        InputError: If an argument is out of range or the device is not available.
    """

    has_saliency = False

    def __init__(
        self,
        model: ConvolutionalNetwork,
        name: str,
        layer: int | str | None = None,
        device: str | torch.device | None = None,
        precision: Precision = "float32",
        batch_size: int = 8,
        image_size: int | None = None,
    ):
        check_integer("batch_size", batch_size, 1)
        self.name = name
        self.layer = block_index(model.key_block if layer is None else layer, model.depth, name)
        self.image_size = nearest_multiple(model.image_size if image_size is None else image_size, model.stride)
        # Private, because features do not depend on them: public attributes identify a backbone in benchmark runs.
        self._device, self._batch_size = choose_device(device), batch_size
        self.precision = supported_precision(precision, self._device.type)
        self.model = model.to(self._device).eval().requires_grad_(False)

    @property
    def device(self) -> torch.device:
        """Device of the network and of the features."""
        return self._device

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Compute the features of images.

        Args:
            images: RGB images (H, W, 3) of any sizes, uint8 or float in [0, 1]; resized to a square without keeping
                their aspect ratio.

        Returns:
            One FeatureMap per image, float32, on the backbone's device. The saliency is 1 everywhere, the global
            feature is the mean of the keys.

        Raises:
            InputError: For other image types, shapes or values.
        """
        batches = image_batches(images, self.image_size, self._batch_size, self._device)
        return [features for batch in batches for features in self._extract(batch)]

    def _extract(self, batch: Float[Tensor, "b 3 s s"]) -> list[FeatureMap]:
        with torch.inference_mode(), autocast(self._device.type, self.precision):
            maps = self.model.features(batch, self.layer)
        # Copied outside inference mode, as in `Backbone`.
        all_keys = [one.permute(1, 2, 0).to(torch.float32, copy=True).contiguous() for one in maps]
        return [FeatureMap(keys, keys.new_ones(keys.shape[:2]), keys.mean((0, 1))) for keys in all_keys]
