"""CO3D's annotation files, v1 and v2, as typed records, decoded only as far as asked for.

A category's frame annotations can hold 86,000 frames and 100 MB of JSON. Opening the file finds where each
frame's entry lies and whose it is; an entry is decoded and validated when it is asked for.
"""

import gzip
import io
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from zsp_lite.data.cameras import NDC_NORM_IMAGE_BOUNDS
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes

FRAMES_FILE, SEQUENCES_FILE = "frame_annotations.jgz", "sequence_annotations.jgz"

Triple = tuple[float, float, float]


class ImageAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    size: tuple[int, int]  # (height, width)


class DepthAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    scale_adjustment: float
    mask_path: str | None = None


class MaskAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    mass: float | None = None  # sum of the probabilities, pixels


class Viewpoint(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """PyTorch3D camera: row vectors, +x left, +y up; intrinsics in the units of `intrinsics_format` (absent in v1)."""

    R: tuple[Triple, Triple, Triple]
    T: Triple
    focal_length: tuple[float, float]
    principal_point: tuple[float, float]
    intrinsics_format: str = NDC_NORM_IMAGE_BOUNDS


class FrameAnnotation(msgspec.Struct, frozen=True):
    """One frame: its 0-based number in its sequence, its time (s), its files and its camera; `meta` is v2's."""

    sequence_name: str
    frame_number: int
    image: ImageAnnotation
    frame_timestamp: float | None = None
    depth: DepthAnnotation | None = None
    mask: MaskAnnotation | None = None
    viewpoint: Viewpoint | None = None
    meta: dict | None | msgspec.UnsetType = msgspec.UNSET


class FrameKey(msgspec.Struct, frozen=True, gc=False):
    """What names a frame within its category."""

    sequence_name: str
    frame_number: int


class VideoAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    length: float | None = None  # s


class PointCloudAnnotation(msgspec.Struct, frozen=True, gc=False):
    path: str
    quality_score: float | None = None
    n_points: int | None = None


class SequenceAnnotation(msgspec.Struct, frozen=True):
    sequence_name: str
    category: str
    video: VideoAnnotation | None = None
    point_cloud: PointCloudAnnotation | None = None
    viewpoint_quality_score: float | None = None


@dataclass(frozen=True, eq=False)
class FrameIndex:
    """A category's frame entries, still JSON, in file order, and each sequence's entries by frame number."""

    path: Path
    entries: list[msgspec.Raw]
    keys: list[FrameKey]
    of_sequence: dict[str, list[int]]

    def positions(self, sequence: str) -> list[int]:
        """Where the sequence's frames stand in the file. Raises InputError on an unknown sequence."""
        if sequence not in self.of_sequence:
            raise InputError(f"annotations {self.path} have no frames of a sequence {sequence!r}")
        return self.of_sequence[sequence]

    def frame(self, position: int) -> FrameAnnotation:
        """The decoded entry.

        Raises InputError that names the file, the frame and the field that does not fit.
        """
        key = self.keys[position]
        where = f"{self.path} (entry {position}: frame {key.frame_number} of {key.sequence_name})"
        return decode(self.entries[position], FrameAnnotation, where)


def read_frame_index(path: Path) -> FrameIndex:
    """Open a category's frame annotations. Raises InputError where they cannot be read."""
    data = decompress(path)
    # Two passes over the bytes, each skipping what it does not need, cost less than one that builds every frame.
    keys = decode(data, list[FrameKey], path)
    entries = msgspec.json.decode(data, type=list[msgspec.Raw])  # views into `data`, not copies
    of_sequence: dict[str, list[int]] = {}
    for position, key in enumerate(keys):
        of_sequence.setdefault(key.sequence_name, []).append(position)
    for positions in of_sequence.values():
        positions.sort(key=lambda position: keys[position].frame_number)
    return FrameIndex(path, entries, keys, of_sequence)


def decode(data: bytes | msgspec.Raw, kind: Any, where: str | Path) -> Any:
    """Validated JSON as `kind`. Raises InputError that says where and which field does not fit."""
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.ValidationError as error:
        raise InputError(f"annotations {where}: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(f"annotations {where} are not valid JSON: {error}") from error


def decompress(path: Path) -> bytes:
    """The JSON of an annotation file. Raises InputError where the file is missing or cut off."""
    compressed = read_bytes(path, "annotations")
    try:
        data = gzip.decompress(compressed)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"annotations {path} are not complete gzip data: {error}") from error
    # Python's json writes NaN and Infinity, which JSON does not have. As null they are "not given" where that
    # is allowed and an error that names the field where it is not.
    if b"NaN" in data or b"Infinity" in data:
        data = re.sub(rb"(?<=[:,\[\s])-?(?:NaN|Infinity)(?=[,\]}\s])", b"null", data)
    return data


def compress(data: bytes) -> bytes:
    """Gzip without name and time, so that equal data give equal bytes."""
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, mtime=0) as file:
        file.write(data)
    return buffer.getvalue()
