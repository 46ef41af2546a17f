"""From views to ranked hypotheses: the stages of the verified solver, one after the other."""

import hashlib
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from zsp_lite.best_view import ViewPair
from zsp_lite.pipeline import Hypothesis, PoseEstimate, match_points
from zsp_lite.verified.confidence import MODES_APART, Calibration, calibration_for, margins
from zsp_lite.verified.poses import Poses, angles, join, suppress
from zsp_lite.verified.proposals import propose
from zsp_lite.verified.refinement import COARSE, FINE, POLISH, refine
from zsp_lite.verified.scene import Scene, make_scene
from zsp_lite.verified.soft_icp import soft_icp
from zsp_lite.verified.verification import Terms, Weights, verify
from zsp_lite.views import View

# Hypotheses that go on after each stage, best first, and how far apart they are (degrees).
_COARSE_KEPT, _COARSE_APART = 12, 20.0
_FINE_KEPT, _FINE_APART = 6, 15.0
_POLISHED = 3
# About so many points of the reference and of the targets a search looks at; the last verification takes all.
_SEARCH_POINTS, _POLISH_POINTS = (150, 375), (450, 2000)
# Two answers whose scores are within this many nats explain the views equally well. Measured on ellipsoids whose
# features obey their symmetry, seen all around: the true answers' scores differ by 0.6 on the median, three of four
# times by less than 1. Of training pairs with so small a lead the better answer was right 62 % of the time
# (`benchmark.tuning`). Where the views saw more of the object under one answer than under the other, the scores of
# equally true answers differ by several nats, and nothing is noticed.
EQUALLY_GOOD = 1.0
# Share of the points below which nothing of the pose was confirmed.
_NOTHING_SEEN = 0.05
# Similarity (above that of any two places) of what lies on each other. Right and wrong answers alike have 0.06 and
# more; where the views share no side of the object it is 0.01.
_NOTHING_ALIKE = 0.02


@dataclass(frozen=True, eq=False)
class Solution:
    """What the solver found.

    hypotheses: best score first, at least 15 degrees apart, never none.  view_angles: degrees of rotation from the
    reference's camera to each target view's (N,), under the best.  flags: one line per reason not to trust it.
    timings: seconds per stage.  scene: what the poses were tested on, its views in the
    order `order` of the targets.  poses: the hypotheses in its working units.
    """

    hypotheses: tuple[Hypothesis, ...]
    view_angles: Float[np.ndarray, " n"]
    flags: tuple[str, ...]
    timings: dict[str, float]
    scene: Scene
    order: tuple[int, ...]
    poses: Poses

    @property
    def target_spread(self) -> float:
        """The object's standard deviation as all target views show it, in their unit."""
        return 1 / self.scene.target_frame.scale


@dataclass(frozen=True)
class VerifiedSolver:
    """The `Solver` beyond the paper: test many poses in all target views. The defaults are what measured best.

    Attributes:
        weights: Of the terms of the score.
        calibration: Of the confidences; None for the one that fits the number of target views.
        features: Weight of the similarity in the soft ICP.
        icp: Whether to run the soft ICP.
        refinement: Whether to run the refinement.
    """

    weights: Weights = Weights()
    calibration: Calibration | None = None
    features: float = 8.0
    icp: bool = True
    refinement: bool = True

    def __call__(
        self, reference: View, targets: Sequence[View], pairs: Sequence[ViewPair], *, seed: int, threshold: float
    ) -> PoseEstimate:
        """Estimate the pose (see `pipeline.Solver`): the best hypothesis of `solve`, and all others with it."""
        found = self.solve(reference, targets, pairs, seed)
        best = found.hypotheses[0]
        matches = pairs[best.view].matches
        source, target = match_points(reference, targets[best.view], matches)
        residual = np.linalg.norm(best.sim3.apply(source) - target, axis=1)
        return PoseEstimate(
            best.sim3, best.view, matches, residual < threshold * found.target_spread, -found.view_angles, reference,
            tuple(targets), found.timings, found.flags, found.hypotheses,
        )  # fmt: skip

    def solve(
        self,
        reference: View,
        targets: Sequence[View],
        pairs: Sequence[ViewPair],
        seed: int | np.random.Generator = 0,
    ) -> Solution:
        """Run all stages: proposals, soft ICP, verification, refinement of the best poses, ranking.

        The result does not depend on the order of the targets, and rotates with their world.

        Args:
            reference: Reference view.
            targets: N >= 1 usable target views (see `views.usable_targets`).
            pairs: For each target view, its similarities to the reference and their matches.
            seed: Of everything that is drawn.

        Raises:
            InputError: The reference, or all targets together, have too few foreground patches of known depth.
        """
        timings: dict[str, float] = {}
        with _timed(timings, "scene"), torch.no_grad():
            order = _content_order(targets)
            scene = make_scene(
                reference, [targets[k] for k in order], [pairs[k].similarity for k in order],
                [pairs[k].matches for k in order],
            )  # fmt: skip
        poses, terms = search(scene, seed, self, timings)
        with _timed(timings, "ranking"), torch.no_grad():
            score = self.weights.score(terms).double().numpy()
            apart = angles(poses.rotation, poses.rotation).double().numpy()
            calibration = self.calibration or calibration_for(len(order))
            confidence = calibration.confidence(margins(score, apart), scene.spread)
            sight = angles(poses.rotation, scene.target_maps.rotation.transpose(1, 2)).double().numpy()
            hypotheses = []
            for i in range(len(poses)):
                view = int(sight[i].argmin())
                pose = scene.sim3(poses, i, view)
                hypotheses.append(Hypothesis(pose, order[view], float(score[i]), terms.of(i), float(confidence[i])))
        view_angles = np.empty(len(targets))
        view_angles[list(order)] = sight[0]
        flags = _doubts(hypotheses, poses)
        return Solution(tuple(hypotheses), view_angles, flags, timings, scene, order, poses)


