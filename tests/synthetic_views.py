"""Views of an asymmetric implicit surface, and a backbone whose features are functions of the
object coordinates.

The colours of the images encode the object coordinates. Features computed from them are exact, so
that any error is caused by the pipeline.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.random import default_rng

from zsp_lite import Camera, FeatureMap, Frame, Sim3
from zsp_lite.course.synthetic.sequences import orbit_pose
from zsp_lite.data.depth import unproject_depth

AXES = np.array([1.2, 0.8, 0.6])  # half axes of the ellipsoid without its bumps
REACH = 1.6  # no point of the object is farther from its middle; colours encode [-REACH, REACH]


def inside(points: np.ndarray) -> np.ndarray:
    """Implicit function of the object, (..., 3) -> (...), negative inside."""
    x, y, z = np.moveaxis(points, -1, 0)
    # Small waves make the ellipsoid asymmetric.
    bumps = 0.08 * np.sin(4 * x + 1) + 0.08 * np.sin(5 * y - 2 * z) + 0.06 * np.cos(6 * z + x)
    return np.linalg.norm(points / AXES, axis=-1) - 1 - bumps


def look_at(direction, distance: float = 4.0, size=(140, 180), focal: float = 190.0) -> Camera:
    """A camera at `distance` in `direction` from the origin that looks at the origin; `size` is
    (H, W), `focal` in pixels."""
    forward = -np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    right = np.cross(forward, (0.1, 0.2, 1.0))  # of an oblique vertical: cameras are not level
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    middle = np.array([size[1], size[0]]) / 2
    return Camera(rotation, np.array([0, 0, distance]), np.full(2, focal), middle, size)


def level_camera(azimuth, height=0.0):
    """A camera that looks at (1, 2, 3) from an azimuth and, by `height`, from above, both in
    degrees; +z of the world is up."""
    # Without roll, at a distance of 3.
    pose = orbit_pose(*np.radians([azimuth, height]), 0, 3.0, (1, 2, 3))
    return Camera(*pose, np.full(2, 100.0), np.full(2, 50.0), (100, 100))


# Object poses of the two sequences of a pair, and directions of cameras.
AT_HOME = Sim3.identity()
ELSEWHERE = Sim3(1.15, look_at((0.3, -1, 0.6)).R, np.array([0.05, -0.1, 0.08]))
DIRECTIONS = [(1, 0.2, 0.3), (-0.5, 1, 0.3), (-1, -0.6, 0.2), (0.3, -1, 0.4), (0.6, 0.8, -0.2)]


def turned(camera: Camera, turn: np.ndarray) -> Camera:
    """The same camera in a world that is rotated about its origin."""
    return replace(camera, R=camera.R @ turn.T)


def render(camera: Camera, placement: Sim3, name: str = "") -> Frame:
    """Render the object; `placement` maps object to world coordinates."""
    height, width = camera.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = camera.unproject_camera(np.stack([x, y], -1), np.ones((height, width)))
    # Rays that miss the ball around the object see nothing.
    centre = camera.to_camera(placement.t)
    reach = REACH * placement.scale
    off_centre = np.linalg.norm(np.cross(rays, centre), axis=-1)
    in_ball = off_centre < reach * np.linalg.norm(rays, axis=-1)
    start, *ends = placement.inverse().apply(
        camera.to_world(np.concatenate([np.zeros((1, 3)), rays[in_ball]]))
    )
    along = ends - start  # per unit of depth, in object coordinates
    # From far to near in steps of -0.1, so that the last entry found is the nearest one. An entry
    # is the first depth inside the object. No test has an object outside these depths.
    entry = np.full(len(along), np.inf)
    was_inside = np.zeros(len(along), dtype=bool)
    steps, step = np.linspace(7.0, 1.5, 56, retstep=True)
    for depth in steps[np.abs(steps - centre[2]) < reach - step]:
        is_inside = inside(start + depth * along) <= 0
        entry[was_inside & ~is_inside] = depth - step
        was_inside = is_inside
    # Bisection between a depth inside the object, `high`, and one in front of it, `low`.
    hit = np.isfinite(entry)
    high = np.where(hit, entry, 1.0)
    low = high + step
    for _ in range(14):
        half = (low + high) / 2
        outside = inside(start + half[:, None] * along) > 0
        low = np.where(outside, half, low)
        high = np.where(outside, high, half)
    # Black, 0, is the background.
    colour = np.rint(((start + high[:, None] * along) / REACH + 1) * 127).clip(1, 254)
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[in_ball] = np.where(hit[:, None], colour, 0)
    depth = np.zeros((height, width), np.float32)
    depth[in_ball] = np.where(hit, high, 0)
    return Frame(rgb, depth, (depth > 0).astype(np.float32), camera, name)


def around(placement: Sim3, count: int = 7, arc: float = 360) -> list[Frame]:
    """Render views of the object, evenly spaced in an arc of degrees about the vertical
    through it, from a little above."""
    angles = np.radians(np.arange(count) * arc / count)
    cameras = [look_at(placement.R @ (np.cos(a), np.sin(a), 0.3)) for a in angles]
    return [render(camera, placement, f"{k:04d}") for k, camera in enumerate(cameras)]


@dataclass(frozen=True)
class CoordinateBackbone:
    """Features are sines and cosines of the object coordinates that the colours encode; black is
    background."""

    grid: int = 28

    def __call__(self, images) -> list[FeatureMap]:
        return [self.features(np.asarray(image)) for image in images]

    def features(self, image: np.ndarray) -> FeatureMap:
        """The features of one image from the mean colour of each of n x n patches."""
        n = self.grid
        p = len(image) // n  # pixels along a patch

        def average(pixels: np.ndarray) -> np.ndarray:
            return pixels.reshape(n, p, n, p, -1).mean(axis=(1, 3))

        painted = image.min(axis=-1, keepdims=True) > 0
        share = average(painted)
        mean = average(image * painted) / np.maximum(share, 1e-9)
        share = share[..., 0]
        coordinates = (mean / 127 - 1) * REACH
        # Directions and frequencies of 32 random waves.
        waves = default_rng(5).normal(0, 1.6, (3, 32))
        keys = np.concatenate([np.sin(coordinates @ waves), np.cos(coordinates @ waves)], axis=-1)
        # The background has one short key; patches half on the object are on it.
        keys[share < 0.5] = 0.05 * default_rng(6).normal(size=keys.shape[-1])
        keys = torch.as_tensor(keys, dtype=torch.float32)
        saliency = torch.as_tensor(np.where(share < 0.5, 0, share), dtype=torch.float32)
        return FeatureMap(keys, saliency, keys[share >= 0.5].mean(dim=0).nan_to_num())


def true_pose(reference: Camera, placement: Sim3, target: Camera, target_placement: Sim3) -> Sim3:
    """The true map from the reference's camera frame to the target's, for one object at two
    placements."""
    first = reference.sim3 @ placement
    return target.sim3 @ target_placement @ first.inverse()


def reference_and_targets(targets: int = 3) -> list[Frame]:
    """A frame of the object AT_HOME, and some frames of it ELSEWHERE, by cameras that are turned
    with the world of the object."""
    # Farther than the reference's camera, which is at 4.
    cameras = [
        turned(look_at(direction, distance=4.5), ELSEWHERE.R) for direction in DIRECTIONS[:targets]
    ]
    elsewhere = [render(camera, ELSEWHERE, f"target {i}") for i, camera in enumerate(cameras)]
    return [render(look_at((1, 0.6, 0.4)), AT_HOME, "reference"), *elsewhere]


ABOVE_FLOOR = [(1, 0.2, 0.6), (0.4, 1, 0.5), (0.7, -0.8, 0.4), (1, 0.5, 1.5)]  # as DIRECTIONS


def object_on_floor(direction) -> tuple[Frame, np.ndarray]:
    """A frame of the object AT_HOME, in red on a grey floor before a wall, whose depth has holes,
    and the true mask."""
    camera = look_at(direction, distance=5.0)
    seen = render(camera, AT_HOME)
    truth = seen.mask > 0
    # Directions of the rays in the world, with depth 1.
    rays = unproject_depth(np.ones(camera.size), camera) @ camera.R
    # The depth of the wall, at x = -3, and of the floor, at z = -0.8, a little below the object.
    depths = (np.array([-3.0, -0.8]) - camera.centre[[0, 2]]) / rays[..., [0, 2]]
    depth = np.where(truth, seen.depth, np.where(depths > 0, depths, np.inf).min(axis=-1))
    rng = default_rng(0)
    # Three of ten blocks of 7 x 9 pixels are holes. Beyond 20 units a sensor measures nothing.
    holes = np.kron(rng.random((20, 20)) < 0.3, np.ones((7, 9)))
    depth = np.where((holes > 0) | (depth > 20), 0, depth)
    rgb = np.where(truth[..., None], (200, 40, 40), 90) + rng.integers(-9, 9, (*camera.size, 3))
    return Frame(rgb.astype(np.uint8), depth.astype(np.float32), None, camera), truth


def overlap(mask: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union of a mask and a boolean one."""
    found = mask > 0.5
    return (found & truth).sum() / (found | truth).sum()
