"""Path tracing: what is handed to Blender, and, where Blender is installed, that both engines agree."""

import os
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from model_files import painted, view, wedge, write_quad, write_wedge

import zsp_lite
from zsp_lite.cli.main import main
from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError
from zsp_lite.synthetic import path_tracing
from zsp_lite.synthetic.meshes import Material, TexturedMesh, canonical_mesh, read_mesh
from zsp_lite.synthetic.models import ModelInfo
from zsp_lite.synthetic.path_tracing import PYTHON_VARIABLE, path_traced_views, trace, write_scene
from zsp_lite.synthetic.raytracing import HARD_SHADOWS, MeshScene
from zsp_lite.synthetic.room import Room, random_room, studio

BLENDER = Path(os.environ.get(PYTHON_VARIABLE) or Path(__file__).parents[1] / ".render-env/bin/python")
needs_blender = pytest.mark.skipif(not BLENDER.is_file(), reason="no Blender module; `make render-env` installs it")


def written(tmp_path, mesh, room, cameras) -> dict:
    write_scene(tmp_path / "scene.npz", MeshScene(mesh, room, HARD_SHADOWS), cameras)
    with np.load(tmp_path / "scene.npz") as stored:
        return dict(stored)


def test_cameras_of_blender_look_at_the_object_and_are_upright(tmp_path):
    mesh = painted(wedge())
    camera = view(mesh.vertices)
    (pose,) = written(tmp_path, mesh, studio(), [camera])["camera_to_world"]
    assert pose[:3, 3] == pytest.approx(camera.centre)
    depth = -(np.linalg.inv(pose) @ np.append(mesh.vertices.mean(0), 1))[2]  # Blender's cameras look along -z
    assert depth == pytest.approx((camera.R @ mesh.vertices.mean(0) + camera.t)[2])
    assert pose[2, 1] > 0.5  # +y of the camera points upwards


def test_the_faces_of_the_room_have_the_rows_and_columns_of_its_images(tmp_path):
    room = random_room(3, plain=True)
    mesh = painted(wedge())
    scene = written(tmp_path, mesh, room, [view(mesh.vertices)])
    corners, uv = scene["room_corners"], scene["room_uv"]
    floor = mesh.vertices[:, 2].min()
    assert corners[4][:, 2] == pytest.approx([floor] * 4) and corners[5][:, 2] == pytest.approx(
        [floor + room.high[2]] * 4
    )
    for wall in range(4):  # the first row of a wall's image is at the ceiling, where v is 1
        assert (uv[wall][:, 1] == (corners[wall][:, 2] > floor + 1)).all()
    assert (uv[4][:, 1] == (corners[4][:, 1] < 0)).all()  # the first row of the floor's image is at low y


def test_windows_and_the_ceiling_give_off_light_and_walls_reflect(tmp_path):
    room = random_room(3, plain=True)
    scene = written(tmp_path, painted(wedge()), room, [view(wedge().vertices)])
    assert max(scene[f"glow{wall}"].max() for wall in range(4)) > 1  # the window
    assert scene["glow5"].min() > 0 and not scene["room5"].any()
    for face in range(6):
        assert scene[f"room{face}"].max() <= 0.9
        np.testing.assert_array_equal(scene[f"room{face}"] + scene[f"glow{face}"], room.images[face])


def test_cameras_of_several_sizes_or_without_square_pixels_are_refused(tmp_path):
    mesh = painted(wedge())
    camera = view(mesh.vertices)
    stretched = Camera(camera.R, camera.t, camera.focal_length * [1, 1.1], camera.principal_point, camera.size)
    for cameras in ([stretched], [camera, view(mesh.vertices, size=32)]):
        with pytest.raises(InputError, match="one image size with square pixels"):
            written(tmp_path, mesh, studio(), cameras)


def test_the_command_says_in_one_line_that_blender_is_missing(tmp_path, monkeypatch, capsys):
    write_wedge(tmp_path / "models/chair/one.obj")
    monkeypatch.setenv(PYTHON_VARIABLE, str(tmp_path / "nowhere"))
    arguments = ["synth", "--models", str(tmp_path / "models"), "--engine", "cycles", "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert "make render-env" in message and message.count("\n") == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("end", "message"),
    [
        ("echo 'No module named bpy' >&2; exit 1", "exit code 1: No module named bpy"),
        ("kill -9 $$", "exit code -9: noise"),
        ("exit 0", "exit code 0: noise"),  # without pictures
    ],
)
def test_a_failure_of_blender_is_reported_with_its_last_line(tmp_path, monkeypatch, end, message):
    python = tmp_path / "python"
    python.write_text(f"#!/bin/sh\necho noise >&2\n{end}\n")
    python.chmod(0o755)
    monkeypatch.setenv(PYTHON_VARIABLE, str(python))
    mesh = painted(wedge())
    with pytest.raises(InputError, match=f"Blender failed in .* with {message}"):
        path_traced_views(mesh, [view(mesh.vertices)], np.random.default_rng(0))


