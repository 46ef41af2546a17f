"""The commands for data: their output, the files they write, and one line for bad input."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from co3d_folders import convert_to_v2, sequence_data
from test_importers import hairdryer_views, write_lists

from zsp_lite.cli.main import main
from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Co3D, write_co3d
from zsp_lite.data.frames import Frame, write_mask
from zsp_lite.data.labels import PoseLabel, read_labels, write_label
from zsp_lite.importers import READERS
from zsp_lite.importers.convert import ImportResult


@pytest.fixture
def root(tmp_path):
    write_co3d(tmp_path / "data", "chair", [sequence_data("a"), sequence_data("b")])
    return tmp_path / "data"


def test_labels_are_imported_and_transferred(root, tmp_path, capsys):
    for name in "ab":
        write_label(tmp_path / "clone/data", "chair", PoseLabel(np.eye(4), name, "a"))
    assert main(["data", "labels", str(tmp_path / "clone"), "--root", str(root)]) == 0
    assert "2 labels, 0 files of pairs" in capsys.readouterr().out
    shutil.copytree(root / "chair", tmp_path / "v2/chair")
    convert_to_v2(tmp_path / "v2/chair")
    write_label(tmp_path / "v2", "chair", PoseLabel(np.diag([-1.0, -1, 1, 1]), "b", "a"))
    transfer = ["data", "transfer", str(root), str(tmp_path / "v2"), "chair"]
    assert main(transfer) == 2 and "expected --replace" in capsys.readouterr().err
    assert main([*transfer, "--replace"]) == 0
    assert "camera centres differ by 0.00 %" in capsys.readouterr().out
    assert list(read_labels(tmp_path / "v2", "chair")) == ["a", "b"]


def test_a_capture_is_imported(tmp_path, capsys):
    source = tmp_path / "scan"
    source.mkdir()
    frames = hairdryer_views()
    for frame in frames:
        write_mask(tmp_path / f"masks/{frame.name}.png", frame.mask)
    write_lists(source, frames)
    arguments = ["data", "import", "lists", str(source), "--root", str(tmp_path / "mine"), "--category", "teapot"]
    assert main([*arguments, "--sequence", "one", "--masks", str(tmp_path / "masks")]) == 0
    assert "8 frames" in capsys.readouterr().out
    assert len(Co3D(tmp_path / "mine").frames("teapot", "one")) == 8


def test_options_of_the_import_reach_the_library(monkeypatch, capsys):
    given = []

    def import_capture(*arguments):
        given.append(arguments)
        return ImportResult(1, 0, 1, 1.0, ("the masks may be wrong: why",))

    for layout in READERS:
        monkeypatch.setitem(READERS, layout, lambda folder, **options: (folder, options))
    monkeypatch.setattr("zsp_lite.importers.import_capture", import_capture)
    words = "--root mine --category cup --sequence one --frames 7".split()
    assert main(["data", "import", "nerfstudio", "scan", *words, "--box", "1,2,3,4"]) == 0
    assert given.pop() == ((Path("scan"), {}), Path("mine"), "cup", "one", (1, 2, 3, 4), None, 7)
    assert "flag: the masks may be wrong: why\n" in capsys.readouterr().out
    assert main(["data", "import", "lists", "scan", *words, "--depth-unit", "0.5", "--masks", "there"]) == 0
    capture = (Path("scan"), {"depth_unit": 0.5})
    assert given.pop() == (capture, Path("mine"), "cup", "one", None, Path("there"), 7)


def test_errors_of_the_import_name_the_option_that_cures(tmp_path, capsys):
    folder = tmp_path / "scan"
    camera = Camera(np.eye(3), np.zeros(3), np.full(2, 30.0), np.array([16.0, 12.0]), (24, 32))
    write_lists(folder, [Frame(np.zeros((24, 32, 3), np.uint8), np.ones((24, 32), np.float32), None, camera, "0")])
    words = ["data", "import", "lists", str(folder), "--root", str(tmp_path / "mine"), "--category", "cup"]
    assert main([*words, "--sequence", "one"]) == 2
    error = capsys.readouterr().err
    assert "(--box TOP,LEFT,HEIGHT,WIDTH)" in error and "(--masks DIR)" in error
    assert not (tmp_path / "mine").exists()
