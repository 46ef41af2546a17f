"""Reader and writer of data sets in CO3D's layout (v1 and v2)."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from jaxtyping import Float64, Real, UInt8

from zsp_lite.data import annotations as records
from zsp_lite.data import frames as images
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.files import path_inside, plain_name, stable_hash, write_atomic
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import read_ply, write_ply

# Of sequences that are worth labelling: the supplement, "Choice of evaluation categories &
# sequences".
_MIN_VIEW_QUALITY, _MIN_CLOUD_QUALITY = 1.25, 0.3


@dataclass(frozen=True)
class Pair:
    """A reference frame of one sequence and the target frames, by their numbers, of another
    sequence of a category."""

    category: str
    reference_sequence: str
    reference_frame: int
    target_sequence: str
    target_frames: tuple[int, ...]
    repeat: int = 0  # number of the evaluation, with random draws of its own

    @property
    def key(self) -> str:
        """Unique identifier of the pair, used in results."""
        targets = ",".join(map(str, self.target_frames))
        reference = f"{self.category}/{self.reference_sequence}:{self.reference_frame}"
        return f"{reference}/{self.target_sequence}:{targets}"

    @classmethod
    def from_key(cls, key: str) -> "Pair":
        """Return the pair with a `key`."""
        category, reference, target = key.split("/")
        first, _, frame = reference.rpartition(":")
        second, _, frames = target.rpartition(":")
        return cls(category, first, int(frame), second, tuple(map(int, frames.split(","))))

    @property
    def seed(self) -> int:
        """Seed of all random draws for this pair; it depends on the key and the repeat only."""
        return stable_hash(f"{self.key} {self.repeat}" if self.repeat else self.key) >> 1


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
                f"data folder {root} {state}, expected a folder with CATEGORY/{records.FRAMES_FILE}"
            )
        self._index: tuple[str, records.FrameIndex] | None = None
        self._sequences: dict[str, list[records.SequenceAnnotation]] = {}

    def categories(self) -> list[str]:
        """List the folders that have frame annotations, sorted by name."""
        return sorted(path.parent.name for path in self.root.glob(f"*/{records.FRAMES_FILE}"))

    def sequences(self, category: str) -> list[records.SequenceAnnotation]:
        """Read the sequence annotations of a category, in file order."""
        if category not in self._sequences:
            self._sequences[category] = records.read_sequences(
                self._category_folder(category) / records.SEQUENCES_FILE
            )
        return list(self._sequences[category])

    def select(self, category: str, top: int = 10) -> list[records.SequenceAnnotation]:
        """Select at most `top` sequences for labelling, those with the best point clouds first."""
        selected = []
        for sequence in self.sequences(category):
            cloud = sequence.point_cloud.quality_score if sequence.point_cloud else None
            views = sequence.viewpoint_quality_score
            if (cloud or 0) > _MIN_CLOUD_QUALITY and (views or 0) > _MIN_VIEW_QUALITY:
                selected.append(sequence)
        return sorted(
            selected, key=lambda one: (-one.point_cloud.quality_score, one.sequence_name)
        )[:top]

    def frame_list(self, category: str) -> list[records.FrameKey]:
        """List the frames in the order of the annotation file, to which the ids of published pairs
        refer."""
        return self._frame_index(category).keys

    def frame_numbers(self, category: str) -> dict[str, list[int]]:
        """List the numbers of the frames of every sequence of a category, in ascending order."""
        return {
            name: list(found) for name, found in self._frame_index(category).by_sequence.items()
        }

    def frames(self, category: str, sequence: str) -> list[records.FrameAnnotation]:
        """Read the frame annotations of a sequence, sorted by frame number."""
        index = self._frame_index(category)
        return [index.frame(position) for position in index.positions(sequence).values()]

    def frame(self, category: str, sequence: str, frame_number: int) -> records.FrameAnnotation:
        """Read the annotation of one frame; its number differs from its position in `frames` if
        frames are missing."""
        index = self._frame_index(category)
        if (position := index.positions(sequence).get(frame_number)) is None:
            raise InputError(f"sequence {category}/{sequence} has no frame number {frame_number}")
        return index.frame(position)

    def camera(self, annotation: records.FrameAnnotation) -> Camera:
        """Convert the viewpoint of a frame to a camera."""
        name = f"{annotation.sequence_name}/{annotation.frame_number}"
        if (view := annotation.viewpoint) is None:
            raise InputError(f"frame {name} has no viewpoint, expected a camera")
        try:
            return Camera.from_pytorch3d(**msgspec.structs.asdict(view), size=annotation.image.size)
        except InputError as error:
            raise InputError(f"frame {name}: {error}") from error

    def load(self, annotation: records.FrameAnnotation) -> Frame:
        """Load the image and camera of a frame, and its depth and mask if annotated.

        Depth is 0 (unknown) where its file is 0 or the depth mask is 0. No path may lead out of the
        data folder.
        """
        camera, size = self.camera(annotation), annotation.image.size
        name = f"{annotation.sequence_name}/{annotation.frame_number}"
        rgb = self._read(images.read_image, annotation.image.path, size)
        mask = depth = None
        if annotation.mask is not None:
            mask = self._read(images.read_mask, annotation.mask.path, size)
        if annotation.depth is not None:
            depth = self._read(
                images.read_depth, annotation.depth.path, size, annotation.depth.scale_adjustment
            )
            if annotation.depth.mask_path is not None:
                valid = self._read(images.read_mask, annotation.depth.mask_path, size) > 0
                depth = np.where(valid, depth, np.float32(0))
        return Frame(rgb, depth, mask, camera, name)

    def load_pair(self, pair: Pair) -> tuple[Frame, list[Frame]]:
        """Load the reference frame and the target frames of an evaluation pair."""
        reference = self.load(
            self.frame(pair.category, pair.reference_sequence, pair.reference_frame)
        )
        targets = [
            self.load(self.frame(pair.category, pair.target_sequence, n))
            for n in pair.target_frames
        ]
        return reference, targets

    def point_cloud(
        self, category: str, sequence: str
    ) -> tuple[Float64[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"] | None]:
        """Read the point cloud of a sequence: points (n, 3) in world coordinates, and RGB colours
        (n, 3) or None."""
        clouds = {one.sequence_name: one.point_cloud for one in self.sequences(category)}
        if (cloud := clouds.get(sequence)) is None:
            raise InputError(f"sequence {category}/{sequence} has no point cloud")
        return read_ply(path_inside(self.root, cloud.path))

    def extent(self, category: str, sequence: str) -> tuple[Float64[np.ndarray, "3"], float] | None:
        """Return the centre and the diameter of a sequence's object in its world; None without a
        point cloud.

        They are those of the box of the cloud's points, without the outermost 2 % on each side.
        """
        clouds = {one.sequence_name: one.point_cloud for one in self.sequences(category)}
        if (cloud := clouds.get(sequence)) is None or not path_inside(
            self.root, cloud.path
        ).is_file():
            return None
        points, _ = self.point_cloud(category, sequence)
        low, high = np.quantile(points, (0.02, 0.98), axis=0)
        return (low + high) / 2, float(np.linalg.norm(high - low))

    def _read(
        self, reader: Callable[..., np.ndarray], relative: str, size: tuple[int, int], *options
    ) -> np.ndarray:
        path = path_inside(self.root, relative)
        image = reader(path, *options)
        images.check_pixels(path, image, size)
        return image

    def _category_folder(self, category: str) -> Path:
        check_choice(f"data folder {self.root}: category", category, self.categories())
        return self.root / category

    def _frame_index(self, category: str) -> records.FrameIndex:
        if self._index is None or self._index[0] != category:
            self._index = None  # frees the previous category's JSON before the next one is read
            self._index = (
                category,
                records.read_frame_index(self._category_folder(category) / records.FRAMES_FILE),
            )
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
    """Write sequences into `root / category` in the layout of CO3D v1; the same input gives the
    same bytes.

    Other sequences in the folder are kept; those of the same names are replaced. The annotations
    are updated atomically after each sequence, so the folder stays readable if the run is
    interrupted. Only one process can write to a category at a time. `quality` is that of JPEG, 0 to
    100.
    """
    root, folder = Path(root), Path(root) / plain_name(category, "category")
    frames_path, sequences_path = folder / records.FRAMES_FILE, folder / records.SEQUENCES_FILE
    with writing(folder):
        frames, listed = [], []  # the name of the sequence, and the entry in the file
        if frames_path.is_file():
            index = records.read_frame_index(frames_path)
            frames = [(key.sequence_name, entry) for key, entry in zip(index.keys, index.entries)]
        if sequences_path.is_file():
            listed = [(one.sequence_name, one) for one in records.read_sequences(sequences_path)]

        for sequence in sequences:
            annotations, annotation = _write_sequence(root, category, sequence, quality)
            frames = [one for one in frames if one[0] != sequence.name] + [
                (sequence.name, one) for one in annotations
            ]
            listed = [one for one in listed if one[0] != sequence.name] + [
                (sequence.name, annotation)
            ]
            for path, entries in ((frames_path, frames), (sequences_path, listed)):
                content = msgspec.json.encode(
                    [entry for _, entry in entries], enc_hook=np.ndarray.tolist
                )
                write_atomic(path, records.compress(content))


def _write_sequence(
    root: Path, category: str, sequence: SequenceData, quality: int
) -> tuple[list[records.FrameAnnotation], records.SequenceAnnotation]:
    base = f"{category}/{plain_name(sequence.name, 'sequence')}"
    annotations = []
    for number, (frame, timestamp) in enumerate(
        zip(sequence.frames, sequence.timestamps, strict=True)
    ):
        stem = f"frame{number + 1:06d}"
        image = records.ImageAnnotation(f"{base}/images/{stem}.jpg", frame.camera.size)
        images.write_image(root / image.path, frame.rgb, quality)
        depth = mask = None
        if frame.depth is not None:
            path = f"{base}/depths/{stem}.jpg.geometric.png"
            mask_path = f"{base}/depth_masks/{stem}.png"
            depth = records.DepthAnnotation(path, float(sequence.depth_scale_adjustment), mask_path)
            images.write_depth(root / path, frame.depth, sequence.depth_scale_adjustment)
            images.write_mask(root / mask_path, frame.depth > 0)
        if frame.mask is not None:
            # The stored 8-bit values are summed, because a sum of integers is the same on every
            # machine.
            mass = int(np.rint(frame.mask.astype(np.float64) * 255).astype(np.int64).sum()) / 255
            mask = records.MaskAnnotation(f"{base}/masks/{stem}.png", mass)
            images.write_mask(root / mask.path, frame.mask)
        view = records.Viewpoint(**frame.camera.to_pytorch3d())  # its arrays are written as lists
        annotations.append(
            records.FrameAnnotation(
                sequence.name, number, image, float(timestamp), depth, mask, view
            )
        )
    cloud = records.PointCloudAnnotation(
        f"{base}/pointcloud.ply", sequence.point_cloud_quality, len(sequence.points)
    )
    write_ply(root / cloud.path, sequence.points, sequence.colours, sequence.normals)
    return annotations, records.SequenceAnnotation(
        sequence.name, category, None, cloud, sequence.viewpoint_quality
    )
