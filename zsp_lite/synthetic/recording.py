"""Recording of one object as a sequence of a data folder, with object pose, labels and evaluation pairs."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from zsp_lite.data.co3d import Co3D, SequenceData, write_co3d
from zsp_lite.data.labels import PoseLabel, write_label
from zsp_lite.data.pairs import pairs_path, sample_pairs, write_published_pairs
from zsp_lite.errors import check_integer
from zsp_lite.io.files import read_json, write_atomic
from zsp_lite.synthetic.meshes import TexturedMesh
from zsp_lite.synthetic.sensor import simulate_capture
from zsp_lite.synthetic.sequences import HEIGHTS, RenderedSequence, render_sequence

POSES_FILE = "object_poses.json"  # in each category folder: the pose of each sequence's object in its world
_JPEG_QUALITY = 88


def check_settings(frames: int, image_size: int, seed: int) -> None:
    """Raise InputError if the number of frames, the shorter image side or the seed is out of its range."""
    check_integer("frames", frames, 1, 10_000)
    check_integer("image_size", image_size, 32, 4096)
    check_integer("seed", seed, 0)


def record_sequence(
    mesh: TexturedMesh,
    name: str,
    key: int,
    frames: int,
    image_size: int,
    heights: tuple[float, float] = HEIGHTS,
) -> tuple[SequenceData, RenderedSequence]:
    """Render an object and simulate the sensor; `key` is the seed of room, cameras and noise.

    Returns the recorded sequence, and the exact one in the same unit.
    """
    exact = render_sequence(mesh, np.random.default_rng([key, 1]), frames, image_size, heights)
    return simulate_capture(exact, name, np.random.default_rng([key, 2]))


def write_sequence(
    out: Path, category: str, mesh: TexturedMesh, recorded: tuple[SequenceData, RenderedSequence]
) -> None:
    """Add a recorded sequence, with the pose and the bounding box of its object, to a data folder.

    The pose is written last: a sequence with a pose is complete.
    """
    data, exact = recorded
    write_co3d(out, category, [data], _JPEG_QUALITY)
    low, high = mesh.vertices.min(0).tolist(), mesh.vertices.max(0).tolist()
    poses = read_poses(out, category)
    poses[data.name] = {"trans": exact.object_pose.tolist(), "scale": exact.scale, "low": low, "high": high}
    write_atomic(out / category / POSES_FILE, json.dumps(poses, indent=1).encode())


def read_poses(out: Path, category: str) -> dict:
    """Return the entries of a category's file of object poses by sequence; empty without the file."""
    path = out / category / POSES_FILE
    return read_json(path, dict, "object poses") if path.is_file() else {}


def write_labels(out: Path, category: str, names: Iterable[str]) -> None:
    """Write the pose labels of sequences from their object poses; the first name is the reference."""
    poses = {name: np.array(pose["trans"]) for name, pose in read_poses(out, category).items()}
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
