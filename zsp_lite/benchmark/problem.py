"""Argument and results of a benchmark row: `Problem` and `Answer`."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.benchmark.store import FrameKey, FrameStore
from zsp_lite.data.cameras import Camera
from zsp_lite.data.co3d import Pair
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, real_array
from zsp_lite.estimates import Hypothesis, PoseEstimate
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.views import View

# Members of a stored result; an answer's details must have other names.
RESERVED = (
    "error", "failed", "symmetric_error", "translation", "scale", "view", "note", "second_error", "one_of_two",
)  # fmt: skip
# What decides the matches of a ZeroShotPose: rows that agree in it share the matches.
_MATCH_SETTINGS = ("k", "clusters", "foreground", "cycle_from", "matcher", "binning")


@dataclass(frozen=True, eq=False)
class Answer:
    """Pose of the reference object in one of the target views."""

    rotation: Float[np.ndarray, "3 3"]  # from the reference's camera to the camera of the target view
    view: int = 0  # index of the target view
    translation: Float[np.ndarray, "3"] | None = None  # in the target's unit, if the method estimates it
    scale: float | None = None  # if the method estimates it
    note: str = ""  # warning about the pose; "" for none
    # Numbers and texts to store with the result, such as {"inliers": 12}; "timings" in it are seconds per stage.
    details: Mapping[str, Any] = field(default_factory=dict)
    hypotheses: tuple[Hypothesis, ...] = ()  # ranked candidate poses, of solvers that have them
    one_of_two: bool = False  # whether the solver cannot decide between the two best poses


class Row(Protocol):
    """A row of the benchmark's tables: any callable from a `Problem` to a pose.

    A row that takes the pose of the target view whose global feature is most similar to the reference's:

        def most_similar(problem):
            feature = problem.reference.features.global_feature
            cosines = [
                torch.cosine_similarity(feature, target.features.global_feature, dim=0) for target in problem.targets
            ]
            return np.eye(3), int(np.argmax(cosines))

        evaluate(data, "zsp-tiny", {"ours": "ours", "most similar": most_similar}, pairs=10)

    or, on the command line, `zsp-lite benchmark --methods ours,my_module:most_similar`.
    """

    def __call__(self, problem: "Problem") -> Answer | PoseEstimate | Sim3 | np.ndarray | tuple[Sim3 | np.ndarray, int]:
        """Estimate the pose of the reference object in one of the target views.

        Returns:
            An Answer, a PoseEstimate, or a Sim3 or a rotation (3, 3), alone (target view 0) or with the view's index.

        Raises:
            InputError: If there is no pose; the pair counts as failed, with an error of 180 degrees.
        """
        ...


def as_answer(found: Any) -> Answer:
    """Convert what a row returns to an Answer; InputError if it is none of what `Row` allows."""
    if isinstance(found, PoseEstimate):
        details = {"matches": len(found.matches), "inliers": int(found.inliers.sum()), "timings": found.timings}
        if found.confidence is not None:
            details["confidence"] = round(found.confidence, 4)
        sim3 = found.sim3
        return Answer(sim3.R, found.view, sim3.t, sim3.scale, found.note, details, found.hypotheses, found.one_of_two)
    if isinstance(found, Answer):
        return replace(found, rotation=_rotation(found.rotation), details=_details(found.details))
    pose, view = found if isinstance(found, tuple) and len(found) == 2 else (found, 0)
    if isinstance(pose, Sim3):
        return Answer(pose.R, int(view), pose.t, pose.scale)
    return Answer(_rotation(pose), int(view))


def _rotation(pose: Any) -> Float[np.ndarray, "3 3"]:
    return Sim3(1.0, real_array("pose of the row", pose), np.zeros(3)).R


def _details(details: Mapping[str, Any]) -> dict[str, Any]:
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in details.items()}
    for name, value in plain.items():
        if name in RESERVED or (name != "timings" and not isinstance(value, bool | int | float | str | None)):
            raise InputError(
                f"detail {name} of the row is a {type(value).__name__}, expected a number or a text with another name "
                f"than {', '.join(RESERVED)}"
            )
    return plain


class Problem:
    """One pair as a method sees it: everything but the true pose. Results are computed once and shared by all methods.

    `pair` names the frames, `seed` is for the method's random draws.
    """

    def __init__(self, pair: Pair, store: FrameStore):
        self.pair, self.seed, self.store = pair, pair.seed, store
        targets = [(pair.target_sequence, number) for number in pair.target_frames]
        # (sequence, frame number) of the reference and of each target
        self.keys: list[FrameKey] = [(pair.reference_sequence, pair.reference_frame), *targets]
        self._shared: dict[tuple, Any] = {}

    @property
    def reference(self) -> View:
        """The reference's crop with the features of the run's backbone."""
        return self.views()[0]

    @property
    def targets(self) -> list[View]:
        """The targets' crops with the features of the run's backbone."""
        return self.views()[1:]

    def frames(self) -> list[Frame]:
        """Return the object crops, the reference's first, resized to the backbone's input."""
        return [self.store.frame(key) for key in self.keys]

    def frames_with_depth(self) -> list[Frame]:
        """Return `frames`; InputError, which fails the pair, if one has no depth map."""
        if missing := [frame.name for frame in self.frames() if frame.depth is None]:
            raise InputError(f"no depth map: {', '.join(missing)}")
        return self.frames()

    def full_frames(self) -> list[Frame]:
        """Return the uncropped frames, the reference first."""
        return [self.store.full_frame(key) for key in self.keys]

    def descriptions(self, features: str = "backbone") -> list[Any]:
        """Return what an extractor computes from each crop (see `extractors.EXTRACTORS`)."""
        return [self.store.describe(features, key) for key in self.keys]

    def views(self, features: str = "backbone", foreground: str = "saliency") -> list[View]:
        """Return the crops with their features and foregrounds (see `views.frame_view`)."""
        return [self.store.view(features, key, foreground) for key in self.keys]

    def first_cameras(self) -> tuple[Camera, Camera]:
        """Return the cameras of the first frame of the reference's and the target's sequence."""
        return self.store.first_camera(self.pair.reference_sequence), self.store.first_camera(self.pair.target_sequence)

    def estimate(
        self, features: str = "backbone", settings: Mapping[str, Any] | None = None, target: int | None = None
    ) -> PoseEstimate:
        """Run the paper's method with other settings of `ZeroShotPose`, on all targets or on the one with an index.

        Estimates that differ in later stages only share the matches.
        """
        name = (features, target, tuple(sorted((settings or {}).items(), key=lambda item: item[0])))
        if name not in self._shared:
            method = ZeroShotPose(self.store.extractors[features], **(settings or {}), seed=self.seed)
            self._shared[name] = self._estimate(features, method, target)
        return self._shared[name]

    def _estimate(self, features: str, method: ZeroShotPose, target: int | None) -> PoseEstimate:
        reference, *views = self.views(features, method.foreground)
        keys = self.keys[1:]
        if target is not None:
            keys, views = [keys[target]], [views[target]]
        if not method.upright:
            return method.estimate_from_views(reference, views)
        settings = tuple(getattr(method, name) for name in _MATCH_SETTINGS)
        matched, seconds = [], 0.0
        for key, view in zip(keys, views):
            name = ("matches", features, key, settings)
            if name not in self._shared:
                similarity = self.store.similarity(features, self.keys[0], key, method, reference, view)
                start = time.perf_counter()
                self._shared[name] = method.match_views(reference, [view], [similarity]), time.perf_counter() - start
            one, matching_seconds = self._shared[name]
            matched += one
            seconds += matching_seconds
        found = method.estimate_from_views(reference, views, matched)
        return replace(found, timings={"matching": seconds} | found.timings)
