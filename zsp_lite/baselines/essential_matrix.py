"""Rotation without depth: the essential matrix of the matches (supplement, "Depth-free methods")."""

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.matching import Matches

_FEWEST = 5  # matches


def essential_rotation(
    reference: Frame, target: Frame, matches: Matches, grid: tuple[int, int]
) -> tuple[Float[np.ndarray, "3 3"], int, str]:
    """Return the rotation from the reference's camera to the target's, how many matches agree with it, and a note.

    Five-point RANSAC in OpenCV (its draws are always the same) on directions, since every crop has a camera of its own.
    Where too few matches agree, the best view as it is: the identity, and a note that says so.
    """
    first = _directions(reference.camera, matches.reference, grid)
    second = _directions(target.camera, matches.target, grid)
    focal = np.concatenate([reference.camera.focal_length, target.camera.focal_length]).mean()
    threshold = reference.camera.size[0] / grid[0] / focal  # matches are patch centres: a patch is as far as one is off
    poses = []
    if len(matches) >= _FEWEST:
        found, mask = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.999, threshold)
        # OpenCV stacks several solutions of one sample; which is meant shows in how many points lie in front.
        for matrix in () if found is None else np.split(found, len(found) // 3):
            poses.append(cv2.recoverPose(matrix, first, second, np.eye(3), mask=mask.copy())[:2])
    inliers, rotation = max(poses, key=lambda pose: pose[0], default=(0, None))
    if inliers and np.isfinite(rotation).all():
        return rotation, int(inliers), ""
    return np.eye(3), 0, f"pose is the best view's: no essential matrix in {len(matches)} matches"


def _directions(camera: Camera, patches: np.ndarray, grid: tuple[int, int]) -> Float[np.ndarray, "k 2"]:
    """Return where patch centres lie on the plane at depth 1 of the camera."""
    height, width = camera.size
    pixels = (np.asarray(patches, dtype=np.float64)[:, ::-1] + 0.5) * (width / grid[1], height / grid[0])
    return np.ascontiguousarray(camera.unproject_camera(pixels, np.ones(len(pixels)))[:, :2])