def search(
    scene: Scene,
    seed: int | np.random.Generator = 0,
    solver: VerifiedSolver = VerifiedSolver(),
    timings: dict[str, float] | None = None,
) -> tuple[Poses, Terms]:
    """The poses that explain a scene best, best first, at least 15 degrees apart, and their terms.

    timings: is given the seconds of each stage.
    """
    rng, timings = np.random.default_rng(seed), {} if timings is None else timings
    with _timed(timings, "proposals"), torch.no_grad():
        poses = propose(scene, rng)
    with _timed(timings, "alignment"), torch.no_grad():
        if solver.icp:
            poses = soft_icp(scene, poses, features=solver.features)
    with _timed(timings, "verification"), torch.no_grad():
        score = solver.weights.score(verify(scene, poses))
        poses = poses[suppress(poses.rotation, score, _COARSE_APART, _COARSE_KEPT)]
    with _timed(timings, "refinement"), torch.no_grad():
        if solver.refinement:
            poses = _refined(scene, poses, solver.weights, rng)
        terms = verify(scene, poses)
        best = suppress(poses.rotation, solver.weights.score(terms), _FINE_APART, _FINE_KEPT)
        return poses[best], terms[best]


def _refined(scene: Scene, poses: Poses, weights: Weights, rng: np.random.Generator) -> Poses:
    def score_with(points: tuple[int, int]) -> Callable[[Poses], Float[Tensor, " m"]]:
        there = len(scene.reference_points), len(scene.target_points)
        every = tuple(max(round(n / wanted), 1) for n, wanted in zip(there, points))
        return lambda tried: weights.score(verify(scene, tried, every))

    some, nearly_all = score_with(_SEARCH_POINTS), score_with(_POLISH_POINTS)
    poses, reached = refine(poses, some, COARSE, rng)
    poses = poses[suppress(poses.rotation, reached, _FINE_APART, _FINE_KEPT)]
    poses, reached = refine(poses, some, FINE, rng)
    order = suppress(poses.rotation, reached, _FINE_APART, _FINE_KEPT)
    polished, _ = refine(poses[order[:_POLISHED]], nearly_all, POLISH, rng)
    return join([polished, poses[order[_POLISHED:]]])


def equally_good(score: Float[Tensor, " m"], rotation: Float[Tensor, "m 3 3"]) -> list[int]:
    """The best hypothesis and all that are as good as it, within EQUALLY_GOOD nats and 30 degrees from one another."""
    modes = suppress(rotation, score, MODES_APART, len(score))
    return [int(i) for i in modes if score[modes[0]] - score[i] < EQUALLY_GOOD]


def _doubts(hypotheses: Sequence[Hypothesis], poses: Poses) -> tuple[str, ...]:
    """Why the best hypothesis may not be the answer."""
    best, flags = hypotheses[0], []
    alike = equally_good(torch.tensor([one.score for one in hypotheses]), poses.rotation)
    if len(alike) > 1:
        scores = ", ".join(f"{hypotheses[i].score:.1f}" for i in alike)
        flags.append(
            f"{len(alike)} poses more than 30 degrees apart explain the views equally well (scores {scores}): "
            "the object may be symmetric"
        )
    if max(best.terms["f_seen"], best.terms["r_seen"]) < _NOTHING_SEEN:
        flags.append("no view confirms the pose: hardly a point falls on a surface that was seen")
    if max(best.terms["f_sim"], best.terms["r_sim"]) < _NOTHING_ALIKE:
        flags.append("no view confirms the pose: what falls on each other does not look alike")
    return tuple(flags)


def _content_order(targets: Sequence[View]) -> tuple[int, ...]:
    """The targets sorted by a hash of their content, which neither their order nor the world's axes change."""
    content = [target.frame.rgb.tobytes() + target.foreground.cpu().numpy().tobytes() for target in targets]
    keys = [hashlib.blake2b(one, digest_size=16).digest() for one in content]
    return tuple(sorted(range(len(targets)), key=keys.__getitem__))


@contextmanager
def _timed(timings: dict[str, float], stage: str):
    start = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - start
