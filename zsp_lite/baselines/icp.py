"""Iterative closest point with scale, on the object's points as depth and mask give them (supplement, "Baselines")."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import inpaint_depth, unproject_depth
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.open3d import load_open3d

POINTS = 5000
_STEPS = 100
_TOLERANCE = 1e-6
_ON_OBJECT = 0.5
_FEW = 10
# Every point has a partner, however far: as in PyTorch3D's, which the paper used.
_ANY_DISTANCE = 1e6


def icp(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "m 3"]) -> Sim3:
    """The similarity from the source to the target at which Open3D's point-to-point ICP with scale ends up.

    It starts from the identity. Raises InputError where it does not end in a similarity.
    """
    open3d = load_open3d()
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (source, target)]
    registration = open3d.pipelines.registration
    found = registration.registration_icp(
        *clouds, _ANY_DISTANCE, np.eye(4), registration.TransformationEstimationPointToPoint(with_scaling=True),
        registration.ICPConvergenceCriteria(_TOLERANCE, _TOLERANCE, _STEPS),
    ).transformation  # fmt: skip
    found = np.asarray(found)
    determinant = np.linalg.det(found[:3, :3]) if np.isfinite(found).all() else 0.0
    if not determinant > 1e-12:
        raise InputError("icp: ended in no similarity, for the source shrank to a point")
    scale = float(np.cbrt(determinant))
    return Sim3(scale, found[:3, :3] / scale, found[:3, 3])


def align(
    reference: Frame,
    targets: Sequence[Frame],
    view: int,
    firsts: tuple[Camera, Camera],
    seed: int | np.random.Generator,
) -> Sim3:
    """Reference-camera points to those of target `view`, by ICP on `POINTS` random points of either object.

    The target's cloud is that of all its views. Both clouds are placed as if the camera that looks at them, of the
    reference or of target `view`, stood where the first camera of its sequence stood (`firsts`): this puts the two
    cameras' frames on top of each other, less what the two sequences' first cameras differ in. Raises InputError
    where a frame has no depth on its object.
    """
    rng = np.random.default_rng(seed)
    camera = targets[view].camera
    source = _sample(object_points(reference), rng)
    parts = [camera.to_camera(target.camera.to_world(object_points(target))) for target in targets]
    target = _sample(np.concatenate(parts), rng)
    placed = icp(firsts[0].to_world(source), firsts[1].to_world(target))
    into, out_of = (Sim3(1.0, first.R, first.t) for first in reversed(firsts))
    return into @ placed @ out_of.inverse()


def object_points(frame: Frame) -> Float[np.ndarray, "n 3"]:
    """Camera-frame points of the object's pixels with known depth (in-painted, where hardly any is known).

    Raises InputError without a depth map or a known pixel in it.
    """
    if frame.depth is None:
        raise InputError(f"{frame.name or 'frame'}: no depth map, expected one for the object's points")
    on_object = np.ones(frame.camera.size, bool) if frame.mask is None else frame.mask >= _ON_OBJECT
    depth, chosen = frame.depth, on_object & (frame.depth > 0)
    if chosen.sum() < _FEW:
        depth, chosen = inpaint_depth(frame.depth), on_object
    return unproject_depth(depth, frame.camera)[chosen]


def _sample(points: Float[np.ndarray, "n 3"], rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
    if len(points) < _FEW:
        raise InputError(f"object has {len(points)} points, expected at least {_FEW}")
    return points if len(points) <= POINTS else points[rng.choice(len(points), POINTS, replace=False)]
