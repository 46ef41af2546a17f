"""A hand-held camera walks around an object: the renderings of one sequence, in a world of its own."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.synthetic.appearance import random_appearance
from zsp_lite.synthetic.assembly import Shape
from zsp_lite.synthetic.primitives import TAU
from zsp_lite.synthetic.render import Rendering, Scene, orbit_pose

_ASPECTS = ((1, 1), (4, 3), (3, 4))  # height : width
_FRAME_MARGIN = 0.03  # the object keeps this share of each image side free at either end


@dataclass(frozen=True, eq=False)
class RenderedSequence:
    """Views of one object and the frame they live in.

    The cameras of `views` map the sequence's world to theirs. `object_pose` (4, 4, rigid) and `scale` place
    the object: `world = R @ (scale * canonical) + t`. `timestamps` are in seconds.
    """

    views: tuple[Rendering, ...]
    timestamps: tuple[float, ...]
    object_pose: Float[np.ndarray, "4 4"]
    scale: float

    def to_world(self, canonical: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """World points of canonical object coordinates."""
        return self.scale * np.asarray(canonical, np.float64) @ self.object_pose[:3, :3].T + self.object_pose[:3, 3]


def image_shape(image_size: int, seed: int | np.random.Generator) -> tuple[int, int]:
    """(height, width) of a square, upright or wide picture whose shorter side is `image_size` pixels."""
    rng = np.random.default_rng(seed)
    tall, wide = _ASPECTS[rng.integers(len(_ASPECTS))]
    unit = image_size / min(tall, wide)
    return round(tall * unit), round(wide * unit)


def handheld_sweep(
    vertices: Float[np.ndarray, "v 3"], seed: int | np.random.Generator, frames: int, size: tuple[int, int]
) -> list[Camera]:
    """`frames` cameras of (height, width) `size` once around the object, in the frame of its vertices.

    The walk starts anywhere and goes either way; height, distance, aim and roll drift and shake. One focal
    length for all, so that the object fills 55 to 75 % of the shorter image side in the typical view and is never cut.
    """
    rng = np.random.default_rng(seed)
    progress = (np.arange(frames) + rng.normal(0, 0.12, frames)) / frames
    phase = rng.uniform(0, TAU, 4)

    def wave(k: int, turns: float) -> np.ndarray:
        return np.sin(turns * TAU * progress + phase[k])

    azimuth = rng.uniform(0, TAU) + rng.choice([-1, 1]) * TAU * progress + 0.06 * wave(0, 2)
    elevation = np.radians(rng.uniform(19, 30) + rng.uniform(3, 9) * wave(1, float(rng.choice([1, 2]))))
    elevation = np.clip(elevation + np.radians(rng.normal(0, 1, frames)), np.radians(10), np.radians(35))
    distance = rng.uniform(6, 9) * (1 + 0.08 * wave(2, 1) + rng.normal(0, 0.01, frames))
    roll = np.radians(3 * wave(3, 1.5) + rng.normal(0, 2, frames))
    aim = (vertices.max(0) + vertices.min(0)) / 2 + rng.normal(0, 0.1, 3) + rng.normal(0, 0.05, (frames, 3))
    poses = [orbit_pose(*view) for view in zip(azimuth, elevation, roll, distance, aim, strict=True)]

    # Corners of the object's image at focal length 1, relative to the optical axis.
    plane = [(v := vertices @ R.T + t)[:, :2] / v[:, 2:] for R, t in poses]
    low, high = np.array([p.min(0) for p in plane]), np.array([p.max(0) for p in plane])
    sides = np.array(size[::-1], float)
    principal_point = np.round(sides / 2 + rng.normal(0, 0.004, 2) * sides, 6)
    room = np.minimum(principal_point, sides - principal_point) - _FRAME_MARGIN * sides
    wanted = rng.uniform(0.55, 0.75) * sides.min() / np.median((high - low).max(1))
    allowed = (room / np.maximum(-low, high).max(0)).min()
    focal = np.full(2, round(min(wanted, allowed), 6))
    return [Camera(R, t, focal, principal_point, size) for R, t in poses]


def render_sequence(shape: Shape, seed: int | np.random.Generator, frames: int, image_size: int) -> RenderedSequence:
    """Render `frames` views around `shape`; the same seed gives the same pictures.

    The shorter image side has `image_size` pixels. The world is the first camera's frame, so where the object
    stands in it, and where it faces, says nothing about its category. The room always has a floor: structure
    from motion needs something that stands still around the object.
    """
    rng = np.random.default_rng(seed)
    scene = Scene(shape)
    look = replace(random_appearance(rng), has_ground=True)
    cameras = handheld_sweep(scene.vertices, rng, frames, image_shape(image_size, rng))
    first = cameras[0].matrix
    to_object = np.linalg.inv(first)
    # The last digits of sines and products depend on the processor: rounded, files are equal on any of them.
    tidy = partial(np.round, decimals=9)
    views = []
    for camera in cameras:
        exposed = replace(look, gain=look.gain * np.exp(rng.normal(0, 0.02)))
        view = scene.render(camera, exposed, rng)
        pose = tidy(camera.matrix @ to_object) + 0.0  # no negative zeros
        views.append(replace(view, camera=replace(camera, R=pose[:3, :3], t=pose[:3, 3])))
    seconds = np.round(np.arange(frames) * rng.uniform(0.4, 0.9), 3)
    return RenderedSequence(tuple(views), tuple(seconds.tolist()), tidy(first), 1.0)


def rescaled(sequence: RenderedSequence, factor: float) -> RenderedSequence:
    """The same sequence with the unit of its world changed: all lengths times `factor`; canonical stays."""
    views = tuple(
        replace(view, depth=view.depth * np.float32(factor), camera=replace(view.camera, t=view.camera.t * factor))
        for view in sequence.views
    )
    pose = sequence.object_pose.copy()
    pose[:3, 3] *= factor
    return replace(sequence, views=views, object_pose=pose, scale=sequence.scale * factor)
