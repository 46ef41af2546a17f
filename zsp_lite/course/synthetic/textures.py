"""Colours, smooth noise, the albedo of floors and walls, and sampling between pixels."""

from collections.abc import Sequence
from colorsys import hsv_to_rgb

import cv2
import numpy as np
from jaxtyping import Float

Colour = Float[np.ndarray, "3"]
# A colour, vector or point per pixel.
Image = Float[np.ndarray, "h w 3"]
# A number per pixel.
Map = Float[np.ndarray, "h w"]
ANY_HUE = (0, 360)  # range in degrees

_FOLD = 4096  # points per row of OpenCV's maps, whose sides are limited to 32,767
_JOINT = 3  # pixels between boards or tiles
# Layers of grain from fine to cloudy, each with its width in pixels and its amount.
_GRAIN = ((1.0, 0.1), (6.0, 0.06), (60.0, 0.05))


# Both conversions have the constants of the sRGB standard, IEC 61966-2-1.
def srgb_to_linear(colour: np.ndarray) -> np.ndarray:
    """Convert sRGB colours in [0, 1] to linear ones."""
    colour = np.asarray(colour, np.float32)
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(colour: np.ndarray) -> np.ndarray:
    """Convert linear colours in [0, 1] to sRGB; the inverse of `srgb_to_linear`."""
    colour = np.asarray(colour, np.float32)
    return np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * colour ** (1 / 2.4) - 0.055)


def random_colour(
    rng: np.random.Generator,
    hue: tuple[float, float],
    saturation: tuple[float, float],
    value: tuple[float, float],
) -> Colour:
    """Draw an sRGB colour from ranges of hue (in degrees), saturation and value."""
    return np.array(
        hsv_to_rgb(rng.uniform(*hue) / 360, rng.uniform(*saturation), rng.uniform(*value))
    )


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Blur an image by a Gaussian; a sigma below 0.2 pixels changes nothing."""
    # OpenCV refuses a sigma of 0.
    return cv2.GaussianBlur(image, (0, 0), max(sigma, 0.2), borderType=cv2.BORDER_REFLECT)


def smooth_noise(
    rng: np.random.Generator, size: tuple[int, int], sigma: float, stretch: float = 1.0
) -> Map:
    """Return smooth Gaussian noise of unit variance.

    It is smoothed over `sigma` pixels down the columns and `sigma * stretch` along the rows.
    """
    smoothing = np.array([sigma, sigma * stretch])
    step = np.maximum(smoothing / 2, 1)  # broad noise is drawn on a coarser grid
    # Two more cells let even the broadest noise vary over the image.
    height, width = (np.ceil(np.array(size) / step) + 2).astype(int).tolist()
    noise = rng.standard_normal((height, width), np.float32)
    down, along = smoothing / step
    noise = cv2.GaussianBlur(
        noise, (0, 0), sigmaX=along, sigmaY=down, borderType=cv2.BORDER_REFLECT
    )
    noise = cv2.resize(noise, size[::-1], interpolation=cv2.INTER_CUBIC)
    return noise / (noise.std() + 1e-6)


def surface_albedo(
    rng: np.random.Generator,
    size: tuple[int, int],
    colour: Colour,
    grain: float = 1.0,
    tiled: bool = False,
) -> Image:
    """Return the albedo of a surface with grain about an sRGB colour.

    The factor `grain` weakens the grain. With `tiled`, the surface consists of boards or tiles.
    """
    stretch = 1.0
    brightness = np.ones(size, np.float32)
    if tiled:
        # Tiles are square; boards are 4 or 10 times as wide as high, with the long grain of wood.
        height = int(rng.integers(40, 160))  # pixels
        width = int(height * rng.choice([1, 4, 10]))
        stretch = 1.0 if width == height else 12.0
        brightness = _tiles(rng, size, height, width)
    for sigma, amount in _GRAIN:
        brightness += grain * rng.uniform(0.3, 1) * amount * smooth_noise(rng, size, sigma, stretch)
    # No surface of a room is whiter than sRGB 0.92.
    return srgb_to_linear(np.clip(brightness[..., None] * colour.astype(np.float32), 0, 0.92))


def _tiles(rng: np.random.Generator, size: tuple[int, int], height: int, width: int) -> Map:
    """Return the brightness (about 1) of tiles that differ at random, with dark joints."""
    row = np.arange(size[0])[:, None]
    # Each row of tiles is shifted by the same offset against the row before it.
    column = np.arange(size[1]) + row // height * rng.integers(1, width)
    shape = (size[0] // height + 1, column.max() // width + 1)
    of_tile = rng.normal(1, rng.uniform(0.02, 0.1), shape)
    joint = (row % height < _JOINT) | (column % width < _JOINT)
    of_joint = rng.uniform(0.5, 0.8)
    return np.where(joint, of_joint, of_tile[row // height, column // width]).astype(np.float32)


def pyramid(image: np.ndarray) -> list[np.ndarray]:
    """Return an image and its halvings down to 4 pixels."""
    levels = [image]
    while min(image.shape[:2]) >= 8:
        height, width = image.shape[:2]
        image = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        levels.append(image)
    return levels


def sample_pyramid(
    levels: Sequence[np.ndarray], u: np.ndarray, v: np.ndarray, footprint: np.ndarray, border: int
) -> Float[np.ndarray, "n c"]:
    """Interpolate each point in the level whose pixels are about as wide as its footprint.

    The footprint (n,) is given in pixels of the finest level. For the other arguments, see
    `sample_image`.
    """
    level = np.clip(np.rint(np.log2(np.maximum(footprint, 1))), 0, len(levels) - 1).astype(np.int8)
    samples = np.empty((len(u), levels[0].shape[2]), np.float32)
    for index in np.unique(level):
        chosen = np.flatnonzero(level == index)
        samples[chosen] = sample_image(levels[index], u[chosen], v[chosen], border)
    return samples


def sample_image(
    image: np.ndarray, u: np.ndarray, v: np.ndarray, border: int
) -> Float[np.ndarray, "n c"]:
    """Interpolate an image bilinearly at (u, v) in [0, 1], v from the top.

    Outside the image, `border` continues it as in OpenCV; with BORDER_CONSTANT, by ones.
    """
    # Points far outside the image would lose precision in OpenCV's pixel coordinates.
    if border == cv2.BORDER_WRAP:
        u = u % 1
        v = v % 1
    height, width, channels = image.shape
    if not len(u):
        return np.empty((0, channels), np.float32)
    # In OpenCV's pixel coordinates, the centre of the first pixel is at 0.
    places = np.stack([u * width, v * height]) - 0.5
    places = np.pad(places, ((0, 0), (0, -len(u) % _FOLD))).astype(np.float32)
    x, y = places.reshape(2, -1, _FOLD)
    samples = cv2.remap(
        image, x, y, cv2.INTER_LINEAR, borderMode=border, borderValue=(1.0, 1.0, 1.0, 1.0)
    )
    return samples.reshape(-1, channels)[: len(u)].astype(np.float32, copy=False)
