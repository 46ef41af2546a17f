"""Iterative closest point (ICP) with scale on the object points of depth maps (supplement, "Baselines")."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.ply import load_open3d
from zsp_lite.points import object_points

POINTS = 5000  # largest number of points per cloud
_ITERATIONS = 100
_TOLERANCE = 1e-6  # relative change of fitness and RMSE at convergence
_MIN_POINTS = 10
# Every point has a correspondence at any distance, as in PyTorch3D's ICP, which the paper uses.
_MAX_DISTANCE = 1e6


def icp(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"]) -> Sim3:
    """Align point clouds by Open3D's point-to-point ICP with scale, starting from the identity."""
    open3d = load_open3d()
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (source, target)]
    registration = open3d.pipelines.registration
    result = registration.registration_icp(
        *clouds, _MAX_DISTANCE, np.eye(4), registration.TransformationEstimationPointToPoint(with_scaling=True),
        registration.ICPConvergenceCriteria(_TOLERANCE, _TOLERANCE, _ITERATIONS),
    )  # fmt: skip
    matrix = np.asarray(result.transformation)
    determinant = np.linalg.det(matrix[:3, :3]) if np.isfinite(matrix).all() else 0.0
    if not determinant > 1e-12:
        raise InputError("icp: the result is not a similarity, because the scale converged to 0")
    scale = float(np.cbrt(determinant))
    return Sim3(scale, matrix[:3, :3] / scale, matrix[:3, 3])


def align(reference: Frame, targets: Sequence[Frame], view: int, firsts: tuple[Camera, Camera], seed: int) -> Sim3:
    """Estimate the pose of a reference frame in target `view` by ICP, from camera points to camera points.

    Both cameras start where the first camera of their sequence is (supplement), because the worlds of CO3D's sequences
    are nearly aligned already, which would help.
    """
    rng = np.random.default_rng(seed)
    camera = targets[view].camera
    source = _subsample(object_points(reference), rng)
    parts = [camera.to_camera(target.camera.to_world(object_points(target))) for target in targets]
    target = _subsample(np.concatenate(parts), rng)
    aligned = icp(firsts[0].to_world(source), firsts[1].to_world(target))
    to_reference, to_target = (Sim3(1.0, first.R, first.t) for first in firsts)
    return to_target @ aligned @ to_reference.inverse()


def _subsample(points: Float[np.ndarray, "n 3"], rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    if len(points) < _MIN_POINTS:
        raise InputError(f"object has {len(points)} points of known depth, expected at least {_MIN_POINTS}")
    return points if len(points) <= POINTS else points[rng.choice(len(points), POINTS, replace=False)]
