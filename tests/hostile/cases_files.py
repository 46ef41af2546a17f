"""Files that are not what their names say, or that grow on reading: images, gzip, JSON, arrays, point clouds."""

import gzip
import io
import json
import struct
import zipfile
import zlib

import cv2
import numpy as np

from tests.hostile.harness import Wrong, case, command, edit_frames, gzip_bomb, strange_files
from zsp_lite.data.annotations import read_frame_index
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import read_depth, read_image, read_mask
from zsp_lite.io.files import read_arrays
from zsp_lite.io.ply import read_ply

RNG = np.random.default_rng(0)
_SMOOTH = cv2.resize(RNG.integers(0, 255, (12, 16, 3), np.uint8), (320, 240))
JPEG = cv2.imencode(".jpg", _SMOOTH)[1].tobytes()
PNG = cv2.imencode(".png", _SMOOTH)[1].tobytes()


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, data: bytes, depth: int = 8, colour: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", data) + png_chunk(b"IEND", b"")


def jpeg_of_size(height: int, width: int) -> bytes:
    at = JPEG.index(b"\xff\xc0") + 5
    return JPEG[:at] + struct.pack(">HH", height, width) + JPEG[at + 4 :]


def damaged_jpeg(byte: int) -> bytes:
    """Without 40 bytes of its data. (Not all damage shows: JPEG has no checksum.)"""
    start = JPEG.index(b"\xff\xda") + 20
    return JPEG[: start + byte] + JPEG[start + byte + 40 :]


def encoded(extension: str) -> bytes:
    return cv2.imencode(extension, _SMOOTH)[1].tobytes()


