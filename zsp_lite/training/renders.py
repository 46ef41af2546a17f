"""The training set: several views of one object at a time, with their geometry."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.data.cameras import Camera
from zsp_lite.synthetic.sequences import orbit_pose
from zsp_lite.training.instances import make_instance, render_instance

VIEWS = 8  # per object
SIZE = 192  # of a view, pixels
GRID = 48  # points along each side of a view at which geometry is known
PAIR_ANGLES = np.radians((5, 45))  # smallest and largest difference in azimuth of the two views of a pair


@dataclass(frozen=True)
class RenderSet:
    """Views of n objects.

    Attributes:
        rgb: Images.
        surface: Object coordinates of every fourth pixel, NaN on the background. Two views of one object correspond
            where these agree; they have no meaning across objects.
        geometry: Normal in the camera frame, and depth standardised over the object's pixels of the view.
    """

    rgb: UInt8[np.ndarray, "n views size size 3"]
    surface: Float[np.ndarray, "n views grid grid 3"]
    geometry: Float[np.ndarray, "n views grid grid 4"]

    def __len__(self) -> int:
        return len(self.rgb)


def render_set(numbers: Iterable[int]) -> RenderSet:
    """Render the objects of these numbers, about half a second each."""
    return RenderSet(*map(np.stack, zip(*map(render_object, numbers), strict=True)))


def render_object(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render one object; returns its rows of `RenderSet.rgb`, `.surface` and `.geometry`.

    The views are four pairs, a quarter turn apart. The two views of a pair differ by 5 to 45 degrees of azimuth, about
    as much as a reference and the nearest of a few target views, and never more than two views of different pairs.
    Each view shows another instance of the object, with its own proportions, materials and room.
    """
    rng = np.random.default_rng([number, 0])  # [number, 1] draws the object itself
    start = rng.uniform(0, 2 * np.pi)
    views, step = [], SIZE // GRID
    for view in range(VIEWS):
        if view % 2 == 0:
            azimuth, apart = start + (view // 2) * np.pi / 2, rng.uniform(*PAIR_ANGLES)
            elevation = rng.uniform(0, 0.9)
        mesh, coordinates = make_instance(number, rng)
        vertices = mesh.vertices
        R, t = orbit_pose(
            azimuth=azimuth + (view % 2 - 0.5) * apart,
            elevation=np.clip(elevation + rng.normal(0, 0.12), 0.02, 1.1),
            roll=rng.normal(0, 0.1),
            distance=rng.uniform(5, 10),
            target=(vertices.max(0) + vertices.min(0)) / 2,
        )
        camera = framed_camera(vertices, R, t, SIZE, 1.12 * np.exp(rng.normal(0, 0.06)), rng.normal(0, 0.02, 2))
        image = render_instance(number, mesh, coordinates, camera, rng)
        every = (slice(step // 2, None, step),) * 2
        depth, on_object = image.depth[every], image.mask[every]
        spread = max(float(depth[on_object].std()), 1e-6) if on_object.any() else 1.0
        middle = depth[on_object].mean() if on_object.any() else 0.0
        relative = np.where(on_object, (depth - middle) / spread, 0)
        maps = image.canonical[every], np.dstack([image.normals[every], relative])
        views.append((image.rgb, *(one.astype(np.float16) for one in maps)))
    return tuple(map(np.stack, zip(*views, strict=True)))


def framed_camera(vertices: Float[np.ndarray, "v 3"], R: np.ndarray, t: np.ndarray, size: int, margin: float = 1.1,
                  shift: Float[np.ndarray, "2"] | None = None) -> Camera:  # fmt: skip
    """Return a camera at pose R, t with a square image of `size` pixels that contains all vertices.

    The bounding square of the object is enlarged by the factor `margin` and shifted by `shift`, a fraction of its
    width.
    """
    in_camera = vertices @ R.T + t
    plane = in_camera[:, :2] / in_camera[:, 2:]
    low, high = plane.min(0), plane.max(0)
    width = (high - low).max() * margin
    centre = (low + high) / 2 + (0 if shift is None else np.asarray(shift) * width)
    focal_length = size / width
    return Camera(R, t, np.full(2, focal_length), size / 2 - centre * focal_length, (size, size))
