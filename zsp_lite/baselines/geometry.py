"""Poses by geometry alone (supplement): ICP with scale; the essential matrix without depth."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.matching import Matches
from zsp_lite.points import object_points

POINTS = 5000  # largest number of points per cloud, the paper's (supplement)
_MIN_POINTS = 10  # fewer points do not determine a shape
# Points correspond at any distance, as in PyTorch3D's ICP, which the paper uses.
_MAX_DISTANCE = 1e6


def icp(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"]) -> Sim3:
    """Align point clouds by Open3D's point-to-point ICP with scale, starting from the identity."""
    import open3d

    vectors = open3d.utility.Vector3dVector
    registration = open3d.pipelines.registration
    result = registration.registration_icp(
        open3d.geometry.PointCloud(vectors(source)),
        open3d.geometry.PointCloud(vectors(target)),
        _MAX_DISTANCE,
        np.eye(4),
        registration.TransformationEstimationPointToPoint(with_scaling=True),
        # PyTorch3D's defaults.
        registration.ICPConvergenceCriteria(
            relative_fitness=1e-6, relative_rmse=1e-6, max_iteration=100
        ),
    )
    matrix = np.asarray(result.transformation)
    # The determinant is the cube of the scale.
    determinant = np.linalg.det(matrix[:3, :3]) if np.isfinite(matrix).all() else 0.0
    if not determinant > 1e-12:
        raise InputError("icp: the result is not a similarity, because the scale converged to 0")
    return Sim3.from_matrix(matrix)


def align(
    reference: Frame, targets: Sequence[Frame], view: int, firsts: tuple[Camera, Camera], seed: int
) -> Sim3:
    """Estimate the pose of a reference frame in target `view` by ICP, between camera frames.

    `firsts` has the first cameras of the sequences of reference and targets.
    """
    rng = np.random.default_rng(seed)
    camera = targets[view].camera
    source = _subsample(object_points(reference), rng)
    # The points of all targets in the frame of the target view's camera.
    clouds = [camera.to_camera(target.camera.to_world(object_points(target))) for target in targets]
    destination = _subsample(np.concatenate(clouds), rng)
    # For ICP, both cameras are placed where the first camera of their sequence is (supplement):
    # with their own places, the worlds of CO3D's sequences would be nearly aligned already.
    first_reference, first_target = firsts
    aligned = icp(first_reference.to_world(source), first_target.to_world(destination))
    return first_target.sim3 @ aligned @ first_reference.sim3.inverse()


def _subsample(
    points: Float[np.ndarray, "n 3"], rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    """Choose at most `POINTS` points at random; InputError if there are too few."""
    if len(points) < _MIN_POINTS:
        raise InputError(
            f"object has {len(points)} points of known depth, expected at least {_MIN_POINTS}"
        )
    if len(points) <= POINTS:
        return points
    return points[rng.choice(len(points), POINTS, replace=False)]


def essential_rotation(
    reference: Frame, target: Frame, matches: Matches, grid: tuple[int, int]
) -> tuple[Float[np.ndarray, "3 3"], int, str]:
    """Return the rotation between the cameras, the number of its inliers, and a note for users."""
    # Points at depth 1 take the place of pixels, because every crop has a camera of its own.
    source = _directions(reference.camera, matches.reference, grid)
    destination = _directions(target.camera, matches.target, grid)
    focal = np.concatenate([reference.camera.focal_length, target.camera.focal_length]).mean()
    # The threshold is the height of a patch at depth 1, because matches are patch centres.
    threshold = reference.camera.size[0] / grid[0] / focal
    poses = []
    # The five-point algorithm in RANSAC; OpenCV's random draws are always the same.
    if len(matches) >= 5:
        matrices, mask = cv2.findEssentialMat(
            source, destination, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=threshold
        )
        # OpenCV stacks the s solutions of one sample, (3 s, 3). The right solution has the most
        # points in front of both cameras: `recoverPose` returns their number first, and then the
        # rotation. It changes its mask.
        if matrices is not None:
            for matrix in np.split(matrices, len(matrices) // 3):
                poses.append(
                    cv2.recoverPose(matrix, source, destination, np.eye(3), mask=mask.copy())[:2]
                )
    inliers, rotation = max(poses, key=lambda pose: pose[0], default=(0, None))
    if inliers and np.isfinite(rotation).all():
        return rotation, int(inliers), ""
    note = f"pose is the best view's, not a fit: no essential matrix in {len(matches)} matches"
    return np.eye(3), 0, note


def _directions(
    camera: Camera, patches: np.ndarray, grid: tuple[int, int]
) -> Float[np.ndarray, "k 2"]:
    """Return where patch centres lie on the plane at depth 1 of the camera."""
    height, width = camera.size
    # From (row, column) of a patch to (x, y) of its centre.
    patch_size = (width / grid[1], height / grid[0])
    pixels = (np.asarray(patches, dtype=np.float64)[:, ::-1] + 0.5) * patch_size
    return np.ascontiguousarray(camera.unproject_camera(pixels, np.ones(len(pixels)))[:, :2])
