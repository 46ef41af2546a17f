"""Frames of one category with their features, each computed once and kept while it is among the last used."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.matching import key_similarities, similarities
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.views import IMAGE_SIZE, View, crop_size, frame_view, object_crop

FrameKey = tuple[str, int]  # sequence name and frame number
CAPACITY = 128  # frames in memory
_POINTS = ("patch_points", "measured_points")  # cached properties of a View


@dataclass
class _Entry:
    """A frame's object crop with what has been computed from it."""

    crop: Frame
    descriptions: dict[str, Any] = field(default_factory=dict)
    views: dict[tuple, View] = field(default_factory=dict)


@dataclass
class FrameStore:
    """Frames of one category and their features."""

    dataset: Co3D  # the folder in CO3D's layout
    category: str
    extractors: Mapping[str, Any]  # by name
    threads: int | None = None  # threads of torch during feature extraction; None leaves them as they are
    # Seconds of every frame read ("reading"), every feature extraction (the extractor's name) and every comparison of
    # two frames ("similarity"), since the last `timings.clear()`.
    timings: dict[str, list[float]] = field(default_factory=dict)
    _entries: dict[FrameKey, _Entry] = field(default_factory=dict)
    _extents: dict[str, tuple[np.ndarray, float] | None] = field(default_factory=dict)
    _similarities: dict[tuple, Float[torch.Tensor, "n1 n2"]] = field(default_factory=dict)

    def __post_init__(self):
        backbone = self.extractors.get("backbone")  # rows such as "icp" and "sift" need none
        self._size = IMAGE_SIZE if backbone is None else crop_size(backbone)

    def full_frame(self, key: FrameKey) -> Frame:
        """Read a frame from disk, uncropped."""
        return self.dataset.load(self.dataset.frame(self.category, *key))

    def frame(self, key: FrameKey) -> Frame:
        """Return a frame's object crop, resized to the backbone's input."""
        return self._entry(key).crop

    def first_camera(self, sequence: str) -> Camera:
        """Return the camera of a sequence's first frame."""
        return self.dataset.camera(self.dataset.frames(self.category, sequence)[0])

    def extent(self, sequence: str) -> tuple[Float[np.ndarray, "3"], float] | None:
        """Return the centre and the diameter of a sequence's object in its world; None without a point cloud.

        They are those of the box of the cloud's points, without the outermost 2 % on each side.
        """
        if sequence not in self._extents:
            self._extents[sequence] = None
            with suppress(InputError):
                points, _ = self.dataset.point_cloud(self.category, sequence)
                low, high = np.quantile(points, (0.02, 0.98), axis=0)
                self._extents[sequence] = (low + high) / 2, float(np.linalg.norm(high - low))
        return self._extents[sequence]

    def describe(self, features: str, key: FrameKey) -> Any:
        """Return what an extractor computes from a frame's crop."""
        descriptions = self._entry(key).descriptions
        if features not in descriptions:
            descriptions[features] = self._extract(features, self.frame(key))
        return descriptions[features]

    def description(self, features: str, key: FrameKey) -> Any | None:
        """Return the result of an earlier `describe`, None if there is none."""
        return self._entry(key).descriptions.get(features)

    def view(self, features: str, key: FrameKey, foreground: str) -> View:
        """Return a frame's crop with its features and foreground (see `views.frame_view`)."""
        views, name = self._entry(key).views, (features, foreground)
        if name not in views:
            views[name] = frame_view(self.frame(key), self.describe(features, key), foreground)
        view = views[name]
        # The 3D points of the patches depend on the crop and the grid alone: all views of the frame share them.
        for other in views.values():
            if other.features.grid == view.features.grid:
                vars(view).update({part: vars(other)[part] for part in _POINTS if part in vars(other)})
        return view

    def similarity(
        self, features: str, reference: FrameKey, target: FrameKey, solver: ZeroShotPose, first: View, second: View
    ) -> Float[torch.Tensor, "n1 n2"]:
        """Return the similarities of two frames' patches; those of the last reference and target sequence are kept."""
        problem = (reference, target[0])
        if any(known[:2] != problem for known in self._similarities):
            self._similarities.clear()
        name = (*problem, features, solver.binning, target)
        if name not in self._similarities:
            with self._timed("similarity"):
                compare = similarities if solver.binning else key_similarities
                (self._similarities[name],) = compare(first.features, [second.features])
        return self._similarities[name]

    def _entry(self, key: FrameKey) -> _Entry:
        entry = self._entries.pop(key, None)
        if entry is None:
            with self._timed("reading"):
                entry = _Entry(object_crop(self.full_frame(key), self._size))
        self._entries[key] = entry  # the last used is the last in the dictionary
        if len(self._entries) > CAPACITY:
            del self._entries[next(iter(self._entries))]
        return entry

    def _extract(self, features: str, frame: Frame) -> Any:
        extractor = self.extractors[features]
        # One frame at a time: the last bits of a frame's features must not depend on the rest of a batch.
        with self._timed(features), torch_threads(self.threads):
            (found,) = extractor.describe([frame]) if hasattr(extractor, "describe") else extractor([frame.rgb])
        return found

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.timings.setdefault(stage, []).append(round(time.perf_counter() - start, 5))


@contextmanager
def torch_threads(threads: int | None) -> Iterator[None]:
    """Set the number of torch's threads within a block; None leaves it as it is."""
    before = torch.get_num_threads()
    if threads not in (None, before):
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        if threads not in (None, before):
            torch.set_num_threads(before)
