"""A category's frames and what extractors say of them, each worked out once and dropped after its last use."""

import time
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float

from zsp_lite.benchmark.cache import FeatureCache
from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.views import View, crop_size, frame_view, object_crop

FrameKey = tuple[str, int]  # sequence and frame number


@dataclass
class Spent:
    """How often something was done, and the seconds that it took."""

    times: int = 0
    seconds: float = 0.0


@dataclass
class FrameStore:
    """Frames of one category and their descriptions.

    extractors: by name; each is called on a list of images, or, where it has `describe`, on a list of frames.
    cache: where feature maps outlive the process, or None.  threads: of torch while it describes a frame, None for as
    many as it has.  expected: how many more pairs will use a frame; it is forgotten after the last of them.
    spent: what reading, each extractor and the similarities have cost so far.
    """

    dataset: Co3D
    category: str
    extractors: Mapping[str, Any]
    cache: FeatureCache | None = None
    threads: int | None = None
    expected: Counter[FrameKey] = field(default_factory=Counter)
    spent: dict[str, Spent] = field(default_factory=dict)
    _frames: dict[FrameKey, Frame | InputError] = field(default_factory=dict)
    _described: dict[FrameKey, dict[str, Any]] = field(default_factory=dict)
    _views: dict[FrameKey, dict[tuple, View]] = field(default_factory=dict)
    _similarities: dict[tuple, Float[torch.Tensor, "n1 n2"]] = field(default_factory=dict)
    _first_cameras: dict[str, Camera] = field(default_factory=dict)

    def load(self, keys: Iterable[FrameKey]) -> None:
        """Read and crop frames. A file that cannot be read is an error; one without an object fails its pairs."""
        for key in keys:
            if key not in self._frames:
                with self._timed("reading"):
                    frame = self.full_frame(key)
                    try:
                        self._frames[key] = object_crop(frame, crop_size(self.extractors.get("backbone")))
                    except InputError as error:
                        self._frames[key] = error

    def release(self, keys: Iterable[FrameKey]) -> None:
        """A pair is done with these frames."""
        for key in keys:
            self.expected[key] -= 1
            if self.expected[key] <= 0:
                for kept in (self._frames, self._described, self._views):
                    kept.pop(key, None)

    def forget_similarities(self) -> None:
        """The pairs that follow have another reference or another target sequence."""
        self._similarities.clear()

    def full_frame(self, key: FrameKey) -> Frame:
        return self.dataset.load(self.dataset.frame(self.category, *key))

    def frame(self, key: FrameKey) -> Frame:
        """The object crop. Raises InputError where the frame has no object."""
        self.load([key])
        frame = self._frames[key]
        if isinstance(frame, InputError):
            raise frame
        return frame

    def first_camera(self, sequence: str) -> Camera:
        """The camera of a sequence's first frame."""
        if sequence not in self._first_cameras:
            self._first_cameras[sequence] = self.dataset.camera(self.dataset.frames(self.category, sequence)[0])
        return self._first_cameras[sequence]

    def describe(self, features: str, key: FrameKey) -> Any:
        """What an extractor says of a frame's crop."""
        described = self._described.setdefault(key, {})
        if features not in described:
            described[features] = self._extract(features, self.frame(key))
        return described[features]

    def described(self, features: str, key: FrameKey) -> Any | None:
        """`describe`, where that was done already."""
        return self._described.get(key, {}).get(features)

    def view(self, features: str, key: FrameKey, foreground: str, saliency_threshold: float) -> View:
        views, name = self._views.setdefault(key, {}), (features, foreground, saliency_threshold)
        if name not in views:
            feature_map = self.describe(features, key)
            views[name] = frame_view(self.frame(key), feature_map, foreground, saliency_threshold)
        view = views[name]
        # The points depend on the frame and the grid alone: what one row has worked out, others need not.
        for other in views.values():
            if "patch_points" in vars(other) and other.features.grid == view.features.grid:
                vars(view).setdefault("patch_points", other.patch_points)
        return view

    def similarity(
        self, features: str, reference: FrameKey, target: FrameKey, solver: ZeroShotPose, first: View, second: View
    ) -> Float[torch.Tensor, "n1 n2"]:
        """Similarities of two frames' patches, the same for all of the solver's other settings."""
        name = (features, solver.binning, reference, target)
        if name not in self._similarities:
            with self._timed("similarity"):
                (self._similarities[name],) = solver.similarities(first, [second])
        return self._similarities[name]

    def _extract(self, features: str, frame: Frame) -> Any:
        extractor = self.extractors[features]
        if self.cache is not None and (known := self.cache.read(features, frame)) is not None:
            return known
        # One frame at a time: a frame's features, to their last bit, must not depend on which others came with it.
        with self._timed(features), _torch_threads(self.threads):
            if hasattr(extractor, "describe"):
                (found,) = extractor.describe([frame])
            else:
                (found,) = extractor([frame.rgb])
        if self.cache is not None:
            self.cache.write(features, frame, found)
        return found

    @contextmanager
    def _timed(self, what: str):
        start = time.perf_counter()
        yield
        spent = self.spent.setdefault(what, Spent())
        spent.times += 1
        spent.seconds += time.perf_counter() - start


@contextmanager
def _torch_threads(threads: int | None):
    """Let torch use so many threads for a while."""
    before = torch.get_num_threads()
    if threads is None or threads == before:
        yield
        return
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)
