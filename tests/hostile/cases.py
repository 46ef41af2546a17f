"""The cases: endless, oversized and malicious files and options, for every reader and command."""

import io
import json
import struct
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
from co3d_folders import sequence_data
from PIL import Image
from test_readers import write as write_scan
from uco3d_folders import open_metadata

from tests.hostile.harness import (
    BENCHMARK,
    CASES,
    FRAMES,
    OF_UCO3D,
    READERS_OF,
    RESULTS,
    STRANGE,
    Case,
    both,
    case,
    command,
    gzip_bomb,
    read_capture,
    strange,
    written,
)
from zsp_lite import Frame
from zsp_lite.importers import open_capture
from zsp_lite.importers.files import read_depth_file, read_mask_file, read_picture

CONTINUED = f"{BENCHMARK} --data ROOT/data --out ROOT/out"
# Every command, with a file that it reads.
COMMANDS_OF = {
    "picture": ("a.png", "estimate ROOT/a.png ROOT/b.png --intrinsics 60,60,32,32 --out ROOT/e"),
    "results": (RESULTS, "tables ROOT/out"),
    "packed results": (f"{RESULTS}.gz", "tables ROOT/out"),
    "run to continue": ("out/run.jsonl", CONTINUED),
    "settings of a run": ("out/run.json", CONTINUED),
    "checked annotations": (FRAMES, "data check ROOT/data"),
    "weights": ("x.safetensors", "demo --backbone ROOT/x.safetensors --out ROOT/d"),
}
for kind in STRANGE:
    for what, (name, read) in READERS_OF.items():
        case("file", f"{what}: {kind}", read, strange(name, kind))
    for what, (name, line) in COMMANDS_OF.items():
        code = 1 if what == "checked annotations" else 2
        command("file", f"{what}: {kind}", line, strange(name, kind), code)


# Oversized files: small on the disk, large in memory.
def png(width: int, height: int) -> bytes:
    """A grey picture whose header claims a size, with a megabyte of zeros for its pixels."""
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(1 << 20), 9)),
        (b"IEND", b""),
    )
    content = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks:
        checksum = zlib.crc32(kind + data)
        content += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)
    return content


def safetensors(header: dict | bytes, data: bytes = b"") -> bytes:
    """Weights in the format of safetensors, with any header."""
    encoded = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(encoded)) + encoded + data


