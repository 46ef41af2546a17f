"""One point cloud of the object from all frames (Open3D's TSDF fusion), and the scale that CO3D's clouds have."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.open3d import load_open3d

_VOXELS = 96  # along three standard deviations of the object: finer than depth cameras are
_MAX_POINTS = 50_000
_CONFIRMED = 3  # frames that a surface must be seen in, where there are so many


def fuse(
    frames: Sequence[Frame],
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """World points, colours and normals of what the masks show: truncated signed distances (Curless and Levoy, 1996).

    Raises InputError where no frame has known depth on the object.
    """
    o3d = load_open3d()
    voxel = 3 * _spread(frames) / _VOXELS
    kinds, shapes = (o3d.core.float32,) * 3, ((1,), (1,), (3,))
    volume = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight", "color"), kinds, shapes, voxel, 16, 2000)
    for frame in frames:
        depth = np.where(frame.mask > 0.5, frame.depth, 0).astype(np.float32)
        if not depth.any():
            continue
        # Open3D's pixel centres are at whole numbers.
        intrinsic = o3d.core.Tensor(frame.camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        extrinsic = o3d.core.Tensor(frame.camera.matrix)
        seen = o3d.t.geometry.Image(depth)
        colour = o3d.t.geometry.Image(frame.rgb.astype(np.float32) / 255)
        reach = {"depth_scale": 1.0, "depth_max": 1.01 * float(depth.max()), "trunc_voxel_multiplier": 4.0}
        blocks = volume.compute_unique_block_coordinates(seen, intrinsic, extrinsic, **reach)
        volume.integrate(blocks, seen, colour, intrinsic, intrinsic, extrinsic, **reach)
    enough = min(_CONFIRMED, len(frames)) - 0.5  # Open3D takes what is above it
    cloud = volume.extract_point_cloud(weight_threshold=enough).to_legacy()
    cloud, _ = cloud.remove_statistical_outlier(nb_neighbors=20, std_ratio=2.5)
    if len(cloud.points) > _MAX_POINTS:
        cloud = cloud.uniform_down_sample(int(np.ceil(len(cloud.points) / _MAX_POINTS)))
    if len(cloud.points) < 4:
        raise InputError(f"{len(frames)} frames fuse to {len(cloud.points)} points, expected overlapping depth maps")
    colours = np.rint(np.asarray(cloud.colors) * 255).clip(0, 255).astype(np.uint8)
    return np.asarray(cloud.points).copy(), colours, np.asarray(cloud.normals).copy()


def scale_frame(frame: Frame, scale: float) -> Frame:
    """The frame in a world whose unit is `scale` times smaller: depth and camera follow."""
    camera = replace(frame.camera, t=frame.camera.t * scale)
    return replace(
        frame, camera=camera, depth=None if frame.depth is None else (frame.depth * scale).astype(np.float32)
    )


def unit_scale(points: Float[np.ndarray, "n 3"]) -> float:
    """What to multiply by so that the standard deviation, averaged over the axes, is 1, as CO3D's clouds have it."""
    spread = float(points.std(axis=0).mean())
    if not spread > 0:
        raise InputError(f"point cloud of {len(points)} points has no extent, expected an object")
    return 1 / spread


def _spread(frames: Sequence[Frame]) -> float:
    clouds = []
    for frame in frames:
        if frame.depth is not None and frame.mask is not None:
            on = (frame.mask > 0.5) & (frame.depth > 0)
            clouds.append(frame.camera.to_world(unproject_depth(frame.depth, frame.camera)[on])[::7])
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    if len(points) < 4:
        raise InputError(f"{len(frames)} frames have no known depth on the object, expected some in its masks")
    middle = np.median(points, axis=0)
    return float(1.48 * np.median(np.abs(points - middle), axis=0).mean())
