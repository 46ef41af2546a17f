"""Conversion of a source to a sequence of a data folder, with a fused point cloud (Open3D)."""

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.data.annotations import FRAMES_FILE, read_frame_index
from zsp_lite.data.frames import Frame, frame_defect
from zsp_lite.data.writing import SequenceData, write_co3d
from zsp_lite.errors import InputError
from zsp_lite.importers import PACKED
from zsp_lite.importers.capture import HALF_PIXEL, first_three
from zsp_lite.importers.sources import Source, open_source
from zsp_lite.io.files import plain_name
from zsp_lite.points import axis_deviation, object_pixels, sampling_step, world_points

logger = logging.getLogger(__name__)

# Voxels per three standard deviations of the object: they are finer than the noise of depth
# cameras.
_VOXELS = 96
_MAX_POINTS = 50_000  # of a fused point cloud
# The size of the object is estimated from every seventh pixel, or fewer.
_LEAST_STEP = 7
# This many frames must see a surface. With fewer frames, all must see it.
MIN_VIEWS = 3


@dataclass(frozen=True)
class ImportResult:
    """Numbers of frames and points of an import."""

    frames: int
    points: int
    scale: float  # factor from the capture's lengths to those of the sequence
    flags: tuple[str, ...]  # reasons to doubt the masks, the depth or the intrinsics
    size: str = ""  # how wide and how far away the object is in the capture


def import_source(source: Source, root: str | Path, category: str, sequence: str) -> ImportResult:
    """Write a source as the sequence ROOT/CATEGORY/SEQUENCE, with masks and a fused point cloud.

    Lengths are scaled so that the point cloud has unit standard deviation, averaged over the axes,
    as in CO3D. Frames with a defect, such as an empty mask, are left out; the others keep their
    numbers. An interrupted import can be repeated. If the source cannot be read, segmented or
    fused, or if the sequence exists, InputError is raised before anything is written.
    """
    folder = Path(root) / plain_name(category, "category") / plain_name(sequence, "sequence")
    if is_imported(root, category, sequence):
        raise InputError(f"{folder} exists already, expected another sequence name")
    problem = source.contradiction()
    if problem:
        # Wrong intrinsics may show as wrong depth: doubts about them come first.
        problem = "; ".join(filter(None, (*source.doubts, problem)))
        raise InputError(f"{source.path}: {problem}")

    source = source.segmented()
    left_out = [*source.left_out]
    seen = []
    for position, number in enumerate(source.numbers):
        defect = frame_defect(source.read_frame(position))
        if defect:
            left_out.append(f"frame {number}: {defect}")
        else:
            seen.append(position)
    if left_out and len(seen) < MIN_VIEWS:
        raise InputError(
            f"{source.path}: {len(seen)} of {len(seen) + len(left_out)} frames remain, expected "
            f"{MIN_VIEWS}: {'; '.join(filter(None, (*source.doubts, first_three(left_out))))}"
        )
    frames = LazyFrames(source.read_frame, seen)
    points, colours, normals = fuse(frames)
    scale = 1 / axis_deviation(points)
    scaled = LazyFrames(lambda position: scale_frame(source.read_frame(position), scale), seen)
    numbers = [source.numbers[position] for position in seen]
    # The numbers count as the times, too.
    data = SequenceData(
        sequence, scaled, [*map(float, numbers)], points * scale, colours, normals, numbers=numbers
    )
    write_co3d(root, category, [data])
    flags = replace(source, left_out=left_out).flags(frames)
    return ImportResult(len(seen), len(points), scale, tuple(flags), source.size(frames))


def is_imported(root: str | Path, category: str, sequence: str) -> bool:
    """Whether a data folder has a sequence; one whose import was interrupted is not annotated."""
    path = Path(root, category, FRAMES_FILE)
    return path.is_file() and sequence in read_frame_index(path).by_sequence


def import_captures(
    folder: str | Path, root: str | Path, category: str
) -> Iterator[tuple[str, ImportResult]]:
    """Import the captures in a folder that are not imported yet; yield names and results.

    InputError if two have one name. Files of other kinds are left out.
    """
    paths = {}
    for path in sorted(Path(folder).glob("[!.]*")):
        if path.is_file() and path.suffix.lower() not in PACKED:
            logger.warning("%s is left out, expected a folder, .zip or .r3d", path)
            continue
        name = path.stem if path.is_file() else path.name
        if name in paths:
            raise InputError(
                f"{folder} has {paths[name].name} and {path.name}, expected one scan of a name"
            )
        paths[name] = path
    if not paths:
        raise InputError(f"{folder} has no scan, expected a folder, .zip or .r3d of each object")
    for name, path in paths.items():
        if not is_imported(root, category, name):
            yield name, import_source(open_source(path), root, category, name)


