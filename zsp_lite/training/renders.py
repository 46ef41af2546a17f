"""The training set of the backbone: several views of one object at a time, with their geometry."""

import hashlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.errors import InputError
from zsp_lite.io.files import read_arrays, sha256
from zsp_lite.synthetic.models import list_models
from zsp_lite.synthetic.render import framed_camera, orbit_pose
from zsp_lite.training.instances import ModelInstances, ProceduralInstances
from zsp_lite.training.shards import render_shards
from zsp_lite.training.views import render_view

VIEWS = 8  # per object
SIZE = 192  # of a view, pixels
GRID = 48  # points along each side of a view at which geometry is known
SHARD = 200  # objects per file
ARRAYS = ("rgb", "mask", "surface", "geometry")  # of a file
PAIR_ANGLES = np.radians((5, 45))  # smallest and largest difference in azimuth of the two views of a pair
PROPORTIONS, DEFORMATION = 0.3, 1.0  # differences between the views of one object; see `render_object`
MODEL_SHARE = 0.6  # of the objects, where there is a folder of models
HELD_OUT = 9_000_000  # number of the first object that is never trained on
SEED_STRIDE = 10_000_000  # objects of seed s have the numbers from s * SEED_STRIDE on


@dataclass(frozen=True)
class RenderSet:
    """Views of n objects.

    Attributes:
        rgb: Images.
        mask: Pixels of the object.
        surface: Object coordinates of every fourth pixel, NaN on the background. Two views of one object correspond
            where these agree; they have no meaning across objects.
        geometry: Normal in the camera frame, and depth standardised over the object's pixels of the view.
    """

    rgb: UInt8[np.ndarray, "n views size size 3"]
    mask: Bool[np.ndarray, "n views size size"]
    surface: Float[np.ndarray, "n views grid grid 3"]
    geometry: Float[np.ndarray, "n views grid grid 4"]

    def __len__(self) -> int:
        return len(self.rgb)


