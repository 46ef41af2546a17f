"""Files: limits, one table of bad files, each refused by one line that names it, PLY files, one
writer per folder."""

import gzip
import io
import os
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from co3d_folders import write_category
from numpy.random import default_rng
from numpy.testing import assert_array_equal
from refusals import refused
from safetensors.torch import save

from zsp_lite import Co3D, InputError
from zsp_lite.backbones.checkpoints import read_checkpoint
from zsp_lite.data import frames
from zsp_lite.data.annotations import read_frame_index
from zsp_lite.data.frames import read_depth, read_image, read_mask
from zsp_lite.data.pairs import read_pair_file
from zsp_lite.importers import recognise
from zsp_lite.importers.files import read_depth_file, read_picture
from zsp_lite.io.files import GROWTH_ALLOWED, path_inside, plain_name, read_bytes
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import read_ply, write_ply

PICTURE = cv2.resize(default_rng(0).integers(0, 255, (9, 16, 3), np.uint8), (160, 90))
PNG, WEBP = (cv2.imencode(extension, PICTURE)[1].tobytes() for extension in (".png", ".webp"))
INDEX = "frame_annotations.jgz"
FRAME = b'{"sequence_name": "a", "frame_number": 1}'
COLOUR_NAMES = ("red", "green", "blue")


class Code:
    """Pickled as a call that makes the file `executed`."""

    def __reduce__(self):
        return open, ("executed", "w")


def _saved(save, *content) -> bytes:
    """What a function of NumPy or PyTorch writes."""
    buffer = io.BytesIO()
    save(buffer, *content)
    return buffer.getvalue()


def _torch(content) -> bytes:
    """A file of PyTorch."""
    return _saved(lambda file: torch.save(content, file))


def _ply(count, body: bytes, encoding="binary_little_endian", kind="") -> bytes:
    """A PLY file of positions and, if a type is given, of colours."""
    columns = [f"property float {x}\n" for x in "xyz"] + [
        f"property {kind} {x}\n" for x in COLOUR_NAMES if kind
    ]
    return (
        f"ply\nformat {encoding} 1.0\nelement vertex {count}\n{''.join(columns)}end_header\n"
    ).encode() + body


# Name of a file, its reader, part of the message, and contents of the file by what is wrong.
BAD_FILES = [
    (
        "x.jpg",
        read_image,
        "cannot be decoded .*expected a complete .jpg file",
        {
            "empty": b"",
            "text": b"text",
            "PNG with a wrong checksum": PNG[:60] + b"\0\0\0\0" + PNG[64:],
        },
    ),
    ("mask.png", read_mask, "cannot be decoded", {"empty": b""}),
    ("scan.zip", recognise, "zip .* cannot be unpacked", {"damaged": b"PK" + bytes(99)}),
    ("depth.png", read_depth, "expected a 16-bit greyscale PNG", {"8 bits": PNG}),
    (
        "a.heic",
        read_picture,
        "cannot be decoded .* expected the photograph as JPEG",
        {"": bytes(99)},
    ),
    ("a.webp", read_picture, "cannot be decoded", {"cut": WEBP[:-40]}),
    (
        "d.npy",
        read_depth_file,
        r"holds .*, expected numbers \(H, W\)",
        {
            "text": _saved(np.save, ["x"]),
            "colours": _saved(np.save, np.ones((4, 4, 3))),
            "empty": _saved(np.save, np.ones((0, 4))),
        },
    ),
    ("d.npy", read_depth_file, "cannot be decoded", {"code": _saved(np.save, [Code()])}),
    ("d.npz", read_depth_file, "holds 2 arrays, expected one", {"two": _saved(np.savez, 1, 2)}),
    (
        "d.exr",
        read_depth_file,
        "expected the depth as .npy or a float .tiff",
        {"": b"v/1\x01" + bytes(99)},
    ),
    (INDEX, read_frame_index, "Input data was truncated", {"empty": b""}),
    (
        INDEX,
        read_frame_index,
        "no gzip data that can be read",
        {"cut": gzip.compress(bytes(99))[:-6], "bytes behind": gzip.compress(b"[]") + b"x"},
    ),
    (
        INDEX,
        read_frame_index,
        "grow to more",
        {"bomb": gzip.compress(bytes(GROWTH_ALLOWED + 1), 1)},
    ),
    (INDEX, read_frame_index, "JSON is malformed", {"no JSON": gzip.compress(b"[{]")}),
    (INDEX, read_frame_index, "annotations", {"nested": gzip.compress(b"[" * 100_000)}),
    (INDEX, read_frame_index, "Expected `object`", {"numbers": gzip.compress(b"[1, 2]")}),
    (
        INDEX,
        read_frame_index,
        "entries 0 and 1 are both frame 1 of a",
        {"a frame twice": gzip.compress(b"[" + FRAME + b"," + FRAME + b"]")},
    ),
    (
        "x.ply",
        read_ply,
        "is not a complete PLY file",
        {
            "empty": b"",
            "cut": _ply(3, bytes(35)),
            "too long": _ply(3, bytes(37)),
            "10^12 points": _ply(10**12, bytes(36)),
            "no points": _ply(0, b""),
        },
    ),
    (
        "x.ply",
        read_ply,
        "expected finite numbers",
        {"not finite": _ply(1, np.float32([0, np.nan, 0]).tobytes())},
    ),
    (
        "x.pth",
        read_checkpoint,
        "damaged, or contains more than tensors",
        {"cut": _torch({"a": torch.zeros(99)})[:-200], "code": _torch({"a": Code()})},
    ),
    ("x.pth", read_checkpoint, "expected a state dict of tensors", {"a number": _torch(5)}),
    (
        "x.safetensors",
        read_checkpoint,
        "damaged, or contains",
        {
            "cut": save({"a": torch.zeros(9)})[:-1],
            "giant header": struct.pack("<Q", 2**63) + b"{}",
        },
    ),
    ("cup.pt", read_pair_file, "contains more than tensors", {"code": _torch([Code()])}),
    ("cup.pt", read_pair_file, "Expected `array`, got `object`", {"a dictionary": _torch({})}),
    ("cup.pt", read_pair_file, "missing required field `class` - at", {"other": _torch([{}])}),
]


