"""Point clouds: those of sequences, and planes in them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8

from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError
from zsp_lite.io.files import path_inside
from zsp_lite.io.ply import read_ply


def point_cloud(
    dataset: Co3D, category: str, sequence: str
) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"] | None]:
    """Read a sequence's point cloud (see `Co3D.point_cloud`)."""
    path = _cloud_path(dataset, category, sequence)
    if path is None:
        raise InputError(f"sequence {category}/{sequence} has no point cloud")
    return read_ply(path)


def extent(
    dataset: Co3D, category: str, sequence: str
) -> tuple[Float64[np.ndarray, "3"], float] | None:
    """Return the centre and the diameter of a sequence's object in its world.

    Both describe the box around the points of its cloud, without the outermost 2 % on each side.
    None without a point cloud.
    """
    path = _cloud_path(dataset, category, sequence)
    if path is None or not path.is_file():
        return None
    points, _ = read_ply(path)
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low))


def best_plane(
    points: Float[np.ndarray, "n 3"],
    tolerance: float,
    trials: int,
    allowed: Callable[[np.ndarray], Bool[np.ndarray, " trials"]] = lambda normals: True,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], int]:
    """Fit a plane to points with outliers (RANSAC; Fischler and Bolles 1981).

    Args:
        points: Points.
        tolerance: Largest distance of an inlier.
        trials: Number of samples of three points.
        allowed: Whether planes with some normals (trials, 3), of any length, count.

    Returns:
        The normal, of either sign; the middle of the inliers; and their number, 0 if no plane
        counts.
    """
    corners = points[np.random.default_rng(0).integers(len(points), size=(trials, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    # Collinear points span no plane.
    counting = (lengths[:, 0] > 0) & allowed(normals)
    normals = normals / np.where(lengths > 0, lengths, 1)
    offsets = (normals * corners[:, 0]).sum(axis=1, keepdims=True)
    inside = np.abs(normals @ points.T - offsets) < tolerance  # (trials, n)
    counts = inside.sum(axis=1) * counting
    # The least-squares plane of the inliers: their direction of least variance is its normal.
    inliers = points[inside[counts.argmax()]]
    middle = inliers.mean(axis=0)
    return np.linalg.svd(inliers - middle, full_matrices=False)[2][2], middle, int(counts.max())


def _cloud_path(dataset: Co3D, category: str, sequence: str) -> Path | None:
    """Return the path of a sequence's point cloud, None if the annotations have none."""
    clouds = {known.sequence_name: known.point_cloud for known in dataset.sequences(category)}
    cloud = clouds.get(sequence)
    return None if cloud is None else path_inside(dataset.root, cloud.path)
