"""Model files are read into the canonical frame or refused with a reason; their renderings have
exact geometry."""

import numpy as np
import pytest
import trimesh
from model_files import studio, wedge, write_quad, write_wedge
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

from zsp_lite.course.synthetic import meshes
from zsp_lite.course.synthetic.meshes import ModelInfo, canonical_mesh, list_models, read_mesh
from zsp_lite.course.synthetic.primitives import surface_spread
from zsp_lite.course.synthetic.raytracing import MeshScene
from zsp_lite.course.synthetic.sequences import orbit_pose
from zsp_lite.course.synthetic.textures import srgb_to_linear
from zsp_lite.course.training.renders import framed_camera

STUDIO = studio()
# A texture of 2 x 2 pixels.
CHECKS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)


def test_an_obj_file_gives_texture_coordinates_texture_colour_and_opacity(tmp_path):
    mesh = read_mesh(write_quad(tmp_path / "quad.obj", CHECKS, colour=(0.5, 1, 1), opacity=0.25))
    assert len(mesh.faces) == 2
    assert np.ptp(mesh.vertices, axis=0).tolist() == [2, 2, 0]
    (material,) = mesh.materials
    assert material.texture[..., :3].tolist() == CHECKS.tolist()
    assert_array_equal(material.texture[..., 3], 255)
    assert_allclose(material.colour, [0.5, 1, 1, 0.25], atol=0.01)
    # Texture coordinates of each corner: u to the right, v up.
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    assert mesh.uv.reshape(-1, 2) == pytest.approx(corners[:, :2] / 2 + 0.5)
    assert np.abs(mesh.normals) == pytest.approx(np.broadcast_to([0, 0, 1.0], (2, 3, 3)))


def test_the_linear_colour_factor_of_gltf_becomes_srgb(tmp_path):
    linear = np.array([5, 51, 255]) / 255
    cube = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[*linear, 1.0])
    cube.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    cube.export(tmp_path / "cube.glb")
    (read,) = read_mesh(tmp_path / "cube.glb").materials
    assert_allclose(srgb_to_linear(read.colour[:3]), linear, atol=1e-4)


@pytest.mark.parametrize("extension", ["obj", "glb", "ply", "stl"])
def test_every_format_gives_the_same_canonical_shape(tmp_path, extension):
    shape = wedge()
    # From front +x, up +z to the axes that the format has by default.
    turned = shape.vertices[:, [1, 0, 2]] * (1, -1, 1)
    vertices = turned if extension == "stl" else shape.vertices[:, [1, 2, 0]]
    path = tmp_path / f"wedge.{extension}"
    trimesh.Trimesh(vertices, shape.faces, process=False).export(path)
    mesh = canonical(path)
    centred = shape.vertices - (shape.vertices.max(0) + shape.vertices.min(0)) / 2
    expected = centred / surface_spread(centred, shape.faces)
    # Formats differ in the order of faces: compare the sorted coordinates of all corners.
    corners = np.sort(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0)
    assert_allclose(corners, np.sort(expected[shape.faces].reshape(-1, 3), axis=0), atol=1e-5)
    assert surface_spread(mesh.vertices, mesh.faces) == pytest.approx(1)


def test_parts_of_a_scene_are_placed_by_its_graph(tmp_path):
    # A cube around the origin, and one around x = 5 that is mirrored and twice as long in x.
    mirrored = np.diag([-2.0, 1, 1, 1])
    mirrored[0, 3] = 5
    scene = trimesh.Scene()
    for transform in (np.eye(4), mirrored):
        scene.add_geometry(trimesh.creation.box(), transform=transform)
    scene.export(tmp_path / "two.glb")
    mesh = read_mesh(tmp_path / "two.glb")
    x = mesh.vertices[:, 0]
    assert (x.min(), x.max()) == pytest.approx((-0.5, 6))
    assert_allclose(np.linalg.norm(mesh.normals, axis=-1), np.ones((24, 3)), atol=1e-5)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    "name, content, reason",
    [
        (
            "nan.obj",
            f"v nan 0 0\n{TRIANGLE}f 1 2 3\n",
            "nan.obj: vertices holds nan, expected finite numbers",
        ),
        (
            "far.obj",
            f"v 1e300 0 0\n{TRIANGLE}f 1 2 3\n",
            "far.obj: vertices holds 1e.300, expected finite numbers",
        ),
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no visible face with an area"),
        ("lost.obj", f"mtllib gone.mtl\n{TRIANGLE}f 1 2 3\n", "lacks its material file 'gone.mtl'"),
        ("damaged.glb", "glTF" + 50 * " ", "damaged.glb cannot be read"),
        ("cube.dae", "<COLLADA/>", "lacks the package pycollada"),
        ("clear.obj", "quad", "no visible face with an area"),
        ("bare.obj", "quad", "lacks its texture 'bare.png'"),
        ("many.obj", 3 * f"{TRIANGLE}f 1 2 3\n", "has 3 faces, expected 1 to 2"),
        ("large.obj", 1000 * TRIANGLE, "bytes, expected at most"),
    ],
)
def test_an_unusable_file_is_refused_with_its_reason(tmp_path, monkeypatch, name, content, reason):
    monkeypatch.setattr(meshes, "find_spec", lambda name: None)  # no optional package
    monkeypatch.setattr(meshes, "MAX_FACES", 2)
    monkeypatch.setattr(meshes, "MAX_BYTES", 1000)
    if content == "quad":
        # clear.obj is transparent, the other one lacks its texture.
        write_quad(tmp_path / name, CHECKS, opacity=float(name != "clear.obj"))
        (tmp_path / "bare.png").unlink(missing_ok=True)
    else:
        (tmp_path / name).write_text(content)
    refused(reason, read_mesh, tmp_path / name)


