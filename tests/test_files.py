"""Limits on files: what is no file, grows too much, is too large or damaged is refused before it is read."""

import gzip
import io
import os
import struct
import threading
import zipfile

import cv2
import numpy as np
import pytest
import torch
from co3d_folders import edit_json, random_camera, sequence_data

from zsp_lite.backbones.checkpoints import build_vit, read_checkpoint
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.data.annotations import read_frame_index
from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Co3D, write_co3d
from zsp_lite.data.frames import Frame, read_image, resize_frame
from zsp_lite.data.labels import PoseLabel, read_labels, write_label
from zsp_lite.data.pairs import read_upstream_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.files import decompress, growth_limit, read_arrays, read_bytes
from zsp_lite.io.ply import read_ply, write_ply
from zsp_lite.io.tensors import load_torch

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


def test_the_limit_on_pixels_holds_for_resizing(monkeypatch):
    monkeypatch.setenv("ZSP_LITE_MAX_PIXELS", "99")
    whole = Frame(np.zeros((8, 8, 3), np.uint8), None, None, random_camera(0, (8, 8)))
    assert resize_frame(whole, (9, 11)).camera.size == (9, 11)
    with pytest.raises(InputError, match=r"\(10, 10\), expected at most 99 pixels"):
        resize_frame(whole, (10, 10))


@pytest.mark.parametrize("text", ["abc", "0", "-1", "1.5", " ", "\u0663", "9" * 5000])
def test_a_limit_on_pixels_that_is_no_positive_whole_number_is_refused(tmp_path, monkeypatch, text):
    (tmp_path / "x.png").write_bytes(cv2.imencode(".png", PICTURE)[1].tobytes())
    monkeypatch.setenv("ZSP_LITE_MAX_PIXELS", text)
    with pytest.raises(InputError, match="ZSP_LITE_MAX_PIXELS is .*, expected a positive whole number"):
        read_image(tmp_path / "x.png")


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


def _saved(content) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


def test_a_tensor_with_more_values_than_its_file_stores_is_refused():
    stored = torch.arange(6.0).reshape(2, 3)
    assert torch.equal(load_torch(_saved({"a": [stored.T]}), "file")["a"][0], stored.T)
    with pytest.raises(InputError, match=r"file: tensor of shape \(10000000000,\) is not dense"):
        load_torch(_saved([{"a": (torch.zeros(1).expand(10**10),)}]), "file")


def test_a_compressed_torch_file_is_refused(tmp_path):
    with (
        zipfile.ZipFile(io.BytesIO(_saved({"a": torch.zeros(9)}))) as old,
        zipfile.ZipFile(tmp_path / "x.pth", "w", zipfile.ZIP_DEFLATED) as new,
    ):
        for name in old.namelist():
            new.writestr(name, old.read(name))
    with pytest.raises(InputError, match="checkpoint .*x.pth: damaged, .*compressed entries"):
        read_checkpoint(tmp_path / "x.pth")


def test_blocks_that_are_not_numbered_from_zero_are_refused_before_a_network_is_built():
    weights = VisionTransformer(16, 8, 64, 1, 1).state_dict()
    with pytest.raises(InputError, match="2 blocks, not numbered from 0 to 1"):
        build_vit(weights | {"blocks.100000000.norm1.weight": torch.zeros(64)})


def test_a_long_message_keeps_its_beginning_and_end():
    message = str(InputError("begin" + "x" * 100_000 + "end"))
    assert len(message) < 1000 and message.startswith("begin") and message.endswith("end")


@pytest.mark.parametrize("name, value", [("T", 1e155), ("focal_length", 1e-300), ("principal_point", 1e300)])
def test_a_camera_of_absurd_magnitude_is_refused(name, value):
    values = {"R": np.eye(3), "T": np.zeros(3), "focal_length": np.ones(2), "principal_point": np.zeros(2)}
    with pytest.raises(InputError, match=f"{name} .*expected"):
        Camera.from_pytorch3d(**values | {name: np.full(values[name].shape, value)}, size=(20, 20))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"target_seq_name": "a"}, "'a' is compared with itself"),
        ({"all_target_id": [3, 4]}, "2 targets, expected 1 as in the name of its folder"),
        ({"reference_frame_id": True}, "frame id is True"),
    ],
)
def test_a_pair_that_cannot_be_evaluated_as_its_set_says_is_refused(tmp_path, change, message):
    write_co3d(tmp_path, "cup", [sequence_data("a", 3), sequence_data("b", 3)])
    pair = {"class": "cup", "reference_seq_name": "a", "reference_frame_id": 0, "target_seq_name": "b",
            "all_target_id": [3]}  # fmt: skip
    path = tmp_path / "determ_eval/1samples_1tgt/cup.pt"
    path.parent.mkdir(parents=True)
    path.write_bytes(_saved([pair]))
    assert read_upstream_pairs(path, Co3D(tmp_path))[0].target_frames == (0,)
    path.write_bytes(_saved([pair | change]))
    with pytest.raises(InputError, match=message):
        read_upstream_pairs(path, Co3D(tmp_path))


def test_a_link_to_itself_is_refused(tmp_path):
    write_co3d(tmp_path, "cup", [sequence_data("a", 1)])
    (tmp_path / "x.pt").symlink_to(tmp_path / "x.pt")
    with pytest.raises(InputError, match="evaluation pairs .*x.pt cannot be read"):
        read_upstream_pairs(tmp_path / "x.pt", Co3D(tmp_path))


@pytest.mark.parametrize("name", ["x.pth", "x.safetensors"])
def test_a_file_of_weights_above_four_gigabytes_is_refused_before_it_is_read(tmp_path, name):
    with open(tmp_path / name, "wb") as file:
        file.truncate(5 << 30)
    with pytest.raises(InputError, match=f"checkpoint .*{name} is {5 << 30} bytes long, expected at most {4 << 30}"):
        read_checkpoint(tmp_path / name)


def test_labels_with_two_references_are_refused(tmp_path):
    for name in "ab":
        write_label(tmp_path, "cup", PoseLabel(np.eye(4), name, name))
    with pytest.raises(InputError, match="have references a, b, expected one"):
        read_labels(tmp_path, "cup")
