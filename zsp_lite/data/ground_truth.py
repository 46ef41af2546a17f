"""Object poses of synthetic data, for evaluation only: the file object_poses.json of a category."""

from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError, rigid_matrix
from zsp_lite.io.files import read_json

# A file in each category folder: the pose of each sequence's object in the sequence's world.
POSES_FILE = "object_poses.json"
_Vector = tuple[float, float, float]
_Row = tuple[float, float, float, float]


class ObjectPose(msgspec.Struct):
    """Pose of an object, `world = scale * R @ object + t`, and its box in object coordinates."""

    trans: tuple[_Row, _Row, _Row, _Row]  # the matrix [R t]
    scale: float
    low: _Vector  # corners of the box
    high: _Vector
    # Turns about the up axis, in degrees, after which the shape is the same; 0 is not among them.
    turns: tuple[int, ...] = ()

    @property
    def R(self) -> Float[np.ndarray, "3 3"]:
        """Rotation from object to world."""
        return np.array(self.trans)[:3, :3]

    @property
    def t(self) -> Float[np.ndarray, "3"]:
        """Translation from object to world."""
        return np.array(self.trans)[:3, 3]

    def to_object(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Map world points to object coordinates: front +x, left +y, up +z, unit deviation."""
        return (np.asarray(world, np.float64) - self.t) @ self.R / self.scale

    def to_box(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Map world points to box coordinates, 0 to 1 along each object axis."""
        return (self.to_object(world) - self.low) / np.subtract(self.high, self.low)


def read_poses(out: Path, category: str) -> dict[str, ObjectPose]:
    """Return the object pose of every sequence of a category; none without the file."""
    path = out / category / POSES_FILE
    if not path.is_file():
        return {}
    poses = read_json(path, dict[str, ObjectPose], "object poses")
    for name, pose in poses.items():
        pose.trans = rigid_matrix(f"object poses {path}: {name}", pose.trans).tolist()
    return poses


def object_poses(dataset: Co3D, category: str) -> dict[str, ObjectPose]:
    """Read the object poses of a category; InputError if the folder is not a synthetic export."""
    poses = read_poses(dataset.root, category)
    if not poses:
        raise InputError(
            f"{dataset.root / category / POSES_FILE} is missing, expected a synthetic export: "
            "other data has no exact object poses"
        )
    return poses
