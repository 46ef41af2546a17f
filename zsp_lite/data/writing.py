"""Writer of data sets in CO3D's layout (v1): images, annotations, labels and evaluation pairs."""

import gzip
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float, Real, UInt8, UInt16

from zsp_lite.alignment import Sim3
from zsp_lite.data.annotations import (
    FRAMES_FILE,
    SEQUENCES_FILE,
    DepthAnnotation,
    FrameAnnotation,
    ImageAnnotation,
    MaskAnnotation,
    PointCloudAnnotation,
    SequenceAnnotation,
    Viewpoint,
    read_frame_index,
    read_sequences,
)
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import PoseLabel, label_folder
from zsp_lite.io.files import plain_name, write_atomic
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import write_ply


@dataclass(frozen=True, eq=False)
class SequenceData:
    """Content of a sequence for `write_co3d`; the points are in world coordinates."""

    name: str
    frames: Sequence[Frame]
    timestamps: Sequence[float]  # of each frame, seconds
    points: Real[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    normals: Real[np.ndarray, "n 3"] | None = None
    viewpoint_quality: float | None = None
    point_cloud_quality: float | None = None
    depth_scale_adjustment: float = 1.0  # CO3D's factor from stored depth to depth
    numbers: Sequence[int] = ()  # of the frames; by default from 0 on


def write_co3d(
    root: str | Path, category: str, sequences: Iterable[SequenceData], quality: int = 92
) -> None:
    """Write sequences to ROOT/CATEGORY in CO3D v1's layout; equal input gives equal bytes.

    Other sequences in the folder are kept; those of the same names are replaced. The annotations
    are updated atomically after each sequence, so the folder stays readable if the run is
    interrupted. Only one process can write to a category at a time. `quality` is that of JPEG, 0 to
    100.
    """
    root = Path(root)
    folder = root / plain_name(category, "category")
    frames_path = folder / FRAMES_FILE
    sequences_path = folder / SEQUENCES_FILE
    with writing(folder):
        # The annotations in each file, as (name of the sequence, annotation).
        frames = []
        listed = []
        if frames_path.is_file():
            index = read_frame_index(frames_path)
            frames = [(key.sequence_name, frame) for key, frame in zip(index.keys, index.entries)]
        if sequences_path.is_file():
            listed = [(known.sequence_name, known) for known in read_sequences(sequences_path)]

        for sequence in sequences:
            new_frames, new_sequence = _write_sequence(root, category, sequence, quality)
            _update(sequences_path, listed, sequence.name, [new_sequence])
            _update(frames_path, frames, sequence.name, new_frames)


def write_label(root: str | Path, category: str, label: PoseLabel) -> Path:
    """Write a label, in place of an earlier one of the same sequence, and return the path."""
    path = label_folder(root, category) / f"{plain_name(label.seq, 'sequence')}.json"
    write_atomic(path, label_bytes(label))
    return path


def label_bytes(label: PoseLabel) -> bytes:
    """Encode a label as JSON in the format of the published code."""
    return json.dumps(vars(label), default=np.ndarray.tolist).encode()


def rigid_label(
    sim3: Sim3, centre: Float[np.ndarray, "3"], seq: str, reference_seq: str
) -> PoseLabel:
    """Convert a similarity to a label with the same rotation and the same image of `centre`."""
    # A label has no scale: with the similarity's translation, an object off the origin would be
    # displaced.
    trans = np.eye(4)
    trans[:3, :3] = sim3.R
    trans[:3, 3] = sim3.apply(centre) - sim3.R @ centre
    return PoseLabel(trans, seq, reference_seq)


def pairs_path(root: str | Path, category: str, n: int, n_targets: int) -> Path:
    """Return ROOT/determ_eval/{n}samples_{n_targets}tgt/CATEGORY.pt."""
    return Path(
        root,
        "determ_eval",
        f"{n}samples_{n_targets}tgt",
        f"{plain_name(category, 'category')}.pt",
    )


def write_published_pairs(path: str | Path, pairs: Sequence[Pair], dataset: Co3D) -> None:
    """Write pairs of one category as an evaluation set in the format of the published code."""
    keys = dataset.frame_list(pairs[0].category)
    position = {(key.sequence_name, key.frame_number): i for i, key in enumerate(keys)}
    items = []
    for pair in pairs:
        reference, *targets = [position[frame] for frame in pair.frames]
        items.append(
            {
                "class": pair.category,
                "reference_seq_name": pair.reference_sequence,
                "reference_frame_id": reference,
                "target_seq_name": pair.target_sequence,
                "all_target_id": targets,
            }
        )
    buffer = io.BytesIO()  # torch.save to a file would store the file's name
    torch.save(items, buffer)
    write_atomic(path, buffer.getvalue())


def write_image(path: str | Path, rgb: UInt8[np.ndarray, "h w 3"], quality: int = 92) -> None:
    """Write colours (H, W, 3) as JPEG of the given quality (0 to 100)."""
    _encode(path, ".jpg", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])


