"""Scenes of benchmarks and of depth cameras: BOP, ScanNet, Open3D's recorder.

Each reader yields functions that make a frame (see `capture.Makers`), so that a frame that cannot
be made is left out alone.
"""

from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.errors import InputError, check_number, real_array
from zsp_lite.importers.capture import HALF_PIXEL, CaptureFrame, Makers, make_frame, read_numbers
from zsp_lite.importers.recordings import open3d_camera
from zsp_lite.io.files import read_json

_MILLIMETRES = 0.001


class _Annotation(msgspec.Struct):
    """Pose of an object in an image of BOP."""

    obj_id: int
    cam_R_m2c: Any
    cam_t_m2c: Any


def read_bop(folder: Path, object: int | None = None) -> Makers:
    """Read a scene in BOP's format, in the frame of one of its objects."""
    scene = read_json(folder / "scene_gt.json", dict[str, list[_Annotation]], "capture")
    cameras = read_json(folder / "scene_camera.json", dict[str, dict[str, Any]], "capture")
    # The objects of each image by their numbers.
    numbers = {image: [pose.obj_id for pose in poses] for image, poses in scene.items()}
    known = sorted(set().union(*numbers.values()))
    if object is None and len(known) == 1:
        object = known[0]
    if object not in known:
        raise InputError(
            f"{folder} has the objects {', '.join(map(str, known))}, expected one of them as "
            "--object N"
        )
    for image, objects in numbers.items():
        if object in objects:
            yield partial(_make_bop, folder, image, object, scene[image], cameras.get(image, {}))


def _make_bop(
    folder: Path, image: str, object: int, scene: list[_Annotation], camera: dict[str, Any]
) -> CaptureFrame:
    """Make a frame whose world is the object's; BOP has integer pixel centres and millimetres."""
    where = f"{folder}, image {image}"
    indices = [index for index, pose in enumerate(scene) if pose.obj_id == object]
    if len(indices) > 1:
        raise InputError(f"{where} shows object {object} {len(indices)} times, expected once")
    placed = scene[indices[0]]
    R = real_array(f"{where}: cam_R_m2c", placed.cam_R_m2c, (9,)).reshape(3, 3)
    t = real_array(f"{where}: cam_t_m2c", placed.cam_t_m2c, (3,))
    K = real_array(f"{where}: cam_K", camera.get("cam_K"), (9,))
    # From camera to object: the inverse of the file's pose.
    pose = np.column_stack([R.T, -_MILLIMETRES * R.T @ t])
    scale = real_array(f"{where}: depth_scale", camera.get("depth_scale", 1), ())
    unit = _MILLIMETRES * float(scale)
    check_number(f"{where}: depth_scale", unit, above=0)
    name = f"{image:0>6}"
    return make_frame(
        folder,
        f"rgb/{name}",
        f"depth/{name}",
        pose,
        K.reshape(3, 3) + HALF_PIXEL,
        where,
        mask=f"mask_visib/{name}_{indices[0]:06d}",
        depth_unit=unit,
    )


def read_scannet(folder: Path) -> Makers:
    """Read a scene in ScanNet's format, with a text file for the pose of each image."""
    # ScanNet's depth is aligned to its colours: their intrinsics hold for both. The format does not
    # document its pixel centres, so that K counts as it is.
    K = read_numbers(folder / "intrinsic/intrinsic_color.txt", columns=(3, 4))[:3, :3]
    for image in sorted((folder / "color").glob("*")):
        yield partial(_make_scannet, folder, folder / f"pose/{image.stem}.txt", K)


def _make_scannet(folder: Path, path: Path, K: Float[np.ndarray, "3 3"]) -> CaptureFrame:
    """Make a frame from the file of its pose."""
    return make_frame(
        folder, f"color/{path.stem}", f"depth/{path.stem}", read_numbers(path, (4,)), K, str(path)
    )


def read_open3d(folder: Path) -> Makers:
    """Read frames of Open3D's recorder, with the trajectory that its reconstruction writes."""
    log = folder / "trajectory.log"
    if not log.is_file():
        log = folder / "scene/trajectory.log"
    if not log.is_file():
        raise InputError(
            f"{folder} has no trajectory.log, expected poses: run Open3D's reconstruction "
            "system on it"
        )
    camera = open3d_camera(folder)
    images = sorted(
        path.stem
        for path in (folder / "color").glob("*")
        if path.suffix.lower() in (".jpg", ".png")
    )
    # The log has five lines for each image: one of three frame numbers, which is not used, and the
    # four rows of a matrix. `numpy.loadtxt` needs equally many columns in all lines: these are the
    # four of a matrix, and of three numbers they read the last one twice.
    lines = read_numbers(log, columns=(4,), usecols=(0, 1, 2, -1))
    if len(lines) != 5 * len(images):
        raise InputError(
            f"{log} has {len(lines)} lines, expected 5 for each of {len(images)} images"
        )
    for image, pose in zip(images, lines.reshape(-1, 5, 4)[:, 1:]):
        yield partial(
            make_frame,
            folder,
            f"color/{image}",
            f"depth/{image}",
            pose,
            where=f"{log}, frame {image}",
            **camera,
        )
