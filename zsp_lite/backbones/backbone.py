"""A vision transformer with its preprocessing: a list of images in, a list of FeatureMaps out."""

import re
from collections.abc import Sequence
from contextlib import nullcontext

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from zsp_lite.backbones.vit import nearest_multiple
from zsp_lite.choices import FACETS, Facet
from zsp_lite.errors import InputError, check_choice
from zsp_lite.features import FeatureMap

Image = (
    Float[np.ndarray, "_ _ 3"]
    | UInt8[np.ndarray, "_ _ 3"]
    | Float[Tensor, "_ _ 3"]
    | UInt8[Tensor, "_ _ 3"]
)

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# The block whose keys the published code uses, counted from 0.
_DINO_BLOCK = 9


class Backbone:
    """Vision transformer as feature extractor of the method (section 4.1). The arguments are
    attributes, too.

    Args:
        model: Network: a `vit.VisionTransformer`, or one with its attributes and its `extract`.
        name: Name used in tables and reports.
        layer: Block that describes the patches (see `load_backbone`). Default: block 9 counted from
            0, or the last of a shallower network.
        saliency_heads: Heads of the last block whose CLS attention is averaged into the saliency.
            Default: heads 0, 2, 4 and 5 for the size of DINO's ViT-S (Amir et al. 2021), all heads
            for other sizes.
        batch_size: Number of images in one forward pass.
        device, facet, image_size: See `load_backbone`. The default size is the model's.
        mean, std: Normalisation of RGB values in [0, 1].

    Raises:
        InputError: If an argument is out of range or the device is not available.
    """

    def __init__(
        self,
        model: nn.Module,
        name: str,
        layer: int | str | None = None,
        saliency_heads: Sequence[int] | None = None,
        device: str | torch.device | None = None,
        batch_size: int = 8,
        facet: Facet = "key",
        image_size: int | None = None,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
    ):
        heads = range(model.num_heads)
        if saliency_heads is None:
            # The width, the heads and the depth of DINO's ViT-S.
            dino_small = (model.embed_dim, model.num_heads, model.depth) == (384, 6, 12)
            saliency_heads = (0, 2, 4, 5) if dino_small else heads
        if layer is None:
            layer = min(_DINO_BLOCK, model.depth - 1)
        if image_size is None:
            image_size = model.image_size
        if not saliency_heads or not set(saliency_heads) <= set(heads):
            raise InputError(
                f"{name}: saliency_heads are {tuple(saliency_heads)}, expected some of 0 to "
                f"{heads[-1]}"
            )
        check_choice(f"{name}: facet", facet, FACETS)
        self.name = name
        self.facet = facet
        self.saliency_heads = tuple(saliency_heads)
        self.layer = block_index(layer, model.depth, name)
        self.mean = tuple(mean)
        self.std = tuple(std)
        self.batch_size = batch_size
        self.patch_size = model.patch_size
        self.embed_dim = model.embed_dim
        self.image_size = nearest_multiple(image_size, model.patch_size)
        self.device = choose_device(device)
        self.model = model.to(self.device).eval().requires_grad_(False)

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Compute the features of images.

        Images are resized to a square without keeping their aspect ratio, as in the paper.

        Args:
            images: RGB images (H, W, 3) of any sizes, uint8 or float in [0, 1].

        Returns:
            One FeatureMap per image, float32, on the CPU. The saliency is the CLS attention
            averaged over the saliency heads, min-max normalised to [0, 1].

        Raises:
            InputError: For other image types, shapes or values.
        """
        features = []
        for first in range(0, len(images), self.batch_size):
            batch = prepare_images(images[first : first + self.batch_size], self.image_size, first)
            features += self._extract(batch.to(self.device))
        return features

    def _extract(self, batch: Float[Tensor, "b 3 s s"]) -> list[FeatureMap]:
        """Compute the features of a batch of prepared images."""
        # By default, a GPU computes convolutions in TensorFloat-32: ask for float32. The other
        # flags are given with their values, because they would be reset.
        precision = nullcontext()
        if self.device.type == "cuda":
            cudnn = torch.backends.cudnn
            precision = cudnn.flags(
                cudnn.enabled, cudnn.benchmark, deterministic=cudnn.deterministic, allow_tf32=False
            )
        with torch.inference_mode(), precision:
            tokens = self.model.extract(
                normalize(batch, self.mean, self.std), self.layer, self.facet
            )
            # (b, heads, n) -> (b, n), from 0 to 1 in each image
            saliency = tokens.attention[:, list(self.saliency_heads)].float().mean(1)
            low = saliency.amin(1, keepdim=True)
            high = saliency.amax(1, keepdim=True)
            saliency = (saliency - low) / (high - low).clamp_min(1e-12)
        # One map per image: (rows, columns, dim), (rows, columns) and (dim,).
        keys = tokens.keys.unflatten(1, tokens.grid).cpu()
        saliency = saliency.unflatten(1, tokens.grid).cpu()
        return [FeatureMap(*maps) for maps in zip(keys, saliency, tokens.cls.cpu())]


def block_index(layer: int | str, depth: int, name: str) -> int:
    """Return the index from 0 of a block given as "last", "block9" or an integer.

    Negative integers count from the end.
    """
    text = "-1" if layer == "last" else str(layer).strip()
    # An integer, which may be negative, or "block" and a number, which may not.
    number = re.fullmatch(r"(?:block(?=\d))?(-?\d+)", text)
    if not number or not -depth <= int(number[1]) < depth:
        raise InputError(
            f"{name}: layer is {layer!r}, expected 'last', 'block0' to 'block{depth - 1}', or "
            f"a number from {-depth} to {depth - 1}"
        )
    return int(number[1]) % depth


def prepare_images(
    images: Sequence[Image], size: int = 224, first: int = 0
) -> Float[Tensor, "b 3 s s"]:
    """Stack RGB images (H, W, 3), uint8 or float in [0, 1], to a batch of squares in [0, 1].

    Images are resized bilinearly with anti-aliasing. `first` is the number of the first image in
    error messages.
    """
    prepared = []
    for index, image in enumerate(images, first):
        # An array is copied, because torch does not accept read-only ones and negative strides.
        image = image if torch.is_tensor(image) else torch.from_numpy(np.array(image))
        is_bytes = image.dtype == torch.uint8
        # NaN is not in the range: its comparisons are false.
        is_unit = image.is_floating_point() and bool(((image >= 0) & (image <= 1)).all())
        if image.shape[2:] != (3,) or not image.numel() or not (is_bytes or is_unit):
            raise InputError(
                f"image {index} is {image.dtype} of shape {tuple(image.shape)}, expected uint8 or "
                "floats in [0, 1] of shape (H, W, 3)"
            )
        image = image.to(torch.float32) / (255 if is_bytes else 1)
        image = image.permute(2, 0, 1)[None]  # (1, 3, H, W)
        if image.shape[2:] != (size, size):
            image = F.interpolate(
                image, (size, size), mode="bilinear", align_corners=False, antialias=True
            )
        prepared.append(image)
    return torch.cat(prepared)


def normalize(
    images: Float[Tensor, "b 3 h w"],
    mean: Sequence[float],
    std: Sequence[float],
) -> Float[Tensor, "b 3 h w"]:
    """Subtract the mean and divide by the standard deviation, per channel."""
    mean = images.new_tensor(mean).view(3, 1, 1)
    std = images.new_tensor(std).view(3, 1, 1)
    return (images - mean) / std


def choose_device(device: str | torch.device | None) -> torch.device:
    """Return a device that can be used: by default the GPU if there is one, else the CPU."""
    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        # After the first line, torch has advice for its developers.
        reason = str(error).splitlines()[0][:120]
        raise InputError(f"device {str(device)!r} cannot be used: {reason}") from error
