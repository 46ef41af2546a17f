"""Zero-shot pose estimation from frames to a pose, composed of the stages' functions (paper, fig. 2 and sec. 4)."""

import importlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from zsp_lite.alignment import SCALE_RANGE, Sim3, ransac
from zsp_lite.best_view import VIEW_SELECTORS, ViewMatch, ViewSelector
from zsp_lite.data.frames import Frame, frame_defect, turn_frame
from zsp_lite.errors import InputError, check_integer, check_number
from zsp_lite.estimates import PoseEstimate, Solver, match_points, timed, turn_reference_back
from zsp_lite.features import SALIENCY_THRESHOLD, FeatureExtractor
from zsp_lite.matchers import MATCHERS, Matcher
from zsp_lite.matching import key_similarities, match, similarities
from zsp_lite.points import standard_deviation
from zsp_lite.views import View, crop_size, extract_views, has_saliency, object_crop, usable_targets

# Solvers beyond the paper by name, as "module:class"; a module is imported when its name is used.
SOLVERS = {"verified": "zsp_lite.verified:VerifiedSolver"}
_FEW = 10  # fewer points do not give a standard deviation


@dataclass(frozen=True)
class ZeroShotPose:
    """Zero-shot category-level pose estimation; the defaults are the paper's.

    Attributes:
        backbone: Computes the features of images; any `FeatureExtractor`.
        k: Number of matches.
        kmeans: Select the matches by clustering the 2k best candidates (sec. 4.1); False takes the k best. None uses
            the solver's setting (see `estimates.Solver`): True for the paper's, False for the verified one.
        view_selector: "correspond", as in the paper, another name in `best_view.VIEW_SELECTORS`, or a `ViewSelector`.
        trials: Number of RANSAC trials.
        threshold: Largest residual of a RANSAC inlier in scene units. (The scenes of CO3D are scaled to unit standard
            deviation.)
        adaptive_threshold: Multiply the threshold by the standard deviation of the object points in the chosen view,
            for scenes in other units (supplement, "RANSAC parameters").
        sample_size: Points per RANSAC trial.
        saliency_threshold: A patch is foreground if its saliency is above this. The default is the published code's.
        foreground: "saliency", as in the paper, or "mask" for the frame's own object mask. Backbones without saliency
            need "mask".
        cycle_from: View in which cycles start: "reference", as in the paper, or "target", as in the cycle step of the
            published code (see `matching.match`; docs/published_code.md lists all its differences).
        matcher: "cyclical", as in the paper, another name in `matchers.MATCHERS`, or a `Matcher`.
        binning: Compare log-binned descriptors, as in the paper; False compares the keys themselves.
        solver: "paper" selects the best view and aligns with it by RANSAC; a name in `SOLVERS`, such as "verified",
            or a `Solver`. The settings view_selector, trials, sample_size and adaptive_threshold are for "paper" only.
        seed: Seed of k-means and of the solver.
        upright: The reference image is upright, as the target views are. False tries four turns of its crop by 90
            degrees, because the features of a turned image are others and phones may store images turned. The estimate
            with the highest score is kept, and its pose is that of the image as given. The score is that of the first
            hypothesis, or that of the chosen view where a solver has none. Confidence and alternatives are those within
            the chosen turn. Keep True where images are upright: fewer wrong poses compete.

    Raises:
        InputError: A setting is out of range.
    """

    backbone: FeatureExtractor
    k: int = 50
    kmeans: bool | None = None
    view_selector: str | ViewSelector = "correspond"
    trials: int = 1000
    threshold: float = 0.2
    adaptive_threshold: bool = False
    sample_size: int = 4
    saliency_threshold: float = SALIENCY_THRESHOLD
    foreground: Literal["saliency", "mask"] = "saliency"
    cycle_from: Literal["reference", "target"] = "reference"
    matcher: str | Matcher = "cyclical"
    binning: bool = True
    solver: str | Solver = "paper"
    seed: int = 0
    upright: bool = True

    def __post_init__(self):
        for name, allowed in (
            ("matcher", ("cyclical", *MATCHERS)),
            ("view_selector", tuple(VIEW_SELECTORS)),
            ("foreground", ("saliency", "mask")),
            ("cycle_from", ("reference", "target")),
            ("solver", ("paper", *SOLVERS)),
            ("kmeans", (True, False, None)),
            ("adaptive_threshold", (True, False)),
            ("binning", (True, False)),
            ("upright", (True, False)),
        ):
            value = getattr(self, name)
            if name in ("matcher", "view_selector", "solver") and callable(value):
                continue
            if value not in allowed:
                raise InputError(f"{name} is {value!r}, expected one of {', '.join(map(str, allowed))}")
        for name, minimum in (("k", 1), ("trials", 1), ("sample_size", 3), ("seed", 0)):
            check_integer(name, getattr(self, name), minimum)
        if self.foreground == "saliency" and not has_saliency(self.backbone):
            name = getattr(self.backbone, "name", type(self.backbone).__name__)
            raise InputError(f"foreground is 'saliency', which {name} does not have; expected 'mask'")
        check_number("threshold", self.threshold, above=0)
        check_number("saliency_threshold", self.saliency_threshold)

    @property
    def clusters(self) -> bool:
        """Whether k-means selects the matches (see `kmeans`)."""
        return getattr(self._solver(), "kmeans", True) if self.kmeans is None else self.kmeans

    def estimate(self, reference: Frame, targets: Sequence[Frame]) -> PoseEstimate:
        """Estimate the pose of the reference object in the best of N target views.

        A frame without a mask is not cropped. Target views with a `frame_defect`, such as an empty mask, or without
        foreground are left out, with a flag each. If the matches of the best view do not determine a pose (fewer than
        `sample_size`, collinear, or no plausible scale), the paper's solver returns `view_alignment` with a flag.

        Args:
            reference: Frame of the reference object.
            targets: Frames of another object of its category, in one world.

        Raises:
            InputError: There are no targets, no target is usable, or the reference has an empty mask or no known
                depth.
        """
        timings: dict[str, float] = {}
        turns, views = self.pair_views(reference, targets, timings)
        return self.estimate_from_turns(turns, views, timings)

    def pair_views(
        self, reference: Frame, targets: Sequence[Frame], timings: dict[str, float] | None = None
    ) -> tuple[list[View], list[View]]:
        """Crop frames and extract features and foregrounds, all in one batch.

        Args:
            reference: Frame of the reference object.
            targets: Frames of the target object.
            timings: Gets the seconds of both stages.

        Returns:
            The view of the reference, or the views of its four turns if it is not `upright`; and the target views.
        """
        timings = {} if timings is None else timings
        with timed(timings, "crop"):
            size = crop_size(self.backbone)
            crop, *crops = [object_crop(frame, size) for frame in (reference, *targets)]
            turns = [turn_frame(crop, quarters) for quarters in range(1 if self.upright else 4)]
        with timed(timings, "features"):
            views = extract_views(self.backbone, [*turns, *crops], self.foreground, self.saliency_threshold)
        return views[: len(turns)], views[len(turns) :]

    def views(self, frames: Iterable[Frame]) -> list[View]:
        """Crop frames to their objects and extract features and foregrounds, as `estimate` does."""
        crops = [object_crop(frame, crop_size(self.backbone)) for frame in frames]
        return extract_views(self.backbone, crops, self.foreground, self.saliency_threshold)

    def estimate_from_views(
        self, reference: View, targets: Sequence[View], timings: dict[str, float] | None = None
    ) -> PoseEstimate:
        """Run the stages after feature extraction: matching and the solver (see `estimate`).

        If the reference is not `upright`, the features of its other three turns are extracted here.

        Args:
            reference: Reference view (see `views`).
            targets: Target views.
            timings: Seconds of earlier stages, to include in the estimate's.
        """
        timings, turns = dict(timings or {}), [reference]
        if not self.upright:
            with timed(timings, "turns"):
                crops = [turn_frame(reference.frame, quarters) for quarters in (1, 2, 3)]
                turns += extract_views(self.backbone, crops, self.foreground, self.saliency_threshold)
        return self.estimate_from_turns(turns, targets, timings)

    def estimate_from_turns(
        self, turns: Sequence[View], targets: Sequence[View], timings: dict[str, float] | None = None
    ) -> PoseEstimate:
        """Run the stages after feature extraction for every turn of the reference, and keep the best estimate.

        Turns that do not determine a pose are left out. Timings are the sums over all turns.

        Args:
            turns: The reference view, or several turned by 0, 1, ... quarter turns (see `pair_views`).
            targets: Target views.
            timings: Seconds of earlier stages, to include in the estimate's.

        Raises:
            InputError: No turn determines a pose; the error is that of the first.
        """
        found, failures, total = [], [], dict(timings or {})
        for quarters, view in enumerate(turns):
            try:
                one = self._estimate_matched(view, targets)
            except InputError as error:
                failures.append(error)
                continue
            for stage, seconds in one.timings.items():
                total[stage] = total.get(stage, 0.0) + seconds
            score = one.hypotheses[0].score if one.hypotheses else one.view_scores[one.view]
            found.append((score, quarters, one))
        if not found:
            raise failures[0]
        _, quarters, best = max(found, key=lambda one: one[0])
        return replace(turn_reference_back(best, turns[0], quarters) if quarters else best, timings=total)

    def _estimate_matched(self, reference: View, targets: Sequence[View]) -> PoseEstimate:
        """Match a reference view with the targets and run the solver."""
        timings: dict[str, float] = {}
        with timed(timings, "matching"):
            sims = self.similarities(reference, targets)
            pairs = [self.match_views(reference, target, sim) for target, sim in zip(targets, sims)]
        return self.estimate_from_pairs(reference, targets, pairs, timings)

    def similarities(self, reference: View, targets: Sequence[View]) -> list[Float[torch.Tensor, "n1 n2"]]:
        """Compute the cosine similarities between the reference's and each target's patch descriptors."""
        function = similarities if self.binning else key_similarities
        return function(reference.features, [target.features for target in targets])

    def match_views(self, reference: View, target: View, sim: Float[torch.Tensor, "n1 n2"]) -> ViewMatch:
        """Match the reference with one target view (sec. 4.1), from their similarities."""
        matches = match(
            reference.features, target.features, self.k, self.clusters, self.seed, self.cycle_from,
            ref_foreground=reference.foreground, target_foreground=target.foreground, sim=sim, matcher=self.matcher,
            binning=self.binning,
        )  # fmt: skip
        return ViewMatch(
            reference.features, target.features, reference.foreground, target.foreground, sim, matches, self.k
        )

    def estimate_from_pairs(
        self,
        reference: View,
        targets: Sequence[View],
        pairs: Sequence[ViewMatch],
        timings: dict[str, float] | None = None,
    ) -> PoseEstimate:
        """Run the solver on the usable target views (see `estimate`), for the reference view as it is.

        Args:
            reference: Reference view.
            targets: Target views.
            pairs: For each target view, its similarities to the reference and their matches (see `match_views`).
            timings: Seconds of earlier stages, to include in the estimate's.
        """
        if not targets:
            raise InputError("no target views, expected at least one")
        if defect := frame_defect(reference.frame):
            raise InputError(f"reference {reference.frame.name or 'view'}: {defect}")
        usable, flags = usable_targets(targets)
        found = self._solver()(
            reference, [targets[i] for i in usable], [pairs[i] for i in usable],
            seed=self.seed, threshold=self.threshold,
        )  # fmt: skip
        scores = np.full(len(targets), -np.inf)
        scores[usable] = found.view_scores
        return replace(
            found, view=usable[found.view], view_scores=scores, target_views=tuple(targets),
            timings=(timings or {}) | found.timings, flags=(*flags, *found.flags),
            hypotheses=tuple(replace(one, view=usable[one.view]) for one in found.hypotheses),
        )  # fmt: skip

    def _solver(self) -> Solver:
        if self.solver == "paper":
            return partial(
                align_best_view, view_selector=self.view_selector, trials=self.trials, sample_size=self.sample_size,
                adaptive_threshold=self.adaptive_threshold,
            )  # fmt: skip
        if isinstance(self.solver, str):
            module, name = SOLVERS[self.solver].split(":")
            return getattr(importlib.import_module(module), name)()
        return self.solver


