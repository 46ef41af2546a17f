"""Import of uCO3D (Liu et al., UnCommon Objects in 3D, CVPR 2025), as its own script downloads it.

ROOT/metadata.sqlite has the tables `sequence_annots` and `frame_annots`.
ROOT/SUPER/CATEGORY/SEQUENCE/ has videos of images and of masks, depth maps in an HDF5 file, and the
point cloud of the object.
"""

import logging
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from jaxtyping import Float, Float32

from zsp_lite.data.cameras import NDC_ISOTROPIC, Camera
from zsp_lite.data.depth import zero_unknown
from zsp_lite.data.evaluation import spread
from zsp_lite.data.frames import MAX_PIXELS, Frame, check_pixels
from zsp_lite.data.labels import PoseLabel
from zsp_lite.data.writing import SequenceData, label_bytes, write_co3d
from zsp_lite.errors import (
    InputError,
    check_choice,
    check_magnitude,
    check_number,
    rotation_matrix,
)
from zsp_lite.importers.capture import HALF_PIXEL, convert_plain
from zsp_lite.importers.convert import (
    MIN_VIEWS,
    ImportResult,
    LazyFrames,
    is_imported,
    scale_frame,
)
from zsp_lite.importers.unpacked import Video
from zsp_lite.io.files import file_size, path_inside, write_atomic
from zsp_lite.io.ply import read_ply
from zsp_lite.points import axis_deviation

logger = logging.getLogger(__name__)

_METADATA = "metadata.sqlite"
# Limits of a query. The rows of a sequence need some 10,000 steps of SQLite's machine; a search
# through the rows of all categories needs hundreds of millions.
_MOST_STEPS = 1_000_000
_LONGEST_VALUE = 1 << 20  # bytes; the longest values are captions
# A frame agrees if the median distance of its depth from the point cloud is below this multiple of
# the object's standard deviation: most of its points can then be inliers of RANSAC. The depth is
# from a network and may be wrong.
_TOLERANCE = 0.2
# Number of cells along the longer side of an image. The camera sees the nearest point of the cloud
# in each cell: an object covers several hundred cells, and a cloud has points in all of them.
_CELLS = 48
_GREY = 128  # colour of points without colours
_LONGEST_VIDEO = 1e6  # seconds
# Columns whose names begin with no underscore.
_PLAIN_COLUMNS = ("sequence_name", "frame_number", "frame_timestamp")
# The reference of the proposed labels: uCO3D's aligned frame, which is the world of no sequence.
_ALIGNED_FRAME = "uco3d"
_ATTRIBUTION = """\
# Authors and licence

The sequences are from **uCO3D**: Liu et al., *UnCommon Objects in 3D*, CVPR 2025,
<https://uco3d.github.io>, under [CC BY 4.0](https://creativecommons.org/licenses/by/4.0/).

Changes: some frames of each video were chosen and undistorted, and all lengths were scaled.
"""


def _column(field: str) -> str:
    """Return the column of a field; most columns begin with an underscore."""
    return field if field in _PLAIN_COLUMNS else f"_{field}"


class _Row(msgspec.Struct, rename=_column):
    """A row of a table, in which arrays of numbers are blobs."""

    sequence_name: str

    def numbers(self, field: str, shape: tuple[int, ...], kind: str = "<f4") -> np.ndarray:
        """Decode a blob of four bytes per number to an array; `kind` is the type of its numbers."""
        blob = getattr(self, field)
        expected = 4 * int(np.prod(shape))
        if len(blob) != expected:
            raise InputError(
                f"{_column(field)} has {len(blob)} bytes, expected {expected} for numbers of "
                f"shape {shape}"
            )
        values = np.frombuffer(blob, kind).reshape(shape).astype(np.float64)
        check_magnitude(_column(field), values)
        return values


class _SequenceRow(_Row):
    """A row of `sequence_annots`; paths are relative to ROOT."""

    video_path: str
    mask_video_path: str
    depth_video_path: str  # the HDF5 file
    segmented_point_cloud_path: str
    reconstruction_quality_viewpoint: float | None
    alignment_R: bytes | None  # see `_Sequence._label`
    alignment_T: bytes | None


