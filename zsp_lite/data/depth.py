"""Depth maps: CO3D's 16-bit encoding, in-painting, and points of pixels and patches.

A depth map is (H, W), along +z in units of the world; 0 means unknown.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Real, UInt16

from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError


def decode_depth(
    bits: UInt16[np.ndarray, "h w"], scale_adjustment: float = 1.0
) -> Float[np.ndarray, "h w"]:
    """Decode CO3D's depth, bits of float16 times `scale_adjustment`; 0 where it is not positive."""
    with np.errstate(invalid="ignore", over="ignore"):  # bits of NaN or infinity
        depth = np.ascontiguousarray(bits).view(np.float16).astype(np.float32)
        depth = depth * np.float32(scale_adjustment)
    return zero_unknown(depth)


def zero_unknown(depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Replace depth that is not finite or not positive by 0."""
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def inpaint_depth(depth: Real[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Fill unknown pixels by OpenCV's Navier-Stokes in-painting; InputError if none is known.

    Known pixels are unchanged; filled ones are clipped to the range of the known depths.
    """
    depth = np.ascontiguousarray(depth, dtype=np.float32)
    known = np.isfinite(depth) & (depth > 0)
    if not known.any():
        raise InputError(
            f"depth map of shape {depth.shape} has no known pixel, expected at least one above 0"
        )
    low = depth[known].min()
    high = depth[known].max()
    filled = cv2.inpaint(
        np.where(known, depth, 0), (~known).astype(np.uint8), inpaintRadius=3, flags=cv2.INPAINT_NS
    )
    filled = np.nan_to_num(filled, nan=low)  # OpenCV divides by weights that can be 0
    return np.where(known, depth, filled.clip(low, high))


def unproject_depth(depth: Real[np.ndarray, "h w"], camera: Camera) -> Float[np.ndarray, "h w 3"]:
    """Compute each pixel's point (H, W, 3) in camera coordinates, the origin for unknown depth."""
    depth = np.asarray(depth, dtype=np.float64)
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return camera.unproject_camera(np.stack([x, y], axis=-1), depth)


def patch_points(
    depth: Real[np.ndarray, "h w"], camera: Camera, grid: tuple[int, int], inpaint: bool = True
) -> tuple[Float[np.ndarray, "rows cols 3"], Bool[np.ndarray, "rows cols"]]:
    """Compute one point per patch in camera coordinates.

    The point of a patch is the point of the pixel whose depth is the 25th percentile of the patch's
    known depths. A patch without known depth takes the in-painted depth at its central pixel; or,
    without `inpaint`, the origin: in-painting takes most of the time. Also returns whether each
    patch has a known depth.
    """
    # The paper does not say which of a patch's pixels it takes. At a silhouette the nearer surface
    # is the object, and a percentile is robust to single outliers.
    depth = np.asarray(depth, dtype=np.float32)
    height, width = depth.shape
    rows, row_valid, row_middle = _split(height, grid[0])
    cols, col_valid, col_middle = _split(width, grid[1])

    # Pixel indices and depths of every patch, (rows, cols, pixels per patch). The depth is infinite
    # where it is unknown, and where a smaller patch has no such pixel.
    shape = (len(rows), len(cols), rows.shape[1], cols.shape[1])
    pixel = np.broadcast_to(rows[:, None, :, None] * width + cols[None, :, None, :], shape)
    pixel = pixel.reshape(*shape[:2], -1)
    valid = (row_valid[:, None, :, None] & col_valid[None, :, None, :]).reshape(pixel.shape)
    values = depth.ravel()[pixel]
    values = np.where(valid & np.isfinite(values) & (values > 0), values, np.inf)

    # The pixel of each patch, (rows, cols): with known depths, the one at the 25th percentile;
    # without any, the central pixel.
    n_known = np.isfinite(values).sum(axis=-1)
    known = n_known > 0
    rank = np.maximum(n_known - 1, 0) // 4
    chosen = np.take_along_axis(
        np.argsort(values, axis=-1, kind="stable"), rank[..., None], axis=-1
    )
    at_percentile = np.take_along_axis(pixel, chosen, axis=-1)[..., 0]
    index = np.where(known, at_percentile, row_middle[:, None] * width + col_middle)
    filled = inpaint_depth(depth) if inpaint and not known.all() else depth
    y, x = np.divmod(index, width)
    depths = filled.ravel()[index]
    if not inpaint:
        depths = np.where(known, depths, 0)
    return camera.unproject_camera(np.stack([x + 0.5, y + 0.5], axis=-1), depths), known


def _split(length: int, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split the pixels 0 to `length` - 1 of a side into `count` bands.

    Returns the pixels of each band, padded to the widest band: (bands, widest); whether each is no
    padding; and the central pixel of each band.
    """
    edges = np.arange(count + 1) * length // count
    index = edges[:-1, None] + np.arange(np.diff(edges).max())
    valid = index < edges[1:, None]
    return np.minimum(index, length - 1), valid, (edges[:-1] + edges[1:]) // 2
