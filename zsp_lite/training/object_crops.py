"""Pictures for the small baselines: object crops of the training categories, with the pose that each shows."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.data.frames import Frame, crop_to_object, resize_frame
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_arrays
from zsp_lite.synthetic.appearance import random_appearance
from zsp_lite.synthetic.assembly import make_shape
from zsp_lite.synthetic.render import Scene, framed_camera, orbit_pose
from zsp_lite.synthetic.training_categories import TRAINING

SIZE = 128
VIEWS = 4
SHARD = 100
_PIXELS = 160


@dataclass(frozen=True)
class ObjectCrops:
    """Crops of n pictures, an object's `VIEWS` pictures one after the other.

    aspect: width / height that a crop had before it was made square.  rotation: from the category's canonical frame to
    the camera.
    """

    rgb: UInt8[np.ndarray, "n size size 3"]
    aspect: Float[np.ndarray, " n"]
    rotation: Float[np.ndarray, "n 3 3"]

    def __len__(self) -> int:
        return len(self.rgb)

    def split(self, held_out: int) -> tuple["ObjectCrops", "ObjectCrops"]:
        """All but the last `held_out` pictures, and these."""
        parts = (self.rgb, self.aspect, self.rotation)
        first, last = [part[:-held_out] for part in parts], [part[-held_out:] for part in parts]
        return ObjectCrops(*first), ObjectCrops(*last)


def render_object(seed: int) -> list[tuple[np.ndarray, float, np.ndarray]]:
    """One object of a random training category from `VIEWS` sides, each in its own light and room, cropped."""
    rng = np.random.default_rng([seed, 2])
    generators = list(TRAINING.values())
    shape = make_shape(generators[rng.integers(len(generators))], [seed, 3])
    scene = Scene(shape)
    found = []
    for view in range(VIEWS):
        azimuth = 2 * np.pi * (view + rng.uniform()) / VIEWS
        R, t = orbit_pose(azimuth, rng.uniform(0.05, 0.8), rng.normal(0, 0.08), rng.uniform(5, 10), scene.centre)
        camera = framed_camera(scene.vertices, R, t, _PIXELS, 1.3)
        image = scene.render(camera, random_appearance(rng), rng)
        crop = crop_to_object(Frame(image.rgb, None, image.mask.astype(np.float32), camera))
        height, width = crop.camera.size
        found.append((resize_frame(crop, (SIZE, SIZE)).rgb, width / height, R))
    return found


def object_crops(
    folder: str | Path, objects: int, seed: int = 0, workers: int = 2, progress=lambda iterable, total: iterable
) -> ObjectCrops:
    """`objects` objects (rounded up to hundreds), rendered into `folder` or found there; about 0.1 s each.

    Raises InputError for fewer than 1.
    """
    if objects < 1:
        raise InputError(f"object_crops: objects is {objects}, expected at least 1")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shard = min(SHARD, objects)
    starts = range(0, objects, shard)
    with ProcessPoolExecutor(workers) as pool:
        paths = list(progress(pool.map(partial(_shard, count=shard, folder=folder, seed=seed), starts), len(starts)))
    columns = []
    for path in paths:
        columns.append(read_arrays(path, ("rgb", "aspect", "rotation"), "crops"))
    return ObjectCrops(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))


def _shard(first: int, count: int, folder: Path, seed: int) -> Path:
    path = folder / f"crops-{seed}-{first:06d}-{first + count:06d}.npz"
    if not path.exists():
        rows = [row for i in range(count) for row in render_object(seed * 10_000_000 + first + i)]
        rgb, aspect, rotation = (np.stack(column) for column in zip(*rows, strict=True))
        unfinished = path.with_suffix(".part.npz")
        np.savez(unfinished, rgb=rgb, aspect=aspect, rotation=rotation)
        unfinished.rename(path)
    return path
