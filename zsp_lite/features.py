"""Feature maps of a vision transformer, and log-binned descriptors (Amir et al. 2021).

The descriptor of a patch has 17 bins: the keys of the patch and its eight neighbours at stride 1,
and the eight neighbours at stride 3 of the keys averaged over 3x3 patches. `log_bin` follows this
definition literally and needs 17 times the memory of the keys; `matching.similarity` compares such
descriptors without building them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zsp_lite.errors import InputError

Grid = tuple[int, int]  # (rows, columns) of patches
# A patch is foreground if its saliency is above this. The paper gives no value; this is the
# published code's.
SALIENCY_THRESHOLD = 0.05


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Features of one image: copies of what is given, as float32 tensors on the CPU without
    gradients.

    InputError if shapes do not fit together or values are not finite.
    """

    keys: Float[Tensor, "h w d"]  # key of each patch
    saliency: Float[Tensor, "h w"]  # saliency of each patch, in [0, 1]
    global_feature: Float[Tensor, " e"]  # feature of the whole image

    def __post_init__(self):  # any backbone may be plugged in, on any device
        for name, values in list(vars(self).items()):
            values = torch.as_tensor(values).detach().cpu()
            # `clone` outside inference mode: the copy can enter a graph with gradients.
            with torch.inference_mode(False):
                object.__setattr__(self, name, values.to(torch.float32).clone())
        keys = tuple(self.keys.shape)
        saliency = tuple(self.saliency.shape)
        if len(keys) != 3 or 0 in keys or saliency != keys[:2]:
            raise InputError(
                f"FeatureMap: keys and saliency have shapes {keys}, {saliency}, expected (H, "
                "W, D), (H, W)"
            )
        if not all(part.isfinite().all() for part in vars(self).values()):
            raise InputError(
                "FeatureMap: keys, saliency or global feature hold values that are not finite"
            )

    @property
    def grid(self) -> Grid:
        """Rows and columns of patches."""
        return tuple(self.saliency.shape)

    def foreground(self) -> Bool[Tensor, "h w"]:
        """Select the patches whose saliency is above `SALIENCY_THRESHOLD`."""
        return self.saliency > SALIENCY_THRESHOLD


@runtime_checkable
class FeatureExtractor(Protocol):
    """A backbone: maps images to feature maps. Any callable with this signature is accepted.

    An attribute `image_size` (pixels), if there is one, sets the size of the object crops; the
    default is 224. An attribute `has_saliency` that is False says that the saliency is 1
    everywhere, so that object masks are needed.

    A backbone whose keys are the mean colours of 8 x 8 pixels:

        class Colours:
            image_size = 224

            def __call__(self, images):
                maps = []
                for image in images:
                    patches = torch.as_tensor(image / 255).float().unfold(0, 8, 8).unfold(1, 8, 8)
                    keys = patches.mean((-2, -1))
                    maps.append(FeatureMap(keys, torch.ones(keys.shape[:2]), keys.mean((0, 1))))
                return maps

        ZeroShotPose(Colours())
    """

    def __call__(self, images: Sequence[np.ndarray]) -> list[FeatureMap]:
        """Extract the feature maps, all on one grid, of images (H, W, 3), uint8 or float in
        [0, 1]."""
        ...


@lru_cache(maxsize=32)
def bin_indices(grid: Grid) -> Int[Tensor, "17 n"]:
    """Compute, for each bin and patch, the index of the patch that fills it.

    Bins 0 to 8 read the keys (offsets -1, 0, 1 in rows and columns, row-major), bins 9 to 16 the
    pooled keys (offsets -3, 0, 3, row-major, without the centre). Offsets beyond the border are
    clamped to it.
    """
    near = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    far = [(3 * dy, 3 * dx) for dy, dx in near if dy or dx]
    height, width = grid
    with torch.inference_mode(False):  # the result is cached, and later callers may need gradients
        rows = torch.arange(height)[:, None]
        columns = torch.arange(width)
        filled = [
            (rows + dy).clamp(0, height - 1) * width + (columns + dx).clamp(0, width - 1)
            for dy, dx in near + far
        ]
        return torch.stack(filled).flatten(1)


def average_pool(x: Tensor, axes: tuple[int, int]) -> Tensor:
    """Average over 3x3 windows of two axes at stride 1, smaller ones at the border."""
    # torch's `avg_pool2d` pools the last two axes only, and `matching` pools others of large
    # tensors, which it would have to copy. Its last digits differ, too.
    for axis in axes:
        n = x.shape[axis]
        total = x.clone()
        total.narrow(axis, 1, n - 1).add_(x.narrow(axis, 0, n - 1))
        total.narrow(axis, 0, n - 1).add_(x.narrow(axis, 1, n - 1))
        count = x.new_full((n,), 3)
        count[0] -= 1
        count[-1] -= 1
        x = total.div_(count.view(-1, *[1] * (x.ndim - 1 - axis)))
    return x


def log_bin(
    x: Float[Tensor, "b h w d"] | Float[np.ndarray, "b h w d"],
) -> Float[Tensor, "b h w 17*d"]:
    """Compute the descriptors of all patches from keys x: 17 bins, concatenated in the order of
    `bin_indices`."""
    x = torch.as_tensor(x)
    return descriptors(x, bin_indices(tuple(x.shape[1:3]))).unflatten(1, x.shape[1:3])


def descriptors(
    keys: Float[Tensor, "b h w d"], index: Int[Tensor, "17 n"]
) -> Float[Tensor, "b n 17*d"]:
    """Compute the descriptors of some patches; `index` has their columns of `bin_indices`."""
    near = keys.flatten(1, 2)[:, index[:9]]  # (B, 9, n, D)
    far = average_pool(keys, (1, 2)).flatten(1, 2)[:, index[9:]]  # (B, 8, n, D)
    return torch.cat([near, far], dim=1).transpose(1, 2).flatten(2)
