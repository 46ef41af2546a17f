"""The method from frames to a pose, composed of the stages' plain functions (paper fig. 2 and sec. 4)."""

import time
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float

from zsp_lite.alignment import Sim3, ransac
from zsp_lite.best_view import VIEW_SELECTORS, ViewPair
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.matchers import MATCHERS, Matcher
from zsp_lite.matching import Matches, match, plain_similarities, similarities
from zsp_lite.verified import Hypothesis, VerifiedSettings, solve
from zsp_lite.views import IMAGE_SIZE, View, extract_views, frame_view, object_crop, patch_mask

if TYPE_CHECKING:
    from zsp_lite.backbones.load import Backbone

# Views are pipeline's vocabulary, wherever they live.
__all__ = [
    "IMAGE_SIZE", "PoseEstimate", "View", "ZeroShotPose", "frame_view", "extract_views", "match_points", "object_crop",
    "patch_mask", "view_alignment",
]  # fmt: skip

# Instances of one category, each of unit spread, do not differ more: what the paper leaves open.
SCALE_RANGE = (0.2, 5.0)
_FEW = 10


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The pose of the reference object in a target view, and how it came about.

    sim3: reference-camera points to camera points of the chosen target view.  view: its index.
    matches: between the reference and that view.  inliers: (K,) which of them the fit used.
    points: their 3D points in the reference's and the target's camera frame, (K, 3) each.
    view_scores: (N,) of all target views, higher is better.  timings: seconds per stage.
    target_camera: of the chosen view.  flags: one line per reason not to trust the estimate.
    reference_view, target_views: crops, features and foregrounds that went in.
    hypotheses: of the verified solver, best first, each with what speaks for it; the first is the estimate.
    """

    sim3: Sim3
    view: int
    matches: Matches
    inliers: Bool[np.ndarray, " k"]
    points: tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]
    view_scores: Float[np.ndarray, " n"]
    timings: dict[str, float]
    target_camera: Camera
    reference_view: View
    target_views: tuple[View, ...]
    flags: tuple[str, ...] = ()
    hypotheses: tuple[Hypothesis, ...] = ()

    @property
    def confidence(self) -> float | None:
        """Chance that the rotation is within 30 degrees of the truth; None where the solver does not say."""
        return self.hypotheses[0].confidence if self.hypotheses else None

    @property
    def reliable(self) -> bool:
        """Whether nothing was flagged; it says nothing about how right a fitted pose is."""
        return not self.flags

    @property
    def note(self) -> str:
        """The flags as one line."""
        return "; ".join(self.flags)

    def propagate(self, cameras: Sequence[Camera]) -> list[Sim3]:
        """Pose of the reference against other cameras of the target sequence (sec. 5.6): reference-camera
        points to each camera's points, through the known world-to-camera transforms."""
        best = self.target_camera
        poses = []
        for camera in cameras:
            turn = camera.R @ best.R.T
            poses.append(Sim3(1.0, turn, camera.t - turn @ best.t) @ self.sim3)
        return poses


