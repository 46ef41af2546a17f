"""Recording of one object as a sequence of a data folder, with object pose, labels and evaluation pairs."""

import json
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from zsp_lite.data.co3d import Co3D, SequenceData, write_co3d
from zsp_lite.data.labels import PoseLabel, write_label
from zsp_lite.data.pairs import pairs_path, sample_pairs, write_published_pairs
from zsp_lite.io.files import read_json, write_atomic
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.sequences import RenderedSequence

POSES_FILE = "object_poses.json"  # in each category folder: the pose of each sequence's object in its world
_JPEG_QUALITY = 88
_Vector = tuple[float, float, float]
_Row = tuple[float, float, float, float]


class ObjectPose(msgspec.Struct):
    """Pose of an object in its world, `world = scale * R @ object + t`, and its bounding box in object coordinates."""

    trans: tuple[_Row, _Row, _Row, _Row]  # the matrix [R t]
    scale: float
    low: _Vector  # corners of the box
    high: _Vector
    turns: tuple[int, ...] = ()  # about the up axis, in degrees, after which the shape is the same; 0 is not among them

    @property
    def R(self) -> Float[np.ndarray, "3 3"]:
        return np.array(self.trans)[:3, :3]

    @property
    def t(self) -> Float[np.ndarray, "3"]:
        return np.array(self.trans)[:3, 3]

    def to_object(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Map world points to object coordinates (front +x, left +y, up +z, surface of unit standard deviation)."""
        return (np.asarray(world, np.float64) - self.t) @ self.R / self.scale

    def to_box(self, world: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Map world points to box coordinates, 0 to 1 along each object axis."""
        return (self.to_object(world) - self.low) / np.subtract(self.high, self.low)


def write_sequence(
    out: Path, category: str, mesh: TexturedMesh, recorded: tuple[SequenceData, RenderedSequence]
) -> None:
    """Add a recorded sequence to a data folder; its pose is written last, so that a sequence with one is complete."""
    data, exact = recorded
    write_co3d(out, category, [data], _JPEG_QUALITY)
    low, high = mesh.vertices.min(0).tolist(), mesh.vertices.max(0).tolist()
    poses = read_poses(out, category)
    poses[data.name] = ObjectPose(exact.object_pose.tolist(), exact.scale, low, high, shape_turns(mesh.vertices))
    write_atomic(out / category / POSES_FILE, json.dumps(msgspec.to_builtins(poses), indent=1).encode())


def shape_turns(vertices: Float[np.ndarray, "v 3"]) -> tuple[int, ...]:
    """Return the quarter turns about the up axis, in degrees, after which the vertices are the same within 3 %."""
    points = vertices - (vertices.min(0) + vertices.max(0)) / 2
    x, y, z = points.T
    turned = {90: (-y, x, z), 180: (-x, -y, z), 270: (y, -x, z)}
    distance = {turn: KDTree(points).query(np.stack(one, 1))[0].max() for turn, one in turned.items()}
    return tuple(turn for turn, farthest in distance.items() if farthest < 0.03 * np.ptp(points))


def read_poses(out: Path, category: str) -> dict[str, ObjectPose]:
    """Return the object pose of every sequence of a category; none without the file."""
    path = out / category / POSES_FILE
    return read_json(path, dict[str, ObjectPose], "object poses") if path.is_file() else {}


def write_labels(out: Path, category: str, names: Iterable[str]) -> None:
    """Write the pose labels of sequences from their object poses; the first name is the reference."""
    poses = {name: np.array(pose.trans) for name, pose in read_poses(out, category).items()}
    reference, *others = names
    write_label(out, category, PoseLabel(np.eye(4), reference, reference))
    for name in others:
        # Rounded, to be equal on all processors, and without negative zeros.
        trans = np.round(poses[name] @ np.linalg.inv(poses[reference]), 12) + 0.0
        write_label(out, category, PoseLabel(trans, name, reference))


def write_pairs(out: Path, category: str, pairs: int, targets: Iterable[int], seed: int) -> None:
    """Sample evaluation pairs, a file per number of target views, in the format of the published evaluation."""
    dataset = Co3D(out)
    for n_targets in targets:
        sampled = sample_pairs(dataset, category, pairs, n_targets, seed)
        write_published_pairs(pairs_path(out, category, pairs, n_targets), sampled, dataset)
