"""SIFT keypoints (Lowe 2004), matched as mutual nearest neighbours and unprojected by depth (paper sec. 5.2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from zsp_lite.data.depth import inpaint_depth
from zsp_lite.data.frames import ON_OBJECT, Frame


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of an image."""

    pixels: Float[np.ndarray, "n 2"]  # (x, y), pixel centres at half-integers
    descriptors: Float[np.ndarray, "n 128"]  # of unit length


class Sift:
    """Detector and descriptor of keypoints in the mask or, without a mask, in the whole image: OpenCV's defaults."""

    name = "sift"

    def describe(self, frames: Sequence[Frame]) -> list[Keypoints]:
        """Detect the keypoints of object crops."""
        return [self._describe(frame) for frame in frames]

    def _describe(self, frame: Frame) -> Keypoints:
        grey = cv2.cvtColor(np.ascontiguousarray(frame.rgb), cv2.COLOR_RGB2GRAY)
        mask = None if frame.mask is None else (frame.mask > ON_OBJECT).astype(np.uint8)
        points, descriptors = cv2.SIFT_create().detectAndCompute(grey, mask)
        if not points:
            return Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32))
        # OpenCV measures from the centre of pixel 0 (half a pixel) in an upsampled image that is shifted by -1/4 pixel.
        pixels = np.array([point.pt for point in points], dtype=np.float64) + 0.25
        length = np.linalg.norm(descriptors, axis=1, keepdims=True)
        return Keypoints(pixels, descriptors / np.maximum(length, 1e-12))


def mutual_matches(
    first: Keypoints, second: Keypoints, k: int = 50
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Indices in both images, and cosine similarities, of the k most similar mutual nearest neighbours, best first."""
    if not len(first.pixels) or not len(second.pixels):
        return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    similarity = first.descriptors.astype(np.float64) @ second.descriptors.T.astype(np.float64)
    partner = similarity.argmax(axis=1)
    index = np.arange(len(similarity))
    index = index[similarity.argmax(axis=0)[partner] == index]
    index = index[np.argsort(-similarity[index, partner[index]], kind="stable")][:k]
    return index, partner[index], similarity[index, partner[index]]


def unproject_pixels(frame: Frame, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Compute the points of pixels in camera coordinates, with in-painted depth where it is unknown."""
    height, width = frame.camera.size
    columns, rows = np.floor(pixels).astype(np.int64).clip(0, (width - 1, height - 1)).T
    return frame.camera.unproject_camera(pixels, inpaint_depth(frame.depth)[rows, columns])