def write_mask(path: str | Path, mask: Real[np.ndarray, "h w"] | Bool[np.ndarray, "h w"]) -> None:
    """Write probabilities (H, W) in [0, 1] as an 8-bit PNG, or a boolean mask as a 1-bit one."""
    options = [cv2.IMWRITE_PNG_BILEVEL, 1] if mask.dtype == bool else []
    _encode(path, ".png", np.rint(mask.astype(np.float64) * 255).astype(np.uint8), options)


def write_depth(
    path: str | Path, depth: Real[np.ndarray, "h w"], scale_adjustment: float = 1.0
) -> None:
    """Write depth (H, W) as a 16-bit PNG in CO3D's encoding (see `encode_depth`)."""
    _encode(path, ".png", encode_depth(depth, scale_adjustment), [])


def encode_depth(
    depth: Real[np.ndarray, "h w"], scale_adjustment: float = 1.0
) -> UInt16[np.ndarray, "h w"]:
    """Encode depth as the bits of float16 values; the inverse of `decode_depth`."""
    depth = np.asarray(depth, dtype=np.float64) / scale_adjustment
    # A value beyond float16's range (65504) would become infinite; it is stored as unknown.
    usable = np.isfinite(depth) & (depth > 0) & (depth <= float(np.finfo(np.float16).max))
    return np.where(usable, depth, 0).astype(np.float16).view(np.uint16)


def compress(data: bytes) -> bytes:
    """Compress with gzip; equal data give equal bytes."""
    # gzip.compress would write the platform into the header. Name and time are left out of it, too.
    buffer = io.BytesIO()
    with gzip.GzipFile(filename="", mode="wb", fileobj=buffer, mtime=0) as file:
        file.write(data)
    return buffer.getvalue()


def _update(path: Path, named: list[tuple[str, Any]], name: str, new: Sequence) -> None:
    """Replace a sequence's annotations in the list, whose last ones they become, and in the file.

    The list holds (name of the sequence, annotation).
    """
    named[:] = [pair for pair in named if pair[0] != name]
    named += [(name, annotation) for annotation in new]
    # A viewpoint holds arrays, which become lists.
    content = msgspec.json.encode(
        [annotation for _, annotation in named], enc_hook=np.ndarray.tolist
    )
    write_atomic(path, compress(content))


def _write_sequence(
    root: Path, category: str, sequence: SequenceData, quality: int
) -> tuple[list[FrameAnnotation], SequenceAnnotation]:
    """Write the files of a sequence; return the annotations of its frames, and of the sequence."""
    base = f"{category}/{plain_name(sequence.name, 'sequence')}"
    annotations = []
    for number, frame, timestamp in zip(
        sequence.numbers or range(len(sequence.frames)),
        sequence.frames,
        sequence.timestamps,
        strict=True,
    ):
        stem = f"frame{number + 1:06d}"  # CO3D numbers frames from 0, and their files from 1
        image = ImageAnnotation(f"{base}/images/{stem}.jpg", frame.camera.size)
        write_image(root / image.path, frame.rgb, quality)
        depth = mask = None
        if frame.depth is not None:
            path = f"{base}/depths/{stem}.jpg.geometric.png"
            mask_path = f"{base}/depth_masks/{stem}.png"
            depth = DepthAnnotation(path, float(sequence.depth_scale_adjustment), mask_path)
            write_depth(root / path, frame.depth, sequence.depth_scale_adjustment)
            write_mask(root / mask_path, frame.depth > 0)
        if frame.mask is not None:
            # The stored 8-bit values are summed, because a sum of integers is the same on every
            # machine.
            mass = int(np.rint(frame.mask.astype(np.float64) * 255).astype(np.int64).sum()) / 255
            mask = MaskAnnotation(f"{base}/masks/{stem}.png", mass)
            write_mask(root / mask.path, frame.mask)
        annotations.append(
            FrameAnnotation(
                sequence.name,
                number,
                image,
                float(timestamp),
                depth,
                mask,
                Viewpoint(**frame.camera.to_pytorch3d()),
            )
        )
    cloud = PointCloudAnnotation(
        f"{base}/pointcloud.ply", sequence.point_cloud_quality, len(sequence.points)
    )
    write_ply(root / cloud.path, sequence.points, sequence.colours, sequence.normals)
    return annotations, SequenceAnnotation(
        sequence.name,
        category,
        point_cloud=cloud,
        viewpoint_quality_score=sequence.viewpoint_quality,
    )


def _encode(path: str | Path, extension: str, image: np.ndarray, options: list[int]) -> None:
    """Write an image file by OpenCV with its options."""
    write_atomic(path, cv2.imencode(extension, image, options)[1].tobytes())
