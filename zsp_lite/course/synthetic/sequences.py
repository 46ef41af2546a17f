"""Simulated recordings: a hand-held camera moves once around an object, and its depth and masks
have CO3D's errors.

CO3D's depth comes from multi-view stereo (COLMAP), which finds no match without texture, at depth
edges and at grazing angles. Its masks come from a segmentation network (PointRend), accurate to one
or two pixels.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float

from zsp_lite.course.synthetic.meshes import TexturedMesh
from zsp_lite.course.synthetic.primitives import TAU
from zsp_lite.course.synthetic.raytracing import MeshScene, Rendering
from zsp_lite.course.synthetic.room import random_room
from zsp_lite.course.synthetic.textures import blur, smooth_noise
from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import SequenceData
from zsp_lite.data.frames import Frame
from zsp_lite.points import axis_deviation

_ASPECTS = ((1, 1), (4, 3), (3, 4))  # height : width
# lowest and highest mean elevation of a sequence's cameras above the object, degrees
HEIGHTS = (
    19.0,
    30.0,
)
_FRAME_MARGIN = 0.03  # free border at each image side, as a fraction of that side
_DEPTH_NOISE = 0.005  # standard deviation relative to the depth, at the object
# Range of the fraction of pixels without depth, drawn per sequence. The wall has no depth at all.
_OBJECT_HOLES = (0.28, 0.46)
_FLOOR_HOLES = (0.1, 0.3)
# Ranges of CO3D's viewpoint quality and point cloud quality in the sequences that the paper labels,
# and of CO3D's factor from stored depth to depth.
_SCORES = (1.3, 3.0), (0.35, 1.0), (0.4, 2.5)


def orbit_pose(
    azimuth: float, elevation: float, roll: float, distance: float, target
) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation and translation, world to camera, of a camera that looks at `target` (3,);
    angles in radians."""
    away = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    forward = -away
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    c, s = np.cos(roll), np.sin(roll)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.stack(
        [right, np.cross(forward, right), forward]
    )
    return R, -R @ (np.asarray(target, float) + away * distance)


def handheld_sweep(
    vertices: Float[np.ndarray, "v 3"],
    rng: np.random.Generator,
    frames: int,
    size: tuple[int, int],
    heights: tuple[float, float] = HEIGHTS,
) -> list[Camera]:
    """Draw the cameras, in object coordinates, of a hand-held camera that moves once around the
    object."""
    progress = (np.arange(frames) + rng.normal(0, 0.12, frames)) / frames
    phase = rng.uniform(0, TAU, 4)

    def wave(k: int, turns: float) -> np.ndarray:
        return np.sin(turns * TAU * progress + phase[k])

    azimuth = rng.uniform(0, TAU) + rng.choice([-1, 1]) * TAU * progress + 0.06 * wave(0, 2)
    elevation = rng.uniform(*heights) + rng.uniform(3, 9) * wave(1, float(rng.choice([1, 2])))
    elevation = np.radians(
        (elevation + rng.normal(0, 1, frames)).clip(heights[0] - 9, heights[1] + 5)
    )
    distance = rng.uniform(6, 9) * (1 + 0.08 * wave(2, 1) + rng.normal(0, 0.01, frames))
    roll = np.radians(3 * wave(3, 1.5) + rng.normal(0, 2, frames))
    aim = (
        (vertices.max(0) + vertices.min(0)) / 2
        + rng.normal(0, 0.1, 3)
        + rng.normal(0, 0.05, (frames, 3))
    )
    poses = [
        orbit_pose(*view) for view in zip(azimuth, elevation, roll, distance, aim, strict=True)
    ]

    # Bounding box of the object's image at focal length 1, relative to the optical axis.
    plane = [(v := vertices @ R.T + t)[:, :2] / v[:, 2:] for R, t in poses]
    low = np.array([p.min(0) for p in plane])
    high = np.array([p.max(0) for p in plane])
    sides = np.array(size[::-1], float)
    principal_point = np.round(sides / 2 + rng.normal(0, 0.004, 2) * sides, 6)
    room = np.minimum(principal_point, sides - principal_point) - _FRAME_MARGIN * sides
    # The object fills 55 to 75 % of the shorter side in the median view, and is inside the image in
    # all views.
    wanted = rng.uniform(0.55, 0.75) * sides.min() / np.median((high - low).max(1))
    allowed = (room / np.maximum(-low, high).max(0)).min()
    focal_length = np.full(2, round(min(wanted, allowed), 6))
    return [Camera(R, t, focal_length, principal_point, size) for R, t in poses]


