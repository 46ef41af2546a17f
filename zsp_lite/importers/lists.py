"""Captures given as text lists: a line per frame in each, and TUM's RGB-D benchmark with times."""

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from zsp_lite.errors import InputError
from zsp_lite.importers.capture import Makers, make_frame, parse_numbers, read_lines

_TUM_INTRINSICS = 525.0, 525.0, 320.0, 240.0  # the benchmark's default, with pixel centres at half-integers
_TUM_UNIT, _TUM_TOLERANCE = 1 / 5000, 0.02  # metres per stored depth value; seconds between an image and its depth


def read_lists(folder: Path) -> Makers:
    """Read a capture given as plain text lists: line n of each describes frame n.

    rgb.txt, depth.txt: one file name per line
    poses.txt: one camera-to-world matrix per line, 12 or 16 numbers in row-major order, in OpenCV's axes
    intrinsics.txt: the 3 x 3 matrix K in pixels, or fx fy cx cy, once or in a line per frame; pixel centres are at
    half-integers
    """
    lists = {name: read_lines(folder / name) for name in ("rgb.txt", "depth.txt", "poses.txt", "intrinsics.txt")}
    intrinsics = parse_numbers(lists["intrinsics.txt"], f"{folder}/intrinsics.txt", (3, 4))
    poses = parse_numbers(lists["poses.txt"], f"{folder}/poses.txt", (12, 16))
    if intrinsics.shape[1] == 3 or len(intrinsics) == 1:
        del lists["intrinsics.txt"]
        intrinsics = [intrinsics.squeeze()] * len(poses)
    counts = {name: len(lines) for name, lines in lists.items()}
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InputError(f"capture {folder}: the lists have lines: {found}; expected equal numbers")
    for line, names in enumerate(zip(lists["rgb.txt"], lists["depth.txt"])):
        where = f"capture {folder}, line {line + 1} of the lists"
        yield partial(make_frame, folder, *names, poses[line], intrinsics[line], where)


def read_tum(folder: Path, intrinsics: tuple[float, float, float, float] = _TUM_INTRINSICS) -> Makers:
    """Read a sequence of TUM's RGB-D benchmark: image, depth and pose of the nearest times are a frame."""
    where = f"{folder}/groundtruth.txt"
    poses = parse_numbers(read_lines(folder / "groundtruth.txt"), where, (8,))
    (times, images), (depth_times, depths) = (_timed_files(folder / name) for name in ("rgb.txt", "depth.txt"))
    for time, image, depth, pose in zip(times, images, _nearest(depth_times, times), _nearest(poses[:, 0], times)):
        if min(depth, pose) >= 0:
            yield partial(
                make_frame, folder, image, depths[depth], poses[pose, 1:], intrinsics, f"{where}, time {time:.6f}",
                depth_unit=_TUM_UNIT,
            )  # fmt: skip


def _timed_files(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read a list of times and file names."""
    rows = [line.split(maxsplit=1) for line in read_lines(path)]
    return parse_numbers([row[0] for row in rows], path, (1,))[:, 0], [row[-1] for row in rows]


def _nearest(times: np.ndarray, wanted: np.ndarray) -> list[int]:
    """Return the position of the time that is nearest to each wanted one, -1 if none is within the tolerance."""
    tree = cKDTree(np.nan_to_num(times, nan=-1)[:, None])
    gaps, found = tree.query(np.nan_to_num(wanted, nan=-9)[:, None], distance_upper_bound=_TUM_TOLERANCE)
    return np.where(np.isfinite(gaps), found, -1).tolist()
