"""The training set: several views of one build at a time, with what a renderer knows about each."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.errors import InputError
from zsp_lite.io.files import read_arrays
from zsp_lite.synthetic.appearance import random_appearance
from zsp_lite.synthetic.assembly import Shape, deform, make_shape, make_variant
from zsp_lite.synthetic.render import Scene, framed_camera, orbit_pose
from zsp_lite.synthetic.training_categories import TRAINING, random_assembly

VIEWS = 8
SIZE = 192
GRID = 48
SHARD = 200
APART = np.radians((5, 45))  # in azimuth, of the two views of a pair: never farther than views of two pairs
PROPORTIONS, DEFORMATION = 0.3, 1.0  # how far the views of one build differ; see `render_object`
HELD_OUT = 9_000_000  # the number of the first object that is never trained on


@dataclass(frozen=True)
class RenderSet:
    """Views of n builds.

    `surface` holds the object coordinates of every fourth pixel, NaN on the background: two views of ONE build
    correspond where these agree. They are never compared between builds. `geometry` holds the normal in the camera
    frame and the depth, standardised over the object's pixels of that view.
    """

    rgb: UInt8[np.ndarray, "n views size size 3"]
    surface: Float[np.ndarray, "n views grid grid 3"]
    geometry: Float[np.ndarray, "n views grid grid 4"]

    def __len__(self) -> int:
        return len(self.rgb)


def render_object(
    seed: int, generators=None, proportions: float = PROPORTIONS, deformation: float = DEFORMATION
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render one build; returns its rows of `RenderSet.rgb`, `.surface` and `.geometry`.

    Half of the builds come from the named training categories, half are random assemblies. Views come in four pairs,
    a quarter turn from one another: the two of a pair are 5 to 45 degrees of azimuth apart, about as far as a reference
    is from the nearest of a few target views, and never farther than two of different pairs; every side's opposite is
    there too.
    Every view shows a copy with other proportions (`make_variant`, by that amount), gently deformed (`deform`), now and
    then without one of its parts, under its own materials, light and room, so that only what all views share, the
    object's build, can tell one place from another.
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
            azimuth, apart = start + (view // 2) * np.pi / 2, rng.uniform(*APART)
            elevation = rng.uniform(-0.05, 0.9)
        scene = _altered(shape, make_variant(generator, [seed, 1], rng, proportions), rng, deformation)
        R, t = orbit_pose(
            azimuth + (view % 2 - 0.5) * apart, np.clip(elevation + rng.normal(0, 0.12), -0.1, 1.1), rng.normal(0, 0.1),
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


def _altered(shape: Shape, sibling: Shape, rng: np.random.Generator, deformation: float) -> Scene:
    """The scene of a deformed copy of `sibling` whose pixels keep the surface coordinates of `shape`."""
    if not np.array_equal(shape.faces, sibling.faces):
        raise ValueError("a sibling has other parts than its object: its generator chose them by a proportion")
    vertices = deform(sibling, rng, deformation)
    part = shape.part[shape.faces[:, 0]]
    size = np.bincount(part)
    gone = (rng.random(len(size)) < 0.06) & (size < 0.3 * len(part))
    kept = ~gone[part]
    return Scene(replace(shape, faces=shape.faces[kept], material=shape.material[kept]), vertices)


def _render_shard(first: int, count: int, folder: Path, seed: int, proportions: float, deformation: float) -> Path:
    # The name says all that decides the content: what was rendered in another way is not taken for it.
    name = f"objects-{seed}-{first:06d}-{first + count:06d}-{proportions:g}-{deformation:g}.npz"
    path = folder / name
    if not path.exists():
        numbers = range(seed * 10_000_000 + first, seed * 10_000_000 + first + count)
        rows = [render_object(number, None, proportions, deformation) for number in numbers]
        rgb, surface, geometry = (np.stack(column) for column in zip(*rows, strict=True))
        unfinished = path.with_suffix(".part.npz")
        np.savez(unfinished, rgb=rgb, surface=surface, geometry=geometry)
        unfinished.rename(path)
    return path


def render_set(folder: Path, objects: int, seed: int = 0, shard: int = SHARD, workers: int = 2,
               progress=lambda iterable, total: iterable, first: int = 0,
               proportions: float = PROPORTIONS, deformation: float = DEFORMATION) -> list[Path]:  # fmt: skip
    """Render `objects` objects (rounded up to whole shards), from number `first` on, into `folder`, or reuse them.

    Returns the shard paths; a killed run continues with the first missing shard. About 1.1 MB per object.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    starts = range(first, first + objects, shard)
    with ProcessPoolExecutor(workers) as pool:
        how = dict(count=shard, folder=folder, seed=seed, proportions=proportions, deformation=deformation)
        paths = pool.map(partial(_render_shard, **how), starts)
        return list(progress(paths, len(starts)))


def load_render_set(paths: list[Path]) -> RenderSet:
    """Read shards into memory, one at a time: joining them afterwards would need all of it twice.

    Raises InputError where a file is no shard, or one of other sizes.
    """
    joined: list[np.ndarray] = []
    for index, path in enumerate(paths):
        shard = read_arrays(path, ("rgb", "surface", "geometry"), "training renders")
        count = len(shard[0])  # all shards have as many objects
        expected = (count, VIEWS, SIZE, SIZE, 3), (count, VIEWS, GRID, GRID, 3), (count, VIEWS, GRID, GRID, 4)
        for name, part, shape in zip(("rgb", "surface", "geometry"), shard, expected, strict=True):
            if part.shape != shape:
                raise InputError(f"{path}: {name} has shape {part.shape}, expected {shape}; remove it to render anew")
        if not joined:
            joined = [np.empty((count * len(paths), *part.shape[1:]), part.dtype) for part in shard]
        for whole, part in zip(joined, shard, strict=True):
            whole[index * count : (index + 1) * count] = part
    return RenderSet(*joined)


def training_and_held_out(
    folder: Path, objects: int, seed: int = 0, progress=lambda iterable, total: iterable,
    proportions: float = PROPORTIONS, deformation: float = DEFORMATION,
) -> tuple[RenderSet, RenderSet]:  # fmt: skip
    """`objects` objects to train on, and others to watch the training by: an eighth as many, at most `SHARD`.

    `proportions` and `deformation` are of the former; the others are always rendered alike, and have numbers that no
    training set reaches, so runs that go on from one another can share them.
    """
    shard = min(SHARD, max(1, objects // 8))
    held_out = render_set(folder, shard, seed, shard, first=HELD_OUT)
    how = dict(progress=progress, proportions=proportions, deformation=deformation)
    return load_render_set(render_set(folder, objects, seed, shard, **how)), load_render_set(held_out)