def _npy(shape: tuple[int, ...], descr: str = "<f8", data: bytes = b"") -> bytes:
    """An array file of NumPy whose header claims a shape and type."""
    fields = str({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    header = fields.ljust(117) + b"\n"  # 128 bytes with what stands before it
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


def depth_map(content: bytes) -> Callable[[Path], None]:
    """Return a function that gives the capture a depth map."""
    return both(written("capture/z/0.npy", content), written("capture/depth.txt", "z/0.npy\n"))


DEEP = b"[" * 100_000  # JSON of so many nested lists
# For each case: the reader, and the content of its file.
OVERSIZED = [
    ("image", png(30_000, 30_000)),
    ("depth", png(2**31 - 1, 2**31 - 1)),
    ("frame annotations", gzip_bomb),
    ("nerfstudio", DEEP),
    ("pairs", b"\x80\x02" + b"]" * 100_000 + b"."),
    (
        "safetensors",
        safetensors({"a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4]}}, bytes(4)),
    ),
    ("safetensors", safetensors(b'{"a":' * 100_000)),
    ("lists", "x" * 20_000_000),
    ("lists", "\n" * 2_000_000),
]
for number, (what, data) in enumerate(OVERSIZED):
    name, read = READERS_OF[what]
    case("oversized", f"{what} {number}", read, written(name, data))
command(
    "oversized",
    "results that are a gzip bomb",
    "tables ROOT/out",
    written(f"{RESULTS}.gz", gzip_bomb),
)
case("oversized", "depth map of 10^15 numbers", read_capture("lists"), depth_map(_npy((10**15,))))


# Malicious files: links that lead out of a folder, and code.
def link(name: str, target: str) -> Callable[[Path], None]:
    """Return a function that replaces a file of the folder by a link."""

    def replace_by_link(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(target)

    return replace_by_link


case(
    "malicious",
    "depth map of objects",
    read_capture("lists"),
    depth_map(_npy((1,), "|O", b"cos\nsystem\n(S'touch executed'\ntR.")),
)
for target in ("capture/pictures/0.jpg", "capture/rgb.txt"):
    case(
        "malicious",
        f"{target} is a link out of the folder",
        read_capture("lists"),
        link(target, "/etc/passwd"),
    )


def scan(layout: str, change: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return a function that writes one frame in a layout of `test_readers`, and changes it."""

    def write(folder: Path) -> None:
        frame = replace(sequence_data("c", 1).frames[0], name="0")
        path, _ = write_scan(layout, folder / "scan", [frame])
        change(path)
        (folder / "path").write_text(str(path))

    return write


def read_scan(folder: Path) -> list[Frame]:
    """Read the frames of the scan."""
    return [frame.load() for frame in open_capture((folder / "path").read_text()).frames]


def rewritten(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    """Return a function that changes the content of a file."""
    return lambda path: (path / name).write_bytes(change((path / name).read_bytes()))


def zip_of(name: str, size: int) -> Callable[[Path], None]:
    """Return a function that writes a zip with one file of zeros."""

    def write(path: Path) -> None:
        with (
            zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as zipped,
            zipped.open(name, "w", force_zip64=True) as file,
        ):
            for _ in range(size >> 20):
                file.write(bytes(1 << 20))

    return write


def without_lzfse(path: Path) -> None:
    """Give a scan of Record3D a depth map that is not compressed."""
    with zipfile.ZipFile(path, "a") as zipped, warnings.catch_warnings(action="ignore"):
        zipped.writestr("rgbd/0.depth", bytes(range(256)))  # the last of equal names is unpacked


def ten_hours(data: bytes) -> bytes:
    """Make an MP4 file claim a duration of ten hours, for the movie and for its media."""
    for kind in (b"mvhd", b"mdhd"):
        # Behind the name of either header: 12 bytes, units per second, and the duration in units.
        scale = data.index(kind) + 16
        duration = scale + 4
        ten = 36_000 * int.from_bytes(data[scale:duration])
        data = data[:duration] + ten.to_bytes(4) + data[duration + 4 :]
    return data


ODOMETRY = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
for name, layout, change in (
    (
        "quaternion of zeros",
        "stray",
        written("odometry.csv", ODOMETRY + "0, 0, 0, 0, 0, 0, 0, 0, 0\n"),
    ),
    (
        "frames without end",
        "stray",
        both(
            written(
                "odometry.csv",
                ODOMETRY
                + "".join(f"0, {k}, 0, 0, 0, 0, 0, 0, 1\n" for k in (1e9, 1e18, -5, "nan")),
            ),
            written("depth/1000000000.png", ""),
        ),
    ),
    (
        "video of 10 hours",
        "stray",
        both(
            rewritten("rgb.mp4", ten_hours),
            rewritten("odometry.csv", lambda data: data.replace(b"\n0, 0,", b"\n0, 900000,")),
            written("depth/900000.png", ""),
        ),
    ),
    (
        "video that is a list of addresses",
        "stray",
        written("rgb.mp4", "#EXTM3U\n#EXTINF:9,\n/etc/passwd\n"),
    ),
    (
        "camera of objects",
        "polycam",
        written("keyframes/corrected_cameras/000000.json", '{"fx": {}, "t_00": "x"}'),
    ),
    ("depth that is no LZFSE", "record3d", without_lzfse),
    (
        "times that are no numbers",
        "tum",
        written("rgb.txt", "nan a.jpg\ninf b.jpg\n-1e308 c.jpg\n"),
    ),
    (
        "objects that are lists",
        "bop",
        written("scene_gt.json", '{"0": [{"obj_id": [], "cam_R_m2c": {}, "cam_t_m2c": "x"}]}'),
    ),
    ("pose of many numbers", "scannet", written("pose/000000.txt", "1 2 3 4\n" * 100_000)),
    ("matrix of nothing", "open3d", written("intrinsic.json", '{"intrinsic_matrix": [[], [[]]]}')),
):
    case("scan", f"{layout}: {name}", read_scan, scan(layout, change))


# uCO3D's tables and depth maps.
def rows_without_end(folder):
    """Replace the table of frames by a view that has endless rows."""
    with closing(open_metadata(folder / "uco3d")) as metadata, metadata:
        metadata.execute("DROP TABLE frame_annots")
        endless = "SELECT 1 AS n UNION ALL SELECT n + 1 FROM numbers"
        metadata.execute(
            f"CREATE VIEW frame_annots AS WITH RECURSIVE numbers AS ({endless}) SELECT 'b' AS "
            "sequence_name, n AS frame_number FROM numbers"
        )


def depth_of(shape, chunks):
    """Return a function that replaces the depth maps by one of a shape, without values."""

    def write(folder):
        with h5py.File(folder / OF_UCO3D / "depth_maps.h5", "w") as depths:
            depths.create_dataset("1", shape, np.float32, chunks=chunks)

    return write


for name, change in (
    ("rows without end", rows_without_end),
    ("depth map of 10^15 numbers", depth_of((10**7, 10**8), chunks=(64, 64))),
):
    case("uCO3D", name, READERS_OF["uCO3D's depth"][1], change)


# Pictures, depth maps and masks of other kinds.
def encoded(values: np.ndarray, kind: str, palette: bool = False, **options) -> bytes:
    """A picture in a format of Pillow."""
    image, file = Image.fromarray(values), io.BytesIO()
    if palette:
        image.putpalette(range(256))
    image.save(file, kind, **options)
    return file.getvalue()


def npz(*members: np.ndarray) -> bytes:
    """An archive of arrays."""
    file = io.BytesIO()
    np.savez_compressed(file, *members)
    return file.getvalue()


def exif(kind: int, count: int, value: bytes) -> bytes:
    """A JPEG whose EXIF orientation has a type, a number of values, and a value or an offset.

    The directory of EXIF names itself as the next one.
    """
    directory = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack(
        "<HHI4sI", 0x0112, kind, count, value, 8
    )
    jpeg = encoded(np.zeros((8, 8, 3), np.uint8), "JPEG")
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(directory) + 2) + directory + jpeg[2:]


TIFF = encoded(np.ones((32, 32), np.float32), "TIFF")
LABELS = np.arange(4096, dtype=np.uint16).reshape(64, 64) % 300
for name, read, data in (
    ("wild.tiff", read_depth_file, TIFF[:4] + b"\xff" * 4 + TIFF[8:]),
    (
        "bomb.tiff",
        read_depth_file,
        lambda: encoded(np.zeros((20_000, 20_000), np.uint16), "TIFF", compression="tiff_lzw"),
    ),
    ("bomb.pfm", read_depth_file, b"Pf\n99999 99999\n-1.0\n"),
    ("objects.npz", read_depth_file, npz(np.array([{}]))),
    ("palette.png", read_mask_file, encoded(LABELS.astype(np.uint8), "PNG", palette=True)),
):
    case(
        "picture",
        name,
        lambda folder, name=name, read=read: read(folder / name),
        written(name, data),
    )
case(
    "picture",
    "npz of 3 GB",
    READERS_OF["depth file"][1],
    lambda folder: zip_of("a.npy", 3 << 30)(folder / "z.npz"),
)
MASK_OF_300_LABELS = written("a_mask.png", encoded(LABELS, "PNG"))
command("picture", "mask of 300 labels", COMMANDS_OF["picture"][1], MASK_OF_300_LABELS)


def read_without_orientation(*tag: int | bytes) -> Callable[[Path], tuple[str, str]]:
    """Return the call of a case: a picture is read as if it had no EXIF orientation."""

    def call(folder: Path) -> tuple[str, str]:
        written("e.jpg", exif(*tag))(folder)
        _, orientation = read_picture(folder / "e.jpg")
        return "right" if orientation == 1 else "wrong", ""

    return call


for tag in (
    (3, 1, b"\x60\xea\0\0"),
    (2, 4, b"abc\0"),
    (5, 1, b"\xff" * 4),
    (3, 1 << 31, bytes(4)),
    (99, 1, bytes(4)),
):
    CASES.append(Case("picture", f"EXIF orientation {tag}", read_without_orientation(*tag)))

ON_DATA = f"{BENCHMARK} --data ROOT/data --out ROOT/new"


def module_that_exits(folder: Path) -> None:
    """Write a module of methods that ends the program."""
    sys.path.insert(0, str(folder))
    written("raises.py", "raise SystemExit(3)")(folder)


for option in (
    "--methods raises:now",
    "--methods a=/dev/zero/x.csv",
    "--categories ../..",
    "--list-pairs /dev/null/x",
):
    command("malicious", f"benchmark {option}", f"{ON_DATA} {option}", module_that_exits)

# Options that reach beyond their folder, or ask for more than there is.
for line in (
    f"{ON_DATA} --pairs 100000000",
    f"{ON_DATA} --workers 100000000000",
    f"{ON_DATA} --image-size 1000000",
    f"{BENCHMARK} --data ROOT/data --out /dev/null/x",
    "compare ROOT \udcff",
    "demo --data \udcff",
    "data labels file:///etc --root ROOT/data",
    "data transfer ROOT/data ROOT/data ../cup",
    "data import ROOT/capture --root ROOT/data --category c --sequence .. --box 2,2,20,20",
):
    command("options", line.replace(ON_DATA, "benchmark")[:60], line)
