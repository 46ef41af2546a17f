"""RGB-D captures: the files and camera of a frame, how they become a `Frame`, and a reader for each format."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import Camera, camera_from_pose
from zsp_lite.data.frames import Frame, check_pixels, enlarge_depth, read_image
from zsp_lite.errors import MAX_LENGTH, InputError
from zsp_lite.importers import files
from zsp_lite.io.files import decode_json, path_inside, read_bytes, read_json

# OpenCV's and Open3D's pixel centres are at integers: subtract this from an intrinsic matrix with half-integer centres.
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # +y up, looking along -z
_FARTHEST = 1e4  # greatest known depth, in units of the world
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_Row = tuple[float, float, float, float]
_Side = Annotated[float, msgspec.Meta(multiple_of=1)]  # pixels; exporters write 640 or 640.0
_Coefficient = Annotated[float, msgspec.Meta(ge=-100, le=100)]  # of the distortion


@dataclass(frozen=True, eq=False)
class CaptureFrame:
    """Files and camera of a frame."""

    image: Path
    depth: Path  # of the image's aspect ratio; phones store it smaller than the image
    camera: Camera
    depth_unit: float = 0.001  # world units per stored depth value
    distortion: tuple[float, ...] = ()  # OpenCV's k1, k2, p1, p2, k3; image, depth and mask are undistorted
    mask: Path | None = None
    label: int | None = None  # of the object, where masks have the labels of several
    orientation: str | None = None  # "stored" or "displayed": how camera, depth and mask refer to a turned photograph
    posed: bool = True  # False for a single image, whose world is its camera's frame

    def load(self) -> Frame:
        """Load the frame as viewers display it; InputError if a file is missing, damaged or of another size."""
        rgb, turn = files.read_picture(self.image)
        depth = files.read_depth_file(self.depth) * np.float32(self.depth_unit)
        mask = files.read_mask_file(self.mask, self.label) if self.has_mask else None
        lies_stored = partial(files.lies_as_stored, rgb.shape, turn, self.orientation, self.image)
        camera = self.camera
        if lies_stored(camera.size):
            camera = files.display_camera(camera, turn, self.image.name, self.posed)
        if lies_stored(depth.shape):
            depth = files.display_image(depth, turn)
        if mask is not None and lies_stored(mask.shape):
            mask = files.display_image(mask, turn)
        rgb, size = files.display_image(rgb, turn), camera.size
        enlarged = enlarge_depth(np.where(depth > _FARTHEST, np.float32(0), depth), size)
        for path, pixels in ((self.image, rgb), (self.mask, mask)):
            if pixels is not None:
                check_pixels(path, pixels, size)
        if enlarged.shape != size:
            expected = f"(H, W) = {size} as the image, or smaller with its aspect ratio"
            raise InputError(f"depth {self.depth} is {depth.shape} pixels, expected {expected}")
        if any(self.distortion):
            k1, k2, p1, p2, k3 = self.distortion
            p2, p1 = (camera.R @ self.camera.R.T)[:2, :2] @ (p2, p1)  # a vector, which turns with the image
            matrix, coefficients = camera.K - HALF_PIXEL, np.array([k1, k2, p1, p2, k3])
            maps = cv2.initUndistortRectifyMap(matrix, coefficients, None, matrix, size[::-1], cv2.CV_32FC1)
            rgb = cv2.remap(rgb, *maps, cv2.INTER_LINEAR)
            enlarged = cv2.remap(enlarged, *maps, cv2.INTER_NEAREST)
            mask = None if mask is None else cv2.remap(mask, *maps, cv2.INTER_LINEAR)
        return Frame(rgb, enlarged, mask, camera, self.image.name)

    @property
    def has_mask(self) -> bool:
        """Whether there is a file of the frame's mask."""
        return self.mask is not None and self.mask.is_file()


