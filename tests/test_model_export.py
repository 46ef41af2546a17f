"""A folder of models becomes a data folder with exact labels; the user's renderer and sensor fit in."""

import json
import re
import shutil
from functools import wraps

import cv2
import numpy as np
import pytest
from model_files import write_quad, write_wedge

from zsp_lite.cli import main as cli
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import shipped_pairs
from zsp_lite.data.samples import REPOSITORY
from zsp_lite.errors import InputError
from zsp_lite.synthetic.ground_truth import ground_truth_pair, object_poses
from zsp_lite.synthetic.model_export import RENDERED_FILE, export_models
from zsp_lite.synthetic.model_sheet import label_overlay, sheet_views, write_contact_sheet, write_label_overlay
from zsp_lite.synthetic.models import list_models, turn_model
from zsp_lite.synthetic.raytracing import HARD_SHADOWS
from zsp_lite.synthetic.sensor import simulate_capture
from zsp_lite.synthetic.sequences import render_sequence, render_views

FRAMES, SIZE = 8, 64
pytestmark = pytest.mark.usefixtures("coarse_rooms")


def quick(mesh, cameras, rng):
    """The default renderer with hard shadows."""
    return render_views(mesh, cameras, rng, HARD_SHADOWS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two chairs, one of which lies on its back in its file, and a sign whose texture is missing."""
    root = tmp_path_factory.mktemp("models")
    write_wedge(root / "chair" / "high.obj", seat=0.9)
    write_wedge(root / "chair" / "low.obj", seat=0.4)
    (root / "models.json").write_text('{"chair/low": {"author": "Ann", "licence": "CC0-1.0"}}')
    path = root / "chair" / "low.obj"
    lines = path.read_text().splitlines()
    lying = [f"v {x} {-z} {y}" for x, y, z in (map(float, line.split()[1:]) for line in lines if line[0] == "v")]
    path.write_text("\n".join(lying + [line for line in lines if line[0] == "f"]) + "\n")
    turn_model(root, "chair/low", "left", -90)
    write_quad(root / "sign" / "stop.obj", np.full((4, 4, 3), 200, np.uint8))
    (root / "sign" / "stop.png").unlink()
    return root


@pytest.fixture(scope="module")
def data(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("data")
    left_out = export_models(folder, out, FRAMES, seed=3, image_size=SIZE, renderer=quick)
    return Co3D(out), left_out


def test_the_data_folder_has_a_sequence_per_usable_model_and_names_the_others(data):
    dataset, left_out = data
    assert dataset.categories() == ["chair"]
    assert [sequence.sequence_name for sequence in dataset.sequences("chair")] == ["high", "low"]
    assert list(left_out) == ["sign/stop"] and "lacks its texture 'stop.png'" in left_out["sign/stop"]
    frames = dataset.frames("chair", "low")
    frame = dataset.load(frames[0])
    assert len(frames) == FRAMES and min(frame.camera.size) == SIZE
    assert 0.05 < (frame.mask > 0.5).mean() < 0.5 and 0.4 < (frame.depth[frame.mask > 0.9] > 0).mean() < 0.9
    points, _ = dataset.point_cloud("chair", "low")
    assert points.std(0).mean() == pytest.approx(1, abs=1e-3)
    record = json.loads((dataset.root / RENDERED_FILE).read_text())["sequences"]["chair"]["low"]
    assert (record["author"], record["licence"], record["file"]) == ("Ann", "CC0-1.0", "chair/low.obj")


def test_labels_map_the_front_of_the_reference_to_the_front_of_every_object(data):
    dataset, _ = data
    poses, labels = object_poses(dataset, "chair"), read_labels(dataset.root, "chair")
    assert (labels["high"].trans == np.eye(4)).all()
    for name, label in labels.items():
        axes = label.trans[:3, :3] @ poses["high"].R  # of the reference, placed by the label
        assert axes == pytest.approx(poses[name].R, abs=1e-6)
        assert label.trans[:3, :3] @ poses["high"].t + label.trans[:3, 3] == pytest.approx(poses[name].t, abs=1e-6)


def test_points_of_the_cloud_fill_the_bounding_box_of_the_model(data, folder):
    dataset, _ = data
    for model in list_models(folder)[:2]:
        pose = object_poses(dataset, "chair")[model.name]
        points, _ = dataset.point_cloud("chair", model.name)
        inside = pose.to_box(points)
        assert np.quantile(inside, 0.01) > -0.1 and np.quantile(inside, 0.99) < 1.1
        vertices = model.read().vertices
        assert (pose.low == vertices.min(0)).all() and (pose.high == vertices.max(0)).all()


def test_the_overlay_draws_the_front_of_the_reference_on_the_front_of_every_object(data, tmp_path):
    """The tips of the overlay's axes are pixels near which the object shows its own front, left side and top."""
    dataset, _ = data
    drawn = label_overlay(dataset, "chair")
    assert list(drawn) == ["high", "low"]
    for name, (picture, pose, camera) in drawn.items():
        own = object_poses(dataset, "chair")[name]
        for axis in range(3):
            (overlaid, true), _ = camera.project(np.stack([pose[:3, 3] + pose[:3, axis], own.t + own.R[:, axis]]))
            assert overlaid == pytest.approx(true, abs=0.1)
        towards = pose[:3, 0] @ (camera.centre - pose[:3, 3])
        assert picture.shape == (200, 200, 3) and towards > 0  # the frame sees the front
        # Matching colours: red, green and blue arrows are in the picture.
        for channel in range(3):
            others = np.delete(picture.astype(int), channel, axis=2).max(-1)
            assert (picture[..., channel] - others > 60).sum() > 20
    path = write_label_overlay(tmp_path / "overlay.png", dataset)
    assert path.read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(InputError, match="extension '.doc'"):
        write_label_overlay(tmp_path / "overlay.doc", dataset)


def test_pairs_and_ground_truth_matches_exist(data):
    dataset, _ = data
    pairs = shipped_pairs(dataset, "chair", 3)
    assert len(pairs) == 20 and len(shipped_pairs(dataset, "chair", 1)) == 20
    assert ground_truth_pair(dataset, pairs[0], (14, 14)).valid.sum() > 5


def test_complete_sequences_stay_and_turned_models_are_rendered_again(data, folder, tmp_path):
    rendered = []

    @wraps(quick)
    def counting(mesh, cameras, rng):
        rendered.append(mesh.name)
        return quick(mesh, cameras, rng)

    copy, out = tmp_path / "models", tmp_path / "data"
    shutil.copytree(folder, copy)
    shutil.copytree(data[0].root, out)
    settings = {"frames": FRAMES, "seed": 3, "image_size": SIZE, "renderer": counting}
    before = read_labels(out, "chair")["low"].trans
    export_models(copy, out, **settings)
    assert not rendered
    turn_model(copy, "chair/low", "up", 90)
    export_models(copy, out, **settings)
    assert len(rendered) == 1 and rendered[0].endswith("low.obj")
    assert not np.allclose(read_labels(out, "chair")["low"].trans, before)
    with pytest.raises(InputError, match="was written with"):
        export_models(copy, out, **{**settings, "seed": 4})


def test_a_renderer_and_a_sensor_of_the_user_take_the_place_of_the_own_ones(folder, tmp_path):
    def black(mesh, cameras, rng):
        for view in quick(mesh, cameras, rng):
            view.rgb[:] = 0
            yield view

    def exact_masks(sequence, name, seed):
        data, exact = simulate_capture(sequence, name, seed)
        for frame, view in zip(data.frames, exact.views, strict=True):
            frame.mask[:] = view.mask
        return data, exact

    export_models(folder, tmp_path, 2, image_size=48, renderer=black, sensor=exact_masks)
    dataset = Co3D(tmp_path)
    frame = dataset.load(dataset.frames("chair", "high")[1])
    assert frame.rgb.max() < 5 and set(np.unique(frame.mask)) == {0, 1}
    with pytest.raises(InputError, match="was written with .*'sensor': '.*exact_masks'"):
        export_models(folder, tmp_path, 2, image_size=48, renderer=black)


def test_landscape_pictures_and_coarse_depth_are_settings_of_an_export(folder, tmp_path):
    for out, settings in (("fine", {}), ("coarse", {"landscape": True, "depth_bits": 6})):
        export_models(folder, tmp_path / out, frames=1, image_size=SIZE, renderer=quick, **settings)
    stored = {out: sorted((tmp_path / out).rglob("depths/*.png")) for out in ("fine", "coarse")}
    dataset = Co3D(tmp_path / "coarse")
    for annotation in (frame for s in dataset.sequences("chair") for frame in dataset.frames("chair", s.sequence_name)):
        assert dataset.load(annotation).rgb.shape == (SIZE, 85, 3)
    assert all(not (cv2.imread(str(path), -1) & 0b1111).any() for path in stored["coarse"])
    assert any((cv2.imread(str(path), -1) & 0b1111).any() for path in stored["fine"])
    with pytest.raises(InputError, match="was written with .*depth_bits"):
        export_models(folder, tmp_path / "coarse", frames=1, image_size=SIZE, renderer=quick)
    with pytest.raises(InputError, match="was written with .*'renderer': 'quick'"):
        export_models(folder, tmp_path / "fine", frames=1, image_size=SIZE)
    with pytest.raises(InputError, match="depth_bits is 11, expected an integer from 1 to 10"):
        export_models(folder, tmp_path / "other", depth_bits=11)


def test_cameras_do_not_depend_on_the_renderer(folder):
    mesh = list_models(folder)[0].read()
    one = render_sequence(mesh, 5, 3, 48, quick)
    two = render_sequence(mesh, 5, 3, 48, lambda mesh, cameras, rng: quick(mesh, cameras, np.random.default_rng(0)))
    for first, second in zip(one.views, two.views, strict=True):
        assert (first.camera.matrix == second.camera.matrix).all()
        assert (first.mask == second.mask).all() and (first.depth == second.depth)[first.mask].all()
    assert (one.views[0].camera.matrix == np.eye(4)).all()


def test_the_contact_sheet_shows_every_usable_model_three_times(folder, tmp_path):
    unusable = write_contact_sheet(folder, tmp_path / "sheet.html", size=48)
    page = (tmp_path / "sheet.html").read_text()
    assert list(unusable) == ["sign/stop"] and "stop.png" in page
    assert page.count("data:image/jpeg") == 6 and "Ann, CC0-1.0" in page
    pictures = sheet_views(list_models(folder)[0].read(), 64)
    assert [picture.shape for picture in pictures] == [(64, 64, 3)] * 3


def test_a_folder_of_other_data_or_without_a_usable_model_is_refused(data, folder, tmp_path):
    write_quad(tmp_path / "models" / "sign" / "stop.obj", opacity=0)
    with pytest.raises(InputError, match="holds no usable model; sign/stop: .* no visible face"):
        export_models(tmp_path / "models", tmp_path / "out")
    (data[0].root / RENDERED_FILE).rename(tmp_path / RENDERED_FILE)
    with pytest.raises(InputError, match="holds other data"):
        export_models(folder, data[0].root)
    (tmp_path / RENDERED_FILE).rename(data[0].root / RENDERED_FILE)


@pytest.mark.slow
def test_the_command_line_renders_checks_and_turns_models(folder, tmp_path, capsys):
    out, mine = tmp_path / "data", tmp_path / "mine"
    write_wedge(mine / "chair" / "a.obj")
    shutil.copytree(folder / "sign", mine / "sign")
    arguments = ["synth", "--models", str(mine), "--frames", "2", "--image-size", "48", "--out", str(out)]
    assert cli.main(arguments) == 0
    assert "Left out sign/stop" in capsys.readouterr().out
    assert Co3D(out).categories() == ["chair"]
    assert (out / "models.html").is_file() and (out / "label_overlay.jpg").is_file()
    assert cli.main(["models", "sheet", str(mine), "--out", str(tmp_path / "sheet.html")]) == 0
    assert (tmp_path / "sheet.html").read_bytes() == (out / "models.html").read_bytes()
    capsys.readouterr()
    assert cli.main(["models", "turn", str(mine), "chair/a", "--degrees", "90"]) == 0
    assert capsys.readouterr().out == "chair/a: front -x, up +y in the axes of its file\n"
    for wrong, message in (
        (["synth", "--models", str(folder), "--preset", "eval", "--out", "x"], "or --models"),
        (["synth", "--models", str(folder), "--sequences", "2", "--out", "x"], "one sequence per model"),
        (["synth", "--category", "mouse", "--image-size", "64", "--out", "x"], "--image-size goes with --models"),
        (["synth", "--models", str(tmp_path / "nowhere"), "--out", "x"], "does not exist"),
        (["models", "turn", str(folder), "chair/none", "--degrees", "9"], "expected one of chair/high"),
    ):
        assert cli.main(wrong) == 2 and message in capsys.readouterr().err


@pytest.mark.slow
def test_the_code_of_the_page_on_own_models_runs(tmp_path, monkeypatch, capsys):
    page = (REPOSITORY / "docs" / "own_models.md").read_text()
    (dataset,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert len(dataset.strip().splitlines()) < 50
    monkeypatch.chdir(tmp_path)
    exec(dataset, names := {})
    assert names["dataset"].categories() == ["disc"] and "disc" in capsys.readouterr().out
    first, second = (names["dataset"].point_cloud("disc", name)[0] for name in ("first", "second"))
    label = read_labels(tmp_path / "outputs" / "discs", "disc")["second"].trans
    assert first @ label[:3, :3].T + label[:3, 3] == pytest.approx(second, abs=1e-4)
