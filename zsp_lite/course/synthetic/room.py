"""A random room around an object: floor, furnished walls, light, and a cheap camera in it.

All colours are linear unless a name says sRGB. Lengths are in units of the object, whose surface
has unit spread.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.course.synthetic.primitives import direction, rotation
from zsp_lite.course.synthetic.textures import (
    ANY_HUE,
    Colour,
    Image,
    blur,
    linear_to_srgb,
    pyramid,
    random_colour,
    sample_pyramid,
    srgb_to_linear,
    surface_albedo,
)

Vector = Float[np.ndarray, "3"]
# A row per point or ray.
Vectors = Float[np.ndarray, "n 3"]
Values = Float[np.ndarray, " n"]

FLOOR_REACH = 25.0  # distance in units up to which the floor has depth
# Indices among the faces of a room; the walls are 0 to 3.
_FLOOR = 4
_CEILING = 5
_MIDDLE = np.array([0, 0, 1.5])  # about the middle of an object of unit spread on the floor
_FLOOR_PIXELS = 1024  # along each side of the floor's image
_WALL_DENSITY = 20  # pixels per unit


@dataclass(frozen=True, eq=False)
class CheapCamera:
    """Response of a camera: from linear radiance to 8-bit sRGB."""

    exposure: float = 0.2  # mean luminance after automatic exposure, with 1 for white
    # factor per channel: the error of the automatic white balance
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    # 2.5 times the standard deviation at mid-grey, relative to white, in a picture of 256 pixels
    noise: float = 0.01
    vignetting: float = 0.1  # loss of light in the corners, as a fraction

    def exposure_gain(self, radiance: Image) -> float:
        """Return the factor of automatic exposure, which bright windows affect little."""
        luminance = radiance @ np.float32([0.2126, 0.7152, 0.0722])  # weights of ITU-R BT.709
        # The exposure follows the average of the median and of a mean that limits bright pixels.
        median = np.median(luminance)
        mean = np.minimum(luminance, 4 * median).mean()
        return float(2 * self.exposure / max(median + mean, 1e-6))

    def develop(
        self, radiance: Image, gain: float, rng: np.random.Generator
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the 8-bit picture of linear radiance; `gain` is that of `exposure_gain`."""
        height, width = radiance.shape[:2]
        pixel = min(height, width) / 256  # all blurs are given for a picture of 256 pixels
        y = np.linspace(-1, 1, height)[:, None]
        x = np.linspace(-1, 1, width)
        falloff = 1 - self.vignetting * (x**2 + y**2) / 2
        image = (radiance * (gain * falloff)[..., None] * self.white_balance).astype(np.float32)
        image = blur(image, 0.4 * pixel)  # blur of the lens
        # Noise that demosaicing smooths; 1.6 makes up for the variance that the blur takes away.
        # The variance of photon noise grows with the light, that of read noise is constant.
        noise = blur(rng.standard_normal((height, width, 3), np.float32), 0.5 * pixel)
        image = np.maximum(image + 1.6 * self.noise * noise * np.sqrt(0.16 * image + 0.006), 0)
        # A filmic tone curve, Narkowicz's fit to ACES.
        filmic = image * (2.26 * image + 0.03) / (image * (2.19 * image + 0.59) + 0.16)
        image = linear_to_srgb(np.clip(filmic, 0, 1))
        image += 0.35 * (image - blur(image, 0.9 * pixel))  # sharpening by the camera
        return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)


