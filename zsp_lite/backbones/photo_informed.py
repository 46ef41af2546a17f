"""A vision transformer whose patch tokens receive the features of a network that was trained on photographs.

The photo network is EfficientNet-Lite0 (see `zsp_lite.backbones.efficientnet`), supervised by ImageNet's class labels,
never by poses. It sees the image at twice the resolution of the transformer, so that its map of stride 16 has one
position per patch of 8 pixels. A linear layer maps its features to the width of the tokens, to which they are added
before the first block. Without that addition the transformer is one of its own.
"""

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.backbones.backbone import normalize
from zsp_lite.backbones.efficientnet import EfficientNetLite0
from zsp_lite.backbones.facets import Facet
from zsp_lite.backbones.vit import Tokens, VisionTransformer

BLOCK, CHANNELS = 10, 112  # of EfficientNet-Lite0: the last map of stride 16
TRANSFORMER = "transformer"  # key of the metadata of a photo input: file name of its transformer
DETAIL = 2  # sides of the photo network's images, as a multiple of the transformer's


class PhotoProjection(nn.Module):
    """Linear map of the photo network's features, each position normalised, to tokens; 0 before training."""

    def __init__(self, dim: int):
        super().__init__()
        self.linear = nn.Linear(CHANNELS, dim)
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    def forward(self, features: Float[Tensor, "batch channels rows columns"]) -> Float[Tensor, "batch n dim"]:
        return self.linear(F.layer_norm(features.flatten(2).transpose(1, 2), (CHANNELS,)))


class PhotoInput(nn.Module):
    """What a photo-informed transformer has beside its two parts; the content of its file.

    Attributes:
        projection: Maps the photo network's features to tokens.
        key_mean: Mean key of each block, which is subtracted from the keys.
    """

    def __init__(self, depth: int, dim: int):
        super().__init__()
        self.projection = PhotoProjection(dim)
        self.register_buffer("key_mean", torch.zeros(depth, dim))


class PhotoInformedViT(nn.Module):
    """Vision transformer with the features of EfficientNet-Lite0 added to its patch tokens.

    Args:
        vit: Transformer with patches of 8 pixels, for images with ImageNet's normalisation.

    Attributes:
        image_size, patch_size, embed_dim, depth, num_heads: As those of `VisionTransformer`; image_size and patch_size
            are in pixels of the larger image.
        multiple: Height and width of an image must be multiples of it.
    """

    def __init__(self, vit: VisionTransformer):
        super().__init__()
        self.vit, self.photo_network = vit, EfficientNetLite0()
        self.photo_input = PhotoInput(vit.depth, vit.embed_dim)
        self.image_size, self.patch_size = DETAIL * vit.image_size, DETAIL * vit.patch_size
        self.multiple = math.lcm(self.patch_size, EfficientNetLite0.stride)
        self.embed_dim, self.depth, self.num_heads = vit.embed_dim, vit.depth, vit.num_heads

    def inputs(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> tuple[
        Float[Tensor, "batch 3 h w"], Float[Tensor, "batch n dim"], Float[Tensor, "batch channels rows columns"]
    ]:  # fmt: skip
        """Return the transformer's images, what is added to its patch tokens, and the photo network's features."""
        features = self.photo_network.features(images, BLOCK)
        return normalize(F.avg_pool2d(images, DETAIL)), self.photo_input.projection(features), features

    def extract(self, images: Float[Tensor, "batch 3 height width"], layer: int = 9, facet: Facet = "key") -> Tokens:
        """Compute what `VisionTransformer.extract` does, and the features of the photo network.

        Args:
            images: RGB images with values in [0, 1]; height and width are multiples of `multiple`.
            layer, facet: Block and activation that describe the patches.
        """
        small, added, photo = self.inputs(images)
        tokens = replace(
            self.vit.extract(small, layer, facet, added),
            photo=photo.flatten(2).transpose(1, 2), photo_last=self.photo_network.run_blocks(photo, BLOCK + 1),
        )  # fmt: skip
        return replace(tokens, keys=tokens.keys - self.photo_input.key_mean[layer]) if facet == "key" else tokens
