"""SwAV: self-supervised convolutional features, matched as mutual nearest neighbours (paper sec. 5.2).

The paper took ResNet-50 pre-trained by SwAV (Caron et al. 2020). "swav-tiny" is a small network that this project
trained in the same way on renders of its training categories.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from zsp_lite.backbones.backbone import IMAGENET_MEAN, IMAGENET_STD, Image, prepare_images
from zsp_lite.backbones.checkpoints import read_checkpoint
from zsp_lite.baselines.resnet import TINY, ResNet, Shape, load_weights
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.io.download import cache_folder, fetch

URL = "https://dl.fbaipublicfiles.com/deepcluster/swav_800ep_pretrain.pth.tar"
TINY_WEIGHTS = Path(__file__).parents[1] / "weights" / "swav-tiny.safetensors"
# What SwAV trains on top of the network: no part of its features.
_HEADS = ("projection_head.", "prototypes.")


class Swav:
    """Called like a Backbone: images in, one FeatureMap each out; SwAV knows no foreground, saliency is all ones.

    layer: whose output describes the patches (the paper does not say which). Of ResNet-50 it is layer3, with the
    picture at 448 pixels, so that its grid of 28 x 28 is that of the paper's ViT. The global feature is the last
    layer's average.
    """

    def __init__(self, model: ResNet, name: str, image_size: int, layer: int = 3):
        self.model = model.eval().requires_grad_(False)
        self.name, self.image_size, self.layer = name, image_size, layer
        self.device = torch.device("cpu")

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Features of (H, W, 3) images, uint8 or float in [0, 1]. Raises InputError on others."""
        found = []
        for index, image in enumerate(images):
            batch = normalised(prepare_images([image], self.image_size, index))
            with torch.inference_mode():
                layers = self.model.layers(batch)
                keys, pooled = layers[self.layer - 1][0].permute(1, 2, 0), layers[-1].mean((2, 3))[0]
            keys = keys.clone()  # an ordinary tensor, outside inference mode
            found.append(FeatureMap(keys, torch.ones(keys.shape[:2]), pooled.clone()))
        return found

    def state_dict(self) -> dict[str, Tensor]:
        """The network's weights, which tell one Swav from another."""
        return self.model.state_dict()


def load_swav(path: str | Path | None = None) -> Swav:
    """SwAV's ResNet-50: a checkpoint file, or the released one, downloaded on first use.

    The layout is torchvision's under a `module.` prefix. Raises InputError where it cannot be had or has another.
    """
    if path is None:
        target = cache_folder() / Path(URL).name
        try:
            path = fetch(URL, target)
        except InputError as error:
            raise InputError(f"swav: {error}; put the file at {target}, or use swav-tiny") from error
    weights, _ = read_checkpoint(path)
    model = ResNet()
    load_weights(model, weights, f"swav {path}", _HEADS)
    return Swav(model, "swav", 448)


def load_swav_tiny(path: str | Path = TINY_WEIGHTS) -> Swav:
    """This project's small counterpart. Raises InputError where its weights are not there."""
    model = load_tiny(path, "swav-tiny", TINY)
    return Swav(model, "swav-tiny", 224)


def load_tiny(path: str | Path, name: str, shape: Shape) -> ResNet:
    """A small network from a file of ours."""
    if not Path(path).is_file():
        raise InputError(f"{name}: {Path(path).name} is not there; `zsp-lite train-baseline {name}` makes it")
    weights, _ = read_checkpoint(path)
    model = ResNet(shape)
    load_weights(model, weights, f"{name} {path}")
    return model


def normalised(images: Tensor) -> Tensor:
    """Images in [0, 1] less ImageNet's mean, in units of its standard deviation."""
    mean, std = (images.new_tensor(x).view(3, 1, 1) for x in (IMAGENET_MEAN, IMAGENET_STD))
    return (images - mean) / std
