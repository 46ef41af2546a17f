"""Dense RootSIFT on the patch grid: the hand-made descriptor that a learnt one must beat in one pipeline.

The patch centres form a grid and all descriptors are upright, so a histogram's weights are a product of one of rows
and one of columns: two small matrix products make all of them at once, 60 times faster than OpenCV does one by one.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from zsp_lite.backbones.backbone import Image, prepare_images
from zsp_lite.features import FeatureMap

_CELLS, _BINS = 4, 8  # cells along each side of a descriptor, orientations in each cell
_CELL = 1.5  # side of a cell, in keypoint sizes
# OpenCV's: the blur of its first octave, taking that of the camera for granted; where peaks are cut; its unit.
_BLUR = (1.6**2 - 0.5**2) ** 0.5
_PEAK, _UNIT = 0.2, 512.0


class RootSift:
    """Called like a Backbone: images in, one FeatureMap each out, keys (28, 28, 128), saliency all ones.

    One upright SIFT descriptor (Lowe 2004) per patch centre of the image at 224 pixels, then RootSIFT
    (Arandjelovic and Zisserman 2012): the square root of the L1-normalised histogram, whose dot products are
    Hellinger kernels. A keypoint `keypoint_size` pixels wide has 4 x 4 cells of 1.5 times that side, so the
    default of 24 describes a patch by most of the object around it.
    SIFT knows no foreground: callers give masks, or take the whole image. The
    global feature is the mean descriptor, normalised.
    """

    name = "rootsift"
    image_size = 224
    patch_size = 8
    embed_dim = 128
    device = torch.device("cpu")

    def __init__(self, keypoint_size: float = 24.0):
        self.keypoint_size = keypoint_size

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Features of (H, W, 3) images, uint8 or float in [0, 1]. Raises InputError on others."""
        return [self._describe(image, index) for index, image in enumerate(images)]

    def _describe(self, image: Image, index: int) -> FeatureMap:
        rgb = prepare_images([image], self.image_size, index)[0].mul(255).round().to(torch.uint8)
        grey = cv2.cvtColor(np.ascontiguousarray(rgb.permute(1, 2, 0).numpy()), cv2.COLOR_RGB2GRAY)
        side = self.image_size // self.patch_size
        centres = (np.arange(side) + 0.5) * self.patch_size - 0.5  # OpenCV counts from the centre of pixel 0
        histograms = dense_sift(grey, centres, self.keypoint_size)
        total = histograms.sum(axis=-1, keepdims=True)
        keys = torch.from_numpy(np.sqrt(histograms / np.maximum(total, 1e-12)).astype(np.float32))
        mean = torch.nn.functional.normalize(keys.mean((0, 1)), dim=0)
        return FeatureMap(keys, torch.ones(side, side), mean)


def dense_sift(
    grey: UInt8[np.ndarray, "n n"], centres: Float[np.ndarray, " side"], size: float
) -> Float[np.ndarray, "side side 128"]:
    """SIFT descriptors of upright keypoints `size` pixels wide at (row, column) in centres x centres.

    What OpenCV's `SIFT.compute` gives for them, in its whole numbers from 0 to 255, up to rounding.
    """
    n, side = len(grey), len(centres)
    blurred = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _BLUR)
    right, up = np.zeros_like(blurred), np.zeros_like(blurred)  # at the border no gradient is known
    right[1:-1, 1:-1] = blurred[1:-1, 2:] - blurred[1:-1, :-2]
    up[1:-1, 1:-1] = blurred[:-2, 1:-1] - blurred[2:, 1:-1]
    length, angle = cv2.cartToPolar(right, up, angleInDegrees=True)
    # Each gradient is shared out between the two nearest orientations.
    place = (angle * (_BINS / 360)).ravel()
    lower = np.floor(place).astype(np.int64)
    beyond = (place - lower) * length.ravel()
    oriented = np.zeros((_BINS, n * n), np.float32)
    pixel = np.arange(n * n)
    oriented[lower % _BINS, pixel] = length.ravel() - beyond
    oriented[(lower + 1) % _BINS, pixel] += beyond
    weights = _weights(n, centres, _CELL * size)
    cells = (weights @ oriented.reshape(_BINS, n, n) @ weights.T).reshape(_BINS, side, _CELLS, side, _CELLS)
    histograms = cells.transpose(1, 3, 2, 4, 0).reshape(side, side, -1)
    histograms = np.minimum(histograms, _PEAK * np.linalg.norm(histograms, axis=-1, keepdims=True))
    norm = np.linalg.norm(histograms, axis=-1, keepdims=True)
    return np.round(histograms * (_UNIT / np.maximum(norm, np.finfo(np.float32).eps))).clip(0, 255)


def _weights(n: int, centres: Float[np.ndarray, " side"], cell: float) -> Float[np.ndarray, "rows n"]:
    """Along one axis, what each of n pixels counts in each cell of each keypoint: rows are keypoints times cells."""
    offset = np.arange(n) - np.round(centres)[:, None]
    place = offset / cell
    reach = np.exp(-(place**2) / (_CELLS**2 / 2)) * (np.abs(offset) <= round(cell * 2**0.5 * (_CELLS + 1) / 2))
    apart = np.abs(place[:, None] + _CELLS / 2 - 0.5 - np.arange(_CELLS)[:, None])
    return (reach[:, None] * np.maximum(1 - apart, 0)).reshape(-1, n).astype(np.float32)
