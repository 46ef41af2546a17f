"""Reader of nerfstudio's transforms.json with depth, which phone scanners export.

Its cameras have OpenGL's axes (+y up, looking along -z), and its pixel centres are at half-integers.
"""

from pathlib import Path

import msgspec
import numpy as np

from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import CaptureFrame, camera_from_pose, listed_file
from zsp_lite.io.files import path_inside, read_bytes

FILE = "transforms.json"
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_Row = tuple[float, float, float, float]


class _Intrinsics(msgspec.Struct, kw_only=True):
    """Intrinsics, given for all frames together or for each frame."""

    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    w: int | float | None = None
    h: int | float | None = None
    k1: float | None = None
    k2: float | None = None
    p1: float | None = None
    p2: float | None = None
    k3: float | None = None
    k4: float | None = None


class _Frame(_Intrinsics, kw_only=True):
    file_path: str
    transform_matrix: tuple[_Row, _Row, _Row, _Row]
    depth_file_path: str | None = None
    mask_path: str | None = None


class _File(_Intrinsics, kw_only=True):
    frames: list[_Frame]
    camera_model: str = "OPENCV"
    depth_unit_scale_factor: float = 0.001


def read_nerfstudio(folder: str | Path) -> list[CaptureFrame]:
    """Read the frames that have depth.

    Stored depth is in millimetres unless the file has `depth_unit_scale_factor`. Radial and tangential distortion are
    corrected on loading.

    Raises:
        InputError: The file is invalid, no frame has depth, the camera model is another one, intrinsics are missing, or
            k4 is not 0.
    """
    path = path_inside(folder, FILE)
    content = decode(read_bytes(path, FILE), _File, path)
    if content.camera_model not in _MODELS:
        raise InputError(f"{path}: camera_model is {content.camera_model!r}, expected one of {', '.join(_MODELS)}")
    frames = []
    for number, frame in enumerate(content.frames):
        if frame.depth_file_path is None:
            continue
        where = f"{path}, frame {number}"
        given = {}
        for name in _Intrinsics.__struct_fields__:
            own, common = getattr(frame, name), getattr(content, name)
            given[name] = common if own is None else own
        given["fl_y"] = given["fl_x"] if given["fl_y"] is None else given["fl_y"]
        missing = [name for name in ("fl_x", "cx", "cy", "w", "h") if given[name] is None]
        if missing:
            raise InputError(f"{where}: no {', '.join(missing)}, expected intrinsics in pixels")
        if given["k4"]:
            raise InputError(f"{where}: k4 is {given['k4']}, expected 0: OpenCV's distortion model has no r^8 term")
        pose = np.array(frame.transform_matrix) @ _TO_OPENCV
        size = given["h"], given["w"]
        if any(isinstance(side, float) and not side.is_integer() for side in size):
            raise InputError(f"{where}: h and w are {size}, expected integers")
        size = int(size[0]), int(size[1])
        camera = camera_from_pose(pose, (given["fl_x"], given["fl_y"]), (given["cx"], given["cy"]), size, where)
        image, depth = (listed_file(Path(folder), name, where) for name in (frame.file_path, frame.depth_file_path))
        mask = None if frame.mask_path is None else listed_file(Path(folder), frame.mask_path, where)
        distortion = tuple(given[name] or 0.0 for name in ("k1", "k2", "p1", "p2", "k3"))
        unit = content.depth_unit_scale_factor
        frames.append(CaptureFrame(image, depth, camera, float(number), unit, distortion, mask))
    if not frames:
        raise InputError(f"{path}: none of {len(content.frames)} frames has depth_file_path, expected RGB-D frames")
    return frames
