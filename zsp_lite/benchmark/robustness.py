"""Robustness rows: estimation with corrupted depth, masks and camera poses, or with exact synthetic depth and masks.

Crops and features are not changed, so each row differs from the original one in a single property. Lengths are in units
of the object's spread, the standard deviation of its points. Random numbers are drawn with the pair's seed.
"""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.benchmark.problem import Problem
from zsp_lite.data.annotations import decode
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes
from zsp_lite.pipeline import PoseEstimate, ZeroShotPose
from zsp_lite.points import object_points, standard_deviation
from zsp_lite.views import frame_view

_HOLES = 0.3  # fraction of the image that becomes unknown, in regions about a sixteenth of the crop wide
_DEPTH_NOISE = 0.1  # standard deviation in spreads; correlated over two pixels
_POSE_NOISE = 1.0, 0.01  # degrees; fraction of the camera's distance to the object
_WANDER = 20.0  # correlation length of a mask's error in pixels

Damage = Callable[[Frame, np.random.Generator], Frame]


def holes(frame: Frame, rng: np.random.Generator) -> Frame:
    """Remove the depth in 30 % of the image, in addition to the pixels without depth."""
    unknown = _smooth(rng, frame.camera.size, 14.0)
    depth = np.where(unknown < np.quantile(unknown, _HOLES), 0, _depth(frame))
    return replace(frame, depth=depth.astype(np.float32))


def depth_noise(frame: Frame, rng: np.random.Generator) -> Frame:
    """Add noise to the depth, with a standard deviation of a tenth of the object's spread."""
    depth = _depth(frame)
    noisy = depth + _DEPTH_NOISE * object_spread(frame) * _smooth(rng, depth.shape, 2.0)
    return replace(frame, depth=np.where(depth > 0, np.maximum(noisy, 1e-3), 0).astype(np.float32))


def mask_error(pixels: float) -> Damage:
    """Return a function that displaces the outline of the mask by a root mean square of `pixels` of the crop."""

    def damage(frame: Frame, rng: np.random.Generator) -> Frame:
        if frame.mask is None:
            raise InputError(f"{frame.name or 'frame'}: no mask, expected one")
        inside = (frame.mask > 0.5).astype(np.uint8)
        distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
        wandered = distance + pixels * _smooth(rng, frame.camera.size, _WANDER)
        # If no pixel is left, the mask is not changed.
        mask = (wandered > 0) if (wandered > 0).any() else inside > 0
        return replace(frame, mask=mask.astype(np.float32))

    return damage


def pose_noise(frame: Frame, rng: np.random.Generator) -> Frame:
    """Rotate the camera by one degree about a random axis, and move it by 1 % of its distance to the object."""
    degrees, share = _POSE_NOISE
    axis, away = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    turn, _ = cv2.Rodrigues(np.radians(degrees) * axis)
    camera = frame.camera
    depth = _depth(frame)
    moved = camera.t + share * float(np.median(depth[depth > 0])) * away
    return replace(frame, camera=replace(camera, R=turn @ camera.R, t=turn @ moved))


def nothing(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return the frame unchanged."""
    return frame


# By name: the change of the reference and of each target. The methods use the camera poses of targets only.
DAMAGES: dict[str, tuple[Damage, Damage]] = {
    "holes": (holes, holes),
    "depthnoise": (depth_noise, depth_noise),
    "mask4": (mask_error(4.0), mask_error(4.0)),
    "mask8": (mask_error(8.0), mask_error(8.0)),
    "posenoise": (nothing, pose_noise),
}


@dataclass(frozen=True)
class Damaged:
    """A row of the benchmark: `ZeroShotPose` on changed views.

    Attributes:
        damage: Name in `DAMAGES`, or "clean" for exact depth and masks.
        settings: Settings of `ZeroShotPose`.
    """

    damage: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, problem: Problem) -> PoseEstimate:
        solver = ZeroShotPose(problem.store.extractors["backbone"], **self.settings, seed=problem.seed)
        rng = np.random.default_rng([problem.seed % 2**32, zlib.crc32(self.damage.encode())])
        views = []
        for index, (key, frame, features) in enumerate(zip(problem.keys, problem.frames(), problem.descriptions())):
            if self.damage == "clean":
                frame = exact(frame, problem.store.dataset.root, problem.pair.category, key[0])
            else:
                frame = DAMAGES[self.damage][min(index, 1)](frame, rng)
            views.append(frame_view(frame, features, solver.foreground, solver.saliency_threshold))
        return solver.estimate_from_views(views[0], views[1:])


def object_spread(frame: Frame) -> float:
    """Compute the standard deviation of the visible points of the object; of all points if the mask has none."""
    points = object_points(frame)
    return standard_deviation(points if len(points) else object_points(replace(frame, mask=None)))


def exact(frame: Frame, root: str | Path, category: str, sequence: str) -> Frame:
    """Replace depth and mask of a synthetic frame by the exact ones; the depth of the background is unknown.

    Raises:
        InputError: The folder was not made by `zsp-lite synth`.
    """
    rays = _object_rays(str(root), category, sequence)
    camera = frame.camera
    height, width = camera.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    # The rays have unit depth, so the ray parameter is the depth.
    directions = camera.unproject_camera(np.stack([x, y], axis=-1), np.ones((height, width))) @ camera.R
    depth = rays(camera.centre, directions)
    mask = np.isfinite(depth)
    return replace(frame, depth=np.where(mask, depth, 0).astype(np.float32), mask=mask.astype(np.float32))


@lru_cache(maxsize=8)
def _object_rays(root: str, category: str, sequence: str) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a function from a ray's origin (3,) and directions (..., 3) in the world to ray parameters (...)."""
    from zsp_lite.io.open3d import load_open3d
    from zsp_lite.synthetic.export import POSES_FILE, SETTINGS_FILE, make_object

    settings, poses = Path(root) / SETTINGS_FILE, Path(root) / category / POSES_FILE
    if not (settings.is_file() and poses.is_file()):
        raise InputError(
            f"{root}: no {SETTINGS_FILE}, expected a folder made by zsp-lite synth, which contains exact poses"
        )
    seed = decode(read_bytes(settings, "settings"), dict, settings)["seed"]
    placed = decode(read_bytes(poses, "object poses"), dict, poses)[sequence]
    shape = make_object(category, sequence, seed)
    pose = np.array(placed["trans"])
    vertices = placed["scale"] * shape.vertices @ pose[:3, :3].T + pose[:3, 3]
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(shape.faces.astype(np.uint32)))

    def cast(eye: np.ndarray, directions: np.ndarray) -> np.ndarray:
        rays = np.concatenate([np.broadcast_to(eye, directions.shape), directions], axis=-1)
        return scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()

    return cast


def _depth(frame: Frame) -> Float[np.ndarray, "h w"]:
    if frame.depth is None or not (frame.depth > 0).any():
        raise InputError(f"{frame.name or 'frame'}: no known depth, expected at least one pixel")
    return frame.depth


def _smooth(rng: np.random.Generator, size: tuple[int, int], width: float) -> Float[np.ndarray, "h w"]:
    """Return noise of unit variance, correlated over `width` pixels."""
    noise = cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), width, borderType=cv2.BORDER_REFLECT)
    return noise / noise.std()
