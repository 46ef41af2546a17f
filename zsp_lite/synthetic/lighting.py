"""Light of a room: its radiance along camera rays, and what an object at its origin receives from around."""

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.synthetic.room import Room
from zsp_lite.synthetic.sampling import look_up, pyramid, sample_pyramid

FLOOR_REACH = 25.0  # distance in units up to which the floor has depth
_FLOOR = 4  # index of the floor among the faces of a room
_PANORAMA = (16, 32)  # rows and columns
_GLOSS = 40  # exponent of the cosine over which glossy surfaces reflect


class RoomLight:
    """A room prepared for rendering; it serves any number of objects. All points are relative to the room's origin."""

    def __init__(self, room: Room):
        self.room = room
        self._images = [pyramid(image) for image in room.images]
        rows, cols = _PANORAMA
        polar = ((np.arange(rows) + 0.5) / rows * np.pi)[:, None]
        azimuth = (np.arange(cols) + 0.5) / cols * 2 * np.pi
        x, y = np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)
        directions = np.dstack([x, y, np.broadcast_to(np.cos(polar), x.shape)]).reshape(-1, 3).astype(np.float32)
        cosine, solid_angle = np.maximum(directions @ directions.T, 0), np.sqrt(1 - directions[:, 2] ** 2)
        upwards = cosine[0] * solid_angle
        self._ambient = np.zeros(3, np.float32)  # irradiance of walls and ceiling on the floor
        self._ambient = upwards @ self._seen_from_the_object(directions) / upwards.sum()
        around = self._seen_from_the_object(directions)
        lobes = (cosine * solid_angle, cosine**_GLOSS * solid_angle)
        self._matte, self._glossy = (
            (lobe @ around / lobe.sum(1, keepdims=True)).reshape(rows, cols, 3) for lobe in lobes
        )

    def irradiance(self, normal: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return the irradiance of the room, without its key light, at unblocked points with these normals."""
        return look_up(self._matte, normal)

    def reflection(self, direction: Float[np.ndarray, "n 3"], roughness: Float[np.ndarray, " n"]) -> np.ndarray:
        """Return the radiance (n, 3) of the room from these directions, blurred by the roughness."""
        rough = roughness[:, None]
        return (1 - rough) * look_up(self._glossy, direction) + rough * look_up(self._matte, direction)

    def radiance(
        self, eye: Float[np.ndarray, "3"], rays: Float[np.ndarray, "n 3"], pixel: float
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        """Return the radiance of walls and ceiling and the albedo of the floor along rays, and the reach of the floor.

        Rays start at `eye`, which is moved into the room; `pixel` is the angle between neighbours in radians. The reach
        is the ray parameter where a ray meets the floor, 0 where it does not.
        """
        low, high = (corner[:, None].astype(np.float32) for corner in (self.room.low, self.room.high))
        eye = np.clip(eye[:, None], low + 0.05, high - 0.05).astype(np.float32)
        rays = np.ascontiguousarray(np.where(np.abs(rays) < 1e-9, np.float32(1e-9), rays).T)
        reach = (np.where(rays > 0, high, low) - eye) / rays
        nearest, axis = reach.min(0), reach.argmin(0)
        face = 2 * axis + (np.take_along_axis(rays, axis[None], 0)[0] > 0)
        x, y, z = (eye + nearest * rays - low) / (high - low)
        texels = nearest * np.sqrt((rays**2).sum(0)) * pixel
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

    def _seen_from_the_object(self, directions: np.ndarray) -> np.ndarray:
        """Return the radiance of the empty room in directions (n, 3)."""
        radiance, reach = self.radiance(np.array([0, 0, 1.5]), directions, pixel=np.pi / _PANORAMA[0])
        floor = reach > 0
        radiance[floor] *= self.on_the_floor(*np.ones((2, floor.sum()), np.float32))
        return radiance
