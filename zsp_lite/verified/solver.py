"""The verified solver: all stages from matched views to ranked hypotheses."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from zsp_lite.alignment import Sim3
from zsp_lite.estimates import Hypothesis, PoseEstimate, timed
from zsp_lite.matching import Matches
from zsp_lite.verified.confidence import Calibration, evidence, modes, reliability_flags
from zsp_lite.verified.poses import Poses, concatenate, non_maximum_suppression, rotation_angles
from zsp_lite.verified.proposals import poses_from_matches, poses_from_views
from zsp_lite.verified.refinement import MAX_HYPOTHESES, MIN_ANGLE, refine_coarse_to_fine
from zsp_lite.verified.scene import Scene, build_scene, measured_match_points
from zsp_lite.verified.soft_icp import soft_icp
from zsp_lite.verified.verification import TERM_NAMES, WEIGHTS, score_terms
from zsp_lite.views import View, ViewMatch

# Chosen, not fitted.
_MAX_REFINED = 12  # largest number of proposals that are refined
_MIN_ANGLE_REFINED = 20.0  # degrees between the rotations of these proposals


@dataclass(frozen=True, eq=False)
class Solution:
    """Hypotheses of the verified solver, and the scene on which their poses were scored."""

    hypotheses: tuple[Hypothesis, ...]  # best score first, at least one, at least 15 degrees apart
    # Angle in degrees from the reference's camera to each target view's, under the best hypothesis.
    view_angles: Float[np.ndarray, " n"]
    timings: dict[str, float]  # seconds per stage
    scene: Scene
    view_order: tuple[int, ...]  # index of the target view behind each view of the scene
    poses: Poses  # the hypotheses in the scene's working units


class VerifiedSolver:
    """An `estimates.Solver` that scores many poses against all target views."""

    kmeans = False  # the best matches, without clusters (see `ZeroShotPose.kmeans`)

    def __call__(self, reference, targets, matched, *, seed, threshold) -> PoseEstimate:
        """Return the best hypothesis of `solve`; `estimates.Solver` describes the arguments.

        Inliers have measured depth on both sides.
        """
        solution = self.solve(reference, targets, matched, seed)
        rotation = solution.poses.rotation
        best = solution.hypotheses[0]
        flags, one_of_two = reliability_flags(
            solution.hypotheses, rotation_angles(rotation, rotation).numpy()
        )
        matches = matched[best.view].matches
        # The spread of the target's points from all views: the threshold is relative to it.
        spread = 1 / solution.scene.target_to_working.scale
        inliers = measured_inliers(
            reference, targets[best.view], matches, best.sim3, threshold * spread
        )
        return PoseEstimate(
            best.sim3,
            best.view,
            matches,
            inliers,
            -solution.view_angles,
            reference,
            tuple(targets),
            solution.timings,
            flags,
            solution.hypotheses,
            one_of_two,
        )

    @torch.no_grad()
    def solve(
        self, reference: View, targets: Sequence[View], matched: Sequence[ViewMatch], seed: int
    ) -> Solution:
        """Run all stages on usable target views, in any order and any world, and their matches."""
        rng = np.random.default_rng(seed)
        timings = {}
        with timed(timings, "scene"):
            order = _content_order(targets)
            scene = build_scene(
                reference,
                [targets[k] for k in order],
                [matched[k].similarity for k in order],
                [matched[k].matches for k in order],
            )

        with timed(timings, "proposals"):
            enough = [points for points in scene.matches if len(points[0]) >= 3]
            by_view = [poses_from_matches(*points, rng) for points in enough]
            poses = concatenate([*by_view, poses_from_views(scene)])

        with timed(timings, "alignment"):
            poses = soft_icp(scene, poses)

        with timed(timings, "verification"):
            score = WEIGHTS.score(score_terms(scene, poses))
            poses = poses[
                non_maximum_suppression(poses.rotation, score, _MIN_ANGLE_REFINED, _MAX_REFINED)
            ]

        with timed(timings, "refinement"):
            poses = refine_coarse_to_fine(scene, poses, rng)

        with timed(timings, "ranking"):
            terms = score_terms(scene, poses)
            best = non_maximum_suppression(
                poses.rotation, WEIGHTS.score(terms), MIN_ANGLE, MAX_HYPOTHESES
            )
            poses = poses[best]
            terms = terms[best]
            angles = scene.view_angles(poses).numpy()
            score = WEIGHTS.score(terms).double().numpy()
            # Poses of one mode share a probability: the odds of all but the best one are 0.
            mode = modes(rotation_angles(poses.rotation, poses.rotation).numpy())
            deficit = np.where(mode == np.arange(len(mode)), score[0] - score, np.inf)
            x = evidence(
                scene.view_span,
                len(order),
                float(angles[0].min()),
                float(scene.view_similarity.std(correction=0)),
                float(WEIGHTS.of_shape().score(terms)[0]),
            )
            confidence = Calibration().probabilities(deficit, x)[mode]
            # The view of each hypothesis is the one whose camera is nearest under its pose.
            hypotheses = tuple(
                Hypothesis(
                    scene.to_sim3(poses, i, view),
                    order[view],
                    float(score[i]),
                    dict(zip(TERM_NAMES, terms[i].tolist())),
                    float(confidence[i]),
                    int(mode[i]),
                )
                for i, view in enumerate(angles.argmin(axis=1).tolist())
            )
        # The inverse permutation leads from the scene's order of the views back to the caller's.
        view_angles = angles[0][np.argsort(order)].astype(np.float64)
        return Solution(hypotheses, view_angles, timings, scene, order, poses)


def _content_order(targets: Sequence[View]) -> tuple[int, ...]:
    """Order views by a hash of their pixels: the order in which they come changes no result."""
    digests = []
    for target in targets:
        content = target.frame.rgb.tobytes() + target.foreground.numpy().tobytes()
        digests.append(hashlib.blake2b(content, digest_size=16).digest())
    return tuple(sorted(range(len(targets)), key=digests.__getitem__))


def measured_inliers(
    reference: View, target: View, matches: Matches, sim3: Sim3, threshold: float
) -> Bool[np.ndarray, " k"]:
    """Return which matches have measured depth on both sides and a small residual under a pose."""
    source, destination, known = measured_match_points(reference, target, matches)
    residual = np.linalg.norm(sim3.apply(source) - destination, axis=1)
    return known & (residual < threshold)
