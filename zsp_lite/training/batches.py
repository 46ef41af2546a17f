"""Training batches: random crops, flips and colours of rendered views, with the geometry that goes with them."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from zsp_lite.training.renders import GRID, SIZE, VIEWS, RenderSet

PATCH_SIZE = 8  # pixels
# Normalisation of RGB values in [0, 1] during training. `export_checkpoint` replaces it by ImageNet's in the patch
# embedding, and `starting_weights` reverses that.
MEAN, STD = 0.45, 0.25


@dataclass(frozen=True)
class Batch:
    """Crops of several objects, the views of an object one after the other; n patches per crop, row by row.

    Attributes:
        images: Normalised RGB images; `detail` times the side of the crops that the transformer sees.
        surface: Object coordinates at the centre of each patch, NaN on the background.
        geometry: Normal in the camera frame, and depth standardised over the object, at the centre of each patch.
        coverage: Fraction of each patch that the object covers.
        objects: Number of objects.
    """

    images: Float[Tensor, "crops 3 side side"]
    surface: Float[Tensor, "crops n 3"]
    geometry: Float[Tensor, "crops n 4"]
    coverage: Float[Tensor, "crops n"]
    objects: int

    def to(self, device: torch.device) -> "Batch":
        """Copy the tensors to a device."""
        tensors = (self.images, self.surface, self.geometry, self.coverage)
        return Batch(*(tensor.to(device) for tensor in tensors), self.objects)


def crop_grids(
    rng: np.random.Generator, n: int, per_object: int, side: int, scale: tuple[float, float]
) -> tuple[Float[Tensor, "n side side 2"], Float[Tensor, "n 2 2"]]:
    """Draw random, slightly rotated crops; all crops of an object are mirrored, or none.

    Args:
        rng: Random generator.
        n: Number of crops.
        per_object: Consecutive crops that belong to one object.
        side: Side of the crops in pixels.
        scale: Smallest and largest width of a crop as a fraction of the image's.

    Returns:
        Sampling grids for `grid_sample`, and the matrices that map directions in the image to directions in the crop.
    """
    size = rng.uniform(*scale, n)
    ratio = np.exp(rng.uniform(-0.25, 0.25, n))
    width, height = np.minimum(size * ratio, 1), np.minimum(size / ratio, 1)
    angle = rng.normal(0, 0.12, n)
    x, y = (rng.uniform(-1, 1, n) * (1 - extent) * 0.9 for extent in (width, height))
    flip = np.repeat(rng.choice([-1.0, 1.0], n // per_object), per_object)
    c, s = np.cos(angle), np.sin(angle)
    affine = np.stack([
        np.stack([width * c * flip, -width * s, x], 1),
        np.stack([height * s * flip, height * c, y], 1),
    ], 1).astype(np.float32)  # fmt: skip
    grid = F.affine_grid(torch.from_numpy(affine), (n, 1, side, side), align_corners=False)
    turn = np.stack([np.stack([flip * c, flip * s], 1), np.stack([-s, c], 1)], 1).astype(np.float32)
    return grid, torch.from_numpy(turn)


def recolour(rng: np.random.Generator, x: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Change brightness, contrast and saturation at random, blur some images, and normalise by `MEAN` and `STD`."""
    n = len(x)

    def draw(low, high):
        return torch.from_numpy(rng.uniform(low, high, (n, 1, 1, 1)).astype(np.float32))

    x = x * draw(0.7, 1.3)
    mean = x.mean((2, 3), keepdim=True)
    x = (x - mean) * draw(0.7, 1.3) + mean
    grey = x.mean(1, keepdim=True)
    saturation = draw(0.3, 1.4) * torch.from_numpy((rng.random((n, 1, 1, 1)) > 0.2).astype(np.float32))
    x = grey + (x - grey) * saturation
    blurred = torch.from_numpy(rng.random(n) < 0.3)
    x[blurred] = F.avg_pool2d(F.pad(x[blurred], (1, 1, 1, 1), mode="replicate"), 3, 1)
    return ((x - MEAN) / STD).contiguous()


