"""CSV files that are exchanged with another program: the frames of pairs, and the poses that it finds for them.

docs/benchmark_your_own.md has the columns of both.
"""

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import binom

from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import read_labels, relative_pose
from zsp_lite.errors import InputError, check_magnitude, real_array, rotation_matrix
from zsp_lite.io.files import digest, read_bytes, write_atomic
from zsp_lite.metrics import rotation_error

PairKey = tuple[str, str, int, str, int]  # category, reference sequence and frame, target sequence and frame
_KEY = ("category", "reference_sequence", "reference_frame", "target_sequence", "target_frame")
_AXES = {"": (1, 1, 1), "in OpenGL's axes": (1, -1, -1), "in PyTorch3D's axes": (-1, -1, 1)}  # OpenCV's in others


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
        text = data.decode("utf-8-sig")
        mark = next((mark for mark in ";\t" if mark in text.partition("\n")[0]), ",")
        reader = csv.DictReader(io.StringIO(text, newline=""), delimiter=mark, restval="")
        reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
        lines = [(reader.reader.line_num, line) for line in reader]  # its own is wrong after a blank line
    except (ValueError, csv.Error) as error:
        raise InputError(f"poses {path}: {error}, expected a CSV file") from error
    if missing := [name for name in (*_KEY, "rotation") if name not in (reader.fieldnames or ())]:
        raise InputError(f"poses {path}: no column {', '.join(missing)}, expected a CSV file with these")
    for number, line in lines:
        try:
            if None in line:
                raise ValueError(f"more than the {len(reader.fieldnames)} fields of the header")
            rotation = rotation_matrix("rotation", _numbers("rotation", line["rotation"], 9).reshape(3, 3))
            translation, scale = (line.get(name, "").strip() for name in ("translation", "scale"))
            translation = _numbers("translation", translation, 3) if translation else None
            scale = float(_numbers("scale", scale, 1)[0]) if scale else None
            key = tuple(int(line[name]) if name.endswith("frame") else line[name].strip() for name in _KEY)
            if key in poses:
                raise ValueError("second pose of the same frames")
            poses[key] = StoredPose(rotation, translation, scale)
        except ValueError as error:  # an InputError is one, too
            raise InputError(f"poses {path}, line {number}: {error}") from error
    return poses, digest(data)


def _numbers(name: str, text: str, size: int) -> np.ndarray:
    """Read the numbers of a field; a comma in one is its decimal point."""
    values = real_array(name, np.array(text.replace(",", ".").split(), float), (size,))
    check_magnitude(name, values)
    return values


def fit_poses(
    path: str | Path, poses: Mapping[PairKey, StoredPose], dataset: Co3D, pairs: Sequence[Pair]
) -> tuple[dict[PairKey, StoredPose], str]:
    """Return the poses of pairs, and a remark: how many poses have no pair, and a convention that fits better.

    Sequences may lack the leading zeros, which a spreadsheet removes. InputError if such a name fits two, or no pose a
    pair.
    """
    asked = {
        (pair.category, pair.reference_sequence, pair.reference_frame, pair.target_sequence, number)
        for pair in pairs for number in pair.target_frames
    }  # fmt: skip
    sequences = {(key[0], name) for key in asked for name in key[1::2]}
    full: dict[tuple[str, str], list[str]] = {}
    for category, name in sorted(sequences):
        full.setdefault((category, name.lstrip("0")), []).append(name)
    fitting = {}
    for (category, first, number, second, target), pose in poses.items():
        ends = []
        for name in (first, second):
            found = [name] if (category, name) in sequences else full.get((category, name.lstrip("0")), [name])
            if len(found) > 1:
                told = f"sequence {category}/{name} is {' or '.join(found)} without leading zeros"
                raise InputError(f"poses {path}: {told}, expected a name as in pairs.csv")
            ends += found
        key = category, ends[0], number, ends[1], target
        if key in asked:
            fitting[key] = pose
    if not fitting:
        raise InputError(f"{path} has no pose for any of the {len(pairs)} pairs of --list-pairs")
    remarks = [f"{len(poses) - len(fitting)} of {len(poses)} poses fit no pair"] if len(fitting) < len(poses) else []
    truths, labels = [], {category: read_labels(dataset.root, category) for category in {key[0] for key in fitting}}
    for category, first, number, second, target in sorted(fitting):
        reference, other = (
            dataset.camera(dataset.frame(category, *end)) for end in ((first, number), (second, target))
        )
        truths.append(relative_pose(labels[category][first], reference, labels[category][second], other)[:3, :3])
    rotations = np.stack([pose.rotation for _, pose in sorted(fitting.items(), key=lambda one: one[0])])
    return fitting, "; ".join(filter(None, [*remarks, _better_reading(rotations, np.stack(truths))]))


def _better_reading(rotations: Float[np.ndarray, "n 3 3"], truths: Float[np.ndarray, "n 3 3"]) -> str:
    """Tell which other convention clearly makes rotations agree with the labels; "" if none does."""
    errors = {}
    for axes, signs in _AXES.items():
        read = rotations * np.outer(signs, signs)
        errors[axes] = rotation_error(read, truths)
        errors[" and ".join(filter(None, ["inverted", axes]))] = rotation_error(read.swapaxes(1, 2), truths)
    medians = {reading: np.median(error) for reading, error in errors.items()}
    best = min(medians, key=medians.get)
    # A sixth of turns about the up axis at random is below 30 degrees.
    chance = binom.sf((errors[best] < 30).sum() - 1, len(truths), 1 / 6)
    if not (medians[best] < min(30, medians[""] / 2) and chance < 5e-4):
        return ""
    return (
        f"rotations agree with the labels if {best}: median error {medians[best]:.0f}° in place of {medians['']:.0f}°"
    )
