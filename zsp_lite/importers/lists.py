"""Reader of captures given as plain text lists.

rgb.txt, depth.txt: one file name per line; depth files are 16-bit PNGs or .npy
poses.txt: one camera-to-world matrix per line, 12 or 16 numbers in row-major order, in OpenCV's axes (+x right,
    +y down, +z forward)
intrinsics.txt: the 3 x 3 matrix K in pixels, with pixel centres at half-integers
masks/: if it is there, a mask file for each image, of the image's name with any extension
"""

from pathlib import Path

import numpy as np

from zsp_lite.data.frames import read_image
from zsp_lite.errors import MAX_LENGTH, InputError
from zsp_lite.importers.capture import CaptureFrame, camera_from_pose, files_by_stem
from zsp_lite.io.files import path_inside, read_bytes


def read_lists(folder: str | Path, depth_unit: float = 0.001) -> list[CaptureFrame]:
    """Read a capture: line n of each list describes frame n. `depth_unit` is in world units per stored depth value."""
    lists = {name: _read_lines(folder, name) for name in ("rgb.txt", "depth.txt", "poses.txt")}
    counts = {name: len(lines) for name, lines in lists.items()}
    if len(set(counts.values())) > 1 or not lists["rgb.txt"]:
        found = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InputError(f"capture {folder}: the lists have lines: {found}; expected equal numbers, at least 1")
    where = f"{folder}/intrinsics.txt"
    rows = [_numbers(text, where, (3,)) for text in _read_lines(folder, "intrinsics.txt")]
    if len(rows) != 3 or [*rows[2], rows[1][0], rows[0][1]] != [0, 0, 1, 0, 0] or min(rows[0][0], rows[1][1]) <= 0:
        raise InputError(f"intrinsics {where} are {rows}, expected fx 0 cx, 0 fy cy, 0 0 1 in pixels")
    (fx, _, cx), (_, fy, cy), _ = rows
    masks, size = files_by_stem(Path(folder) / "masks"), read_image(path_inside(folder, lists["rgb.txt"][0])).shape[:2]
    frames = []
    for number, (image, depth, numbers) in enumerate(zip(*lists.values()), 1):
        where = f"{folder}/poses.txt, line {number}"
        pose = np.array([*_numbers(numbers, where, (12, 16)), 0, 0, 0, 1][:16]).reshape(4, 4)
        image, depth = path_inside(folder, image), path_inside(folder, depth)
        camera = camera_from_pose(pose, (fx, fy, cx, cy), size, where)
        frames.append(CaptureFrame(image, depth, camera, depth_unit, mask=masks.get(image.stem)))
    return frames


def _read_lines(folder: str | Path, name: str) -> list[str]:
    """Read the lines of a text file, without comments (#) and empty lines."""
    text = read_bytes(path_inside(folder, name), "list").decode("utf-8", "replace")
    return [line for part in text.splitlines() if (line := part.split("#")[0].strip())]


def _numbers(text: str, where: str, counts: tuple[int, ...]) -> list[float]:
    """Convert a line to numbers; InputError if they are not as many as one of `counts`."""
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) not in counts or not all(abs(value) <= MAX_LENGTH for value in values):  # false for NaN too
        raise InputError(f"{where}: {text[:100]!r}, expected {' or '.join(map(str, counts))} finite numbers")
    return values
