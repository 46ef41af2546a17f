"""Reader of captures given as plain text lists.

rgb.txt, depth.txt: one file name per line; depth files are 16-bit PNGs or .npy
poses.txt: one camera-to-world matrix per line, 12 or 16 numbers in row-major order, in OpenCV's axes (+x right,
    +y down, +z forward)
intrinsics.txt: the 3 x 3 matrix K in pixels, with pixel centres at half-integers
masks/: if it is there, a mask file for each image, of the image's name with any extension
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsp_lite.data.frames import read_image
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import CaptureFrame, camera_from_pose, files_by_stem
from zsp_lite.io.files import path_inside, read_bytes


def read_lists(folder: str | Path, depth_unit: float = 0.001) -> list[CaptureFrame]:
    """Read a capture: line n of each list describes frame n. `depth_unit` is in world units per stored depth value."""
    lists = {name: _read_lines(folder, name) for name in ("rgb.txt", "depth.txt", "poses.txt")}
    counts = {name: len(lines) for name, lines in lists.items()}
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InputError(f"capture {folder}: the lists have lines: {found}; expected equal numbers")
    K = _numbers(_read_lines(folder, "intrinsics.txt"), f"{folder}/intrinsics.txt", (3,))
    if K.shape != (3, 3) or K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]].tolist() != [0, 0, 0, 0, 1]:
        raise InputError(f"{folder}/intrinsics.txt is {K.tolist()}, expected fx 0 cx, 0 fy cy, 0 0 1 in pixels")
    intrinsics = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    poses = _numbers(lists["poses.txt"], f"{folder}/poses.txt", (12, 16))
    masks, size = files_by_stem(Path(folder) / "masks"), read_image(path_inside(folder, lists["rgb.txt"][0])).shape[:2]
    frames = []
    for number, (image, depth, pose) in enumerate(zip(lists["rgb.txt"], lists["depth.txt"], poses), 1):
        image, depth = path_inside(folder, image), path_inside(folder, depth)
        matrix = np.array([*pose, 0, 0, 0, 1][:16]).reshape(4, 4)
        camera = camera_from_pose(matrix, intrinsics, size, f"capture {folder}, line {number} of the lists")
        frames.append(CaptureFrame(image, depth, camera, depth_unit, mask=masks.get(image.stem)))
    return frames


def _read_lines(folder: str | Path, name: str) -> list[str]:
    """Read the lines of a text file, without comments (#) and empty lines."""
    text = read_bytes(path_inside(folder, name), "list").decode("utf-8", "replace")
    if not (lines := [line for part in text.splitlines() if (line := part.split("#")[0].strip())]):
        raise InputError(f"{folder}/{name} is empty, expected at least 1 line")
    return lines


def _numbers(lines: list[str], where: str, columns: tuple[int, ...]) -> Float[np.ndarray, "rows columns"]:
    """Convert lines to numbers, as many in each as one of `columns`."""
    try:
        values = np.loadtxt(lines, ndmin=2)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error
    if values.shape[1] not in columns:
        raise InputError(f"{where}: {values.shape[1]} numbers per line, expected {' or '.join(map(str, columns))}")
    return values
