"""One writer per folder, as long as its process lives."""

import subprocess
import sys

import pytest
from co3d_folders import sequence_data

from zsp_lite.cli.main import main
from zsp_lite.data.co3d import Co3D, write_co3d
from zsp_lite.errors import InputError
from zsp_lite.io.locks import writing

_HOLD = "import sys; from zsp_lite.io.locks import writing\nwith writing(sys.argv[1]): print(1, flush=True); input()"


def test_a_category_has_one_writer_until_that_is_killed(tmp_path):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    writer = subprocess.Popen([sys.executable, "-c", _HOLD, str(tmp_path / "cup")], **pipes)
    assert writer.stdout.readline()
    with pytest.raises(InputError, match="cup: another process is writing to it"):
        write_co3d(tmp_path, "cup", [sequence_data("a", 2)])
    writer.kill()
    writer.wait()
    write_co3d(tmp_path, "cup", [sequence_data("a", 2)])
    assert len(Co3D(tmp_path).frames("cup", "a")) == 2
    assert not list((tmp_path / "cup").glob(".*"))


def test_a_command_that_writes_a_folder_is_refused_beside_another_writer(tmp_path, capsys):
    with writing(tmp_path / "out"):
        assert main(["synth", "--category", "chair", "--out", str(tmp_path / "out")]) == 2
    assert "another process is writing to it" in capsys.readouterr().err


def test_a_folder_is_free_after_an_error(tmp_path):
    with pytest.raises(ZeroDivisionError), writing(tmp_path):
        raise ZeroDivisionError
    with writing(tmp_path), pytest.raises(InputError, match="another process"), writing(tmp_path):
        pass


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="folder .*file/new cannot be made: not a directory, expected a folder"):
        with writing(tmp_path / "file/new"):
            pass
