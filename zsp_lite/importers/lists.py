"""Reader of captures given as plain text lists.

rgb.txt, depth.txt: one file name per line; depth files are 16-bit PNGs or .npy
poses.txt: one camera-to-world matrix per line, 12 or 16 numbers in row-major order, in OpenCV's axes (+x right,
    +y down, +z forward)
intrinsics.txt: the 3 x 3 matrix K in pixels, with pixel centres at half-integers
masks/: if it is there, a mask file for each image, of the image's name with any extension
"""

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


def read_lists(folder: str | Path, depth_unit: float = 0.001) -> list[CaptureFrame]:
    """Read a capture: line n of each list describes frame n. `depth_unit` is in world units per stored depth value.

    Raises:
        InputError: A list is missing or invalid, or the lists differ in length.
    """
    folder = Path(folder)
    columns = {"rgb.txt": 1, "depth.txt": 1, "poses.txt": 12}
    rows = {name: read_rows(path_inside(folder, name), count, "list") for name, count in columns.items()}
    counts = {name: len(found) for name, found in rows.items()}
    if len(set(counts.values())) > 1 or not counts["rgb.txt"]:
        found = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InputError(f"capture {folder}: the lists have lines: {found}; expected equal numbers, at least 1")
    matrix = _intrinsics(path_inside(folder, "intrinsics.txt"))
    masks = {path.stem: f"masks/{path.name}" for path in sorted((folder / "masks").glob("*"))}
    size, frames = None, []
    for (line, image), (_, depth), (pose_line, pose) in zip(*rows.values()):
        where = f"{folder / 'poses.txt'}, line {pose_line}"
        values = parse_numbers(pose, where)
        if len(values) not in (12, 16):
            raise InputError(f"{where}: {len(values)} numbers, expected 12 or 16")
        pose = np.eye(4)
        pose[: len(values) // 4] = np.array(values).reshape(-1, 4)
        path = listed_file(folder, image[0], f"{folder / 'rgb.txt'}, line {line}")
        size = size or image_size(path)
        camera = camera_from_pose(pose, matrix.diagonal()[:2], matrix[:2, 2], size, where)
        depth_path = listed_file(folder, depth[0], f"{folder / 'depth.txt'}, line {line}")
        mask = listed_file(folder, masks[path.stem], f"capture {folder}") if path.stem in masks else None
        frames.append(CaptureFrame(path, depth_path, camera, float(len(frames)), depth_unit, mask=mask))
    return frames


def _intrinsics(path: Path) -> np.ndarray:
    rows = [parse_numbers(words, f"{path}, line {line}") for line, words in read_rows(path, 3, "intrinsics")]
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        raise InputError(f"intrinsics {path} have {len(rows)} lines, expected a 3 x 3 matrix in pixels")
    matrix = np.array(rows)
    if (matrix[2] != (0, 0, 1)).any() or matrix[1, 0] or matrix[0, 1]:
        raise InputError(f"intrinsics {path} are {rows}, expected fx 0 cx, 0 fy cy, 0 0 1 in pixels")
    return matrix
