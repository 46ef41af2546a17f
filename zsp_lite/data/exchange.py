"""CSV files that are exchanged with another program: the frames of pairs, and the poses that it finds for them.

docs/benchmark_your_own.md has the columns of both.
"""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.errors import InputError, check_magnitude, real_array
from zsp_lite.io.files import digest, read_bytes, write_atomic

PairKey = tuple[str, str, int, str, int]  # category, reference sequence and frame, target sequence and frame
_KEY = ("category", "reference_sequence", "reference_frame", "target_sequence", "target_frame")


class StoredPose(NamedTuple):
    """Pose of the reference object in the camera of a target frame."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"] | None  # in the target's unit
    scale: float | None


def write_questions(path: str | Path, dataset: Co3D, pairs: Sequence[Pair]) -> Path:
    """Write pairs, with a line for each frame."""
    lines = []
    for number, pair in enumerate(pairs):
        targets = [("target", pair.target_sequence, frame) for frame in pair.target_frames]
        for role, sequence, frame in [("reference", pair.reference_sequence, pair.reference_frame), *targets]:
            found = dataset.frame(pair.category, sequence, frame)
            camera, depth, mask = dataset.camera(found), found.depth, found.mask
            (fx, fy), (cx, cy) = camera.focal_length.tolist(), camera.principal_point.tolist()
            R, t = (" ".join(map(repr, part.ravel().tolist())) for part in (camera.R, camera.t))
            lines.append({
                "pair": number, "role": role, "category": pair.category, "sequence": sequence, "frame": frame,
                "image": found.image.path, "depth": depth and depth.path,
                "depth_scale": depth and depth.scale_adjustment, "mask": mask and mask.path,
                "fx": fx, "fy": fy, "cx": cx, "cy": cy, "R": R, "t": t,
            })  # fmt: skip
    text = io.StringIO()
    writer = csv.DictWriter(text, lines[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    write_atomic(path, text.getvalue().encode())
    return Path(path)


def read_poses(path: str | Path) -> tuple[dict[PairKey, StoredPose], str]:
    """Read poses, with a line for each pair, and the hash of the file."""
    data, poses = read_bytes(path, "poses"), {}
    try:
        reader = csv.DictReader(io.StringIO(data.decode("utf-8-sig"), newline=""), restval="")
        lines = [(reader.reader.line_num, line) for line in reader]  # its own is wrong after a blank line
    except (ValueError, csv.Error) as error:
        raise InputError(f"poses {path}: {error}, expected a CSV file") from error
    if missing := [name for name in (*_KEY, "rotation") if name not in (reader.fieldnames or ())]:
        raise InputError(f"poses {path}: no column {', '.join(missing)}, expected a CSV file with these")
    for number, line in lines:
        try:
            if None in line:
                raise ValueError(f"more than the {len(reader.fieldnames)} fields of the header")
            rotation = Sim3(1.0, _numbers("rotation", line["rotation"], 9).reshape(3, 3), np.zeros(3)).R
            translation, scale = (line.get(name, "") for name in ("translation", "scale"))
            translation = _numbers("translation", translation, 3) if translation else None
            scale = float(_numbers("scale", scale, 1)[0]) if scale else None
            key = tuple(int(line[name]) if name.endswith("frame") else line[name] for name in _KEY)
            if key in poses:
                raise ValueError("second pose of the same frames")
            poses[key] = StoredPose(rotation, translation, scale)
        except ValueError as error:  # an InputError is one, too
            raise InputError(f"poses {path}, line {number}: {error}") from error
    return poses, digest(data)


def _numbers(name: str, text: str, size: int) -> np.ndarray:
    """Read the numbers of a field."""
    values = real_array(name, np.array(text.split(), float), (size,))
    check_magnitude(name, values)
    return values