def evenly_spaced(frames: Sequence[CaptureFrame], count: int) -> list[CaptureFrame]:
    """Select at most `count` evenly spaced frames, with the first and the last."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
    return [frames[index] for index in chosen]


def files_by_stem(folder: str | Path) -> dict[str, Path]:
    """Return the files of a folder by their names without extension; links may not lead out of it."""
    return {path.stem: path_inside(folder, path.name) for path in sorted(Path(folder).glob("*"))}


class _NerfstudioFrame(msgspec.Struct):
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


def read_nerfstudio(folder: str | Path) -> list[CaptureFrame]:
    """Read the frames with depth of nerfstudio's transforms.json, which phone scanners export.

    The depth is in millimetres unless the file has `depth_unit_scale_factor`.
    """
    path = path_inside(folder, "transforms.json")
    common, frames = read_json(path, dict[str, Any], "capture"), []
    listed = decode_json(msgspec.json.encode(common.pop("frames", None)), list[dict[str, Any]], f"{path}, frames")
    for number, own in enumerate(listed):
        if own.get("depth_file_path") is None:
            continue
        where = f"{path}, frame {number}"
        frame = decode_json(msgspec.json.encode(common | own), _NerfstudioFrame, where)
        if frame.camera_model not in _MODELS or frame.k4:
            found = f"{frame.camera_model!r} with k4 = {frame.k4:g}"
            raise InputError(f"{where}: camera_model is {found}, expected one of {', '.join(_MODELS)} with k4 = 0")
        pose = np.array(frame.transform_matrix) @ _FROM_OPENGL
        intrinsics, size = (frame.fl_x, frame.fl_y or frame.fl_x, frame.cx, frame.cy), (int(frame.h), int(frame.w))
        camera = camera_from_pose(pose, intrinsics, size, where)
        image, depth = path_inside(folder, frame.file_path), path_inside(folder, frame.depth_file_path)
        mask = None if frame.mask_path is None else path_inside(folder, frame.mask_path)
        distortion = frame.k1, frame.k2, frame.p1, frame.p2, frame.k3  # OpenCV's order; its model has no r^8 term, k4
        frames.append(CaptureFrame(image, depth, camera, frame.depth_unit_scale_factor, distortion, mask))
    if not frames:
        raise InputError(f"{path}: none of {len(listed)} frames has depth_file_path, expected RGB-D frames")
    return frames


def read_lists(folder: str | Path, depth_unit: float = 0.001) -> list[CaptureFrame]:
    """Read a capture given as plain text lists: line n of each describes frame n.

    rgb.txt, depth.txt: one file name per line; `depth_unit` is in world units per stored depth value
    poses.txt: one camera-to-world matrix per line, 12 or 16 numbers in row-major order, in OpenCV's axes
    intrinsics.txt: the 3 x 3 matrix K in pixels, with pixel centres at half-integers
    masks/: if it is there, a mask file for each image, of the image's name with any extension
    """
    lists = {name: _read_lines(folder, name) for name in ("rgb.txt", "depth.txt", "poses.txt")}
    counts = {name: len(lines) for name, lines in lists.items()}
    if len(set(counts.values())) > 1:
        found = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise InputError(f"capture {folder}: the lists have lines: {found}; expected equal numbers")
    K = _numbers(_read_lines(folder, "intrinsics.txt"), f"{folder}/intrinsics.txt", (3,))
    if K.shape != (3, 3) or K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]].tolist() != [0, 0, 0, 0, 1]:
        raise InputError(f"{folder}/intrinsics.txt is {K.tolist()}, expected fx 0 cx, 0 fy cy, 0 0 1 in pixels")
    intrinsics = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    poses = _numbers(lists["poses.txt"], f"{folder}/poses.txt", (12, 16))
    masks, size = files_by_stem(Path(folder) / "masks"), read_image(path_inside(folder, lists["rgb.txt"][0])).shape[:2]
    frames = []
    for number, (image, depth, pose) in enumerate(zip(lists["rgb.txt"], lists["depth.txt"], poses, strict=True), 1):
        image, depth = path_inside(folder, image), path_inside(folder, depth)
        matrix = np.array([*pose, 0, 0, 0, 1][:16]).reshape(4, 4)
        camera = camera_from_pose(matrix, intrinsics, size, f"capture {folder}, line {number} of the lists")
        frames.append(CaptureFrame(image, depth, camera, depth_unit, mask=masks.get(image.stem)))
    return frames


def _read_lines(folder: str | Path, name: str) -> list[str]:
    """Read the lines of a text file, without comments (#) and empty lines."""
    text = read_bytes(path_inside(folder, name), "list").decode("utf-8", "replace")
    if not (lines := [line for part in text.splitlines() if (line := part.split("#")[0].strip())]):
        raise InputError(f"{folder}/{name} is empty, expected at least 1 line")
    return lines


def _numbers(lines: list[str], where: str, columns: tuple[int, ...]) -> Float[np.ndarray, "rows columns"]:
    """Convert lines to numbers, as many in each as one of `columns`."""
    try:
        values = np.loadtxt(lines, ndmin=2)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error
    if values.shape[1] not in columns:
        raise InputError(f"{where}: {values.shape[1]} numbers per line, expected {' or '.join(map(str, columns))}")
    return values


READERS: dict[str, Callable[..., list[CaptureFrame]]] = {"nerfstudio": read_nerfstudio, "lists": read_lists}
SIGNS = {"nerfstudio": "transforms.json", "lists": "poses.txt"}  # files by which a format is recognised
