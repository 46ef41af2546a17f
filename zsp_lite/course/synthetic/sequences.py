"""Simulated recordings of a hand-held camera, whose depth and masks have the errors of CO3D's.

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
from zsp_lite.course.synthetic.primitives import (
    TAU,
    Coordinates,
    Vertices,
    box_centre,
    direction,
    rotation,
    unit,
)
from zsp_lite.course.synthetic.raytracing import MeshScene, Rendering
from zsp_lite.course.synthetic.room import random_room
from zsp_lite.course.synthetic.textures import Map, blur, smooth_noise
from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import Frame
from zsp_lite.data.writing import SequenceData
from zsp_lite.points import axis_deviation

_ASPECTS = ((1, 1), (4, 3), (3, 4))  # height : width
# Lowest and highest mean elevation of a sequence's cameras above the object, in degrees.
_HEIGHTS = (19.0, 30.0)
_FRAME_MARGIN = 0.03  # free border at each image side, as a fraction of that side
_DEPTH_NOISE = 0.005  # standard deviation relative to the depth, at the object
# Ranges of the fraction of pixels without depth, which is drawn per sequence. Walls have no depth.
_OBJECT_HOLES = (0.28, 0.46)
_FLOOR_HOLES = (0.1, 0.3)
# Ranges of the last three fields of `SequenceData`, as in the sequences that the paper labels.
_SCORES = (
    (1.3, 3.0),  # viewpoint quality
    (0.35, 1.0),  # point cloud quality
    (0.4, 2.5),  # factor from stored depth to depth
)


def orbit_pose(
    azimuth: float, elevation: float, roll: float, distance: float, target: Coordinates
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Return R and t, world to camera, of a camera that looks at `target` (3,); angles in radians.

    The camera is `distance` from the target in the direction of azimuth and elevation.
    """
    away = direction(azimuth, elevation)
    forward = -away
    right = unit(np.cross(forward, [0, 0, 1.0]))
    # The rows are the camera's axes: right, down and forward.
    R = rotation("z", roll) @ np.stack([right, np.cross(forward, right), forward])
    return R, -R @ (np.asarray(target, float) + away * distance)


def handheld_sweep(
    vertices: Vertices,
    rng: np.random.Generator,
    frames: int,
    size: tuple[int, int],
) -> list[Camera]:
    """Draw cameras, in object coordinates, of a hand that moves once around the object.

    Args:
        vertices: of the object, with unit spread.
        rng: source of the random numbers.
        frames: number of cameras.
        size: height and width of their images in pixels.

    Returns:
        Cameras of one focal length; the whole object is inside all their images.
    """
    # Every quantity of the motion swings slowly (waves) and trembles from frame to frame (normal
    # numbers).
    progress = (np.arange(frames) + rng.normal(0, 0.12, frames)) / frames
    phase = rng.uniform(0, TAU, 4)

    # Quantity k swings this often on the way around the object.
    def wave(k: int, turns: float) -> Float[np.ndarray, " frames"]:
        return np.sin(turns * TAU * progress + phase[k])

    azimuth = rng.uniform(0, TAU) + rng.choice([-1, 1]) * TAU * progress + 0.06 * wave(0, 2)
    elevation = rng.uniform(*_HEIGHTS) + rng.uniform(3, 9) * wave(1, float(rng.choice([1, 2])))
    elevation += rng.normal(0, 1, frames)
    # No single view is more than 9 degrees below or 5 above the range of means.
    elevation = np.radians(elevation.clip(_HEIGHTS[0] - 9, _HEIGHTS[1] + 5))
    distance = rng.uniform(6, 9) * (1 + 0.08 * wave(2, 1) + rng.normal(0, 0.01, frames))
    roll = np.radians(3 * wave(3, 1.5) + rng.normal(0, 2, frames))
    aim = box_centre(vertices) + rng.normal(0, 0.1, 3) + rng.normal(0, 0.05, (frames, 3))
    poses = list(map(orbit_pose, azimuth, elevation, roll, distance, aim))

    # Bounding boxes of the object's images at focal length 1, relative to the optical axis.
    low, high = np.moveaxis([image_box(vertices, R, t) for R, t in poses], 1, 0)
    sides = np.array(size[::-1], float)  # width and height, as image points are (x, y)
    principal_point = np.round(sides / 2 + rng.normal(0, 0.004, 2) * sides, 6)
    space = np.minimum(principal_point, sides - principal_point) - _FRAME_MARGIN * sides
    # The object fills 55 to 75 % of the shorter side in the median view, if it is then inside the
    # image in all views.
    wanted = rng.uniform(0.55, 0.75) * sides.min() / np.median((high - low).max(1))
    allowed = (space / np.maximum(-low, high).max(0)).min()
    focal_length = np.full(2, round(min(wanted, allowed), 6))
    return [Camera(R, t, focal_length, principal_point, size) for R, t in poses]


