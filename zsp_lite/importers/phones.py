"""Scans of phones as apps export them, after their documents: Stray Scanner, Polycam, Record3D."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import lzfse
import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.data.writing import write_image
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import (
    FROM_OPENGL,
    CaptureFrame,
    Makers,
    make_frame,
    read_numbers,
    read_text_lines,
    refuse,
    sharpest,
)
from zsp_lite.importers.unpacked import Video, new_folder
from zsp_lite.io.files import read_bytes, read_json

# Columns of Stray Scanner's odometry.csv: number, position and quaternion of a frame.
_ODOMETRY = "frame x y z qx qy qz qw".split()
_CAMERA = "fx fy cx cy".split()  # its camera in pixels, which older files lack


def read_stray(folder: Path, count: int) -> Makers:
    """Read a scan of Stray Scanner, at most `count` sharp frames of its video."""
    path = folder / "odometry.csv"
    rows = _read_odometry(path)
    K = read_numbers(folder / "camera_matrix.csv", (3,), delimiter=",")
    video = Video(folder / "rgb.mp4")
    # Number of each row's image in the video. A row without a number has no image.
    images = np.nan_to_num(rows[:, 0], nan=-1)
    left_out = []
    doubt = ""
    times = np.array(video.times() if video.count < len(rows) else [])
    if 1 < len(times) < len(rows):
        video = Video(video.path)  # `times` has read the other to its end
        missing = len(rows) - len(times)
        fewer = (
            f"{folder}: the video has {missing} images fewer than odometry.csv "
            f"({len(times)} of {len(rows)})"
        )
        # The times of the images, in steps of their median distance (1 ms at least), count frames.
        # They show which images are missing, if the first and the last one are there.
        steps = np.rint((times - times[0]) / np.median(np.diff(times)).clip(1))
        timed = np.isin(images - images[0], steps)
        if timed[-1] and timed.sum() == len(times):
            rows = rows[timed]
            images = np.arange(len(times))
            left_out += missing * [fewer]
        else:
            doubt = f"{fewer}: images after a gap may be late"

    pictures = new_folder()
    items = list(zip(rows, images))
    for (row, _), image in sharpest(items, count, lambda item: video.frame(int(item[1])), left_out):
        name = f"{row[0]:06.0f}"
        picture = pictures / f"{name}.jpg"
        write_image(picture, image, quality=95)
        yield partial(
            make_frame,
            folder,
            picture,
            f"depth/{name}.png",
            row[1:8],
            row[8:] if np.isfinite(row[8:]).sum() == 4 else K,
            f"{path}, frame {row[0]:.0f}",
            confidence=f"confidence/{name}.png",
            doubt=doubt,
        )
    for problem in left_out:
        yield partial(refuse, problem)


def _read_odometry(path: Path) -> Float[np.ndarray, "rows columns"]:
    """Read the columns of odometry.csv by the names in its header; an empty number is NaN."""
    names = [name.strip() for name in read_text_lines(path, least=2)[0].split(",")]
    missing = [name for name in _ODOMETRY if name not in names]
    if missing:
        raise InputError(
            f"{path} has no column {', '.join(missing)}, expected {', '.join(_ODOMETRY)}"
        )
    columns = [names.index(name) for name in (*_ODOMETRY, *_CAMERA) if name in names]
    return read_numbers(
        path,
        (len(columns),),
        delimiter=",",
        skiprows=1,
        usecols=columns,
        converters=lambda text: float(text.strip() or "nan"),
    )


def read_polycam(folder: Path) -> Makers:
    """Read Polycam's raw data: its corrected images and cameras, if they are there."""
    folder = folder / "keyframes"
    prefix = ""
    if (folder / "corrected_cameras").is_dir() and (folder / "corrected_images").is_dir():
        prefix = "corrected_"
    for path in sorted((folder / f"{prefix}cameras").glob("*.json")):
        yield partial(_make_polycam, folder, path, f"{prefix}images/{path.stem}")