class _FrameRow(_Row):
    """A row of `frame_annots`."""

    frame_number: int
    frame_timestamp: Annotated[float, msgspec.Meta(ge=0, le=_LONGEST_VIDEO)]  # seconds
    depth_scale_adjustment: float
    image_size: bytes
    viewpoint_R: bytes
    viewpoint_T: bytes
    viewpoint_focal_length: bytes
    viewpoint_principal_point: bytes
    viewpoint_colmap_distortion_coeffs: bytes

    def depth_name(self) -> str:
        """Return the name of the frame's depth map."""
        return str(self.frame_number + 1)  # maps are numbered from 1

    def distortion(self) -> Float[np.ndarray, "12"]:
        """Return the coefficients of OpenCV's rational model with a thin prism."""
        return self.numbers("viewpoint_colmap_distortion_coeffs", (12,))

    def camera(self) -> Camera:
        """Return the camera of the image in the video, without its distortion."""
        height, width = self.numbers("image_size", (2,), "<i4")
        return Camera.from_pytorch3d(
            self.numbers("viewpoint_R", (3, 3)),
            self.numbers("viewpoint_T", (3,)),
            self.numbers("viewpoint_focal_length", (2,)),
            self.numbers("viewpoint_principal_point", (2,)),
            NDC_ISOTROPIC,
            (int(height), int(width)),
        )

    def undistorted(self) -> Camera:
        """Return the camera of the undistorted image, as uCO3D's own code computes it."""
        camera = self.camera()
        # With alpha = 0, all its pixels are inside the image of the video.
        K, _ = cv2.getOptimalNewCameraMatrix(
            camera.K - HALF_PIXEL, self.distortion(), camera.size[::-1], alpha=0
        )
        K = K + HALF_PIXEL
        return replace(camera, focal_length=K[[0, 1], [0, 1]], principal_point=K[:2, 2])


def import_uco3d(
    root: str | Path,
    out: str | Path,
    category: str,
    sequences: Sequence[str] | None = None,
    best: int = 10,
    count: int = 24,
) -> Iterator[tuple[str, ImportResult]]:
    """Write sequences of a category as OUT/CATEGORY/SEQUENCE; yield names and results.

    uCO3D's alignment of the objects becomes pose labels in OUT/label_proposals. Sequences that
    exist in OUT stay as they are. Sequences that cannot be imported are left out with a warning.

    Args:
        root: uCO3D's folder, in which single categories or sequences may be missing.
        out: Data folder.
        category: Name of the category.
        sequences: Names of sequences. By default, those with the best cameras are imported.
        best: Number of sequences that are imported by default.
        count: Number of frames per sequence, evenly spaced among those with a mask and depth.

    Raises:
        InputError: Category or sequence is not on the disk, the metadata are not those of uCO3D, or
            none of the sequences can be imported.
    """
    root = Path(root)
    out = Path(out)
    with closing(_open_metadata(root / _METADATA)) as metadata:
        names = _downloaded(root, category)
        for name in sequences or ():
            check_choice(f"{root}: sequence of {category}", name, names)
        asked = sorted(set(sequences or names))
        placeholders = ", ".join("?" * len(asked))
        rows = _select(
            metadata,
            _SequenceRow,
            f"sequence_annots WHERE sequence_name IN ({placeholders}) "
            "ORDER BY _reconstruction_quality_viewpoint DESC, sequence_name",
            asked,
        )
        if not sequences:
            rows = rows[:best]
        present = False  # whether any of the sequences is in OUT
        problem = "no sequence on the disk is in the metadata"
        for row in rows:
            name = row["sequence_name"]
            if is_imported(out, category, name):
                present = True
                continue
            try:
                sequence = _Sequence(root, metadata, convert_plain(row, _SequenceRow, _METADATA))
                result = sequence.write(out, category, count)
            except InputError as error:
                problem = f"{name}: {error}"
                logger.warning("%s is left out: %s", name, error)
                continue
            present = True
            yield name, result
    if not present:
        raise InputError(f"{root}: no sequence of {category} can be imported: {problem}")


def _open_metadata(path: Path) -> sqlite3.Connection:
    """Open a database for reading, with limits for each query."""
    file_size(path, "uCO3D's metadata")
    metadata = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
    metadata.row_factory = sqlite3.Row
    metadata.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_VALUE)
    metadata.set_progress_handler(lambda: 1, _MOST_STEPS)  # 1 ends the query with an error
    return metadata


