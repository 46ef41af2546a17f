"""Open3D's RGB-D folders: color/ (or image/, rgb/), depth/ in millimetres, an intrinsic file and a trajectory log."""

import re
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import Capture, CaptureFrame, camera_from_pose, numbers, read_rows
from zsp_lite.io.files import read_bytes

_COLOURS = "color", "image", "rgb"
_INTRINSICS = "camera_intrinsic.json", "intrinsic.json", "camera_primesense.json"
_TRAJECTORIES = "trajectory.log", "scene/trajectory.log", "odometry.log"


class _Intrinsic(msgspec.Struct):
    width: int
    height: int
    intrinsic_matrix: list[float]  # column after column


def read_open3d(folder: str | Path) -> Capture:
    """Pictures and depth maps in the order of their names, the n-th of each with the n-th pose (camera to world).

    Depth is in millimetres, Open3D's default. Raises InputError where a part is missing or the numbers differ.
    """
    folder = Path(folder)
    colours = _images(folder, _COLOURS)
    depths = _images(folder, ("depth",))
    path = _first(folder, _INTRINSICS)
    given = decode(read_bytes(path, "intrinsic"), _Intrinsic, path)
    if len(given.intrinsic_matrix) != 9:
        raise InputError(f"intrinsic {path} has {len(given.intrinsic_matrix)} numbers in intrinsic_matrix, expected 9")
    matrix = np.array(given.intrinsic_matrix).reshape(3, 3).T
    trajectory = _first(folder, _TRAJECTORIES)
    poses = read_trajectory(trajectory)
    if not len(colours) == len(depths) == len(poses):
        raise InputError(
            f"capture {folder} has {len(colours)} pictures, {len(depths)} depth maps and {len(poses)} poses, "
            "expected equally many"
        )
    shots = []
    for number, (colour, depth, pose) in enumerate(zip(colours, depths, poses)):
        # Open3D's pixel centres are at whole numbers, ours at half ones.
        camera = camera_from_pose(pose, matrix.diagonal()[:2], matrix[:2, 2] + 0.5, (given.height, given.width),
                           f"{trajectory}, pose {number}")  # fmt: skip
        shots.append(CaptureFrame(colour, depth, camera, float(number)))
    return Capture(tuple(shots))


def read_trajectory(path: Path) -> list[Float[np.ndarray, "4 4"]]:
    """The poses of a .log file: for each a line of three numbers and four lines of a matrix."""
    rows = read_rows(path, 3, "trajectory")
    if not rows or len(rows) % 5:
        raise InputError(f"trajectory {path} has {len(rows)} lines, expected five for each pose")
    poses = []
    for start in range(0, len(rows), 5):
        lines = [numbers(words, f"trajectory {path}, line {number}") for number, words in rows[start + 1 : start + 5]]
        if any(len(line) != 4 for line in lines):
            raise InputError(f"trajectory {path}, line {rows[start][0]}: expected four lines of four numbers after it")
        poses.append(np.array(lines))
    return poses


def _images(folder: Path, names: tuple[str, ...]) -> list[Path]:
    for name in names:
        found = [path for path in (folder / name).glob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg")]
        if found:
            return sorted(found, key=_by_number)
    raise InputError(f"capture {folder} has no pictures in {', '.join(f'{name}/' for name in names)}")


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Sorts 2.jpg before 10.jpg."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part) if part.isdigit() else -1, part) for part in parts]


def _first(folder: Path, names: tuple[str, ...]) -> Path:
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"capture {folder} has none of {', '.join(names)}, expected one")
