"""Rendered sequences: a hand-held camera moves once around an object."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.primitives import TAU
from zsp_lite.synthetic.raytracing import MeshScene, Rendering
from zsp_lite.synthetic.room import RoomLight, random_room

_ASPECTS = ((1, 1), (4, 3), (3, 4))  # height : width
HEIGHTS = (19.0, 30.0)  # lowest and highest mean elevation of a sequence's cameras above the object, degrees
_FRAME_MARGIN = 0.03  # free border at each image side, as a fraction of that side


@dataclass(frozen=True, eq=False)
class RenderedSequence:
    """Exact views of one object, and the pose of the object in the world of the sequence."""

    views: tuple[Rendering, ...]  # their cameras map from the world
    timestamps: tuple[float, ...]  # seconds
    object_pose: Float[np.ndarray, "4 4"]  # rigid transform [R t]: `world = R @ (scale * canonical) + t`
    scale: float


def orbit_pose(azimuth: float, elevation: float, roll: float, distance: float, target) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and translation (3,), world to camera, of a camera that looks at `target` (3,).

    Angles are in radians: azimuth about z, 0 at +x; elevation above the horizontal plane; roll about the optical axis.
    """
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    forward = -away
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    c, s = np.cos(roll), np.sin(roll)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.stack([right, np.cross(forward, right), forward])
    return R, -R @ (np.asarray(target, float) + away * distance)


def handheld_sweep(
    vertices: Float[np.ndarray, "v 3"],
    rng: np.random.Generator,
    frames: int,
    size: tuple[int, int],
    heights: tuple[float, float] = HEIGHTS,
) -> list[Camera]:
    """Draw the cameras, in object coordinates, of a hand-held camera that moves once around the object.

    All share one focal length: the object fills 55 to 75 % of the shorter image side in the median view and is inside
    the image in all views.
    """
    progress = (np.arange(frames) + rng.normal(0, 0.12, frames)) / frames
    phase = rng.uniform(0, TAU, 4)

    def wave(k: int, turns: float) -> np.ndarray:
        return np.sin(turns * TAU * progress + phase[k])

    azimuth = rng.uniform(0, TAU) + rng.choice([-1, 1]) * TAU * progress + 0.06 * wave(0, 2)
    elevation = rng.uniform(*heights) + rng.uniform(3, 9) * wave(1, float(rng.choice([1, 2])))
    elevation = np.radians((elevation + rng.normal(0, 1, frames)).clip(heights[0] - 9, heights[1] + 5))
    distance = rng.uniform(6, 9) * (1 + 0.08 * wave(2, 1) + rng.normal(0, 0.01, frames))
    roll = np.radians(3 * wave(3, 1.5) + rng.normal(0, 2, frames))
    aim = (vertices.max(0) + vertices.min(0)) / 2 + rng.normal(0, 0.1, 3) + rng.normal(0, 0.05, (frames, 3))
    poses = [orbit_pose(*view) for view in zip(azimuth, elevation, roll, distance, aim, strict=True)]

    # Bounding box of the object's image at focal length 1, relative to the optical axis.
    plane = [(v := vertices @ R.T + t)[:, :2] / v[:, 2:] for R, t in poses]
    low, high = np.array([p.min(0) for p in plane]), np.array([p.max(0) for p in plane])
    sides = np.array(size[::-1], float)
    principal_point = np.round(sides / 2 + rng.normal(0, 0.004, 2) * sides, 6)
    room = np.minimum(principal_point, sides - principal_point) - _FRAME_MARGIN * sides
    wanted = rng.uniform(0.55, 0.75) * sides.min() / np.median((high - low).max(1))
    allowed = (room / np.maximum(-low, high).max(0)).min()
    focal_length = np.full(2, round(min(wanted, allowed), 6))
    return [Camera(R, t, focal_length, principal_point, size) for R, t in poses]


def render_sequence(
    mesh: TexturedMesh, rng: np.random.Generator, frames: int, image_size: int, heights: tuple[float, float] = HEIGHTS
) -> RenderedSequence:
    """Render views around an object in a random room; `image_size` is the shorter image side.

    The world is the frame of the first camera, so that the pose of the object in it does not depend on the category.
    """
    tall, wide = _ASPECTS[rng.integers(len(_ASPECTS))]
    size = round(tall / min(tall, wide) * image_size), round(wide / min(tall, wide) * image_size)
    cameras = handheld_sweep(mesh.vertices, rng, frames, size, heights)
    scene = MeshScene(mesh, RoomLight(random_room(rng)), rng)
    first = cameras[0].matrix
    to_object = np.linalg.inv(first)
    # The last digits of sines and products depend on the processor; rounding makes the files equal everywhere.
    rounded = partial(np.round, decimals=9)
    views = []
    for camera in cameras:
        view = scene.render(camera)
        pose = rounded(view.camera.matrix @ to_object) + 0.0  # no negative zeros
        views.append(replace(view, camera=replace(view.camera, R=pose[:3, :3], t=pose[:3, 3])))
    seconds = np.round(np.arange(frames) * rng.uniform(0.4, 0.9), 3)
    return RenderedSequence(tuple(views), tuple(seconds.tolist()), rounded(first), 1.0)


def rescaled(sequence: RenderedSequence, factor: float) -> RenderedSequence:
    """Multiply all lengths of the world by `factor`; canonical coordinates stay."""
    views = tuple(
        replace(view, depth=view.depth * np.float32(factor), camera=replace(view.camera, t=view.camera.t * factor))
        for view in sequence.views
    )
    pose = sequence.object_pose.copy()
    pose[:3, 3] *= factor
    return replace(sequence, views=views, object_pose=pose, scale=sequence.scale * factor)
