"""The instances of a procedural object that its training views show, each rendered in a room.

The differences between the instances are what the features are to ignore.
"""

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.synthetic.assembly import Shape, deform, make_shape, make_variant
from zsp_lite.synthetic.lighting import RoomLight
from zsp_lite.synthetic.materials import random_materials, with_materials
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.raytracing import FASTEST, MeshScene
from zsp_lite.synthetic.render import Rendering
from zsp_lite.synthetic.room import random_room
from zsp_lite.synthetic.training_categories import TRAINING, random_assembly

PROPORTIONS = 0.3  # amount by which the proportions of the instances vary (see `make_variant`)
ROOMS, SHARING = 8, 100  # so many rooms for so many consecutive objects: a room takes five times as long as a view


class Build:
    """A procedural object of a random training category, or, as half of them are, a random assembly of parts."""

    def __init__(self, number: int, rng: np.random.Generator):
        generators = list(TRAINING.values())
        self.generator = generators[rng.integers(len(generators))] if rng.random() < 0.5 else random_assembly
        self.seed, self.rng = [number, 1], rng
        self.shape = make_shape(self.generator, self.seed)

    def instance(self) -> tuple[TexturedMesh, Float[np.ndarray, "v 3"]]:
        """Return a mesh with its own proportions, deformation and materials, and its vertices' object coordinates."""
        sibling = make_variant(self.generator, self.seed, self.rng, PROPORTIONS)
        vertices = deform(sibling, self.rng, 1.0)
        shape = _without_some_parts(self.shape, self.rng)
        return with_materials(shape, random_materials(self.rng), vertices), shape.vertices


def render_instance(
    number: int, mesh: TexturedMesh, coordinates: Float[np.ndarray, "v 3"], camera: Camera, rng: np.random.Generator
) -> Rendering:
    """Render an instance of object `number` with few rays in a random room, which is turned at random."""
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = replace(mesh, vertices=mesh.vertices @ turn.T, normals=(mesh.normals @ turn.T).astype(np.float32))
    room = _room(number // SHARING * ROOMS + int(rng.integers(ROOMS)))
    scene = MeshScene(turned, room, FASTEST, coordinates=coordinates)
    view = scene.render(replace(camera, R=camera.R @ turn.T), rng)
    return replace(view, camera=camera)


def _without_some_parts(shape: Shape, rng: np.random.Generator) -> Shape:
    """Drop small parts of a shape at random; the vertices stay."""
    part = shape.part[shape.faces[:, 0]]
    size = np.bincount(part)
    gone = (rng.random(len(size)) < 0.06) & (size < 0.3 * len(part))
    kept = ~gone[part]
    return replace(shape, faces=shape.faces[kept], material=shape.material[kept])


@lru_cache(maxsize=ROOMS)
def _room(index: int) -> RoomLight:
    """Return a room in half the resolution, to save memory."""
    room = random_room(index)
    halves = (cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in room.images)
    return RoomLight(replace(room, images=tuple(halves)))
