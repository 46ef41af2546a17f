"""Frames of one category with their features, each computed once and kept while it is among the last used."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.views import View, crop_size, frame_view, object_crop

FrameKey = tuple[str, int]  # sequence name and frame number
CAPACITY = 128  # frames in memory


class FrameStore:
    """Frames of one category and their features; `timings` are the seconds of all that was `timed`, by stage."""

    def __init__(self, dataset: Co3D, category: str, extractors: Mapping[str, Any], threads: int | None = None):
        """Make an empty store; `threads` are torch's during feature extraction, None leaves them as they are."""
        self.dataset, self.category, self.extractors, self.threads = dataset, category, extractors, threads
        self.timings: dict[str, list[float]] = {}
        self._kept = lru_cache(CAPACITY)(self._read)
        self.extent = cache(self._extent)

    def full_frame(self, key: FrameKey) -> Frame:
        """Read a frame from disk, uncropped."""
        return self.dataset.load(self.dataset.frame(self.category, *key))

    def frame(self, key: FrameKey) -> Frame:
        """Return a frame's object crop, resized to the backbone's input."""
        return self._kept(key)["crop"]

    def describe(self, features: str, key: FrameKey) -> Any:
        """Return what an extractor computes from a frame's crop."""
        kept, extractor = self._kept(key), self.extractors[features]
        if features not in kept:
            # One frame at a time: the last bits of a frame's features must not depend on the rest of a batch.
            with torch_threads(self.threads):
                if hasattr(extractor, "describe"):
                    (kept[features],) = self.timed(features, extractor.describe, [kept["crop"]])
                else:
                    (kept[features],) = self.timed(features, extractor, [kept["crop"].rgb])
        return kept[features]

    def view(self, features: str, key: FrameKey, foreground: str) -> View:
        """Return a frame's crop with its features and foreground (see `views.frame_view`)."""
        kept, name = self._kept(key), (features, foreground)
        if name not in kept:
            kept[name] = frame_view(self.frame(key), self.describe(features, key), foreground)
        return kept[name]

    def timed(self, stage: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function, and add the time that it takes to the `timings` of a stage."""
        start = time.perf_counter()
        found = function(*arguments)
        self.timings.setdefault(stage, []).append(time.perf_counter() - start)
        return found

    def _read(self, key: FrameKey) -> dict[Any, Any]:
        """Read a frame: its crop, to which is added by name what is computed from it."""
        size = crop_size(self.extractors.get("backbone"))
        return {"crop": self.timed("reading", lambda: object_crop(self.full_frame(key), size))}

    def _extent(self, sequence: str) -> tuple[Float[np.ndarray, "3"], float] | None:
        """Return the centre and the diameter of a sequence's object in its world; None without a point cloud.

        They are those of the box of the cloud's points, without the outermost 2 % on each side.
        """
        try:
            points, _ = self.dataset.point_cloud(self.category, sequence)
        except InputError:
            return None
        low, high = np.quantile(points, (0.02, 0.98), axis=0)
        return (low + high) / 2, float(np.linalg.norm(high - low))


@contextmanager
def torch_threads(threads: int | None) -> Iterator[None]:
    """Set the number of torch's threads within a block; None leaves it as it is."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
