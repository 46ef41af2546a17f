"""Planes and connected regions, which separate an object from what it stands on."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from zsp_lite.data.clouds import best_plane

_PLANE_TRIALS = 500  # number of samples of three points
_PLANE_POINTS = 4000  # largest number of points to which a plane is fitted, for speed
WINDOW_3 = np.ones((3, 3), np.uint8)  # of OpenCV's filters of masks, pixels


def fit_plane(
    points: Float[np.ndarray, "n 3"], threshold: float
) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit a plane `normal @ x = offset` to points with outliers by RANSAC, up to its sign."""
    # The step is rounded up.
    points = points[:: -(-len(points) // _PLANE_POINTS)]
    normal, middle, _ = best_plane(points, threshold, _PLANE_TRIALS)
    return normal, float(normal @ middle)


def largest_region(inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the largest connected region after parts thinner than 3 pixels are removed.

    It is empty if there is no region.
    """
    opened = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_OPEN, WINDOW_3)
    _, regions, statistics, _ = cv2.connectedComponentsWithStats(opened)
    areas = statistics[1:, cv2.CC_STAT_AREA]  # the first region is the outside
    return regions == 1 + areas.argmax() if len(areas) else np.zeros_like(inside)
