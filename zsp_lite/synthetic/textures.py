"""Colours, smooth noise, and the picture of a floor or of a wall."""

import cv2
import numpy as np
from jaxtyping import Float


def srgb_to_linear(colour) -> np.ndarray:
    """Convert sRGB colours in [0, 1] to linear ones."""
    colour = np.asarray(colour, np.float32)
    return np.where(colour <= 0.04045, colour / np.float32(12.92), ((colour + 0.055) / 1.055) ** np.float32(2.4))


def linear_to_srgb(colour) -> np.ndarray:
    """Convert linear colours in [0, 1] to sRGB; the inverse of `srgb_to_linear`."""
    colour = np.asarray(colour, np.float32)
    return np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * colour ** np.float32(1 / 2.4) - 0.055)


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
    """Return Gaussian noise of unit variance, smoothed over `sigma` pixels, and `stretch` times as many along rows."""
    smoothing = np.array([sigma, sigma * stretch])
    step = np.maximum(smoothing / 2, 1)  # broad noise is drawn on a coarser grid
    height, width = (np.ceil(np.array(size) / step) + 2).astype(int).tolist()
    noise = rng.standard_normal((height, width), np.float32)
    down, along = smoothing / step
    noise = cv2.GaussianBlur(noise, (0, 0), sigmaX=along, sigmaY=down, borderType=cv2.BORDER_REFLECT)
    noise = cv2.resize(noise, size[::-1], interpolation=cv2.INTER_CUBIC)
    return noise / (noise.std() + 1e-6)


def surface(
    rng: np.random.Generator, size: tuple[int, int], colour: Float[np.ndarray, "3"], grain: float, laid: bool = False
) -> Float[np.ndarray, "h w 3"]:
    """Return the linear colours of a surface around an sRGB colour, with grain, and with boards or tiles if `laid`."""
    height, width = size
    stretch = 1.0
    value = np.ones(size, np.float32)
    if laid:
        tile = rng.integers(40, 160)  # pixels
        board = int(tile * rng.choice([1, 4, 10]))
        stretch = 1.0 if board == tile else 12.0  # boards have the grain of wood
        row = np.arange(height)[:, None]
        column = np.arange(width) + row // tile * rng.integers(1, board)  # each row begins elsewhere
        of_board = rng.normal(1, rng.uniform(0.02, 0.1), (height // tile + 1, column.max() // board + 1))
        joint = (row % tile < 3) | (column % board < 3)
        value = np.where(joint, rng.uniform(0.5, 0.8), of_board[row // tile, column // board]).astype(np.float32)
    for sigma, amount in ((1.0, 0.1), (6.0, 0.06), (60.0, 0.05)):
        value += grain * rng.uniform(0.3, 1) * amount * smooth_noise(rng, size, sigma, stretch)
    return srgb_to_linear(np.clip(value[..., None] * colour.astype(np.float32), 0, 0.92))
