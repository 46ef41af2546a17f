"""Ray-casting renderer on the CPU: Open3D intersects rays with the mesh, NumPy shades the hits."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.data.cameras import Camera
from zsp_lite.io.open3d import load_open3d
from zsp_lite.synthetic.appearance import Appearance, background_colour, surface_albedo
from zsp_lite.synthetic.assembly import Shape


@dataclass(frozen=True)
class Rendering:
    """One rendered view with its exact geometry.

    Attributes:
        rgb: Picture.
        depth: z coordinate in the camera frame, 0 where the ray hits neither the object nor the floor.
        mask: Pixels of the object.
        canonical: Object coordinates of each object pixel, NaN elsewhere.
        normals: Unit normals of the object pixels in the camera frame, 0 elsewhere.
        camera: Camera of the view.
    """

    rgb: UInt8[np.ndarray, "h w 3"]
    depth: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    canonical: Float[np.ndarray, "h w 3"]
    normals: Float[np.ndarray, "h w 3"]
    camera: Camera


def orbit_pose(azimuth: float, elevation: float, roll: float, distance: float, target) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of a camera on a sphere around `target` that looks at its centre.

    Args:
        azimuth: Angle about z in radians; 0 is in front of the object, at +x.
        elevation: Angle above the horizontal plane in radians.
        roll: Rotation about the optical axis in radians.
        distance: Radius of the sphere.
        target: Centre of the sphere (3,).

    Returns:
        World-to-camera rotation (3, 3) and translation (3,).
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
    """Return a camera at pose R, t with a square image of `size` pixels that contains all vertices.

    The bounding square of the object is enlarged by the factor `margin` and shifted by `shift`, a fraction of its
    width.
    """
    in_camera = vertices @ R.T + t
    plane = in_camera[:, :2] / in_camera[:, 2:]
    low, high = plane.min(0), plane.max(0)
    width = (high - low).max() * margin
    centre = (low + high) / 2 + (0 if shift is None else np.asarray(shift) * width)
    focal_length = size / width
    return Camera(R, t, np.full(2, focal_length), size / 2 - centre * focal_length, (size, size))


class Scene:
    """One object, prepared for ray casting; `vertices` replaces those of the shape, for a deformed copy."""

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
        self, camera: Camera, appearance: Appearance, seed: int | np.random.Generator, shadows: bool = True
    ) -> Rendering:
        """Render the object on a floor in front of a wall; `seed` draws the sensor noise."""
        rng = np.random.default_rng(seed)
        height, width = camera.size
        R, eye = camera.R.astype(np.float32), camera.centre.astype(np.float32)
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        plane = (np.stack([x, y], -1) - camera.principal_point) / camera.focal_length
        rays = np.concatenate([plane, np.ones_like(plane[..., :1])], -1).reshape(-1, 3).astype(np.float32) @ R
        hits = self._rays.cast_rays(self._tensor(np.concatenate([np.broadcast_to(eye, rays.shape), rays], 1)))
        distance = hits["t_hit"].numpy()
        mask = np.isfinite(distance)

        # Object pixels. Rays have unit z in the camera frame, so the ray parameter is the depth.
        on = np.flatnonzero(mask)
        face, uv = hits["primitive_ids"].numpy()[on], hits["primitive_uvs"].numpy()[on]
        weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)
        canonical = np.einsum("nk,nkd->nd", weights, self.shape.vertices[self.shape.faces[face]]).astype(np.float32)
        view = rays[on] / np.linalg.norm(rays[on], axis=1, keepdims=True)
        normal = hits["primitive_normals"].numpy()[on]
        normal *= -np.sign((normal * view).sum(1, keepdims=True))
        point = eye + distance[on, None] * rays[on]

        # Background pixels: floor where a downward ray meets it, wall elsewhere.
        off = np.flatnonzero(~mask)
        down = rays[off, 2] < -1e-3
        reach = np.where(down, (self.floor - eye[2]) / np.where(down, rays[off, 2], -1), np.inf)
        grounded = (reach < 25) & appearance.has_ground
        floor_point = eye + reach[grounded, None] * rays[off[grounded]]
        wall_point = 2.5 * rays[off] / np.linalg.norm(rays[off], axis=1, keepdims=True)
        background = background_colour(wall_point, appearance.wall_waves, appearance.wall_colours)
        background[grounded] = background_colour(floor_point, appearance.ground_waves, appearance.ground_colours)
        depth = np.where(mask, distance, 0).astype(np.float32)
        depth[off[grounded]] = reach[grounded]

        lit = np.ones(len(on))
        if shadows:
            origin = np.concatenate([point + 0.01 * normal, floor_point + [0, 0, 0.002]])
            ray = np.concatenate([origin, np.broadcast_to(appearance.light, origin.shape)], 1).astype(np.float32)
            shadow = self._rays.test_occlusions(self._tensor(ray)).numpy()
            lit = 1 - 0.85 * shadow[: len(on)]
            background[grounded] *= 1 - 0.5 * shadow[len(on) :, None]
        rgb = np.zeros((height * width, 3))
        rgb[on] = _shade(
            appearance, surface_albedo(appearance, canonical, self.shape.material[face]), normal, view, lit
        )
        rgb[off] = background
        rgb = rgb * appearance.gain + rng.normal(0, appearance.noise + 1e-4, rgb.shape)

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


def _shade(appearance: Appearance, albedo, normal, view, lit):
    """Return colours (n, 3) by Blinn-Phong shading, with ambient light from above and a weak light at the camera."""
    lambert = np.clip(normal @ appearance.light, 0, 1) * lit
    half = appearance.light - view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    highlight = np.clip((normal * half).sum(1), 0, 1) ** 24 * appearance.specular * lit
    ambient = appearance.ambient * (0.75 + 0.25 * normal[:, 2])
    headlight = 0.15 * np.clip(-(normal * view).sum(1), 0, 1)
    return albedo * (ambient + headlight + appearance.diffuse * lambert)[:, None] + highlight[:, None]
