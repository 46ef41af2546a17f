"""Reader of nerfstudio's transforms.json with depth, which phone scanners export.

Its cameras have OpenGL's axes (+y up, looking along -z), and its pixel centres are at half-integers.
"""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from zsp_lite.data.cameras import MOST_PIXELS
from zsp_lite.errors import MAX_LENGTH, InputError
from zsp_lite.importers.capture import CaptureFrame, camera_from_pose
from zsp_lite.io.files import path_inside, read_json

FILE = "transforms.json"
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_Row = tuple[float, float, float, float]
_FocalLength = Annotated[float, msgspec.Meta(ge=1e-3, le=MAX_LENGTH)]  # pixels
_Position = Annotated[float, msgspec.Meta(ge=-MAX_LENGTH, le=MAX_LENGTH)]  # pixels
_Side = Annotated[float, msgspec.Meta(ge=1, le=MOST_PIXELS, multiple_of=1)]  # pixels; exporters write 640 or 640.0
_Coefficient = Annotated[float, msgspec.Meta(ge=-100, le=100)]


class _Intrinsics(msgspec.Struct, kw_only=True):
    """Intrinsics, given for all frames together or for each frame."""

    fl_x: _FocalLength | None = None
    fl_y: _FocalLength | None = None
    cx: _Position | None = None
    cy: _Position | None = None
    w: _Side | None = None
    h: _Side | None = None
    k1: _Coefficient | None = None
    k2: _Coefficient | None = None
    p1: _Coefficient | None = None
    p2: _Coefficient | None = None
    k3: _Coefficient | None = None
    k4: Annotated[float, msgspec.Meta(ge=0, le=0)] | None = None  # OpenCV's model has no term of r^8


class _Frame(_Intrinsics, kw_only=True):
    file_path: str
    transform_matrix: tuple[_Row, _Row, _Row, _Row]
    depth_file_path: str | None = None
    mask_path: str | None = None


class _File(_Intrinsics, kw_only=True):
    frames: list[_Frame]
    camera_model: Literal["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"] = "OPENCV"
    depth_unit_scale_factor: Annotated[float, msgspec.Meta(gt=0, le=MAX_LENGTH)] = 0.001


def read_nerfstudio(folder: str | Path) -> list[CaptureFrame]:
    """Read the frames that have depth.

    Stored depth is in millimetres unless the file has `depth_unit_scale_factor`. Radial and tangential distortion are
    corrected on loading.

    Raises:
        InputError: The file is invalid, no frame has depth, the camera model is another one, intrinsics are missing, or
            k4 is not 0.
    """
    path = path_inside(folder, FILE)
    content = read_json(path, _File, "capture")
    common = {name: getattr(content, name) for name in _Intrinsics.__struct_fields__}
    frames = []
    for number, frame in enumerate(content.frames):
        if frame.depth_file_path is None:
            continue
        where = f"{path}, frame {number}"
        given = {name: getattr(frame, name) for name in common}
        given = common | {name: value for name, value in given.items() if value is not None}
        missing = [name for name in ("fl_x", "cx", "cy", "w", "h") if given[name] is None]
        if missing:
            raise InputError(f"{where}: no {', '.join(missing)}, expected intrinsics in pixels")
        focal_length = given["fl_x"], given["fl_y"] or given["fl_x"]
        size = int(given["h"]), int(given["w"])
        pose = np.array(frame.transform_matrix) @ _TO_OPENCV
        camera = camera_from_pose(pose, focal_length, (given["cx"], given["cy"]), size, where)
        image, depth = (path_inside(folder, name) for name in (frame.file_path, frame.depth_file_path))
        mask = None if frame.mask_path is None else path_inside(folder, frame.mask_path)
        distortion = tuple(given[name] or 0.0 for name in ("k1", "k2", "p1", "p2", "k3"))
        unit = content.depth_unit_scale_factor
        frames.append(CaptureFrame(image, depth, camera, float(number), unit, distortion, mask))
    if not frames:
        raise InputError(f"{path}: none of {len(content.frames)} frames has depth_file_path, expected RGB-D frames")
    return frames