def solve_pair(
    method: ZeroShotPose, reference: Frame, targets: Sequence[Frame], solvers: Sequence[str] | None = None
) -> dict[str, PoseEstimate]:
    """Estimate the pose of a pair by each of several solvers; crops and features are computed once.

    Args:
        method: The method.
        reference: Frame of the reference object.
        targets: Frames of the target object.
        solvers: Names of solvers; by default the method's own.

    Raises:
        InputError: The pose cannot be estimated (see `ZeroShotPose.estimate`).
    """
    if solvers is None:
        name = method.solver if isinstance(method.solver, str) else getattr(method.solver, "__name__", "solver")
        return {name: method.estimate(reference, targets)}
    timings: dict[str, float] = {}
    turns, views = method.pair_views(reference, targets, timings)
    return {name: replace(method, solver=name).estimate_from_turns(turns, views, timings) for name in solvers}


def align_best_view(
    reference: View,
    targets: Sequence[View],
    pairs: Sequence[ViewMatch],
    *,
    seed: int = 0,
    threshold: float = 0.2,
    view_selector: str | ViewSelector = "correspond",
    trials: int = 1000,
    sample_size: int = 4,
    adaptive_threshold: bool = False,
) -> PoseEstimate:
    """Solve as the paper does: select the best view (sec. 4.2) and fit the pose to its matches by RANSAC (sec. 4.3).

    This is the `Solver` named "paper"; `ZeroShotPose` explains the settings.
    """
    timings: dict[str, float] = {}
    with timed(timings, "view"):
        select = VIEW_SELECTORS[view_selector] if isinstance(view_selector, str) else view_selector
        scores = np.array([select(pair) for pair in pairs], dtype=np.float64)
        best = int(scores.argmax())
        matches = pairs[best].matches
    with timed(timings, "alignment"):
        points = match_points(reference, targets[best], matches)
        unit = (standard_deviation(_foreground_points(targets[best])) or 1.0) if adaptive_threshold else 1.0
        flags: tuple[str, ...] = ()
        try:
            sim3, inliers = ransac(
                *points, threshold=unit * threshold, trials=trials, sample_size=sample_size, seed=seed,
                scale_range=SCALE_RANGE,
            )  # fmt: skip
            if (agreeing := int(inliers.sum())) < sample_size:
                flags = (f"only {agreeing} of {len(inliers)} matches agree with the pose",)
        except InputError as error:
            sim3, inliers = view_alignment(reference, targets[best]), np.zeros(len(points[0]), dtype=bool)
            flags = (f"pose is the best view's, not a fit: {error}",)
    return PoseEstimate(sim3, best, matches, inliers, scores, reference, tuple(targets), timings, flags)


def view_alignment(reference: View, target: View) -> Sim3:
    """Align a view with the reference without matches: the pose of the row "Ours-BV" in the paper's tables.

    Returns:
        Identity rotation, with the scale and translation that map the standard deviation and the centroid of the
        reference's foreground points onto those of the target's.
    """
    first, second = _foreground_points(reference), _foreground_points(target)
    spread, target_spread = standard_deviation(first), standard_deviation(second)
    scale = target_spread / spread if spread > 0 and target_spread > 0 else 1.0
    return Sim3(scale, np.eye(3), second.mean(axis=0) - scale * first.mean(axis=0))


def _foreground_points(view: View) -> Float[np.ndarray, "n 3"]:
    """Get the points of the foreground patches with measured depth; if they are too few, those of the whole crop."""
    points, known = view.patch_points
    for chosen in (view.known_foreground, known):
        if chosen.sum() >= _FEW:
            return points[chosen]
    return points.reshape(-1, 3)
