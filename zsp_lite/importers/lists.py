"""Captures given as text lists: a line per frame in each, and TUM's RGB-D benchmark with times."""

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from zsp_lite.data.cameras import Values
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import (
    PRIMESENSE,
    Makers,
    make_frame,
    read_numbers,
    read_text_lines,
    refuse,
)

_TUM_UNIT = 1 / 5000  # metres per stored depth value
_TUM_TOLERANCE = 0.02  # seconds between an image and its depth


def read_lists(folder: Path) -> Makers:
    """Read text lists, of which line n describes frame n (see `zsp-lite data import -h`)."""
    images = read_text_lines(folder / "rgb.txt")
    depths = read_text_lines(folder / "depth.txt")
    poses = read_numbers(folder / "poses.txt", (12, 16))
    # Three lines of K; or lines of fx, fy, cx, cy and 0, 4, 5 or 8 coefficients of distortion.
    intrinsics = read_numbers(folder / "intrinsics.txt", (3, 4, 8, 9, 12))
    if intrinsics.shape[1] == 3 and len(intrinsics) != 3:
        raise InputError(
            f"{folder}/intrinsics.txt has {len(intrinsics)} lines of 3 numbers, expected K in 3 "
            "lines, or fx, fy, cx, cy in each"
        )
    if intrinsics.shape[1] == 3 or len(intrinsics) == 1:
        intrinsics = [intrinsics.squeeze()] * len(images)
    if len(set(images)) < len(images):
        raise InputError(f"{folder}/rgb.txt names a picture twice, expected another in each line")
    lines = [*map(len, (images, depths, poses, intrinsics))]
    if len(set(lines)) > 1:
        raise InputError(
            f"capture {folder}: rgb.txt, depth.txt, poses.txt and the intrinsics have {lines} "
            "lines, expected equal numbers"
        )
    for line, names in enumerate(zip(images, depths)):
        where = f"capture {folder}, line {line + 1} of the lists"
        yield partial(
            make_frame,
            folder,
            *names,
            poses[line],
            intrinsics[line][:4],
            where,
            distortion=intrinsics[line][4:],
        )


def read_tum(folder: Path, intrinsics: Values | None = None) -> Makers:
    """Read a sequence of TUM's RGB-D benchmark: images with the nearest depth and pose in time."""
    camera = PRIMESENSE if intrinsics is None else {"intrinsics": intrinsics}
    poses = read_numbers(folder / "groundtruth.txt", (8,))
    times, images = _read_times(folder / "rgb.txt")
    depth_times, depths = _read_times(folder / "depth.txt")
    for time, image, depth, pose in zip(
        times, images, _nearest(depth_times, times), _nearest(poses[:, 0], times)
    ):
        if min(depth, pose) < 0:
            yield partial(refuse, f"{image} has no depth or no pose within {_TUM_TOLERANCE} s")
            continue
        yield partial(
            make_frame,
            folder,
            image,
            depths[depth],
            poses[pose, 1:],
            where=f"{folder}, time {time:.6f}",
            depth_unit=_TUM_UNIT,
            **camera,
        )


def _read_times(path: Path) -> tuple[np.ndarray, list[str]]:
    """Read the times and names of a list of files."""
    names = [line.split(maxsplit=1)[-1] for line in read_text_lines(path)]
    return read_numbers(path, (1,), usecols=0)[:, 0], names


def _nearest(times: np.ndarray, wanted: np.ndarray) -> list[int]:
    """Return the position of the time nearest to each wanted one, -1 beyond the tolerance."""
    # NaN becomes -1 s or -9 s, which are far from each other and from all times.
    tree = cKDTree(np.nan_to_num(times, nan=-1)[:, None])
    gaps, nearest = tree.query(
        np.nan_to_num(wanted, nan=-9)[:, None], distance_upper_bound=_TUM_TOLERANCE
    )
    return np.where(np.isfinite(gaps), nearest, -1).tolist()
