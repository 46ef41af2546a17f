"""Exact depth and masks of exported synthetic frames, recomputed from the object's mesh."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from zsp_lite.data.annotations import decode
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes
from zsp_lite.io.open3d import load_open3d
from zsp_lite.synthetic.export import SETTINGS_FILE, make_object
from zsp_lite.synthetic.recording import POSES_FILE


def exact_frame(frame: Frame, root: str | Path, category: str, sequence: str) -> Frame:
    """Return a synthetic frame with the object's true depth and mask; depth off the object is unknown.

    Args:
        frame: A frame, or a crop of one.
        root: Folder made by `zsp-lite synth`.
        category: Category of the frame.
        sequence: Sequence of the frame.

    Raises:
        InputError: If `zsp-lite synth` did not make the folder.
    """
    cast = _ray_caster(str(root), category, sequence)
    camera = frame.camera
    height, width = camera.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    # Rays of unit depth: the distance along them, in their lengths, is the depth.
    directions = camera.unproject_camera(np.stack([x, y], axis=-1), np.ones((height, width))) @ camera.R
    depth = cast(camera.centre, directions)
    mask = np.isfinite(depth)
    return replace(frame, depth=np.where(mask, depth, 0).astype(np.float32), mask=mask.astype(np.float32))


@lru_cache(maxsize=8)
def _ray_caster(root: str, category: str, sequence: str) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A function from a ray origin (3,) and directions (..., 3) in the sequence's world to distances (...)."""
    settings, poses = Path(root) / SETTINGS_FILE, Path(root) / category / POSES_FILE
    if not (settings.is_file() and poses.is_file()):
        raise InputError(
            f"{root}: no {SETTINGS_FILE}, expected a folder made by zsp-lite synth, which contains exact poses"
        )
    seed = decode(read_bytes(settings, "settings"), dict, settings)["seed"]
    placed = decode(read_bytes(poses, "object poses"), dict, poses)[sequence]
    shape = make_object(category, sequence, seed)
    pose = np.array(placed["trans"])
    vertices = placed["scale"] * shape.vertices @ pose[:3, :3].T + pose[:3, 3]
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(shape.faces.astype(np.uint32)))

    def cast(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], axis=-1)
        return scene.cast_rays(o3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()

    return cast