def render_object(
    seed: int,
    proportions: float = PROPORTIONS,
    deformation: float = DEFORMATION,
    models: Path | None = None,
    share: float = MODEL_SHARE,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Render one object.

    The views are four pairs, a quarter turn apart. The two views of a pair differ by 5 to 45 degrees of azimuth, about
    as much as a reference and the nearest of a few target views, and never more than two views of different pairs.

    Procedural objects: half of them are of the named training categories, half are random assemblies of parts. Each
    view shows another instance of the same build: with other proportions (`make_variant`), deformed (`deform`),
    sometimes without one of its parts, with its own materials and room.

    Models from files: see `ModelInstances`.

    Args:
        seed: Number of the object.
        proportions: Amount by which proportions of procedural objects vary.
        deformation: Amount of the deformation.
        models: Folder of models (`zsp_lite.synthetic.models`). Default: all objects are procedural.
        share: Fraction of the objects that are models from this folder.

    Returns:
        The object's rows of `RenderSet.rgb`, `.mask`, `.surface` and `.geometry`.
    """
    rng = np.random.default_rng([seed, 0])
    if models is not None and rng.random() < share:
        source = ModelInstances(models, rng, deformation)
    else:
        source = ProceduralInstances(seed, rng, proportions, deformation)
    start = rng.uniform(0, 2 * np.pi)
    rgb = np.empty((VIEWS, SIZE, SIZE, 3), np.uint8)
    mask = np.empty((VIEWS, SIZE, SIZE), bool)
    surface = np.empty((VIEWS, GRID, GRID, 3), np.float16)
    geometry = np.empty((VIEWS, GRID, GRID, 4), np.float16)
    step = SIZE // GRID
    for view in range(VIEWS):
        if view % 2 == 0:
            azimuth, apart = start + (view // 2) * np.pi / 2, rng.uniform(*PAIR_ANGLES)
            elevation = rng.uniform(0, 0.9)
        instance = source.instance(view)
        vertices = instance.mesh.vertices
        R, t = orbit_pose(
            azimuth + (view % 2 - 0.5) * apart, np.clip(elevation + rng.normal(0, 0.12), 0.02, 1.1), rng.normal(0, 0.1),
            rng.uniform(5, 10), (vertices.max(0) + vertices.min(0)) / 2,
        )  # fmt: skip
        camera = framed_camera(vertices, R, t, SIZE, 1.12 * np.exp(rng.normal(0, 0.06)), rng.normal(0, 0.02, 2))
        image = render_view(seed, instance.mesh, instance.coordinates, camera, rng)
        every = (slice(step // 2, None, step),) * 2
        depth, on_object = image.depth[every], image.mask[every]
        spread = max(float(depth[on_object].std()), 1e-6) if on_object.any() else 1.0
        middle = depth[on_object].mean() if on_object.any() else 0.0
        rgb[view], mask[view], surface[view] = image.rgb, image.mask, image.canonical[every]
        geometry[view, ..., :3] = image.normals[every]
        geometry[view, ..., 3] = np.where(on_object, (depth - middle) / spread, 0)
    return rgb, mask, surface, geometry


def render_set(
    folder: Path,
    objects: int,
    seed: int = 0,
    shard: int | None = None,
    workers: int = 2,
    first: int = 0,
    proportions: float = PROPORTIONS,
    deformation: float = DEFORMATION,
    models: Path | None = None,
    share: float = MODEL_SHARE,
) -> list[Path]:
    """Render a training set into a folder, about 1.4 MB per object. Existing shards are reused.

    Args:
        folder: Folder of the shards; their names contain all other arguments.
        objects: Number of objects, rounded up to whole shards.
        seed: Seed of the set.
        shard: Objects per shard. Default: 200, or `objects` if these are fewer.
        workers: Number of processes (see `render_shards`).
        first: Number of the first object.
        proportions, deformation, models, share: See `render_object`.

    Returns:
        Paths of the shards.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    shard = min(SHARD, objects) if shard is None else shard
    source = "" if models is None else f"-{share:g}-{_digest(models)}"
    shards = {}
    for start in range(first, first + objects, shard):
        name = f"views-{seed}-{start:06d}-{start + shard:06d}-{proportions:g}-{deformation:g}{source}.npz"
        shards[folder / name] = range(seed * SEED_STRIDE + start, seed * SEED_STRIDE + start + shard)
    render = partial(render_object, proportions=proportions, deformation=deformation, models=models, share=share)
    render_shards(render, shards, ARRAYS, workers)
    return list(shards)


def load_render_set(paths: list[Path]) -> RenderSet:
    """Read shards into one set. Raises InputError if a file is damaged or has arrays of other sizes."""
    joined: list[np.ndarray] = []  # filled shard by shard: concatenation would need twice the memory
    for index, path in enumerate(paths):
        shard = read_arrays(path, ARRAYS, "training renders")
        count = len(shard[0])  # all shards have as many objects
        views = (count, VIEWS)
        expected = (*views, SIZE, SIZE, 3), (*views, SIZE, SIZE), (*views, GRID, GRID, 3), (*views, GRID, GRID, 4)
        for name, part, shape in zip(ARRAYS, shard, expected, strict=True):
            if part.shape != shape:
                raise InputError(
                    f"{path}: {name} has shape {part.shape}, expected {shape}; remove it to render it again"
                )
        if not joined:
            joined = [np.empty((count * len(paths), *part.shape[1:]), part.dtype) for part in shard]
        for whole, part in zip(joined, shard, strict=True):
            whole[index * count : (index + 1) * count] = part
    return RenderSet(*joined)


def training_and_held_out(
    folder: Path,
    objects: int,
    seed: int = 0,
    proportions: float = PROPORTIONS,
    deformation: float = DEFORMATION,
    models: Path | None = None,
) -> tuple[RenderSet, RenderSet]:
    """Render or load a training set and held-out objects, an eighth as many but at most 200.

    Args:
        folder: See `render_set`.
        objects: Number of training objects.
        seed: Seed of both sets.
        proportions, deformation: Of the training set; held-out objects have the default values. Their numbers are in no
            training set, so runs that continue one another can use the same.
        models: See `render_object`. Held-out objects are procedural.
    """
    shard = min(SHARD, max(1, objects // 8))
    training = render_set(folder, objects, seed, shard, proportions=proportions, deformation=deformation, models=models)
    held_out = render_set(folder, shard, seed, shard, first=HELD_OUT)
    return load_render_set(training), load_render_set(held_out)


def models_digest(models: Path) -> str:
    """Return a checksum of the names and contents of all files of a folder of models.

    Raises:
        InputError: If there are no models, or a file cannot be read.
    """
    list_models(models)
    files = sorted(path for path in Path(models).rglob("*") if path.is_file())
    listed = [f"{path.relative_to(models).as_posix()} {sha256(path, 'model')}" for path in files]
    return hashlib.sha256("\n".join(listed).encode()).hexdigest()


def _digest(models: Path) -> str:
    """Return a checksum of the names and sizes of a folder's models."""
    listed = [f"{model.category}/{model.name} {model.path.stat().st_size}" for model in list_models(models)]
    return hashlib.sha256("\n".join(listed).encode()).hexdigest()[:8]
