"""Images: colours, smooth noise, the picture of a floor or of a wall, and sampling between
pixels."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

_FOLD = 4096  # points per row of OpenCV's maps, whose sides are limited to 32,767


def srgb_to_linear(colour) -> np.ndarray:
    """Convert sRGB colours in [0, 1] to linear ones."""
    colour = np.asarray(colour, np.float32)
    return np.where(
        colour <= 0.04045, colour / np.float32(12.92), ((colour + 0.055) / 1.055) ** np.float32(2.4)
    )


def linear_to_srgb(colour) -> np.ndarray:
    """Convert linear colours in [0, 1] to sRGB; the inverse of `srgb_to_linear`."""
    colour = np.asarray(colour, np.float32)
    return np.where(
        colour <= 0.0031308, 12.92 * colour, 1.055 * colour ** np.float32(1 / 2.4) - 0.055
    )


def hsv(hue: float, saturation: float, value: float) -> Float[np.ndarray, "3"]:
    """Return an sRGB colour from its hue in degrees, its saturation and its value."""
    k = (np.array([5, 3, 1]) + hue / 60) % 6
    return value - value * saturation * np.clip(np.minimum(k, 4 - k), 0, 1)


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an image by a Gaussian of at least 0.2 pixels."""
    return cv2.GaussianBlur(image, (0, 0), max(sigma, 0.2), borderType=cv2.BORDER_REFLECT)


def smooth_noise(
    rng: np.random.Generator, size: tuple[int, int], sigma: float, stretch: float = 1.0
) -> Float[np.ndarray, "h w"]:
    """Return Gaussian noise of unit variance, smoothed over `sigma` pixels, and `stretch` times as
    many along rows."""
    smoothing = np.array([sigma, sigma * stretch])
    step = np.maximum(smoothing / 2, 1)  # broad noise is drawn on a coarser grid
    height, width = (np.ceil(np.array(size) / step) + 2).astype(int).tolist()
    noise = rng.standard_normal((height, width), np.float32)
    down, along = smoothing / step
    noise = cv2.GaussianBlur(
        noise, (0, 0), sigmaX=along, sigmaY=down, borderType=cv2.BORDER_REFLECT
    )
    noise = cv2.resize(noise, size[::-1], interpolation=cv2.INTER_CUBIC)
    return noise / (noise.std() + 1e-6)


def surface(
    rng: np.random.Generator,
    size: tuple[int, int],
    colour: Float[np.ndarray, "3"],
    grain: float,
    laid: bool = False,
) -> Float[np.ndarray, "h w 3"]:
    """Return the linear colours of a surface around an sRGB colour, with grain, and with boards or
    tiles if `laid`."""
    height, width = size
    stretch = 1.0
    value = np.ones(size, np.float32)
    if laid:
        tile = rng.integers(40, 160)  # pixels
        board = int(tile * rng.choice([1, 4, 10]))
        stretch = 1.0 if board == tile else 12.0  # boards have the grain of wood
        row = np.arange(height)[:, None]
        # each row begins elsewhere
        column = np.arange(width) + row // tile * rng.integers(1, board)
        of_board = rng.normal(
            1, rng.uniform(0.02, 0.1), (height // tile + 1, column.max() // board + 1)
        )
        joint = (row % tile < 3) | (column % board < 3)
        value = np.where(
            joint, rng.uniform(0.5, 0.8), of_board[row // tile, column // board]
        ).astype(np.float32)
    for sigma, amount in ((1.0, 0.1), (6.0, 0.06), (60.0, 0.05)):
        value += grain * rng.uniform(0.3, 1) * amount * smooth_noise(rng, size, sigma, stretch)
    return srgb_to_linear(np.clip(value[..., None] * colour.astype(np.float32), 0, 0.92))


def pyramid(image: np.ndarray) -> list[np.ndarray]:
    """Return an image and its halvings down to 4 pixels."""
    levels = [image]
    while min(levels[-1].shape[:2]) >= 8:
        height, width = levels[-1].shape[:2]
        levels.append(
            cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        )
    return levels


def sample_pyramid(
    levels: Sequence[np.ndarray], u: np.ndarray, v: np.ndarray, texels: np.ndarray, border: int
) -> Float[np.ndarray, "n c"]:
    """Sample each point (u, v) at the level that fits `texels`, the texels of the finest level that
    it covers."""
    level = np.clip(np.rint(np.log2(np.maximum(texels, 1))), 0, len(levels) - 1).astype(np.int8)
    result = np.empty((len(u), levels[0].shape[2]), np.float32)
    for index in np.unique(level):
        on = np.flatnonzero(level == index)
        result[on] = sample_image(levels[index], u[on], v[on], border)
    return result


def sample_image(
    image: np.ndarray, u: np.ndarray, v: np.ndarray, border: int
) -> Float[np.ndarray, "n c"]:
    """Interpolate an image bilinearly at (u, v) in [0, 1], v from the top.

    Outside the image, `border` continues it as in OpenCV; with BORDER_CONSTANT, by ones.
    """
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
    found = cv2.remap(
        image, x, y, cv2.INTER_LINEAR, borderMode=border, borderValue=(1.0, 1.0, 1.0, 1.0)
    )
    return found.reshape(-1, image.shape[2])[: len(u)].astype(np.float32, copy=False)