def test_only_the_script_of_blender_imports_bpy_and_nothing_imports_the_script():
    """Blender's module is under the GPL and runs in a process of its own."""
    sources = {path.stem: path.read_text() for path in Path(zsp_lite.__file__).parent.rglob("*.py")}
    imported = {name: set(re.findall(r"^\s*(?:import|from) (\S+)", text, re.M)) for name, text in sources.items()}
    assert [name for name, modules in imported.items() if modules & {"bpy", "mathutils"}] == ["blender_scene"]
    assert not [name for name, text in sources.items() if re.search(r"^\s*(import|from) .*blender_scene", text, re.M)]
    assert imported["blender_scene"] <= set(sys.stdlib_module_names) | {"bpy", "mathutils", "numpy", "pathlib"}


def holed_quad(tmp_path) -> TexturedMesh:
    texture = np.full((64, 64, 4), 255, np.uint8)
    texture[8:40, 8:28, 3] = 0
    mesh = read_mesh(write_quad(tmp_path / "quad.obj", texture))
    return canonical_mesh(mesh, ModelInfo().axes(".obj"))


@needs_blender
@pytest.mark.slow
@pytest.mark.parametrize("shape", ["wedge", "cut-out"])
def test_both_engines_see_the_same_silhouette(tmp_path, monkeypatch, shape):
    """A black object in a room that glows: what is dark is the object."""
    monkeypatch.setenv(PYTHON_VARIABLE, str(BLENDER))
    mesh = painted(wedge()) if shape == "wedge" else holed_quad(tmp_path)
    black = [Material(np.array([0, 0, 0, 1.0]), m.texture, specular=0.0, roughness=1.0) for m in mesh.materials]
    mesh = TexturedMesh(mesh.vertices, mesh.faces, mesh.normals, mesh.uv, mesh.colours, mesh.material, tuple(black))
    glowing = studio()
    images = tuple(np.full((8, 8, 3), 0.8 if face == 4 else 2.0, np.float32) for face in range(6))
    room = Room(glowing.low, glowing.high, images, glowing.light, 0.15, np.ones(3), np.ones(3), 0.0, glowing.camera)
    centred = view(mesh.vertices, azimuth=25, size=128)
    size, shift = (96, 128), np.array([3.3, -12.4])  # a principal point off the centre
    camera = Camera(centred.R, centred.t, centred.focal_length * 0.7, centred.principal_point * 0.8 + shift, size)
    scene = MeshScene(mesh, room, HARD_SHADOWS)
    write_scene(tmp_path / "scene.npz", scene, [camera])
    (radiance,) = trace(tmp_path, 1, samples=16)
    # Linear, without a tone curve. The wedge is seen before the floor, whose albedo is 0.8 and which receives the key
    # light at its slant and the light of the room; the cut-out before a wall, which gives off light.
    brightest = 0.8 * (room.light[2] + 1) if shape == "wedge" else 2.0
    assert np.percentile(radiance, 95) == pytest.approx(brightest, rel=0.02)
    mask = scene.geometry(camera)["mask"]
    assert 500 < mask.sum() < 0.5 * mask.size
    dark = radiance.max(-1) < 0.25
    kernel = np.ones((3, 3), np.uint8)
    inner, outer = cv2.erode(mask.astype(np.uint8), kernel) > 0, cv2.dilate(mask.astype(np.uint8), kernel) > 0
    assert dark[inner].mean() > 0.99 and dark[~outer].mean() < 0.002
    # The upper outline, away from the shadow on the floor, is at the same place to a fraction of a pixel.
    upper = np.flatnonzero(mask.any(1))[: int(mask.any(1).sum() / 2)]
    dark = (radiance.max(-1) < np.median(radiance) / 2)[upper]
    shared = dark.any(0) & mask[upper].any(0)
    assert abs((dark[:, shared].argmax(0) - mask[upper][:, shared].argmax(0)).mean()) < 0.3
    middles = [(seen.argmax(1) + seen.shape[1] - 1 - seen[:, ::-1].argmax(1)) / 2 for seen in (dark, mask[upper])]
    assert abs((middles[0] - middles[1])[dark.any(1)].mean()) < 0.3


@needs_blender
@pytest.mark.slow
def test_path_traced_views_have_the_geometry_of_ray_casting_and_a_texture_that_stands_upright(tmp_path, monkeypatch):
    monkeypatch.setenv(PYTHON_VARIABLE, str(BLENDER))
    monkeypatch.setattr(path_tracing, "_SAMPLES", 8)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32], texture[:32, 32:], texture[32:, :32], texture[32:] [:, 32:] = (
        (220, 30, 30), (30, 200, 30), (30, 30, 220), (220, 200, 30))  # fmt: skip
    mesh = canonical_mesh(read_mesh(write_quad(tmp_path / "quad.obj", texture)), ModelInfo().axes(".obj"))
    camera = view(mesh.vertices, azimuth=0, elevation=5, size=64)
    (seen,) = path_traced_views(mesh, [camera], np.random.default_rng(1))
    expected = MeshScene(mesh, random_room(np.random.default_rng(1), plain=True), HARD_SHADOWS).geometry(camera)
    np.testing.assert_array_equal(seen.mask, expected["mask"])
    np.testing.assert_array_equal(seen.depth, expected["depth"])
    rows, cols = np.nonzero(seen.mask)
    top, left = rows < rows.mean(), cols < cols.mean()
    means = [seen.rgb[rows[on], cols[on]].mean(0) for on in (top & left, top & ~left, ~top & left, ~top & ~left)]
    assert [mean.argmax() for mean in means[:3]] == [0, 1, 2] and means[3][2] < means[3][:2].min()
