"""Limits on files: what is no file, grows too much, is too large or damaged is refused before it is read."""

import gzip
import os
import struct
import threading
import zipfile

import cv2
import numpy as np
import pytest
from co3d_folders import edit_json, sequence_data

from zsp_lite.data.annotations import read_frame_index
from zsp_lite.data.co3d import write_co3d
from zsp_lite.data.frames import read_image
from zsp_lite.errors import InputError
from zsp_lite.io.files import decompress, growth_limit, read_arrays, read_bytes
from zsp_lite.io.ply import read_ply, write_ply

PICTURE = cv2.resize(np.random.default_rng(0).integers(0, 255, (9, 16, 3), np.uint8), (160, 90))


def test_a_pipe_is_refused_without_waiting_for_a_writer(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="image .*pipe cannot be read: a pipe or a device"):
        read_bytes(tmp_path / "pipe", "image")


def test_a_path_with_a_null_byte_is_refused_in_one_printable_line():
    with pytest.raises(InputError, match=r"image 'a\\x00b'\.\.\. cannot be read: embedded null byte"):
        read_bytes("a\0b", "image")


def test_a_file_above_a_gigabyte_is_refused(tmp_path):
    with open(tmp_path / "sparse", "wb") as file:
        file.truncate(2 << 30)
    with pytest.raises(InputError, match=f"sparse is {2 << 30} bytes long, expected at most {1 << 30}"):
        read_bytes(tmp_path / "sparse", "image")


@pytest.mark.parametrize("members", [1, 3])
def test_gzip_data_of_any_number_of_members_is_read_up_to_the_limit(members):
    content = os.urandom(1000)
    assert decompress(members * gzip.compress(content), "data") == members * content
    bomb = members * gzip.compress(bytes(growth_limit(0) // members + 1), 1)
    assert len(bomb) < growth_limit(0) / 32
    with pytest.raises(InputError, match="data grow from .* bytes, expected less"):
        decompress(bomb, "data")


def test_an_array_is_refused_before_it_is_allocated_if_its_shape_does_not_fit_its_file(tmp_path):
    header = str({"descr": "<f8", "fortran_order": False, "shape": (10**15,)}).ljust(117).encode() + b"\n"
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + bytes(8))
    with pytest.raises(InputError, match=r"x.npz cannot be read: .*float64 of shape \(1000000000000000,\) in 8 bytes"):
        read_arrays(tmp_path / "x.npz", ("a",), "arrays")


def test_a_jpeg_that_the_decoder_patches_up_is_refused_and_nothing_is_printed(tmp_path, capfd):
    data = cv2.imencode(".jpg", PICTURE)[1].tobytes()
    (tmp_path / "whole.jpg").write_bytes(data)
    assert read_image(tmp_path / "whole.jpg").shape == PICTURE.shape
    (tmp_path / "x.jpg").write_bytes(data[: len(data) // 2] + b"\xff\xd9")
    with pytest.raises(InputError, match=r"x.jpg cannot be decoded .*Corrupt JPEG data: premature end"):
        read_image(tmp_path / "x.jpg")
    assert capfd.readouterr().err == ""
    os.write(2, b"still there")
    assert capfd.readouterr().err == "still there"


def test_pictures_are_decoded_by_several_threads_at_once(tmp_path):
    (tmp_path / "x.jpg").write_bytes(cv2.imencode(".jpg", PICTURE)[1].tobytes())
    found = []
    threads = [threading.Thread(target=lambda: found.append(read_image(tmp_path / "x.jpg"))) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8 and all((image == found[0]).all() for image in found)


@pytest.mark.parametrize("extension", [".jpg", ".png"])
def test_the_limit_on_pixels_is_compared_with_the_header(tmp_path, monkeypatch, extension):
    path = tmp_path / f"x{extension}"
    path.write_bytes(cv2.imencode(extension, PICTURE)[1].tobytes())
    monkeypatch.setenv("ZSP_LITE_MAX_PIXELS", "14399")
    with pytest.raises(InputError, match="90 x 160 pixels, expected 1 to 14399 pixels"):
        read_image(path)
    monkeypatch.setenv("ZSP_LITE_MAX_PIXELS", "14400")
    assert read_image(path).shape == (90, 160, 3)


def test_a_frame_listed_twice_is_refused(tmp_path):
    write_co3d(tmp_path, "cup", [sequence_data("a", 3)])
    path = tmp_path / "cup" / "frame_annotations.jgz"
    edit_json(path, lambda content: [*content, content[1]])
    with pytest.raises(InputError, match="entries 1 and 3 are both frame 1 of a"):
        read_frame_index(path)


@pytest.mark.parametrize("count", [b"-1", b"99999999999", b"1.5"])
def test_a_point_cloud_with_another_number_of_points_in_its_header_is_refused(tmp_path, count):
    write_ply(tmp_path / "x.ply", np.ones((3, 3)), np.zeros((3, 3), np.uint8))
    data = (tmp_path / "x.ply").read_bytes()
    (tmp_path / "x.ply").write_bytes(data.replace(b"vertex 3", b"vertex " + count))
    with pytest.raises(InputError, match="not a complete PLY file"):
        read_ply(tmp_path / "x.ply")


def test_coordinates_that_overflow_when_squared_are_refused(tmp_path):
    text = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property double {x}\n" for x in "xyz")
    (tmp_path / "x.ply").write_text(text + "end_header\n1e155 0 0\n")
    with pytest.raises(InputError, match=r"holds 1e\+155, expected finite numbers of at most 1e\+09"):
        read_ply(tmp_path / "x.ply")