def _make_polycam(folder: Path, path: Path, image: str) -> CaptureFrame:
    """Make a frame from the file of its camera."""
    camera = read_json(path, dict[str, Any], "capture")
    pose = [camera.get(f"t_{row}{column}") for row in range(3) for column in range(4)]
    intrinsics = [camera.get(name) for name in ("fx", "fy", "cx", "cy")]
    return make_frame(
        folder,
        image,
        f"depth/{path.stem}",
        pose,
        intrinsics,
        str(path),
        FROM_OPENGL,
        confidence=f"confidence/{path.stem}",
    )


_Side = Annotated[int, msgspec.Meta(ge=1, le=10_000)]  # pixels


class _Record3D(msgspec.Struct):
    """The file `metadata` of a Record3D scan; numbers of a pose that are not finite are None."""

    K: Annotated[list[float], msgspec.Meta(min_length=9, max_length=9)]  # in column-major order
    poses: list[list[float | None]]  # qx, qy, qz, qw, tx, ty, tz
    dw: _Side = 256  # width and height of the depth maps; the LiDAR's by default
    dh: _Side = 192
    perFrameIntrinsicCoeffs: list[list[float | None]] | None = None


def read_record3d(folder: Path) -> Makers:
    """Read a scan of Record3D; its depth is decompressed to a temporary folder."""
    scan = read_json(folder / "metadata", _Record3D, "capture")
    unpacked = new_folder()
    if not any(map(any, scan.poses)):
        raise InputError(
            f"{folder.resolve().name}/metadata: all {len(scan.poses)} poses are zero: the tracking "
            "failed, expected another scan"
        )
    # fx, fy, cx, cy of each frame. A file without them has one K for all frames.
    every = scan.perFrameIntrinsicCoeffs or [[scan.K[k] for k in (0, 4, 6, 7)]] * len(scan.poses)
    for number in range(len(scan.poses)):
        intrinsics = every[number] if number < len(every) else []
        yield partial(_make_record3d, folder, unpacked / f"{number}", scan, intrinsics)
    for path in folder.glob("rgbd/*.jpg"):
        if path.stem not in map(str, range(len(scan.poses))):
            yield partial(refuse, f"rgbd/{path.name}: no pose in metadata")


def _make_record3d(
    folder: Path, unpacked: Path, scan: _Record3D, intrinsics: list[float | None]
) -> CaptureFrame:
    """Make a frame; its depth and confidence are decompressed to `unpacked`.npy and .png.

    The name of `unpacked` is the number of the frame.
    """
    name = f"rgbd/{unpacked.name}"
    pose = scan.poses[int(unpacked.name)]
    depth = unpacked.with_suffix(".npy")
    confidence = unpacked.with_suffix(".png")
    np.save(depth, _decompressed(folder / f"{name}.depth", np.float32, scan))
    if (folder / f"{name}.conf").is_file():
        cv2.imwrite(str(confidence), _decompressed(folder / f"{name}.conf", np.uint8, scan))
    return make_frame(
        folder,
        f"{name}.jpg",
        depth,
        pose[4:] + pose[:4],
        intrinsics,
        f"{folder}, frame {unpacked.name}",
        FROM_OPENGL,
        confidence=confidence if confidence.is_file() else None,
        depth_unit=1.0,
    )


def _decompressed(path: Path, kind: type, scan: _Record3D) -> np.ndarray:
    """Decompress a map (dh, dw) of numbers of a type by LZFSE."""
    data = read_bytes(path, "depth")
    try:
        # Compressed, a map may be a little larger, not twice as large.
        if len(data) > 2 * scan.dh * scan.dw * np.dtype(kind).itemsize:
            raise ValueError(f"{len(data)} compressed bytes")
        return np.frombuffer(lzfse.decompress(data), kind).reshape(scan.dh, scan.dw)
    except (lzfse.error, MemoryError, ValueError) as error:
        raise InputError(
            f"{path.name} is no map of {scan.dh} x {scan.dw} numbers ({str(error) or 'damaged'})"
        ) from error
