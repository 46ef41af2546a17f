"""A CPU renderer: Open3D casts the rays, NumPy shades them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.data.cameras import Camera
from zsp_lite.io.open3d import load_open3d
from zsp_lite.synthetic.appearance import Appearance, backdrop, surface_albedo
from zsp_lite.synthetic.assembly import Shape


@dataclass(frozen=True)
class Rendering:
    """One view with everything a renderer knows about it.

    `depth` is the z coordinate in the camera frame, 0 where no surface is hit; `canonical` holds the object
    coordinates of each object pixel and `normals` its normal in the camera frame, NaN and 0 elsewhere.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    canonical: Float[np.ndarray, "h w 3"]
    normals: Float[np.ndarray, "h w 3"]
    camera: Camera


def orbit_pose(azimuth: float, elevation: float, roll: float, distance: float, target) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotation (3, 3) and translation (3,) of a camera on a sphere about `target`, looking at it.

    Angles in radians; azimuth 0 stands in front of the object, at +x; roll turns the camera about its axis.
    """
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    forward = -away
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    c, s = np.cos(roll), np.sin(roll)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.stack([right, np.cross(forward, right), forward])
    return R, -R @ (np.asarray(target, float) + away * distance)


def framed_camera(vertices: Float[np.ndarray, "v 3"], R: np.ndarray, t: np.ndarray, size: int, margin: float = 1.1,
                  shift: Float[np.ndarray, "2"] | None = None) -> Camera:  # fmt: skip
    """A square camera at pose R, t whose image of `size` pixels just holds all vertices.

    The object's bounding square is enlarged by the factor `margin` and moved by `shift`, a fraction of its width.
    """
    in_camera = vertices @ R.T + t
    plane = in_camera[:, :2] / in_camera[:, 2:]
    low, high = plane.min(0), plane.max(0)
    width = (high - low).max() * margin
    centre = (low + high) / 2 + (0 if shift is None else np.asarray(shift) * width)
    focal = size / width
    return Camera(R, t, np.array([focal, focal]), size / 2 - centre * focal, (size, size))


class Scene:
    """One object, ready for rays; `vertices` replaces the shape's own, for a deformed copy."""

    def __init__(self, shape: Shape, vertices: Float[np.ndarray, "v 3"] | None = None):
        o3d = load_open3d()
        self.shape = shape
        self.vertices = shape.vertices if vertices is None else vertices
        self._tensor = o3d.core.Tensor
        self._rays = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._rays.add_triangles(
            self._tensor(self.vertices.astype(np.float32)), self._tensor(shape.faces.astype(np.uint32))
        )
        self.floor = float(self.vertices[:, 2].min())
        self.centre = (self.vertices.max(0) + self.vertices.min(0)) / 2

    def render(
        self, camera: Camera, look: Appearance, seed: int | np.random.Generator, shadows: bool = True
    ) -> Rendering:
        """Render the object on its floor before its wall; `seed` draws the sensor noise."""
        rng = np.random.default_rng(seed)
        height, width = camera.size
        R, eye = camera.R.astype(np.float32), camera.centre.astype(np.float32)
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        plane = (np.stack([x, y], -1) - camera.principal_point) / camera.focal_length
        rays = np.concatenate([plane, np.ones_like(plane[..., :1])], -1).reshape(-1, 3).astype(np.float32) @ R
        hits = self._rays.cast_rays(self._tensor(np.concatenate([np.broadcast_to(eye, rays.shape), rays], 1)))
        distance = hits["t_hit"].numpy()
        mask = np.isfinite(distance)

        # The object's pixels. Rays have unit z in the camera frame, so the ray parameter is the depth.
        on = np.flatnonzero(mask)
        face, uv = hits["primitive_ids"].numpy()[on], hits["primitive_uvs"].numpy()[on]
        weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)
        canonical = np.einsum("nk,nkd->nd", weights, self.shape.vertices[self.shape.faces[face]]).astype(np.float32)
        view = rays[on] / np.linalg.norm(rays[on], axis=1, keepdims=True)
        normal = hits["primitive_normals"].numpy()[on]
        normal *= -np.sign((normal * view).sum(1, keepdims=True))
        point = eye + distance[on, None] * rays[on]

        # The room's pixels: floor where a downward ray meets it, wall elsewhere.
        off = np.flatnonzero(~mask)
        down = rays[off, 2] < -1e-3
        reach = np.where(down, (self.floor - eye[2]) / np.where(down, rays[off, 2], -1), np.inf)
        grounded = (reach < 25) & look.has_ground
        floor_point = eye + reach[grounded, None] * rays[off[grounded]]
        wall_point = 2.5 * rays[off] / np.linalg.norm(rays[off], axis=1, keepdims=True)
        room = backdrop(wall_point, look.wall_waves, look.wall_colours)
        room[grounded] = backdrop(floor_point, look.ground_waves, look.ground_colours)
        depth = np.where(mask, distance, 0).astype(np.float32)
        depth[off[grounded]] = reach[grounded]

        lit = np.ones(len(on))
        if shadows:
            origin = np.concatenate([point + 0.01 * normal, floor_point + [0, 0, 0.002]])
            ray = np.concatenate([origin, np.broadcast_to(look.light, origin.shape)], 1).astype(np.float32)
            shadow = self._rays.test_occlusions(self._tensor(ray)).numpy()
            lit = 1 - 0.85 * shadow[: len(on)]
            room[grounded] *= 1 - 0.5 * shadow[len(on) :, None]
        rgb = np.zeros((height * width, 3))
        rgb[on] = _shade(look, surface_albedo(look, canonical, self.shape.material[face]), normal, view, lit)
        rgb[off] = room
        rgb = rgb * look.gain + rng.normal(0, look.noise + 1e-4, rgb.shape)

        def image(values, fill, channels):
            out = np.full((height * width, channels), fill, np.float32)
            out[on] = values
            return out.reshape(height, width, channels)

        return Rendering(
            rgb=(np.clip(rgb, 0, 1) * 255).astype(np.uint8).reshape(height, width, 3),
            depth=depth.reshape(height, width),
            mask=mask.reshape(height, width),
            canonical=image(canonical, np.nan, 3),
            normals=image(normal @ R.T, 0, 3),
            camera=camera,
        )


def _shade(look: Appearance, albedo, normal, view, lit):
    """Colours (n, 3) by Blinn-Phong shading with a sky-dependent ambient term and a little light from the camera."""
    lambert = np.clip(normal @ look.light, 0, 1) * lit
    half = look.light - view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    highlight = np.clip((normal * half).sum(1), 0, 1) ** 24 * look.specular * lit
    ambient = look.ambient * (0.75 + 0.25 * normal[:, 2])
    headlight = 0.15 * np.clip(-(normal * view).sum(1), 0, 1)
    return albedo * (ambient + headlight + look.diffuse * lambert)[:, None] + highlight[:, None]