@dataclass(eq=False)
class Room:
    """A box around objects, and the light on them.

    The origin of all points is on the floor below the object. The box has axes of its own, turned
    about z. `images` has one image per face, in the order -x, +x, -y, +y, floor, ceiling of the
    box. The image of the floor is its albedo, the other images are radiances. The rows of a wall's
    image run down, the rows of floor and ceiling run along y. The columns run along y on the first
    two walls, and along x on the other faces.
    """

    low: Vector  # corners of the box in its axes; low[2] is 0
    high: Vector
    images: tuple[np.ndarray, ...]
    light: Vector  # unit vector towards the key light
    light_radius: float  # angular radius of the key light in radians
    light_colour: Colour  # irradiance of the key light on a surface that faces it
    camera: CheapCamera
    turn: float = 0.0  # angle in radians from the x axis of all points to that of the box

    def __post_init__(self):
        # The columns are the axes of the box: `points @ axes` are points in these.
        self.axes = rotation("z", self.turn).astype(np.float32)
        self._pyramids = [pyramid(image) for image in self.images]
        faces = np.array([image.mean((0, 1)) for image in self.images])
        # Irradiance of a surface that faces one of the six faces: half of it from there, half from
        # the four beside it.
        self._ambient = (faces[_CEILING] + faces[:_FLOOR].mean(0)) / 2
        # The albedo of the floor becomes its radiance in full light.
        unblocked = np.ones(1, np.float32)
        faces[_FLOOR] *= self.on_the_floor(unblocked, unblocked)[0]
        # The faces come in three opposite pairs; the last axis holds the colour channels.
        opposite = faces.reshape(3, 2, 3)[:, ::-1].reshape(6, 3)
        self._irradiance = (faces + (faces.sum(0) - faces - opposite) / 4) / 2

    def irradiance(self, normal: Vectors) -> Vectors:
        """Return the irradiance from the room, without its key light, where nothing blocks it."""
        # Along each axis, the normal points to one face. The squares of its coordinates are the
        # weights of these three faces; they sum to 1.
        normal = normal @ self.axes
        face = 2 * np.arange(3) + (normal > 0)
        return np.einsum("nf,nfc->nc", normal**2, self._irradiance[face])

    def reflection(self, rays: Vectors, roughness: Values) -> Vectors:
        """Return the radiance that an object receives from rays, blurred by its roughness."""
        radiance, reach = self.radiance(_MIDDLE, rays, roughness)
        floor = np.flatnonzero(reach)
        unblocked = np.ones(len(floor), np.float32)
        radiance[floor] *= self.on_the_floor(unblocked, unblocked)
        return radiance

    def radiance(
        self,
        eye: Vector,
        rays: Vectors,
        angle: float | Values,
    ) -> tuple[Vectors, Values]:
        """Return what rays meet in the room.

        Args:
            eye: where the rays start.
            rays: directions of any length.
            angle: angle in radians that each ray covers.

        Returns:
            The radiance of walls and ceiling, and the albedo of the floor; and the parameter of
            each ray at which it meets the floor, 0 for a ray that does not.
        """
        # Vectors are columns here: corners (3, 1), rays (3, n).
        low = self.low[:, None].astype(np.float32)
        high = self.high[:, None].astype(np.float32)
        size = high - low
        # An eye outside the room sees it from just inside its walls, by 0.05 units.
        eye = (eye @ self.axes)[:, None]
        eye = np.clip(eye, low + 0.05, high - 0.05).astype(np.float32)
        # No coordinate of a ray may be zero: the distances to the planes are divided by them.
        rays = rays @ self.axes
        rays = np.ascontiguousarray(np.where(np.abs(rays) < 1e-9, np.float32(1e-9), rays).T)

        # From inside a box, a ray leaves through the nearest of the three planes ahead of it.
        reach = (np.where(rays > 0, high, low) - eye) / rays
        nearest = reach.min(0)
        axis = reach.argmin(0)
        face = 2 * axis + (np.take_along_axis(rays, axis[None], 0)[0] > 0)
        x, y, z = (eye + nearest * rays - low) / size  # in [0, 1]
        width = nearest * np.sqrt((rays**2).sum(0)) * angle  # of each ray at its end, in units

        radiance = np.empty((len(nearest), 3), np.float32)
        for index, image in enumerate(self._pyramids):
            chosen = np.flatnonzero(face == index)
            columns = 1 if index < 2 else 0  # the axis along which the image's columns run
            u = (y if columns else x)[chosen]
            v = (1 - z if index < _FLOOR else y)[chosen]
            density = image[0].shape[1] / float(size[columns, 0])  # pixels per unit
            radiance[chosen] = sample_pyramid(
                image, u, v, width[chosen] * density, cv2.BORDER_REPLICATE
            )
        return radiance, np.where(face == _FLOOR, nearest, 0)

    def on_the_floor(self, key: Values, around: Values) -> Vectors:
        """Return the irradiance of the floor from the visible shares of key light and room."""
        direct = max(float(self.light[2]), 0) * self.light_colour.astype(np.float32)
        return key[:, None] * direct + around[:, None] * self._ambient