class LazyFrames(Sequence[Frame]):
    """Frames that are loaded at each access, because all of a capture do not fit into memory."""

    def __init__(self, load: Callable[[Any], Frame], items: Sequence[Any]):
        """Make the frames that `load` returns for the items."""
        self._load = load
        self._items = items

    def __len__(self) -> int:
        return len(self._items)

    def __getitem__(self, position: int) -> Frame:
        return self._load(self._items[position])


def fuse(
    frames: Collection[Frame],
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Fuse the depth inside the masks (Curless and Levoy 1996) to points, colours and normals."""
    import open3d as o3d

    voxel = 3 * _robust_deviation(frames) / _VOXELS
    # A voxel has a distance to the surface, a weight and a colour. The grid starts with space for
    # 2000 blocks and grows.
    volume = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(o3d.core.float32,) * 3,
        attr_channels=((1,), (1,), (3,)),
        voxel_size=voxel,
        block_resolution=16,
        block_count=2000,
    )

    # Average the signed distance of each voxel to the measured surfaces over the frames.
    for frame in frames:
        depth = np.where(object_pixels(frame), frame.depth, 0).astype(np.float32)
        if not depth.any():
            continue
        intrinsic = o3d.core.Tensor(frame.camera.K - HALF_PIXEL)
        extrinsic = o3d.core.Tensor(frame.camera.matrix)
        options = {
            "depth_scale": 1.0,
            # Open3D ignores depth from this value on: the greatest depth must be below it.
            "depth_max": 1.01 * float(depth.max()),
            "trunc_voxel_multiplier": 4.0,  # distances are cut off at 4 voxels
        }
        depth = o3d.t.geometry.Image(depth)
        colour = o3d.t.geometry.Image(frame.rgb.astype(np.float32) / 255)
        blocks = volume.compute_unique_block_coordinates(depth, intrinsic, extrinsic, **options)
        volume.integrate(blocks, depth, colour, intrinsic, intrinsic, extrinsic, **options)

    # The surface is where the distance is 0. Open3D uses voxels of a greater weight, which is the
    # number of frames that saw the voxel.
    weight = min(MIN_VIEWS, len(frames)) - 0.5
    cloud = volume.extract_point_cloud(weight_threshold=weight).to_legacy()
    # A point is an outlier if its mean distance from 20 neighbours is more than 2.5 standard
    # deviations above the mean of all points.
    cloud, _ = cloud.remove_statistical_outlier(nb_neighbors=20, std_ratio=2.5)
    if len(cloud.points) > _MAX_POINTS:
        # Every so many points, rounded up.
        cloud = cloud.uniform_down_sample(-(-len(cloud.points) // _MAX_POINTS))
    if len(cloud.points) < 4:  # fewer have no volume
        raise InputError(
            f"{len(frames)} frames fuse to {len(cloud.points)} points, expected overlapping "
            "depth maps"
        )
    colours = np.rint(np.asarray(cloud.colors) * 255).clip(0, 255).astype(np.uint8)
    return np.asarray(cloud.points).copy(), colours, np.asarray(cloud.normals).copy()


def scale_frame(frame: Frame, scale: float) -> Frame:
    """Multiply all lengths of a frame by `scale`: its depth and its camera's translation."""
    camera = replace(frame.camera, t=frame.camera.t * scale)
    return replace(frame, camera=camera, depth=(frame.depth * scale).astype(np.float32))


def _robust_deviation(frames: Collection[Frame]) -> float:
    """Estimate the object's standard deviation, averaged over the axes, despite outliers."""
    clouds = []
    for frame in frames:
        step = max(_LEAST_STEP, sampling_step(frame, len(frames)))
        clouds.append(world_points(frame, object_pixels(frame), step))
    points = np.concatenate(clouds)
    if not len(points):
        raise InputError(
            f"{len(frames)} frames have no known depth on the object, expected some inside "
            "the masks"
        )
    deviation = np.abs(points - np.median(points, axis=0))
    # The standard deviation of a normal distribution is 1.48 times its median absolute deviation.
    return float(1.48 * np.median(deviation, axis=0).mean())