@dataclass(frozen=True)
class ZeroShotPose:
    """The method with its settings; the defaults are the paper's.

    k: matches kept.  kmeans: spread them over the object by clustering the 2k closest cycles (sec. 4.1).
    view_selector: a name in `VIEW_SELECTORS`.  trials, threshold, sample_size: of RANSAC; the threshold is in
    scene units, CO3D's being unit standard deviation of the point cloud.  saliency_threshold: foreground above it.
    adaptive_threshold: take the threshold as a share of what the chosen view shows of the object (its points' standard
    deviation), as the supplement suggests: for scenes in other units.
    foreground: "saliency" as in the paper, or "mask" to take the frame's own mask.
    cycle_from: "reference" as in the paper, or "target" as in its published code.
    matcher: "cyclical" as in the paper, or another way to choose matches: see `matchers`.
    binning: compare log-binned descriptors as in the paper, or the bare keys.
    solver: "paper" trusts RANSAC in the best view; "verified" tests many poses against all views (see `verified`) and
    adapts its thresholds to the object's size. verified: settings of the latter.
    Raises InputError for a setting out of its range.
    """

    backbone: "Backbone"
    k: int = 50
    kmeans: bool = True
    view_selector: str = "correspond"
    trials: int = 1000
    threshold: float = 0.2
    adaptive_threshold: bool = False
    sample_size: int = 4
    saliency_threshold: float = 0.05
    foreground: Literal["saliency", "mask"] = "saliency"
    cycle_from: Literal["reference", "target"] = "reference"
    matcher: str | Matcher = "cyclical"
    binning: bool = True
    solver: Literal["paper", "verified"] = "paper"
    verified: VerifiedSettings = VerifiedSettings()
    seed: int = 0

    def __post_init__(self):
        matchers = ("cyclical", *MATCHERS)
        for name, value, allowed in (
            ("matcher", self.matcher if isinstance(self.matcher, str) else "cyclical", matchers),
            ("view_selector", self.view_selector, tuple(VIEW_SELECTORS)),
            ("foreground", self.foreground, ("saliency", "mask")),
            ("cycle_from", self.cycle_from, ("reference", "target")),
            ("solver", self.solver, ("paper", "verified")),
        ):
            if value not in allowed:
                raise InputError(f"{name} is {value!r}, expected one of {', '.join(allowed)}")
        if self.k < 1 or self.trials < 1 or self.sample_size < 3 or not self.threshold > 0:
            raise InputError(
                f"k={self.k}, trials={self.trials}, sample_size={self.sample_size}, threshold="
                f"{self.threshold}; expected k, trials >= 1, sample_size >= 3, threshold > 0"
            )

    def estimate(self, reference: Frame, targets: Sequence[Frame]) -> PoseEstimate:
        """The pose of the reference's object in the best of N target views of another object of its category.

        A frame without a mask is taken whole. Where the matches of the best view cannot carry a fit (fewer
        than sample_size, collinear, or of no plausible scale) the estimate is the best view itself: identity
        rotation, translation and scale from the foregrounds' centroids and spreads, and a flag that says so.
        Raises InputError for no targets, an empty mask, and no known depth in the reference or the chosen target.
        """
        timings: dict[str, float] = {}
        with _timed(timings, "crop"):
            frames = [object_crop(frame) for frame in (reference, *targets)]
        with _timed(timings, "features"):
            views = extract_views(self.backbone, frames, self.foreground, self.saliency_threshold)
        return self.estimate_from_features(views[0], views[1:], timings)

    def estimate_from_features(
        self, reference: View, targets: Sequence[View], timings: dict[str, float] | None = None
    ) -> PoseEstimate:
        """`estimate`, from views that were prepared before and may be shared between pairs and settings."""
        if not targets:
            raise InputError("no target views, expected at least one")
        timings = dict(timings or {})
        with _timed(timings, "matching"):
            sims = self.similarities(reference, targets)
            comparisons = [self.compare(reference, target, sim) for target, sim in zip(targets, sims)]
        return self.estimate_from_comparisons(reference, targets, comparisons, timings)

    def similarities(self, reference: View, targets: Sequence[View]) -> list[Float[torch.Tensor, "n1 n2"]]:
        """Cosines between the descriptors of the reference's patches and of each target's."""
        compared = similarities if self.binning else plain_similarities
        return compared(reference.features, [target.features for target in targets])

    def compare(self, reference: View, target: View, sim: Float[torch.Tensor, "n1 n2"]) -> ViewPair:
        """The matches between the reference and one target view, and what a view selector looks at."""
        matches = match(
            reference.features, target.features, self.k, self.kmeans, self.seed, self.cycle_from,
            ref_foreground=reference.foreground, target_foreground=target.foreground, sim=sim, matcher=self.matcher,
            binning=self.binning,
        )  # fmt: skip
        return ViewPair(
            reference.features, target.features, reference.foreground, target.foreground, sim, matches, self.k
        )

    def estimate_from_comparisons(
        self,
        reference: View,
        targets: Sequence[View],
        comparisons: Sequence[ViewPair],
        timings: dict[str, float] | None = None,
    ) -> PoseEstimate:
        """The last two stages: choose the view and align (sec. 4.2 and 4.3), or verify poses in all views."""
        timings = dict(timings or {})
        if self.solver == "verified":
            return self._estimate_verified(reference, targets, comparisons, timings)
        with _timed(timings, "view"):
            scores = np.array([VIEW_SELECTORS[self.view_selector](comparison) for comparison in comparisons])
            best = int(scores.argmax())
            matches = comparisons[best].matches
        with _timed(timings, "alignment"):
            points = match_points(reference, targets[best], matches)
            unit = _spread(_foreground_points(targets[best])) if self.adaptive_threshold else 1.0
            flags: tuple[str, ...] = ()
            try:
                sim3, inliers = ransac(
                    *points, threshold=unit * self.threshold, trials=self.trials, sample_size=self.sample_size,
                    seed=self.seed, scale_range=SCALE_RANGE,
                )  # fmt: skip
                if (agreeing := int(inliers.sum())) < self.sample_size:
                    flags = (f"only {agreeing} of {len(inliers)} matches agree with the pose",)
            except InputError as error:
                sim3, inliers = view_alignment(reference, targets[best]), np.zeros(len(points[0]), dtype=bool)
                flags = (f"pose is the best view's, not a fit: {error}",)
        return PoseEstimate(
            sim3, best, matches, inliers, points, scores, timings, targets[best].frame.camera,
            reference, tuple(targets), flags,
        )  # fmt: skip

    def _estimate_verified(
        self, reference: View, targets: Sequence[View], comparisons: Sequence[ViewPair], timings: dict[str, float]
    ) -> PoseEstimate:
        """The best hypothesis of the verified solver, in the target view that it sees the object most alike."""
        found = solve(
            reference, targets, [one.similarity for one in comparisons], [one.matches for one in comparisons],
            self.seed, self.verified,
        )  # fmt: skip
        best = found.hypotheses[0]
        matches = comparisons[best.view].matches
        points = match_points(reference, targets[best.view], matches)
        residual = np.linalg.norm(best.sim3.apply(points[0]) - points[1], axis=1)
        return PoseEstimate(
            best.sim3, best.view, matches, residual < self.threshold * found.target_spread, points, -found.view_angles,
            timings | found.timings, targets[best.view].frame.camera, reference, tuple(targets), found.flags,
            found.hypotheses,
        )  # fmt: skip


