"""Argument and results of a benchmark row: `Problem`, whose frames a `FrameStore` keeps, and `Answer`."""

import time
from collections.abc import Callable, Mapping
from copy import copy, deepcopy
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from typing import Any, Protocol

import numpy as np
import torch
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from zsp_lite.alignment import Sim3
from zsp_lite.best_view import ViewMatch
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, ends_the_run, real_array, rotation_matrix
from zsp_lite.estimates import PoseEstimate
from zsp_lite.features import FeatureMap
from zsp_lite.matching import key_similarities, similarities
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.views import IMAGE_SIZE, View, feature_maps, frame_view, object_crop

FrameKey = tuple[str, int]  # sequence name and frame number
CAPACITY = 128  # frames in memory


@dataclass(frozen=True, eq=False)
class Answer:
    """Pose of the reference object in one of the target views."""

    rotation: Float[np.ndarray, "3 3"]  # from the reference's camera to the camera of the target view
    view: int = 0  # index of the target view
    translation: Float[np.ndarray, "3"] | None = None  # in the target's unit, if the method estimates it
    scale: float | None = None  # if the method estimates it
    note: str = ""  # warning about the pose; "" for none
    inliers: int | None = None  # number of matches that agree with the pose
    confidence: float | None = None  # probability that the rotation error is below 30 degrees


class Row(Protocol):
    """A row of the benchmark's tables: any callable from a `Problem` to a pose.

    A row that takes the pose of the target view whose global feature is most similar to the reference's:

        def most_similar(problem):
            first, *others = (view.features.global_feature for view in problem.views())
            return np.eye(3), int(np.argmax([torch.cosine_similarity(first, other, dim=0) for other in others]))
    """

    def __call__(self, problem: "Problem") -> Answer | PoseEstimate | Sim3 | np.ndarray | tuple[Sim3 | np.ndarray, int]:
        """Estimate the pose of the reference object in one of the target views.

        A Sim3 or a rotation (3, 3) stands alone (target view 0) or with the view's index. InputError says that there is
        no pose: the pair counts as failed, with an error of 180 degrees.
        """
        ...


def as_answer(found: Any) -> Answer:
    """Convert what a row returns to an Answer; InputError if it is none of what `Row` allows."""
    if isinstance(found, PoseEstimate):
        sim3, inliers = found.sim3, int(found.inliers.sum())
        return Answer(sim3.R, found.view, sim3.t, sim3.scale, found.note, inliers, found.confidence)
    if isinstance(found, Answer):
        move, scale = found.translation, 1.0 if found.scale is None else found.scale
        exact = Sim3(scale, found.rotation, np.zeros(3) if move is None else move)  # refuses what is no pose
        return replace(found, rotation=exact.R, translation=None if move is None else exact.t)
    pose, view = found if isinstance(found, tuple) and len(found) == 2 else (found, 0)
    if isinstance(pose, Sim3):
        return Answer(pose.R, int(view), pose.t, pose.scale)
    return Answer(_rotation(pose), int(view))


def _rotation(pose: Any) -> Float[np.ndarray, "3 3"]:
    return rotation_matrix("pose of the row", real_array("pose of the row", pose, (3, 3)))


