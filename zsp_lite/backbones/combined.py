"""Several backbones side by side: the keys of a patch are the weighted, normalised keys of each."""

import math
import numbers
import os
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from zsp_lite.backbones.backbone import Image
from zsp_lite.backbones.huggingface import PREFIX
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureExtractor, FeatureMap, Grid
from zsp_lite.views import crop_size, has_saliency

WEIGHTS = 1e-3, 1e3  # smallest and largest weight; outside, float32 would lose one of the parts


class CombinedBackbone:
    """Backbones side by side: their keys are concatenated.

    The keys of each part are interpolated to the grid of the first part, normalised to unit length and multiplied by
    the part's weight; the cosine similarity of two patches is then the mean of the parts' cosines, weighted by the
    squares of the weights. Log-binning follows, as for any keys. Saliency, global feature, positions and photo
    features are those of the first part that has a saliency of its own, or of the first part if none has.

    Args:
        parts: The backbones, all on one device.
        weights: One per part. Default: 1.

    Attributes:
        name: Such as "zsp-tiny+0.5*effnet-lite0".
        image_size: The largest of the parts' sizes in pixels; each part resizes images to its own.
        has_saliency: Whether a part has a saliency of its own.

    The arguments are attributes of the same name.

    Raises:
        InputError: There are fewer than two parts, or the weights are not as many numbers from 0.001 to 1000.
    """

    def __init__(self, parts: Sequence[FeatureExtractor], weights: Sequence[float] | None = None):
        self.parts, self.weights = tuple(parts), (1.0,) * len(parts) if weights is None else tuple(weights)
        if len(self.parts) < 2 or len(self.parts) != len(self.weights):
            raise InputError(
                f"combination: got {len(self.parts)} parts and {len(self.weights)} weights, expected at least 2 of each"
            )
        for weight in self.weights:
            _check_weight(weight, "combination")
        names = [getattr(part, "name", type(part).__name__) for part in self.parts]
        terms = [name if weight == 1 else f"{weight:g}*{name}" for name, weight in zip(names, self.weights)]
        self.name = "+".join(terms)
        self.image_size = max(map(crop_size, self.parts))
        salient = [index for index, part in enumerate(self.parts) if has_saliency(part)]
        self.has_saliency = bool(salient)
        self._salient = salient[0] if salient else 0

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Compute the features of images.

        Args:
            images: RGB images (H, W, 3) of any sizes, uint8 or float in [0, 1].

        Returns:
            One FeatureMap per image.

        Raises:
            InputError: For other image types, shapes or values.
        """
        return [self._combine(maps) for maps in zip(*(part(images) for part in self.parts), strict=True)]

    def _combine(self, maps: tuple[FeatureMap, ...]) -> FeatureMap:
        grid, salient = maps[0].grid, maps[self._salient]
        keys = [w * F.normalize(_resize(one.keys, grid), dim=-1) for w, one in zip(self.weights, maps)]
        saliency = _resize(salient.saliency[..., None], grid)[..., 0]
        positions = None if salient.positions is None else _resize(salient.positions, grid)
        return FeatureMap(torch.cat(keys, dim=-1), saliency, salient.global_feature, positions, salient.photo)


def is_combination(name: str) -> bool:
    """Tell whether a backbone's name is a combination: it has a + or *, and there is no file or folder of that name."""
    return ("+" in name or "*" in name) and not os.path.exists(os.path.expanduser(name.removeprefix(PREFIX)))


def parse_combination(name: str) -> tuple[list[str], list[float]]:
    """Parse names of backbones joined by "+", each with an optional weight, such as "zsp-tiny+0.5*effnet-lite0".

    Returns:
        The names and the weights.

    Raises:
        InputError: A name is empty, there is one only, or a weight is not a number from 0.001 to 1000.
    """
    names, weights = [], []
    for term in name.split("+"):
        weight, star, part = (text.strip() for text in term.rpartition("*"))
        names.append(part)
        try:
            weights.append(float(weight) if star else 1.0)
        except ValueError:
            weights.append(math.nan)
        _check_weight(weights[-1], f"backbone {name!r}: {term.strip()!r}")
    if len(names) < 2 or "" in names:
        raise InputError(f"backbone {name!r}: expected names joined by +, such as zsp-tiny+0.5*effnet-lite0")
    return names, weights


def _check_weight(weight: float, what: str) -> None:
    low, high = WEIGHTS
    if not isinstance(weight, numbers.Real) or not low <= weight <= high:
        raise InputError(f"{what}: weight is {weight!r}, expected a number from {low:g} to {high:g}")


def _resize(values: Float[Tensor, "h w d"], grid: Grid) -> Float[Tensor, "_ _ d"]:
    """Interpolate a map to another grid, bilinearly with anti-aliasing."""
    if tuple(values.shape[:2]) == grid:
        return values
    resized = F.interpolate(values.permute(2, 0, 1)[None], grid, mode="bilinear", align_corners=False, antialias=True)
    return resized[0].permute(1, 2, 0)
