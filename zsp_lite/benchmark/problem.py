"""What a benchmark row gets and returns: `Problem`, with frames of a `FrameStore`, and `Answer`."""

import inspect
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float
from threadpoolctl import threadpool_limits

from zsp_lite.alignment import Sim3
from zsp_lite.data.clouds import extent
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.evaluation import spread
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError, NoPoseError, ends_the_run
from zsp_lite.estimates import PoseEstimate
from zsp_lite.matching import similarities
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.scans.category import (
    CategoryAlignment,
    PairHypotheses,
    partners,
    synchronise,
    world_hypotheses,
)
from zsp_lite.scans.judge import REFERENCES, Question, asked_positions, judge_pairs
from zsp_lite.scans.shapes import FRAMES, Shape
from zsp_lite.scans.upright import find_up
from zsp_lite.views import IMAGE_SIZE, View, feature_maps, frame_view, object_crop

CAPACITY = 128  # frames in memory: those of about twenty pairs with five targets


@dataclass(frozen=True, eq=False)
class Answer:
    """Pose of the reference object in one of the target views."""

    # from the reference's camera to the camera of the target view
    rotation: Float[np.ndarray, "3 3"]
    view: int = 0  # index of the target view
    # in the target's unit, if the method estimates it
    translation: Float[np.ndarray, "3"] | None = None
    scale: float | None = None  # if the method estimates it
    note: str = ""  # warning about the pose; "" for none
    inliers: int | None = None  # number of matches that agree with the pose
    confidence: float | None = None  # probability that the rotation error is below 30 degrees


class Row(Protocol):
    """A row of the benchmark's tables: any callable from a `Problem` to a pose.

    A row that takes the pose of the target view whose global feature is most similar to the
    reference's:

        def most_similar(problem):
            first, *others = (view.features.global_feature for view in problem.views())
            cosines = [torch.cosine_similarity(first, other, dim=0) for other in others]
            return np.eye(3), int(np.argmax(cosines))
    """

    def __call__(
        self, problem: "Problem"
    ) -> Answer | PoseEstimate | Sim3 | np.ndarray | tuple[Sim3 | np.ndarray, int]:
        """Estimate the pose of the reference object in one of the target views.

        A Sim3 or a rotation (3, 3) stands alone (target view 0) or with the view's index.
        InputError says that there is no pose: the pair counts as failed, with an error of 180
        degrees.
        """
        ...


def as_answer(found: Any) -> Answer:
    """Convert what a row returns to an Answer; InputError if it is none of what `Row` allows."""
    if isinstance(found, PoseEstimate):
        sim3 = found.sim3
        inliers = int(found.inliers.sum())
        return Answer(sim3.R, found.view, sim3.t, sim3.scale, found.note, inliers, found.confidence)
    if not isinstance(found, Answer):
        pose, view = found if isinstance(found, tuple) and len(found) == 2 else (found, 0)
        if isinstance(pose, Sim3):
            return Answer(pose.R, int(view), pose.t, pose.scale)
        found = Answer(pose, int(view))
    # Sim3 refuses what is no pose.
    scale = 1.0 if found.scale is None else found.scale
    moved = found.translation is not None
    exact = Sim3(scale, found.rotation, found.translation if moved else np.zeros(3))
    return replace(found, rotation=exact.R, translation=exact.t if moved else None)


def parameters(plugin: Any) -> Mapping[str, inspect.Parameter]:
    """Return the parameters of a plug-in by name, of a torch module those of `forward`; none of a
    compiled function without a signature."""
    with suppress(TypeError, ValueError):
        return inspect.signature(getattr(plugin, "forward", plugin)).parameters
    return {}


def seeded(plugin: Any, seed: int) -> Any:
    """Give the seed to a plug-in that has a parameter `seed`; return others as they are."""
    return partial(plugin, seed=seed) if "seed" in parameters(plugin) else plugin


@contextmanager
def _time_added(timings: dict[str, list[float]], stage: str) -> Iterator[None]:
    """Append the run time of the block, in seconds, to those of a stage."""
    start = time.perf_counter()
    yield
    timings.setdefault(stage, []).append(time.perf_counter() - start)


