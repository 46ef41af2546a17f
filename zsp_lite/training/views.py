"""Single views of objects for training, rendered with few rays."""

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.synthetic.lighting import RoomLight
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.raytracing import FASTEST, MeshScene
from zsp_lite.synthetic.render import Rendering
from zsp_lite.synthetic.room import random_room

ROOMS, SHARING = 8, 100  # so many rooms for so many consecutive objects: a room takes five times as long as a view


def render_view(
    number: int,
    mesh: TexturedMesh,
    coordinates: Float[np.ndarray, "v 3"],
    camera: Camera,
    rng: np.random.Generator,
) -> Rendering:
    """Render one view of an object in a random room, which is turned at random.

    Args:
        number: Number of the object. Objects with neighbouring numbers share their rooms.
        mesh: Object.
        coordinates: Object coordinates of its vertices.
        camera: Camera; maps from the coordinates of the mesh.
        rng: Source of the draws.
    """
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = replace(mesh, vertices=mesh.vertices @ turn.T, normals=(mesh.normals @ turn.T).astype(np.float32))
    room = _room(number // SHARING * ROOMS + int(rng.integers(ROOMS)))
    scene = MeshScene(turned, room, FASTEST, coordinates=coordinates)
    view = scene.render(replace(camera, R=camera.R @ turn.T), rng)
    return replace(view, camera=camera)


@lru_cache(maxsize=ROOMS)
def _room(index: int) -> RoomLight:
    """Return a room in half the resolution, to save memory."""
    room = random_room(index)
    halves = (cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in room.images)
    return RoomLight(replace(room, images=tuple(halves)))
