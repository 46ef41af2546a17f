"""nerfstudio's transforms.json and its relatives: Blender's scenes, NeRFCapture, instant-ngp."""

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec

from zsp_lite.errors import MAX_LENGTH, InputError
from zsp_lite.importers.capture import (
    FROM_OPENGL,
    CaptureFrame,
    Makers,
    convert_plain,
    find_inside,
    make_frame,
)
from zsp_lite.importers.files import picture_size
from zsp_lite.io.files import read_json

_NAMES = ("transforms.json", "transforms_train.json")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_FISHEYE = "OPENCV_FISHEYE"
_Row = tuple[float | None, float | None, float | None, float | None]  # None: not finite
_Side = Annotated[float, msgspec.Meta(multiple_of=1)]  # pixels; exporters write 640 or 640.0
_Angle = Annotated[float, msgspec.Meta(gt=0, lt=math.pi)]  # radians
_Unit = Annotated[float, msgspec.Meta(gt=0, le=MAX_LENGTH)]
# Coefficient of the distortion; a greater one is a mistake.
_Coefficient = Annotated[float, msgspec.Meta(ge=-100, le=100)]


class _Frame(msgspec.Struct):
    """The values of a frame, those of all frames included."""

    file_path: str
    transform_matrix: Annotated[list[_Row], msgspec.Meta(min_length=3, max_length=4)]
    fl_x: float | None = None
    fl_y: float | None = None
    camera_angle_x: _Angle | None = None
    cx: float | None = None
    cy: float | None = None
    w: _Side | None = None
    h: _Side | None = None
    depth_file_path: str | None = None
    depth_path: str | None = None
    mask_path: str | None = None
    k1: _Coefficient = 0.0
    k2: _Coefficient = 0.0
    p1: _Coefficient = 0.0
    p2: _Coefficient = 0.0
    k3: _Coefficient = 0.0
    k4: _Coefficient = 0.0
    camera_model: str = "OPENCV"
    depth_unit_scale_factor: _Unit = 0.001
    integer_depth_scale: _Unit | None = None  # if given, it counts, not the factor above


def read_nerfstudio(path: str | Path) -> Makers:
    """Read the frames with depth of a folder with transforms.json, or of such a file.

    The depth is in millimetres unless the file has `integer_depth_scale` or
    `depth_unit_scale_factor`.
    """
    path = Path(path)
    if path.suffix != ".json":
        path = next((path / name for name in _NAMES if (path / name).is_file()), path / _NAMES[0])
    common = read_json(path, dict[str, Any], "capture")
    listed = convert_plain(common.pop("frames", None), list[dict[str, Any]], f"{path}, frames")
    for number, frame in enumerate(listed):
        yield partial(_make, path.parent, common | frame, f"{path}, frame {number}")


def _make(folder: Path, values: dict[str, Any], where: str) -> CaptureFrame:
    """Make a frame from its values, those of all frames included."""
    frame = convert_plain(values, _Frame, where)
    depth = frame.depth_file_path or frame.depth_path
    if not depth:
        raise InputError(f"{where}: no depth_file_path or depth_path")
    fisheye = frame.camera_model == _FISHEYE
    if not fisheye and (frame.camera_model not in _MODELS or frame.k4):
        raise InputError(
            f"{where}: camera_model is {frame.camera_model!r} with k4 = {frame.k4:g}, expected one "
            f"of {', '.join(_MODELS)} with k4 = 0, or {_FISHEYE}"
        )
    # OpenCV's order of the coefficients. Only its fisheye model has the term of the eighth
    # power, k4.
    last = (frame.k3, frame.k4) if fisheye else (frame.p1, frame.p2, frame.k3)
    size = (int(frame.h or 0), int(frame.w or 0))
    if 0 in size:
        size = picture_size(find_inside(folder, frame.file_path) or folder / frame.file_path)
    return make_frame(
        folder,
        frame.file_path,
        depth,
        frame.transform_matrix,
        _intrinsics(frame, *size, where),
        where,
        FROM_OPENGL,
        size,
        frame.mask_path,
        fisheye=fisheye,
        depth_unit=frame.integer_depth_scale or frame.depth_unit_scale_factor,
        distortion=(frame.k1, frame.k2, *last),
    )


def _intrinsics(frame: _Frame, height: int, width: int, where: str) -> list[float]:
    """Return fx, fy, cx, cy of a frame; by default both focal lengths are equal."""
    fx = frame.fl_x
    if not fx and not frame.camera_angle_x:
        raise InputError(f"{where}: no focal length, expected fl_x or camera_angle_x")
    if not fx:
        fx = width / 2 / math.tan(frame.camera_angle_x / 2)
    cx = width / 2 if frame.cx is None else frame.cx
    cy = height / 2 if frame.cy is None else frame.cy
    return [fx, frame.fl_y or fx, cx, cy]
