"""Rows on corrupted data: holes and noise in the depth, wrong masks, wrong camera poses; or on exact synthetic data.

Crops and features stay as they are, so that every row sees the same images and differs in one thing only. Lengths are
in units of the object's spread, the standard deviation of its points.
"""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.benchmark.problem import Problem
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import object_points, standard_deviation
from zsp_lite.views import frame_view

_HOLES = 0.3  # fraction of the image, in patches of about a sixteenth of its width
_DEPTH_NOISE = 0.1  # of the spread, correlated over two pixels
_POSE_NOISE = 1.0, 0.01  # degrees; fraction of the camera's distance to the object
_OUTLINE = 20.0  # pixels along an outline over which the mask's error changes

Damage = Callable[[Frame, np.random.Generator], Frame]


def holes(frame: Frame, rng: np.random.Generator) -> Frame:
    """Remove the depth in 30 % of the image, in addition to what is unknown already."""
    noise = _smooth_noise(rng, frame.camera.size, 14.0)
    depth = np.where(noise < np.quantile(noise, _HOLES), 0, _known_depth(frame))
    return replace(frame, depth=depth.astype(np.float32))


def depth_noise(frame: Frame, rng: np.random.Generator) -> Frame:
    """Add noise of a tenth of the object's spread, r.m.s., to the depth."""
    depth = _known_depth(frame)
    noisy = depth + _DEPTH_NOISE * object_spread(frame) * _smooth_noise(rng, depth.shape, 2.0)
    return replace(frame, depth=np.where(depth > 0, np.maximum(noisy, 1e-3), 0).astype(np.float32))


def mask_error(pixels: float) -> Damage:
    """Return a damage that moves the mask's outline by so many pixels of the crop, r.m.s., inwards and outwards."""

    def damage(frame: Frame, rng: np.random.Generator) -> Frame:
        if frame.mask is None:
            raise InputError(f"{frame.name or 'frame'}: no mask, expected one")
        inside = (frame.mask > 0.5).astype(np.uint8)
        distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
        moved = distance + pixels * _smooth_noise(rng, frame.camera.size, _OUTLINE)
        mask = (moved > 0) if (moved > 0).any() else inside > 0  # an empty mask would test something else
        return replace(frame, mask=mask.astype(np.float32))

    return damage


def pose_noise(frame: Frame, rng: np.random.Generator) -> Frame:
    """Rotate the camera by one degree about a random axis, and move it by 1 % of its distance from the object."""
    degrees, fraction = _POSE_NOISE
    axis, direction = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    turn, _ = cv2.Rodrigues(np.radians(degrees) * axis)
    camera = frame.camera
    depth = _known_depth(frame)
    moved = camera.t + fraction * float(np.median(depth[depth > 0])) * direction
    return replace(frame, camera=replace(camera, R=turn @ camera.R, t=turn @ moved))


def nothing(frame: Frame, rng: np.random.Generator) -> Frame:
    """Return the frame as it is."""
    return frame


# By name: the damage of the reference and of each target. Methods use the poses of the targets' cameras only.
DAMAGES: dict[str, tuple[Damage, Damage]] = {
    "holes": (holes, holes),
    "depthnoise": (depth_noise, depth_noise),
    "mask4": (mask_error(4.0), mask_error(4.0)),
    "mask8": (mask_error(8.0), mask_error(8.0)),
    "posenoise": (nothing, pose_noise),
}


@dataclass(frozen=True)
class Damaged:
    """A row: `ZeroShotPose` on damaged frames.

    Attributes:
        damage: A name in `DAMAGES`, or "clean" for exact depth and masks of synthetic frames.
        settings: Settings of `ZeroShotPose`.
    """

    damage: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, problem: Problem) -> PoseEstimate:
        """Estimate the pose. The damage is drawn with the pair's seed and the damage's name."""
        solver = ZeroShotPose(problem.store.extractors["backbone"], **self.settings, seed=problem.seed)
        rng = np.random.default_rng([problem.seed, zlib.crc32(self.damage.encode())])
        views = []
        for index, (key, frame, features) in enumerate(zip(problem.keys, problem.frames(), problem.descriptions())):
            if self.damage == "clean":
                from zsp_lite.synthetic.exact import exact_frame

                frame = exact_frame(frame, problem.store.dataset.root, problem.pair.category, key[0])
            else:
                frame = DAMAGES[self.damage][min(index, 1)](frame, rng)
            views.append(frame_view(frame, features, solver.foreground, solver.saliency_threshold))
        return solver.estimate_from_views(views[0], views[1:])


def object_spread(frame: Frame) -> float:
    """Return the standard deviation, averaged over the axes, of the object's points; without a mask, of all points."""
    points = object_points(frame)
    return standard_deviation(points if len(points) else object_points(replace(frame, mask=None)))


def _known_depth(frame: Frame) -> Float[np.ndarray, "h w"]:
    if frame.depth is None or not (frame.depth > 0).any():
        raise InputError(f"{frame.name or 'frame'}: no known depth, expected at least one pixel")
    return frame.depth


def _smooth_noise(rng: np.random.Generator, size: tuple[int, int], width: float) -> Float[np.ndarray, "h w"]:
    """Noise of unit variance, correlated over `width` pixels."""
    noise = cv2.GaussianBlur(rng.standard_normal(size).astype(np.float32), (0, 0), width, borderType=cv2.BORDER_REFLECT)
    return noise / noise.std()
