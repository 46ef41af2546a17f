"""Sampling: images between their pixels, panoramas by direction, and sets of random directions."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

_DIRECTIONS = 64  # different sets of random directions


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) scaled to unit length."""
    return vectors / np.maximum(np.sqrt(np.einsum("...d,...d->...", vectors, vectors))[..., None], 1e-12)


def flat_normals(corners: np.ndarray) -> np.ndarray:
    """Return the unit normals (n, 3) of triangles (n, 3, 3)."""
    return unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def basis(normal: np.ndarray) -> Float[np.ndarray, "n 3 3"]:
    """Return orthonormal rows (tangent, tangent, normal) for unit normals (n, 3), after Duff et al. (2017)."""
    x, y, z = normal.T
    sign = np.where(z >= 0, 1, -1).astype(np.float32)
    a = -1 / (sign + z)
    b = x * y * a
    rows = [[1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y], [x, y, z]]
    return np.moveaxis(np.array(rows, np.float32), -1, 0)


def stratified(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return sets (sets, n) of points in the unit square: a golden-ratio lattice with a random shift."""
    shift = rng.random((_DIRECTIONS, 2, 1))
    index = np.arange(n)
    return ((index + shift[:, 0]) / n) % 1, (index * 0.6180339887 + shift[:, 1]) % 1


def cosine_directions(rng: np.random.Generator, n: int) -> Float[np.ndarray, "sets n 3"]:
    """Return sets of directions about +z with a density of the cosine."""
    u, v = stratified(rng, max(n, 1))
    r = np.sqrt(u)
    return np.stack([r * np.cos(2 * np.pi * v), r * np.sin(2 * np.pi * v), np.sqrt(1 - u)], -1).astype(np.float32)


def pyramid(image: np.ndarray) -> list[np.ndarray]:
    """Return an image and its halvings down to 4 pixels."""
    levels = [image]
    while min(levels[-1].shape[:2]) >= 8:
        height, width = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return levels


def sample_image(
    levels: Sequence[np.ndarray], u: np.ndarray, v: np.ndarray, texels: np.ndarray | None, border: int, fill=0
) -> Float[np.ndarray, "n c"]:
    """Look up points (u, v) in [0, 1] (v from the top) by bilinear interpolation.

    The level of the pyramid fits `texels`, the texels of the finest level that a sample covers; by default one. Outside
    the image OpenCV's rule `border` holds, with the value `fill` for BORDER_CONSTANT; BORDER_WRAP repeats the image.
    """
    if border == cv2.BORDER_WRAP:
        u, v = u % 1, v % 1
    if texels is None:
        return _bilinear(levels[0], u, v, border, fill)
    level = np.clip(np.rint(np.log2(np.maximum(texels, 1))), 0, len(levels) - 1).astype(np.int8)
    result = np.empty((len(u), levels[0].shape[2]), np.float32)
    for index in np.flatnonzero(np.bincount(level)):
        on = np.flatnonzero(level == index)
        result[on] = _bilinear(levels[index], u[on], v[on], border, fill)
    return result


def _bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray, border: int, fill) -> np.ndarray:
    if not len(u):
        return np.empty((0, image.shape[2]), np.float32)
    height, width = image.shape[:2]
    x, y = (u * width - 0.5).astype(np.float32), (v * height - 0.5).astype(np.float32)
    fold = 4096  # OpenCV's limit of rows and columns is 32767
    padding = -len(u) % fold
    grid = (np.pad(x, (0, padding)).reshape(-1, fold), np.pad(y, (0, padding)).reshape(-1, fold))
    found = cv2.remap(image, *grid, cv2.INTER_LINEAR, borderMode=border, borderValue=fill)
    return found.reshape(-1, image.shape[2])[: len(u)].astype(np.float32, copy=False)


def look_up(panorama: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the radiance of a panorama (rows from +z down) in directions (n, 3), bilinearly."""
    x, y, z = directions.T
    u, v = np.arctan2(y, x) / np.float32(2 * np.pi), np.arctan2(np.hypot(x, y), z) / np.float32(np.pi)
    half = np.float32(0.5 / len(panorama))
    v = np.clip(v, half, 1 - half)  # only the azimuth wraps: the zenith does not blend with the nadir
    return sample_image([panorama], u, v, None, cv2.BORDER_WRAP)
