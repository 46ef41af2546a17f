"""One writer per folder, and no leftovers of killed processes."""

import subprocess
import sys

import numpy as np
import pytest
from co3d_folders import sequence_data

from zsp_lite.alignment import ransac, umeyama
from zsp_lite.data.co3d import Co3D, write_co3d
from zsp_lite.errors import InputError, real_array
from zsp_lite.features import FeatureMap
from zsp_lite.io.files import write_atomic
from zsp_lite.io.locks import LOCK, writing

_HOLD = "import sys; from zsp_lite.io.locks import writing\nwith writing(sys.argv[1]): print(1, flush=True); input()"
_STOP = (
    "import os, sys; os.replace = lambda *_: (print(1, flush=True), input())\n"
    "from zsp_lite.io.files import write_atomic; write_atomic(sys.argv[1], b'old')"
)


def _started(code, path) -> subprocess.Popen:
    """Start Python code and wait for its first line."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen([sys.executable, "-c", code, str(path)], **pipes)
    assert process.stdout.readline()
    return process


def test_a_category_has_one_writer_until_that_is_killed(tmp_path):
    writer = _started(_HOLD, tmp_path / "cup")
    with pytest.raises(InputError, match="cup: another process is writing to it"):
        write_co3d(tmp_path, "cup", [sequence_data("a", 2)])
    writer.kill()
    writer.wait()
    write_co3d(tmp_path, "cup", [sequence_data("a", 2)])
    assert len(Co3D(tmp_path).frames("cup", "a")) == 2
    assert not list((tmp_path / "cup").glob(".*"))


@pytest.mark.parametrize(
    "command", [["synth", "--category", "chair", "--out"], ["train", "--objects", "1", "--out"]], ids=lambda one: one[0]
)
def test_a_command_that_writes_a_folder_is_refused_beside_another_writer(tmp_path, capsys, command):
    from zsp_lite.cli.main import main

    with writing(tmp_path / "out"):
        assert main([*command, str(tmp_path / "out")]) == 2
    assert "another process is writing to it" in capsys.readouterr().err


def test_a_folder_in_which_nothing_was_written_is_removed(tmp_path):
    with writing(tmp_path / "new"):
        pass
    assert not (tmp_path / "new").exists()
    with pytest.raises(InputError, match="folder .*file/new is a file or lies in one, expected a folder"):
        (tmp_path / "file").touch()
        with writing(tmp_path / "file/new"):
            pass


def test_a_folder_is_free_after_an_error(tmp_path):
    with pytest.raises(ZeroDivisionError), writing(tmp_path):
        raise ZeroDivisionError
    with writing(tmp_path), pytest.raises(InputError, match="another process"), writing(tmp_path):
        pass


def test_a_lock_whose_file_was_removed_before_it_was_locked_does_not_count(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl", reason="Windows does not remove an open file")
    lock = fcntl.flock

    def remove_first(*options):  # as another writer that ends between the opening and the locking of the file
        (tmp_path / LOCK).unlink()
        monkeypatch.setattr(fcntl, "flock", lock)
        return lock(*options)

    monkeypatch.setattr(fcntl, "flock", remove_first)
    with pytest.raises(InputError, match="another process"), writing(tmp_path):
        pass
    with writing(tmp_path), pytest.raises(InputError, match="another process"), writing(tmp_path):
        pass


@pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")
def test_the_next_write_removes_the_temporary_files_of_killed_processes_only(tmp_path):
    killed, waiting = (_started(_STOP, tmp_path / name) for name in ("killed.txt", "waiting.txt"))
    assert len(list(tmp_path.glob(".*.tmp"))) == 2
    killed.kill()
    killed.wait()
    write_atomic(tmp_path / "killed.txt", b"new")
    assert [path.name[:12] for path in tmp_path.glob(".*")] == [".waiting.txt"]
    waiting.kill()
    waiting.wait()


@pytest.mark.parametrize("values", [np.ones(3) * 1j, np.array(["1"]), "1", None, [[1], [1, 2]], [{}], {1}])
def test_what_is_not_an_array_of_real_numbers_is_refused(values):
    with pytest.raises(InputError, match="points is .*, expected real numbers"):
        real_array("points", values)


def test_points_that_overflow_when_squared_are_refused():
    points = np.random.default_rng(0).normal(size=(9, 3))
    for fit in (umeyama, ransac):
        with pytest.raises(InputError, match=r"source holds .*e\+155"):
            fit(1e155 * points, points)


def test_a_backbone_that_answers_nan_in_its_global_feature_is_refused():
    import torch

    with pytest.raises(InputError, match="global feature, positions or photo hold values that are not finite"):
        FeatureMap(torch.ones(2, 2, 3), torch.ones(2, 2), torch.tensor([1.0, torch.nan]))
