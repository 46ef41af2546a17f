"""Light of a room on the object and on the floor, and the radiance of the room along camera rays."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.synthetic.room import Room
from zsp_lite.synthetic.sampling import look_up, pyramid, sample_image

FLOOR_REACH = 25.0  # distance in units up to which the floor has depth
_PANORAMA = (64, 128)
_SIGMAS = (0.0, 1.5, 4.0, 9.0)  # blur of the panorama in pixels, for increasing roughness
_ROUGHNESS = (0.25, 0.45, 0.65)  # limits between these blurs


@dataclass(frozen=True, eq=False)
class ShadowMap:
    """Shadow of the object on the floor, on a square grid around it.

    Attributes:
        light: Visible shares of the key light and of the room at each grid point (n, n, 2).
        half: Half the width of the grid in units.
    """

    light: Float[np.ndarray, "n n 2"]
    half: float


class RoomLight:
    """A room around an object: its radiance along rays and its irradiance at the object.

    Args:
        room: Room.
        origin: Position of the room's origin, on the floor below the object.
        shadow: Shadow of the object.
    """

    def __init__(self, room: Room, origin: Float[np.ndarray, "3"], shadow: ShadowMap):
        self.room, self._origin, self._shadow = room, origin, shadow
        self._images = [pyramid(image) for image in room.images]
        self._panoramas = self._make_panoramas()

    def irradiance(self, normal: np.ndarray) -> np.ndarray:
        """Return the irradiance (n, 3) of the room at unblocked points with normals (n, 3)."""
        return look_up(self._irradiance, normal)

    def towards(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the radiance of the room in directions (n, 3); the floor near the object is in its shadow."""
        light = look_up(self._panoramas[-1], directions)  # the smooth one: few rays per sample, little noise
        down = np.flatnonzero(directions[:, 2] < -0.02)
        reach = (self._origin[2] - origin[down, 2]) / directions[down, 2]
        point = origin[down, :2] + reach[:, None] * directions[down, :2]
        key, around = self.floor_light(point)
        cosine = max(float(self.room.light[2]), 0)
        full = self.room.ambient + cosine * self.room.light_colour
        shaded = around[:, None] * self.room.ambient + (key * cosine)[:, None] * self.room.light_colour
        light[down] = light[down] * (shaded / full).astype(np.float32)
        return light

    def reflection(self, direction: np.ndarray, roughness: np.ndarray) -> np.ndarray:
        """Return the radiance of the room in directions (n, 3), blurred by the roughness (n,)."""
        level = np.searchsorted(_ROUGHNESS, roughness)
        result = np.empty_like(direction)
        for index in np.unique(level):
            on = level == index
            result[on] = look_up(self._panoramas[index], direction[on])
        return result

    def floor_light(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the visible shares (n,) of the key light and of the room at floor points (n, 2)."""
        u, v = ((point - self._origin[:2]) / (2 * self._shadow.half) + 0.5).T
        sample = sample_image([self._shadow.light], u, v, np.ones(len(u)), cv2.BORDER_CONSTANT, (1.0, 1.0))
        return sample[:, 0], sample[:, 1]

    def _make_panoramas(self) -> list[np.ndarray]:
        """Return the radiance of the room around the object by direction, at several blurs."""
        rows, cols = _PANORAMA
        polar, azimuth = (np.arange(rows) + 0.5) / rows * np.pi, (np.arange(cols) + 0.5) / cols * 2 * np.pi
        sine = np.sin(polar)[:, None]
        directions = np.stack(
            [sine * np.cos(azimuth), sine * np.sin(azimuth), np.repeat(np.cos(polar)[:, None], cols, 1)], -1
        )
        directions = directions.reshape(-1, 3).astype(np.float32)
        eye = self._origin + np.float32([0, 0, 1.5])
        eye = np.broadcast_to(eye, directions.shape)
        radiance, _ = self.radiance(eye, directions, pixel=0.1, reflections=False)
        radiance = radiance.reshape(rows, cols, 3)
        weight = (np.sin(polar)[:, None, None] * np.ones((1, cols, 1))).astype(np.float32)
        self.mean = ((radiance * weight).sum((0, 1)) / weight.sum((0, 1))).astype(np.float32)
        above, cosine = polar < np.pi / 2, weight * np.maximum(np.cos(polar), 0).astype(np.float32)[:, None, None]
        # The light from above is that of the room's settings, with the colours and directions of its faces.
        scale = self.room.ambient.mean() / max(float(((radiance * cosine).sum((0, 1)) / cosine.sum()).mean()), 1e-6)
        radiance = (radiance * np.where(above[:, None, None], scale, 1)).astype(np.float32)
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
        self, origin: np.ndarray, rays: np.ndarray, pixel: float, reflections: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the radiance of the box's faces along rays.

        Args:
            origin: Origins (n, 3); those outside the box are moved into it.
            rays: Directions (n, 3).
            pixel: Angle between neighbouring rays in radians.
            reflections: Whether a glossy floor reflects the room.

        Returns:
            Radiance (n, 3), and the ray parameter (n,) where a ray meets the floor, 0 elsewhere.
        """
        room = self.room
        low, high = (corner.astype(np.float32) + self._origin for corner in (room.low, room.high))
        origin = np.clip(origin, low + 0.05, high - 0.05)
        safe = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
        reach = np.where(safe > 0, high - origin, low - origin) / safe
        axis = reach.argmin(1)
        distance = reach[np.arange(len(rays)), axis]
        point = origin + distance[:, None] * rays
        side = axis * 2 + (rays[np.arange(len(rays)), axis] > 0)
        share = (point - low) / (high - low)
        radiance = np.empty((len(rays), 3), np.float32)
        length = np.linalg.norm(rays, axis=1)
        footprint = pixel * distance * length
        for face in range(6):
            if not len(on := np.flatnonzero(side == face)):
                continue
            u, v = (
                (share[on, 1], 1 - share[on, 2])
                if face < 2
                else (share[on, 0], 1 - share[on, 2] if face < 4 else share[on, 1])
            )
            image = self._images[face]
            extent = (high - low)[1 if face < 2 else 0]
            # A surface that is seen at an angle is foreshortened along one axis only.
            cosine = np.abs(rays[on, axis[on]]) / length[on]
            texels = footprint[on] / np.sqrt(np.maximum(cosine, 0.04)) * image[0].shape[1] / extent
            radiance[on] = sample_image(image, u, v, texels, cv2.BORDER_REPLICATE)
        floor = np.flatnonzero(side == 4)
        key, around = self.floor_light(point[floor, :2])
        light = around[:, None] * room.ambient + (key * max(float(room.light[2]), 0))[:, None] * room.light_colour
        radiance[floor] *= light.astype(np.float32)
        if room.gloss and reflections:
            view = rays[floor] / length[floor, None]
            mirrored = view * np.float32([1, 1, -1])
            fresnel = room.gloss + (0.6 - room.gloss) * (1 + view[:, 2]) ** 5
            radiance[floor] += (fresnel * around)[:, None] * look_up(self._panoramas[1], mirrored)
        floor_depth = np.where((side == 4) & (distance < FLOOR_REACH), distance, 0).astype(np.float32)
        return radiance, floor_depth