@dataclass(frozen=True, eq=False)
class Crop:
    """A frame's object crop with what extractors compute from it, by their names."""

    frame: Frame
    described: dict[str, Any] = field(default_factory=dict)

    def view(self, features: str, foreground: str) -> View:
        """Return the crop with its features and foreground (see `views.frame_view`)."""
        return frame_view(self.frame, self.described[features], foreground)


def evenly_spaced(numbers: Mapping[str, Sequence[int]], count: int) -> dict[str, tuple[int, ...]]:
    """Choose at most `count` of the frames of each object, evenly spaced over its sequence."""
    return {
        name: tuple(every[k] for k in spread(count, len(every))) for name, every in numbers.items()
    }


class FrameStore:
    """The crops of frames; the most recently used are kept in memory.

    Features are extracted with a number of `threads`; None leaves it as it is.
    """

    def __init__(self, dataset: Co3D, extractors: Mapping[str, Any], threads: int | None = None):
        self.dataset = dataset
        self.extractors = extractors
        self.threads = threads
        self.timings: dict[str, list[float]] = {}  # seconds of the stages of the present pair
        # Functions that remember what they return.
        self._crop = lru_cache(CAPACITY)(self._read_crop)
        self.hypotheses = cache(self._hypotheses)
        self.shape = cache(self._shape)
        self.aligned = cache(self._aligned)
        self.extent = cache(partial(extent, dataset))
        self.labels = cache(partial(read_labels, dataset.root))

    def _hypotheses(self, pair: Pair) -> PairHypotheses | None:
        """Find the hypotheses of the verified solver between the worlds of both objects; None if
        the views determine no pose."""
        with suppress(NoPoseError):
            estimate = PairProblem(pair, self).estimate(settings={"solver": "verified"})
            return world_hypotheses(pair.reference_sequence, pair.target_sequence, estimate)

    def _shape(self, category: str, sequence: str, numbers: tuple[int, ...]) -> Shape:
        """Fuse some of the frames of an object, upright if the floor or the cameras tell the
        vertical."""
        chosen = [numbers[k] for k in spread(FRAMES, len(numbers))]
        frames = [self.crop(category, sequence, number).frame for number in chosen]
        return Shape.of(frames, find_up(frames)[0])  # [1] says why there is none

    def judged(
        self,
        category: str,
        frames: Mapping[str, tuple[int, ...]],
        references: int = REFERENCES,
        pairs: Iterable[tuple[str, str]] | None = None,
        repeat: int = 0,
        solve: Callable[[list[Pair]], Iterable[PairHypotheses | None]] | None = None,
    ) -> list[PairHypotheses]:
        """Find the poses between objects of a category by their shapes and by some frames of each
        (see `judge.judge_pairs`).

        `frames` has the numbers of an object's frames by its name. `pairs` are pairs of names, by
        default all. `solve` finds the hypotheses of pairs of frames in the store's place, in
        another process.
        """
        shapes = {}
        every = self.dataset.frame_numbers(category)
        order = {}  # by name, the numbers of the frames that are asked, in this order
        for name, numbers in frames.items():
            with suppress(NoPoseError):  # objects without a surface are left out
                shapes[name] = self.shape(category, name, tuple(every[name]))
            order[name] = [numbers[k] for k in asked_positions(references, len(numbers))]

        def ask(questions: list[Question]) -> Iterable[PairHypotheses | None]:
            asked = []
            for name, rank, other in questions:
                number = order[name][rank]
                asked.append(Pair(category, name, number, other, frames[other], repeat))
            return solve(asked) if solve else map(self.hypotheses, asked)

        counts = {name: len(numbers) for name, numbers in order.items()}
        shaped = [pair for pair in pairs or combinations(frames, 2) if {*pair} <= shapes.keys()]
        return judge_pairs(shapes, counts, ask, shaped)

    def _aligned(self, category: str, targets: int) -> CategoryAlignment:
        """Align all objects of a category."""
        frames = evenly_spaced(self.dataset.frame_numbers(category), targets)
        pairs = partners([*frames], per_object=None)  # None for its default
        return synchronise(self.judged(category, frames, pairs=pairs))

    def _read_crop(self, category: str, sequence: str, number: int) -> Crop:
        """Read a frame and crop it to its object."""
        size = getattr(self.extractors.get("backbone"), "image_size", IMAGE_SIZE)
        with ends_the_run(f"reading frame {sequence}/{number}"):
            annotation = self.dataset.frame(category, sequence, number)
            with _time_added(self.timings, "reading"):
                frame = object_crop(self.dataset.load(annotation), size)
        # Rows are not told the names of objects.
        return Crop(replace(frame, name=f"frame {number}"))

    def crop(self, category: str, sequence: str, number: int, features: Iterable[str] = ()) -> Crop:
        """Return a frame's crop with what some extractors compute from it, each once."""
        crop = self._crop(category, sequence, number)
        for name in features:
            if name in crop.described:
                continue
            extractor = self.extractors[name]
            with (
                threadpool_limits(self.threads),
                ends_the_run(f"features {name!r}"),
                _time_added(self.timings, name),
            ):
                # One frame at a time: the last bits of a frame's features must not depend on the
                # rest of a batch.
                if hasattr(extractor, "describe"):
                    described = extractor.describe([crop.frame])
                else:
                    described = feature_maps(extractor, [crop.frame])
                crop.described[name] = described[0]
        return crop