def match_points(
    reference: View, target: View, matches: Matches
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """The matches' 3D points, each in its own camera frame (sec. 4.3)."""
    (source, _), (destination, _) = reference.patch_points, target.patch_points
    return source[tuple(matches.reference.T)], destination[tuple(matches.target.T)]


def view_alignment(reference: View, target: View) -> Sim3:
    """The reference as if seen from the target's viewpoint ("Ours-BV"): identity rotation, and the scale and
    translation that bring the foreground points' spread and centroid onto the target's."""
    first, second = _foreground_points(reference), _foreground_points(target)
    spread = np.sqrt(np.square(first - first.mean(axis=0)).sum(axis=1).mean())
    target_spread = np.sqrt(np.square(second - second.mean(axis=0)).sum(axis=1).mean())
    scale = float(target_spread / spread) if spread > 0 and target_spread > 0 else 1.0
    return Sim3(scale, np.eye(3), second.mean(axis=0) - scale * first.mean(axis=0))


def _spread(points: Float[np.ndarray, "n 3"]) -> float:
    """Standard deviation: the root of the axes' mean variance."""
    return float(np.sqrt(points.var(axis=0).mean())) or 1.0


def _foreground_points(view: View) -> Float[np.ndarray, "n 3"]:
    points, known = view.patch_points
    foreground = np.asarray(view.foreground.cpu())
    # Measured points of the object; where they are too few to have a spread, of the whole crop.
    for chosen in (foreground & known, known):
        if chosen.sum() >= _FEW:
            return points[chosen]
    return points.reshape(-1, 3)


@contextmanager
def _timed(timings: dict[str, float], stage: str):
    start = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - start
