"""The renderer's geometry is exact, and its pictures obey light, texture, holes and glass."""

import numpy as np
import pytest
from model_files import painted, studio, view, wedge, write_quad

from zsp_lite.synthetic.meshes import canonical_mesh, read_mesh
from zsp_lite.synthetic.models import ModelInfo
from zsp_lite.synthetic.raytracing import MeshScene
from zsp_lite.synthetic.room import RoomLight
from zsp_lite.synthetic.sequences import orbit_pose
from zsp_lite.training.renders import framed_camera

STUDIO = RoomLight(studio())


def render(mesh, camera, samples=1, coordinates=None):
    return MeshScene(mesh, STUDIO, 0, coordinates, samples).render(camera)


def standing_quad(folder, texture, **material):
    """A textured square, 2 x 2, that faces +x and stands on an edge."""
    mesh = read_mesh(write_quad(folder / "quad.obj", texture, **material))
    return canonical_mesh(mesh, ModelInfo().axes(".obj"))


def from_the_front(mesh, size=48):
    return framed_camera(mesh.vertices, *orbit_pose(0, 0.02, 0, 8, np.zeros(3)), size, margin=1.5)


def intersect(camera, vertices, faces):
    """Depth (h, w) of the nearest triangle at the centre of each pixel, from a linear system each; inf elsewhere."""
    x, y = np.meshgrid(np.arange(camera.size[1]) + 0.5, np.arange(camera.size[0]) + 0.5)
    rays = camera.unproject_camera(np.stack([x, y], -1), np.ones(camera.size))
    nearest = np.full(camera.size, np.inf)
    for corners in (vertices @ camera.R.T + camera.t)[faces]:
        weights = rays @ np.linalg.inv(corners)  # depth * ray = (weights * depth) @ corners
        depth = 1 / weights.sum(-1)
        hit = (weights >= 0).all(-1) & (depth > 0)
        nearest[hit] = np.minimum(nearest, depth)[hit]
    return nearest


@pytest.mark.parametrize("samples", [1, 2])
def test_depth_and_mask_are_those_of_the_triangles_and_of_the_floor_for_any_number_of_samples(samples):
    mesh = painted(wedge())
    camera = view(mesh.vertices, azimuth=200)
    drawn = render(mesh, camera, samples)
    expected = intersect(camera, mesh.vertices, mesh.faces)
    assert (drawn.mask == np.isfinite(expected)).mean() > 0.999
    both = drawn.mask & np.isfinite(expected)
    assert drawn.depth[both] == pytest.approx(expected[both], abs=1e-4)
    row, col = np.nonzero((drawn.depth > 0) & ~drawn.mask)
    floor = camera.unproject(np.stack([col + 0.5, row + 0.5], 1), drawn.depth[row, col])
    assert len(row) > 500 and floor[:, 2] == pytest.approx(mesh.vertices[:, 2].min(), abs=1e-3)
    row, col = np.nonzero(drawn.mask)
    ray = camera.unproject_camera(np.stack([col + 0.5, row + 0.5], 1), np.ones(len(row)))
    facing = (drawn.normals[row, col] * ray).sum(1)
    assert np.linalg.norm(drawn.normals[row, col], axis=1) == pytest.approx(1, abs=1e-4) and (facing < 1e-6).all()


def test_a_texture_is_upright_and_not_mirrored(tmp_path):
    colours = np.array([[[200, 40, 40], [40, 180, 40]], [[40, 60, 200], [200, 190, 60]]], np.uint8)
    texture = np.repeat(np.repeat(colours, 16, 0), 16, 1)
    mesh = standing_quad(tmp_path, texture)
    drawn = render(mesh, from_the_front(mesh))
    row, col = np.nonzero(drawn.mask)
    (top, bottom), (left, right) = (np.quantile(axis, (0.25, 0.75)).astype(int) for axis in (row, col))
    seen = drawn.rgb[np.ix_([top, bottom], [left, right])].astype(int)
    # Red, green / blue, yellow: the brighter channels tell them apart.
    assert (seen.argmax(-1)[0] == [0, 1]).all() and seen[1, 0].argmax() == 2 and seen[1, 1].argmin() == 2


def test_a_hole_in_a_texture_is_a_hole_in_mask_depth_and_shadow(tmp_path):
    texture = np.full((64, 64, 4), 255, np.uint8)
    texture[16:48, 16:48, 3] = 0
    mesh = standing_quad(tmp_path, texture)
    scene = MeshScene(mesh, STUDIO, 0)
    drawn = scene.render(from_the_front(mesh))
    row, col = np.nonzero(drawn.mask)
    middle = round(row.mean()), round(col.mean())
    assert not drawn.mask[middle] and np.isnan(drawn.canonical[middle]).all()
    full = (np.ptp(row) + 1) * (np.ptp(col) + 1)
    assert drawn.mask.sum() / full == pytest.approx(0.75, abs=0.05)
    behind = np.array([[-3.0, 0, 0], [-3.0, 0.9 * mesh.vertices[:, 1].max(), 0]], np.float32)
    assert scene._visible_share(behind, np.tile(np.float32([1, 0, 0]), (2, 1, 1))).tolist() == [1, 0]