def random_room(seed: int | np.random.Generator, turn: float = 0.0) -> Room:
    """Draw a room, independent of the object; all ranges are chosen by hand."""
    rng = np.random.default_rng(seed)
    sides = rng.uniform(11.5, 17, 4)
    low = np.array([-sides[0], -sides[1], 0])
    high = np.array([sides[2], sides[3], rng.uniform(12, 14)])
    width, depth, height = high - low
    light = direction(azimuth=rng.uniform(0, 2 * np.pi), elevation=rng.uniform(0.5, 1.4))
    warmth = rng.uniform(-0.08, 0.2)  # excess of red in the key light, and lack of blue
    temperature = rng.normal(0, 0.045)  # error of the camera's white balance

    floor = _floor(rng)
    # Ranges of hue, saturation and value; three in four rooms have pale walls.
    if rng.random() < 0.75:
        wall_colour = random_colour(rng, (25, 60), (0, 0.14), (0.6, 0.92))
    else:
        wall_colour = random_colour(rng, ANY_HUE, (0, 0.4), (0.6, 0.92))
    walls = [_wall(rng, side, height, wall_colour) for side in (depth, depth, width, width)]
    ceiling = np.full((8, 8, 3), 0.7, np.float32)  # of one radiance
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
        turn=turn,
    )


def _floor(rng: np.random.Generator) -> Float[np.ndarray, "n n 3"]:
    """Return the albedo of a floor: boards, tiles or one surface, sometimes with a rug."""
    colour = random_colour(rng, (15, 60), (0.02, 0.6), (0.3, 0.8))
    tiled = rng.random() < 0.75
    floor = surface_albedo(rng, (_FLOOR_PIXELS, _FLOOR_PIXELS), colour, tiled=tiled)
    if rng.random() < 0.3:
        # The edges of the rug, in pixels, on all sides of the middle of the floor, where the object
        # stands.
        edges = _FLOOR_PIXELS * (0.5 + [-1, -1, 1, 1] * rng.uniform(0.09, 0.22, 4))
        top, left, bottom, right = edges.astype(int).tolist()
        colour = random_colour(rng, ANY_HUE, (0.02, 0.4), (0.25, 0.7))
        rug = surface_albedo(rng, (bottom - top, right - left), colour)
        floor[top:bottom, left:right] = rug
    return floor


def _wall(rng: np.random.Generator, width: float, height: float, colour: Colour) -> Image:
    """Return the radiance of a wall with rectangular blocks: furniture, pictures, windows."""
    rows = round(height * _WALL_DENSITY)
    cols = round(width * _WALL_DENSITY)
    image = surface_albedo(rng, (rows, cols), colour, grain=0.2)
    image[-8:] *= 0.4  # a dark skirting board, 0.4 units high
    left = rng.uniform(0.3, 2)
    while left < width - 2:
        wide = rng.uniform(1, 4)
        tall = rng.uniform(1.2, 5)
        hangs = rng.random() < 0.5
        # A block is a picture or a window if it hangs, otherwise a piece of furniture. Two in five
        # blocks that hang are windows; they shine, three times as bright.
        brightness = 3.0 if hangs and rng.random() < 0.4 else 1.0
        cells = _cell_colours(rng)
        bottom = rows - round(rng.uniform(2.5, 4) * _WALL_DENSITY if hangs else 0)
        block_width = round(wide * _WALL_DENSITY)
        block_height = round(tall * _WALL_DENSITY)
        block = cv2.resize(cells, (block_width, block_height), interpolation=cv2.INTER_NEAREST)
        # The part of the block that is on the wall has a dark frame of three pixels.
        start = round(left * _WALL_DENSITY)
        area = image[max(bottom - block_height, 0) : bottom, start : start + block_width]
        area[:] = 0.3 * block.mean((0, 1))
        area[3:-3, 3:-3] = (brightness * block)[3 : area.shape[0] - 3, 3 : area.shape[1] - 3]
        left += wide + rng.uniform(0.3, 4)
    return image


def _cell_colours(rng: np.random.Generator) -> Float[np.ndarray, "rows cols 3"]:
    """Draw the linear colours of the cells of a block on a wall."""
    rows = int(rng.integers(1, 5))
    cols = int(rng.choice([1, 2, 12]))  # twelve narrow cells look like books
    colour = random_colour(rng, ANY_HUE, (0, 0.4), (0.2, 0.9))
    variation = rng.normal(0, 0.12, (rows, cols, 1)) + rng.normal(0, 0.05, (rows, cols, 3))
    return srgb_to_linear(np.clip(colour + variation, 0.05, 0.95))