def image_box(
    vertices: Vertices, R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the lower and upper corner (x, y) of the vertices' image at focal length 1."""
    in_camera = vertices @ R.T + t
    plane = in_camera[:, :2] / in_camera[:, 2:]
    return plane.min(0), plane.max(0)


def render_sequence(
    mesh: TexturedMesh,
    rng: np.random.Generator,
    frames: int,
    image_size: int,
) -> tuple[list[Rendering], Float[np.ndarray, "4 4"]]:
    """Render exact views around an object in a random room.

    Args:
        mesh: the object, with unit spread.
        rng: source of the random numbers.
        frames: number of views.
        image_size: shorter image side in pixels.

    Returns:
        The views, whose cameras map from the world of the sequence; and the pose [R t] of the
        object in that world.
    """
    aspect = np.array(_ASPECTS[rng.integers(len(_ASPECTS))])
    height, width = np.rint(aspect / aspect.min() * image_size).astype(int).tolist()
    cameras = handheld_sweep(mesh.vertices, rng, frames, (height, width))
    # The lines of floor and walls must not tell the heading of the object: the room is turned by an
    # angle from a random stream of its own.
    turn = rng.spawn(1)[0].uniform(0, TAU)
    scene = MeshScene(mesh, random_room(rng, turn), rng)
    # The frame of the first camera is the world, so that the object's pose does not depend on the
    # category.
    object_to_world = cameras[0].matrix
    world_to_object = np.linalg.inv(object_to_world)
    # The last digits of sines and products depend on the processor; rounded poses are equal
    # everywhere. Adding 0.0 turns negative zeros into zeros.
    views = []
    for camera in cameras:
        view = scene.render(camera)
        pose = np.round(view.camera.matrix @ world_to_object, 9) + 0.0
        views.append(replace(view, camera=replace(view.camera, R=pose[:3, :3], t=pose[:3, 3])))
    return views, np.round(object_to_world, 9)


def stereo_depth(
    view: Rendering, object_holes: float, floor_holes: float, rng: np.random.Generator
) -> Map:
    """Simulate the depth map of multi-view stereo, 0 where the depth is unknown.

    Args:
        view: the exact view.
        object_holes: fraction of the object's pixels without depth.
        floor_holes: fraction of the floor's pixels without depth.
        rng: source of the random numbers.
    """
    # The pixels of least confidence in each region have no depth.
    confidence = _stereo_confidence(view, rng)
    known = np.zeros(view.mask.shape, bool)
    floor = ~view.mask & (view.depth > 0)
    for region, holes in ((view.mask, object_holes), (floor, floor_holes)):
        if region.any():
            known |= region & (confidence >= np.quantile(confidence[region], holes))
    # A flat object that is seen edge-on may have no pixel; then there is no noise.
    object_depth = np.median(view.depth[view.mask]) if view.mask.any() else np.inf
    # The noise relative to the depth grows with the depth, up to three times the object's. It is
    # mostly correlated between pixels; the squares of both weights sum to about 1.
    correlated = 0.95 * smooth_noise(rng, view.mask.shape, 2.0)
    independent = 0.3 * rng.standard_normal(view.mask.shape)
    noise = (correlated + independent) * (_DEPTH_NOISE * np.minimum(view.depth / object_depth, 3))
    return np.where(known, view.depth * np.maximum(1 + noise, 0.5), 0).astype(np.float32)


def _stereo_confidence(view: Rendering, rng: np.random.Generator) -> Map:
    """Return how well stereo would match each pixel: badly at depth edges and grazing angles."""
    h, w = view.mask.shape
    scale = min(h, w) / 100  # pixels per percent of the shorter side

    # Texture: the logarithm of the mean gradient around a pixel, standardised over the image.
    grey = view.rgb.astype(np.float32) @ np.float32([0.299, 0.587, 0.114])  # weights of BT.601
    grey = blur(grey, max(0.6 * scale, 0.3))
    energy = cv2.Sobel(grey, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(grey, cv2.CV_32F, 0, 1) ** 2
    texture = np.log(np.sqrt(blur(energy, 2.5 * scale)) + 1)
    texture = (texture - texture.mean()) / (texture.std() + 1e-6)

    # Edges: steps of the depth of more than 3 % between neighbours. The wall, whose depth is 0,
    # counts as the farthest point of the floor. An edge is the blurred mark of a step, doubled, and
    # at most 1.
    far = np.where(view.depth > 0, view.depth, view.depth.max())
    jump = cv2.dilate(far, np.ones((3, 3))) / cv2.erode(far, np.ones((3, 3))) - 1
    edge = np.minimum(blur((jump > 0.03).astype(np.float32), max(0.5 * scale, 0.3)) * 2, 1)

    # Grazing angles: 0 up to 60 degrees between ray and normal, 1 at 90.
    ray = unproject_depth(np.ones((h, w)), view.camera)
    facing = np.abs((view.normals * ray).sum(-1)) / np.linalg.norm(ray, axis=-1)
    grazing = np.where(view.mask, np.clip(1 - facing / 0.5, 0, 1), 0)

    # The weights of noise, edges and grazing angles, relative to texture, are chosen by hand.
    noise = 0.7 * smooth_noise(rng, (h, w), 5 * scale)
    noise += 0.4 * smooth_noise(rng, (h, w), 1.5 * scale)
    return texture + noise - 1.5 * edge - 1.5 * grazing


def soft_mask(mask: Bool[np.ndarray, "h w"], rng: np.random.Generator) -> Map:
    """Simulate the probabilities (float32) of a segmentation network: a soft, displaced edge."""
    # Distance from the edge in pixels, positive inside. OpenCV measures from the centre of a pixel
    # to the centre of the nearest pixel of the other kind; the edge is half a pixel nearer.
    inside = mask.astype(np.uint8)
    distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    distance -= cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    distance -= np.where(mask, 0.5, -0.5)
    # The edge wanders by at most 1.5 pixels, smoothly over 4 % of the image's side.
    wander = np.clip(0.8 * smooth_noise(rng, mask.shape, 0.04 * min(mask.shape)), -1.5, 1.5)
    # A logistic function, 0.7 pixels wide; beyond 14 pixels it is 0 or 1.
    return (1 / (1 + np.exp(-np.clip(distance + wander, -14, 14) / 0.7))).astype(np.float32)


def fused_cloud(
    views: Sequence[Rendering],
    depths: Sequence[Map],
    n_points: int,
    rng: np.random.Generator,
) -> list[np.ndarray]:
    """Sample world points of the object from all depth maps, with normals and 8-bit colours."""
    clouds = []
    for view, depth in zip(views, depths):
        known = (depth > 0) & view.mask
        points = view.camera.to_world(unproject_depth(depth, view.camera)[known])
        normals = view.normals[known] @ view.camera.R  # from the camera frame to the world
        clouds.append((points, normals, view.rgb[known]))
    cloud = [np.concatenate(values) for values in zip(*clouds)]
    n = len(cloud[0])
    chosen = np.sort(rng.choice(n, min(n_points, n), replace=False))
    return [values[chosen] for values in cloud]


def record_sequence(
    mesh: TexturedMesh,
    name: str,
    key: int,
    frames: int,
    image_size: int,
) -> tuple[SequenceData, Float[np.ndarray, "4 4"], float]:
    """Return a sequence with the errors of CO3D's data.

    Args:
        mesh: the object, with unit spread.
        name: name of the sequence.
        key: seed of everything random about the sequence.
        frames: number of its frames.
        image_size: shorter image side in pixels.

    Returns:
        The sequence, whose point cloud has unit spread as in CO3D; and the exact pose [R t] and
        scale of the object in it: `world = R @ (scale * canonical) + t`.
    """
    # Views and errors have random numbers of their own: [key, 1] and [key, 2].
    rng = np.random.default_rng([key, 1])
    views, pose = render_sequence(mesh, rng, frames, image_size)
    seconds = np.round(np.arange(frames) * rng.uniform(0.4, 0.9), 3).tolist()

    # The fractions of holes vary from view to view about the fractions of the sequence, by 0.03.
    rng = np.random.default_rng([key, 2])
    holes = np.array([rng.uniform(*_OBJECT_HOLES), rng.uniform(*_FLOOR_HOLES)])
    depths = []
    masks = []
    for view in views:
        object_holes, floor_holes = np.clip(holes + rng.normal(0, 0.03, 2), 0.05, 0.9)
        depths.append(stereo_depth(view, object_holes, floor_holes, rng))
        masks.append(soft_mask(view.mask, rng))
    points, normals, colours = fused_cloud(views, depths, int(rng.integers(5000, 8001)), rng)

    # The unit of length becomes the spread of the point cloud.
    factor = round(1 / axis_deviation(points), 9)
    pose[:3, 3] *= factor
    recorded = [
        Frame(
            view.rgb,
            depth * np.float32(factor),
            mask,
            replace(view.camera, t=view.camera.t * factor),
        )
        for view, depth, mask in zip(views, depths, masks)
    ]
    scores = [round(rng.uniform(*limits), 4) for limits in _SCORES]
    data = SequenceData(name, recorded, seconds, points * factor, colours, normals, *scores)
    return data, pose, factor
