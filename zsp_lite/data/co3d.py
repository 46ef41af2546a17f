"""Reader and writer of data sets in CO3D's layout (v1 and v2)."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float64, Real, UInt8

from zsp_lite.data.annotations import (
    FRAMES_FILE,
    SEQUENCES_FILE,
    DepthAnnotation,
    FrameAnnotation,
    FrameIndex,
    FrameKey,
    ImageAnnotation,
    MaskAnnotation,
    PointCloudAnnotation,
    SequenceAnnotation,
    Viewpoint,
    compress,
    read_frame_index,
    read_sequences,
)
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import (
    Frame,
    check_pixels,
    read_depth,
    read_image,
    read_mask,
    write_depth,
    write_image,
    write_mask,
)
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.files import path_inside, plain_name, stable_hash, write_atomic
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import read_ply, write_ply

# Sequences with greater qualities are worth labelling ("Choice of evaluation categories &
# sequences" of the supplement).
_MIN_VIEW_QUALITY = 1.25
_MIN_CLOUD_QUALITY = 0.3


@dataclass(frozen=True)
class Pair:
    """A reference frame of one sequence and target frames of another, by their numbers."""

    category: str
    reference_sequence: str
    reference_frame: int
    target_sequence: str
    target_frames: tuple[int, ...]
    # Number of the evaluation: each repetition has other random draws.
    repeat: int = 0

    @property
    def key(self) -> str:
        """Identifier of the frames, used in results; repetitions of a pair share it."""
        targets = ",".join(map(str, self.target_frames))
        reference = f"{self.category}/{self.reference_sequence}:{self.reference_frame}"
        return f"{reference}/{self.target_sequence}:{targets}"

    @property
    def frames(self) -> list[tuple[str, int]]:
        """Sequence and number of each frame, the reference's first."""
        targets = [(self.target_sequence, number) for number in self.target_frames]
        return [(self.reference_sequence, self.reference_frame), *targets]

    @classmethod
    def from_key(cls, key: str) -> "Pair":
        """Return the pair with a `key`, and the repeat 0."""
        category, reference, target = key.split("/")
        reference_sequence, _, reference_frame = reference.rpartition(":")
        target_sequence, _, frames = target.rpartition(":")
        return cls(
            category,
            reference_sequence,
            int(reference_frame),
            target_sequence,
            tuple(map(int, frames.split(","))),
        )

    @property
    def seed(self) -> int:
        """Seed of all random draws for this pair; it depends on the key and the repeat only."""
        name = f"{self.key} {self.repeat}" if self.repeat else self.key
        return stable_hash(name) >> 1  # 63 of the 64 bits, because tables hold it as int64


