"""Per-pixel maps of a set of views (depth, mask, silhouette distance, patch) and the projection of points into them.

A pixel of unknown depth gives no information about surfaces: its weight is 0. It may still lie inside or outside the
silhouette, which comes from the mask.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from zsp_lite.alignment import Sim3
from zsp_lite.data.cameras import Camera
from zsp_lite.verified.poses import float_tensor
from zsp_lite.views import View

# Resolution of the maps. Finer maps do not change results with patches of 8 pixels, and exceed the processor's cache.
_MAP_PIXELS = 128 * 128
# The silhouette of a soft mask is uncertain: distances to it are averaged over these.
_MASK_THRESHOLDS = (0.3, 0.5, 0.7)
_NO_SILHOUETTE = 1e4  # distance in pixels where the mask is empty
_MIN_DEPTH = 1e-3  # working units; depths are clamped to it before the projection


@dataclass(frozen=True, eq=False)
class ViewMaps:
    """Cameras of v views in working units, and one table row for each of their pixels."""

    rotation: Float[Tensor, "v 3 3"]  # world-to-camera: `x_cam = rotation @ x + translation`, x in the working frame
    translation: Float[Tensor, "v 3"]  # working units
    focal_length: Float[Tensor, " v"]  # in map pixels; the maps are resampled so that it is equal along both axes
    principal_point: Float[Tensor, "v 2"]  # (x, y) in map pixels
    size: Float[Tensor, "v 2"]  # (width, height) in map pixels, whole numbers
    first_row: Int[Tensor, " v"]  # table row of each view's first pixel
    # row-major, view after view: depth in working units; weight of that depth (the soft mask, 0 where
    # the depth is unknown); distance to the silhouette in map pixels (0 inside); similarity column of the patch (-1
    # for none). Columns are contiguous in memory
    table: Float[Tensor, "pixels 4"]
    pixel_scale: Float[Tensor, "v 2"]  # (x, y) pixels of the view's frame per map pixel


@dataclass(frozen=True, eq=False)
class Projection:
    """n points under m poses, projected into v views, with the map values at their pixels."""

    depth: Float[Tensor, "m v n"]  # depth of the point, working units
    surface_depth: Float[Tensor, "m v n"]  # measured depth at its pixel, working units
    weight: Float[Tensor, "m v n"]  # of the measured depth, in [0, 1]; 0 where it is unknown or background
    silhouette_distance: Float[Tensor, "m v n"]  # at the point's depth, working units; 0 inside
    patch: Int[Tensor, "m v n"]  # similarity column of the patch at its pixel, -1 for none
    pixels: Float[Tensor, "m v n 2"]  # (x, y) in map pixels


def build_maps(
    views: Sequence[View],
    world_to_camera: Sequence[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]],
    world_to_working: Sim3,
    columns: Sequence[Int[np.ndarray, " patches"]],
) -> ViewMaps:
    """Build the maps of views that share a world frame."""
    cameras, tables = zip(*(_table(*one, world_to_working.scale) for one in zip(views, columns, strict=True)))
    sizes = np.array([camera.size[::-1] for camera in cameras])
    return ViewMaps(
        float_tensor([R for R, _ in world_to_camera]),
        float_tensor([world_to_working.scale * t - R @ world_to_working.t for R, t in world_to_camera]),
        float_tensor([np.sqrt(camera.focal_length.prod()) for camera in cameras]),
        float_tensor([camera.principal_point for camera in cameras]),
        float_tensor(sizes),
        torch.from_numpy(np.cumsum([0, *(table.shape[1] for table in tables[:-1])])),
        torch.from_numpy(np.concatenate(tables, axis=1)).T,
        float_tensor([view.frame.camera.size[::-1] for view in views] / sizes),
    )


def project_points(
    maps: ViewMaps, linear: Float[Tensor, "m 3 3"], translation: Float[Tensor, "m 3"], points: Float[Tensor, "n 3"]
) -> Projection:
    """Transform points by `linear @ x + translation`, project them into every view and read the maps."""
    m, v = len(linear), len(maps.size)
    camera_linear = (maps.rotation @ linear[:, None]).reshape(-1, 3)
    camera_translation = (maps.rotation @ translation[:, None, :, None])[..., 0] + maps.translation
    in_camera = (camera_linear @ points.T).view(m, v, 3, -1).add_(camera_translation[..., None])
    depth = in_camera[:, :, 2]
    pixels_per_unit = maps.focal_length[:, None] / depth.clamp_min(_MIN_DEPTH)
    pixels = in_camera[:, :, :2].mul_(pixels_per_unit[:, :, None]).add_(maps.principal_point[..., None])
    last = torch.nextafter(maps.size, torch.zeros(()))[..., None]
    # A point beyond the border reads the nearest border pixel, and its silhouette distance is larger by the distance to
    # it; but where the silhouette reaches the border, the object is cut off, its extent unknown, and the distance 0.
    nearest = torch.minimum(pixels.clamp_min(0), last)
    column, row = nearest.int().unbind(2)
    index = (row * maps.size[:, :1].int()).add_(column).add_(maps.first_row[:, None].int())
    surface_depth, weight, distance, patch = (
        values.index_select(0, index.flatten()).view(index.shape) for values in maps.table.unbind(1)
    )
    beyond = torch.sub(pixels, nearest).abs_().sum(2)  # 0 within the image
    distance = distance.addcmul_(beyond, distance.sign()).div_(pixels_per_unit)
    return Projection(depth, surface_depth, weight, distance, patch.int(), pixels.transpose(2, 3))


def _table(
    view: View, columns: Int[np.ndarray, " patches"], scale: float
) -> tuple[Camera, Float[np.ndarray, "4 pixels"]]:
    """Resize the camera to about _MAP_PIXELS pixels, with equal focal lengths along both axes, and fill its table."""
    frame, camera, grid = view.frame, view.frame.camera, view.features.grid
    aspect = (camera.size[0] / camera.focal_length[1]) / (camera.size[1] / camera.focal_length[0])
    height = max(round(float(np.sqrt(_MAP_PIXELS * aspect))), 1)
    width = max(round(_MAP_PIXELS / height), 1)
    rows, cols = ((2 * np.arange(n) + 1) * old // (2 * n) for n, old in zip((height, width), camera.size))
    mask = cv2.resize(view.soft_mask, (width, height), interpolation=cv2.INTER_LINEAR)
    depth = np.zeros((height, width), np.float32) if frame.depth is None else frame.depth[np.ix_(rows, cols)]
    outside = [(mask < threshold).astype(np.uint8) for threshold in _MASK_THRESHOLDS]
    distance = [cv2.distanceTransform(one, cv2.DIST_L2, 5).clip(max=_NO_SILHOUETTE) for one in outside]
    patch = (np.arange(height) * grid[0] // height)[:, None] * grid[1] + np.arange(width) * grid[1] // width
    table = depth * scale, np.where(depth > 0, mask, 0), np.mean(distance, axis=0), columns[patch]
    return camera.resize((height, width)), np.stack([values.astype(np.float32) for values in table]).reshape(4, -1)
