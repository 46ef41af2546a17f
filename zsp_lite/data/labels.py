"""Pose labels in the upstream form, and the ground-truth relative pose that they give with the cameras.

A label is a rigid motion (unit scale, column vectors) from the point cloud of the category's reference
sequence into the world of its own sequence; the reference sequence has the
identity. Files: ROOT/class_labels/CATEGORY/SEQ.json.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.data.annotations import decode
from zsp_lite.data.cameras import Camera
from zsp_lite.errors import InputError
from zsp_lite.io.files import plain_name, read_bytes, write_atomic

# Labels are printed numbers; what deviates more than this from a rotation is no rigid motion.
_RIGID_TOLERANCE = 1e-3

_Row = tuple[float, float, float, float]


class _LabelFile(msgspec.Struct):
    trans: tuple[_Row, _Row, _Row, _Row]
    seq: str
    reference_seq: str


@dataclass(frozen=True, eq=False)
class PoseLabel:
    """`trans` (4, 4) takes points of `reference_seq`'s cloud into `seq`'s world. InputError where it is not rigid."""

    trans: Float[np.ndarray, "4 4"]
    seq: str
    reference_seq: str

    def __post_init__(self):
        try:
            trans = np.array(self.trans, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"label of {self.seq} has trans {self.trans!r}, expected a 4x4 matrix") from error
        if trans.shape != (4, 4) or not np.isfinite(trans).all():
            raise InputError(f"label of {self.seq} has trans {trans.tolist()}, expected a finite 4x4 matrix")
        rotation = trans[:3, :3]
        deviation = max(np.abs(rotation @ rotation.T - np.eye(3)).max(), np.abs(trans[3] - (0, 0, 0, 1)).max())
        if deviation > _RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
            raise InputError(f"label of {self.seq} has trans {trans.tolist()}, expected a rigid motion of unit scale")
        object.__setattr__(self, "trans", trans)


def label_folder(root: str | Path, category: str) -> Path:
    """Where the category's labels are or would be: ROOT/class_labels, or upstream's
    ROOT/data/class_labels.
    """
    folders = [Path(root) / part / plain_name(category, "category") for part in ("class_labels", "data/class_labels")]
    return next((folder for folder in folders if folder.is_dir()), folders[0])


def read_labels(root: str | Path, category: str) -> dict[str, PoseLabel]:
    """The category's labels by sequence, sorted by name; {} where it has none.

    Raises InputError on a file that cannot be read, lacks a field, is not rigid, or speaks of another
    sequence than its name says.
    """
    labels = {}
    for path in sorted(label_folder(root, category).glob("*.json")):
        label = parse_label(read_bytes(path, "label"), str(path))
        if label.seq != path.stem:
            raise InputError(f"label {path} is of sequence {label.seq!r}, expected {path.stem!r} as its name says")
        labels[label.seq] = label
    return labels


def parse_label(data: bytes, where: str) -> PoseLabel:
    """A label file's content. Raises InputError, naming `where` it came from, on what `read_labels` refuses."""
    label = decode(data, _LabelFile, where)
    try:
        return PoseLabel(np.array(label.trans), label.seq, label.reference_seq)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def write_label(root: str | Path, category: str, label: PoseLabel) -> Path:
    """Write one label in one step, over an earlier one of the same sequence; returns the file's path."""
    path = label_folder(root, category) / f"{plain_name(label.seq, 'sequence')}.json"
    write_atomic(path, label_bytes(label))
    return path


def label_bytes(label: PoseLabel) -> bytes:
    """What a label's file holds, in the upstream JSON form."""
    content = {"trans": label.trans.tolist(), "seq": label.seq, "reference_seq": label.reference_seq}
    return json.dumps(content).encode()


def relative_pose(
    label_a: PoseLabel, camera_a: Camera, label_b: PoseLabel, camera_b: Camera
) -> Float[np.ndarray, "4 4"]:
    """Ground truth: what takes points of reference camera a's frame to target camera b's frame.

    `T_ab = Tcam_b @ T0b @ inv(T0a) @ inv(Tcam_a)` ("Labelling pose for evaluation" in the supplementary, which writes
    the composition from left to right). Raises InputError where the labels belong to different reference sequences.
    """
    if label_a.reference_seq != label_b.reference_seq:
        raise InputError(
            f"labels of {label_a.seq} and {label_b.seq} refer to {label_a.reference_seq} and "
            f"{label_b.reference_seq}, expected one reference sequence"
        )
    return camera_b.matrix @ label_b.trans @ np.linalg.inv(label_a.trans) @ np.linalg.inv(camera_a.matrix)
