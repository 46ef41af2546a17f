"""Dense RootSIFT on the patch grid: the hand-made descriptor that a learnt one must beat in one pipeline."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from zsp_lite.backbones import Image, prepare_images
from zsp_lite.features import FeatureMap


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
        keypoints = [cv2.KeyPoint(x, y, self.keypoint_size, 0.0) for y in centres for x in centres]
        _, histograms = cv2.SIFT_create().compute(grey, keypoints)
        histograms = np.maximum(histograms, 0.0)
        total = histograms.sum(axis=1, keepdims=True)
        root = np.sqrt(histograms / np.maximum(total, 1e-12)).astype(np.float32)
        keys = torch.from_numpy(root).view(side, side, self.embed_dim)
        mean = torch.nn.functional.normalize(keys.mean((0, 1)), dim=0)
        return FeatureMap(keys, torch.ones(side, side), mean)