def test_an_orientation_is_a_rotation_to_front_x_and_up_z():
    # An oblique front.
    rotation = ModelInfo(front=(-3, 4, 0), up=(0, 0, 2)).axes(".ply")
    expected = np.array([[-3, 4, 0], [-4, -3, 0], [0, 0, 5]]) / 5
    assert rotation == pytest.approx(expected)
    rotation = ModelInfo(front="-x", up="+y").axes(".obj")
    assert rotation == pytest.approx(np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]]))


@pytest.mark.parametrize("info", [ModelInfo(front="+y", up="+y"), ModelInfo(up=(0, 0, 0))])
def test_impossible_orientations_are_refused(info):
    refused("expected", info.axes, ".obj")


@pytest.mark.parametrize(
    "folder, entries, message",
    [
        ("", '{"chair/gone": {}}', "names 'chair/gone', which has no file"),
        ("nowhere", "{}", "does not exist"),
        ("chair", "{}", "holds no model"),
    ],
)
def test_a_folder_without_models_and_a_wrong_list_are_refused(tmp_path, folder, entries, message):
    write_wedge(tmp_path / "chair/a.obj")
    (tmp_path / "models.json").write_text(entries)
    refused(message, list_models, tmp_path / folder)


def render(mesh, camera, samples=1):
    """A picture of a mesh on the floor of the studio, by so many rays per side of a pixel."""
    return MeshScene(mesh, STUDIO, seed=0, samples=samples).render(camera)


def canonical(path):
    """The mesh of a file in the canonical frame."""
    return canonical_mesh(read_mesh(path), ModelInfo().axes(path.suffix))


def framed(mesh, azimuth, elevation, size):
    """A camera that frames a mesh; angles in degrees."""
    # Without roll, at a distance of 8.
    pose = orbit_pose(*np.radians([azimuth, elevation]), 0, 8, np.zeros(3))
    return framed_camera(mesh.vertices, *pose, size, margin=1.5)


def intersect(camera, vertices, faces):
    """Depth (h, w) of the nearest triangle at the centre of each pixel, inf where there is none;
    each triangle is a linear system."""
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
def test_depth_and_mask_are_those_of_the_triangles_and_the_floor(tmp_path, samples):
    mesh = canonical(write_wedge(tmp_path / "wedge.obj"))
    camera = framed(mesh, 200, 25, 64)
    drawn = render(mesh, camera, samples)
    expected = intersect(camera, mesh.vertices, mesh.faces)
    # A pixel whose centre lies on an edge may be inside or outside.
    assert (drawn.mask == np.isfinite(expected)).mean() > 0.999
    both = drawn.mask & np.isfinite(expected)
    assert_allclose(drawn.depth[both], expected[both], atol=1e-4)
    row, col = np.nonzero((drawn.depth > 0) & ~drawn.mask)
    floor = camera.unproject(np.stack([col + 0.5, row + 0.5], 1), drawn.depth[row, col])
    assert len(row) > 500  # the floor is seen beside the object
    assert_allclose(floor[:, 2], mesh.vertices[:, 2].min(), atol=1e-3)


def test_a_texture_is_upright_and_not_mirrored(tmp_path):
    # Red and green above blue and yellow, 16 x 16 pixels each.
    colours = np.array([[[200, 40, 40], [40, 180, 40]], [[40, 60, 200], [200, 190, 60]]], np.uint8)
    mesh = canonical(
        write_quad(tmp_path / "quad.obj", np.kron(colours, np.ones((16, 16, 1), np.uint8)))
    )
    drawn = render(mesh, framed(mesh, 0, 1, 48))
    # The square is 32 pixels wide, in the middle: a pixel in the middle of each quarter.
    (red, green), (blue, yellow) = drawn.rgb[16:48:16, 16:48:16].astype(int)
    # The light changes the colours; their brightest and darkest channels tell them apart.
    assert [red.argmax(), green.argmax(), blue.argmax(), yellow.argmin()] == [0, 1, 2, 2]


@pytest.fixture
def holed(tmp_path):
    """A square that is clear in its middle, a quarter of its area."""
    texture = np.full((64, 64, 4), 255, np.uint8)
    texture[16:48, 16:48, 3] = 0
    return canonical(write_quad(tmp_path / "quad.obj", texture))


def test_a_hole_in_a_texture_is_a_hole_in_mask_and_coordinates(holed):
    drawn = render(holed, framed(holed, 0, 1, 48))
    assert not drawn.mask[24, 24]
    assert np.isnan(drawn.canonical[24, 24]).all()
    # The square is 32 pixels wide.
    assert_allclose(drawn.mask.sum() / 32**2, 0.75, atol=0.05)


def test_light_falls_through_a_hole_in_a_texture(holed):
    # Points behind the middle and behind the side of the square, with light from the front.
    points = np.array([[-3.0, 0, 0], [-3.0, 0.9 * holed.vertices[:, 1].max(), 0]], np.float32)
    light = np.tile(np.float32([1, 0, 0]), (2, 1, 1))
    assert MeshScene(holed, STUDIO, seed=0)._visible_share(points, light).tolist() == [1, 0]