big = zlib.compress(bytes(1 << 20), 9)
IMAGES = {
    "JPEG cut in the middle": JPEG[: len(JPEG) // 2],
    "JPEG cut, with an end marker": JPEG[: len(JPEG) // 2] + b"\xff\xd9",
    "JPEG damaged early": damaged_jpeg(50),
    "JPEG damaged in the middle": damaged_jpeg(len(JPEG) // 2),
    "JPEG of 65500 x 65500 in its header": jpeg_of_size(65500, 65500),
    "JPEG of height 0": jpeg_of_size(0, 320),
    "JPEG without a frame": JPEG[:2] + JPEG[JPEG.index(b"\xff\xda") :],
    "JPEG start marker only": b"\xff\xd8\xff\xd9",
    "JPEG segment of length 0": b"\xff\xd8\xff\xe0\x00\x00\xff\xd9",
    "PNG cut": PNG[: len(PNG) // 2],
    "PNG with a wrong checksum": PNG[:60] + b"\0\0\0\0" + PNG[64:],
    "PNG of 2^31 - 1 pixels a side": png(2**31 - 1, 2**31 - 1, big),
    "PNG of 30000 x 30000": png(30000, 30000, zlib.compress(bytes(30001 * 1000), 9)),
    "PNG of 100000 x 9000 in 16 bits": png(100000, 9000, big, 16),
    "PNG of width 0": png(0, 10, big),
    "PNG header only": PNG[:33],
    "GIF": b"GIF89a" + struct.pack("<HH", 60000, 60000) + b"\x80\0\0\0\0\0\xff\xff\xff;",
    "BMP of 40000 x 40000": encoded(".bmp")[:18] + struct.pack("<ii", 40000, 40000) + encoded(".bmp")[26:],
    "TIFF of another size": encoded(".tiff").replace(struct.pack("<I", 320), struct.pack("<I", 60000)),
    "portable map of 30000 x 30000": b"P6\n30000 30000\n255\n" + bytes(100),
    "Radiance picture": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 30000\n" + bytes(100),
    "SVG": b"<svg xmlns='http://www.w3.org/2000/svg' width='1e9' height='1e9'/>",
}  # fmt: skip
READERS = {"image": read_image, "mask": read_mask, "depth": read_depth}


def _write_and(read, data):
    def call(folder):
        (folder / "x.png").write_bytes(data)
        return read(folder / "x.png")

    return call


for kind, read in READERS.items():
    for name, data in IMAGES.items():
        case("image", f"{kind}: {name}", _write_and(read, data))
    for name, write in strange_files().items():
        case("file", f"{kind}: {name}", lambda folder, read=read, write=write: (write(folder / "x.png"),
                                                                           read(folder / "x.png"))[1])  # fmt: skip
for name in ("a\0b.png", "x" * 5000 + ".png", "\udcff.png", "", "."):
    case("file", f"image named {name[:10]!r}", lambda folder, name=name: read_image(name))


# gzip and JSON
def _annotations(data):
    def call(folder):
        path = folder / "data/cup/frame_annotations.jgz"
        path.write_bytes(data() if callable(data) else data)
        return read_frame_index(path)

    return call


_ENTRY = b'{"sequence_name": "a", "frame_number": %d}'
GZIPPED = {
    "8 GB of spaces": gzip_bomb,
    "JSON, then 8 GB of spaces": lambda: gzip_bomb(start=b"[]"),
    "half a gigabyte in one member": lambda: gzip.compress(bytes(1 << 29), 1),
    "cut": gzip.compress(b"[" + _ENTRY % 1 + b"]")[:-6],
    "wrong checksum": gzip.compress(b"[]")[:-8] + bytes(8),
    "bytes behind it": gzip.compress(b"[]") + b"hello",
    "header only": b"\x1f\x8b\x08\0\0\0\0\0\0\0",
    "100,000 levels of lists": gzip.compress(b"[" * 100_000 + b"]" * 100_000),
    "100,000 levels of objects": gzip.compress(b'{"a":' * 100_000 + b"1" + b"}" * 100_000),
    "number of 100,000 digits": gzip.compress(b'[{"sequence_name": "a", "frame_number": ' + b"9" * 100_000 + b"}]"),
    "number with an exponent": gzip.compress(b'[{"sequence_name": "a", "frame_number": 1e999999999}]'),
    "null": gzip.compress(b"null"),
    "text in UTF-16": gzip.compress("[]".encode("utf-16")),
    "name that is not UTF-8": gzip.compress(b'[{"sequence_name": "\xff", "frame_number": 1}]'),
    "equal frame numbers": gzip.compress(b"[" + _ENTRY % 1 + b"," + _ENTRY % 1 + b"]"),
}
for name, data in GZIPPED.items():
    case("gzip", f"frame annotations: {name}", _annotations(data))
for name, write in strange_files().items():
    case("file", f"frame annotations: {name}", lambda folder, write=write: (
        write(folder / "data/cup/frame_annotations.jgz"),
        read_frame_index(folder / "data/cup/frame_annotations.jgz"))[1])  # fmt: skip
    case("file", f"sequence annotations: {name}", lambda folder, write=write: (
        write(folder / "data/cup/sequence_annotations.jgz"), Co3D(folder / "data").sequences("cup"))[1])  # fmt: skip
    case("file", f"point cloud: {name}", lambda folder, write=write: (
        write(folder / "x.ply"), read_ply(folder / "x.ply"))[1])  # fmt: skip
command("gzip", "data check of a gzip bomb", "data", "check", "ROOT/data", codes=(1,),
        change=lambda folder: (folder / "data/cup/frame_annotations.jgz").write_bytes(gzip_bomb()))  # fmt: skip


def _twice(content):
    return [*content, content[0]]


case("gzip", "frames listed twice", lambda folder: (edit_frames(folder, _twice),
                                                    Co3D(folder / "data").frame_list("cup"))[1])  # fmt: skip


# arrays
def _npy(descr: str, shape, data: bytes = b"") -> bytes:
    header = str({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    header += b" " * (63 - (len(header) + 10) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def _npz(members: dict[str, bytes], compression=zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def _zeros_npz(mebibytes: int) -> bytes:
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w", force_zip64=True) as file,
    ):
        file.write(_npy("|u1", (mebibytes << 20,)))
        for _ in range(mebibytes):
            file.write(bytes(1 << 20))
    return buffer.getvalue()


ARRAYS = {
    "2 GB of zeros": lambda: _zeros_npz(2048),
    "shape beyond the data": lambda: _npz({"a.npy": _npy("<f8", (10**12,))}),
    "shape of 2^63": lambda: _npz({"a.npy": _npy("<f8", (2**63, 2**10))}),
    "negative shape": lambda: _npz({"a.npy": _npy("<f8", (-1, 5))}),
    "objects": lambda: _npz({"a.npy": _npy("|O", (1,), b"cos\nsystem\n(S'touch pwned'\ntR.")}),
    "texts": lambda: _npz({"a.npy": _npy("<U9", (1,), bytes(36))}),
    "complex numbers": lambda: _npz({"a.npy": _npy("<c16", (1,), bytes(16))}),
    "header that is code": lambda: _npz({"a.npy": _npy("__import__('os').system('touch pwned')", (1,))}),
    "another name": lambda: _npz({"b.npy": _npy("<f8", (1,), bytes(8))}),
    "no arrays": lambda: _npz({}),
    "cut": lambda: _npz({"a.npy": _npy("<f8", (100,), RNG.bytes(800))})[:-200],
    "not an array": lambda: _npz({"a.npy": b"hello"}),
    "wrong checksum": lambda: _npz({"a.npy": _npy("<f8", (100,), bytes(800))}, 0).replace(bytes(400), b"1" * 400),
}  # fmt: skip


def _arrays(data):
    def call(folder):
        (folder / "x.npz").write_bytes(data())
        found = read_arrays(folder / "x.npz", ("a",), "arrays")
        if (folder / "pwned").exists():
            raise Wrong("code was executed")
        return found

    return call


for name, data in ARRAYS.items():
    case("array", name, _arrays(data))
for name, write in strange_files().items():
    case("file", f"arrays: {name}", lambda folder, write=write: (
        write(folder / "x.npz"), read_arrays(folder / "x.npz", ("a",), "arrays"))[1])  # fmt: skip


# point clouds
def _ply(count, body: bytes = b"", kind="ascii", properties=("x", "y", "z"), extra="", of="float") -> bytes:
    lines = "".join(f"property {of} {name}\n" for name in properties)
    return f"ply\nformat {kind} 1.0\nelement vertex {count}\n{lines}{extra}end_header\n".encode() + body


LITTLE = "binary_little_endian"
CLOUDS = {
    "no points": _ply(0),
    "no points, binary": _ply(0, kind=LITTLE),
    "negative count": _ply(-1, b"0 0 0\n"),
    "negative count, binary": _ply(-1, bytes(12), LITTLE),
    "count above the data": _ply(5, b"0 0 0\n"),
    "count below the data": _ply(1, b"0 0 0\n1 1 1\n"),
    "count below the data, binary": _ply(1, bytes(24), LITTLE),
    "count above the data, binary": _ply(5, bytes(12), LITTLE),
    "10^12 points": _ply(10**12, bytes(12), LITTLE),
    "10^30 points": _ply(10**30, bytes(12), LITTLE),
    "10^12 points without properties": _ply(10**12, b"", LITTLE, ()),
    "fractional count": _ply("1.5", b"0 0 0\n"),
    "coordinates of 1e155": _ply(2, b"1e155 0 0\n0 1e155 0\n", of="double"),
    "coordinates of 1e308, binary": _ply(1, struct.pack("<ddd", 1e308, 1, 1), LITTLE, of="double"),
    "infinite": _ply(1, b"inf 0 0\n"),
    "not a number": _ply(1, b"nan 0 0\n"),
    "texts": _ply(1, b"a b c\n"),
    "two coordinates": _ply(1, b"0 0\n", properties=("x", "y")),
    "coordinates as lists": _ply(1, b"1 0 1 0 1 0\n", of="list uchar float"),
    "list of 2^31 faces": _ply(1, bytes(12), LITTLE, extra="element face 2147483647\nproperty list int int i\n"),
    "unknown type": _ply(1, b"0 0 0\n", of="quad"),
    "no end of the header": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n",
    "header of 50 MB": _ply(1, b"0 0 0\n", extra="comment x\n" * 5_000_000 + "element x"),
    "cut": _ply(100, bytes(600), LITTLE),
}  # fmt: skip
for name, data in CLOUDS.items():
    case("point cloud", name, lambda folder, data=data: ((folder / "x.ply").write_bytes(data),
                                                         read_ply(folder / "x.ply"))[1])  # fmt: skip

# archives of labels
_LABEL = json.dumps({"trans": np.eye(4).tolist(), "seq": "c", "reference_seq": "a"}).encode()


def _tar(members: dict[str, bytes], link: tuple[str, str] | None = None) -> bytes:
    import tarfile

    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
        if link:
            info = tarfile.TarInfo(link[0])
            info.type, info.linkname = tarfile.SYMTYPE, link[1]
            archive.addfile(info)
    return buffer.getvalue()


def _tar_bomb() -> bytes:
    import tarfile

    info = tarfile.TarInfo("class_labels/cup/c.json")
    info.size = 8 << 30
    return gzip.compress(info.tobuf()) + gzip_bomb(8)


def _zip_bomb() -> bytes:
    return _npz({"class_labels/cup/c.json": bytes(1 << 29)})


ARCHIVES = {
    "tar.gz of 8 GB": _tar_bomb,
    "gzip of 8 GB": gzip_bomb,
    "zip of half a gigabyte in one label": _zip_bomb,
    "path out of the folder, zip": lambda: _npz({"class_labels/../c.json": _LABEL}),
    "path out of the folder, tar": lambda: _tar({"class_labels/../c.json": _LABEL}),
    "backslash in a name": lambda: _npz({"class_labels/cup/..\\c.json": _LABEL}),
    "hidden name": lambda: _npz({"class_labels/cup/.c.json": _LABEL}),
    "link": lambda: _tar({}, ("class_labels/cup/c.json", "/etc/passwd")),
    "label of another name": lambda: _npz({"class_labels/cup/d.json": _LABEL}),
    "label of another reference": lambda: _npz({"class_labels/cup/c.json": _LABEL.replace(b'"a"', b'"b"')}),
    "label of 100,000 levels": lambda: _npz({"class_labels/cup/c.json": b"[" * 100_000}),
    "no labels": lambda: _npz({"readme": b"hello"}),
    "encrypted": lambda: _npz({"class_labels/cup/c.json": _LABEL}, 0)
    .replace(
        b"PK\x03\x04\x14\0\0\0", b"PK\x03\x04\x14\0\1\0")
    .replace(b"PK\x01\x02\x14\x03\x14\0\0\0", b"PK\x01\x02\x14\x03\x14\0\1\0"),
    "pairs of 100,000 levels": lambda: _npz({"determ_eval/1samples_1tgt/cup.pt": b"\x80\x02" + b"]" * 100_000 + b"."}),
}  # fmt: skip


def _archive(data):
    from zsp_lite.data.label_import import import_labels

    def call(folder):
        (folder / "x.zip").write_bytes(data())
        return import_labels(folder / "x.zip", folder / "data")

    return call


for name, data in ARCHIVES.items():
    case("archive", name, _archive(data))
for name, write in strange_files().items():
    if name not in ("folder",):
        command("file", f"archive of labels: {name}", "data", "labels", "ROOT/x.zip", "--root", "ROOT/data",
                change=lambda folder, write=write: write(folder / "x.zip"))  # fmt: skip
