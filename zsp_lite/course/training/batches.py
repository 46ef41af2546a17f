"""Training batches: random crops, flips and colours of views, with their geometry.

The ranges of the random numbers are those of the training of `zsp-tiny` (docs/rebuild.md).
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from zsp_lite.course.training.renders import VIEWS, RenderSet

PATCH_SIZE = 8  # pixels
# Normalisation of RGB values in [0, 1] during training, one number for all channels.
MEAN = 0.45
STD = 0.25


@dataclass(frozen=True)
class Batch:
    """Crops of several objects, the views of an object one after the other.

    Every crop has n patches, row by row.
    """

    images: Float[Tensor, "crops 3 side side"]  # normalised RGB
    # object coordinates at the centre of each patch, NaN on the background
    surface: Float[Tensor, "crops n 3"]
    # at the same points: normal in the camera frame, and depth standardised over the object
    geometry: Float[Tensor, "crops n 4"]
    coverage: Float[Tensor, "crops n"]  # fraction of each patch that the object covers
    objects: int  # their number


def crop_grids(
    rng: np.random.Generator, n: int, per_object: int, side: int, scale: tuple[float, float]
) -> tuple[Float[Tensor, "n side side 2"], Float[Tensor, "n 2 2"]]:
    """Draw slightly rotated crops.

    Args:
        rng: source of the random numbers.
        n: number of crops.
        per_object: number of consecutive crops that are mirrored together or not.
        side: of the crops in pixels.
        scale: range of their widths, as a fraction of the image's.

    Returns:
        Grids for `grid_sample`; and matrices that map directions in the image to directions in the
        crop.
    """
    size = rng.uniform(*scale, n)
    # The sides differ by a factor of up to exp(0.5), 1.65.
    ratio = np.exp(rng.uniform(-0.25, 0.25, n))
    width = np.minimum(size * ratio, 1)
    height = np.minimum(size / ratio, 1)
    angle = rng.normal(0, 0.12, n)  # radians
    # The centres, with the image from -1 to 1; a rotated crop stays inside most of the time.
    x = rng.uniform(-1, 1, n) * (1 - width) * 0.9
    y = rng.uniform(-1, 1, n) * (1 - height) * 0.9
    flip = np.repeat(rng.choice([-1.0, 1.0], n // per_object), per_object)
    c = np.cos(angle)
    s = np.sin(angle)
    # `affine` (2, 3, n) maps points of the crop to the image; `turn` (2, 2, n) maps directions in
    # the image to the crop.
    affine = np.array(
        [[width * c * flip, -width * s, x], [height * s * flip, height * c, y]], np.float32
    )
    turn = np.array([[flip * c, flip * s], [-s, c]], np.float32)
    affine = torch.from_numpy(affine).permute(2, 0, 1).contiguous()
    turn = torch.from_numpy(turn).permute(2, 0, 1).contiguous()
    return F.affine_grid(affine, (n, 1, side, side), align_corners=False), turn


def recolour(rng: np.random.Generator, x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Change colours at random, blur some images, and normalise by `MEAN` and `STD`."""
    n = len(x)

    def draw(low: float, high: float) -> Tensor:  # one number per image
        return torch.from_numpy(rng.uniform(low, high, (n, 1, 1, 1)).astype(np.float32))

    # brightness
    x = x * draw(0.7, 1.3)
    # contrast
    mean = x.mean((2, 3), keepdim=True)
    x = (x - mean) * draw(0.7, 1.3) + mean
    # saturation, where one image in five becomes grey
    grey = x.mean(1, keepdim=True)
    saturation = draw(0.3, 1.4)
    coloured = torch.from_numpy(rng.random((n, 1, 1, 1)) > 0.2)
    x = grey + (x - grey) * (saturation * coloured)
    # a blur over 3 x 3 pixels, of three images in ten
    blurred = torch.from_numpy(rng.random(n) < 0.3)
    x[blurred] = F.avg_pool2d(F.pad(x[blurred], (1, 1, 1, 1), mode="replicate"), 3, 1)
    return ((x - MEAN) / STD).contiguous()


def sample_batch(
    renders: RenderSet,
    rng: np.random.Generator,
    objects: int,
    side: int,
    scale: tuple[float, float],
    members: np.ndarray | None = None,
) -> Batch:
    """Draw a random crop of each view of some objects.

    Args:
        renders: the training set.
        rng: source of the random numbers.
        objects: number of objects.
        side: of the crops in pixels.
        scale: range of their widths, as a fraction of the image's.
        members: indices of the objects; by default random.

    Returns:
        The crops, recoloured, with the geometry of their patches.
    """
    index = rng.integers(0, len(renders.rgb), objects) if members is None else members

    def maps_of(array: np.ndarray) -> Tensor:  # (crops, channels, rows, columns)
        maps = torch.from_numpy(array[index])
        return maps.flatten(0, 1).permute(0, 3, 1, 2).float()

    grid, turn = crop_grids(rng, objects * VIEWS, VIEWS, side, scale)
    images = F.grid_sample(
        maps_of(renders.rgb) / 255, grid, padding_mode="reflection", align_corners=False
    )

    # Geometry is sampled at the centre of each patch, coverage at four points of it.
    patches = side // PATCH_SIZE
    surface = maps_of(renders.surface)
    on_object = (~surface[:, :1].isnan()).float()
    coverage = F.avg_pool2d(_sample_geometry(on_object, grid, 2 * patches), 2).flatten(1)
    # NaN is sampled as a number far below all coordinates of objects, which are of unit spread.
    surface = _sample_geometry(surface.nan_to_num(nan=-99.0), grid, patches)
    surface = surface.flatten(2).transpose(1, 2)
    surface[surface < -50] = float("nan")
    geometry = _sample_geometry(maps_of(renders.geometry), grid, patches)
    geometry = geometry.flatten(2).transpose(1, 2)
    # The x and y of the normals turn with the crop.
    geometry[..., :2] = geometry[..., :2] @ turn.transpose(1, 2)
    return Batch(recolour(rng, images), surface, geometry, coverage, objects)


def _sample_geometry(
    maps: Float[Tensor, "crops c h w"], grid: Float[Tensor, "crops side side 2"], n: int
) -> Float[Tensor, "crops c n n"]:
    """Return the nearest values of maps at n x n points of crops, evenly spaced."""
    points = F.interpolate(grid.permute(0, 3, 1, 2), (n, n), mode="area").permute(0, 2, 3, 1)
    return F.grid_sample(maps, points, mode="nearest", padding_mode="border", align_corners=False)
