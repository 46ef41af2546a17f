"""Renderer of textured meshes on the CPU: Open3D intersects rays, NumPy and OpenCV shade the hits.

A sample of the picture receives the key light with a soft shadow, the light of the room that the
object does not block, and reflections. Depth, mask and object coordinates are exact: those of the
ray through the centre of each pixel.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from zsp_lite.course.synthetic.meshes import TexturedMesh
from zsp_lite.course.synthetic.primitives import TAU, Vertices, area_normals, box_centre, unit
from zsp_lite.course.synthetic.room import FLOOR_REACH, Room, Values, Vectors
from zsp_lite.course.synthetic.textures import (
    Image,
    Map,
    pyramid,
    sample_image,
    sample_pyramid,
    srgb_to_linear,
)
from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import unproject_depth

_LAYERS = 4  # surfaces that a ray meets at most, as it passes through the holes of textures
_HOLE = 128  # opacity of a texture, 0 to 255, below which it has a hole
# Distance in units between a surface and the start of a ray that leaves it: the ray must not meet
# the same surface again.
_OFFSET = 2e-3
# Rays towards the room from each sample of the picture; and both towards the room and towards the
# key light from each point of the floor.
_RAYS = 4
_LEAST_FACING = 0.02  # cosine of the largest angle between a visible point's normal and its ray
# Light from parts of the object that block the room, relative to the light of the room; chosen by
# hand.
_BLOCKED = 0.25
_SHADOW_CELLS = 96  # along each side of the grid on which the shadow on the floor is known


@dataclass(frozen=True)
class Rendering:
    """One rendered view with its exact geometry."""

    rgb: UInt8[np.ndarray, "h w 3"]
    # z in the camera frame, 0 where the ray hits neither the object nor the floor
    depth: Map
    mask: Bool[np.ndarray, "h w"]  # pixels of the object
    canonical: Image  # object coordinates of each object pixel, NaN elsewhere
    # unit normals of the object pixels in the camera frame, 0 elsewhere
    normals: Image
    camera: Camera


class _Hits(NamedTuple):
    """Surface points where rays hit the mesh; a ray hits once or not at all."""

    ray: Int[np.ndarray, " n"]  # index of the ray
    distance: Values  # the ray's parameter at the point
    face: Int[np.ndarray, " n"]
    weights: Vectors  # of the face's corners, with sum 1


class MeshScene:
    """A mesh on the floor of a room, for rendering from cameras in the coordinates of the mesh.

    Args:
        mesh: the object.
        room: the room around it; its origin is below the middle of the object.
        seed: source of the random numbers of shadows, exposure and noise.
        coordinates: object coordinates of the vertices; by default the vertices themselves.
        samples: number of samples of the picture along each side of a pixel.
    """

    def __init__(
        self,
        mesh: TexturedMesh,
        room: Room,
        seed: int | np.random.Generator,
        coordinates: Vertices | None = None,
        samples: int = 2,
    ):
        import open3d as o3d  # slow to import

        self.mesh = mesh
        self.room = room
        self._rng = np.random.default_rng(seed)
        self._samples = samples
        self._tensor = o3d.core.Tensor
        self._raycaster = o3d.t.geometry.RaycastingScene(nthreads=1)
        vertices = mesh.vertices.astype(np.float32)
        self._raycaster.add_triangles(
            self._tensor(vertices), self._tensor(mesh.faces.astype(np.uint32))
        )
        # The origin of the room, in the coordinates of the mesh: below the middle, on the floor.
        self.origin = box_centre(mesh.vertices).astype(np.float32)
        self.origin[2] = mesh.vertices[:, 2].min()

        # Per face: its unit normal, twice its area, and the object coordinates of its corners.
        normals = area_normals(vertices, mesh.faces)
        self._flat = unit(normals)
        area = np.linalg.norm(normals, axis=1)
        if coordinates is None:
            coordinates = mesh.vertices
        self._coordinates = coordinates[mesh.faces].astype(np.float32)
        # Per face: how many sides of the texture one unit of length covers.
        uv_area = np.abs(np.linalg.det(mesh.uv[:, 1:] - mesh.uv[:, :1]))
        self._texture_scale = np.sqrt(uv_area / np.maximum(area, 1e-12))

        # Per material: the texture's pyramid, whether it has holes, and three numbers.
        self._textures = [None if m.texture is None else pyramid(m.texture) for m in mesh.materials]
        self._has_holes = [
            m.texture is not None and bool(m.texture[..., 3].min() < _HOLE) for m in mesh.materials
        ]
        self._properties = np.array(
            [[m.specular, m.roughness, m.colour[3]] for m in mesh.materials], np.float32
        )
        self._shadow, self._shadow_width = self._shadow_on_the_floor()
        self._gain: float | None = None  # of the exposure, known from the first view on

    def render(self, camera: Camera) -> Rendering:
        """Render one view; the exposure is measured on the first view and varies little after."""
        # Exact geometry, along one ray per pixel.
        rays = _pixel_rays(camera, 1)
        radiance, depth = self._background(camera, rays)
        hits = self._cast(camera.centre, rays)
        pixel = np.unravel_index(hits.ray, camera.size)
        mask = np.zeros(camera.size, bool)
        normals = np.zeros((*camera.size, 3), np.float32)
        canonical = np.full_like(normals, np.nan)
        mask[pixel] = True
        depth[pixel] = hits.distance  # rays have unit z in the camera frame
        canonical[pixel] = _interpolated(hits.weights, self._coordinates[hits.face])
        flat = _towards(self._flat[hits.face], rays.reshape(-1, 3)[hits.ray])
        normals[pixel] = flat @ camera.R.T.astype(np.float32)

        # The picture: the mean of the samples in a pixel, over the room behind the object.
        if self._samples > 1:
            rays = _pixel_rays(camera, self._samples)
            hits = self._cast(camera.centre, rays)
        shaded = self._shade(camera, rays, hits)
        shaded = cv2.resize(shaded, camera.size[::-1], interpolation=cv2.INTER_AREA)
        radiance = shaded[..., :3] + (1 - shaded[..., 3:]) * radiance
        if self._gain is None:
            self._gain = self.room.camera.exposure_gain(radiance)
        # Automatic exposure varies by 2.5 % from view to view.
        gain = self._gain * np.exp(self._rng.normal(0, 0.025))
        rgb = self.room.camera.develop(radiance, gain, self._rng)
        return Rendering(rgb, depth, mask, canonical, normals, camera)

    def _cast(self, origin: Float[np.ndarray, "#*n 3"], rays: Float[np.ndarray, "*n 3"]) -> _Hits:
        """Return the first point that each ray meets; rays pass through the holes of textures."""
        origin = np.broadcast_to(origin.astype(np.float32), rays.shape).reshape(-1, 3)
        rays = rays.reshape(-1, 3)
        start = np.zeros(len(rays), np.float32)  # the parameter from which each ray is followed
        active = np.arange(len(rays))  # indices of the rays that are still followed
        layers = []
        for _ in range(_LAYERS):
            points = origin[active] + start[active, None] * rays[active]
            result = self._raycaster.cast_rays(self._tensor(np.hstack([points, rays[active]])))
            reach = result["t_hit"].numpy()
            hit = np.flatnonzero(np.isfinite(reach))
            # Open3D gives the weights of the second and the third corner.
            uv = result["primitive_uvs"].numpy()[hit]
            weights = np.column_stack([1 - uv.sum(1), uv])
            face = result["primitive_ids"].numpy()[hit].astype(np.int64)
            ray = active[hit]
            distance = start[ray] + reach[hit]
            hole = self._is_hole(face, weights)
            layers.append(_Hits(ray[~hole], distance[~hole], face[~hole], weights[~hole]))
            # The rays that met a hole go on from there.
            active = ray[hole]
            start[active] = distance[hole] + _OFFSET
            if not len(active):
                break
        return _Hits(*map(np.concatenate, zip(*layers)))

    def _is_hole(self, face: Int[np.ndarray, " n"], weights: Vectors) -> Bool[np.ndarray, " n"]:
        """Return at which surface points the texture has a hole."""
        hole = np.zeros(len(face), bool)
        for index in np.flatnonzero(self._has_holes):
            chosen = np.flatnonzero(self.mesh.material[face] == index)
            u, v = _interpolated(weights[chosen], self.mesh.uv[face[chosen]]).T
            rgba = sample_image(self._textures[index][0], u, 1 - v, cv2.BORDER_WRAP)
            hole[chosen] = rgba[:, 3] < _HOLE
        return hole

    def _visible_share(self, point: Vectors, directions: Float[np.ndarray, "n k 3"]) -> Values:
        """Return the share of the k directions from each point that the object does not block."""
        n, k = directions.shape[:2]
        # Ray i * k + j starts at point i.
        blocked = np.bincount(self._cast(point[:, None], directions).ray // k, minlength=n)
        return 1 - blocked.astype(np.float32) / k

    def _shade(self, camera: Camera, rays: Image, hits: _Hits) -> Float[np.ndarray, "h w 4"]:
        """Return the object's radiance along rays, multiplied by its opacity; and the opacity."""
        size = rays.shape[:2]
        rays = rays.reshape(-1, 3)[hits.ray]
        view = unit(rays)
        flat = _towards(self._flat[hits.face], rays)
        normal = self._shading_normals(hits, view, flat)
        facing = np.maximum(-_dot(normal, view), _LEAST_FACING)
        point = camera.centre.astype(np.float32) + hits.distance[:, None] * rays + _OFFSET * flat

        # Light that arrives: from the key light if both normals face it, and from the room.
        light = self.room.light.astype(np.float32)
        light_colour = self.room.light_colour.astype(np.float32)
        key = np.maximum(normal @ light, 0) * (flat @ light > 0)
        key, visible = self._unblocked(key, point, normal, hits.ray, size)
        around = self.room.irradiance(normal) * (_BLOCKED + (1 - _BLOCKED) * visible)[:, None]

        # Light that is scattered in all directions.
        footprint = hits.distance / (camera.focal_length.mean() * self._samples)
        diffuse = (key[:, None] * light_colour + around) * self._albedo(hits, footprint)

        # Light that is reflected: Schlick's approximation of the reflectance, which grows less
        # towards grazing angles on rough surfaces, the room in the direction of the mirrored ray,
        # and a normalised Blinn-Phong highlight of the key light.
        specular, roughness, opacity = self._properties[self.mesh.material[hits.face]].T
        reflectance = specular + np.maximum(1 - roughness - specular, 0) * (1 - facing) ** 5
        reflectance = reflectance[:, None]
        mirrored = self.room.reflection(view + 2 * facing[:, None] * normal, roughness)
        mirrored *= visible[:, None]
        # Roughness counts as at least 0.25, which limits how narrow a highlight is.
        exponent = 2 / np.maximum(roughness, 0.25) ** 4 - 2
        cosine = np.maximum(_dot(normal, unit(light - view)), 0)
        highlight = key * (exponent + 8) / 8 * cosine**exponent
        reflected = mirrored + highlight[:, None] * light_colour
        radiance = diffuse * (1 - reflectance) + reflectance * reflected

        shaded = np.zeros((*size, 4), np.float32)
        layer = opacity[:, None] * np.column_stack([radiance, np.ones(len(radiance))])
        shaded.reshape(-1, 4)[hits.ray] = layer
        return shaded

    def _shading_normals(self, hits: _Hits, view: Vectors, flat: Vectors) -> Vectors:
        """Return interpolated normals, turned so that no visible point faces away."""
        normal = _interpolated(hits.weights, self.mesh.normals[hits.face])
        # The normal is turned to the side of the surface that the flat normal is on.
        normal *= np.where(_dot(normal, flat) < 0, np.float32(-1), np.float32(1))[:, None]
        normal = unit(normal)
        # Visible points do not face away, though their interpolated normals may.
        excess = np.maximum(_dot(normal, view) + _LEAST_FACING, 0)
        return unit(normal - excess[:, None] * view)

    def _unblocked(
        self,
        key: Values,
        point: Vectors,
        normal: Vectors,
        ray: Int[np.ndarray, " n"],
        size: tuple[int, int],
    ) -> tuple[Values, Values]:
        """Return the key light that reaches each point, and the share of the room that it sees."""
        of_light = np.ones(len(key), np.float32)
        lit = np.flatnonzero(key)
        of_light[lit] = self._lit_share(point[lit], count=1)
        of_room = self._room_share(point, normal)
        # Few rays per sample are noisy: each sample takes the mean of its neighbours on the object.
        # The blur divides by all nine neighbours; the third channel becomes the share of these that
        # are on the object.
        shares = np.zeros((*size, 3), np.float32)
        shares.reshape(-1, 3)[ray] = np.column_stack([of_light, of_room, np.ones(len(key))])
        of_light, of_room, on_object = cv2.blur(shares, (3, 3)).reshape(-1, 3)[ray].T
        return key * of_light / on_object, of_room / on_object

    def _albedo(self, hits: _Hits, footprint: Values) -> Vectors:
        """Return the linear colours of surface points; `footprint` is a sample's width in units."""
        face = hits.face
        weights = hits.weights
        material = self.mesh.material[face]
        albedo = srgb_to_linear(_interpolated(weights, self.mesh.colours[face]))
        for index in np.unique(material):
            chosen = np.flatnonzero(material == index)
            look = self.mesh.materials[index]
            texture = self._textures[index]
            albedo[chosen] *= srgb_to_linear(look.colour[:3])
            if look.pattern:
                points = _interpolated(weights[chosen], self._coordinates[face[chosen]])
                albedo[chosen] *= srgb_to_linear(look.pattern(points))
            if texture:
                u, v = _interpolated(weights[chosen], self.mesh.uv[face[chosen]]).T
                pixels = footprint[chosen] * self._texture_scale[face[chosen]]
                pixels *= np.sqrt(np.prod(texture[0].shape[:2]))
                rgba = sample_pyramid(texture, u, 1 - v, pixels, cv2.BORDER_WRAP)
                albedo[chosen] *= srgb_to_linear(rgba[:, :3] / 255)
        # Artists use pure black, pure white and fully saturated colours. Real surfaces reflect at
        # least a few percent of every colour, and never all light.
        return 0.015 + 0.8 * albedo

    def _lit_share(self, point: Vectors, count: int) -> Values:
        """Return the share of the key light that each point sees, by `count` rays towards it."""
        radius = np.float32(np.tan(self.room.light_radius))
        offset = radius * _spread_directions(self._rng, len(point), count)
        return self._visible_share(point, unit(self.room.light.astype(np.float32) + offset))

    def _room_share(self, point: Vectors, normal: Float[np.ndarray, "#n 3"]) -> Values:
        """Return the share of the room above the surface that each point sees."""
        # The sum of the normal and a random unit vector has the density of the cosine, by which a
        # surface receives light; 0.99 keeps the sum from being zero.
        offset = 0.99 * _spread_directions(self._rng, len(point), _RAYS)
        return self._visible_share(point, unit(normal[:, None] + offset))

    def _shadow_on_the_floor(self) -> tuple[Float[np.ndarray, "n n 2"], float]:
        """Return the shares of key light and room seen from a grid on the floor, and its width."""
        # The grid is as wide as the object with a shadow on either side. The shadow counts as at
        # most 5 units long, and as at least 0.8 of the object's height even below a light from
        # above: the object also shades the floor from the room. The slope of the light counts as
        # at most 1 / 0.3. The grid has the axes of the room, as its border and its cells are
        # visible.
        extent = np.ptp(self.mesh.vertices @ self.room.axes, axis=0)
        light = self.room.light
        length = extent[2] * max(float(np.linalg.norm(light[:2]) / max(light[2], 0.3)), 0.8)
        width = float(extent[:2].max()) + 2 * min(length, 5.0)
        n = _SHADOW_CELLS
        line = ((np.arange(n, dtype=np.float32) + 0.5) / n - 0.5) * width
        x, y = np.meshgrid(line, line)
        point = np.stack([x, y, np.full_like(x, _OFFSET)], -1).reshape(-1, 3)
        point = point @ self.room.axes.T + self.origin
        key = self._lit_share(point, _RAYS).reshape(n, n)
        around = self._room_share(point, np.float32([[0, 0, 1]])).reshape(n, n)
        # A blur, in cells of the grid, hides the noise of few rays.
        key = cv2.GaussianBlur(key, (0, 0), 0.8)
        around = cv2.GaussianBlur(around, (0, 0), 2.0)
        return np.dstack([key, around]), width

    def _background(self, camera: Camera, rays: Image) -> tuple[Image, Map]:
        """Return the room's radiance with the object's shadow, and the depth of the floor."""
        eye = camera.centre - self.origin
        flat_rays = rays.reshape(-1, 3)
        radiance, reach = self.room.radiance(eye, flat_rays, 1 / camera.focal_length.mean())
        floor = np.flatnonzero(reach)
        point = eye + reach[floor, None] * flat_rays[floor]
        u, v = (point @ self.room.axes[:, :2] / self._shadow_width + 0.5).T
        shares = sample_image(self._shadow, u, v, cv2.BORDER_CONSTANT)
        radiance[floor] *= self.room.on_the_floor(*shares.T)
        depth = np.where(reach < FLOOR_REACH, reach, 0).astype(np.float32)
        return radiance.reshape(rays.shape), depth.reshape(rays.shape[:2])


