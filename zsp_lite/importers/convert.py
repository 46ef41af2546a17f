"""Conversion of a capture to a sequence of a data folder in CO3D's layout, with a fused point cloud (Open3D)."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.data.cameras import Box
from zsp_lite.data.co3d import SequenceData, write_co3d
from zsp_lite.data.frames import ON_OBJECT, Frame
from zsp_lite.errors import InputError
from zsp_lite.importers.agreement import disagreement, neighbours
from zsp_lite.importers.capture import HALF_PIXEL, CaptureFrame, evenly_spaced, find_masks
from zsp_lite.importers.files import question_intrinsics
from zsp_lite.importers.masks import (
    depth_flags,
    given_mask_flags,
    mask_flags,
    masks_from_box,
    masks_from_depth,
)
from zsp_lite.io.files import plain_name
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import load_open3d
from zsp_lite.points import axis_deviation, object_pixels, sampling_step, world_points

_VOXELS = 96  # voxels per three standard deviations of the object; finer than the noise of depth cameras
_MAX_POINTS = 50_000
_LEAST_STEP = 7  # between the pixels by which the size of the object is estimated
_GROUP = 8  # frames that are segmented by depth at once
_MIN_VIEWS = 3  # number of frames that must see a surface, if there are that many frames


@dataclass(frozen=True)
class ImportResult:
    """Numbers of frames and points of an import."""

    frames: int
    empty: int  # frames that were left out because their masks are empty
    points: int
    scale: float  # factor from the capture's lengths to those of the sequence
    flags: tuple[str, ...]  # what speaks against the masks and the intrinsics


def import_capture(
    capture: Sequence[CaptureFrame],
    root: str | Path,
    category: str,
    sequence: str,
    box: Box | None = None,
    masks: str | Path | None = None,
    max_frames: int = 100,
    mask: str | None = None,
    label: int | None = None,
    orientation: str | None = None,
) -> ImportResult:
    """Write a capture as the sequence ROOT/CATEGORY/SEQUENCE, with masks and a fused point cloud.

    Lengths are scaled so that the point cloud has unit standard deviation, averaged over the axes, as in CO3D. Frames
    whose mask is empty are left out. An interrupted import can be repeated.

    Args:
        capture: Frames of a capture (see `open_capture`).
        root: The data folder, new or existing.
        category: Name of the category.
        sequence: Name of the new sequence.
        box: Bounding box (top, left, height, width) of the object in the first frame, pixels (see `masks_from_box`).
        masks: Folder of mask files, named like the images, if there is no box. Without both, those of the capture.
        max_frames: Maximum number of frames, evenly spaced; CO3D's sequences have about 100.
        mask: "auto" makes the masks of all frames by depth, "given" and None only those that are missing in some.
        label: Number of the object in masks that label several.
        orientation: How camera, depth and masks refer to turned photographs (see `open_source`).

    Raises:
        InputError: The capture cannot be read, segmented or fused, or the sequence exists. Nothing is written then.
    """
    folder = Path(root) / plain_name(category, "category") / plain_name(sequence, "sequence")
    unfinished = folder / ".unfinished"
    if folder.exists() and not unfinished.is_file():
        raise InputError(f"{folder} exists already, expected another sequence name")
    capture = [replace(frame, label=label, orientation=orientation) for frame in evenly_spaced(capture, max_frames)]
    flags = question_intrinsics(capture[0].camera, capture[0].image.name)
    if box is not None or mask == "auto":
        capture = [replace(frame, mask=None) for frame in capture]
    elif masks is not None:
        found = find_masks(masks, [frame.image for frame in capture])
        capture = [replace(frame, mask=path) for frame, path in zip(capture, found)]
    missing = [index for index, frame in enumerate(capture) if not frame.has_mask]
    if box is None and mask != "auto" and len(missing) == len(capture):
        raise InputError(
            f"{capture[0].image.name} has no mask, expected a box in the first picture (--box TOP,LEFT,HEIGHT,WIDTH), "
            "a folder of masks that are named like the pictures (--masks DIR), or --mask auto"
        )
    some = (capture[index].load() for index in neighbours(len(capture)))
    if line := disagreement(some, capture[0].depth_unit):
        raise InputError(f"{capture[0].image}: {line}")
    if box is None:
        bits = _masks_by_depth(capture, missing)
    else:
        found = masks_from_box((frame.load() for frame in capture), box)
        bits = dict(enumerate(np.packbits(frame.mask > ON_OBJECT) for frame in found))

    def load(index: int) -> Frame:
        frame = capture[index].load()
        if index not in bits:
            return frame
        made = np.unpackbits(bits[index], count=frame.depth.size).reshape(frame.depth.shape)
        return replace(frame, mask=made.astype(np.float32))

    seen = [k for k in range(len(capture)) if (bits[k].any() if k in bits else load(k).shows_object)]
    if not seen:
        raise InputError(f"the masks of all {len(capture)} frames are empty, expected an object")
    frames = LazyFrames(load, seen)
    missing = [capture[index].image.name for index in bits]
    flags += mask_flags(frames) if len(bits) == len(capture) else given_mask_flags(frames, missing)
    flags += depth_flags(frames[position] for position in neighbours(len(seen)))
    points, colours, normals = fuse(frames)
    scale = 1 / axis_deviation(points)
    scaled = LazyFrames(lambda index: scale_frame(load(index), scale), seen)
    data = SequenceData(sequence, scaled, [float(index) for index in seen], points * scale, colours, normals)
    with writing(root):
        folder.mkdir(parents=True, exist_ok=True)
        unfinished.touch()
        write_co3d(root, category, [data])
        unfinished.unlink()
    return ImportResult(len(seen), len(capture) - len(seen), len(points), scale, flags)


def _masks_by_depth(capture: Sequence[CaptureFrame], wanted: Sequence[int]) -> dict[int, UInt8[np.ndarray, " bytes"]]:
    """Segment some frames of a capture by depth, in groups all around the object; return the bits of the masks."""
    bits, groups = {}, -(-len(wanted) // _GROUP)
    for first in range(groups):
        group = wanted[first::groups]
        others = np.linspace(0, len(capture) - 1, _GROUP - len(group)).round().astype(int)
        chosen = sorted({*group, *others.tolist()})
        masked = zip(chosen, masks_from_depth([capture[index].load() for index in chosen]), strict=True)
        bits |= {index: np.packbits(frame.mask > ON_OBJECT) for index, frame in masked if index in group}
    return bits


class LazyFrames(Sequence[Frame]):
    """Frames that are loaded at each access, because those of a capture do not fit into memory together."""

    def __init__(self, load: Callable[[int], Frame], indices: Sequence[int]):
        self._load, self._indices = load, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: int) -> Frame:
        return self._load(self._indices[position])


def fuse(
    frames: Collection[Frame],
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Fuse the depth inside the masks by TSDF (Curless and Levoy 1996) to world points, RGB colours and normals."""
    o3d = load_open3d()
    voxel = 3 * _spread(frames) / _VOXELS
    types, shapes = (o3d.core.float32,) * 3, ((1,), (1,), (3,))
    volume = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight", "color"), types, shapes, voxel, 16, 2000)
    for frame in frames:
        depth = np.where(object_pixels(frame), frame.depth, 0).astype(np.float32)
        if not depth.any():
            continue
        intrinsic = o3d.core.Tensor(frame.camera.K - HALF_PIXEL)
        extrinsic = o3d.core.Tensor(frame.camera.matrix)
        options = {"depth_scale": 1.0, "depth_max": 1.01 * float(depth.max()), "trunc_voxel_multiplier": 4.0}
        depth = o3d.t.geometry.Image(depth)
        colour = o3d.t.geometry.Image(frame.rgb.astype(np.float32) / 255)
        blocks = volume.compute_unique_block_coordinates(depth, intrinsic, extrinsic, **options)
        volume.integrate(blocks, depth, colour, intrinsic, intrinsic, extrinsic, **options)
    weight = min(_MIN_VIEWS, len(frames)) - 0.5  # Open3D keeps voxels of a greater weight
    cloud = volume.extract_point_cloud(weight_threshold=weight).to_legacy()
    cloud, _ = cloud.remove_statistical_outlier(nb_neighbors=20, std_ratio=2.5)
    if len(cloud.points) > _MAX_POINTS:
        cloud = cloud.uniform_down_sample(int(np.ceil(len(cloud.points) / _MAX_POINTS)))
    if len(cloud.points) < 4:
        raise InputError(f"{len(frames)} frames fuse to {len(cloud.points)} points, expected overlapping depth maps")
    colours = np.rint(np.asarray(cloud.colors) * 255).clip(0, 255).astype(np.uint8)
    return np.asarray(cloud.points).copy(), colours, np.asarray(cloud.normals).copy()


def scale_frame(frame: Frame, scale: float) -> Frame:
    """Multiply all lengths of a frame, of its depth and of its camera's translation, by `scale`."""
    camera = replace(frame.camera, t=frame.camera.t * scale)
    return replace(frame, camera=camera, depth=(frame.depth * scale).astype(np.float32))


def _spread(frames: Collection[Frame]) -> float:
    """Estimate the object's standard deviation, averaged over the axes, by the median absolute deviation."""
    clouds = []
    for frame in frames:
        step = max(_LEAST_STEP, sampling_step(frame, len(frames)))
        clouds.append(world_points(frame, object_pixels(frame), step))
    points = np.concatenate(clouds)
    if not len(points):
        raise InputError(f"{len(frames)} frames have no known depth on the object, expected some inside the masks")
    deviation = np.abs(points - np.median(points, axis=0))
    return float(1.48 * np.median(deviation, axis=0).mean())  # 1.48: ratio to the standard deviation for normal noise
