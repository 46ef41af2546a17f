"""CSV files exchanged with another program: pairs and poses.

docs/benchmark_your_own.md has the columns of both.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.evaluation import true_poses
from zsp_lite.errors import (
    InputError,
    check_choice,
    check_magnitude,
    check_number,
    real_array,
    rotation_matrix,
)
from zsp_lite.io.files import digest, read_bytes, write_atomic
from zsp_lite.metrics import rotation_error

_REQUIRED = ("pair", "target_frame", "rotation")  # columns that a file of poses must have
_CHANCE = 0.01  # another convention is named if the p value of a sign test is at most this


class StoredPose(NamedTuple):
    """Pose of the reference object in the camera of a target frame."""

    line: int  # number of its line in the file
    target_frame: int
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"] | None  # in the target's unit
    scale: float | None


def write_questions(path: str | Path, dataset: Co3D, pairs: Sequence[Pair]) -> Path:
    """Write pairs, with a line for each frame."""
    lines = []
    for pair in pairs:
        for index, (sequence, frame) in enumerate(pair.frames):
            annotation = dataset.frame(pair.category, sequence, frame)
            depth = annotation.depth
            mask = annotation.mask
            camera = dataset.camera(annotation)
            fx, fy = camera.focal_length.tolist()
            cx, cy = camera.principal_point.tolist()
            lines.append(
                {
                    "pair": pair.key,
                    "role": "target" if index else "reference",
                    "category": pair.category,
                    "sequence": sequence,
                    "frame": frame,
                    "image": annotation.image.path,
                    "depth": depth.path if depth else None,
                    "depth_scale": depth.scale_adjustment if depth else None,
                    "mask": mask.path if mask else None,
                    "fx": fx,
                    "fy": fy,
                    "cx": cx,
                    "cy": cy,
                    "R": " ".join(map(repr, camera.R.ravel().tolist())),
                    "t": " ".join(map(repr, camera.t.tolist())),
                }
            )
    write_atomic(path, pd.DataFrame(lines).to_csv(index=False, lineterminator="\n").encode())
    return Path(path)


def read_stored_poses(path: str | Path) -> tuple[dict[str, StoredPose], str]:
    """Read poses by the key of their pair, and the hash of the file."""
    data = read_bytes(path, "poses")
    poses = {}
    for number, line in _read_lines(path, data):
        try:
            key = line["pair"].strip()
            pose = _read_pose(number, line)
            if key in poses:
                raise ValueError(f"second pose of the pair of line {poses[key].line}")
        except ValueError as error:  # an InputError is one, too
            raise InputError(f"poses {path}, line {number}: {error}") from error
        poses[key] = pose
    return poses, digest(data)


def _read_lines(path: str | Path, data: bytes) -> list[tuple[int, dict]]:
    """Read the lines of a CSV file that are not blank, each with its number."""
    try:
        # A redirection in PowerShell writes UTF-16 with its byte-order mark.
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
        # A spreadsheet may separate fields by semicolons or tabulators.
        header = text.partition("\n")[0]
        mark = next((mark for mark in ";\t" if mark in header), ",")
        reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=mark, restval="")
        reader.fieldnames = ["_".join(name.lower().split()) for name in reader.fieldnames or ()]
        # The reader skips blank lines, so that their position in its output is no line number. The
        # blank lines of a spreadsheet have separators: all their fields are empty.
        lines = [(reader.reader.line_num, line) for line in reader if any(line.values())]
    except (ValueError, csv.Error) as error:
        raise InputError(f"poses {path}: {error}, expected a CSV file") from error
    wrong = [name for name in _REQUIRED if reader.fieldnames.count(name) != 1]
    if wrong:
        raise InputError(
            f"poses {path}: no or two columns {', '.join(wrong)}, expected a CSV file with "
            "one of each"
        )
    return lines


def _read_pose(number: int, line: dict) -> StoredPose:
    """Read the pose of a line; ValueError for a wrong field."""
    # The reader gives surplus fields the name None.
    if any(line.pop(None, ())):
        raise ValueError("more fields than the header; a pair has commas and needs quotes")
    rotation = rotation_matrix("rotation", _numbers("rotation", line["rotation"], 9).reshape(3, 3))
    translation = line.get("translation", "").strip()
    translation = _numbers("translation", translation, 3) if translation else None
    scale = line.get("scale", "").strip()
    scale = float(_numbers("scale", scale, 1)[0]) if scale else None
    if scale is not None:
        check_number("scale", scale, above=0)
    return StoredPose(number, int(line["target_frame"]), rotation, translation, scale)


def _numbers(name: str, text: str, size: int) -> np.ndarray:
    """Read the numbers of a field, with decimal points or decimal commas."""
    values = real_array(name, np.array(text.replace(",", ".").split(), float), (size,))
    check_magnitude(name, values)
    return values


def check_poses(
    path: str | Path, poses: Mapping[str, StoredPose], dataset: Co3D, pairs: Sequence[Pair]
) -> str:
    """Say how many of the poses have no pair, and which convention fits better.

    InputError if no pose is of any of the pairs, or if one is in none of its pair's target frames.
    """
    pose_of = {pair: poses[pair.key] for pair in pairs if pair.key in poses}
    if not pose_of:
        raise InputError(f"{path} has no pose for any of the pairs of --list-pairs")
    for pair, pose in pose_of.items():
        check_choice(
            f"poses {path}, line {pose.line}: target_frame", pose.target_frame, pair.target_frames
        )
    surplus = len(poses) - len(pose_of)
    remarks = [
        f"{surplus} of {len(poses)} poses fit no pair" if surplus else "",
        other_convention(dataset, pose_of),
    ]
    return "; ".join(filter(None, remarks))


def other_convention(dataset: Co3D, poses: Mapping[Pair, StoredPose]) -> str:
    """Name another convention by which rotations clearly agree with the labels, or return "".

    Other programs may write inverse rotations, or rotations between cameras with OpenGL's or
    PyTorch3D's axes.
    """
    views = [pair.target_frames.index(pose.target_frame) for pair, pose in poses.items()]
    truths = true_poses(dataset.root, list(poses), np.array(views))[:, :3, :3]
    given = np.stack([pose.rotation for pose in poses.values()])
    # The rotations, (n, 3, 3), as each convention reads them; "" is the documented convention.
    readings = {"": given}
    for signs in ((1, -1, -1), (-1, -1, 1)):
        readings[f"conjugated by diag{signs}"] = given * np.outer(signs, signs)
    for name, rotations in list(readings.items()):
        readings[f"inverted and {name}".removesuffix(" and ")] = rotations.swapaxes(1, 2)
    errors = {name: rotation_error(rotations, truths) for name, rotations in readings.items()}
    medians = {name: float(np.median(error)) for name, error in errors.items()}
    best = min(medians, key=medians.get)
    # Imported here: it takes half a second.
    from scipy.stats import binom

    # The errors of a wrong reading may be small by chance, as for rotations by small angles: a sign
    # test decides whether more pairs agree with the other reading than chance explains.
    by_chance = binom.sf((errors[best] < errors[""]).sum() - 1, len(truths), 1 / 2)
    # The other reading is named if its median is at most half as large, and at most 30 degrees.
    if medians[best] > min(30, medians[""] / 2) or by_chance > _CHANCE:
        return ""
    return (
        f"rotations agree with the labels if {best}: median {medians[best]:.0f}° in place of "
        f"{medians['']:.0f}°"
    )
