"""The training set: several views of one object at a time, with what a renderer knows about each."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.synthetic.appearance import random_appearance
from zsp_lite.synthetic.assembly import Shape, deform, make_shape, make_sibling
from zsp_lite.synthetic.render import Scene, framed_camera, orbit_pose
from zsp_lite.synthetic.training_categories import TRAINING, random_assembly

VIEWS = 8
SIZE = 192
GRID = 48
SHARD = 200


@dataclass(frozen=True)
class RenderSet:
    """Views of n objects.

    `surface` holds the object coordinates of every fourth pixel, NaN on the background: two views of ONE object
    correspond where these agree. They are never compared between objects. `geometry` holds the normal in the camera
    frame and the depth, standardised over the object's pixels of that view.
    """

    rgb: UInt8[np.ndarray, "n views size size 3"]
    surface: Float[np.ndarray, "n views grid grid 3"]
    geometry: Float[np.ndarray, "n views grid grid 4"]

    def __len__(self) -> int:
        return len(self.rgb)


def render_object(seed: int, generators=None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render one training object; returns its rows of `RenderSet.rgb`, `.surface` and `.geometry`.

    Half of the objects come from the named training categories, half are random assemblies. Views come in four pairs,
    a quarter turn apart: the two of a pair look from nearly the same side, and every side's opposite is there too.
    Every view shows a copy with other proportions (`make_sibling`), gently deformed, now and then without one of its
    parts, under its own materials, light and room, so that only what all views share, the object's build, can tell
    one place from another.
    """
    rng = np.random.default_rng([seed, 0])
    generators = list(TRAINING.values()) if generators is None else generators
    generator = generators[rng.integers(len(generators))] if rng.random() < 0.5 else random_assembly
    shape = make_shape(generator, [seed, 1])
    start = rng.uniform(0, 2 * np.pi)
    rgb = np.empty((VIEWS, SIZE, SIZE, 3), np.uint8)
    surface = np.empty((VIEWS, GRID, GRID, 3), np.float16)
    geometry = np.empty((VIEWS, GRID, GRID, 4), np.float16)
    step = SIZE // GRID
    for view in range(VIEWS):
        if view % 2 == 0:
            azimuth = start + (view // 2) * np.pi / 2 + rng.normal(0, 0.2)
            elevation = rng.uniform(-0.05, 0.9)
        scene = _altered(shape, make_sibling(generator, [seed, 1], rng), rng)
        R, t = orbit_pose(
            azimuth + rng.normal(0, 0.2), np.clip(elevation + rng.normal(0, 0.12), -0.1, 1.1), rng.normal(0, 0.1),
            rng.uniform(5, 10), scene.centre,
        )  # fmt: skip
        camera = framed_camera(scene.vertices, R, t, SIZE, 1.12 * np.exp(rng.normal(0, 0.06)), rng.normal(0, 0.02, 2))
        image = scene.render(camera, random_appearance(rng), rng, shadows=rng.random() < 0.6)
        every = (slice(step // 2, None, step),) * 2
        depth, mask = image.depth[every], image.mask[every]
        spread = max(float(depth[mask].std()), 1e-6)
        rgb[view], surface[view] = image.rgb, image.canonical[every]
        geometry[view, ..., :3] = image.normals[every]
        geometry[view, ..., 3] = np.where(mask, (depth - depth[mask].mean()) / spread, 0)
    return rgb, surface, geometry


def _altered(shape: Shape, sibling: Shape, rng: np.random.Generator) -> Scene:
    """The scene of a deformed copy of `sibling` whose pixels keep the surface coordinates of `shape`."""
    same_build = np.array_equal(shape.faces, sibling.faces)
    vertices = deform(sibling if same_build else shape, rng)
    part = shape.part[shape.faces[:, 0]]
    size = np.bincount(part)
    gone = (rng.random(len(size)) < 0.06) & (size < 0.3 * len(part))
    kept = ~gone[part]
    return Scene(replace(shape, faces=shape.faces[kept], material=shape.material[kept]), vertices)


def _render_shard(first: int, count: int, folder: Path, seed: int) -> Path:
    path = folder / f"objects-{seed}-{first:06d}-{first + count:06d}.npz"
    if not path.exists():
        rows = [render_object(seed * 10_000_000 + first + i) for i in range(count)]
        rgb, surface, geometry = (np.stack(column) for column in zip(*rows, strict=True))
        unfinished = path.with_suffix(".part.npz")
        np.savez(unfinished, rgb=rgb, surface=surface, geometry=geometry)
        unfinished.rename(path)
    return path


def render_set(folder: Path, objects: int, seed: int = 0, shard: int = SHARD, workers: int = 2,
               progress=lambda iterable, total: iterable) -> list[Path]:  # fmt: skip
    """Render `objects` objects (rounded up to whole shards) into `folder`, or reuse what is there.

    Returns the shard paths; a killed run continues with the first missing shard. About 1.1 MB per object.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    starts = range(0, objects, shard)
    with ProcessPoolExecutor(workers) as pool:
        paths = pool.map(partial(_render_shard, count=shard, folder=folder, seed=seed), starts)
        return list(progress(paths, len(starts)))


def load_render_set(paths: list[Path]) -> RenderSet:
    """Read shards into memory, one at a time: joining them afterwards would need all of it twice."""
    joined: list[np.ndarray] = []
    for index, path in enumerate(paths):
        with np.load(path) as file:
            shard = [file[name] for name in ("rgb", "surface", "geometry")]
        count = len(shard[0])  # all shards have as many objects
        if not joined:
            joined = [np.empty((count * len(paths), *part.shape[1:]), part.dtype) for part in shard]
        for whole, part in zip(joined, shard, strict=True):
            whole[index * count : (index + 1) * count] = part
    return RenderSet(*joined)


def training_and_held_out(
    folder: Path, objects: int, seed: int = 0, progress=lambda iterable, total: iterable
) -> tuple[RenderSet, RenderSet]:
    """All shards but the last to train on, and the last one, an eighth of few objects, which no step sees."""
    shards = render_set(folder, objects, seed, min(SHARD, max(1, objects // 8)), progress=progress)
    return load_render_set(shards[:-1]), load_render_set(shards[-1:])
