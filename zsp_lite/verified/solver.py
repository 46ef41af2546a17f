"""The verified solver: all stages from matched views to ranked hypotheses."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float

from zsp_lite.best_view import ViewPair
from zsp_lite.errors import check_seed
from zsp_lite.estimates import Hypothesis, PoseEstimate, timed
from zsp_lite.verified.confidence import (
    Calibration,
    hypothesis_probabilities,
    is_one_of_two,
    modes,
    nearly_as_probable,
)
from zsp_lite.verified.poses import Poses, non_maximum_suppression, rotation_angles
from zsp_lite.verified.proposals import propose_poses
from zsp_lite.verified.refinement import MAX_HYPOTHESES, MIN_ANGLE, refine_coarse_to_fine
from zsp_lite.verified.scene import Scene, build_scene
from zsp_lite.verified.soft_icp import soft_icp
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
        calibration: Coefficients of the probabilities.
        kmeans: Whether k-means selects the matches (see `ZeroShotPose.kmeans`).
    """

    kmeans: ClassVar[bool] = False
    weights: ScoreWeights = ScoreWeights()
    calibration: Calibration = Calibration()

    def __call__(
        self, reference: View, targets: Sequence[View], pairs: Sequence[ViewPair], *, seed: int, threshold: float
    ) -> PoseEstimate:
        """Estimate the pose of the reference object (see `estimates.Solver`): the best hypothesis of `solve`.

        Inliers are matches with measured depth on both sides.
        """
        solution = self.solve(reference, targets, pairs, seed)
        best = solution.hypotheses[0]
        matches = pairs[best.view].matches
        (source, known), (target, seen) = (view.measured_points for view in (reference, targets[best.view]))
        u, v = tuple(matches.reference.T), tuple(matches.target.T)
        residual = np.linalg.norm(best.sim3.apply(source[u]) - target[v], axis=1)
        inliers = known[u] & seen[v] & (residual < threshold * solution.target_spread)
        return PoseEstimate(
            best.sim3, best.view, matches, inliers, -solution.view_angles,
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
                poses = soft_icp(scene, poses)
            with timed(timings, "verification"):
                score = self.weights.score(score_terms(scene, poses))
                poses = poses[non_maximum_suppression(poses.rotation, score, _MIN_ANGLE_REFINED, _MAX_REFINED)]
            with timed(timings, "refinement"):
                poses = refine_coarse_to_fine(scene, poses, self.weights, rng)
            with timed(timings, "ranking"):
                terms = score_terms(scene, poses)
                best = non_maximum_suppression(poses.rotation, self.weights.score(terms), MIN_ANGLE, MAX_HYPOTHESES)
                poses, terms = poses[best], terms[best]
                hypotheses, view_angles = self._hypotheses(scene, poses, terms, order)
        angle = rotation_angles(poses.rotation, poses.rotation).double().numpy()
        flags, one_of_two = reliability_flags(hypotheses, angle)
        return Solution(hypotheses, view_angles, flags, one_of_two, timings, scene, order, poses)

    def _hypotheses(
        self, scene: Scene, poses: Poses, terms: ScoreTerms, order: Sequence[int]
    ) -> tuple[tuple[Hypothesis, ...], Float[np.ndarray, " n"]]:
        """Build the hypotheses of ranked poses, and return them with the view angles of the best one."""
        score = self.weights.score(terms).double().numpy()
        angle = rotation_angles(poses.rotation, poses.rotation).double().numpy()
        mode = modes(angle)
        confidence = hypothesis_probabilities(
            score,
            mode,
            len(order),
            scene.view_similarity_std,
            float(self.weights.shape_fit(terms)[0]),
            self.calibration,
        )
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


def reliability_flags(
    hypotheses: Sequence[Hypothesis], angle: Float[np.ndarray, "m m"]
) -> tuple[tuple[str, ...], bool]:
    """Say why the best hypothesis may be wrong, one line per reason, and whether the answer is one of two poses.

    Args:
        hypotheses: Hypotheses, best first.
        angle: Angles between their rotations, degrees.
    """
    terms, flags = hypotheses[0].terms, []
    probability = np.array([one.confidence for one in hypotheses])
    mode = np.array([one.mode for one in hypotheses])
    tied, one_of_two = nearly_as_probable(probability, mode), is_one_of_two(probability, mode, angle)
    shown = " and ".join(f"{probability[i]:.2f}" for i in tied)
    if one_of_two:
        flags.append(
            f"one of two: poses {angle[tied[0], tied[1]]:.0f} degrees apart explain the views about equally well "
            f"(probabilities {shown}): the object may be symmetric"
        )
    elif len(tied) > 1:
        flags.append(
            f"{len(tied)} poses more than 30 degrees apart explain the views about equally well (probabilities "
            f"{shown}): the object may be symmetric"
        )
    if max(terms["forward_overlap"], terms["reverse_overlap"]) < _MIN_OVERLAP:
        flags.append("no view confirms the pose: nearly no point lies on an observed surface")
    if max(terms["forward_similarity"], terms["reverse_similarity"]) < _MIN_SIMILARITY:
        flags.append("no view confirms the pose: features of points that coincide are not similar")
    return tuple(flags), one_of_two


def _content_order(targets: Sequence[View]) -> tuple[int, ...]:
    """Sort the targets by a hash of their content, which neither their order nor the world's axes change."""
    content = [target.frame.rgb.tobytes() + target.foreground.cpu().numpy().tobytes() for target in targets]
    keys = [hashlib.blake2b(one, digest_size=16).digest() for one in content]
    return tuple(sorted(range(len(targets)), key=keys.__getitem__))
