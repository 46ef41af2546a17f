"""Reader of data sets in CO3D's layout (v1 and v2)."""

import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Float64, UInt8

from zsp_lite.data.annotations import (
    FRAMES_FILE,
    SEQUENCES_FILE,
    FrameAnnotation,
    FrameIndex,
    FrameKey,
    SequenceAnnotation,
    read_frame_index,
    read_sequences,
)
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame, check_pixels, read_depth, read_image, read_mask
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.files import path_inside, stable_hash

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

    def select(self, category: str, top: int = 10) -> list[SequenceAnnotation]:
        """Select at most `top` sequences for labelling, those with the best point clouds first."""
        selected = []
        for sequence in self.sequences(category):
            cloud = sequence.point_cloud
            good_cloud = cloud and (cloud.quality_score or 0) > _MIN_CLOUD_QUALITY
            if good_cloud and (sequence.viewpoint_quality_score or 0) > _MIN_VIEW_QUALITY:
                selected.append(sequence)
        return sorted(
            selected,
            key=lambda sequence: (-sequence.point_cloud.quality_score, sequence.sequence_name),
        )[:top]

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
        # A module above this one, imported when it is used.
        return pkgutil.resolve_name("zsp_lite.data.clouds:point_cloud")(self, category, sequence)

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