def _downloaded(root: Path, category: str) -> list[str]:
    """List the sequences of a category whose folders are on the disk."""
    folders = [path for path in root.glob("*/*") if path.is_dir()]
    check_choice(f"{root}: category", category, sorted({path.name for path in folders}))
    places = [path for path in folders if path.name == category]
    return sorted(path.name for place in places for path in place.iterdir() if path.is_dir())


def _select(
    metadata: sqlite3.Connection, kind: type[_Row], source: str, values: Sequence[str]
) -> list[dict[str, Any]]:
    """Query the columns of a kind of rows; `source` has the table and the conditions."""
    columns = ", ".join(field.encode_name for field in msgspec.structs.fields(kind))
    try:
        rows = metadata.execute(f"SELECT {columns} FROM {source}", values)
        return [dict(row) for row in rows]
    except sqlite3.Error as error:
        raise InputError(
            f"{_METADATA}: {error}, expected uCO3D's tables with their keys"
        ) from error


class _DepthMaps:
    """The depth maps in an HDF5 file, by names; the file is open during each access only."""

    def __init__(self, path: Path):
        self.path = path
        file_size(path, "depth maps")
        with self._open() as file:
            self.names = set(file)

    def read(self, name: str) -> Float32[np.ndarray, "h w"]:
        """Read the stored values of a depth map, which must be in this file itself."""
        import h5py

        with self._open() as file:
            if not isinstance(file.get(name, getlink=True), h5py.HardLink):
                raise ValueError("a link")
            values = file[name]
            if values.external or values.is_virtual:
                raise ValueError("stored in another file")
            if len(values.shape) != 2 or not 0 < values.size <= MAX_PIXELS:
                raise ValueError(f"shape {values.shape}")
            return values.astype(np.float32)[:]

    @contextmanager
    def _open(self) -> Iterator[Any]:
        """Open the file; InputError if it is damaged, or if the block raises an error."""
        try:
            import h5py
        except ImportError as error:
            raise InputError(
                f"{self.path.name} is an HDF5 file, expected its package: pip install h5py"
            ) from error
        try:
            with h5py.File(self.path, "r") as file:
                yield file
        # A damaged file may raise anything; a group has none of the attributes of a depth map.
        except Exception as error:
            raise InputError(
                f"depth maps {self.path}: {error}, expected an HDF5 file of (H, W) numbers"
            ) from error


