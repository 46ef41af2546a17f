"""Planes and connected regions, which separate an object from what it stands on."""

import cv2
import numpy as np
from jaxtyping import Bool, Float

_PLANE_TRIALS = 500  # number of samples of three points
_PLANE_POINTS = 4000  # largest number of points to which a plane is fitted, for speed


def fit_plane(
    points: Float[np.ndarray, "n 3"], threshold: float
) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit a plane `normal @ x = offset` to points with outliers by RANSAC, up to its sign."""
    # The step is rounded up.
    points = points[:: -(-len(points) // _PLANE_POINTS)]
    # A plane through three points in each trial: normals (trials, 3), distances (trials, n).
    corners = points[np.random.default_rng(0).integers(len(points), size=(_PLANE_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0, lengths, 1)
    distances = np.abs(normals @ points.T - (normals * corners[:, 0]).sum(axis=1, keepdims=True))
    # Collinear points span no plane: such a sample counts 0.
    counts = (distances < threshold).sum(axis=1) * (lengths[:, 0] > 0)
    # The least-squares plane of the inliers: their direction of least variance is its normal.
    inliers = points[distances[counts.argmax()] < threshold]
    centre = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - centre, full_matrices=False)[2][2]
    return normal, float(normal @ centre)


def largest_region(inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the largest connected region after parts thinner than 3 pixels are removed.

    It is empty if there is no region.
    """
    opened = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, regions, statistics, _ = cv2.connectedComponentsWithStats(opened)
    areas = statistics[1:, cv2.CC_STAT_AREA]  # the first region is the outside
    return regions == 1 + areas.argmax() if len(areas) else np.zeros_like(inside)
