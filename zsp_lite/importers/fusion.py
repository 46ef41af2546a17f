"""Fusion of the object's depth maps into one point cloud (Open3D)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import HALF_PIXEL
from zsp_lite.io.open3d import load_open3d
from zsp_lite.points import object_pixels, object_points

_VOXELS = 96  # voxels per three standard deviations of the object; finer than the noise of depth cameras
_MAX_POINTS = 50_000
_MIN_VIEWS = 3  # number of frames that must see a surface, if there are that many frames


def fuse(
    frames: Sequence[Frame],
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Fuse the depth maps inside the masks by truncated signed distances (TSDF; Curless and Levoy 1996).

    Returns world points (n, 3), RGB colours (n, 3) and normals (n, 3); InputError if too few frames see a surface.
    """
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
    return replace(
        frame, camera=camera, depth=None if frame.depth is None else (frame.depth * scale).astype(np.float32)
    )


def _spread(frames: Sequence[Frame]) -> float:
    """Estimate the object's standard deviation, averaged over the axes, by the median absolute deviation."""
    points = np.concatenate([frame.camera.to_world(object_points(frame))[::7] for frame in frames])
    if len(points) < 4:
        raise InputError(f"{len(frames)} frames have no known depth on the object, expected some inside the masks")
    deviation = np.abs(points - np.median(points, axis=0))
    return float(1.48 * np.median(deviation, axis=0).mean())  # 1.48: ratio to the standard deviation for normal noise
