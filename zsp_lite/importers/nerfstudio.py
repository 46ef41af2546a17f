"""Reader of nerfstudio's transforms.json with depth, which phone scanners export.

Its cameras have OpenGL's axes (+y up, looking along -z), and its pixel centres are at half-integers.
"""

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from zsp_lite.errors import MAX_LENGTH, InputError
from zsp_lite.importers.capture import CaptureFrame, camera_from_pose
from zsp_lite.io.files import decode_json, path_inside, read_json

_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_Row = tuple[float, float, float, float]
_Side = Annotated[float, msgspec.Meta(multiple_of=1)]  # pixels; exporters write 640 or 640.0
_Coefficient = Annotated[float, msgspec.Meta(ge=-100, le=100)]  # of the distortion


class _Frame(msgspec.Struct):
    """A frame, together with what the file gives for all frames."""

    file_path: str
    transform_matrix: tuple[_Row, _Row, _Row, _Row]
    fl_x: float
    cx: float
    cy: float
    w: _Side
    h: _Side
    depth_file_path: str | None = None
    mask_path: str | None = None
    fl_y: float | None = None
    k1: _Coefficient = 0.0
    k2: _Coefficient = 0.0
    p1: _Coefficient = 0.0
    p2: _Coefficient = 0.0
    k3: _Coefficient = 0.0
    k4: float = 0.0
    camera_model: str = "OPENCV"
    depth_unit_scale_factor: Annotated[float, msgspec.Meta(gt=0, le=MAX_LENGTH)] = 0.001


class _File(msgspec.Struct):
    frames: list[dict[str, Any]]


def read_nerfstudio(folder: str | Path) -> list[CaptureFrame]:
    """Read the frames that have depth, which is in millimetres unless the file has `depth_unit_scale_factor`."""
    path = path_inside(folder, "transforms.json")
    common, listed = read_json(path, dict[str, Any], "capture"), read_json(path, _File, "capture").frames
    del common["frames"]
    frames = []
    for number, own in enumerate(listed):
        if own.get("depth_file_path") is None:
            continue
        where = f"{path}, frame {number}"
        frame = decode_json(msgspec.json.encode(common | own), _Frame, where)
        if frame.camera_model not in _MODELS or frame.k4:
            found = f"{frame.camera_model!r} with k4 = {frame.k4:g}"
            raise InputError(f"{where}: camera_model is {found}, expected one of {', '.join(_MODELS)} with k4 = 0")
        pose = np.array(frame.transform_matrix) @ _TO_OPENCV
        intrinsics, size = (frame.fl_x, frame.fl_y or frame.fl_x, frame.cx, frame.cy), (int(frame.h), int(frame.w))
        camera = camera_from_pose(pose, intrinsics, size, where)
        image, depth = path_inside(folder, frame.file_path), path_inside(folder, frame.depth_file_path)
        mask = None if frame.mask_path is None else path_inside(folder, frame.mask_path)
        distortion = frame.k1, frame.k2, frame.p1, frame.p2, frame.k3  # OpenCV's order; its model has no r^8 term, k4
        frames.append(CaptureFrame(image, depth, camera, frame.depth_unit_scale_factor, distortion, mask))
    if not frames:
        raise InputError(f"{path}: none of {len(listed)} frames has depth_file_path, expected RGB-D frames")
    return frames
