"""SwAV: self-supervised convolutional features (paper sec. 5.2).

The paper uses a ResNet-50 pre-trained by SwAV (Caron et al. 2020). "swav-tiny" is a small network of this project,
trained by the same method on renders of the training categories.
"""

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import torch
from torch import Tensor

from zsp_lite.backbones.backbone import Image, normalize, prepare_images
from zsp_lite.backbones.checkpoints import load_weights, read_checkpoint
from zsp_lite.backbones.pretrained import check_shipped
from zsp_lite.baselines.resnet import TINY, ResNet
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.io.download import cache_folder, fetch, pinned

URL = "https://dl.fbaipublicfiles.com/deepcluster/swav_800ep_pretrain.pth.tar"
TINY_WEIGHTS = Path(__file__).parents[1] / "weights" / "swav-tiny.safetensors"
_MOST_BYTES = 200_000_000  # of the file: 28 million float32 weights, and the state of the training
_HEADS = ("projection_head.", "prototypes.")  # parts of the checkpoint that are used in training only


class Swav:
    """Feature extractor (see `features.FeatureExtractor`) with the features of a convolutional network.

    The keys are the output of one layer, the global feature is the mean of the last layer's output, and the saliency is
    1 everywhere.
    """

    has_saliency = False

    def __init__(self, model: ResNet, name: str, image_size: int, layer: int = 3):
        """Create the extractor.

        Args:
            model: The network.
            name: Name of the extractor.
            image_size: Side to which images are resized, pixels. Layer 3 of a ResNet-50 has the paper's grid of 28 x 28
                patches at 448 pixels.
            layer: Layer of the keys, from 1. The paper does not state it.
        """
        self.model = model.eval().requires_grad_(False)
        self.name, self.image_size, self.layer = name, image_size, layer
        self.device = torch.device("cpu")

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Extract the features of (H, W, 3) images, uint8 or float in [0, 1]; InputError for others."""
        maps = []
        for index, image in enumerate(images):
            batch = normalize(prepare_images([image], self.image_size, index))
            with torch.inference_mode():
                layers = self.model.layers(batch)
                keys, pooled = layers[self.layer - 1][0].permute(1, 2, 0), layers[-1].mean((2, 3))[0]
            keys = keys.clone()  # an ordinary tensor, outside inference mode
            maps.append(FeatureMap(keys, torch.ones(keys.shape[:2]), pooled.clone()))
        return maps

    def state_dict(self) -> dict[str, Tensor]:
        """Return the weights of the network, which identify the extractor in the benchmark's cache."""
        return self.model.state_dict()


def load_swav(path: str | Path | None = None) -> Swav:
    """Load the ResNet-50 of SwAV.

    Args:
        path: Checkpoint file with torchvision's keys, prefixed by `module.`. By default the released file, downloaded
            at the first use.

    Raises:
        InputError: The file cannot be downloaded or read, has other keys or shapes, or is not the released one that
            was used before.
    """
    released = nullcontext()
    if path is None:
        target = cache_folder() / Path(URL).name
        try:
            path = fetch(URL, target, most=_MOST_BYTES)
        except InputError as error:
            raise InputError(f"swav: {error}; put the file at {target}, or use swav-tiny") from error
        released = pinned(target)
    model = ResNet()
    with released:
        weights, _ = read_checkpoint(path)
        load_weights(model, weights, f"swav {path}", _HEADS)
    return Swav(model, "swav", 448)


def load_swav_tiny(path: str | Path = TINY_WEIGHTS) -> Swav:
    """Load the small network of this project. Raises InputError if the file is missing or invalid."""
    if not Path(path).is_file():
        raise InputError(f"swav-tiny: {Path(path).name} does not exist; `zsp-lite train-baseline swav-tiny` creates it")
    if path == TINY_WEIGHTS:
        check_shipped(path)
    weights, _ = read_checkpoint(path)
    model = ResNet(TINY)
    load_weights(model, weights, f"swav-tiny {path}")
    return Swav(model, "swav-tiny", 224)
