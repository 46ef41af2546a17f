"""Procedural textures of floors, which repeat without seams; sRGB colours in [0, 1] unless stated otherwise."""

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float

TILE = 768  # pixels along each side
Texture = Float[np.ndarray, "n n 3"]


def srgb_to_linear(colour) -> np.ndarray:
    """Convert sRGB colours in [0, 1] to linear ones."""
    colour = np.asarray(colour, np.float32)
    if not colour.size:
        return colour
    curve = cv2.pow((colour.reshape(-1, 1) + np.float32(0.055)) / np.float32(1.055), 2.4).reshape(colour.shape)
    return np.where(colour <= 0.04045, colour / np.float32(12.92), curve)


def linear_to_srgb(colour) -> np.ndarray:
    """Convert linear colours in [0, 1] to sRGB; the inverse of `srgb_to_linear`."""
    colour = np.asarray(colour, np.float32)
    curve = cv2.pow(colour.reshape(-1, 1), 1 / 2.4).reshape(colour.shape)
    return np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * curve - 0.055)


def periodic_noise(
    rng: np.random.Generator, size: tuple[int, int], slope: float, stretch: tuple[float, float] = (1, 1)
):
    """Return periodic noise (float32) of zero mean and unit variance with a spectrum of frequency^-slope.

    A `stretch` of (1, 8) makes structures eight times as long along the columns.
    """
    spectrum = np.fft.rfft2(rng.standard_normal(size, np.float32)) * _amplitude(size, slope, stretch)
    noise = np.fft.irfft2(spectrum, size)
    return (noise / noise.std()).astype(np.float32)


@lru_cache(maxsize=32)
def _amplitude(size: tuple[int, int], slope: float, stretch: tuple[float, float]) -> np.ndarray:
    fy, fx = np.fft.fftfreq(size[0])[:, None] * size[0], np.fft.rfftfreq(size[1]) * size[1]
    frequency = np.hypot(fy * stretch[0], fx * stretch[1])
    frequency[0, 0] = np.inf
    return (frequency**-slope).astype(np.float32)


def hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    k = (np.array([5, 3, 1]) + hue / 60) % 6
    return value - value * saturation * np.clip(np.minimum(k, 4 - k), 0, 1)


