"""TUM RGB-D folders: rgb.txt, depth.txt, groundtruth.txt with times; depth PNGs of 1/5000 m."""

from pathlib import Path

import numpy as np

from zsp_lite.data.cameras import rotation_from_quaternion
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import (
    Capture,
    CaptureFrame,
    camera_from_pose,
    image_size,
    listed_file,
    numbers,
    read_rows,
)

# The benchmark's default camera; its pixel centres are at whole numbers, ours at half ones.
DEFAULT_INTRINSICS, DEFAULT_SIZE = (525.0, 525.0, 319.5, 239.5), (480, 640)
_DEPTH_UNIT = 1 / 5000
_FARTHEST = 0.02  # seconds between a picture and its depth or pose


def read_tum(folder: str | Path, intrinsics: tuple[float, float, float, float] | None = None) -> Capture:
    """Pictures with a depth map and a pose (camera to world, `tx ty tz qx qy qz qw`) at most 0.02 s away.

    intrinsics: fx, fy, cx, cy in pixels as the benchmark prints them; default: its default camera.
    Raises InputError where a list is missing or broken, where no picture has both, and where pictures of another size
    than the default camera's come without intrinsics.
    """
    folder = Path(folder)
    fx, fy, cx, cy = intrinsics or DEFAULT_INTRINSICS
    lists = {}
    for name, columns in (("rgb.txt", 2), ("depth.txt", 2), ("groundtruth.txt", 8)):
        rows = read_rows(folder / name, columns, "list")
        if not rows:
            raise InputError(f"list {folder / name} is empty, expected lines of {columns} columns")
        times = numbers([words[0] for _, words in rows], str(folder / name))
        lists[name] = np.array(times), rows
    size, shots = None, []
    for time, (line, words) in zip(*lists["rgb.txt"]):
        depth, pose = (_nearest(lists[name], time) for name in ("depth.txt", "groundtruth.txt"))
        if depth is None or pose is None:
            continue
        image = listed_file(folder, words[1], f"{folder / 'rgb.txt'}, line {line}")
        size = size or image_size(image)
        if intrinsics is None and size != DEFAULT_SIZE:
            raise InputError(
                f"{image} is {size} pixels, expected intrinsics, for the default ones are of {DEFAULT_SIZE}"
            )
        where = f"{folder / 'groundtruth.txt'}, line {pose[0]}"
        values = numbers(pose[1][1:8], where)
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = rotation_from_quaternion(values[3:], where), values[:3]
        camera = camera_from_pose(to_world, (fx, fy), (cx + 0.5, cy + 0.5), size, where)
        path = listed_file(folder, depth[1][1], f"{folder / 'depth.txt'}, line {depth[0]}")
        shots.append(CaptureFrame(image, path, camera, float(time), _DEPTH_UNIT))
    if not shots:
        raise InputError(f"capture {folder}: no picture has depth and a pose within {_FARTHEST} s, expected some")
    return Capture(tuple(shots))


def _nearest(listed: tuple[np.ndarray, list], time: float) -> tuple[int, list[str]] | None:
    times, rows = listed
    index = int(np.abs(times - time).argmin())
    return rows[index] if abs(times[index] - time) <= _FARTHEST else None
