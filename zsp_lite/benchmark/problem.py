"""What a method is given of a pair, what it may answer, and the paper's method on it with all that can be shared."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from zsp_lite.alignment import Sim3
from zsp_lite.benchmark.store import FrameKey, FrameStore
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.data.pairs import Pair
from zsp_lite.errors import InputError
from zsp_lite.pipeline import PoseEstimate, ZeroShotPose
from zsp_lite.views import View

# What is found out about an answer: no detail may go by one of these names.
MEASURED = ("error", "failed", "translation_error", "scale", "view", "note")


@dataclass(frozen=True, eq=False)
class Answer:
    """A pose of the reference object in a target view.

    rotation: from the reference's camera to that of target view `view` (an index).  translation: in the target's
    unit, and scale: where the method knows them.  note: why not to trust it, "" for no reason.  details: figures
    worth keeping with it, such as {"inliers": 12}; "timings" in it are seconds by stage.
    """

    rotation: Float[np.ndarray, "3 3"]
    view: int = 0
    translation: Float[np.ndarray, "3"] | None = None
    scale: float | None = None
    note: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)


def as_answer(found: Any) -> Answer:
    """An Answer from what methods return: itself, a PoseEstimate, a Sim3 or a rotation (of view 0), or (pose, view).

    Raises InputError for anything else, for a matrix that is no rotation, and for details that are named like what is
    measured or hold more than numbers and texts.
    """
    if isinstance(found, Answer):
        return replace(found, rotation=_rotation(found.rotation), details=_details(found.details))
    if isinstance(found, PoseEstimate):
        details = {"matches": len(found.matches), "inliers": int(found.inliers.sum()), "timings": found.timings}
        if found.confidence is not None:
            details["confidence"] = round(found.confidence, 4)
        return Answer(found.sim3.R, found.view, found.sim3.t, found.sim3.scale, found.note, details)
    pose, view = found if isinstance(found, tuple) and len(found) == 2 else (found, 0)
    if isinstance(pose, Sim3):
        return Answer(pose.R, int(view), pose.t, pose.scale)
    return Answer(_rotation(pose), int(view))


def _rotation(found: Any) -> Float[np.ndarray, "3 3"]:
    matrix = np.asarray(found, dtype=np.float64) if isinstance(found, np.ndarray | torch.Tensor | list) else np.empty(0)
    if matrix.shape != (3, 3):
        raise InputError(
            f"method returned a {type(found).__name__}, expected a Sim3 or 3x3 rotation, alone or with the view's "
            "index, a PoseEstimate or an Answer"
        )
    return Sim3(1.0, matrix, np.zeros(3)).R


def _details(details: Mapping[str, Any]) -> dict[str, Any]:
    if taken := sorted({*MEASURED} & details.keys()):
        raise InputError(f"method's details name {', '.join(taken)}, expected other names than {', '.join(MEASURED)}")
    plain = {name: value.item() if isinstance(value, np.generic) else value for name, value in details.items()}
    for name, value in plain.items():
        if name != "timings" and not isinstance(value, bool | int | float | str | None):
            raise InputError(f"method's detail {name} is a {type(value).__name__}, expected a number or a text")
    return plain


class Problem:
    """One pair as a method sees it: everything but the truth.

    pair: which frames.  seed: what draws shall start from.  reference, targets: views with the run's backbone.
    Whatever is asked for is worked out once and kept for the pair's other methods.
    """

    def __init__(self, pair: Pair, store: FrameStore):
        self.pair, self.seed, self.store = pair, pair.seed, store
        self.keys: list[FrameKey] = [(pair.reference_sequence, pair.reference_frame)]
        self.keys += [(pair.target_sequence, number) for number in pair.target_frames]
        self._shared: dict[tuple, Any] = {}

    @property
    def reference(self) -> View:
        return self.views()[0]

    @property
    def targets(self) -> list[View]:
        return self.views()[1:]

    def frames(self) -> list[Frame]:
        """Object crops of the backbone's image size, the reference's first."""
        return [self.store.frame(key) for key in self.keys]

    def full_frames(self) -> list[Frame]:
        """The frames as they are on disk, read anew."""
        return [self.store.full_frame(key) for key in self.keys]

    def described(self, features: str = "backbone") -> list[Any]:
        """What an extractor says of each crop."""
        return [self.store.describe(features, key) for key in self.keys]

    def views(
        self, features: str = "backbone", foreground: str = "saliency", saliency_threshold: float = 0.05
    ) -> list[View]:
        """The crops with their features and foregrounds (see `views.frame_view`)."""
        return [self.store.view(features, key, foreground, saliency_threshold) for key in self.keys]

    def first_cameras(self) -> tuple[Camera, Camera]:
        """The cameras of the reference's and the target's first frame in their sequences."""
        return self.store.first_camera(self.keys[0][0]), self.store.first_camera(self.keys[1][0])

    def estimate(
        self, features: str = "backbone", settings: Mapping[str, Any] | None = None, only: int | None = None
    ) -> PoseEstimate:
        """The paper's method with other features or settings; `only` leaves it no other target view.

        Estimates that differ in their last stages alone share the first: similarities, then matches.
        """
        settings = dict(settings or {})
        name = (features, only, tuple(sorted(settings.items(), key=lambda item: item[0])))
        if name not in self._shared:
            solver = ZeroShotPose(self.store.extractors[features], **settings, seed=self.seed)
            self._shared[name] = self._estimate(features, solver, only)
        return self._shared[name]

    def _estimate(self, features: str, solver: ZeroShotPose, only: int | None) -> PoseEstimate:
        reference, *targets = self.views(features, solver.foreground, solver.saliency_threshold)
        keys = self.keys[1:]
        if only is not None:
            keys, targets = keys[only : only + 1], targets[only : only + 1]
        # What matches depend on; estimates that agree in it share them.
        name = tuple(getattr(solver, part) for part in (
            "k", "kmeans", "foreground", "saliency_threshold", "cycle_from", "matcher", "binning",
        ))  # fmt: skip
        comparisons, seconds = [], 0.0
        for key, target in zip(keys, targets, strict=True):
            shared = ("comparison", features, key, name)
            if shared not in self._shared:
                sim = self.store.similarity(features, self.keys[0], key, solver, reference, target)
                start = time.perf_counter()
                found = solver.match_pair(reference, target, sim)
                self._shared[shared] = found, time.perf_counter() - start
            comparison, spent = self._shared[shared]
            comparisons.append(comparison)
            seconds += spent
        return solver.estimate_from_pairs(reference, targets, comparisons, {"matching": seconds})
