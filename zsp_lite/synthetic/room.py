"""Random surroundings of a photographed object: a room or a yard with textures and lights.

All colours are linear unless a name says sRGB. Lengths are in units of the object, whose surface has unit spread.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.synthetic import textures
from zsp_lite.synthetic.photography import CheapCamera
from zsp_lite.synthetic.textures import (
    asphalt,
    carpet,
    concrete,
    grass,
    hsv,
    paving,
    periodic_noise,
    planks,
    srgb_to_linear,
    tiles,
)  # fmt: skip

_FLOOR_PIXELS = 1536  # along each side of the floor's image
_WALL_DENSITY = 24  # pixels per unit


@dataclass(frozen=True, eq=False)
class Room:
    """A box around the object, with the radiance of its walls, and the light on the object.

    The origin is on the floor below the object. `images` are those of the faces -x, +x, -y, +y, floor, ceiling. The
    floor's is an albedo, the others are radiances. The rows of a wall run from the ceiling to the floor, those of the
    floor and of the ceiling along y; the columns run along y on the first two walls, along x elsewhere.
    """

    low: Float[np.ndarray, "3"]  # corners of the box; low[2] is 0
    high: Float[np.ndarray, "3"]
    images: tuple[np.ndarray, ...]  # linear, one per face
    light: Float[np.ndarray, "3"]  # unit vector towards the key light
    light_radius: float  # angular radius of the key light in radians
    light_colour: Float[np.ndarray, "3"]  # irradiance of the key light on a surface that faces it
    ambient: Float[np.ndarray, "3"]  # irradiance of everything else on an unoccluded floor
    gloss: float  # reflectance of the floor at normal incidence
    camera: CheapCamera


def random_room(seed: int | np.random.Generator) -> Room:
    """Draw surroundings, independent of the object: mostly rooms, sometimes a yard."""
    rng = np.random.default_rng(seed)
    outdoors = rng.random() < 0.2
    extent = rng.uniform(11.5, 17, 4) * (1.5 if outdoors else 1.0)
    height = rng.uniform(9, 12) * (2 if outdoors else 1)
    low, high = np.array([-extent[0], -extent[1], 0]), np.array([extent[2], extent[3], height])
    azimuth = rng.uniform(0, 2 * np.pi)
    if outdoors:
        overcast = rng.random() < 0.5
        elevation, radius = rng.uniform(0.7, 1.25), rng.uniform(0.25, 0.5) if overcast else rng.uniform(0.02, 0.05)
        strength, warmth = (rng.uniform(0.4, 0.9), 0.02) if overcast else (rng.uniform(1.5, 2.6), 0.1)
        ambient = np.array([0.93, 1.0, 1.1])
    else:
        lamp = rng.random() < 0.4
        elevation = rng.uniform(1.05, 1.4) if lamp else rng.uniform(0.5, 0.9)
        radius = rng.uniform(0.07, 0.16) if lamp else rng.uniform(0.14, 0.3)
        strength, warmth = rng.uniform(0.7, 1.6), rng.uniform(0.05, 0.2) if lamp else rng.uniform(-0.08, 0.06)
        ambient = np.array([1.02, 1.0, 0.97])
    light = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    floors = (asphalt, paving, paving, grass, concrete) if outdoors else (
        planks, planks, planks, tiles, tiles, carpet, concrete)  # fmt: skip
    make = floors[rng.integers(len(floors))]
    floor = _floor_image(make, rng, not outdoors and rng.random() < 0.25)
    wall_colour = _wall_colour(rng)
    sides = [(high - low)[1], (high - low)[1], (high - low)[0], (high - low)[0]]
    # The side of the window is the one that the light comes from.
    lit = int(np.abs(light[:2]).argmax()) * 2 + int(light[np.abs(light[:2]).argmax()] > 0)
    walls = [_facade(rng, width, height) if outdoors else
             _wall(rng, width, height, wall_colour, (k == lit) or rng.random() < 0.15)
             for k, width in enumerate(sides)]  # fmt: skip
    ceiling = np.empty((64, 64, 3), np.float32)
    ceiling[:] = (0.9, 1.15, 1.5) if outdoors else (0.72, 0.71, 0.69)
    temperature = rng.normal(0, 0.045)
    camera = CheapCamera(
        exposure=rng.uniform(0.19, 0.3),
        white_balance=(1 + temperature, 1 + rng.normal(0, 0.012), 1 - temperature),
        noise=rng.uniform(0.01, 0.035),
        blur=rng.uniform(0.3, 0.55),
        vignetting=rng.uniform(0.03, 0.25),
        defocus=rng.uniform(0.5, 1.8),
    )
    colour = strength * np.array([1 + warmth, 1, 1 - warmth])
    gloss = 0.04 if make in (planks, tiles) else 0.0
    return Room(low, high, (*walls, floor, ceiling), light, float(radius), colour, ambient, gloss, camera)


def _floor_image(make: Callable, rng: np.random.Generator, rug: bool) -> np.ndarray:
    """Return the linear albedo of the whole floor, with a rug below the object where `rug` is set."""
    repeats, texture = _FLOOR_PIXELS // textures.TILE, srgb_to_linear(np.clip(make(rng), 0, 1))
    if rng.random() < 0.5:
        texture = texture.swapaxes(0, 1)
    image = np.tile(texture, (repeats, repeats, 1))
    if rug:
        cloth = srgb_to_linear(np.clip(carpet(rng), 0, 1))
        border = srgb_to_linear(hsv(rng.uniform(0, 360), rng.uniform(0.03, 0.4), rng.uniform(0.2, 0.7)))
        half, middle = (rng.uniform(0.09, 0.22, 2) * _FLOOR_PIXELS).astype(int), _FLOOR_PIXELS // 2
        (top, left), (bottom, right) = middle - half, middle + half
        patch = np.tile(cloth, (repeats, repeats, 1))[: bottom - top, : right - left].copy()
        edge = 14
        patch[:edge] = patch[-edge:] = patch[:, :edge] = patch[:, -edge:] = border
        image[top:bottom, left:right] = patch
        image[bottom : bottom + 3, left:right] *= 0.7
    stains = cv2.resize(1 + 0.05 * periodic_noise(rng, (256, 256), 1.5), (_FLOOR_PIXELS, _FLOOR_PIXELS))
    return np.clip(image * stains[..., None], 0, 0.85)


def _wall_colour(rng: np.random.Generator) -> np.ndarray:
    """Draw the sRGB colour of a painted wall: mostly white, cream and pale tones."""
    if rng.random() < 0.75:
        return hsv(rng.uniform(25, 60), rng.uniform(0.01, 0.14), rng.uniform(0.72, 0.92))
    return hsv(rng.uniform(0, 360), rng.uniform(0.12, 0.4), rng.uniform(0.45, 0.8))


def _canvas(width: float, height: float) -> tuple[int, int]:
    return round(height * _WALL_DENSITY), round(width * _WALL_DENSITY)


def _box(image: np.ndarray, x: float, z: float, width: float, height: float, colour) -> tuple[slice, slice]:
    """Fill a rectangle whose lower left corner is at (x, z) on a wall, in units; return its rows and columns."""
    rows = image.shape[0]
    top, bottom = rows - round((z + height) * _WALL_DENSITY), rows - round(z * _WALL_DENSITY)
    area = (
        slice(max(top, 0), max(bottom, 0)),
        slice(max(round(x * _WALL_DENSITY), 0), round((x + width) * _WALL_DENSITY)),
    )
    image[area] = colour
    return area


def _wall(rng: np.random.Generator, width: float, height: float, colour: np.ndarray, window: bool) -> np.ndarray:
    """Return the radiance of an inner wall: paint, skirting board, and furniture, pictures, a door or a window."""
    rows, cols = _canvas(width, height)
    image = np.empty((rows, cols, 3), np.float32)
    image[:] = srgb_to_linear(colour)
    image *= (1 + 0.03 * cv2.resize(periodic_noise(rng, (128, 128), 1.5), (cols, rows)))[..., None]
    skirting = srgb_to_linear(hsv(30, rng.uniform(0, 0.3), rng.uniform(0.4, 0.9)))
    _box(image, 0, 0, width, 0.35, skirting)
    _box(image, 0, 0.35, width, 0.06, skirting * 0.5)
    x = rng.uniform(0.3, 2.5)
    while x < width - 2:
        kind, wide = rng.integers(5), rng.uniform(2, 4.5)
        wide = min(wide, width - x - 0.2)
        if kind == 0:  # shelf with books
            top = rng.uniform(3, 7)
            wood = srgb_to_linear(hsv(rng.uniform(20, 40), rng.uniform(0.05, 0.5), rng.uniform(0.2, 0.9)))
            _box(image, x, 0, wide, top, wood)
            level = 0.3
            while level + 1.1 < top:
                _box(image, x + 0.12, level, wide - 0.24, 1.0, wood * 0.25)
                at = x + 0.15
                while at < x + wide - 0.5:
                    thick = rng.uniform(0.08, 0.3)
                    if rng.random() < 0.8:
                        spine = hsv(rng.uniform(0, 360), 0.7 * rng.beta(1.2, 2.5), rng.uniform(0.1, 0.8))
                        _box(image, at, level, thick - 0.02, rng.uniform(0.6, 0.95), srgb_to_linear(spine))
                    at += thick
                level += 1.15
        elif kind == 1:  # picture
            tall, low = rng.uniform(1.2, 2.5), rng.uniform(3.2, 5)
            _box(image, x, low, wide * 0.7, tall, rng.uniform(0.01, 0.5))
            area = _box(image, x + 0.12, low + 0.12, wide * 0.7 - 0.24, tall - 0.24, 0)
            shape = image[area].shape[:2]
            if min(shape) > 1:
                share = np.clip(0.5 + 0.35 * cv2.resize(periodic_noise(rng, (64, 64), 1.7), shape[::-1]), 0, 1)[
                    ..., None
                ]
                one, two = (hsv(rng.uniform(0, 360), rng.uniform(0.05, 0.4), rng.uniform(0.3, 0.8)) for _ in range(2))
                one, two = srgb_to_linear(one), srgb_to_linear(two)
                image[area] = one * share + two * (1 - share)
        elif kind == 2:  # cupboard or sofa: a dark or coloured block in front of the wall
            tall = rng.uniform(1.5, 3.5)
            block = srgb_to_linear(hsv(rng.uniform(0, 360), rng.uniform(0.03, 0.35), rng.uniform(0.15, 0.75)))
            _box(image, x, 0.15, wide, tall, block)
            _box(image, x, 0, wide, 0.15, block * 0.1)
            for k in range(1, int(rng.integers(1, 5))):
                _box(image, x + wide * k / 4, 0.25, 0.05, tall - 0.2, block * 0.4)
            _box(image, x, tall, wide, 0.12, np.minimum(block * 1.5, 0.9))
        elif kind == 3 and rng.random() < 0.5:  # door
            paint = srgb_to_linear(hsv(30, rng.uniform(0, 0.5), rng.uniform(0.4, 0.9)))
            _box(image, x - 0.15, 0, 2.9, 6.6, paint * 0.7)
            _box(image, x, 0, 2.6, 6.45, paint)
            _box(image, x + 2.25, 3, 0.2, 0.12, 0.3)
            wide = 3
        x += wide + rng.uniform(0.4, 3.5)
    if window:
        wide, tall, low = min(rng.uniform(4, 8), width * 0.6), rng.uniform(3.5, 5.5), rng.uniform(2.2, 3.2)
        x = rng.uniform(0.5, width - wide - 0.5)
        _box(image, x - 0.2, low - 0.2, wide + 0.4, tall + 0.4, 0.75)
        area = _box(image, x, low, wide, tall, 3.0)
        view = np.linspace(4.5, 1.6, image[area].shape[0], dtype=np.float32)[:, None, None]
        image[area] = view * np.float32([0.92, 1, 1.08])
        for k in range(1, int(rng.integers(2, 4))):
            _box(image, x + wide * k / 3, low, 0.14, tall, 0.7)
        if rng.random() < 0.6:
            cloth = srgb_to_linear(hsv(rng.uniform(0, 360), rng.uniform(0, 0.4), rng.uniform(0.5, 0.95)))
            for start in (x - 0.9, x + wide - 0.3):
                area = _box(image, start, 0.4, 1.3, low + tall, 0)
                folds = 0.75 + 0.25 * np.sin(np.linspace(0, rng.uniform(15, 30), image[area].shape[1]))
                image[area] = cloth * folds[None, :, None]
    ramp_x = 1 - 0.3 * np.exp(-np.minimum(np.arange(cols), cols - 1 - np.arange(cols)) / (1.5 * _WALL_DENSITY))
    ramp_z = 1 - 0.35 * np.exp(-np.arange(rows)[::-1] / (1.2 * _WALL_DENSITY))
    return image * (0.85 * ramp_z[:, None] * ramp_x)[..., None].astype(np.float32)


def _facade(rng: np.random.Generator, width: float, height: float) -> np.ndarray:
    """Return the radiance of the surroundings of a yard: a house, a hedge or trees, and sky above."""
    rows, cols = _canvas(width, height)
    sky = np.linspace(0, 1, rows, dtype=np.float32)[:, None, None]
    image = np.broadcast_to(
        np.float32([0.75, 1.0, 1.4]) * (1 - sky) + np.float32([1.3, 1.35, 1.4]) * sky, (rows, cols, 3)
    )
    image = image * (1 + 0.12 * cv2.resize(periodic_noise(rng, (128, 128), 1.7), (cols, rows)))[..., None]
    height_of = (rng.uniform(2.5, 8) + 0.8 * np.cumsum(rng.normal(0, 0.06, cols))).clip(1.5) * _WALL_DENSITY
    if rng.random() < 0.5:  # leaves
        value = np.exp(0.5 * cv2.resize(periodic_noise(rng, (512, 512), 0.9), (cols, rows)))[..., None]
        plants = srgb_to_linear(hsv(rng.uniform(75, 120), rng.uniform(0.3, 0.6), rng.uniform(0.3, 0.5))) * value
        outline = height_of + 6 * periodic_noise(rng, (1, cols), 0.6)[0]
        below = (rows - np.arange(rows))[:, None] < outline
        image = np.where(below[..., None], plants, image)
    else:  # house
        paint = srgb_to_linear(hsv(float(rng.choice([15, 30, 45])), rng.uniform(0.05, 0.45), rng.uniform(0.5, 0.85)))
        courses = 1 + 0.06 * cv2.resize(periodic_noise(rng, (256, 256), 0.5, (1, 3)), (cols, rows))
        tall = rng.uniform(0.6, 1.0) * height
        area = _box(image, 0, 0, width, tall, 0)
        image[area] = paint * courses[area][..., None]
        for floor in np.arange(1.5, tall - 4, 6):
            for x in np.arange(rng.uniform(1, 4), width - 4, rng.uniform(5, 8)):
                _box(image, x - 0.2, floor - 0.2, 2.9, 3.9, 0.6)
                _box(image, x, floor, 2.5, 3.5, np.float32([0.08, 0.1, 0.12]) * rng.uniform(0.5, 3))
                _box(image, x + 1.2, floor, 0.1, 3.5, 0.6)
    return np.asarray(image, np.float32)
