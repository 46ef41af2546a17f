"""Pose labels in the format of the published code, and ground-truth relative poses.

The label of a sequence is a rigid transform (column vectors) from the world of the category's
reference sequence to the world of the sequence; the label of the reference sequence is the
identity. Files: ROOT/class_labels/CATEGORY/SEQ.json.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError, rigid_matrix
from zsp_lite.io.files import plain_name, read_json

_Row = tuple[float, float, float, float]


class _LabelFile(msgspec.Struct):
    trans: tuple[_Row, _Row, _Row, _Row]
    seq: str
    reference_seq: str


@dataclass(frozen=True, eq=False)
class PoseLabel:
    """Rigid transform from the world of the sequence `reference_seq` to that of `seq`."""

    trans: Float[np.ndarray, "4 4"]
    seq: str
    reference_seq: str

    def __post_init__(self):
        object.__setattr__(self, "trans", np.array(self.trans, dtype=np.float64))


def label_folder(root: str | Path, category: str) -> Path:
    """Return ROOT/class_labels/CATEGORY."""
    return Path(root) / "class_labels" / plain_name(category, "category")


def read_labels(root: str | Path, category: str) -> dict[str, PoseLabel]:
    """Read the labels of a category by sequence, sorted by name."""
    return read_label_folder(label_folder(root, category))


def read_label_folder(folder: Path) -> dict[str, PoseLabel]:
    """Read the labels in a folder by sequence; InputError if they have several references."""
    labels = read_label_files(folder)
    check_one_reference(folder, labels)
    return labels


def read_label_files(folder: Path) -> dict[str, PoseLabel]:
    """Read the labels in a folder by sequence, whatever their references."""
    return {path.stem: read_label(path) for path in sorted(folder.glob("*.json"))}


def check_one_reference(folder: Path, labels: Mapping[str, PoseLabel]) -> None:
    """Raise InputError if the labels for a folder have several reference sequences."""
    references = sorted({label.reference_seq for label in labels.values()})
    if len(references) > 1:
        raise InputError(
            f"labels in {folder} have reference sequences {', '.join(references)}, expected one"
        )


def read_label(path: Path) -> PoseLabel:
    """Read a label file; InputError if it is damaged, not rigid, or of another sequence.

    The name of the file is that of the sequence.
    """
    label = read_json(path, _LabelFile, "label")
    if label.seq != path.stem:
        raise InputError(f"label {path} has seq {label.seq!r}, expected seq as in its name")
    return PoseLabel(
        rigid_matrix(f"label {path}: trans", label.trans), label.seq, label.reference_seq
    )


def relative_pose(
    label_a: PoseLabel, camera_a: Camera, label_b: PoseLabel, camera_b: Camera
) -> Float[np.ndarray, "4 4"]:
    """Compute the true pose, for column vectors, from the frame of camera a to that of camera b.

    It leads from camera a to the world of its sequence, by label a to the world of the category's
    reference sequence, by label b to the world of the other sequence, and to camera b. This is the
    composition in "Labelling pose for evaluation" of the supplement, which writes it from left to
    right. Both labels have the same `reference_seq`.
    """
    return (
        camera_b.matrix
        @ label_b.trans
        @ np.linalg.inv(label_a.trans)
        @ np.linalg.inv(camera_a.matrix)
    )
