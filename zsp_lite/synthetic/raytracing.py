"""Renderer of textured meshes on the CPU: Open3D intersects rays, NumPy and OpenCV shade the hits.

The picture is anti-aliased by several samples per pixel. A sample receives the key light with a soft shadow, the light
of the room that other parts of the object do not block (image-based light), and reflections by the roughness of its
material. Depth, mask and object coordinates are exact: those of the ray through the centre of each pixel.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.io.open3d import load_open3d
from zsp_lite.synthetic.lighting import RoomLight, ShadowMap
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.render import Rendering
from zsp_lite.synthetic.room import Room
from zsp_lite.synthetic.sampling import (
    basis,
    cosine_directions,
    flat_normals,
    pyramid,
    sample_image,
    stratified,
    unit,
)  # fmt: skip
from zsp_lite.synthetic.textures import srgb_to_linear

_LINEAR = srgb_to_linear(np.arange(256) / 255)
_LAYERS = 4  # surfaces that a ray passes through: glass, and holes in cut-out textures
_CUT_OUT = 0.5  # opacity of a texture below which there is a hole
_GLASS = 0.6  # opacity of a material below which it casts no shadow
_BLOCKED = 0.25  # light of a direction that another part of the object blocks, relative to the mean of the room


@dataclass(frozen=True)
class Quality:
    """Numbers of rays."""

    samples: int = 2  # per pixel along each axis
    shadow_rays: int = 3  # per sample towards the key light; with 1, shadows are hard
    ambient_rays: int = 8  # per sample towards the room; with 0, no part of the object blocks its light
    shadow_map: int = 320  # points along each side of the grid on which the shadow on the floor is known


FASTEST = Quality(samples=1, shadow_rays=1, ambient_rays=0, shadow_map=96)


class _Hits(NamedTuple):
    """Surface points of rays: indices of the rays that hit, distance in ray parameters, face and corner weights."""

    ray: np.ndarray
    distance: np.ndarray
    face: np.ndarray
    weights: np.ndarray


class MeshScene:
    """A mesh on the floor of a room, prepared for rendering from many cameras in the coordinates of the mesh.

    The lowest vertex stands on the floor. A `RoomLight` is a room that was prepared before. `coordinates` are the
    object coordinates of each vertex, for a deformed copy of an object; by default its positions.
    """

    def __init__(
        self,
        mesh: TexturedMesh,
        room: Room | RoomLight,
        quality: Quality = Quality(),
        seed: int = 0,
        coordinates: Float[np.ndarray, "v 3"] | None = None,
    ):
        o3d = load_open3d()
        self.lighting = room if isinstance(room, RoomLight) else RoomLight(room)
        self.mesh, self.room, self.quality = mesh, self.lighting.room, quality
        self._tensor = o3d.core.Tensor
        opacity = np.array([material.colour[3] for material in mesh.materials])
        self._holes = np.array([m.texture is not None and m.texture[..., 3].min() < 128 for m in mesh.materials])
        self._rays = self._raycasting(o3d, np.arange(len(mesh.faces)))
        solid = np.flatnonzero(opacity[mesh.material] >= _GLASS)
        self._solid = self._rays if len(solid) == len(mesh.faces) else self._raycasting(o3d, solid)
        self._solid_faces, self._solid_holes = solid, self._holes[mesh.material[solid]].any()
        self.floor = float(mesh.vertices[:, 2].min())
        centre = (mesh.vertices.max(0) + mesh.vertices.min(0)) / 2
        self.origin = np.array([centre[0], centre[1], self.floor], np.float32)  # of the room
        self._corners = mesh.vertices[mesh.faces].astype(np.float32)
        self._flat = flat_normals(self._corners)
        self._coordinates = self._corners if coordinates is None else coordinates[mesh.faces].astype(np.float32)
        self._textures = [None if m.texture is None else pyramid(m.texture) for m in mesh.materials]
        self._tint = np.array([srgb_to_linear(m.colour[:3]) for m in mesh.materials])
        self._coloured = bool((mesh.colours != 1).any())
        self._opacity = opacity.astype(np.float32)
        self._surface = np.array([[m.specular, m.roughness, m.metallic] for m in mesh.materials], np.float32)
        self._texel_density = self._texels_per_area()
        self._rng = np.random.default_rng(seed)
        self._light_sets = self._directions_to_light()
        self._ambient_sets = cosine_directions(self._rng, quality.ambient_rays)
        self.shadow = self._shadow_map()
        self._gain: float | None = None

    def render(self, camera: Camera, seed: int | np.random.Generator) -> Rendering:
        """Render one view; the exposure is measured on the first view and varies little after it."""
        rng = np.random.default_rng(seed)
        n, (top, left, bottom, right) = self.quality.samples, self._object_box(camera)
        box = np.s_[top:bottom, left:right]
        rays = _pixel_rays(camera, (0, 0, *camera.size), 1)
        radiance, depth = self._background(camera, rays)
        hits = self._first_hits(camera, rays[box].reshape(-1, 3))
        exact = self._exact(camera, (top, left), rays[box], hits, depth)
        if bottom > top and right > left:
            samples = rays[box]
            if n > 1:
                samples = _pixel_rays(camera, (top, left, bottom, right), n)
                hits = self._first_hits(camera, samples.reshape(-1, 3))
            colour, through = self._shade_rays(camera, samples.reshape(-1, 3), hits)
            size = (right - left, bottom - top)
            colour = cv2.resize(colour.reshape(samples.shape), size, interpolation=cv2.INTER_AREA)
            through = cv2.resize(through.reshape(samples.shape[:2]), size, interpolation=cv2.INTER_AREA)
            radiance[box] = colour + through[..., None] * radiance[box]
        if self._gain is None:
            self._gain = self.room.camera.exposure_gain(radiance)
        rgb = self.room.camera.develop(radiance, self._gain * np.exp(rng.normal(0, 0.025)), rng)
        return Rendering(rgb=rgb, camera=camera, **exact)

    def _raycasting(self, o3d, faces: np.ndarray):
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        scene.add_triangles(
            self._tensor(self.mesh.vertices.astype(np.float32)), self._tensor(self.mesh.faces[faces].astype(np.uint32))
        )
        return scene

    def _object_box(self, camera: Camera) -> tuple[int, int, int, int]:
        """Return the pixels (top, left, bottom, right) that the object can cover."""
        in_camera = self.mesh.vertices @ camera.R.T + camera.t
        pixels = in_camera[:, :2] / np.maximum(in_camera[:, 2:], 1e-6) * camera.focal_length + camera.principal_point
        low = np.clip(np.floor(pixels.min(0)) - 1, 0, camera.size[::-1]).astype(int)
        high = np.clip(np.ceil(pixels.max(0)) + 1, 0, camera.size[::-1]).astype(int)
        (left, top), (right, bottom) = low.tolist(), high.tolist()
        return top, left, bottom, right

    # Geometry

    def _cast(self, origin: np.ndarray, rays: np.ndarray) -> _Hits:
        hits = self._rays.cast_rays(self._tensor(np.concatenate([origin, rays], 1)))
        distance = hits["t_hit"].numpy()
        on = np.flatnonzero(np.isfinite(distance))
        uv = hits["primitive_uvs"].numpy()[on]
        weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)
        return _Hits(on, distance[on], hits["primitive_ids"].numpy()[on].astype(np.int64), weights)

    def _first_hits(self, camera: Camera, rays: np.ndarray) -> _Hits:
        return self._cast(np.broadcast_to(camera.centre.astype(np.float32), rays.shape), rays)

    def _occluded(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Return whether a solid surface blocks each ray."""
        if not len(rays):
            return np.zeros(len(rays), bool)
        if not self._solid_holes:
            return self._solid.test_occlusions(self._tensor(np.concatenate([origin, rays], 1))).numpy()
        blocked, active = np.zeros(len(rays), bool), np.arange(len(rays))
        origin = origin.copy()
        for _ in range(_LAYERS):
            hits = self._solid.cast_rays(self._tensor(np.concatenate([origin[active], rays[active]], 1)))
            distance = hits["t_hit"].numpy()
            on = np.flatnonzero(np.isfinite(distance))
            uv = hits["primitive_uvs"].numpy()[on]
            face = self._solid_faces[hits["primitive_ids"].numpy()[on].astype(np.int64)]
            opaque = self._texture_opacity(face, np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1)) >= _CUT_OUT
            blocked[active[on[opaque]]] = True
            open_ = on[~opaque]
            origin[active[open_]] += (distance[open_, None] + 1e-3) * rays[active[open_]]
            active = active[open_]
            if not len(active):
                break
        return blocked

    def _exact(
        self, camera: Camera, corner: tuple[int, int], rays: np.ndarray, hits: _Hits, floor_depth: np.ndarray
    ) -> dict:
        """Return depth, mask, object coordinates and normals of rays (h, w, 3) through the centres of pixels.

        `corner` is the pixel (row, col) of the first ray, `hits` are the first surfaces of the rays.
        """
        depth, mask = floor_depth.copy(), np.zeros(camera.size, bool)
        canonical, normals = np.full((*camera.size, 3), np.nan, np.float32), np.zeros((*camera.size, 3), np.float32)
        row, col = np.divmod(np.arange(rays[..., 0].size), max(rays.shape[1], 1))
        rays = rays.reshape(-1, 3)
        eye = np.broadcast_to(camera.centre.astype(np.float32), rays.shape).copy()
        active, passed = np.arange(len(rays)), np.zeros(len(rays), np.float32)
        for _ in range(_LAYERS):
            solid = self._texture_opacity(hits.face, hits.weights) >= _CUT_OUT
            ray, keep = active[hits.ray[solid]], hits.face[solid]
            pixel = row[ray] + corner[0], col[ray] + corner[1]
            mask[pixel] = True
            depth[pixel] = passed[ray] + hits.distance[solid]  # rays have unit z in the camera frame
            canonical[pixel] = _interpolated(hits.weights[solid], self._coordinates[keep])
            normal = self._flat[keep]
            normal *= -np.sign(_dot(normal, rays[ray]))[:, None]
            normals[pixel] = normal @ camera.R.T.astype(np.float32)
            active, step = active[hits.ray[~solid]], hits.distance[~solid] + 1e-3
            eye[active] += step[:, None] * rays[active]
            passed[active] += step
            if not len(active):
                break
            hits = self._cast(eye[active], rays[active])
        return {"depth": depth, "mask": mask, "canonical": canonical, "normals": normals}

    # Shading

    def _shade_rays(self, camera: Camera, rays: np.ndarray, hits: _Hits) -> tuple[np.ndarray, np.ndarray]:
        """Return the radiance (n, 3) of the object along camera rays, and the share of the background (n,).

        `hits` are the first surfaces of the rays.
        """
        colour, through = np.zeros((len(rays), 3), np.float32), np.ones(len(rays), np.float32)
        origin = np.broadcast_to(camera.centre.astype(np.float32), rays.shape).copy()
        pixel = 1 / (camera.focal_length.mean() * self.quality.samples)
        active = np.arange(len(rays))
        passed = np.zeros(len(rays), np.float32)
        for _ in range(_LAYERS):
            ray = active[hits.ray]
            footprint = (passed[ray] + hits.distance) * pixel
            diffuse, mirror, opacity = self._shade(hits, origin[ray], rays[ray], footprint)
            share = through[ray, None]
            colour[ray] += share * (opacity[:, None] * diffuse + np.where(opacity[:, None] > 0, mirror, 0))
            through[ray] *= 1 - opacity
            onwards = opacity < 0.99
            active, step = ray[onwards], hits.distance[onwards] + 1e-3
            origin[active] += step[:, None] * rays[active]
            passed[active] += step
            if not len(active):
                break
            hits = self._cast(origin[active], rays[active])
        return colour, through

    def _shade(self, hits: _Hits, origin: np.ndarray, rays: np.ndarray, footprint: np.ndarray):
        """Return the diffuse radiance (n, 3), the reflected radiance (n, 3) and the opacity (n,) of hits."""
        albedo, opacity = self._albedo(hits.face, hits.weights, footprint)
        view = unit(rays)
        flat = self._flat[hits.face]
        flat *= -np.sign(_dot(flat, view))[:, None]
        normal = _interpolated(hits.weights, self.mesh.normals[hits.face])
        normal *= np.where(_dot(normal, flat) < 0, np.float32(-1), np.float32(1))[:, None]
        normal = unit(normal)
        hidden = np.flatnonzero(_dot(normal, view) > -0.02)  # visible points do not face away
        normal[hidden] -= (0.02 + _dot(normal[hidden], view[hidden]))[:, None] * view[hidden]
        normal[hidden] = unit(normal[hidden])
        facing = np.maximum(-_dot(normal, view), 0.02)
        point = origin + hits.distance[:, None] * rays + 2e-3 * flat

        light = self.room.light.astype(np.float32)
        key = np.maximum(normal @ light, 0) * ((flat @ light) > 0)
        lit = np.flatnonzero(key)
        key[lit] *= self._light_visibility(point[lit])
        around, unblocked = self._ambient(point, normal, flat)
        diffuse = key[:, None] * self.room.light_colour.astype(np.float32) + around

        specular, roughness, metallic = self._surface[self.mesh.material[hits.face]].T
        metallic = metallic[:, None]
        f0 = specular[:, None] * (1 - metallic) + albedo * metallic
        fresnel = f0 + (np.maximum(1 - roughness[:, None], f0) - f0) * ((1 - facing) ** 5)[:, None]
        half = unit(light - view)
        highlight = _ggx(np.maximum(_dot(normal, half), 0), facing, np.maximum(normal @ light, 0), roughness,
                         self.room.light_radius)  # fmt: skip
        reflected = view + 2 * facing[:, None] * normal
        mirror = self.lighting.reflection(reflected, roughness) * unblocked[:, None]
        mirror = fresnel * (mirror + (highlight * key)[:, None] * self.room.light_colour.astype(np.float32))
        return diffuse * albedo * (1 - metallic) * (1 - fresnel), mirror, opacity

    def _albedo(self, face: np.ndarray, weights: np.ndarray, footprint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return linear colours and opacities of surface points; `footprint` is the width of a sample, in units."""
        material = self.mesh.material[face]
        albedo = self._tint[material]
        if self._coloured:
            albedo *= srgb_to_linear(_interpolated(weights, self.mesh.colours[face]))
        opacity = self._opacity[material].copy()
        for index, texture in enumerate(self._textures):
            on = np.flatnonzero(material == index)
            if len(on) and (pattern := self.mesh.materials[index].pattern):
                points = _interpolated(weights[on], self._coordinates[face[on]])
                albedo[on] *= srgb_to_linear(pattern(points))
            if texture is None or not len(on):
                continue
            uv = _interpolated(weights[on], self.mesh.uv[face[on]])
            texels = footprint[on] * self._texel_density[face[on]]
            sample = sample_image(texture, uv[:, 0], 1 - uv[:, 1], texels, cv2.BORDER_WRAP)
            albedo[on] *= _LINEAR[np.clip(sample[:, :3], 0, 255).astype(np.uint8)]
            if self._holes[index]:
                opacity[on] *= np.clip(sample[:, 3] / 127.5 - 0.5, 0, 1)
        # Artists use pure black and fully saturated colours; real surfaces reflect a few percent of all colours.
        return 0.015 + 0.8 * albedo, opacity

    def _texture_opacity(self, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the opacity of the textures alone at surface points, at full resolution."""
        opacity = np.ones(len(face), np.float32)
        if not self._holes.any():
            return opacity
        material = self.mesh.material[face]
        for index in np.flatnonzero(self._holes):
            if len(on := np.flatnonzero(material == index)):
                uv = _interpolated(weights[on], self.mesh.uv[face[on]])
                sample = sample_image(self._textures[index], uv[:, 0], 1 - uv[:, 1], None, cv2.BORDER_WRAP)
                opacity[on] = sample[:, 3] / 255
        return opacity

    def _texels_per_area(self) -> np.ndarray:
        """Return the texels per unit of length on each face (f,)."""
        size = np.array(
            [1.0 if m.texture is None else np.sqrt(np.prod(m.texture.shape[:2])) for m in self.mesh.materials]
        )
        uv = self.mesh.uv.astype(float)
        one, two = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
        texture_area = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        corners = self._corners.astype(float)
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        return (np.sqrt(texture_area / np.maximum(area, 1e-12)) * size[self.mesh.material]).astype(np.float32)

    # Light

    def _directions_to_light(self) -> np.ndarray:
        """Return sets (sets, rays, 3) of directions to points of the key light."""
        n, radius = self.quality.shadow_rays, self.room.light_radius
        if n == 1:
            return np.broadcast_to(self.room.light.astype(np.float32), (1, 1, 3))
        across = basis(self.room.light[None].astype(np.float32))[0]
        u, v = stratified(self._rng, n)
        r = np.tan(radius) * np.sqrt(u)
        offsets = np.stack([r * np.cos(2 * np.pi * v), r * np.sin(2 * np.pi * v), np.ones_like(r)], -1)
        return unit(offsets.astype(np.float32) @ across)

    def _light_visibility(self, point: np.ndarray) -> np.ndarray:
        """Return the visible share of the key light at points (n, 3)."""
        sets = self._light_sets
        chosen = sets[self._rng.integers(len(sets), size=len(point))]
        return 1 - self._blocked(point, chosen).mean(1)

    def _blocked(self, point: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return whether the object blocks each of the directions (n, k, 3) at points (n, 3)."""
        n, k = directions.shape[:2]
        origin = np.repeat(point, k, axis=0)
        return self._occluded(origin, directions.reshape(-1, 3)).reshape(n, k).astype(np.float32)

    def _ambient(self, point: np.ndarray, normal: np.ndarray, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the irradiance of the room at points (n, 3), and the share of directions that are not blocked (n,)."""
        if self.quality.ambient_rays == 0:
            return self.lighting.irradiance(normal), np.ones(len(point), np.float32)
        local = self._ambient_sets[self._rng.integers(len(self._ambient_sets), size=len(point))]
        directions = np.einsum("nkc,ncd->nkd", local, basis(normal))
        below = (directions * flat[:, None]).sum(-1) <= 0
        blocked = self._blocked(point, directions)
        blocked = np.where(below, 1, blocked)
        origin = np.repeat(point - self.origin, directions.shape[1], axis=0)
        light = self.lighting.towards(origin, directions.reshape(-1, 3), self.shadow)
        light = light.reshape(*directions.shape)
        radiance = light * (1 - blocked[..., None]) + blocked[..., None] * (_BLOCKED * self.lighting.mean)
        return radiance.mean(1), 1 - blocked.mean(1)

    def _shadow_map(self) -> ShadowMap:
        """Return the shadow of the object on a grid of floor points."""
        reach = float((np.ptp(self.mesh.vertices, axis=0)[:2] / 2).max())
        tall = float(np.ptp(self.mesh.vertices[:, 2]))
        half = reach + min(
            tall * max(float(np.linalg.norm(self.room.light[:2]) / max(self.room.light[2], 0.3)), 0.8), 5.0
        )
        n = self.quality.shadow_map
        axis = (np.arange(n, dtype=np.float32) + 0.5) / n * 2 * half - half
        x, y = np.meshgrid(axis, axis)
        point = np.stack([x, y, np.full_like(x, 2e-3)], -1).reshape(-1, 3) + self.origin
        rays = 1 if self.quality.shadow_rays == 1 else 2 * self.quality.shadow_rays
        key = np.mean([self._light_visibility(point) for _ in range(max(1, rays // self.quality.shadow_rays))], 0)
        key = key.reshape(n, n)
        around = np.ones((n, n), np.float32)
        if self.quality.ambient_rays:
            key = cv2.GaussianBlur(key.astype(np.float32), (0, 0), 1.0)
            coarse = np.linspace(-half, half, n // 2 + 1, dtype=np.float32)
            coarse = (coarse[1:] + coarse[:-1]) / 2
            x, y = np.meshgrid(coarse, coarse)
            point = np.stack([x, y, np.full_like(x, 2e-3)], -1).reshape(-1, 3) + self.origin
            blocked = np.zeros(len(point), np.float32)
            for _ in range(3):
                sets = self._ambient_sets[self._rng.integers(len(self._ambient_sets), size=len(point))]
                blocked += self._blocked(point, np.ascontiguousarray(sets)).mean(1) / 3
            around = cv2.GaussianBlur(1 - blocked.reshape(n // 2, n // 2), (0, 0), 1.0)
            around = cv2.resize(around, (n, n), interpolation=cv2.INTER_LINEAR)
        return ShadowMap(np.dstack([key, around]).astype(np.float32), half)

    # Background

    def _background(self, camera: Camera, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the radiance (h, w, 3) of the room without the object, and the depth (h, w) of the floor."""
        height, width = camera.size
        eye = camera.centre - self.origin
        radiance, floor_depth = self.lighting.radiance(
            eye, rays.reshape(-1, 3), 1 / camera.focal_length.mean(), self.shadow
        )
        radiance, floor_depth = radiance.reshape(height, width, 3), floor_depth.reshape(height, width)
        focus = float(np.linalg.norm(eye))
        far = np.where(floor_depth > 0, floor_depth, 3 * focus)
        amount = np.clip(np.abs(1 - focus / np.maximum(far, 1e-3)) * 1.8 - 0.2, 0, 1).astype(np.float32)[..., None]
        sigma = self.room.camera.defocus * min(height, width) / 256
        blurred = cv2.GaussianBlur(radiance, (0, 0), max(sigma, 0.3), borderType=cv2.BORDER_REFLECT)
        return radiance * (1 - amount) + blurred * amount, floor_depth


def _pixel_rays(camera: Camera, box: tuple[int, int, int, int], n: int) -> Float[np.ndarray, "h w 3"]:
    """Return rays of unit z in the camera frame through n x n points of each pixel of a box."""
    top, left, bottom, right = box
    x = left + (np.arange((right - left) * n) + 0.5) / n
    y = top + (np.arange((bottom - top) * n) + 0.5) / n
    x = (x - camera.principal_point[0]) / camera.focal_length[0]
    y = (y - camera.principal_point[1]) / camera.focal_length[1]
    return (x[None, :, None] * camera.R[0] + (y[:, None, None] * camera.R[1] + camera.R[2])).astype(np.float32)


def _interpolated(weights: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "n 3 c"]) -> Float[np.ndarray, "n c"]:
    """Return values at surface points from those at the corners of their faces."""
    return np.einsum("nk,nkc->nc", weights, corners)


def _dot(one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    return np.einsum("nd,nd->n", one, other)


def _ggx(cos_half, cos_view, cos_light, roughness, light_radius: float) -> np.ndarray:
    """Return the microfacet term D * V (GGX, Smith) times pi, widened by the angular radius of the light."""
    alpha = np.clip(roughness**2 + 0.5 * light_radius, 0.02, 1)
    a2 = alpha**2
    d = a2 / (cos_half**2 * (a2 - 1) + 1) ** 2
    k = alpha / 2
    visible = 1 / (4 * (cos_view * (1 - k) + k) * (cos_light * (1 - k) + k))
    return d * visible * (roughness**2 / alpha) ** 0.5
