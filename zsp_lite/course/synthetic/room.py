"""A random room around an object: a textured floor, furnished walls, its light, and a cheap camera
in it.

All colours are linear unless a name says sRGB. Lengths are in units of the object, whose surface
has unit spread.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.course.synthetic.textures import (
    blur,
    hsv,
    linear_to_srgb,
    pyramid,
    sample_pyramid,
    srgb_to_linear,
    surface,
)

FLOOR_REACH = 25.0  # distance in units up to which the floor has depth
# among the faces of a room
_FLOOR = 4
_CEILING = 5
_MIDDLE = np.array([0, 0, 1.5])  # about the middle of an object
_FLOOR_PIXELS = 1024  # along each side of the floor's image
_WALL_DENSITY = 20  # pixels per unit


@dataclass(frozen=True, eq=False)
class CheapCamera:
    """Response of a camera: from linear radiance to 8-bit sRGB."""

    exposure: float = 0.2  # mean luminance after automatic exposure, with 1 for white
    # error of automatic balance, a factor per channel
    white_balance: tuple[float, float, float] = (
        1.0,
        1.0,
        1.0,
    )
    noise: float = 0.01  # standard deviation at mid-grey, relative to white
    vignetting: float = 0.1  # loss of light in the corners, as a fraction

    def exposure_gain(self, radiance: Float[np.ndarray, "h w 3"]) -> float:
        """Return the factor of automatic exposure, from mean and median, which limits the effect of
        bright windows."""
        luminance = radiance @ np.float32([0.2126, 0.7152, 0.0722])
        median = np.median(luminance)
        return float(
            2 * self.exposure / max(median + np.minimum(luminance, 4 * median).mean(), 1e-6)
        )

    def develop(
        self, radiance: Float[np.ndarray, "h w 3"], gain: float, rng: np.random.Generator
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the 8-bit picture of linear radiance; `gain` is that of `exposure_gain`."""
        height, width = radiance.shape[:2]
        pixel = min(height, width) / 256  # blurs are those of a picture of 256 pixels
        y = np.linspace(-1, 1, height)[:, None]
        x = np.linspace(-1, 1, width)
        falloff = 1 - self.vignetting * (x**2 + y**2) / 2
        image = (radiance * (gain * falloff)[..., None] * self.white_balance).astype(np.float32)
        image = blur(image, 0.4 * pixel)  # of the lens
        # smoothed by demosaicing
        noise = blur(rng.standard_normal((height, width, 3), np.float32), 0.5 * pixel)
        image = np.maximum(image + 1.6 * self.noise * noise * np.sqrt(0.16 * image + 0.006), 0)
        # A filmic tone curve, Narkowicz's fit to ACES.
        image = linear_to_srgb(
            np.clip(image * (2.26 * image + 0.03) / (image * (2.19 * image + 0.59) + 0.16), 0, 1)
        )
        image += 0.35 * (image - blur(image, 0.9 * pixel))  # sharpening by the camera
        return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