def on_photographs(
    rng: np.random.Generator,
    rgb: Float[Tensor, "n 3 size size"],
    mask: Float[Tensor, "n 1 size size"],
    backgrounds: UInt8[np.ndarray, "m height width 3"],
    views: int,
) -> Float[Tensor, "n 3 size size"]:
    """Put half of the objects in front of random parts of photographs, half of these beside another object.

    Args:
        rng: Random generator.
        rgb: Views in [0, 1].
        mask: Pixels of the objects.
        backgrounds: Photographs.
        views: Consecutive views of one object.
    """
    chosen = np.flatnonzero(rng.random(len(rgb)) < 0.5)
    if not len(chosen):
        return rgb
    n, size = len(chosen), rgb.shape[-1]

    def affine(scale: np.ndarray, aspect: float, x: np.ndarray, y: np.ndarray) -> Tensor:
        flip, zero = rng.choice([-1.0, 1.0], n), np.zeros(n)
        rows = [np.stack([scale * aspect * flip, zero, x], 1), np.stack([zero, scale, y], 1)]
        theta = torch.from_numpy(np.stack(rows, 1).astype(np.float32))
        return F.affine_grid(theta, (n, 1, size, size), align_corners=False)

    photos = torch.from_numpy(backgrounds[rng.integers(len(backgrounds), size=n)]).permute(0, 3, 1, 2).float() / 255
    aspect = backgrounds.shape[1] / backgrounds.shape[2]
    scale = rng.uniform(0.4, 1, n)
    x, y = rng.uniform(-1, 1, n) * (1 - scale * aspect), rng.uniform(-1, 1, n) * (1 - scale)
    behind = F.grid_sample(photos, affine(scale, aspect, x, y), align_corners=False)
    # Another object at the side: the view of the next object in the batch, shifted by about its width.
    other, angle = torch.from_numpy((chosen + views) % len(rgb)), rng.uniform(0, 2 * np.pi, n)
    far = rng.uniform(1.0, 1.7, n) + 2.0 * (rng.random(n) < 0.5)  # half of them are shifted out of the image
    where = affine(rng.uniform(0.8, 1.5, n), 1.0, far * np.cos(angle), far * np.sin(angle))
    beside, share = (F.grid_sample(maps[other], where, align_corners=False) for maps in (rgb, mask))
    behind = behind + share * (beside - behind)
    soft = F.avg_pool2d(F.pad(mask[chosen], (1, 1, 1, 1), mode="replicate"), 3, 1)
    rgb[chosen] = behind + soft * (rgb[chosen] - behind)
    return rgb


def sample_batch(
    renders: RenderSet,
    rng: np.random.Generator,
    objects: int,
    views: int,
    side: int,
    scale: tuple[float, float],
    members: np.ndarray | None = None,
    detail: int = 1,
    backgrounds: UInt8[np.ndarray, "m height width 3"] | None = None,
) -> Batch:
    """Draw a batch of random crops.

    Args:
        renders: Objects to draw from.
        rng: Random generator.
        objects: Number of objects.
        views: Views per object: 8 (all), 4 (two pairs, a quarter turn apart) or 2 (one pair).
        side: Side of the crops in pixels.
        scale: Smallest and largest width of a crop as a fraction of the image's.
        members: Indices of the objects. Default: random.
        detail: Number of pixels of the images per pixel of the crops along each side.
        backgrounds: Photographs that replace the room in half of the views. Default: every view shows its room.
    """
    index = rng.integers(0, len(renders), objects) if members is None else members
    chosen = np.arange(VIEWS)[None].repeat(objects, 0)
    if views < VIEWS:
        chosen = (2 * rng.integers(0, VIEWS // 2, (objects, 1)) + np.arange(views)) % VIEWS
    pick = (index[:, None], chosen)
    rgb = torch.from_numpy(renders.rgb[pick].reshape(-1, SIZE, SIZE, 3)).permute(0, 3, 1, 2).float() / 255
    if backgrounds is not None:
        mask = torch.from_numpy(renders.mask[pick].reshape(-1, 1, SIZE, SIZE)).float()
        rgb = on_photographs(rng, rgb, mask, backgrounds, views)
    maps = [torch.from_numpy(m[pick].reshape(-1, GRID, GRID, m.shape[-1]).astype(np.float32)).permute(0, 3, 1, 2)
            for m in (renders.surface, renders.geometry)]  # fmt: skip
    n, patches = objects * views, side // PATCH_SIZE
    grid, turn = crop_grids(rng, n, views, detail * side, scale)
    images = F.grid_sample(rgb, grid, mode="bilinear", padding_mode="reflection", align_corners=False)

    def at(resolution):
        return F.interpolate(grid.permute(0, 3, 1, 2), (resolution,) * 2, mode="area").permute(0, 2, 3, 1)

    def sample(values, where):
        return F.grid_sample(values, where, mode="nearest", padding_mode="border", align_corners=False)

    surface, geometry = maps
    on_object = (~surface[:, :1].isnan()).float()
    coverage = F.avg_pool2d(sample(on_object, at(2 * patches)), 2).flatten(1)
    centres = at(patches)
    surface = sample(surface.nan_to_num(nan=-99.0), centres).flatten(2).transpose(1, 2)
    surface[surface < -50] = float("nan")
    geometry = sample(geometry, centres).flatten(2).transpose(1, 2)
    geometry[..., :2] = geometry[..., :2] @ turn.transpose(1, 2)
    return Batch(recolour(rng, images), surface, geometry, coverage, objects)
