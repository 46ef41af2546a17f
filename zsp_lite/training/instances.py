"""The instances of a random object that its training views show, each rendered in a room.

The differences between the instances are what the features are to ignore.
"""

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.synthetic.assembly import make_shape
from zsp_lite.synthetic.materials import random_materials, with_materials
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.raytracing import MeshScene, Rendering
from zsp_lite.synthetic.room import RoomLight, random_room
from zsp_lite.training.random_object import build_random_object

ROOMS, SHARING = 8, 100  # so many rooms for so many consecutive objects: a room takes five times as long as a view


def make_instance(number: int, rng: np.random.Generator) -> tuple[TexturedMesh, Float[np.ndarray, "v 3"]]:
    """Return a mesh of object `number` with its own proportions and materials, and its vertices' object coordinates.

    The object coordinates are the same for all instances of an object.
    """
    shape = make_shape(build_random_object, [number, 1])
    instance = make_shape(build_random_object, [number, 1], variation=rng)
    return with_materials(instance, random_materials(rng)), shape.vertices


def render_instance(
    number: int, mesh: TexturedMesh, coordinates: Float[np.ndarray, "v 3"], camera: Camera, rng: np.random.Generator
) -> Rendering:
    """Render an instance of object `number` in a random room, which is turned at random."""
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = replace(mesh, vertices=mesh.vertices @ turn.T, normals=(mesh.normals @ turn.T).astype(np.float32))
    room = _room(number // SHARING * ROOMS + int(rng.integers(ROOMS)))
    scene = MeshScene(turned, room, rng, coordinates, samples=1)
    view = scene.render(replace(camera, R=camera.R @ turn.T))
    return replace(view, camera=camera)


@lru_cache(maxsize=ROOMS)
def _room(index: int) -> RoomLight:
    """Return a room in half the resolution, to save memory."""
    room = random_room(index)
    halves = (cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in room.images)
    return RoomLight(replace(room, images=tuple(halves)))
