"""What a view knows about each of its pixels, as one table to look many projected points up in at once.

A pixel whose depth is unknown says nothing about surfaces: its weight is 0, so a point that falls on it is neither on
the object nor off it. Whether it lies inside the silhouette is known all the same.
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
from zsp_lite.views import View

# Finer maps than this change nothing that patches of 8 pixels could tell, and leave the processor's cache.
_MAP_PIXELS = 128 * 128
# The silhouette of a soft mask is uncertain: distances to it are averaged over these levels.
_MASK_LEVELS = (0.3, 0.5, 0.7)
_NO_SILHOUETTE = 1e4  # pixels
_NEAREST = 1e-3  # working units; nothing is seen nearer to the camera than this
# Columns of the table.
_DEPTH, _WEIGHT, _OFF, _PATCH = range(4)


@dataclass(frozen=True, eq=False)
class ViewMaps:
    """v views' cameras in working units, and a row for each of their pixels.

    rotation, translation: working frame to camera, `x_cam = rotation @ x + translation`.  focal_length: pixels;
    the maps
    are sized so that it is the same along both axes.  centre: principal point (x, y).  size: (width, height), whole
    numbers.  start: the row of each view's first pixel.
    table: per pixel (row-major, view after view) its depth, the weight of that depth (the soft mask; 0 where the
    depth is unknown), its distance in pixels to the silhouette (0 inside), and its patch's column (-1 for none).
    zoom: (x, y), pixels of the view's frame per pixel of the map.
    """

    rotation: Float[Tensor, "v 3 3"]
    translation: Float[Tensor, "v 3"]
    focal_length: Float[Tensor, " v"]
    centre: Float[Tensor, "v 2"]
    size: Float[Tensor, "v 2"]
    start: Int[Tensor, " v"]
    table: Float[Tensor, "pixels 4"]
    zoom: Float[Tensor, "v 2"]

    def __len__(self) -> int:
        return len(self.focal_length)

    @property
    def camera_centres(self) -> Float[Tensor, "v 3"]:
        """Where the cameras stand in the working frame."""
        return -(self.rotation.transpose(1, 2) @ self.translation[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class Seen:
    """What n points under m poses meet in v views.

    depth: of the point.  surface, weight: depth of what the view saw there, and the weight of that (0 unknown or
    background).  off: distance to the silhouette in working units (0 inside).  patch: its column, -1 for none.
    pixels: (x, y) in the view's map.
    """

    depth: Float[Tensor, "m v n"]
    surface: Float[Tensor, "m v n"]
    weight: Float[Tensor, "m v n"]
    off: Float[Tensor, "m v n"]
    patch: Int[Tensor, "m v n"]
    pixels: Float[Tensor, "m v n 2"]


def make_maps(
    views: Sequence[View],
    world_to_camera: Sequence[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]],
    frame: Sim3,
    columns: Sequence[Int[np.ndarray, " patches"]],
) -> ViewMaps:
    """The maps of some views.

    world_to_camera: rotation and translation of each, from one world of theirs.  frame: that world to working units,
    without a rotation.  columns: each patch's column (row-major), -1 for none.
    """
    cameras = [_map_camera(view.frame.camera) for view in views]
    tables = [_table(*one, frame.scale) for one in zip(views, cameras, columns, strict=True)]
    origin = -frame.t / frame.scale  # of the working frame, in the world
    lengths = [len(table) for table in tables]

    def tensor(values) -> Tensor:
        return torch.from_numpy(np.asarray(values, dtype=np.float32))

    sizes = np.array([camera.size[::-1] for camera in cameras])
    return ViewMaps(
        tensor([rotation for rotation, _ in world_to_camera]),
        tensor([frame.scale * (rotation @ origin + translation) for rotation, translation in world_to_camera]),
        tensor([np.sqrt(camera.focal_length.prod()) for camera in cameras]),
        tensor([camera.principal_point for camera in cameras]),
        tensor(sizes),
        torch.from_numpy(np.cumsum([0, *lengths[:-1]])),
        torch.from_numpy(np.concatenate(tables)),
        tensor([view.frame.camera.size[::-1] for view in views] / sizes),
    )


def look_up(
    maps: ViewMaps,
    linear: Float[Tensor, "m 3 3"],
    shift: Float[Tensor, "m 3"],
    points: Float[Tensor, "n 3"],
) -> Seen:
    """Every point p, moved to linear @ p + shift, as every view sees it.

    Beyond the image's border the pixel at the border answers. Off the silhouette the way back to the border counts
    too; where the silhouette reaches the border, the image cut the object off, and nobody knows how far it goes on.
    """
    m, v = len(linear), len(maps)
    turned = (maps.rotation @ linear[:, None]).reshape(-1, 3)
    moved = (maps.rotation @ shift[:, None, :, None])[..., 0] + maps.translation
    in_camera = (turned @ points.T).view(m, v, 3, -1).add_(moved[..., None])
    depth = in_camera[:, :, 2]
    pixels_per_unit = maps.focal_length[:, None] / depth.clamp_min(_NEAREST)
    x = in_camera[:, :, 0].mul_(pixels_per_unit).add_(maps.centre[:, :1])
    y = in_camera[:, :, 1].mul_(pixels_per_unit).add_(maps.centre[:, 1:])
    column = torch.minimum(x.floor().clamp_min_(0), maps.size[:, :1] - 1)
    row = torch.minimum(y.floor().clamp_min_(0), maps.size[:, 1:] - 1)
    index = (row * maps.size[:, :1] + column).long().add_(maps.start[:, None])
    found = maps.table.index_select(0, index.flatten()).view(*index.shape, 4)
    surface, weight, off, patch = found.unbind(-1)
    # From the pixel's centre; half a pixel is none.
    beyond = (x - column - 0.5).abs_().sub_(0.5).clamp_min_(0) + (y - row - 0.5).abs_().sub_(0.5).clamp_min_(0)
    off = torch.where(off > 0, off + beyond, off) / pixels_per_unit
    return Seen(depth, surface, weight, off, patch.long(), torch.stack([x, y], -1))


def _map_camera(camera: Camera) -> Camera:
    """The camera of an image of about _MAP_PIXELS whose pixels are as high as wide in space."""
    height, width = camera.size
    aspect = (height / camera.focal_length[1]) / (width / camera.focal_length[0])
    rows = max(round(float(np.sqrt(_MAP_PIXELS * aspect))), 1)
    return camera.resize((rows, max(round(_MAP_PIXELS / rows), 1)))


def _table(
    view: View, camera: Camera, columns: Int[np.ndarray, " patches"], scale: float
) -> Float[np.ndarray, "pixels 4"]:
    height, width = camera.size
    frame, grid = view.frame, view.features.grid
    rows, cols = ((2 * np.arange(n) + 1) * old // (2 * n) for n, old in zip(camera.size, frame.camera.size))
    mask = cv2.resize(view.soft_mask, (width, height), interpolation=cv2.INTER_LINEAR)
    depth = np.zeros((height, width), np.float32) if frame.depth is None else frame.depth[np.ix_(rows, cols)]
    table = np.empty((height, width, 4), np.float32)
    table[..., _DEPTH] = depth * scale
    table[..., _WEIGHT] = np.where(depth > 0, mask, 0)
    table[..., _OFF] = np.mean([_distance(mask < level) for level in _MASK_LEVELS], axis=0)
    patch = (np.arange(height) * grid[0] // height)[:, None] * grid[1] + np.arange(width) * grid[1] // width
    table[..., _PATCH] = columns[patch]
    return table.reshape(-1, 4)


def _distance(outside: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Pixels from each pixel to the nearest one that is not outside."""
    if outside.all():
        return np.full(outside.shape, _NO_SILHOUETTE, np.float32)
    return cv2.distanceTransform(outside.astype(np.uint8), cv2.DIST_L2, 5)
