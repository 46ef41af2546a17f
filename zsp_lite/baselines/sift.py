"""SIFT (Lowe 2004): keypoints with depth, a baseline of the paper (sec. 5.2), and dense RootSIFT as
patch features."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from zsp_lite.backbones.backbone import Image, prepare_images
from zsp_lite.data.depth import inpaint_depth
from zsp_lite.data.frames import ON_OBJECT, Frame
from zsp_lite.features import FeatureMap
from zsp_lite.matchers import mutual_nearest_neighbours

# Of RootSIFT, pixels: a descriptor covers 144 of 224 pixels, most of an object around its patch.
KEYPOINT_SIZE = 24.0
# OpenCV's constants:
_CELLS = 4  # along each side of a descriptor
_BINS = 8  # orientations per cell
_CELL = 1.5  # side of a cell, in keypoint sizes
_BLUR = (1.6**2 - 0.5**2) ** 0.5  # from the image's own blur, 0.5 pixels, to 1.6 pixels
_CLIP = 0.2  # largest entry of a descriptor, relative to its length
_SCALE = 512.0  # length of a descriptor before it is rounded


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of an image."""

    pixels: Float[np.ndarray, "n 2"]  # (x, y), pixel centres at half-integers
    descriptors: Float[np.ndarray, "n 128"]  # of unit length


class Sift:
    """OpenCV's SIFT with its defaults, in the mask or, without one, in the whole image."""

    name = "sift"

    def describe(self, frames: Sequence[Frame]) -> list[Keypoints]:
        """Detect the keypoints of object crops."""
        keypoints = []
        for frame in frames:
            grey = cv2.cvtColor(np.ascontiguousarray(frame.rgb), cv2.COLOR_RGB2GRAY)
            mask = None if frame.mask is None else (frame.mask > ON_OBJECT).astype(np.uint8)
            points, descriptors = cv2.SIFT_create().detectAndCompute(grey, mask)
            if descriptors is None:
                descriptors = np.empty((0, 128), np.float32)
            # OpenCV's origin is the centre of pixel 0, which adds 1/2; its upsampled image is
            # shifted, which subtracts 1/4.
            pixels = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.25
            length = np.linalg.norm(descriptors, axis=1, keepdims=True)
            keypoints.append(Keypoints(pixels, descriptors / np.maximum(length, 1e-12)))
        return keypoints


def mutual_matches(
    first: Keypoints, second: Keypoints, k: int = 50
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Match mutual nearest neighbours: indices in both images and cosines of the best k."""
    similarity = torch.from_numpy(
        first.descriptors.astype(np.float64) @ second.descriptors.T.astype(np.float64)
    )
    if not similarity.numel():  # an image without keypoints
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    # For each keypoint of the first image, its nearest neighbour in the second image, and their
    # cosine, which is -inf if they are not mutual neighbours.
    partner, score = mutual_nearest_neighbours(similarity)
    best = score.argsort(descending=True, stable=True)[: min(k, int(score.isfinite().sum()))]
    return best.numpy(), partner[best].numpy(), score[best].numpy()


def unproject_pixels(frame: Frame, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Compute the points of pixels in camera coordinates; unknown depth is in-painted."""
    height, width = frame.camera.size
    columns, rows = np.floor(pixels).astype(np.int64).clip(0, (width - 1, height - 1)).T
    return frame.camera.unproject_camera(pixels, inpaint_depth(frame.depth)[rows, columns])


class RootSift:
    """Feature extractor whose keys (28, 28, 128) are upright SIFT descriptors at patch centres.

    As RootSIFT (Arandjelovic and Zisserman 2012), they are square roots of L1-normalised
    histograms, whose dot products are Hellinger kernels. The global feature is their normalised
    mean.
    """

    name = "rootsift"
    has_saliency = False
    image_size = 224
    patch_size = 8

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Extract the features of (H, W, 3) images, uint8 or float in [0, 1]."""
        maps = []
        side = self.image_size // self.patch_size
        # OpenCV's origin is the centre of pixel 0.
        centres = (np.arange(side) + 0.5) * self.patch_size - 0.5
        for rgb in prepare_images(images, self.image_size).mul(255).round().to(torch.uint8):
            grey = cv2.cvtColor(
                np.ascontiguousarray(rgb.permute(1, 2, 0).numpy()), cv2.COLOR_RGB2GRAY
            )
            histograms = dense_sift(grey, centres, KEYPOINT_SIZE)
            total = histograms.sum(axis=-1, keepdims=True)
            keys = torch.from_numpy(
                np.sqrt(histograms / np.maximum(total, 1e-12)).astype(np.float32)
            )
            mean = torch.nn.functional.normalize(keys.mean((0, 1)), dim=0)
            maps.append(FeatureMap(keys, torch.ones(side, side), mean))
        return maps


def dense_sift(
    grey: UInt8[np.ndarray, "n n"], centres: Float[np.ndarray, " side"], size: float
) -> Float[np.ndarray, "side side 128"]:
    """Compute OpenCV's descriptors of upright keypoints on a grid: integers from 0 to 255."""
    side = len(centres)
    blurred = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _BLUR)
    # Gradients, 0 at the border.
    right = np.zeros_like(blurred)
    up = np.zeros_like(blurred)
    right[1:-1, 1:-1] = blurred[1:-1, 2:] - blurred[1:-1, :-2]
    up[1:-1, 1:-1] = blurred[:-2, 1:-1] - blurred[2:, 1:-1]
    length, angle = cv2.cartToPolar(right, up, angleInDegrees=True)
    # Each gradient contributes to the two nearest orientations, with linear weights: (bins, n, n).
    distance = np.abs(angle * (_BINS / 360) - np.arange(_BINS, dtype=np.float32)[:, None, None])
    oriented = length * np.maximum(1 - np.minimum(distance, _BINS - distance), 0)
    # The weight of a pixel is a product of one for its row and one for its column: two matrix
    # products sum all cells in a hundredth of OpenCV's time.
    weights = _weights(len(grey), centres, _CELL * size)
    cells = (weights @ oriented @ weights.T).reshape(_BINS, side, _CELLS, side, _CELLS)
    histograms = cells.transpose(1, 3, 2, 4, 0).reshape(side, side, -1)
    histograms = np.minimum(histograms, _CLIP * np.linalg.norm(histograms, axis=-1, keepdims=True))
    norm = np.linalg.norm(histograms, axis=-1, keepdims=True)
    return np.round(histograms * (_SCALE / np.maximum(norm, np.finfo(np.float32).eps))).clip(0, 255)


def _weights(
    n: int, centres: Float[np.ndarray, " side"], cell: float
) -> Float[np.ndarray, "rows n"]:
    """Compute the weights of n pixels along one axis in each cell of each keypoint."""
    offset = np.arange(n) - np.round(centres)[:, None]  # (keypoints, n), pixels
    in_cells = offset / cell
    # A Gaussian window that ends where OpenCV's window ends.
    inside = np.abs(offset) <= round(cell * 2**0.5 * (_CELLS + 1) / 2)
    window = np.exp(-(in_cells**2) / (_CELLS**2 / 2)) * inside
    # Distances to the centre of each cell, (keypoints, cells, n). The weight falls linearly to 0 at
    # the centre of the next cell.
    distance = np.abs(in_cells[:, None] + _CELLS / 2 - 0.5 - np.arange(_CELLS)[:, None])
    return (window[:, None] * np.maximum(1 - distance, 0)).reshape(-1, n).astype(np.float32)
