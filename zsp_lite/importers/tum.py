"""Reader of TUM RGB-D folders: rgb.txt, depth.txt and groundtruth.txt with times; depth in units of 1/5000 m."""

from pathlib import Path

import numpy as np

from zsp_lite.errors import InputError
from zsp_lite.importers.capture import (
    CaptureFrame,
    camera_from_pose,
    image_size,
    listed_file,
    parse_numbers,
    read_rows,
)
from zsp_lite.io.files import path_inside

# The benchmark's default camera, with pixel centres at half-integers; the benchmark counts them at integers.
DEFAULT_INTRINSICS, DEFAULT_SIZE = (525.0, 525.0, 320.0, 240.0), (480, 640)
_DEPTH_UNIT = 1 / 5000
_MAX_GAP = 0.02  # largest time between an image and its depth or pose, seconds


def read_tum(folder: str | Path, intrinsics: tuple[float, float, float, float] | None = None) -> list[CaptureFrame]:
    """Read the images that have a depth map and a pose within 0.02 s.

    Poses are camera-to-world: `tx ty tz qx qy qz qw`.

    Args:
        folder: The capture.
        intrinsics: fx, fy, cx, cy in pixels, with pixel centres at half-integers: 0.5 is added to the cx and cy that
            the benchmark states. The default is the benchmark's default camera.

    Raises:
        InputError: A list is missing or invalid, no image has both depth and pose, or other intrinsics are needed.
    """
    from scipy.spatial.transform import Rotation  # takes 0.2 s to import

    folder = Path(folder)
    fx, fy, cx, cy = intrinsics or DEFAULT_INTRINSICS
    lists = {}
    for name, columns in (("rgb.txt", 2), ("depth.txt", 2), ("groundtruth.txt", 8)):
        rows = read_rows(path_inside(folder, name), columns, "list")
        if not rows:
            raise InputError(f"list {folder / name} is empty, expected lines of {columns} columns")
        times = parse_numbers([words[0] for _, words in rows], str(folder / name))
        lists[name] = np.array(times), rows
    size, frames = None, []
    for time, (line, words) in zip(*lists["rgb.txt"]):
        depth, pose = (_nearest(lists[name], time) for name in ("depth.txt", "groundtruth.txt"))
        if depth is None or pose is None:
            continue
        image = listed_file(folder, words[1], f"{folder / 'rgb.txt'}, line {line}")
        size = size or image_size(image)
        if intrinsics is None and size != DEFAULT_SIZE:
            raise InputError(
                f"{image} is {size} pixels, expected --intrinsics FX,FY,CX,CY: the default ones are for {DEFAULT_SIZE} "
                "pixels"
            )
        where = f"{folder / 'groundtruth.txt'}, line {pose[0]}"
        values = parse_numbers(pose[1][1:8], where)
        if np.linalg.norm(values[3:]) < 1e-6:
            raise InputError(f"{where}: quaternion is {values[3:]}, expected a quaternion (x, y, z, w) of length 1")
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
        camera = camera_from_pose(matrix, (fx, fy), (cx, cy), size, where)
        path = listed_file(folder, depth[1][1], f"{folder / 'depth.txt'}, line {depth[0]}")
        frames.append(CaptureFrame(image, path, camera, float(time), _DEPTH_UNIT))
    if not frames:
        raise InputError(f"capture {folder}: no image has depth and a pose within {_MAX_GAP} s")
    return frames


def _nearest(listed: tuple[np.ndarray, list], time: float) -> tuple[int, list[str]] | None:
    """Return the row whose time is nearest, or None if it is not within `_MAX_GAP`."""
    times, rows = listed
    index = int(np.abs(times - time).argmin())
    return rows[index] if abs(times[index] - time) <= _MAX_GAP else None