def planks(rng: np.random.Generator) -> Texture:
    """Return boards of wood with grain, seams and differences between boards."""
    n = TILE
    base = hsv(rng.uniform(20, 36), rng.uniform(0.25, 0.6), rng.uniform(0.3, 0.75))
    rows = int(rng.choice([6, 8, 12]))
    width, length = n // rows, n // int(rng.choice([1, 2]))
    fine, broad = periodic_noise(rng, (n, n), 0.9, (1, 14)), periodic_noise(rng, (n, n), 1.4, (1, 6))
    grain = np.empty((n, n), np.float32)
    tone, seam = np.empty((n, n), np.float32), np.ones((n, n), np.float32)
    for row in range(rows):
        band = slice(row * width, (row + 1) * width)
        shift = int(rng.integers(n))
        grain[band] = np.roll(0.6 * fine + 0.5 * broad, (int(rng.integers(n)), shift), (0, 1))[band]
        start = int(rng.integers(length))
        for board in range(n // length + 1):
            columns = np.arange(start + board * length, start + (board + 1) * length) % n
            tone[band, columns] = rng.normal(0, 0.09)
            seam[band, columns[:2]] = 0.55
        seam[row * width : row * width + 2] = 0.5
    value = 1 + tone + 0.1 * grain * rng.uniform(0.5, 1.3)
    warm = np.stack([value, value**1.12, value**1.3], -1)
    return base * warm * cv2.GaussianBlur(seam, (0, 0), 0.7)[..., None]


def tiles(rng: np.random.Generator) -> Texture:
    """Return ceramic tiles with joints."""
    n, count = TILE, int(rng.choice([4, 6, 8]))
    base = hsv(rng.uniform(15, 230), rng.uniform(0.02, 0.15), rng.uniform(0.45, 0.88))
    side, marble = n // count, periodic_noise(rng, (n, n), 1.6)
    value, joint = np.ones((n, n), np.float32), np.zeros((n, n), np.float32)
    for i in range(count):
        for j in range(count):
            cell = np.s_[i * side : (i + 1) * side, j * side : (j + 1) * side]
            turned = np.rot90(np.roll(marble, rng.integers(n, size=2), (0, 1)), rng.integers(4))
            value[cell] = 1 + rng.normal(0, 0.025) + 0.06 * turned[cell]
    for k in range(count):
        joint[k * side : k * side + 4] = joint[:, k * side : k * side + 4] = 1
    joint = cv2.GaussianBlur(joint, (0, 0), 0.8)[..., None]
    dirt = 1 + 0.04 * periodic_noise(rng, (n, n), 1.2)
    return (base * value[..., None] * (1 - joint) + base * rng.uniform(0.5, 0.8) * joint) * dirt[..., None]


def carpet(rng: np.random.Generator) -> Texture:
    """Return a carpet: fine, irregular loops."""
    n = TILE
    base = hsv(rng.uniform(0, 360), rng.uniform(0.02, 0.2), rng.uniform(0.25, 0.7))
    value = 1 + 0.13 * periodic_noise(rng, (n, n), 0.3) + 0.05 * periodic_noise(rng, (n, n), 1.5)
    return base * value[..., None] * (1 + 0.02 * rng.standard_normal((n, n, 3)))


def concrete(rng: np.random.Generator) -> Texture:
    """Return concrete or stone with stains."""
    n = TILE
    base = hsv(rng.uniform(25, 60), rng.uniform(0, 0.1), rng.uniform(0.4, 0.7))
    value = 1 + 0.035 * periodic_noise(rng, (n, n), 1.3) + 0.035 * periodic_noise(rng, (n, n), 0.6)
    pores = (periodic_noise(rng, (n, n), 0.5) > 2.7).astype(np.float32)
    return base * (value - 0.2 * cv2.GaussianBlur(pores, (0, 0), 0.8))[..., None]


def asphalt(rng: np.random.Generator) -> Texture:
    """Return asphalt: dark, with grains of stone."""
    n = TILE
    value = rng.uniform(0.28, 0.45) * (
        1 + 0.2 * periodic_noise(rng, (n, n), 0.25) + 0.07 * periodic_noise(rng, (n, n), 1.4)
    )
    return value[..., None] * np.array([1.0, 0.99, 0.97])


def paving(rng: np.random.Generator) -> Texture:
    """Return paving stones in staggered rows."""
    n, rows = TILE, int(rng.choice([8, 12]))
    base = hsv(float(rng.choice([15, 30, 40, 220])), rng.uniform(0.04, 0.3), rng.uniform(0.4, 0.65))
    height, width = n // rows, n // rows * 2
    value, joint = np.empty((n, n), np.float32), np.zeros((n, n), np.float32)
    for row in range(rows):
        band, start = slice(row * height, (row + 1) * height), (row % 2) * width // 2
        for stone in range(n // width):
            columns = (start + stone * width + np.arange(width)) % n
            value[band, columns] = 1 + rng.normal(0, 0.09)
            joint[band, columns[:3]] = 1
        joint[row * height : row * height + 3] = 1
    value += 0.09 * periodic_noise(rng, (n, n), 0.6) + 0.04 * periodic_noise(rng, (n, n), 1.5)
    return base * (value * (1 - 0.5 * cv2.GaussianBlur(joint, (0, 0), 1.0)))[..., None]


def grass(rng: np.random.Generator) -> Texture:
    """Return a lawn."""
    n = TILE
    blades = periodic_noise(rng, (n, n), 0.3, (1.8, 1)) + 0.25 * periodic_noise(rng, (n, n), 1.0)
    green, straw = hsv(rng.uniform(70, 95), rng.uniform(0.35, 0.5), 0.42), hsv(50, 0.4, 0.5)
    share = np.clip(0.3 + 0.1 * periodic_noise(rng, (n, n), 1.0), 0, 0.7)[..., None]
    return (green * (1 - share) + straw * share) * (1 + 0.22 * blades)[..., None]
