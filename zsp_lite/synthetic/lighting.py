"""Light of a room on an object and on its floor, and the radiance of the room along camera rays."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.synthetic.room import Room
from zsp_lite.synthetic.sampling import look_up, pyramid, sample_image

FLOOR_REACH = 25.0  # distance in units up to which the floor has depth
_FLOOR = 4  # index of the floor among the faces of a room
_PANORAMA = (64, 128)
_SIGMAS = (0.0, 1.5, 4.0, 9.0)  # blur of the panorama in pixels, for increasing roughness
_ROUGHNESS = (0.25, 0.45, 0.65)  # limits between these blurs


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """Shadow of the object on the floor: the visible shares of the key light and of the room on a square grid.

    The grid is centred at the object; `half` is half its width in units.
    """

    light: Float[np.ndarray, "n n 2"]
    half: float

    def at(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the visible shares (n,) of the key light and of the room at floor points (n, 2)."""
        u, v = (point / (2 * self.half) + 0.5).T
        sample = sample_image([self.light], u, v, None, cv2.BORDER_CONSTANT, (1.0, 1.0))
        return sample[:, 0], sample[:, 1]


class RoomLight:
    """Light of a room: its radiance along rays, and the light that an object at its origin receives.

    All points are relative to the room's origin. An instance serves any number of objects.
    """

    def __init__(self, room: Room):
        self.room = room
        self._images = [pyramid(image) for image in room.images]
        self._panoramas = self._make_panoramas()

    def irradiance(self, normal: np.ndarray) -> np.ndarray:
        """Return the irradiance (n, 3) of the room at unblocked points with normals (n, 3)."""
        return look_up(self._irradiance, normal)

    def towards(self, origin: np.ndarray, directions: np.ndarray, shadow: ShadowMap) -> np.ndarray:
        """Return the radiance of the room in directions (n, 3); the floor near the object is in its shadow."""
        light = look_up(self._panoramas[-1], directions)  # the smooth one: few rays per sample, little noise
        down = np.flatnonzero(directions[:, 2] < -0.02)
        reach = -origin[down, 2] / directions[down, 2]
        point = origin[down, :2] + reach[:, None] * directions[down, :2]
        key, around = shadow.at(point)
        light[down] *= self._floor_irradiance(key, around) / self._floor_irradiance(np.ones(1), np.ones(1))
        return light

    def _floor_irradiance(self, key: np.ndarray, around: np.ndarray) -> Float[np.ndarray, "n 3"]:
        """Return the irradiance of the floor for visible shares (n,) of the key light and of the room."""
        shares = np.stack([around, key * max(float(self.room.light[2]), 0)], 1).astype(np.float32)
        return shares @ np.stack([self.room.ambient, self.room.light_colour]).astype(np.float32)

    def reflection(self, direction: np.ndarray, roughness: np.ndarray) -> np.ndarray:
        """Return the radiance of the room in directions (n, 3), blurred by the roughness (n,)."""
        level = np.searchsorted(_ROUGHNESS, roughness)
        result = np.empty_like(direction)
        for index in np.flatnonzero(np.bincount(level)):
            on = np.flatnonzero(level == index)
            result[on] = look_up(self._panoramas[index], direction[on])
        return result

    def _make_panoramas(self) -> list[np.ndarray]:
        """Return the radiance of the room around the object by direction, at several blurs."""
        rows, cols = _PANORAMA
        polar, azimuth = (np.arange(rows) + 0.5) / rows * np.pi, (np.arange(cols) + 0.5) / cols * 2 * np.pi
        sine = np.sin(polar)[:, None]
        directions = np.stack(
            [sine * np.cos(azimuth), sine * np.sin(azimuth), np.repeat(np.cos(polar)[:, None], cols, 1)], -1
        )
        directions = directions.reshape(-1, 3).astype(np.float32)
        radiance, _ = self.radiance(np.array([0, 0, 1.5]), directions, pixel=0.1)
        radiance = radiance.reshape(rows, cols, 3)
        weight = (np.sin(polar)[:, None, None] * np.ones((1, cols, 1))).astype(np.float32)
        self.mean = ((radiance * weight).sum((0, 1)) / weight.sum((0, 1))).astype(np.float32)
        above, cosine = polar < np.pi / 2, weight * np.maximum(np.cos(polar), 0).astype(np.float32)[:, None, None]
        # The light from above is that of the room's settings, with the colours and directions of its faces.
        self.gain = self.room.ambient.mean() / max(float(((radiance * cosine).sum((0, 1)) / cosine.sum()).mean()), 1e-6)
        radiance = (radiance * np.where(above[:, None, None], self.gain, 1)).astype(np.float32)
        # Irradiance by normal: mean radiance of the half space, weighted by the cosine, over every second direction.
        flat = directions.reshape(rows, cols, 3)[::2, ::2].reshape(-1, 3)
        normals = directions.reshape(rows, cols, 3)[2::4, 2::4].reshape(-1, 3)
        cosine = np.maximum(normals @ flat.T, 0) * weight[::2, ::2].ravel()
        mean = cosine @ radiance[::2, ::2].reshape(-1, 3) / cosine.sum(1, keepdims=True)
        self._irradiance = mean.reshape(rows // 4, cols // 4, 3).astype(np.float32)
        wide = np.concatenate([radiance] * 3, 1)
        return [radiance if s == 0 else np.ascontiguousarray(cv2.GaussianBlur(wide, (0, 0), s)[:, cols : 2 * cols])
                for s in _SIGMAS]  # fmt: skip

    def radiance(
        self, eye: Float[np.ndarray, "3"], rays: Float[np.ndarray, "n 3"], pixel: float, shadow: ShadowMap | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the radiance (n, 3) of the box along rays, and the ray parameter (n,) where a ray meets the floor.

        Rays start at `eye`, which is moved into the box; `pixel` is the angle between neighbours in radians. The
        parameter is 0 off the floor. Without a shadow, the room is empty, and a glossy floor does not reflect it.
        """
        room = self.room
        low, high = room.low.astype(np.float32), room.high.astype(np.float32)
        eye = np.clip(eye, low + 0.05, high - 0.05).astype(np.float32)
        columns = [np.where(np.abs(ray) < 1e-9, np.float32(1e-9), ray) for ray in rays.T]
        reach = [(np.where(ray > 0, high[k], low[k]) - eye[k]) / ray for k, ray in enumerate(columns)]
        distance = np.minimum(np.minimum(reach[0], reach[1]), reach[2])
        radiance, floor_depth = np.empty((len(rays), 3), np.float32), np.zeros(len(rays), np.float32)
        length = np.sqrt(columns[0] ** 2 + columns[1] ** 2 + columns[2] ** 2)
        floor = None
        for face in range(6):
            axis, along = face // 2, columns[face // 2]
            on = np.flatnonzero((distance == reach[axis]) & ((along > 0) == face % 2))
            if not len(on):
                continue
            reached = distance[on]
            x, y, z = ((eye[k] - low[k] + reached * columns[k][on]) / (high[k] - low[k]) for k in range(3))
            u, v = y if axis == 0 else x, y if axis == 2 else 1 - z
            image = self._images[face]
            extent = (high - low)[1 if axis == 0 else 0]
            # A surface that is seen at an angle is foreshortened along one axis only.
            slant = np.sqrt(np.maximum(np.abs(along[on]) / length[on], 0.04))
            texels = reached * length[on] / slant * (pixel * image[0].shape[1] / extent)
            radiance[on] = sample_image(image, u, v, texels, cv2.BORDER_REPLICATE)
            if face == _FLOOR:
                floor, point = on, np.stack([x, y], 1) * (high - low)[:2] + low[:2]
                floor_depth[on] = np.where(reached < FLOOR_REACH, reached, 0)
        if floor is None:
            return radiance, floor_depth
        key, around = shadow.at(point) if shadow else np.ones((2, len(floor)), np.float32)
        radiance[floor] *= self._floor_irradiance(key, around)
        if room.gloss and shadow:
            mirrored = rays[floor] * np.float32([1, 1, -1])
            fresnel = room.gloss + (0.6 - room.gloss) * (1 + columns[2][floor] / length[floor]) ** 5
            radiance[floor] += (fresnel * around)[:, None] * look_up(self._panoramas[1], mirrored)
        return radiance, floor_depth