@dataclass(eq=False, repr=False)
class Problem:
    """One pair as a row sees it: images, depth, masks, cameras and features of both objects, and a
    seed.

    Nothing in it leads to the data set.
    """

    seed: int
    crops: Sequence[Crop]  # the reference's crop first
    _extractors: Mapping[str, Any]
    _timings: dict[str, list]  # seconds by stage, to which this problem adds
    # What is computed already: estimates by the arguments of `estimate`, similarities by two
    # feature maps and `binning`.
    _estimates: dict[tuple, PoseEstimate] = field(default_factory=dict)
    _similarities: dict[tuple, Any] = field(default_factory=dict)

    def frames(self, depth: bool = False) -> list[Frame]:
        """Return the object crops, the reference's first, resized to the backbone's input.

        With `depth`, InputError, which fails the pair, if one has no depth map.
        """
        frames = [crop.frame for crop in self.crops]
        missing = [frame.name for frame in frames if frame.depth is None]
        if depth and missing:
            raise InputError(f"no depth map: {', '.join(missing)}")
        return frames

    def views(self) -> list[View]:
        """Return the crops with features of the run's backbone and the foreground by their
        saliency."""
        return [crop.view("backbone", "saliency") for crop in self.crops]

    def estimate(
        self,
        features: str = "backbone",
        settings: Mapping[str, Any] | None = None,
        target: int | None = None,
    ) -> PoseEstimate:
        """Estimate the pose by `ZeroShotPose` with some settings, in all targets or in the one with
        index `target`."""
        settings = settings or {}
        plugins = {
            name: seeded(value, self.seed) for name, value in settings.items() if callable(value)
        }
        # Estimates by plug-ins, which may have no hash, are not kept.
        key = None if plugins else (features, target, *sorted(settings.items()))
        if key in self._estimates:
            return self._estimates[key]
        chosen = {**settings, **plugins, "seed": self.seed}
        method = ZeroShotPose(self._extractors[features], **chosen)
        crops = self.crops if target is None else [self.crops[0], self.crops[1 + target]]
        reference, *targets = [crop.view(features, method.foreground) for crop in crops]
        matched = []
        for view in targets:
            # Rows with other settings share the similarities.
            compared = reference.features, view.features, method.binning
            if compared not in self._similarities:
                with _time_added(self._timings, "similarity"):
                    self._similarities[compared] = similarities(
                        reference.features, [view.features], method.binning
                    )
            with _time_added(self._timings, "matching"):
                matched += method.match_views(reference, [view], self._similarities[compared])
        estimate = method.estimate_from_views(reference, targets, matched)
        for stage, seconds in estimate.timings.items():
            self._timings.setdefault(stage, []).append(seconds)
        if key:
            self._estimates[key] = estimate
        return estimate


class PairProblem(Problem):
    """A problem with its pair and data set, for rows of the library; `features` names the
    extractors that they use."""

    def __init__(self, pair: Pair, store: FrameStore, features: Iterable[str] = ("backbone",)):
        self.pair = pair
        self.store = store
        crops = [store.crop(pair.category, *frame, features) for frame in pair.frames]
        super().__init__(pair.seed, crops, store.extractors, store.timings)
