"""Planes through points, and regions of masks."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

_TRIALS = 500  # samples of three points to fit a plane to
_MOST_POINTS = 4000  # that a plane is fitted to


def fit_plane(points: Float[np.ndarray, "n 3"], threshold: float) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit a plane `normal @ x = offset` to points with outliers, or through a line on which all points lie.

    RANSAC is followed by least squares over the inliers of the best trial, the points nearer than `threshold`. Returns
    the unit normal, of arbitrary sign, and the offset.
    """
    points = points[:: -(-len(points) // _MOST_POINTS)]
    corners = points[np.random.default_rng(0).integers(len(points), size=(_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0, lengths, 1)
    distances = np.abs(normals @ points.T - (normals * corners[:, 0]).sum(axis=1, keepdims=True))
    counts = (distances < threshold).sum(axis=1) * (lengths[:, 0] > 0)  # 0 for a sample of collinear points
    inliers = points[distances[counts.argmax()] < threshold]
    centre = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - centre, full_matrices=False)[2][2]
    return normal, float(normal @ centre)


def largest_region(inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Remove parts thinner than 3 pixels and return the largest connected region, empty if there is none."""
    opened = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, regions, statistics, _ = cv2.connectedComponentsWithStats(opened)
    areas = statistics[1:, cv2.CC_STAT_AREA]  # the first region is the outside
    return regions == 1 + areas.argmax() if len(areas) else np.zeros_like(inside)
