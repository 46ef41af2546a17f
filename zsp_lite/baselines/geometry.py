"""Poses by geometry alone (supplement): ICP with scale; the essential matrix without depth."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.ply import load_open3d
from zsp_lite.matching import Matches
from zsp_lite.points import object_points

POINTS = 5000  # largest number of points per cloud
_MIN_POINTS = 10
# Every point has a correspondence at any distance, as in PyTorch3D's ICP, which the paper uses.
_MAX_DISTANCE = 1e6


def icp(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"]) -> Sim3:
    """Align point clouds by Open3D's point-to-point ICP with scale, starting from the identity."""
    open3d = load_open3d()
    clouds = [
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        for points in (source, target)
    ]
    registration = open3d.pipelines.registration
    result = registration.registration_icp(
        *clouds,
        _MAX_DISTANCE,
        np.eye(4),
        registration.TransformationEstimationPointToPoint(with_scaling=True),
        registration.ICPConvergenceCriteria(
            relative_fitness=1e-6, relative_rmse=1e-6, max_iteration=100
        ),
    )
    matrix = np.asarray(result.transformation)
    determinant = np.linalg.det(matrix[:3, :3]) if np.isfinite(matrix).all() else 0.0
    if not determinant > 1e-12:
        raise InputError("icp: the result is not a similarity, because the scale converged to 0")
    return Sim3.from_matrix(matrix)


def align(
    reference: Frame, targets: Sequence[Frame], view: int, firsts: tuple[Camera, Camera], seed: int
) -> Sim3:
    """Estimate the pose of a reference frame in target `view` by ICP, from camera points to camera
    points."""
    rng = np.random.default_rng(seed)
    camera = targets[view].camera
    source = _subsample(object_points(reference), rng)
    parts = [camera.to_camera(target.camera.to_world(object_points(target))) for target in targets]
    target = _subsample(np.concatenate(parts), rng)
    # Both cameras start where the first camera of their sequence is (supplement), because the
    # worlds of CO3D's sequences are nearly aligned already, which would help.
    first, second = firsts
    aligned = icp(first.to_world(source), second.to_world(target))
    to_reference = Sim3(1.0, first.R, first.t)
    to_target = Sim3(1.0, second.R, second.t)
    return to_target @ aligned @ to_reference.inverse()


def _subsample(
    points: Float[np.ndarray, "n 3"], rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    if len(points) < _MIN_POINTS:
        raise InputError(
            f"object has {len(points)} points of known depth, expected at least {_MIN_POINTS}"
        )
    return (
        points if len(points) <= POINTS else points[rng.choice(len(points), POINTS, replace=False)]
    )


def essential_rotation(
    reference: Frame, target: Frame, matches: Matches, grid: tuple[int, int]
) -> tuple[Float[np.ndarray, "3 3"], int, str]:
    """Return the rotation from the reference's camera to the target's, how many matches agree with
    it, and a note."""
    # Directions, since every crop has a camera of its own.
    first = _directions(reference.camera, matches.reference, grid)
    second = _directions(target.camera, matches.target, grid)
    focal = np.concatenate([reference.camera.focal_length, target.camera.focal_length]).mean()
    # Matches are patch centres: a patch is as far as one is off.
    threshold = reference.camera.size[0] / grid[0] / focal
    poses = []
    if len(matches) >= 5:  # five-point RANSAC; OpenCV's draws are always the same
        found, mask = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.999, threshold)
        # OpenCV stacks several solutions of one sample; which is meant shows in how many points lie
        # in front.
        for matrix in () if found is None else np.split(found, len(found) // 3):
            poses.append(cv2.recoverPose(matrix, first, second, np.eye(3), mask=mask.copy())[:2])
    inliers, rotation = max(poses, key=lambda pose: pose[0], default=(0, None))
    if inliers and np.isfinite(rotation).all():
        return rotation, int(inliers), ""
    return np.eye(3), 0, f"pose is the best view's: no essential matrix in {len(matches)} matches"


def _directions(
    camera: Camera, patches: np.ndarray, grid: tuple[int, int]
) -> Float[np.ndarray, "k 2"]:
    """Return where patch centres lie on the plane at depth 1 of the camera."""
    height, width = camera.size
    pixels = (np.asarray(patches, dtype=np.float64)[:, ::-1] + 0.5) * (
        width / grid[1],
        height / grid[0],
    )
    return np.ascontiguousarray(camera.unproject_camera(pixels, np.ones(len(pixels)))[:, :2])
