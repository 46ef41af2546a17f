"""Conversion of a source to a sequence of a data folder, with a fused point cloud (Open3D)."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.data.co3d import SequenceData, write_co3d
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import HALF_PIXEL
from zsp_lite.importers.sources import Source, open_source
from zsp_lite.io.files import plain_name
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import load_open3d
from zsp_lite.points import axis_deviation, object_pixels, sampling_step, world_points

# Voxels per three standard deviations of the object; finer than the noise of depth cameras.
_VOXELS = 96
_MAX_POINTS = 50_000
_LEAST_STEP = 7  # between the pixels by which the size of the object is estimated
# File in the folder of a sequence whose import goes on, or was interrupted.
_UNFINISHED = ".unfinished"
MIN_VIEWS = 3  # number of frames that must see a surface, if there are that many frames


@dataclass(frozen=True)
class ImportResult:
    """Numbers of frames and points of an import."""

    frames: int
    empty: int  # frames that were left out because their masks are empty
    points: int
    scale: float  # factor from the capture's lengths to those of the sequence
    flags: tuple[str, ...]  # what speaks against the masks and the intrinsics


def import_source(source: Source, root: str | Path, category: str, sequence: str) -> ImportResult:
    """Write a source as the sequence ROOT/CATEGORY/SEQUENCE, with masks and a fused point cloud.

    Lengths are scaled so that the point cloud has unit standard deviation, averaged over the axes,
    as in CO3D. Frames whose mask is empty are left out. An interrupted import can be repeated.
    InputError, and nothing is written, if the source cannot be read, segmented or fused, or the
    sequence exists.
    """
    folder = Path(root) / plain_name(category, "category") / plain_name(sequence, "sequence")
    count = len(source.numbers)
    if is_imported(folder):
        raise InputError(f"{folder} exists already, expected another sequence name")
    if source.left_out and count < MIN_VIEWS:
        raise InputError(
            f"{source.path}: {count} frames remain, expected {MIN_VIEWS}: {source.left_out[0]}"
        )
    problem = source.contradiction()
    if problem:
        raise InputError(f"{source.path}: {problem}")

    source = source.segmented()
    seen = [position for position in range(count) if source.read(position).shows_object]
    if not seen:
        raise InputError(f"the masks of all {count} frames are empty, expected an object")
    frames = LazyFrames(source.read, seen)
    points, colours, normals = fuse(frames)
    scale = 1 / axis_deviation(points)
    scaled = LazyFrames(lambda position: scale_frame(source.read(position), scale), seen)
    data = SequenceData(
        sequence, scaled, [float(position) for position in seen], points * scale, colours, normals
    )
    write_sequence(root, category, data)
    return ImportResult(
        len(seen), count - len(seen), len(points), scale, tuple(source.flags(frames))
    )


def is_imported(folder: Path) -> bool:
    """Whether the folder of a sequence exists, and no import to it was interrupted."""
    return folder.exists() and not (folder / _UNFINISHED).is_file()


def write_sequence(root: str | Path, category: str, data: SequenceData) -> None:
    """Write a new sequence, or one whose import was interrupted."""
    folder = Path(root, category, data.name)
    with writing(root):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _UNFINISHED).touch()
        write_co3d(root, category, [data])
        (folder / _UNFINISHED).unlink()


def import_captures(
    folder: str | Path, root: str | Path, category: str
) -> Iterator[tuple[str, ImportResult]]:
    """Import each capture in a folder that is not there yet; yield its name and what was done."""
    for path in sorted(Path(folder).iterdir()):
        name = path.stem if path.is_file() else path.name
        if not path.name.startswith(".") and not is_imported(Path(root) / category / name):
            yield name, import_source(open_source(path), root, category, name)


class LazyFrames(Sequence[Frame]):
    """Frames that are loaded at each access: those of a capture do not fit into memory together."""

    def __init__(self, load: Callable[[int], Frame], indices: Sequence[int]):
        self._load = load
        self._indices = indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: int) -> Frame:
        return self._load(self._indices[position])


def fuse(
    frames: Collection[Frame],
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Fuse the depth inside the masks (Curless and Levoy 1996) to points, colours and normals."""
    o3d = load_open3d()
    voxel = 3 * _spread(frames) / _VOXELS
    # Three values per voxel, in blocks of 16 x 16 x 16; at first, there is space for 2000 blocks.
    types = (o3d.core.float32,) * 3
    volume = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight", "color"), types, ((1,), (1,), (3,)), voxel, 16, 2000
    )

    # The distance to the measured surface, averaged over the frames.
    for frame in frames:
        depth = np.where(object_pixels(frame), frame.depth, 0).astype(np.float32)
        if not depth.any():
            continue
        intrinsic = o3d.core.Tensor(frame.camera.K - HALF_PIXEL)
        extrinsic = o3d.core.Tensor(frame.camera.matrix)
        options = {
            "depth_scale": 1.0,
            "depth_max": 1.01 * float(depth.max()),
            "trunc_voxel_multiplier": 4.0,
        }
        depth = o3d.t.geometry.Image(depth)
        colour = o3d.t.geometry.Image(frame.rgb.astype(np.float32) / 255)
        blocks = volume.compute_unique_block_coordinates(depth, intrinsic, extrinsic, **options)
        volume.integrate(blocks, depth, colour, intrinsic, intrinsic, extrinsic, **options)

    # The points where it is 0, without outliers.
    weight = min(MIN_VIEWS, len(frames)) - 0.5  # Open3D keeps voxels of a greater weight
    cloud = volume.extract_point_cloud(weight_threshold=weight).to_legacy()
    cloud, _ = cloud.remove_statistical_outlier(nb_neighbors=20, std_ratio=2.5)
    if len(cloud.points) > _MAX_POINTS:
        cloud = cloud.uniform_down_sample(int(np.ceil(len(cloud.points) / _MAX_POINTS)))
    if len(cloud.points) < 4:
        raise InputError(
            f"{len(frames)} frames fuse to {len(cloud.points)} points, expected overlapping "
            "depth maps"
        )
    colours = np.rint(np.asarray(cloud.colors) * 255).clip(0, 255).astype(np.uint8)
    return np.asarray(cloud.points).copy(), colours, np.asarray(cloud.normals).copy()


def scale_frame(frame: Frame, scale: float) -> Frame:
    """Multiply all lengths of a frame, of its depth and of its camera's translation, by `scale`."""
    camera = replace(frame.camera, t=frame.camera.t * scale)
    return replace(frame, camera=camera, depth=(frame.depth * scale).astype(np.float32))


def _spread(frames: Collection[Frame]) -> float:
    """Estimate the object's mean standard deviation by the median absolute deviation."""
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
    # 1.48: ratio to the standard deviation for normal noise
    return float(1.48 * np.median(deviation, axis=0).mean())
