"""Dense RootSIFT descriptors on the patch grid, in place of the features of a network."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from zsp_lite.backbones.backbone import Image, prepare_images
from zsp_lite.features import FeatureMap

KEYPOINT_SIZE = 24.0  # pixels
_CELLS, _BINS = 4, 8  # cells along each side of a descriptor, orientations per cell
_CELL = 1.5  # side of a cell, in keypoint sizes
# OpenCV's constants: blur of the first octave (the image is assumed to have a blur of 0.5), clipping, scale.
_BLUR = (1.6**2 - 0.5**2) ** 0.5
_CLIP, _SCALE = 0.2, 512.0


class RootSift:
    """Feature extractor (see `features.FeatureExtractor`) with one RootSIFT descriptor per patch.

    The image is resized to 224 pixels. The keys, (28, 28, 128), are upright SIFT descriptors (Lowe 2004) at the patch
    centres as RootSIFT (Arandjelovic and Zisserman 2012): square roots of L1-normalised histograms, whose dot products
    are Hellinger kernels. The saliency is 1 everywhere; use object masks. The global feature is the normalised mean of
    the keys.
    """

    name = "rootsift"
    has_saliency = False
    image_size = 224
    patch_size = 8

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Extract the features of (H, W, 3) images, uint8 or float in [0, 1]."""
        return [self._describe(image, index) for index, image in enumerate(images)]

    def _describe(self, image: Image, index: int) -> FeatureMap:
        rgb = prepare_images([image], self.image_size, index)[0].mul(255).round().to(torch.uint8)
        grey = cv2.cvtColor(np.ascontiguousarray(rgb.permute(1, 2, 0).numpy()), cv2.COLOR_RGB2GRAY)
        side = self.image_size // self.patch_size
        centres = (np.arange(side) + 0.5) * self.patch_size - 0.5  # OpenCV's origin is the centre of pixel 0
        histograms = dense_sift(grey, centres, KEYPOINT_SIZE)
        total = histograms.sum(axis=-1, keepdims=True)
        keys = torch.from_numpy(np.sqrt(histograms / np.maximum(total, 1e-12)).astype(np.float32))
        mean = torch.nn.functional.normalize(keys.mean((0, 1)), dim=0)
        return FeatureMap(keys, torch.ones(side, side), mean)


def dense_sift(
    grey: UInt8[np.ndarray, "n n"], centres: Float[np.ndarray, " side"], size: float
) -> Float[np.ndarray, "side side 128"]:
    """Compute the descriptors of upright keypoints on a grid: integers from 0 to 255, OpenCV's up to rounding.

    The weights of the histograms are separable in rows and columns: two small matrix products compute all of them.
    """
    n, side = len(grey), len(centres)
    blurred = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _BLUR)
    right, up = np.zeros_like(blurred), np.zeros_like(blurred)  # gradients are 0 at the border
    right[1:-1, 1:-1] = blurred[1:-1, 2:] - blurred[1:-1, :-2]
    up[1:-1, 1:-1] = blurred[:-2, 1:-1] - blurred[2:, 1:-1]
    length, angle = cv2.cartToPolar(right, up, angleInDegrees=True)
    # Each gradient contributes to the two nearest orientations, with linear weights.
    position = (angle * (_BINS / 360)).ravel()
    lower = np.floor(position).astype(np.int64)
    upper_part = (position - lower) * length.ravel()
    oriented = np.zeros((_BINS, n * n), np.float32)
    pixel = np.arange(n * n)
    oriented[lower % _BINS, pixel] = length.ravel() - upper_part
    oriented[(lower + 1) % _BINS, pixel] += upper_part
    weights = _weights(n, centres, _CELL * size)
    cells = (weights @ oriented.reshape(_BINS, n, n) @ weights.T).reshape(_BINS, side, _CELLS, side, _CELLS)
    histograms = cells.transpose(1, 3, 2, 4, 0).reshape(side, side, -1)
    histograms = np.minimum(histograms, _CLIP * np.linalg.norm(histograms, axis=-1, keepdims=True))
    norm = np.linalg.norm(histograms, axis=-1, keepdims=True)
    return np.round(histograms * (_SCALE / np.maximum(norm, np.finfo(np.float32).eps))).clip(0, 255)


def _weights(n: int, centres: Float[np.ndarray, " side"], cell: float) -> Float[np.ndarray, "rows n"]:
    """Compute the weight of each of n pixels along one axis in each cell of each keypoint (keypoints x cells, n)."""
    offset = np.arange(n) - np.round(centres)[:, None]
    in_cells = offset / cell
    window = np.exp(-(in_cells**2) / (_CELLS**2 / 2)) * (np.abs(offset) <= round(cell * 2**0.5 * (_CELLS + 1) / 2))
    distance = np.abs(in_cells[:, None] + _CELLS / 2 - 0.5 - np.arange(_CELLS)[:, None])
    return (window[:, None] * np.maximum(1 - distance, 0)).reshape(-1, n).astype(np.float32)
