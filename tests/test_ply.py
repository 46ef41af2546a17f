"""Point clouds in PLY files: every encoding and colour type is read."""

import numpy as np
import pytest

from zsp_lite.errors import InputError
from zsp_lite.io.ply import read_ply, write_ply

POINTS = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
COLOURS = np.random.default_rng(1).integers(0, 256, (5, 3)).astype(np.uint8)
COLOURS[0] = 0, 128, 255


def ply(encoding="binary_little_endian", colours=None, kind="uchar", comment="made here"):
    """A PLY file of `POINTS`, and of `colours` stored as the PLY type `kind`."""
    order = ">" if encoding == "binary_big_endian" else "<"
    code = {"uchar": "u1", "int": "i4", "ushort": "u2", "float": "f4", "double": "f8"}[kind]
    columns = [(name, f"{order}f4") for name in "xyz"]
    columns += [(name, order + code) for name in ("red", "green", "blue") if colours is not None]
    table = np.zeros(len(POINTS), columns)
    values = POINTS if colours is None else np.concatenate([POINTS.astype(np.float64), colours], axis=1)
    for (name, _), column in zip(columns, values.T, strict=True):
        table[name] = column
    header = f"ply\nformat {encoding} 1.0\ncomment {comment}\nelement vertex {len(table)}\n"
    header += "".join(f"property {'float' if name in 'xyz' else kind} {name}\n" for name, _ in columns)
    header += "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    text = "\n".join(" ".join(map(repr, row)) for row in table.tolist())
    return header.encode() + (text.encode() if encoding == "ascii" else table.tobytes())


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cloud.ply"


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_positions_are_read_in_every_encoding(path, encoding):
    path.write_bytes(ply(encoding))
    points, colours = read_ply(path)
    np.testing.assert_array_equal(points, POINTS)
    assert points.dtype == np.float64 and colours is None


@pytest.mark.parametrize("encoding", ["binary_little_endian", "ascii"])
@pytest.mark.parametrize(
    ("kind", "scale"),
    [("uchar", 1), ("int", 1), ("ushort", 257), ("float", 1 / 255), ("float", 1), ("double", 1 / 255), ("double", 1)],
)
def test_colours_of_every_type_and_range_are_read_as_8_bit(path, encoding, kind, scale):
    path.write_bytes(ply(encoding, COLOURS * np.float64(scale), kind))
    colours = read_ply(path)[1]
    assert colours.dtype == np.uint8
    np.testing.assert_array_equal(colours, COLOURS)


def test_written_data_is_read_back(path):
    write_ply(path, POINTS, COLOURS, POINTS)
    np.testing.assert_array_equal(read_ply(path)[0], POINTS)
    np.testing.assert_array_equal(read_ply(path)[1], COLOURS)


def test_missing_files_and_positions_that_are_not_finite_are_refused(path):
    with pytest.raises(InputError, match="cannot be read"):
        read_ply(path)
    with pytest.raises(InputError, match="expected finite"):
        write_ply(path, np.full((5, 3), np.nan), COLOURS)
    write_ply(path, np.full((5, 3), 7.0), COLOURS)
    path.write_bytes(path.read_bytes().replace(np.float32(7).tobytes(), np.float32(np.nan).tobytes()))
    with pytest.raises(InputError, match="expected finite"):
        read_ply(path)
