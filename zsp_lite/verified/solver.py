"""The verified solver: all stages from matched views to ranked hypotheses."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from zsp_lite.best_view import ViewPair
from zsp_lite.errors import check_seed
from zsp_lite.estimates import Hypothesis, PoseEstimate, match_points, timed
from zsp_lite.verified.confidence import (
    MODE_ANGLE,
    TIE_MARGIN,
    Calibration,
    calibration_for,
    hypothesis_probabilities,
    is_one_of_two,
    modes,
)
from zsp_lite.verified.poses import Poses, non_maximum_suppression, rotation_angles
from zsp_lite.verified.proposals import propose_poses
from zsp_lite.verified.refinement import MAX_HYPOTHESES, MIN_ANGLE, refine_coarse_to_fine
from zsp_lite.verified.scene import Scene, build_scene
from zsp_lite.verified.soft_icp import FEATURE_WEIGHT, soft_icp
from zsp_lite.verified.verification import ScoreTerms, ScoreWeights, score_terms
from zsp_lite.views import View

# Poses that go from the proposals to the refinement, and the smallest angle between them in degrees.
_MAX_REFINED, _MIN_ANGLE_REFINED = 12, 20.0
# The estimate is flagged below this fraction of points that lie on an observed surface, in both directions.
_MIN_OVERLAP = 0.05
# The estimate is flagged below this similarity term, in both directions. Correct and wrong hypotheses have 0.06 and
# more, views that share no side of the object 0.01.
_MIN_SIMILARITY = 0.02


@dataclass(frozen=True, eq=False)
class Solution:
    """Hypotheses of the verified solver, and what they were scored on.

    Attributes:
        hypotheses: Best score first, at least one, at least 15 degrees apart.
        view_angles: (N,) angle in degrees between the reference's camera and each target view's under the best one.
        flags: One line per reason not to trust the best one.
        one_of_two: Whether the answer is one of two poses (see `confidence.is_one_of_two`).
        timings: Seconds per stage.
        scene: The scene that poses were scored on.
        view_order: Index of the target view behind each view of the scene.
        poses: The hypotheses in the scene's working units.
    """

    hypotheses: tuple[Hypothesis, ...]
    view_angles: Float[np.ndarray, " n"]
    flags: tuple[str, ...]
    one_of_two: bool
    timings: dict[str, float]
    scene: Scene
    view_order: tuple[int, ...]
    poses: Poses

    @property
    def target_spread(self) -> float:
        """Standard deviation of the target object's points from all views, in units of the target's scene."""
        return 1 / self.scene.target_to_working.scale


@dataclass(frozen=True)
class VerifiedSolver:
    """A `estimates.Solver` that scores many poses against all target views. The defaults had the highest accuracy.

    Attributes:
        weights: Weights of the score's terms.
        calibration: Calibration of the confidences; None for the default one for the number of target views.
        feature_weight: Weight of the feature similarity in the soft ICP; 0 aligns by shape alone.
        icp: Whether to run the soft ICP.
        refinement: Whether to run the refinement.
    """

    weights: ScoreWeights = ScoreWeights()
    calibration: Calibration | None = None
    feature_weight: float = FEATURE_WEIGHT
    icp: bool = True
    refinement: bool = True

    def __call__(
        self, reference: View, targets: Sequence[View], pairs: Sequence[ViewPair], *, seed: int, threshold: float
    ) -> PoseEstimate:
        """Estimate the pose of the reference object (see `estimates.Solver`): the best hypothesis of `solve`."""
        solution = self.solve(reference, targets, pairs, seed)
        best = solution.hypotheses[0]
        matches = pairs[best.view].matches
        source, target = match_points(reference, targets[best.view], matches)
        residual = np.linalg.norm(best.sim3.apply(source) - target, axis=1)
        return PoseEstimate(
            best.sim3, best.view, matches, residual < threshold * solution.target_spread, -solution.view_angles,
            reference, tuple(targets), solution.timings, solution.flags, solution.hypotheses, solution.one_of_two,
        )  # fmt: skip

    def solve(
        self,
        reference: View,
        targets: Sequence[View],
        pairs: Sequence[ViewPair],
        seed: int | np.random.Generator = 0,
    ) -> Solution:
        """Run all stages: proposals, soft ICP, verification, refinement, ranking.

        The result is equivariant to the order of the target views and to rotations of their world frame.

        Args:
            reference: Reference view.
            targets: N >= 1 usable target views (see `views.usable_targets`).
            pairs: For each target view, its similarities to the reference and their matches.
            seed: Seed or generator of all random draws.

        Raises:
            InputError: The seed is negative or no integer; or the reference, or all targets together, have too few
                foreground patches of known depth.
        """
        check_seed("seed", seed)
        rng, timings = np.random.default_rng(seed), {}
        with torch.no_grad():
            with timed(timings, "scene"):
                order = _content_order(targets)
                scene = build_scene(
                    reference, [targets[k] for k in order], [pairs[k].similarity for k in order],
                    [pairs[k].matches for k in order],
                )  # fmt: skip
            with timed(timings, "proposals"):
                poses = propose_poses(scene, rng)
            with timed(timings, "alignment"):
                if self.icp:
                    poses = soft_icp(scene, poses, feature_weight=self.feature_weight)
            with timed(timings, "verification"):
                score = self.weights.score(score_terms(scene, poses))
                poses = poses[non_maximum_suppression(poses.rotation, score, _MIN_ANGLE_REFINED, _MAX_REFINED)]
            with timed(timings, "refinement"):
                if self.refinement:
                    poses = refine_coarse_to_fine(scene, poses, self.weights, rng)
            with timed(timings, "ranking"):
                terms = score_terms(scene, poses)
                best = non_maximum_suppression(poses.rotation, self.weights.score(terms), MIN_ANGLE, MAX_HYPOTHESES)
                poses, terms = poses[best], terms[best]
                hypotheses, view_angles = self._hypotheses(scene, poses, terms, order)
        angle = rotation_angles(poses.rotation, poses.rotation).double().numpy()
        one_of_two = is_one_of_two(np.array([one.confidence for one in hypotheses]), angle)
        flags = reliability_flags(hypotheses, poses, one_of_two)
        return Solution(hypotheses, view_angles, flags, one_of_two, timings, scene, order, poses)

    def _hypotheses(
        self, scene: Scene, poses: Poses, terms: ScoreTerms, order: Sequence[int]
    ) -> tuple[tuple[Hypothesis, ...], Float[np.ndarray, " n"]]:
        """Build the hypotheses of ranked poses, and return them with the view angles of the best one."""
        score = self.weights.score(terms).double().numpy()
        angle = rotation_angles(poses.rotation, poses.rotation).double().numpy()
        calibration = self.calibration or calibration_for(len(order))
        confidence = hypothesis_probabilities(score, angle, calibration, scene.view_similarity_std)
        mode = modes(angle)
        view_angle = rotation_angles(poses.rotation, scene.target_maps.rotation.transpose(1, 2)).double().numpy()
        hypotheses = []
        for i, view in enumerate(view_angle.argmin(axis=1)):
            sim3 = scene.to_sim3(poses, i, int(view))
            hypotheses.append(
                Hypothesis(sim3, order[view], float(score[i]), terms.as_dict(i), float(confidence[i]), int(mode[i]))
            )
        view_angles = np.empty(len(order))
        view_angles[list(order)] = view_angle[0]
        return tuple(hypotheses), view_angles


def tied_hypotheses(score: Float[Tensor, " m"], rotation: Float[Tensor, "m 3 3"]) -> list[int]:
    """Select the best hypothesis and those tied with it: within `TIE_MARGIN` nats, more than 30 degrees apart.

    Args:
        score: Scores of the hypotheses, nats.
        rotation: Rotations of the hypotheses.

    Returns:
        Indices, best score first.
    """
    distinct = non_maximum_suppression(rotation, score, MODE_ANGLE, len(score))
    return [int(i) for i in distinct if score[distinct[0]] - score[i] < TIE_MARGIN]


def reliability_flags(hypotheses: Sequence[Hypothesis], poses: Poses, one_of_two: bool = False) -> tuple[str, ...]:
    """Say why the best hypothesis may be wrong, one line per reason.

    Args:
        hypotheses: Hypotheses, best first.
        poses: The same in working units.
        one_of_two: Whether the answer is one of two poses.
    """
    terms, flags = hypotheses[0].terms, []
    tied = tied_hypotheses(torch.tensor([one.score for one in hypotheses]), poses.rotation)
    if one_of_two:
        second = next(i for i, one in enumerate(hypotheses) if i > 0 and one.mode == i)
        angle = float(rotation_angles(poses.rotation[:1], poses.rotation[second : second + 1]))
        flags.append(
            f"one of two: poses {angle:.0f} degrees apart explain the views about equally well (probabilities "
            f"{hypotheses[0].confidence:.2f} and {hypotheses[second].confidence:.2f}): the object may be symmetric"
        )
    elif len(tied) > 1:
        scores = ", ".join(f"{hypotheses[i].score:.1f}" for i in tied)
        flags.append(
            f"{len(tied)} poses more than 30 degrees apart explain the views equally well (scores {scores}): "
            "the object may be symmetric"
        )
    if max(terms["forward_overlap"], terms["reverse_overlap"]) < _MIN_OVERLAP:
        flags.append("no view confirms the pose: nearly no point lies on an observed surface")
    if max(terms["forward_similarity"], terms["reverse_similarity"]) < _MIN_SIMILARITY:
        flags.append("no view confirms the pose: features of points that coincide are not similar")
    return tuple(flags)


def _content_order(targets: Sequence[View]) -> tuple[int, ...]:
    """Sort the targets by a hash of their content, which neither their order nor the world's axes change."""
    content = [target.frame.rgb.tobytes() + target.foreground.cpu().numpy().tobytes() for target in targets]
    keys = [hashlib.blake2b(one, digest_size=16).digest() for one in content]
    return tuple(sorted(range(len(targets)), key=keys.__getitem__))
