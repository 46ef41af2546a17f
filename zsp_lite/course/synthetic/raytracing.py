"""Renderer of textured meshes on the CPU: Open3D intersects rays, NumPy and OpenCV shade the hits.

A sample of the picture receives the key light with a soft shadow, the light of the room that the
object does not block, and reflections. Depth, mask and object coordinates are exact: those of the
ray through the centre of each pixel.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from zsp_lite.course.synthetic.meshes import TexturedMesh
from zsp_lite.course.synthetic.primitives import unit
from zsp_lite.course.synthetic.room import FLOOR_REACH, Room
from zsp_lite.course.synthetic.textures import pyramid, sample_image, sample_pyramid, srgb_to_linear
from zsp_lite.data.cameras import Camera
from zsp_lite.io.ply import load_open3d

_LAYERS = 4  # surfaces with holes that a ray passes through
_OFFSET = 2e-3  # of the start of a ray from the surface that it leaves, in units
_RAYS = 4  # per sample towards the room, and per point of the floor towards the key light
# light from parts of the object that block the room, relative to the light of the room
_BLOCKED = 0.25
_SHADOW_CELLS = 96  # along each side of the grid on which the shadow on the floor is known


@dataclass(frozen=True)
class Rendering:
    """One rendered view with its exact geometry."""

    rgb: UInt8[np.ndarray, "h w 3"]
    # z in the camera frame, 0 where the ray hits neither the object nor the floor
    depth: Float[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]  # pixels of the object
    canonical: Float[np.ndarray, "h w 3"]  # object coordinates of each object pixel, NaN elsewhere
    # unit normals of the object pixels in the camera frame, 0 elsewhere
    normals: Float[np.ndarray, "h w 3"]
    camera: Camera


class _Hits(NamedTuple):
    """Surface points of rays: indices of the rays that hit, distances in ray parameters, faces and
    corner weights."""

    ray: np.ndarray
    distance: np.ndarray
    face: np.ndarray
    weights: np.ndarray


class MeshScene:
    """A mesh on the floor of a room, for rendering from cameras in the coordinates of the mesh."""

    def __init__(
        self,
        mesh: TexturedMesh,
        room: Room,
        seed: int | np.random.Generator,
        coordinates: Float[np.ndarray, "v 3"]
        | None = None,  # of the object that the mesh is a deformed copy of
        samples: int = 2,  # per pixel, along each axis
    ):
        o3d = load_open3d()
        self.mesh, self.room = mesh, room
        self._rng = np.random.default_rng(seed)
        self._samples = samples
        self._tensor = o3d.core.Tensor
        self._rays = o3d.t.geometry.RaycastingScene(nthreads=1)
        triangles = mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)
        self._rays.add_triangles(*map(self._tensor, triangles))
        low = mesh.vertices.min(0)
        high = mesh.vertices.max(0)
        self.origin = np.array([*(low + high)[:2] / 2, low[2]], np.float32)  # of the room
        first, second, third = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float32), 1, 0)
        # normal, with twice the area of the face as its length
        cross = np.cross(second - first, third - first)
        self._flat = unit(cross)
        self._coordinates = (mesh.vertices if coordinates is None else coordinates)[
            mesh.faces
        ].astype(np.float32)
        self._textures = [None if m.texture is None else pyramid(m.texture) for m in mesh.materials]
        self._has_holes = [
            m.texture is not None and bool(m.texture[..., 3].min() < 128) for m in mesh.materials
        ]
        self._properties = np.array(
            [[m.specular, m.roughness, m.colour[3]] for m in mesh.materials], np.float32
        )
        uv_area = np.abs(np.linalg.det(mesh.uv[:, 1:] - mesh.uv[:, :1]))
        # Lengths of the texture per unit, by face.
        self._texture_scale = np.sqrt(uv_area / np.maximum(np.linalg.norm(cross, axis=1), 1e-12))
        self._shadow, self._shadow_width = self._shadow_on_the_floor()
        self._gain: float | None = None

    def render(self, camera: Camera) -> Rendering:
        """Render one view; the exposure is measured on the first view and varies little
        after it."""
        rays = _pixel_rays(camera, 1)
        radiance, depth = self._background(camera, rays)
        hits = self._cast(camera.centre, rays)
        pixel = np.unravel_index(hits.ray, camera.size)
        mask = np.zeros(camera.size, bool)
        normals = np.zeros((*camera.size, 3), np.float32)
        canonical = np.full_like(normals, np.nan)
        # rays have unit z in the camera frame
        mask[pixel] = True
        depth[pixel] = hits.distance
        canonical[pixel] = _interpolated(hits.weights, self._coordinates[hits.face])
        normals[pixel] = _towards(
            self._flat[hits.face], rays.reshape(-1, 3)[hits.ray]
        ) @ camera.R.T.astype(np.float32)
        if self._samples > 1:
            rays = _pixel_rays(camera, self._samples)
            hits = self._cast(camera.centre, rays)
        shaded = cv2.resize(
            self._shade(camera, rays, hits), camera.size[::-1], interpolation=cv2.INTER_AREA
        )
        radiance = shaded[..., :3] + (1 - shaded[..., 3:]) * radiance
        if self._gain is None:
            self._gain = self.room.camera.exposure_gain(radiance)
        rgb = self.room.camera.develop(
            radiance, self._gain * np.exp(self._rng.normal(0, 0.025)), self._rng
        )
        return Rendering(rgb, depth, mask, canonical, normals, camera)

    def _cast(self, origin: Float[np.ndarray, "#*n 3"], rays: Float[np.ndarray, "*n 3"]) -> _Hits:
        """Return the first point that each ray meets; a ray passes through the holes of
        textures."""
        origin = np.broadcast_to(origin.astype(np.float32), rays.shape).reshape(-1, 3)
        rays = rays.reshape(-1, 3)
        start = np.zeros(len(rays), np.float32)
        active = np.arange(len(rays))
        found = []
        for _ in range(_LAYERS):
            points = origin[active] + start[active, None] * rays[active]
            result = self._rays.cast_rays(self._tensor(np.concatenate([points, rays[active]], 1)))
            reach = result["t_hit"].numpy()
            on = np.flatnonzero(np.isfinite(reach))
            uv = result["primitive_uvs"].numpy()[on]
            face = result["primitive_ids"].numpy()[on].astype(np.int64)
            weights = np.column_stack([1 - uv.sum(1), uv])
            ray = active[on]
            distance = start[ray] + reach[on]
            hole = self._is_hole(face, weights)
            found.append(_Hits(ray[~hole], distance[~hole], face[~hole], weights[~hole]))
            active = ray[hole]
            start[active] = distance[hole] + _OFFSET
            if not len(active):
                break
        return _Hits(*map(np.concatenate, zip(*found, strict=True)))

    def _is_hole(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return at which surface points (n,) the texture has a hole."""
        hole = np.zeros(len(face), bool)
        for index in np.flatnonzero(self._has_holes):
            on = np.flatnonzero(self.mesh.material[face] == index)
            u, v = _interpolated(weights[on], self.mesh.uv[face[on]]).T
            hole[on] = sample_image(self._textures[index][0], u, 1 - v, cv2.BORDER_WRAP)[:, 3] < 128
        return hole

    def _visible_share(
        self, point: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n k 3"]
    ) -> np.ndarray:
        """Return the share (n,) of the directions from each point that the object does not
        block."""
        n, count = directions.shape[:2]
        blocked = np.bincount(self._cast(point[:, None], directions).ray // count, minlength=n)
        return 1 - blocked.astype(np.float32) / np.float32(count)

    def _shade(
        self, camera: Camera, rays: Float[np.ndarray, "h w 3"], hits: _Hits
    ) -> Float[np.ndarray, "h w 4"]:
        """Return the radiance of the object along rays, multiplied by its opacity, and the
        opacity."""
        size = rays.shape[:2]
        rays = rays.reshape(-1, 3)[hits.ray]
        material = self.mesh.material[hits.face]
        # width of a sample, in units
        footprint = hits.distance / (camera.focal_length.mean() * self._samples)
        albedo = self._albedo(hits, footprint)
        view = unit(rays)
        flat = _towards(self._flat[hits.face], rays)
        normal = _interpolated(hits.weights, self.mesh.normals[hits.face])
        normal *= np.where(_dot(normal, flat) < 0, np.float32(-1), np.float32(1))[:, None]
        # Visible points do not face away, though their interpolated normals may.
        normal = unit(normal)
        normal = unit(normal - np.maximum(_dot(normal, view) + 0.02, 0)[:, None] * view)
        facing = np.maximum(-_dot(normal, view), 0.02)
        point = camera.centre.astype(np.float32) + hits.distance[:, None] * rays + _OFFSET * flat

        light = self.room.light.astype(np.float32)
        light_colour = self.room.light_colour.astype(np.float32)
        key = np.maximum(normal @ light, 0) * (flat @ light > 0)
        lit = np.flatnonzero(key)
        of_light = np.ones(len(key), np.float32)
        of_light[lit] = self._lit_share(point[lit], 1)
        # Directions with a density of the cosine about the normal.
        towards_room = unit(
            normal[:, None] + 0.99 * _spread_directions(self._rng, len(point), _RAYS)
        )
        of_room = self._visible_share(point, towards_room)
        # Few rays per sample are noisy: each sample takes the mean of its neighbours on the object.
        shares = np.zeros((*size, 3), np.float32)
        shares.reshape(-1, 3)[hits.ray] = np.column_stack([of_light, of_room, np.ones(len(key))])
        of_light, of_room, neighbours = cv2.blur(shares, (3, 3)).reshape(-1, 3)[hits.ray].T
        key = key * of_light / neighbours
        visible = of_room / neighbours
        around = self.room.irradiance(normal) * (_BLOCKED + (1 - _BLOCKED) * visible)[:, None]
        diffuse = (key[:, None] * light_colour + around) * albedo

        specular, roughness, opacity = self._properties[material].T
        # Reflectance by Schlick's approximation, the highlight by Blinn and Phong with its
        # normalisation.
        reflectance = (specular + np.maximum(1 - roughness - specular, 0) * (1 - facing) ** 5)[
            :, None
        ]
        exponent = 2 / np.maximum(roughness, 0.25) ** 4 - 2
        cosine = np.maximum(_dot(normal, unit(light - view)), 0)
        highlight = key * (exponent + 8) / 8 * cosine**exponent
        mirrored = (
            self.room.reflection(view + 2 * facing[:, None] * normal, roughness) * visible[:, None]
        )
        colour = diffuse * (1 - reflectance) + reflectance * (
            mirrored + highlight[:, None] * light_colour
        )

        shaded = np.zeros((*size, 4), np.float32)
        shaded.reshape(-1, 4)[hits.ray] = opacity[:, None] * np.column_stack(
            [colour, np.ones(len(colour))]
        )
        return shaded

    def _albedo(self, hits: _Hits, footprint: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Return the linear colours of surface points; `footprint` is the width of a sample, in
        units."""
        face = hits.face
        weights = hits.weights
        material = self.mesh.material[hits.face]
        albedo = srgb_to_linear(_interpolated(weights, self.mesh.colours[face]))
        for index in np.unique(material):
            on = np.flatnonzero(material == index)
            look = self.mesh.materials[index]
            texture = self._textures[index]
            albedo[on] *= srgb_to_linear(look.colour[:3])
            if look.pattern:
                points = _interpolated(weights[on], self._coordinates[face[on]])
                albedo[on] *= srgb_to_linear(look.pattern(points))
            if texture:
                u, v = _interpolated(weights[on], self.mesh.uv[face[on]]).T
                texels = (
                    footprint[on]
                    * self._texture_scale[face[on]]
                    * np.sqrt(np.prod(texture[0].shape[:2]))
                )
                sample = sample_pyramid(texture, u, 1 - v, texels, cv2.BORDER_WRAP)
                albedo[on] *= srgb_to_linear(sample[:, :3] / 255)
        # Artists use pure black and fully saturated colours; real surfaces reflect a few percent of
        # all colours.
        return 0.015 + 0.8 * albedo

    def _lit_share(self, point: Float[np.ndarray, "n 3"], count: int) -> np.ndarray:
        """Return the share (n,) of the key light that the object does not block, by `count` rays
        from each point."""
        offset = np.float32(np.tan(self.room.light_radius)) * _spread_directions(
            self._rng, len(point), count
        )
        return self._visible_share(point, unit(self.room.light.astype(np.float32) + offset))

    def _shadow_on_the_floor(self) -> tuple[Float[np.ndarray, "n n 2"], float]:
        """Return the visible shares of the key light and of the room on a grid below the object,
        and its width."""
        extent = np.ptp(self.mesh.vertices, axis=0)
        light = self.room.light
        length = extent[2] * max(float(np.linalg.norm(light[:2]) / max(light[2], 0.3)), 0.8)
        n = _SHADOW_CELLS
        width = float(extent[:2].max()) + 2 * min(length, 5.0)
        line = ((np.arange(n, dtype=np.float32) + 0.5) / n - 0.5) * width
        x, y = np.meshgrid(line, line)
        point = np.stack([x, y, np.full_like(x, _OFFSET)], -1).reshape(-1, 3) + self.origin
        key = self._lit_share(point, _RAYS).reshape(n, n)
        towards_room = unit(
            np.float32([0, 0, 1]) + 0.99 * _spread_directions(self._rng, len(point), _RAYS)
        )
        around = self._visible_share(point, towards_room).reshape(n, n)
        return np.dstack(
            [cv2.GaussianBlur(key, (0, 0), 0.8), cv2.GaussianBlur(around, (0, 0), 2.0)]
        ), width

    def _background(
        self, camera: Camera, rays: Float[np.ndarray, "h w 3"]
    ) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
        """Return the radiance of the room with the shadow of the object, and the depth of the
        floor."""
        eye = camera.centre - self.origin
        flat_rays = rays.reshape(-1, 3)
        radiance, reach = self.room.radiance(eye, flat_rays, 1 / camera.focal_length.mean())
        floor = np.flatnonzero(reach)
        u, v = ((eye + reach[floor, None] * flat_rays[floor])[:, :2] / self._shadow_width + 0.5).T
        shares = sample_image(self._shadow, u, v, cv2.BORDER_CONSTANT)
        radiance[floor] *= self.room.on_the_floor(*shares.T)
        depth = np.where(reach < FLOOR_REACH, reach, 0).astype(np.float32)
        return radiance.reshape(rays.shape), depth.reshape(rays.shape[:2])


def _pixel_rays(camera: Camera, n: int) -> Float[np.ndarray, "h w 3"]:
    """Return rays of unit z in the camera frame through n x n points of each pixel."""
    height, width = camera.size
    x = ((np.arange(width * n) + 0.5) / n - camera.principal_point[0]) / camera.focal_length[0]
    y = ((np.arange(height * n) + 0.5) / n - camera.principal_point[1]) / camera.focal_length[1]
    return (x[None, :, None] * camera.R[0] + (y[:, None, None] * camera.R[1] + camera.R[2])).astype(
        np.float32
    )


def _interpolated(
    weights: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "n 3 c"]
) -> Float[np.ndarray, "n c"]:
    """Return values at surface points from those at the corners of their faces."""
    return np.einsum("nk,nkc->nc", weights, corners)


def _towards(
    normal: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Return normals that point towards the eye of rays."""
    return normal * -np.sign(_dot(normal, rays))[:, None]


def _dot(one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the scalar products of the rows."""
    return np.einsum("nd,nd->n", one, other)


def _spread_directions(
    rng: np.random.Generator, n: int, count: int
) -> Float[np.ndarray, "n {count} 3"]:
    """Return n sets of `count` unit vectors that are spread evenly over the sphere, each set turned
    at random."""
    index = np.arange(count, dtype=np.float32)
    z = 1 - 2 * (index + rng.random((n, 1), np.float32)) / count
    # golden ratio
    angle = np.float32(2 * np.pi) * (index * np.float32(0.618034) + rng.random((n, 1), np.float32))
    radius = np.sqrt(np.maximum(1 - z**2, 0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)
