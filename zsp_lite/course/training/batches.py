"""Training batches: random crops, flips and colours of rendered views, with the geometry that goes
with them."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from zsp_lite.course.training.renders import VIEWS, RenderSet

PATCH_SIZE = 8  # pixels
# normalisation of RGB values in [0, 1] during training
MEAN = 0.45
STD = 0.25


@dataclass(frozen=True)
class Batch:
    """Crops of several objects, the views of an object one after the other; n patches per crop, row
    by row."""

    images: Float[Tensor, "crops 3 side side"]  # normalised RGB
    # object coordinates at the centre of each patch, NaN on the background
    surface: Float[Tensor, "crops n 3"]
    # there: normal in the camera frame, and depth standardised over the object
    geometry: Float[Tensor, "crops n 4"]
    coverage: Float[Tensor, "crops n"]  # fraction of each patch that the object covers
    objects: int  # their number


def crop_grids(
    rng: np.random.Generator, n: int, per_object: int, side: int, scale: tuple[float, float]
) -> tuple[Float[Tensor, "n side side 2"], Float[Tensor, "n 2 2"]]:
    """Draw slightly rotated crops as grids for `grid_sample`, and the map of directions in the
    image to the crop's."""
    size = rng.uniform(*scale, n)
    ratio = np.exp(rng.uniform(-0.25, 0.25, n))
    width = np.minimum(size * ratio, 1)
    height = np.minimum(size / ratio, 1)
    angle = rng.normal(0, 0.12, n)
    x, y = (rng.uniform(-1, 1, n) * (1 - extent) * 0.9 for extent in (width, height))
    # Each group is mirrored as a whole or not.
    flip = np.repeat(rng.choice([-1.0, 1.0], n // per_object), per_object)
    c, s = np.cos(angle), np.sin(angle)
    affine = np.array(
        [[width * c * flip, -width * s, x], [height * s * flip, height * c, y]], np.float32
    )
    turn = np.array([[flip * c, flip * s], [-s, c]], np.float32)
    affine, turn = (
        torch.from_numpy(matrix).permute(2, 0, 1).contiguous() for matrix in (affine, turn)
    )
    return F.affine_grid(affine, (n, 1, side, side), align_corners=False), turn


def recolour(rng: np.random.Generator, x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Change brightness, contrast and saturation at random, blur some images, and normalise by
    `MEAN` and `STD`."""
    n = len(x)

    def draw(low, high):
        return torch.from_numpy(rng.uniform(low, high, (n, 1, 1, 1)).astype(np.float32))

    x = x * draw(0.7, 1.3)
    mean = x.mean((2, 3), keepdim=True)
    x = (x - mean) * draw(0.7, 1.3) + mean
    grey = x.mean(1, keepdim=True)
    saturation = draw(0.3, 1.4) * torch.from_numpy(
        (rng.random((n, 1, 1, 1)) > 0.2).astype(np.float32)
    )
    x = grey + (x - grey) * saturation
    blurred = torch.from_numpy(rng.random(n) < 0.3)
    x[blurred] = F.avg_pool2d(F.pad(x[blurred], (1, 1, 1, 1), mode="replicate"), 3, 1)
    return ((x - MEAN) / STD).contiguous()


def sample_batch(
    renders: RenderSet,
    rng: np.random.Generator,
    objects: int,
    views: int,
    side: int,
    scale: tuple[float, float],
    members: np.ndarray | None = None,
) -> Batch:
    """Draw random crops of `side` pixels, whose widths are between the two of `scale` as a fraction
    of the image's.

    The objects are random or the `members`; of each there are 8 views (all), 4 (two pairs, a
    quarter turn apart) or 2 (one pair).
    """
    index = rng.integers(0, len(renders.rgb), objects) if members is None else members
    chosen = np.arange(VIEWS)[None].repeat(objects, 0)
    if views < VIEWS:
        chosen = (2 * rng.integers(0, VIEWS // 2, (objects, 1)) + np.arange(views)) % VIEWS
    pick = (index[:, None], chosen)
    rgb, surface, geometry = (
        torch.from_numpy(maps[pick]).flatten(0, 1).permute(0, 3, 1, 2).float()
        for maps in (renders.rgb, renders.surface, renders.geometry)
    )
    grid, turn = crop_grids(rng, objects * views, views, side, scale)
    images = F.grid_sample(rgb / 255, grid, padding_mode="reflection", align_corners=False)

    def at(resolution):
        return F.interpolate(grid.permute(0, 3, 1, 2), (resolution,) * 2, mode="area").permute(
            0, 2, 3, 1
        )

    def sample(values, where):
        return F.grid_sample(
            values, where, mode="nearest", padding_mode="border", align_corners=False
        )

    patches = side // PATCH_SIZE
    on_object = (~surface[:, :1].isnan()).float()
    coverage = F.avg_pool2d(sample(on_object, at(2 * patches)), 2).flatten(1)
    centres = at(patches)
    surface = sample(surface.nan_to_num(nan=-99.0), centres).flatten(2).transpose(1, 2)
    surface[surface < -50] = float("nan")
    geometry = sample(geometry, centres).flatten(2).transpose(1, 2)
    geometry[..., :2] = geometry[..., :2] @ turn.transpose(1, 2)
    return Batch(recolour(rng, images), surface, geometry, coverage, objects)
