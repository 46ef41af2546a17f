"""SwAV: a ResNet-50 trained by self-supervision (Caron et al. 2020), as a feature extractor (paper sec. 5.2)."""

from collections.abc import Sequence

import torch

from zsp_lite.backbones.backbone import Image, normalize, prepare_images
from zsp_lite.backbones.checkpoints import load_weights, read_checkpoint
from zsp_lite.baselines.resnet import ResNet50, checkpoint_path
from zsp_lite.features import FeatureMap

URL = "https://dl.fbaipublicfiles.com/deepcluster/swav_800ep_pretrain.pth.tar"
_HEADS = ("projection_head.", "prototypes.")  # parts of the checkpoint that are used in training only
_LAYER = 2  # index of the layer of the keys; the paper does not state it


class Swav:
    """Feature extractor (see `features.FeatureExtractor`).

    The keys are the output of the third layer for an image of 448 pixels, (28, 28, 1024); the global feature is the
    mean of the last layer's output, and the saliency is 1 everywhere.
    """

    name = "swav"
    has_saliency = False
    image_size = 448

    def __init__(self, model: ResNet50):
        self.model, self.state_dict = model, model.state_dict  # the weights identify the extractor in the benchmark

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Extract the features of (H, W, 3) images, uint8 or float in [0, 1]."""
        maps = []
        for index, image in enumerate(images):
            layers = self.model(normalize(prepare_images([image], self.image_size, index)))
            keys = layers[_LAYER][0].permute(1, 2, 0)
            maps.append(FeatureMap(keys, torch.ones(keys.shape[:2]), layers[-1].mean((2, 3))[0]))
        return maps


def load_swav() -> Swav:
    """Load the published network from $ZSP_LITE_SWAV, or from the cache folder."""
    path = checkpoint_path(URL, "ZSP_LITE_SWAV", "swav_800ep_pretrain.pth.tar")
    model = ResNet50()
    load_weights(model, read_checkpoint(path)[0], f"swav {path}", _HEADS)
    return Swav(model)