class FrameStore:
    """Frames of one category and their features; `timings` are the seconds of all that was `timed`, by stage.

    `frame`, `describe` and `view` compute once what they return, and keep it while it is among the last used; `kept` is
    what a row keeps for all pairs. `threads` are those of feature extraction, None leaves them as they are.
    """

    def __init__(self, dataset: Co3D, category: str, extractors: Mapping[str, Any], threads: int | None = None):
        self.dataset, self.category, self.extractors, self.threads = dataset, category, extractors, threads
        self.timings: dict[str, list[float]] = {}
        self.kept: dict[Any, Any] = {}
        self.frame = lru_cache(CAPACITY)(self._frame)
        self.describe = lru_cache(CAPACITY * len(extractors))(self._describe)
        self.view = lru_cache(CAPACITY * len(extractors))(self._view)
        self.extent = cache(partial(dataset.extent, category))

    def _frame(self, key: FrameKey) -> Frame:
        """Return a frame's object crop, resized to the backbone's input."""
        size = getattr(self.extractors.get("backbone"), "image_size", IMAGE_SIZE)
        with ends_the_run(f"reading frame {key[0]}/{key[1]}"):
            annotation = self.dataset.frame(self.category, *key)
            return self.timed("reading", lambda: object_crop(self.dataset.load(annotation), size))

    def _describe(self, features: str, key: FrameKey) -> Any:
        """Return what an extractor computes from a frame's crop."""
        extractor, crop = self.extractors[features], self.frame(key)
        extract = getattr(extractor, "describe", None) or partial(feature_maps, extractor)
        # One frame at a time: the last bits of a frame's features must not depend on the rest of a batch.
        with threadpool_limits(self.threads), ends_the_run(f"features {features!r}"):
            return self.timed(features, extract, [crop])[0]

    def _view(self, features: str, key: FrameKey, foreground: str) -> View:
        """Return a frame's crop with its features and foreground (see `views.frame_view`)."""
        return frame_view(self.frame(key), self.describe(features, key), foreground)

    def with_copies(self) -> "FrameStore":
        """Return the store for a row of one's own: what it returns are copies, which the row may overwrite."""
        store = copy(self)
        for name in ("frame", "describe", "view", "extent"):
            setattr(store, name, lambda *key, shared=getattr(self, name): deepcopy(shared(*key)))
        return store

    def timed(self, stage: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function, and add the time that it takes to the `timings` of a stage."""
        start = time.perf_counter()
        found = function(*arguments)
        self.timings.setdefault(stage, []).append(time.perf_counter() - start)
        return found


class Problem:
    """One pair as a method sees it: everything but the true pose. Results are computed once for all methods."""

    def __init__(self, pair: Pair, store: FrameStore):
        self.pair, self.seed, self.store, self._store = pair, pair.seed, store, store
        targets = [(pair.target_sequence, number) for number in pair.target_frames]
        self.keys: tuple[FrameKey, ...] = (pair.reference_sequence, pair.reference_frame), *targets
        self._estimates: dict[tuple, PoseEstimate] = {}
        self._similarity = cache(self._compare)
        self._hand_over: Callable[[Any], Any] = lambda shared: shared

    def with_copies(self) -> "Problem":
        """Return the problem for a row of one's own: what it returns are copies, which the row may overwrite."""
        problem = copy(self)
        problem.store, problem._hand_over = self.store.with_copies(), deepcopy
        return problem

    def frames(self, depth: bool = False) -> list[Frame]:
        """Return the object crops, the reference's first, resized to the backbone's input.

        With `depth`, InputError, which fails the pair, if one has no depth map.
        """
        frames = [self._store.frame(key) for key in self.keys]
        if depth and (missing := [frame.name for frame in frames if frame.depth is None]):
            raise InputError(f"no depth map: {', '.join(missing)}")
        return self._hand_over(frames)

    def views(self) -> list[View]:
        """Return the crops with the features of the run's backbone, and the foreground that its saliency finds."""
        return self._hand_over([self._store.view("backbone", key, "saliency") for key in self.keys])

    def estimate(
        self, features: str = "backbone", settings: Mapping[str, Any] | None = None, target: int | None = None
    ) -> PoseEstimate:
        """Run the paper's method with other settings of `ZeroShotPose`, on all targets or on the one with an index."""
        settings = settings or {}
        name = (features, target, *sorted(settings.items()))
        if name not in self._estimates:
            method = ZeroShotPose(self._store.extractors[features], **settings, seed=self.seed)
            keys = self.keys if target is None else [self.keys[0], self.keys[1 + target]]
            reference, *targets = (self._store.view(features, key, method.foreground) for key in keys)
            matched = [self._match(method, reference, view) for view in targets]
            self._estimates[name] = method.estimate_from_views(reference, targets, matched)
            for stage, seconds in self._estimates[name].timings.items():
                self._store.timings.setdefault(stage, []).append(seconds)
        return self._hand_over(self._estimates[name])

    def _match(self, method: ZeroShotPose, reference: View, target: View) -> ViewMatch:
        similarity = self._similarity(reference.features, target.features, method.binning)
        return self._store.timed("matching", method.match_views, reference, [target], similarity)[0]

    def _compare(self, reference: FeatureMap, target: FeatureMap, binning: bool) -> list[torch.Tensor]:
        compare = similarities if binning else key_similarities
        return self._store.timed("similarity", compare, reference, [target])
