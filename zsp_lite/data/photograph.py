"""Depth and object mask of the stereo photograph of `samples.motorcycle_photograph`."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError

# Calibration at the size in scikit-image, from its documentation: focal length, principal point and difference of the
# two principal points in pixels, baseline in metres. The values are those of the original photograph divided by 4.
# They therefore count from the corner of the image, as `Camera` does, to within 1/8 pixel.
_FOCAL_LENGTH, _PRINCIPAL_POINT, _PRINCIPAL_DIFFERENCE, _BASELINE = 994.978, (311.193, 254.877), 31.086, 0.193001
_FLOOR_ROWS = slice(300, None)  # lower part of the photograph, mostly floor
_FLOOR_DISTANCE = 0.01  # metres; largest distance of a floor point from the plane
_TRIALS = 500  # samples of three points to fit a plane to
_CLEARANCE = 0.02  # metres; smallest height of an object point above the floor
_FARTHEST = 2.75  # metres; the motorcycle is nearer, the bench and the shelf behind it are not


def motorcycle_frame(rgb: UInt8[np.ndarray, "h w 3"], disparity: Float32[np.ndarray, "h w"]) -> Frame:
    """Convert the photograph and its disparities to a frame with depth in metres and an object mask.

    The depth is `focal length * baseline / (disparity + difference of the principal points)`. The mask is the largest
    connected region of points above the floor and nearer than the background. Thin parts, such as the brake cables and
    a mirror, are missing, and so are the lowest 2 cm of the tyres.

    Args:
        rgb: Left image.
        disparity: Disparities in pixels, not finite where unknown.
    """
    known = np.isfinite(disparity)
    depth = np.zeros_like(disparity)
    depth[known] = _BASELINE * _FOCAL_LENGTH / (disparity[known] + _PRINCIPAL_DIFFERENCE)
    camera = Camera(np.eye(3), np.zeros(3), np.full(2, _FOCAL_LENGTH), np.array(_PRINCIPAL_POINT), depth.shape)
    points = unproject_depth(depth, camera)
    normal, offset = fit_plane(points[_FLOOR_ROWS][known[_FLOOR_ROWS]], _FLOOR_DISTANCE)
    height = (points @ normal - offset) * -np.sign(normal[1])  # +y is down
    mask = _largest_region(known & (depth < _FARTHEST) & (height > _CLEARANCE))
    return Frame(rgb, depth, mask.astype(np.float32), camera, "motorcycle photograph")


def scale_to_unit_deviation(frame: Frame) -> Frame:
    """Scale the depth of a frame whose camera is at the origin: the object's points get unit standard deviation.

    The deviation is averaged over the axes, as in CO3D (supplement).
    """
    points = unproject_depth(frame.depth, frame.camera)[(frame.mask > 0) & (frame.depth > 0)]
    return replace(frame, depth=frame.depth / np.float32(points.std(axis=0).mean()))


def fit_plane(points: Float[np.ndarray, "n 3"], threshold: float) -> tuple[Float[np.ndarray, "3"], float]:
    """Fit a plane to points with outliers, by RANSAC and by least squares over the inliers of the best trial.

    Args:
        points: (N, 3) points, N >= 3. At most 4,000 of them, evenly spaced, are used.
        threshold: Largest distance of an inlier.

    Returns:
        Unit normal and offset of the plane `normal @ x = offset`. The sign of the normal is arbitrary.

    Raises:
        InputError: There are fewer than 3 points, or all lie on a line.
    """
    if len(points) < 3:
        raise InputError(f"got {len(points)} points, expected at least 3 to fit a plane")
    points = points[:: -(-len(points) // 4000)]
    corners = points[np.random.default_rng(0).integers(len(points), size=(_TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(lengths > 0, lengths, 1)
    distances = np.abs(normals @ points.T - (normals * corners[:, 0]).sum(axis=1, keepdims=True))
    distances[lengths[:, 0] == 0] = np.inf  # a sample of collinear points
    inliers = points[distances[(distances < threshold).sum(axis=1).argmax()] < threshold]
    if len(inliers) < 3:
        raise InputError(f"no plane within {threshold} of three of the {len(points)} points")
    centre = inliers.mean(axis=0)
    normal = np.linalg.svd(inliers - centre, full_matrices=False)[2][2]
    return normal, float(normal @ centre)


def _largest_region(inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Remove parts thinner than 3 pixels and return the largest connected region."""
    opened = cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, regions, statistics, _ = cv2.connectedComponentsWithStats(opened)
    return regions == 1 + statistics[1:, cv2.CC_STAT_AREA].argmax()
