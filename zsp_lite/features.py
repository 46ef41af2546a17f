"""What a backbone says about one image, and the log-binned descriptors built on it (Amir et al. 2021).

A descriptor has 17 bins: the 3x3 neighbourhood of a patch at stride 1, and around it the eight neighbours at
stride 3 of the keys averaged over 3x3. `log_bin` writes that down literally and needs 17 times the memory of
the keys; `matching.similarity` compares such descriptors without ever making them.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from zsp_lite.errors import InputError

Grid = tuple[int, int]  # (rows, columns) of patches


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Descriptors on the patch grid, saliency in [0, 1] and one global feature. InputError on misfits."""

    keys: Float[Tensor, "h w d"]
    saliency: Float[Tensor, "h w"]
    global_feature: Float[Tensor, " e"]

    def __post_init__(self):
        if self.keys.ndim != 3 or 0 in self.keys.shape:
            raise InputError(f"FeatureMap: keys have shape {tuple(self.keys.shape)}, expected (H, W, D)")
        if self.saliency.shape != self.keys.shape[:2]:
            raise InputError(
                f"FeatureMap: saliency has shape {tuple(self.saliency.shape)}, expected the grid {self.grid}"
            )
        if not bool(self.keys.isfinite().all() & self.saliency.isfinite().all()):
            raise InputError("FeatureMap: keys or saliency hold values that are not finite")

    @property
    def grid(self) -> Grid:
        return self.keys.shape[0], self.keys.shape[1]

    def foreground(self, threshold: float = 0.05) -> Bool[Tensor, "h w"]:
        """Patches on the object: saliency above the threshold (the paper takes 0.05)."""
        return self.saliency > threshold


@lru_cache(maxsize=32)
def bin_indices(grid: Grid) -> Int[Tensor, "17 n"]:
    """For each bin and patch (row-major) the flat index of the patch that fills it, clamped at the border.

    Bins 0 to 8 read the raw keys (offsets -1, 0, 1, row-major), bins 9 to 16 the pooled keys (offsets -3, 0,
    3, row-major, without the centre).
    """
    near = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    far = [(3 * dy, 3 * dx) for dy, dx in near if (dy, dx) != (0, 0)]
    height, width = grid
    with torch.inference_mode(False):  # kept for later callers, who may want gradients
        rows, columns = torch.arange(height)[:, None], torch.arange(width)
        filled = [
            (rows + dy).clamp(0, height - 1) * width + (columns + dx).clamp(0, width - 1) for dy, dx in near + far
        ]
        return torch.stack(filled).flatten(1)


def average_pool(x: Tensor, axis: int) -> Tensor:
    """Mean over each index and its neighbours along one axis; at the ends over the two that exist.

    Twice, over rows and over columns, this is 3x3 average pooling at stride 1 with count_include_pad off.
    """
    n = x.shape[axis]
    if n == 1:
        return x
    total = x.clone()
    total.narrow(axis, 1, n - 1).add_(x.narrow(axis, 0, n - 1))
    total.narrow(axis, 0, n - 1).add_(x.narrow(axis, 1, n - 1))
    count = torch.full((n,), 3.0, dtype=x.dtype, device=x.device)
    count[0] = count[-1] = 2.0
    return total.div_(count.view(-1, *[1] * (x.ndim - 1 - axis)))


def log_bin(x: Float[Tensor, "b h w d"] | Float[np.ndarray, "b h w d"]) -> Float[Tensor, "b h w 17*d"]:
    """The 17 bins of every patch one after the other, in `bin_indices`' order. InputError on bad shapes."""
    x = torch.as_tensor(x)
    if x.ndim != 4 or 0 in x.shape:
        raise InputError(f"log_bin: x has shape {tuple(x.shape)}, expected (B, H, W, D), none of them 0")
    b, h, w, d = x.shape
    pooled = average_pool(average_pool(x, 1), 2)
    index = bin_indices((h, w)).to(x.device)
    near, far = x.flatten(1, 2)[:, index[:9]], pooled.flatten(1, 2)[:, index[9:]]  # (B, 9 or 8, H*W, D)
    return torch.cat([near, far], dim=1).transpose(1, 2).reshape(b, h, w, 17 * d)