def render_sequence(
    mesh: TexturedMesh,
    rng: np.random.Generator,
    frames: int,
    image_size: int,
    heights: tuple[float, float] = HEIGHTS,
) -> tuple[list[Rendering], Float[np.ndarray, "4 4"]]:
    """Render exact views around an object in a random room; `image_size` is the shorter image side.

    Their cameras map from the world of the sequence, the second result from the object to it.
    """
    tall, wide = _ASPECTS[rng.integers(len(_ASPECTS))]
    size = round(tall / min(tall, wide) * image_size), round(wide / min(tall, wide) * image_size)
    cameras = handheld_sweep(mesh.vertices, rng, frames, size, heights)
    scene = MeshScene(mesh, random_room(rng), rng)
    # its frame is the world, so that the object's pose does not depend on the category
    first = cameras[0].matrix
    to_object = np.linalg.inv(first)
    # The last digits of sines and products depend on the processor; rounding makes the files equal
    # everywhere.
    views = []
    for camera in cameras:
        view = scene.render(camera)
        pose = np.round(view.camera.matrix @ to_object, 9) + 0.0  # no negative zeros
        views.append(replace(view, camera=replace(view.camera, R=pose[:3, :3], t=pose[:3, 3])))
    return views, np.round(first, 9)


def stereo_depth(
    view: Rendering, object_holes: float, floor_holes: float, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Simulate the depth map of multi-view stereo; the holes are fractions of the object's and the
    floor's pixels."""
    confidence = _stereo_confidence(view, rng)
    known = np.zeros(view.mask.shape, bool)
    for region, holes in ((view.mask, object_holes), (~view.mask & (view.depth > 0), floor_holes)):
        if region.any():
            known |= region & (confidence >= np.quantile(confidence[region], holes))
    # a flat object may be seen edge-on
    near = np.median(view.depth[view.mask]) if view.mask.any() else np.inf
    # The noise, mostly correlated between pixels, grows with the square of the depth.
    noise = 0.95 * smooth_noise(rng, view.mask.shape, 2.0) + 0.3 * rng.standard_normal(
        view.mask.shape
    )
    noise *= _DEPTH_NOISE * np.minimum(view.depth / near, 3)
    return np.where(known, view.depth * np.maximum(1 + noise, 0.5), 0).astype(np.float32)


def _stereo_confidence(view: Rendering, rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return how well stereo would match each pixel: badly at depth edges and grazing angles."""
    scale = min(view.mask.shape) / 100
    grey = blur(
        view.rgb.astype(np.float32) @ np.float32([0.299, 0.587, 0.114]), max(0.6 * scale, 0.3)
    )
    energy = cv2.Sobel(grey, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(grey, cv2.CV_32F, 0, 1) ** 2
    texture = np.log(np.sqrt(blur(energy, 2.5 * scale)) + 1)
    texture = (texture - texture.mean()) / (texture.std() + 1e-6)
    far = np.where(view.depth > 0, view.depth, view.depth.max())
    jump = cv2.dilate(far, np.ones((3, 3))) / cv2.erode(far, np.ones((3, 3))) - 1
    edge = np.minimum(blur((jump > 0.03).astype(np.float32), max(0.5 * scale, 0.3)) * 2, 1)
    h, w = view.mask.shape
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    ray = view.camera.unproject_camera(np.stack([x, y], -1), np.ones((h, w)))
    facing = np.abs((view.normals * ray).sum(-1)) / np.linalg.norm(ray, axis=-1)
    grazing = np.where(view.mask, np.clip(1 - facing / 0.5, 0, 1), 0)
    noise = 0.7 * smooth_noise(rng, (h, w), 5 * scale) + 0.4 * smooth_noise(
        rng, (h, w), 1.5 * scale
    )
    return texture + noise - 1.5 * edge - 1.5 * grazing


def soft_mask(mask: Bool[np.ndarray, "h w"], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Simulate the probability map (float32) of a segmentation network: a soft edge, displaced by
    up to two pixels."""
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5) - cv2.distanceTransform(
        1 - inside, cv2.DIST_L2, 5
    )
    distance -= np.where(mask, 0.5, -0.5)
    wander = np.clip(0.8 * smooth_noise(rng, mask.shape, 0.04 * min(mask.shape)), -1.5, 1.5)
    return (1 / (1 + np.exp(-np.clip(distance + wander, -14, 14) / 0.7))).astype(np.float32)


def fused_cloud(
    views: Sequence[Rendering],
    depths: Sequence[Float[np.ndarray, "h w"]],
    n_points: int,
    rng: np.random.Generator,
) -> list[np.ndarray]:
    """Sample points of the object from the depth maps of all views: world points, unit normals,
    8-bit colours."""
    parts = []
    for view, depth in zip(views, depths, strict=True):
        row, col = np.nonzero((depth > 0) & view.mask)
        points = view.camera.unproject(np.stack([col + 0.5, row + 0.5], -1), depth[row, col])
        parts.append((points, view.normals[row, col] @ view.camera.R, view.rgb[row, col]))
    cloud = [np.concatenate(values) for values in zip(*parts, strict=True)]
    chosen = np.sort(rng.choice(len(cloud[0]), min(n_points, len(cloud[0])), replace=False))
    return [values[chosen] for values in cloud]


def record_sequence(
    mesh: TexturedMesh,
    name: str,
    key: int,
    frames: int,
    image_size: int,
    heights: tuple[float, float] = HEIGHTS,
) -> tuple[SequenceData, Float[np.ndarray, "4 4"], float]:
    """Return a sequence with the errors of CO3D's data, whose point cloud has CO3D's unit spread.

    The other results are the object's exact pose [R t] and scale in it: `world = R @ (scale *
    canonical) + t`.
    """
    rng = np.random.default_rng([key, 1])
    views, pose = render_sequence(mesh, rng, frames, image_size, heights)
    seconds = np.round(np.arange(frames) * rng.uniform(0.4, 0.9), 3).tolist()
    rng = np.random.default_rng([key, 2])
    object_holes = rng.uniform(*_OBJECT_HOLES)
    floor_holes = rng.uniform(*_FLOOR_HOLES)
    depths, masks = [], []
    for view in views:
        shares = np.clip(np.array([object_holes, floor_holes]) + rng.normal(0, 0.03, 2), 0.05, 0.9)
        depths.append(stereo_depth(view, *shares, rng))
        masks.append(soft_mask(view.mask, rng))
    points, normals, colours = fused_cloud(views, depths, int(rng.integers(5000, 8001)), rng)
    factor = round(1 / axis_deviation(points), 9)
    pose[:3, 3] *= factor
    recorded = [
        Frame(
            view.rgb,
            depth * np.float32(factor),
            mask,
            replace(view.camera, t=view.camera.t * factor),
        )
        for view, depth, mask in zip(views, depths, masks, strict=True)
    ]
    scores = [round(rng.uniform(*limits), 4) for limits in _SCORES]
    return (
        SequenceData(name, recorded, seconds, points * factor, colours, normals, *scores),
        pose,
        factor,
    )
