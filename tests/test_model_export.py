"""A folder of models becomes a data folder with exact labels."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from co3d_folders import sequence_data
from model_files import write_quad, write_wedge
from numpy.testing import assert_allclose
from refusals import refused

from zsp_lite import Co3D
from zsp_lite.course.synthetic import export
from zsp_lite.course.synthetic.export import RENDERED_FILE, export_models
from zsp_lite.course.true_matches import ground_truth_pair
from zsp_lite.data.ground_truth import object_poses
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import shipped_pairs
from zsp_lite.io.files import REPOSITORY

SETTINGS = {"frames": 5, "seed": 3, "image_size": 64}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two chairs, one of which lies on its back in its file, and a sign whose texture is
    missing."""
    root = tmp_path_factory.mktemp("models")
    write_wedge(root / "chair/high.obj", seat=0.9)
    path = write_wedge(root / "chair/low.obj", seat=0.4)
    lying = re.sub(r"v (\S+) (\S+) (\S+)", lay_down, path.read_text())
    path.write_text(lying)
    info = {"front": "-y", "up": "+z", "author": "Ann", "licence": "CC0-1.0"}
    (root / "models.json").write_text(json.dumps({"chair/low": info}))
    write_quad(root / "sign/stop.obj", np.full((4, 4, 3), 200, np.uint8))
    (root / "sign/stop.png").unlink()
    return root


def lay_down(vertex: re.Match) -> str:
    """The line of a vertex, turned by a quarter about the x axis."""
    x, y, z = map(float, vertex.groups())
    return f"v {x} {-z} {y}"


@pytest.fixture(scope="module")
def data(folder, tmp_path_factory):
    """The data folder of the models, and the reasons of those that were left out."""
    out = tmp_path_factory.mktemp("data")
    left_out = export_models(folder, out, **SETTINGS)
    return Co3D(out), left_out


def test_the_data_folder_has_a_sequence_per_usable_model_and_names_the_others(data):
    dataset, left_out = data
    assert dataset.categories() == ["chair"]
    assert [sequence.sequence_name for sequence in dataset.sequences("chair")] == ["high", "low"]
    assert list(left_out) == ["sign/stop"]
    assert "lacks its texture 'stop.png'" in left_out["sign/stop"]


def test_a_rendered_sequence_names_its_author_and_licence(data):
    content = json.loads((data[0].root / RENDERED_FILE).read_text())
    record = content["sequences"]["chair"]["low"]
    expected = {"author": "Ann", "licence": "CC0-1.0", "file": "chair/low.obj"}
    assert expected.items() <= record.items()


@pytest.mark.parametrize("name", ["high", "low"])
def test_labels_map_the_front_of_the_reference_to_the_front_of_every_object(data, name):
    dataset, _ = data
    poses = object_poses(dataset, "chair")
    label, reference = read_labels(dataset.root, "chair")[name].trans, poses["high"]
    assert_allclose(label[:3, :3] @ reference.R, poses[name].R, atol=1e-6)
    middle = label[:3, :3] @ reference.t + label[:3, 3]
    assert_allclose(middle, poses[name].t, atol=1e-6)
    inside = poses[name].to_box(dataset.point_cloud("chair", name)[0])
    # The box holds the cloud but for noise and a few outliers.
    assert np.quantile(inside, 0.01) > -0.1
    assert np.quantile(inside, 0.99) < 1.1


def test_the_data_folder_has_evaluation_pairs_with_true_matches(data):
    dataset, _ = data
    pairs = shipped_pairs(dataset, "chair", 3)
    # As many as an export writes for each category of models.
    assert len(pairs) == len(shipped_pairs(dataset, "chair", 1)) == 20
    assert ground_truth_pair(dataset, pairs[0]).valid.sum() > 20


def test_complete_sequences_stay_and_turned_models_are_rendered_again(
    data, folder, tmp_path, monkeypatch
):
    record = Mock(wraps=export.record_sequence)
    monkeypatch.setattr(export, "record_sequence", record)
    out = tmp_path / "data"
    shutil.copytree(data[0].root, out)
    before = read_labels(out, "chair")["low"].trans
    export_models(folder, out, **SETTINGS)
    assert not record.called
    # Of `high` alone: models.json orients the other one.
    export_models(folder, out, **SETTINGS, front="+x")
    assert [call.args[1] for call in record.call_args_list] == ["high"]
    assert not np.allclose(read_labels(out, "chair")["low"].trans, before)
    refused("was written with", export_models, folder, out, **{**SETTINGS, "seed": 4})


def test_a_folder_of_other_data_or_without_a_usable_model_is_refused(data, folder, tmp_path):
    write_quad(tmp_path / "models/sign/stop.obj", opacity=0)
    message = "no usable model; sign/stop: .* no visible face"
    refused(message, export_models, tmp_path / "models", tmp_path / "out")
    shutil.copytree(data[0].root, tmp_path / "other")
    (tmp_path / "other" / RENDERED_FILE).unlink()
    refused("holds other data", export_models, folder, tmp_path / "other")


def test_the_command_line_renders_models_and_names_those_left_out(folder, tmp_path, run):
    out, mine = tmp_path / "data", tmp_path / "mine"
    write_wedge(mine / "chair/a.obj")
    shutil.copytree(folder / "sign", mine / "sign")
    options = "--frames 1 --image-size 48 --front -x --up +z"
    assert "Left out sign/stop" in run(f"synth --models {mine} {options} --out {out}")
    rotation = json.loads((out / RENDERED_FILE).read_text())["sequences"]["chair"]["a"]["rotation"]
    assert rotation == [-1, 0, 0, 0, -1, 0, 0, 0, 1]


def test_the_code_of_the_page_on_own_models_writes_labels_that_align_the_objects(tmp_path):
    page = (REPOSITORY / "docs/own_models.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names = {}
    exec(code, names)
    elsewhere = np.eye(4)  # a quarter turn and a shift
    elsewhere[:3] = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]]
    whole = sequence_data("first")
    recordings = []
    for name, pose in (("first", np.eye(4)), ("second", elsewhere)):
        points = whole.points @ pose[:3, :3].T + pose[:3, 3]
        recordings.append((replace(whole, name=name, points=points), pose))
    names["write_category"](tmp_path, "box", recordings)
    first, second = [Co3D(tmp_path).point_cloud("box", name)[0] for name in ("first", "second")]
    label = read_labels(tmp_path, "box")["second"].trans
    assert_allclose(first @ label[:3, :3].T + label[:3, 3], second, atol=1e-4)