@pytest.mark.parametrize(
    "name, read, message, data",
    [
        pytest.param(*row, data, id=f"{row[0]} {damage}")
        for *row, contents in BAD_FILES
        for damage, data in contents.items()
    ],
)
def test_a_bad_file_is_refused_in_one_line_that_names_it(
    tmp_path, monkeypatch, name, read, message, data
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_bytes(data)
    assert name in refused(message, read, tmp_path / name)
    assert not (tmp_path / "executed").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes in folders")
@pytest.mark.parametrize(
    "read", [read_image, read_depth, read_ply, read_checkpoint, read_frame_index]
)
def test_what_is_no_file_is_refused_without_being_opened(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "cycle").symlink_to(tmp_path / "cycle")
    for name, reason in (
        ("pipe", "a pipe or a device"),
        (".", "is a directory"),
        ("gone", "no such"),
        ("cycle", ""),
    ):
        refused(f"cannot be read: {reason}", read, tmp_path / name)


def test_a_path_with_a_null_byte_is_refused_in_one_printable_line():
    refused(
        r"image 'a\\x00b'\.\.\. cannot be read: .*embedded null [^\n]+$",
        read_bytes,
        "a\0b",
        "image",
    )


@pytest.mark.parametrize("path", ["../x", "/etc/passwd", "a\0b", "x" * 5000, "link/x"])
def test_paths_out_of_a_folder_are_refused(tmp_path, path, links):
    (tmp_path / "link").symlink_to("/etc")
    refused("path .* (leads out of the data folder|is invalid)", path_inside, tmp_path, path)


@pytest.mark.parametrize("name", ["", "..", ".x", "a/b", "a\\b", "C:", "a\0", "x" * 256])
def test_names_that_are_no_plain_names_are_refused(name):
    refused("category name", plain_name, name, "category")


@pytest.mark.parametrize(
    "name, read",
    [("x", read_image), ("x.pth", read_checkpoint), ("x.safetensors", read_checkpoint)],
)
def test_a_file_above_the_limit_is_refused_before_it_is_read(tmp_path, name, read):
    with open(tmp_path / name, "wb") as file:
        file.truncate(5 << 30)
    refused(f"{name} cannot be read: {5 << 30} bytes, expected at most", read, tmp_path / name)


def test_the_limit_on_pixels_is_compared_with_the_header(tmp_path, monkeypatch):
    path = tmp_path / "x"
    path.write_bytes(PNG)
    monkeypatch.setattr(frames, "MAX_PIXELS", 14_399)
    refused("90 x 160 pixels.* of at most 14399 pixels", read_image, path)
    monkeypatch.setattr(frames, "MAX_PIXELS", 14_400)
    assert read_image(path).shape == (90, 160, 3)


def test_a_photograph_in_webp_is_read(tmp_path):
    (tmp_path / "a.webp").write_bytes(WEBP)
    colours, orientation = read_picture(tmp_path / "a.webp")
    assert (colours.shape, orientation) == ((90, 160, 3), 1)


def test_a_long_message_keeps_its_beginning_and_end():
    message = str(InputError("begin" + "x" * 100_000 + "end"))
    assert len(message) < 1000
    assert message.startswith("begin")
    assert message.endswith("end")


POINTS = default_rng(0).normal(size=(5, 3)).astype(np.float32)
COLOURS = default_rng(1).integers(0, 256, (5, 3)).astype(np.uint8)
COLOURS[0] = 0, 128, 255  # with both ends of the range, by which it is recognised


@pytest.fixture
def path(tmp_path):
    """Where a test writes its PLY file."""
    return tmp_path / "cloud.ply"


TEXT = "\n".join(" ".join(map(repr, row)) for row in POINTS.tolist()).encode()
ENCODED = {
    "ascii": TEXT,
    "binary_little_endian": POINTS.tobytes(),
    "binary_big_endian": POINTS.astype(">f4").tobytes(),
}


@pytest.mark.parametrize("encoding", ENCODED)
def test_positions_are_read_in_every_encoding(path, encoding):
    path.write_bytes(_ply(len(POINTS), ENCODED[encoding], encoding))
    points, colours = read_ply(path)
    assert_array_equal(points, POINTS)
    assert points.dtype == np.float64
    assert colours is None


@pytest.mark.parametrize(
    "kind, code, scale",
    [
        ("uchar", "u1", 1),
        ("int", "i4", 1),
        ("ushort", "u2", 257),
        ("float", "f4", 1),
        ("float", "f4", 1 / 255),
        ("double", "f8", 1 / 255),
    ],
)
def test_colours_of_8_or_16_bits_to_255_or_to_1_are_read_as_8_bit(path, kind, code, scale):
    table = np.zeros(len(POINTS), [("position", "<f4", 3), ("colour", f"<{code}", 3)])
    table["position"] = POINTS
    table["colour"] = COLOURS * np.float64(scale)
    path.write_bytes(_ply(len(POINTS), table.tobytes(), kind=kind))
    colours = read_ply(path)[1]
    assert colours.dtype == np.uint8
    assert_array_equal(colours, COLOURS)


def test_faces_behind_the_vertices_of_a_mesh_are_left_out(path):
    faces = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    data = _ply(len(POINTS), POINTS.tobytes() + b"\3" + bytes(12)).replace(
        b"end_header\n", faces, 1
    )
    path.write_bytes(data)
    assert_array_equal(read_ply(path)[0], POINTS)


def test_written_data_is_read_back(path):
    write_ply(path, POINTS, COLOURS, POINTS)
    assert_array_equal(read_ply(path)[0], POINTS)
    assert_array_equal(read_ply(path)[1], COLOURS)
    refused("expected finite", write_ply, path, np.full((5, 3), np.nan), COLOURS)


_HOLD = (
    "import sys; from zsp_lite.io.locks import writing\nwith writing(sys.argv[1]): print(1, "
    "flush=True); input()"
)


def test_a_category_has_one_writer_until_that_is_killed(tmp_path):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    writer = subprocess.Popen([sys.executable, "-c", _HOLD, str(tmp_path / "cup")], **pipes)
    assert writer.stdout.readline()
    refused(
        "cup: another process is writing to it",
        lambda: write_category(tmp_path, "cup", "a", frames=2),
    )
    writer.kill()
    writer.wait()
    write_category(tmp_path, "cup", "a", frames=2)
    assert len(Co3D(tmp_path).frames("cup", "a")) == 2
    assert not list((tmp_path / "cup").glob(".*"))


def test_a_folder_is_free_after_an_error_and_else_a_command_is_refused(tmp_path, run):
    with pytest.raises(ZeroDivisionError), writing(tmp_path / "out"):
        raise ZeroDivisionError
    with writing(tmp_path / "out"):
        error = run(f"synth --category chair --out {tmp_path}/out", 2)
    assert "another process is writing to it" in error