@dataclass(eq=False)
class Room:
    """A box around objects, and the light on them; the origin of all points is on the floor below
    the object.

    `images` are those of the faces -x, +x, -y, +y, floor, ceiling: an albedo of the floor, else
    radiances. The rows of a wall run down, those of floor and ceiling along y; the columns run
    along y on the first two walls, else along x.
    """

    low: Float[np.ndarray, "3"]  # corners of the box; low[2] is 0
    high: Float[np.ndarray, "3"]
    images: tuple[np.ndarray, ...]
    light: Float[np.ndarray, "3"]  # unit vector towards the key light
    light_radius: float  # angular radius of the key light in radians
    light_colour: Float[np.ndarray, "3"]  # irradiance of the key light on a surface that faces it
    camera: CheapCamera

    def __post_init__(self):
        self._pyramids = [pyramid(image) for image in self.images]
        faces = np.array([image.mean((0, 1)) for image in self.images])
        # Irradiance of a surface that faces one of the six faces: half of it from there, half from
        # the four beside it.
        self._ambient = (faces[_CEILING] + faces[:_FLOOR].mean(0)) / 2
        faces[_FLOOR] *= self.on_the_floor(*np.ones((2, 1), np.float32))[0]
        opposite = faces.reshape(3, 2, 3)[:, ::-1].reshape(6, 3)
        self._irradiance = (faces + (faces.sum(0) - faces - opposite) / 4) / 2

    def irradiance(self, normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the irradiance of the room, without its key light, at unblocked points with these
        normals."""
        face = 2 * np.arange(3) + (normal > 0)
        return np.einsum("nf,nfc->nc", normal**2, self._irradiance[face])

    def reflection(
        self, direction: Float[np.ndarray, "n 3"], roughness: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return the radiance that an object receives from these directions, blurred by the
        roughness."""
        radiance, reach = self.radiance(_MIDDLE, direction, roughness)
        floor = np.flatnonzero(reach)
        radiance[floor] *= self.on_the_floor(*np.ones((2, len(floor)), np.float32))
        return radiance

    def radiance(
        self,
        eye: Float[np.ndarray, "3"],
        rays: Float[np.ndarray, "n 3"],
        blur: float | Float[np.ndarray, " n"],
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """Return the radiance of walls and ceiling and the albedo of the floor along rays, and the
        reach of the floor.

        Each ray covers the angle `blur`, in radians; the reach is its parameter on the floor, 0
        where it misses it.
        """
        low, high = (corner[:, None].astype(np.float32) for corner in (self.low, self.high))
        eye = np.clip(eye[:, None], low + 0.05, high - 0.05).astype(np.float32)
        rays = np.ascontiguousarray(np.where(np.abs(rays) < 1e-9, np.float32(1e-9), rays).T)
        reach = (np.where(rays > 0, high, low) - eye) / rays
        nearest = reach.min(0)
        axis = reach.argmin(0)
        face = 2 * axis + (np.take_along_axis(rays, axis[None], 0)[0] > 0)
        x, y, z = (eye + nearest * rays - low) / (high - low)
        texels = nearest * np.sqrt((rays**2).sum(0)) * blur
        radiance = np.empty((len(nearest), 3), np.float32)
        for index, image in enumerate(self._pyramids):
            on = np.flatnonzero(face == index)
            u = (y if index < 2 else x)[on]
            v = (1 - z if index < _FLOOR else y)[on]
            density = image[0].shape[1] / float((high - low)[1 if index < 2 else 0, 0])
            radiance[on] = sample_pyramid(image, u, v, texels[on] * density, cv2.BORDER_REPLICATE)
        return radiance, np.where(face == _FLOOR, nearest, 0)

    def on_the_floor(
        self, key: Float[np.ndarray, " n"], around: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return the irradiance of the floor, from the visible shares of the key light and of the
        room."""
        direct = max(float(self.light[2]), 0) * self.light_colour.astype(np.float32)
        return key[:, None] * direct + around[:, None] * self._ambient


def random_room(seed: int | np.random.Generator) -> Room:
    """Draw a room, independent of the object."""
    rng = np.random.default_rng(seed)
    sides = rng.uniform(11.5, 17, 4)
    low = np.array([-sides[0], -sides[1], 0])
    high = np.array([sides[2], sides[3], rng.uniform(12, 14)])
    width, depth, height = high - low
    azimuth = rng.uniform(0, 2 * np.pi)
    elevation = rng.uniform(0.5, 1.4)
    light = np.array(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    warmth = rng.uniform(-0.08, 0.2)
    temperature = rng.normal(0, 0.045)

    floor_colour = hsv(rng.uniform(15, 60), rng.uniform(0.02, 0.6), rng.uniform(0.3, 0.8))
    floor = surface(
        rng, (_FLOOR_PIXELS, _FLOOR_PIXELS), floor_colour, 1.0, laid=rng.random() < 0.75
    )
    if rng.random() < 0.3:  # a rug
        sides_of_rug = _FLOOR_PIXELS * (0.5 + [-1, -1, 1, 1] * rng.uniform(0.09, 0.22, 4))
        top, left, bottom, right = sides_of_rug.astype(int).tolist()
        colour = hsv(rng.uniform(0, 360), rng.uniform(0.02, 0.4), rng.uniform(0.25, 0.7))
        floor[top:bottom, left:right] = surface(rng, (bottom - top, right - left), colour, 1.0)
    pale = rng.random() < 0.75
    hue, saturation = (rng.uniform(25, 60), 0.14) if pale else (rng.uniform(0, 360), 0.4)
    wall_colour = hsv(hue, rng.uniform(0, saturation), rng.uniform(0.6, 0.92))
    walls = [_wall(rng, side, height, wall_colour) for side in (depth, depth, width, width)]
    ceiling = np.full((8, 8, 3), 0.7, np.float32)
    return Room(
        low=low,
        high=high,
        images=(*walls, floor, ceiling),
        light=light,
        light_radius=rng.uniform(0.05, 0.3),
        light_colour=rng.uniform(0.7, 1.6) * np.array([1 + warmth, 1, 1 - warmth]),
        camera=CheapCamera(
            exposure=rng.uniform(0.19, 0.3),
            white_balance=(1 + temperature, 1 + rng.normal(0, 0.012), 1 - temperature),
            noise=rng.uniform(0.01, 0.035),
            vignetting=rng.uniform(0.03, 0.25),
        ),
    )


def _wall(
    rng: np.random.Generator, width: float, height: float, colour: Float[np.ndarray, "3"]
) -> np.ndarray:
    """Return the radiance of a wall, with furniture, pictures and windows as rectangles that are
    divided into cells."""
    rows = round(height * _WALL_DENSITY)
    cols = round(width * _WALL_DENSITY)
    image = surface(rng, (rows, cols), colour, 0.2)
    image[-8:] *= 0.4  # skirting board
    left = rng.uniform(0.3, 2)
    while left < width - 2:
        wide = rng.uniform(1, 4)
        tall = rng.uniform(1.2, 5)
        hangs = rng.random() < 0.5
        # of a window, or of anything else
        brightness = 3.0 if hangs and rng.random() < 0.4 else 1.0
        # a row of twelve is one of books
        cells = (
            int(rng.integers(1, 5)),
            int(rng.choice([1, 2, 12])),
        )
        colours = hsv(rng.uniform(0, 360), rng.uniform(0, 0.4), rng.uniform(0.2, 0.9)) + np.zeros(
            (*cells, 3)
        )
        colours += rng.normal(0, 0.12, (*cells, 1)) + rng.normal(0, 0.05, (*cells, 3))
        bottom = rows - round(rng.uniform(2.5, 4) * _WALL_DENSITY if hangs else 0)
        size = (round(wide * _WALL_DENSITY), round(tall * _WALL_DENSITY))
        block = cv2.resize(
            srgb_to_linear(np.clip(colours, 0.05, 0.95)), size, interpolation=cv2.INTER_NEAREST
        )
        area = image[max(bottom - size[1], 0) : bottom, round(left * _WALL_DENSITY) :][:, : size[0]]
        area[:] = 0.3 * block.mean((0, 1))  # the frame
        area[3:-3, 3:-3] = (brightness * block)[3 : area.shape[0] - 3, 3 : area.shape[1] - 3]
        left += wide + rng.uniform(0.3, 4)
    return image