class Co3D:
    """A data set in CO3D's layout: ROOT/CATEGORY/frame_annotations.jgz and the files named there.

    Annotations are read at the first access to a category. The frame annotations of one category
    stay in memory (about 100 MB for the largest), so process the categories one after the other.
    All methods raise InputError, which names category, sequence, frame, file or field, for what is
    unknown, missing or invalid.
    """

    def __init__(self, root: str | Path):
        """Open the data set in the folder `root`; InputError if there is no such folder."""
        self.root = Path(root)
        if not self.root.is_dir():
            state = "is not a folder" if self.root.exists() else "does not exist"
            raise InputError(
                f"data folder {root} {state}, expected a folder with CATEGORY/{FRAMES_FILE}"
            )
        self._index: tuple[str, FrameIndex] | None = None
        self._sequences: dict[str, list[SequenceAnnotation]] = {}

    def categories(self) -> list[str]:
        """List the folders that have frame annotations, sorted by name."""
        return sorted(path.parent.name for path in self.root.glob(f"*/{FRAMES_FILE}"))

    def sequences(self, category: str) -> list[SequenceAnnotation]:
        """Read the sequence annotations of a category, in file order."""
        if category not in self._sequences:
            self._sequences[category] = read_sequences(
                self._category_folder(category) / SEQUENCES_FILE
            )
        return list(self._sequences[category])

    def select(self, category: str) -> list[SequenceAnnotation]:
        """Select at most ten sequences for labelling, those with the best point clouds first."""
        selected = []
        for sequence in self.sequences(category):
            cloud = sequence.point_cloud
            good_cloud = cloud and (cloud.quality_score or 0) > _MIN_CLOUD_QUALITY
            if good_cloud and (sequence.viewpoint_quality_score or 0) > _MIN_VIEW_QUALITY:
                selected.append(sequence)
        return sorted(
            selected,
            key=lambda sequence: (-sequence.point_cloud.quality_score, sequence.sequence_name),
        )[:10]

    def frame_list(self, category: str) -> list[FrameKey]:
        """List sequence and number of all frames, in the file's order.

        The ids of published pairs are positions in this list.
        """
        return self._frame_index(category).keys

    def frame_numbers(self, category: str) -> dict[str, list[int]]:
        """List the numbers of the frames of every sequence of a category, in ascending order."""
        by_sequence = self._frame_index(category).by_sequence
        # The keys of the positions are the frame numbers.
        return {name: list(positions) for name, positions in by_sequence.items()}

    def frames(self, category: str, sequence: str) -> list[FrameAnnotation]:
        """Read the frame annotations of a sequence, sorted by frame number."""
        index = self._frame_index(category)
        return [index.frame(position) for position in index.positions(sequence).values()]

    def frame(self, category: str, sequence: str, frame_number: int) -> FrameAnnotation:
        """Read the annotation of the frame with a number, which need not be its position."""
        index = self._frame_index(category)
        position = index.positions(sequence).get(frame_number)
        if position is None:
            raise InputError(f"sequence {category}/{sequence} has no frame number {frame_number}")
        return index.frame(position)

    def camera(self, annotation: FrameAnnotation) -> Camera:
        """Convert the viewpoint of a frame's annotation to a camera."""
        name = f"{annotation.sequence_name}/{annotation.frame_number}"
        view = annotation.viewpoint
        if view is None:
            raise InputError(f"frame {name} has no viewpoint, expected a camera")
        try:
            return Camera.from_pytorch3d(**msgspec.structs.asdict(view), size=annotation.image.size)
        except InputError as error:
            raise InputError(f"frame {name}: {error}") from error

    def load(self, annotation: FrameAnnotation) -> Frame:
        """Load the image and camera of a frame, and its depth and mask if annotated.

        Depth is 0 (unknown) where its file is 0 or the depth mask is 0. No path may lead out of the
        data folder.
        """
        camera = self.camera(annotation)
        size = annotation.image.size
        rgb = self._read(read_image, annotation.image.path, size)
        mask = None
        if annotation.mask is not None:
            mask = self._read(read_mask, annotation.mask.path, size)
        depth = None
        if annotation.depth is not None:
            depth = self._read(
                read_depth, annotation.depth.path, size, annotation.depth.scale_adjustment
            )
            if annotation.depth.mask_path is not None:
                valid = self._read(read_mask, annotation.depth.mask_path, size) > 0
                depth = np.where(valid, depth, np.float32(0))
        name = f"{annotation.sequence_name}/{annotation.frame_number}"
        return Frame(rgb, depth, mask, camera, name)

    def load_pair(self, pair: Pair) -> tuple[Frame, list[Frame]]:
        """Load the reference frame and the target frames of an evaluation pair."""
        reference, *targets = [
            self.load(self.frame(pair.category, *frame)) for frame in pair.frames
        ]
        return reference, targets

    def point_cloud(
        self, category: str, sequence: str
    ) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"] | None]:
        """Read a sequence's point cloud: world points (n, 3), and RGB colours (n, 3) or None."""
        path = self._cloud_path(category, sequence)
        if path is None:
            raise InputError(f"sequence {category}/{sequence} has no point cloud")
        return read_ply(path)

    def extent(self, category: str, sequence: str) -> tuple[Float64[np.ndarray, "3"], float] | None:
        """Return the centre and the diameter of a sequence's object in its world.

        Both describe the box around the points of its cloud, without the outermost 2 % on each
        side. None without a point cloud.
        """
        path = self._cloud_path(category, sequence)
        if path is None or not path.is_file():
            return None
        points, _ = read_ply(path)
        low, high = np.quantile(points, (0.02, 0.98), axis=0)
        return (low + high) / 2, float(np.linalg.norm(high - low))

    def _cloud_path(self, category: str, sequence: str) -> Path | None:
        """Return the path of a sequence's point cloud, None if the annotations have none."""
        clouds = {known.sequence_name: known.point_cloud for known in self.sequences(category)}
        cloud = clouds.get(sequence)
        return None if cloud is None else path_inside(self.root, cloud.path)

    def _read(
        self, reader: Callable[..., np.ndarray], relative: str, size: tuple[int, int], *options: Any
    ) -> np.ndarray:
        """Read an image of the folder by a function of its path and options, and check its size."""
        path = path_inside(self.root, relative)
        image = reader(path, *options)
        check_pixels(path, image, size)
        return image

    def _category_folder(self, category: str) -> Path:
        """Return the folder of a category; InputError for an unknown one."""
        check_choice(f"data folder {self.root}: category", category, self.categories())
        return self.root / category

    def _frame_index(self, category: str) -> FrameIndex:
        """Return the frame annotations of a category, and keep them until another is asked for."""
        if self._index is None or self._index[0] != category:
            self._index = None  # frees the previous category's JSON before the next one is read
            path = self._category_folder(category) / FRAMES_FILE
            self._index = (category, read_frame_index(path))
        return self._index[1]


@dataclass(frozen=True, eq=False)
class SequenceData:
    """Content of a sequence for `write_co3d`; the points are in world coordinates."""

    name: str
    frames: Sequence[Frame]  # numbered from 0 in this order
    timestamps: Sequence[float]  # of each frame, seconds
    points: Real[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"]
    normals: Real[np.ndarray, "n 3"] | None = None
    viewpoint_quality: float | None = None
    point_cloud_quality: float | None = None
    depth_scale_adjustment: float = 1.0  # CO3D's factor from stored depth to depth


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
    for number, (frame, timestamp) in enumerate(
        zip(sequence.frames, sequence.timestamps, strict=True)
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
