"""Zero-shot pose estimation from frames to a pose, composed of the stages' functions (paper, fig. 2
and sec. 4)."""

import pkgutil
from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from zsp_lite.alignment import SCALE_RANGE, Sim3, ransac
from zsp_lite.best_view import VIEW_SELECTORS, ViewSelector
from zsp_lite.choices import MATCHERS, SOLVERS
from zsp_lite.data.frames import Frame, frame_defect, list_frames
from zsp_lite.errors import InputError, NoPoseError, check_choice, check_integer, check_number
from zsp_lite.estimates import PoseEstimate, Solver, match_points, timed
from zsp_lite.features import FeatureExtractor
from zsp_lite.matching import Matcher, match, similarities
from zsp_lite.points import standard_deviation
from zsp_lite.views import IMAGE_SIZE, View, ViewMatch, extract_views, object_crop, usable_targets

_FEW = 10  # the standard deviation of fewer points says little of the object's size; chosen


@dataclass(frozen=True)
class ZeroShotPose:
    """Zero-shot category-level pose estimation; the defaults are the paper's.

    Attributes:
        backbone: Computes the features of images; any `FeatureExtractor`.
        k: Number of matches.
        kmeans: Select the matches by clustering the 2k best candidates (sec. 4.1); False takes the
            k best. None uses the solver's setting (see `estimates.Solver`): True for the paper's,
            False for the verified one.
        view_selector: "correspond", as in the paper, another name in `best_view.VIEW_SELECTORS`, or
            a `ViewSelector`.
        trials: Number of RANSAC trials.
        threshold: Largest residual of a RANSAC inlier in standard deviations of the target object.
        sample_size: Points per RANSAC trial.
        foreground: "saliency", as in the paper, or "mask" for the frame's own object mask.
            Backbones without saliency need "mask".
        cycle_from: View in which cycles start: "reference", as in the paper, or "target", as in the
            cycle step of the published code (see `matching.match`; docs/published_code.md lists all
            its differences).
        matcher: "cyclical", as in the paper, another name in `choices.MATCHERS`, or a `Matcher`.
        binning: Compare log-binned descriptors, as in the paper; False compares the keys
            themselves.
        solver: "paper" selects the best view and aligns with it by RANSAC; or "verified", or a
            `Solver`. The settings view_selector, trials and sample_size are for "paper" only.
        seed: Seed of k-means and of the solver.

    Raises:
        InputError: A setting is out of range.
    """

    backbone: FeatureExtractor
    k: int = 50
    kmeans: bool | None = None
    view_selector: str | ViewSelector = "correspond"
    trials: int = 1000
    threshold: float = 0.2
    sample_size: int = 4
    foreground: Literal["saliency", "mask"] = "saliency"
    cycle_from: Literal["reference", "target"] = "reference"
    matcher: str | Matcher = "cyclical"
    binning: bool = True
    solver: str | Solver = "paper"
    seed: int = 0

    def __post_init__(self):
        choices = {
            "matcher": MATCHERS,
            "view_selector": VIEW_SELECTORS,
            "solver": SOLVERS["both"],  # all that have a name
            "foreground": ("saliency", "mask"),
            "cycle_from": ("reference", "target"),
            "kmeans": (None, True, False),
        }
        for name, allowed in choices.items():
            chosen = getattr(self, name)
            if not callable(chosen):  # else a plug-in
                check_choice(name, chosen, allowed)
        check_integer("k", self.k, 1)
        check_integer("trials", self.trials, 1, 1_000_000)  # the poses of all are in memory
        check_integer("sample_size", self.sample_size, 3)
        check_integer("seed", self.seed, 0)
        if not callable(self.backbone):
            raise InputError(
                f"backbone is {self.backbone!r}, expected what `load_backbone` returns"
            )
        if self.foreground == "saliency" and not getattr(self.backbone, "has_saliency", True):
            raise InputError(
                "foreground is 'saliency', which the backbone does not have; expected 'mask'"
            )
        check_number("threshold", self.threshold, above=0)

    def estimate(self, reference: Frame, targets: Iterable[Frame]) -> PoseEstimate:
        """Estimate the pose of the reference object in the best of N target views.

        The commands and the benchmark, which share views between solvers, pairs or rows, enter at
        `estimate_from_views`.

        A frame without a mask is not cropped. Target views with a `frame_defect`, such as an empty
        mask, or without foreground are left out, with a flag each. If the matches of the best view
        do not determine a pose (fewer than `sample_size`, or collinear), the pose is that of the
        best view itself, with a flag (see `view_alignment`).

        Args:
            reference: Frame of the reference object.
            targets: Frames of another object of its category, in one world: any iterable, or one.

        Raises:
            InputError: There are no targets, no target is usable, or the reference has an empty
                mask or no known depth.
        """
        timings = {}
        with timed(timings, "features"):
            frames = list_frames([reference, *list_frames(targets)])
            first, *others = self.views(frames)
        found = self.estimate_from_views(first, others)
        return replace(found, timings=timings | found.timings)

    def views(self, frames: Iterable[Frame]) -> list[View]:
        """Crop frames to their objects and extract features and foregrounds, all in one batch."""
        size = getattr(self.backbone, "image_size", IMAGE_SIZE)
        crops = [object_crop(frame, size) for frame in frames]
        return extract_views(self.backbone, crops, self.foreground)

    def match_views(
        self,
        reference: View,
        targets: Sequence[View],
        cosines: Sequence[Float[torch.Tensor, "_ _"]] | None = None,
    ) -> list[ViewMatch]:
        """Match the reference with each target view (sec. 4.1).

        `cosines` are those of the reference's patches with the patches of each view, if they are
        known already.
        """
        if cosines is None:
            features = [target.features for target in targets]
            cosines = similarities(reference.features, features, self.binning)
        kmeans = self.kmeans
        if kmeans is None:
            kmeans = getattr(self._solver(), "kmeans", True)
        matched = []
        for target, similarity in zip(targets, cosines):
            matches = match(
                reference.features,
                target.features,
                self.k,
                kmeans,
                self.seed,
                self.cycle_from,
                ref_foreground=reference.foreground,
                target_foreground=target.foreground,
                sim=similarity,
                matcher=self.matcher,
                binning=self.binning,
            )
            matched.append(ViewMatch(reference, target, similarity, matches, self.k))
        return matched

    def estimate_from_views(
        self, reference: View, targets: Sequence[View], matched: Sequence[ViewMatch] | None = None
    ) -> PoseEstimate:
        """Run the stages after feature extraction: matching and the solver (see `estimate`).

        `matched` is the result of `match_views`, if it is known already.
        """
        defect = frame_defect(reference.frame)
        if defect:
            raise NoPoseError(f"reference {reference.frame.name or 'view'}: {defect}")
        timings = {}
        if matched is None:
            with timed(timings, "matching"):
                matched = self.match_views(reference, targets)
        usable, flags = usable_targets(targets)
        inputs = (reference, [targets[i] for i in usable], [matched[i] for i in usable])
        if not isinstance(self.solver, str):  # a plug-in may overwrite what it gets
            inputs = deepcopy(inputs)
        found = self._solver()(*inputs, seed=self.seed, threshold=self.threshold)
        # The solver numbers the usable views only: back to the numbers of all views. `reshape`
        # fails for a wrong number of scores; a single score would else be written to all views.
        scores = np.full(len(targets), -np.inf)
        scores[usable] = np.reshape(found.view_scores, len(usable))
        return replace(
            found,
            view=usable[found.view],
            view_scores=scores,
            reference_view=reference,
            target_views=tuple(targets),
            timings=timings | found.timings,
            flags=(*flags, *found.flags),
            hypotheses=tuple(replace(one, view=usable[one.view]) for one in found.hypotheses),
        )

    def _solver(self) -> Solver:
        """Return the solver that the setting names."""
        if self.solver == "paper":
            return self._align_best_view
        if self.solver == "verified":  # a room above, imported when it is used
            return pkgutil.resolve_name("zsp_lite.verified:VerifiedSolver")()
        return self.solver

    def _align_best_view(self, reference, targets, matched, *, seed, threshold) -> PoseEstimate:
        """Solve as the paper does: select the best view (sec. 4.2) and fit the pose to its matches
        by RANSAC (sec. 4.3)."""
        timings = {}
        with timed(timings, "view"):
            if isinstance(self.view_selector, str):
                scored = [VIEW_SELECTORS[self.view_selector](one) for one in matched]
            else:  # a plug-in may overwrite what it gets
                scored = [self.view_selector(deepcopy(one)) for one in matched]
            scores = np.array(scored, dtype=np.float64)
            best = int(scores.argmax())
            matches = matched[best].matches
        with timed(timings, "alignment"):
            points = match_points(reference, targets[best], matches)
            size = targets[best].size
            # `SCALE_RANGE` is for objects of size 1.
            scales = tuple(size / reference.size * scale for scale in SCALE_RANGE)
            flags = ()
            try:
                sim3, inliers = ransac(
                    *points, threshold * size, self.trials, self.sample_size, seed, scales
                )
                agreeing = int(inliers.sum())
                if agreeing < self.sample_size:
                    flags = (f"only {agreeing} of {len(inliers)} matches agree with the pose",)
            except InputError as error:
                sim3 = view_alignment(reference, targets[best])
                inliers = np.zeros(len(matches), dtype=bool)
                flags = (f"pose is the best view's, not a fit: {error}",)
        return PoseEstimate(
            sim3, best, matches, inliers, scores, reference, tuple(targets), timings, flags
        )


def view_alignment(reference: View, target: View) -> Sim3:
    """Align a view with the reference without matches: the pose of the row "Ours-BV" in the paper's
    tables.

    The rotation is the identity. Scale and translation map the standard deviation and the centroid
    of the reference's foreground points onto those of the target's.
    """
    first = _foreground_points(reference)
    second = _foreground_points(target)
    spread = standard_deviation(first)
    target_spread = standard_deviation(second)
    scale = target_spread / spread if min(spread, target_spread) > 0 else 1.0
    return Sim3(scale, np.eye(3), second.mean(axis=0) - scale * first.mean(axis=0))


def _foreground_points(view: View) -> Float[np.ndarray, "n 3"]:
    """Get the points of the foreground patches with measured depth; if they are too few, of all
    patches with measured depth; if these are too few, of all patches."""
    points, known = view.patch_points
    for chosen in (view.known_foreground, known):
        if chosen.sum() >= _FEW:
            return points[chosen]
    return points.reshape(-1, 3)
