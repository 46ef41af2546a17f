"""Light of a room: its radiance along camera rays, and what an object at its origin receives from around."""

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.synthetic.room import Room
from zsp_lite.synthetic.sampling import pyramid, sample_pyramid

FLOOR_REACH = 25.0  # distance in units up to which the floor has depth
_FLOOR, _CEILING = 4, 5  # among the faces of a room
_MIDDLE = np.array([0, 0, 1.5])  # about the middle of an object


class RoomLight:
    """A room prepared for rendering; it serves any number of objects. All points are relative to the room's origin."""

    def __init__(self, room: Room):
        self.room = room
        self._images = [pyramid(image) for image in room.images]
        faces = np.array([image.mean((0, 1)) for image in room.images])
        # Irradiance of a surface that faces one of the six faces: half of it from there, half from the four beside it.
        self._ambient = (faces[_CEILING] + faces[:_FLOOR].mean(0)) / 2
        faces[_FLOOR] *= self.on_the_floor(*np.ones((2, 1), np.float32))[0]
        opposite = faces.reshape(3, 2, 3)[:, ::-1].reshape(6, 3)
        self._irradiance = (faces + (faces.sum(0) - faces - opposite) / 4) / 2

    def irradiance(self, normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the irradiance of the room, without its key light, at unblocked points with these normals."""
        face = 2 * np.arange(3) + (normal > 0)
        return np.einsum("nf,nfc->nc", normal**2, self._irradiance[face])

    def reflection(
        self, direction: Float[np.ndarray, "n 3"], roughness: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """Return the radiance that an object receives from these directions, blurred by the roughness."""
        radiance, reach = self.radiance(_MIDDLE, direction, roughness)
        floor = np.flatnonzero(reach)
        radiance[floor] *= self.on_the_floor(*np.ones((2, len(floor)), np.float32))
        return radiance

    def radiance(
        self, eye: Float[np.ndarray, "3"], rays: Float[np.ndarray, "n 3"], blur: float | Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """Return the radiance of walls and ceiling and the albedo of the floor along rays, and the reach of the floor.

        Rays start at `eye`, which is moved into the room; `blur` is the angle that a ray covers, in radians. The reach
        is the ray parameter where a ray meets the floor, 0 where it does not.
        """
        low, high = (corner[:, None].astype(np.float32) for corner in (self.room.low, self.room.high))
        eye = np.clip(eye[:, None], low + 0.05, high - 0.05).astype(np.float32)
        rays = np.ascontiguousarray(np.where(np.abs(rays) < 1e-9, np.float32(1e-9), rays).T)
        reach = (np.where(rays > 0, high, low) - eye) / rays
        nearest, axis = reach.min(0), reach.argmin(0)
        face = 2 * axis + (np.take_along_axis(rays, axis[None], 0)[0] > 0)
        x, y, z = (eye + nearest * rays - low) / (high - low)
        texels = nearest * np.sqrt((rays**2).sum(0)) * blur
        radiance = np.empty((len(nearest), 3), np.float32)
        for index, image in enumerate(self._images):
            on = np.flatnonzero(face == index)
            u, v = (y if index < 2 else x)[on], (1 - z if index < _FLOOR else y)[on]
            density = image[0].shape[1] / float((high - low)[1 if index < 2 else 0, 0])
            radiance[on] = sample_pyramid(image, u, v, texels[on] * density, cv2.BORDER_REPLICATE)
        return radiance, np.where(face == _FLOOR, nearest, 0)

    def on_the_floor(self, key: Float[np.ndarray, " n"], around: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return the irradiance of the floor, from the visible shares of the key light and of the room."""
        direct = max(float(self.room.light[2]), 0) * self.room.light_colour.astype(np.float32)
        return key[:, None] * direct + around[:, None] * self._ambient
