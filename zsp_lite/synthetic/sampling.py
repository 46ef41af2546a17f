"""Sampling: images between their pixels, random directions, and vectors."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

_FOLD = 4096  # points per row of OpenCV's maps, whose sides are limited to 32,767


def dot(one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the scalar products of the rows."""
    return np.einsum("nd,nd->n", one, other)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) scaled to unit length."""
    return vectors / np.maximum(np.sqrt(np.einsum("...d,...d->...", vectors, vectors))[..., None], 1e-12)


def spread_directions(rng: np.random.Generator, n: int, count: int) -> Float[np.ndarray, "n {count} 3"]:
    """Return n sets of `count` unit vectors that are spread evenly over the sphere, each set turned at random."""
    index = np.arange(count, dtype=np.float32)
    z = 1 - 2 * (index + rng.random((n, 1), np.float32)) / count
    angle = np.float32(2 * np.pi) * (index * np.float32(0.618034) + rng.random((n, 1), np.float32))  # golden ratio
    radius = np.sqrt(np.maximum(1 - z**2, 0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)


def pyramid(image: np.ndarray) -> list[np.ndarray]:
    """Return an image and its halvings down to 4 pixels."""
    levels = [image]
    while min(levels[-1].shape[:2]) >= 8:
        height, width = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return levels


def sample_pyramid(
    levels: Sequence[np.ndarray], u: np.ndarray, v: np.ndarray, texels: np.ndarray, border: int
) -> Float[np.ndarray, "n c"]:
    """Sample each point (u, v) at the level that fits `texels`, the texels of the finest level that it covers."""
    level = np.clip(np.rint(np.log2(np.maximum(texels, 1))), 0, len(levels) - 1).astype(np.int8)
    result = np.empty((len(u), levels[0].shape[2]), np.float32)
    for index in np.unique(level):
        on = np.flatnonzero(level == index)
        result[on] = sample_image(levels[index], u[on], v[on], border)
    return result


def sample_image(image: np.ndarray, u: np.ndarray, v: np.ndarray, border: int) -> Float[np.ndarray, "n c"]:
    """Interpolate an image bilinearly at (u, v) in [0, 1] (v from the top); outside, BORDER_CONSTANT means 1."""
    if border == cv2.BORDER_WRAP:
        u, v = u % 1, v % 1
    height, width = image.shape[:2]
    padding = -len(u) % _FOLD
    x, y = (
        np.pad(where * side - 0.5, (0, padding)).astype(np.float32).reshape(-1, _FOLD)
        for where, side in ((u, width), (v, height))
    )
    if not len(x):
        return np.empty((0, image.shape[2]), np.float32)
    found = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border, borderValue=(1.0, 1.0, 1.0, 1.0))
    return found.reshape(-1, image.shape[2])[: len(u)].astype(np.float32, copy=False)