def _pixel_rays(camera: Camera, n: int) -> Image:
    """Return rays of unit z in the camera frame through n x n points of each pixel."""
    height, width = camera.size
    finer = camera.resize((n * height, n * width))
    rays = unproject_depth(np.ones(finer.size), finer)
    return (rays @ camera.R).astype(np.float32)


def _interpolated(
    weights: Vectors, corners: Float[np.ndarray, "n 3 c"]
) -> Float[np.ndarray, "n c"]:
    """Return values at surface points from those at the corners of their faces."""
    return np.einsum("nk,nkc->nc", weights, corners)


def _towards(normal: Vectors, rays: Vectors) -> Vectors:
    """Return the normals, turned so that they point against the rays."""
    return normal * -np.sign(_dot(normal, rays))[:, None]


def _dot(a: Vectors, b: Vectors) -> Values:
    """Return the scalar products of the rows."""
    return np.einsum("nd,nd->n", a, b)


def _spread_directions(
    rng: np.random.Generator, n: int, count: int
) -> Float[np.ndarray, "n {count} 3"]:
    """Return n sets of `count` unit vectors, each spread evenly over the sphere at random."""
    # A Fibonacci spiral: equal steps of z cover equal areas of the sphere, and a turn by the golden
    # ratio (0.618) from point to point keeps the points out of rows.
    index = np.arange(count, dtype=np.float32)
    z = 1 - 2 * (index + rng.random((n, 1), np.float32)) / count
    turns = index * 0.618034 + rng.random((n, 1), np.float32)
    angle = TAU * turns
    radius = np.sqrt(np.maximum(1 - z**2, 0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)
