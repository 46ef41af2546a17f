"""SwAV: a ResNet-50 trained by self-supervision (Caron et al. 2020), as a feature extractor (paper sec. 5.2)."""

import os
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import torch
from torch import Tensor

from zsp_lite.backbones.backbone import Image, normalize, prepare_images
from zsp_lite.backbones.checkpoints import load_weights, read_checkpoint
from zsp_lite.baselines.resnet import ResNet50
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.io.download import cache_folder, fetch, pinned

URL = "https://dl.fbaipublicfiles.com/deepcluster/swav_800ep_pretrain.pth.tar"
VARIABLE = "ZSP_LITE_SWAV"  # environment variable with the path of the checkpoint
_MOST_BYTES = 200_000_000  # of the file: 28 million float32 weights, and the state of the training
_HEADS = ("projection_head.", "prototypes.")  # parts of the checkpoint that are used in training only
_LAYER = 2  # index of the layer of the keys; the paper does not state it


class Swav:
    """Feature extractor (see `features.FeatureExtractor`).

    Images are resized to 448 pixels. The keys are the output of the third layer, (28, 28, 1024); the global feature is
    the mean of the last layer's output, and the saliency is 1 everywhere.
    """

    name = "swav"
    has_saliency = False
    image_size = 448

    def __init__(self, model: ResNet50):
        self.model = model.eval().requires_grad_(False)

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Extract the features of (H, W, 3) images, uint8 or float in [0, 1]; InputError for others."""
        maps = []
        for index, image in enumerate(images):
            batch = normalize(prepare_images([image], self.image_size, index))
            with torch.inference_mode():
                layers = self.model.layers(batch)
                keys, pooled = layers[_LAYER][0].permute(1, 2, 0), layers[-1].mean((2, 3))[0]
            keys = keys.clone()  # an ordinary tensor, outside inference mode
            maps.append(FeatureMap(keys, torch.ones(keys.shape[:2]), pooled.clone()))
        return maps

    def state_dict(self) -> dict[str, Tensor]:
        """Return the weights of the network, which identify the extractor in the benchmark."""
        return self.model.state_dict()


def load_swav(path: str | Path | None = None) -> Swav:
    """Load the ResNet-50 of SwAV.

    Args:
        path: Checkpoint file with torchvision's keys, prefixed by `module.`; by default $ZSP_LITE_SWAV, else the
            released file, downloaded at the first use.

    Raises:
        InputError: The file cannot be downloaded or read, has other keys or shapes, or the released file is not that of
            its first use.
    """
    path, released = path or os.environ.get(VARIABLE), nullcontext()
    if not path:
        path = cache_folder() / Path(URL).name
        try:
            fetch(URL, path, most=_MOST_BYTES)
        except InputError as error:
            raise InputError(f"swav: {error}; download {URL}, and set {VARIABLE} to its path") from error
        released = pinned(path)
    model = ResNet50()
    with released:
        weights, _ = read_checkpoint(path)
        load_weights(model, weights, f"swav {path}", _HEADS)
    return Swav(model)
