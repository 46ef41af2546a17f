"""Reader of Open3D's RGB-D folders: color/ (or image/, rgb/), depth/, intrinsics as JSON, and a trajectory log."""

import re
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import (
    HALF_PIXEL,
    CaptureFrame,
    camera_from_pose,
    listed_file,
    parse_numbers,
    read_rows,
)
from zsp_lite.io.files import path_inside, read_bytes

_COLOURS = "color", "image", "rgb"
_INTRINSICS = "camera_intrinsic.json", "intrinsic.json", "camera.json", "camera_primesense.json"
_TRAJECTORIES = "trajectory.log", "scene/trajectory.log", "odometry.log"


class _Intrinsic(msgspec.Struct):
    width: int
    height: int
    intrinsic_matrix: list[float]  # column-major


def read_open3d(folder: str | Path) -> list[CaptureFrame]:
    """Read a capture: image, depth map and camera-to-world pose number n form frame n.

    Images and depth maps are sorted by the numbers in their names. Depth is in millimetres, Open3D's default. The
    intrinsics file has pixel centres at integers, as Open3D writes it.

    Raises:
        InputError: A part is missing or invalid, or the numbers of images, depth maps and poses differ.
    """
    folder = Path(folder)
    colours = _images(folder, _COLOURS)
    depths = _images(folder, ("depth",))
    path = _first(folder, _INTRINSICS)
    given = decode(read_bytes(path, "intrinsic"), _Intrinsic, path)
    if len(given.intrinsic_matrix) != 9:
        raise InputError(f"intrinsic {path} has {len(given.intrinsic_matrix)} numbers in intrinsic_matrix, expected 9")
    matrix = np.array(given.intrinsic_matrix).reshape(3, 3).T + HALF_PIXEL
    trajectory = _first(folder, _TRAJECTORIES)
    poses = read_trajectory(trajectory)
    if not len(colours) == len(depths) == len(poses):
        raise InputError(
            f"capture {folder} has {len(colours)} images, {len(depths)} depth maps and {len(poses)} poses, "
            "expected equal numbers"
        )
    frames = []
    for number, (colour, depth, pose) in enumerate(zip(colours, depths, poses, strict=True)):
        size, where = (given.height, given.width), f"{trajectory}, pose {number}"
        camera = camera_from_pose(pose, matrix.diagonal()[:2], matrix[:2, 2], size, where)
        frames.append(CaptureFrame(colour, depth, camera, float(number)))
    return frames


def read_trajectory(path: Path) -> list[Float[np.ndarray, "4 4"]]:
    """Read the (4, 4) poses of a .log file: per pose a line of three integers and four lines of a matrix."""
    rows = read_rows(path, 3, "trajectory")
    if not rows or len(rows) % 5:
        raise InputError(f"trajectory {path} has {len(rows)} lines, expected five per pose")
    poses = []
    for start in range(0, len(rows), 5):
        lines = [
            parse_numbers(words, f"trajectory {path}, line {number}") for number, words in rows[start + 1 : start + 5]
        ]
        if any(len(line) != 4 for line in lines):
            raise InputError(f"trajectory {path}, line {rows[start][0]}: expected four lines of four numbers below it")
        poses.append(np.array(lines))
    return poses


def _images(folder: Path, names: tuple[str, ...]) -> list[Path]:
    for name in names:
        found = [path for path in (folder / name).glob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg")]
        if found:
            files = [listed_file(folder, f"{name}/{path.name}", f"capture {folder}") for path in found]
            return sorted(files, key=_by_number)
    raise InputError(f"capture {folder} has no pictures in {', '.join(f'{name}/' for name in names)}")


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Sort key by the numbers in a name: 2.jpg before 10.jpg."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part) if part.isdigit() else -1, part) for part in parts]


def _first(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        if (folder / name).is_file():
            return path_inside(folder, name)
    raise InputError(f"capture {folder} has none of {', '.join(names)}, expected one")