class _Sequence:
    """A sequence with its open files, and the rows of the frames that can be used."""

    def __init__(self, root: Path, metadata: sqlite3.Connection, row: _SequenceRow):
        self.row = row
        self.points, colours = read_ply(path_inside(root, row.segmented_point_cloud_path))
        self.colours = np.full(self.points.shape, _GREY, np.uint8) if colours is None else colours
        self.deviation = axis_deviation(self.points)
        check_number("standard deviation of the point cloud", self.deviation, above=0)
        self.images = Video(path_inside(root, row.video_path), displayed=True)
        self.masks = Video(path_inside(root, row.mask_video_path), displayed=True)
        self.depths = _DepthMaps(path_inside(root, row.depth_video_path))
        # Frames with a mask, a camera, a time and depth.
        rows = _select(
            metadata,
            _FrameRow,
            "frame_annots WHERE sequence_name = ? AND _mask_mass IS NOT 0 "
            "AND _viewpoint_R IS NOT NULL AND frame_timestamp IS NOT NULL "
            "AND _depth_scale_adjustment > 0 ORDER BY frame_number",
            [row.sequence_name],
        )
        frames = [convert_plain(frame, _FrameRow, _METADATA) for frame in rows]
        self.frames = [frame for frame in frames if frame.depth_name() in self.depths.names]

    def write(self, out: Path, category: str, count: int) -> ImportResult:
        """Write the sequence, its licence and its label, with at most `count` frames.

        Frames whose depth disagrees with the point cloud are left out.
        """
        # Choose frames, and leave out those with wrong depth.
        chosen = [self.frames[position] for position in spread(count, len(self.frames))]
        agreeing = [frame for frame in chosen if self._agrees(frame)]
        if len(agreeing) < MIN_VIEWS:
            raise InputError(
                f"{len(agreeing)} of {len(chosen)} frames have depth that agrees with the point "
                f"cloud, expected {MIN_VIEWS}"
            )
        # Scale the scene.
        scale = 1 / self.deviation
        frames = LazyFrames(lambda frame: scale_frame(self._load(frame), scale), agreeing)
        # Load the last frame: InputError, before anything is written, if the video ends too early.
        frames[-1]
        label = self._label(scale)
        data = SequenceData(
            self.row.sequence_name,
            frames,
            [frame.frame_timestamp for frame in agreeing],
            self.points * scale,
            self.colours,
            viewpoint_quality=self.row.reconstruction_quality_viewpoint,
        )
        # Write the sequence, and beside it the licence and the proposed label.
        write_co3d(out, category, [data])
        write_atomic(out / category / "ATTRIBUTION.md", _ATTRIBUTION.encode())
        if label is not None:
            path = out / "label_proposals" / category / f"{label.seq}.json"
            write_atomic(path, label_bytes(label))
        flags = ()
        left_out = len(chosen) - len(agreeing)
        if left_out:
            flags = (
                f"{left_out} of {len(chosen)} frames left out, whose depth disagrees with the "
                "point cloud",
            )
        return ImportResult(len(agreeing), len(self.points), scale, flags)

    def _load(self, frame: _FrameRow) -> Frame:
        """Load a frame without distortion."""
        stored = frame.camera()
        camera = frame.undistorted()
        size = camera.size[::-1]
        rgb = self.images.at(frame.frame_timestamp)
        mask = self.masks.at(frame.frame_timestamp)
        check_pixels(self.images.path, rgb, camera.size)
        check_pixels(self.masks.path, mask, camera.size)
        maps = cv2.initUndistortRectifyMap(
            stored.K - HALF_PIXEL,
            frame.distortion(),
            np.eye(3),
            camera.K - HALF_PIXEL,
            size,
            cv2.CV_32FC1,
        )
        rgb = cv2.remap(rgb, *maps, cv2.INTER_LINEAR)
        # The three channels of a video of masks are equal.
        mask = cv2.remap(mask[..., 0].astype(np.float32) / 255, *maps, cv2.INTER_LINEAR)
        depth = cv2.resize(self._depth(frame), size, interpolation=cv2.INTER_NEAREST_EXACT)
        return Frame(rgb, depth, mask, camera, f"{frame.sequence_name}/{frame.frame_number}")

    def _depth(self, frame: _FrameRow) -> Float32[np.ndarray, "h w"]:
        """Read the depth of a frame, 0 where unknown; its size need not be the image's."""
        # It is stored undistorted: uCO3D's own code unprojects it by the camera of `undistorted`.
        stored = self.depths.read(frame.depth_name())
        return zero_unknown(stored * np.float32(frame.depth_scale_adjustment))

    def _agrees(self, frame: _FrameRow) -> bool:
        """Whether the depth of a frame lies on the part of the point cloud that the camera sees."""
        depth = self._depth(frame)
        height, width = depth.shape
        pixels, distances = frame.undistorted().resize(depth.shape).project(self.points)
        inside = (
            (distances > 0) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
        )
        columns, rows = pixels[inside].astype(int).T
        distances = distances[inside]
        # In the order of the distances, the first point of each cell is the nearest.
        side = max(height, width) / _CELLS
        cells = (rows // side) * _CELLS + columns // side
        order = np.argsort(distances)
        _, first = np.unique(cells[order], return_index=True)
        front = order[first]
        surface = depth[rows[front], columns[front]]
        known = surface > 0
        errors = np.abs(surface - distances[front])[known]
        return bool(known.any() and np.median(errors) < _TOLERANCE * self.deviation)

    def _label(self, scale: float) -> PoseLabel | None:
        """Return the label from uCO3D's aligned frame to the scaled world, None if not aligned."""
        if self.row.alignment_R is None or self.row.alignment_T is None:
            return None
        rotation = rotation_matrix("_alignment_R", self.row.numbers("alignment_R", (3, 3)))
        translation = scale * self.row.numbers("alignment_T", (3,))
        # uCO3D aligns row vectors: aligned = factor * (x @ R + T). Labels are rigid: the factor is
        # dropped. So for column vectors, x = R @ (aligned - T).
        trans = np.eye(4)
        trans[:3, :3] = rotation
        trans[:3, 3] = -rotation @ translation
        return PoseLabel(trans, self.row.sequence_name, _ALIGNED_FRAME)
