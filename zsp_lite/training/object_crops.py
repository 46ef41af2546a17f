"""Training set of the small baseline networks: object crops of the training categories with their camera rotations."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.data.frames import Frame, crop_to_object, resize_frame
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_arrays
from zsp_lite.synthetic.assembly import make_shape
from zsp_lite.synthetic.materials import random_materials, with_materials
from zsp_lite.synthetic.render import framed_camera, orbit_pose
from zsp_lite.synthetic.training_categories import TRAINING
from zsp_lite.training.renders import SEED_STRIDE
from zsp_lite.training.shards import render_shards
from zsp_lite.training.views import render_view

SIZE = 128  # of a crop, pixels
VIEWS = 4  # per object
SHARD = 100  # objects per file
ARRAYS = ("rgb", "aspect", "rotation")  # of a file
_RENDER_SIZE = 160


@dataclass(frozen=True)
class ObjectCrops:
    """Crops of n images, the `VIEWS` images of an object one after the other.

    Attributes:
        rgb: Crops, resized to squares.
        aspect: Width divided by height of each crop before resizing.
        rotation: Rotation from the category's canonical frame to the camera.
    """

    rgb: UInt8[np.ndarray, "n size size 3"]
    aspect: Float[np.ndarray, " n"]
    rotation: Float[np.ndarray, "n 3 3"]

    def __len__(self) -> int:
        return len(self.rgb)

    def split(self, held_out: int) -> tuple["ObjectCrops", "ObjectCrops"]:
        """Return all but the last `held_out` images, and these."""
        parts = (self.rgb, self.aspect, self.rotation)
        first, last = [part[:-held_out] for part in parts], [part[-held_out:] for part in parts]
        return ObjectCrops(*first), ObjectCrops(*last)


def render_object(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render one object of a random training category from `VIEWS` sides, each view with its own materials and room.

    Args:
        seed: Number of the object.

    Returns:
        The object's rows of `ObjectCrops.rgb`, `.aspect` and `.rotation`.
    """
    rng = np.random.default_rng([seed, 2])
    generators = list(TRAINING.values())
    shape = make_shape(generators[rng.integers(len(generators))], [seed, 3])
    rows = []
    for view in range(VIEWS):
        azimuth = 2 * np.pi * (view + rng.uniform()) / VIEWS
        R, t = orbit_pose(azimuth, rng.uniform(0.05, 0.8), rng.normal(0, 0.08), rng.uniform(5, 10), np.zeros(3))
        camera = framed_camera(shape.vertices, R, t, _RENDER_SIZE, 1.3)
        mesh = with_materials(shape, random_materials(rng))
        image = render_view(seed, mesh, shape.vertices, camera, rng)
        crop = crop_to_object(Frame(image.rgb, None, image.mask.astype(np.float32), camera))
        height, width = crop.camera.size
        rows.append((resize_frame(crop, (SIZE, SIZE)).rgb, width / height, R))
    rgb, aspect, rotation = zip(*rows, strict=True)
    return np.stack(rgb), np.array(aspect), np.stack(rotation)


def object_crops(folder: str | Path, objects: int, seed: int = 0, workers: int = 2) -> ObjectCrops:
    """Render crops into a folder, about 0.1 s per object. Existing shards are reused.

    Args:
        folder: Folder of the shards.
        objects: Number of objects, rounded up to whole shards of 100.
        seed: Seed of the set.
        workers: Number of processes (see `render_shards`).

    Raises:
        InputError: For fewer than one object, or if a shard is damaged.
    """
    if objects < 1:
        raise InputError(f"object_crops: objects is {objects}, expected at least 1")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shard = min(SHARD, objects)
    shards = {}
    for start in range(0, objects, shard):
        path = folder / f"crops-{seed}-{start:06d}-{start + shard:06d}.npz"
        shards[path] = range(seed * SEED_STRIDE + start, seed * SEED_STRIDE + start + shard)
    render_shards(render_object, shards, ARRAYS, workers)
    columns = zip(*(read_arrays(path, ARRAYS, "crops") for path in shards), strict=True)
    return ObjectCrops(*(np.concatenate([rows for shard in column for rows in shard]) for column in columns))
