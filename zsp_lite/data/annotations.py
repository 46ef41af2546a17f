"""Records of CO3D's annotation files (v1 and v2), read with msgspec.

The frame annotations of a category can hold 86,000 frames in 100 MB of JSON. `read_frame_index`
decodes the sequence name and number of each frame only; `FrameIndex.frame` decodes and validates a
whole entry.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from zsp_lite.data.cameras import NDC_NORM_IMAGE_BOUNDS
from zsp_lite.errors import MAX_LENGTH, InputError
from zsp_lite.io.files import decode_json, decompress, read_bytes, without_nan

FRAMES_FILE = "frame_annotations.jgz"
SEQUENCES_FILE = "sequence_annotations.jgz"
Row = tuple[float, float, float]


# `gc=False`: Python's search for reference cycles skips these records, which cannot form any.
class ImageAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    size: tuple[int, int]  # (height, width)


class DepthAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    # Factor from stored depth to depth.
    scale_adjustment: Annotated[float, msgspec.Meta(gt=0, le=MAX_LENGTH)]
    mask_path: str | None = None


class MaskAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    mass: float | None = None  # sum of the mask's probabilities over all pixels


class Viewpoint(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """PyTorch3D camera (see `Camera.from_pytorch3d`); v1 files have no `intrinsics_format`."""

    R: tuple[Row, Row, Row]
    T: Row
    focal_length: tuple[float, float]
    principal_point: tuple[float, float]
    intrinsics_format: Literal["ndc_norm_image_bounds", "ndc_isotropic"] = NDC_NORM_IMAGE_BOUNDS


class FrameAnnotation(msgspec.Struct, frozen=True):
    """Files and camera of a frame. `frame_number` starts at 0, `frame_timestamp` is in seconds."""

    sequence_name: str
    frame_number: int
    image: ImageAnnotation
    frame_timestamp: float | None = None
    depth: DepthAnnotation | None = None
    mask: MaskAnnotation | None = None
    viewpoint: Viewpoint | None = None


class FrameKey(msgspec.Struct, frozen=True, gc=False):
    """Identifier of a frame within its category."""

    sequence_name: str
    frame_number: int


class PointCloudAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    quality_score: float | None = None
    n_points: int | None = None


class SequenceAnnotation(msgspec.Struct, frozen=True):
    sequence_name: str
    category: str
    video: dict | None = None
    point_cloud: PointCloudAnnotation | None = None
    viewpoint_quality_score: float | None = None


@dataclass(frozen=True, eq=False)
class FrameIndex:
    """Frame annotations of a category, in file order."""

    path: Path
    entries: list[msgspec.Raw]  # JSON of each frame
    keys: list[FrameKey]
    # For each sequence, the positions of its frames in `entries`, by frame number in ascending
    # order.
    by_sequence: dict[str, dict[int, int]]

    def positions(self, sequence: str) -> dict[int, int]:
        """Return the positions of a sequence's frames by frame number."""
        if sequence not in self.by_sequence:
            raise InputError(f"frame annotations {self.path} have no frames of {sequence!r}")
        return self.by_sequence[sequence]

    def frame(self, position: int) -> FrameAnnotation:
        """Decode the entry at a position; an InputError names the file, the frame and the field."""
        key = self.keys[position]
        return decode_json(
            self.entries[position],
            FrameAnnotation,
            f"frame annotations {self.path} (entry {position}: frame {key.frame_number} of "
            f"{key.sequence_name})",
        )


def read_frame_index(path: Path) -> FrameIndex:
    """Read the frame annotations of a category; InputError if a frame has two entries."""
    data = read_annotations(path)
    # Two passes that each skip most of the bytes are faster than one that builds every frame.
    keys = decode_json(data, list[FrameKey], f"frame annotations {path}")
    entries = msgspec.json.decode(data, type=list[msgspec.Raw])  # views into `data`, not copies
    by_sequence: dict[str, dict[int, int]] = {}
    for position in sorted(range(len(keys)), key=lambda position: keys[position].frame_number):
        key = keys[position]
        positions = by_sequence.setdefault(key.sequence_name, {})
        first = positions.setdefault(key.frame_number, position)
        if first != position:
            raise InputError(
                f"frame annotations {path}: entries {first} and {position} are both frame "
                f"{key.frame_number} of {key.sequence_name}, expected each frame once"
            )
    return FrameIndex(path, entries, keys, by_sequence)


def read_sequences(path: Path) -> list[SequenceAnnotation]:
    """Read the sequence annotations of a category, in file order."""
    return decode_json(
        read_annotations(path), list[SequenceAnnotation], f"sequence annotations {path}"
    )


def read_annotations(path: Path) -> bytes:
    """Read the JSON of a gzipped annotation file, with null in place of NaN and Infinity."""
    return without_nan(decompress(read_bytes(path, "annotations"), f"annotations {path}"))
