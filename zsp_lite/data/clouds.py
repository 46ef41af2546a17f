"""Point clouds of sequences."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError
from zsp_lite.io.files import path_inside
from zsp_lite.io.ply import read_ply


def point_cloud(
    dataset: Co3D, category: str, sequence: str
) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"] | None]:
    """Read a sequence's point cloud (see `Co3D.point_cloud`)."""
    path = _cloud_path(dataset, category, sequence)
    if path is None:
        raise InputError(f"sequence {category}/{sequence} has no point cloud")
    return read_ply(path)


def extent(
    dataset: Co3D, category: str, sequence: str
) -> tuple[Float64[np.ndarray, "3"], float] | None:
    """Return the centre and the diameter of a sequence's object in its world.

    Both describe the box around the points of its cloud, without the outermost 2 % on each side.
    None without a point cloud.
    """
    path = _cloud_path(dataset, category, sequence)
    if path is None or not path.is_file():
        return None
    points, _ = read_ply(path)
    low, high = np.quantile(points, (0.02, 0.98), axis=0)
    return (low + high) / 2, float(np.linalg.norm(high - low))


def _cloud_path(dataset: Co3D, category: str, sequence: str) -> Path | None:
    """Return the path of a sequence's point cloud, None if the annotations have none."""
    clouds = {known.sequence_name: known.point_cloud for known in dataset.sequences(category)}
    cloud = clouds.get(sequence)
    return None if cloud is None else path_inside(dataset.root, cloud.path)
