"""The cases: endless, oversized and malicious files and options, for every reader and command."""

import io
import struct
import sys
import warnings
import zipfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from co3d_folders import sequence_data
from PIL import Image
from test_readers import write as write_scan
from uco3d_folders import open_metadata, write_depth

from tests.hostile.harness import (
    BENCHMARK,
    FRAMES,
    OF_UCO3D,
    READERS_OF,
    RESULTS,
    STRANGE,
    case,
    command,
    gzip_bomb,
    strange,
    written,
)
from zsp_lite import Frame
from zsp_lite.importers import open_capture
from zsp_lite.importers.files import read_depth_file, read_mask_file

CONTINUED = f"{BENCHMARK} --data ROOT/data --out ROOT/out"
ON_DATA = f"{BENCHMARK} --data ROOT/data --out ROOT/new"  # a new run
# Every command, with a file that it reads.
COMMANDS_OF = {
    "picture": (
        "a.png",
        "estimate ROOT/a.png ROOT/data/cup/b --depth ROOT/z.npy --intrinsics 60,60,32,32",
    ),
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
        # `data check` lists the file as a problem.
        code = 1 if what == "checked annotations" else 2
        command("file", f"{what}: {kind}", line, strange(name, kind), code)


# Oversized files: small on the disk, large in memory.
def encoded(values: np.ndarray, kind: str, palette: bool = False, **options) -> bytes:
    """A picture in a format of Pillow."""
    image = Image.fromarray(values)
    file = io.BytesIO()
    if palette:
        image.putpalette(range(256))
    image.save(file, kind, **options)
    return file.getvalue()


def safetensors(header: bytes) -> bytes:
    """Weights in the format of safetensors, four bytes with any header."""
    return struct.pack("<Q", len(header)) + header + bytes(4)


def npy(shape: tuple[int, ...]) -> bytes:
    """An array file of NumPy whose header claims a shape."""
    file = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()


# A JPEG of 8 x 8 pixels whose header claims 65,535 x 65,535. There height and width, of two bytes
# each, stand before the number of channels, 1.
LARGE = encoded(np.zeros((8, 8), np.uint8), "JPEG").replace(b"\0\x08\0\x08\1", b"\xff" * 4 + b"\1")
# For each case: the reader, and the content of its file.
OVERSIZED = [
    ("image", LARGE),
    ("frame annotations", gzip_bomb),
    ("nerfstudio", b"[" * 100_000),
    ("pairs", b"\x80\x02" + b"]" * 100_000 + b"."),
    (
        "safetensors",
        safetensors(b'{"a": {"dtype": "F32", "shape": [1000000000000], "data_offsets": [0, 4]}}'),
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


def scan(layout: str, *changes: Callable[[Path], object]) -> Callable[[Path], None]:
    """Return a function that writes one frame in a layout of `test_readers`, changes it, and writes
    its path, which depends on the layout, to the file `path`."""

    def write(folder: Path) -> None:
        frame = replace(sequence_data("c", 1).frames[0], name="0")
        path, _ = write_scan(layout, folder / "scan", [frame])
        for change in changes:
            change(path)
        (folder / "path").write_text(str(path))

    return write


def read_scan(folder: Path) -> list[Frame]:
    """Read the frames of the scan."""
    return [frame.load() for frame in open_capture((folder / "path").read_text()).frames]


def without_lzfse(path: Path) -> None:
    """Give a scan of Record3D a depth map that is not compressed."""
    with zipfile.ZipFile(path, "a") as zipped, warnings.catch_warnings(action="ignore"):
        zipped.writestr("rgbd/0.depth", bytes(range(256)))  # the last of equal names is unpacked


def ten_hours(path: Path) -> None:
    """Make the video of Stray Scanner claim a duration of ten hours, for the movie and for its
    media, and ask for a frame of the ninth hour."""
    video = path / "rgb.mp4"
    odometry = path / "odometry.csv"
    data = video.read_bytes()
    for kind in (b"mvhd", b"mdhd"):
        # Behind the name of either header: 12 bytes, units per second, and the duration in units.
        scale = data.index(kind) + 16
        duration = scale + 4
        ten = 36_000 * int.from_bytes(data[scale:duration])
        data = data[:duration] + ten.to_bytes(4) + data[duration + 4 :]
    video.write_bytes(data)
    odometry.write_bytes(odometry.read_bytes().replace(b"\n0, 0,", b"\n0, 900000,"))


ODOMETRY = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
for name, layout, *changes in (
    (
        "quaternion of zeros",
        "stray",
        written("odometry.csv", ODOMETRY + "0, 0, 0, 0, 0, 0, 0, 0, 0\n"),
    ),
    (
        "frames without end",
        "stray",
        written(
            "odometry.csv",
            ODOMETRY + "".join(f"0, {k}, 0, 0, 0, 0, 0, 0, 1\n" for k in (1e9, 1e18, -5, "nan")),
        ),
        written("depth/1000000000.png", ""),
    ),
    (
        "video of 10 hours",
        "stray",
        ten_hours,
        written("depth/900000.png", ""),
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
    case("scan", f"{layout}: {name}", read_scan, scan(layout, *changes))


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


for name, change in (
    ("rows without end", rows_without_end),
    (
        "depth map of 10^15 numbers",
        lambda folder: write_depth(
            folder / OF_UCO3D / "depth_maps.h5", (10**7, 10**8), chunks=(64, 64)
        ),
    ),
):
    case("uCO3D", name, READERS_OF["uCO3D's depth"][1], change)


# Pictures, depth maps and masks of other kinds.
def npz(*members: np.ndarray) -> bytes:
    """An archive of arrays."""
    file = io.BytesIO()
    np.savez_compressed(file, *members)
    return file.getvalue()


TIFF = encoded(np.ones((32, 32), np.float32), "TIFF")
LABELS = np.arange(4096).reshape(64, 64).astype(np.uint8)
for name, read, data in (
    ("wild.tiff", read_depth_file, TIFF[:4] + b"\xff" * 4 + TIFF[8:]),
    (
        "bomb.tiff",
        read_depth_file,
        lambda: encoded(np.zeros((20_000, 20_000), np.uint16), "TIFF", compression="tiff_lzw"),
    ),
    ("bomb.pfm", read_depth_file, b"Pf\n99999 99999\n-1.0\n"),
    ("giant.npy", read_depth_file, npy((10**8, 10**7))),
    ("bomb.npz", read_depth_file, lambda: npz(np.broadcast_to(np.zeros(1), 1 << 27))),
    ("palette.png", read_mask_file, encoded(LABELS, "PNG", palette=True)),
):
    case(
        "picture",
        name,
        lambda folder, name=name, read=read: read(folder / name),
        written(name, data),
    )


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
    # Python reads a byte that is not UTF-8 from a command line as such a character.
    "compare ROOT \udcff",
    "demo --data \udcff",
    "data labels file:///etc --root ROOT/data",
    "data transfer ROOT/data ROOT/data ../cup",
    "data import ROOT/capture --root ROOT/data --category c --sequence .. --box 2,2,20,20",
):
    command("options", line.replace(ON_DATA, "benchmark")[:60], line)
