"""The training set: objects of no category, each with several views and their geometry.

Each view shows another instance of the object, with its own proportions, materials and room: the
differences between the instances are what the features are to ignore. Objects have their front at
+x, left at +y, top at +z.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.course.synthetic.assembly import Draw, Parts, make_shape, pair, random_materials
from zsp_lite.course.synthetic.meshes import TexturedMesh
from zsp_lite.course.synthetic.primitives import (
    TAU,
    Coordinates,
    Mesh,
    Vertices,
    box,
    box_centre,
    capsule,
    cylinder,
    ellipsoid,
    extrusion,
    point,
    rotation,
    torus,
)
from zsp_lite.course.synthetic.raytracing import MeshScene, Rendering
from zsp_lite.course.synthetic.room import Room, random_room
from zsp_lite.course.synthetic.sequences import image_box, orbit_pose
from zsp_lite.data.cameras import Camera

VIEWS = 8  # per object
SIZE = 192  # side of a view, pixels
GRID = 48  # points along each side of a view at which geometry is known
# Smallest and largest difference in azimuth of the two views of a pair. A reference and the nearest
# of a few target views differ by about as much; views of different pairs differ by more.
PAIR_ANGLES = np.radians((5, 45))
# A room takes five times as long as a view: SHARING consecutive objects share ROOMS rooms.
ROOMS = 8
SHARING = 100


@dataclass(frozen=True)
class RenderSet:
    """Views of n objects, with the geometry at every fourth pixel."""

    rgb: UInt8[np.ndarray, "n views size size 3"]
    # Object coordinates, NaN on the background. Two views of one object correspond where their
    # coordinates agree; the coordinates of different objects have no relation.
    surface: Float[np.ndarray, "n views grid grid 3"]
    # normal in the camera frame, depth standardised over the object
    geometry: Float[np.ndarray, "n views grid grid 4"]


def render_set(numbers: Iterable[int]) -> RenderSet:
    """Render the objects of these numbers, about half a second each."""
    objects = [render_object(number) for number in numbers]
    return RenderSet(*map(np.stack, zip(*objects)))


def render_object(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render one object in four pairs of views, a quarter turn apart.

    Returns its images, surface points and geometry, as of a `RenderSet`.
    """
    rng = np.random.default_rng([number, 0])  # [number, 1] draws the object itself
    shape = make_shape(build_random_object, [number, 1])
    start = rng.uniform(0, TAU)
    views = []
    for view in range(VIEWS):
        # The two views of a pair share their middle and their angle. All angles are in radians.
        if view % 2 == 0:
            azimuth = start + (view // 2) * TAU / 4
            apart = rng.uniform(*PAIR_ANGLES)
            elevation = rng.uniform(0, 0.9)
        # The instance of the object in this view, and its camera.
        instance = make_shape(build_random_object, [number, 1], variation=rng)
        mesh = replace(instance, materials=random_materials(rng))
        R, t = orbit_pose(
            azimuth=azimuth + (view % 2 - 0.5) * apart,
            elevation=np.clip(elevation + rng.normal(0, 0.12), 0.02, 1.1),
            roll=rng.normal(0, 0.1),
            distance=rng.uniform(5, 10),
            target=box_centre(mesh.vertices),
        )
        margin = 1.12 * np.exp(rng.normal(0, 0.06))
        camera = framed_camera(mesh.vertices, R, t, SIZE, margin, shift=rng.normal(0, 0.02, 2))
        image = render_instance(number, mesh, shape.vertices, camera, rng)
        views.append((image.rgb, *_geometry(image)))
    return tuple(map(np.stack, zip(*views)))


def _geometry(image: Rendering) -> tuple[np.ndarray, np.ndarray]:
    """Return surface (grid, grid, 3) and geometry (grid, grid, 4) of a view."""
    step = SIZE // GRID
    sampled = slice(step // 2, None, step)  # of rows and of columns
    depth = image.depth[sampled, sampled]
    on_object = image.mask[sampled, sampled]
    # The distance of the object does not matter: its depth is standardised.
    relative = np.zeros_like(depth)
    of_object = depth[on_object]
    relative[on_object] = (of_object - of_object.mean()) / max(of_object.std(), 1e-6)
    geometry = np.dstack([image.normals[sampled, sampled], relative])
    surface = image.canonical[sampled, sampled]
    return surface.astype(np.float16), geometry.astype(np.float16)


def framed_camera(
    vertices: Vertices,
    R: np.ndarray,
    t: np.ndarray,
    size: int,
    margin: float = 1.1,
    shift: Coordinates = (0, 0),
) -> Camera:
    """Return a camera whose image frames an object.

    Args:
        vertices: of the object.
        R: rotation of the camera, world to camera.
        t: its translation.
        size: side of the square image in pixels.
        margin: that side, relative to the longer side of the object's image.
        shift: of the middle of the image (2,), as a fraction of its side.
    """
    low, high = image_box(vertices, R, t)
    width = (high - low).max() * margin  # of the image, at focal length 1
    centre = (low + high) / 2 + np.multiply(shift, width)
    focal_length = size / width
    return Camera(R, t, np.full(2, focal_length), size / 2 - centre * focal_length, (size, size))


def render_instance(
    number: int,
    mesh: TexturedMesh,
    coordinates: Vertices,
    camera: Camera,
    rng: np.random.Generator,
) -> Rendering:
    """Render an instance of object `number`, with the object's coordinates, in a random room."""
    # The object and the camera turn together in the room.
    turn = rotation("z", rng.uniform(0, TAU))
    normals = (mesh.normals @ turn.T).astype(np.float32)
    turned = replace(mesh, vertices=mesh.vertices @ turn.T, normals=normals)
    room = _room(number // SHARING * ROOMS + int(rng.integers(ROOMS)))
    scene = MeshScene(turned, room, rng, coordinates, samples=1)  # one ray per pixel
    view = scene.render(replace(camera, R=camera.R @ turn.T))
    return replace(view, camera=camera)


@lru_cache(maxsize=ROOMS)
def _room(index: int) -> Room:
    """Return a room in half the resolution, to save memory."""
    room = random_room(index)
    halves = [
        cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        for image in room.images
    ]
    return replace(room, images=tuple(halves))


def build_random_object(draw: Draw) -> Parts:
    """Build a symmetric tree of 5 to 10 random parts, each attached to an earlier part and of one
    of the first five materials."""
    # The nodes of the tree: centre and size of each part.
    body = point(draw(0.5, 1.3), draw(0.4, 1.0), draw(0.4, 1.2))
    nodes = [(np.zeros(3), body)]
    yield _random_solid(draw, body), draw.choice(5)
    for _ in range(4 + draw.choice(6)):
        parent, parent_size = draw.pick(*nodes)
        direction = draw.rng.normal(size=3)
        size = draw.rng.uniform(0.12, 0.8, 3) * draw(0.5, 1.0)
        # The centre is on a box about the parent, so that the two parts overlap.
        centre = parent + direction / np.abs(direction).max() * (parent_size * 0.4 + size * 0.3)
        mesh = _random_solid(draw, size)
        # A part is on the left with its mirror image on the right, or in the middle.
        mirror = draw.chance(0.55)
        centre[1] = abs(centre[1]) if mirror else 0
        if mirror and draw.chance(0.5):
            mesh = mesh.rotated("z", draw(-0.7, 0.7)).rotated("x", draw(-0.7, 0.7))
        yield from pair(mesh.translated(centre), draw.choice(5), mirror)
        nodes.append((centre, size))


def _random_solid(draw: Draw, size: np.ndarray) -> Mesh:
    """Return a solid of about the given size (3,), sometimes rotated about the axis to the left."""
    # The outline of the slab is an irregular pentagon about the origin.
    angle = np.arange(5) * TAU / 5 + draw.rng.uniform(0, TAU / 5, 5)
    outline = np.stack([np.cos(angle), np.sin(angle)], 1) * draw.rng.uniform(0.3, 0.6, (5, 1))
    solids = (
        box(1),
        ellipsoid(0.55),
        cylinder(0.5, 0.5 * draw(0.3, 1), 1.0),
        capsule((-0.25, 0, 0), (0.25, 0, 0), 0.25).scaled((1, 2, 2)),
        torus(0.36, 0.12, draw.pick(*np.eye(3))),
        extrusion(outline, draw(0.1, 0.9), draw.pick("xz", "xy", "yz")),
    )
    mesh = draw.pick(*solids).scaled(size)
    return mesh.rotated("y", draw(-0.8, 0.8)) if draw.chance(0.4) else mesh
