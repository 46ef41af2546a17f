"""The verified solver as a whole, with perfect features: estimates, invariances and flags."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from synthetic_views import ELSEWHERE, REACH, CoordinateBackbone, look_at, render, true_pose, turned

from zsp_lite import FeatureMap, Frame, PoseEstimate, Sim3, ZeroShotPose
from zsp_lite.metrics import rotation_error
from zsp_lite.points import object_points
from zsp_lite.verified.verification import TERM_NAMES, ScoreCoefficients

pytestmark = pytest.mark.slow

METHOD = ZeroShotPose(CoordinateBackbone(), solver="verified")


@pytest.fixture(scope="module")
def views(frames):
    """A reference and five target views."""
    return METHOD.views(frames)


@pytest.fixture(scope="module")
def estimate(views) -> PoseEstimate:
    """The estimate from all views."""
    return METHOD.estimate_from_views(views[0], views[1:])


def truth(estimate: PoseEstimate, frames: list[Frame]) -> Sim3:
    """The true pose in the view of an estimate."""
    return true_pose(frames[0].camera, Sim3.identity(), estimate.target_camera, ELSEWHERE)


def test_perfect_features_give_the_true_pose(estimate, frames):
    assert rotation_error(estimate.sim3.R, truth(estimate, frames).R) < 4
    assert_allclose(estimate.sim3.scale, ELSEWHERE.scale, rtol=0.08)
    centre = frames[0].camera.to_camera(np.zeros(3))
    assert_allclose(estimate.sim3.apply(centre), truth(estimate, frames).apply(centre), atol=0.12)
    assert estimate.confidence > 0.5
    assert not estimate.flags


def test_hypotheses_are_ranked_and_the_first_is_the_estimate(estimate):
    found = estimate.hypotheses
    assert 1 < len(found) <= 6
    assert found[0].sim3 is estimate.sim3
    assert found[0].view == estimate.view
    scores = [one.score for one in found]
    assert scores == sorted(scores, reverse=True)


def test_the_score_of_a_hypothesis_is_the_weighted_sum_of_its_terms(estimate):
    for one in estimate.hypotheses:
        assert one.terms.keys() == set(TERM_NAMES)
        expected = sum(getattr(ScoreCoefficients(), name) * one.terms[name] for name in TERM_NAMES)
        assert_allclose(one.score, expected, atol=1e-2)


def test_confidences_are_probabilities_and_the_first_is_the_largest(estimate):
    found = estimate.hypotheses
    assert all(0 <= one.confidence <= 1 for one in found)
    assert max(one.confidence for one in found) == found[0].confidence
    assert sum(one.confidence for index, one in enumerate(found) if one.mode == index) <= 1


def test_hypotheses_are_15_degrees_apart(estimate):
    found = estimate.hypotheses
    rotations = np.stack([estimate.between_worlds(one.sim3, one.view).R for one in found])
    apart = rotation_error(rotations[:, None], rotations)
    # But for rounding; each is 0 from itself.
    assert (apart + 180 * np.eye(len(found)) > 14.9).all()


def test_the_estimate_is_for_the_view_closest_to_the_reference(estimate):
    poses = estimate.propagate([view.frame.camera for view in estimate.target_views])
    angles = [rotation_error(pose.R, np.eye(3)) for pose in poses]
    assert estimate.view == np.argmin(angles) == np.argmax(estimate.view_scores)
    assert_allclose(-estimate.view_scores, angles, atol=0.1)


def test_inliers_agree_with_the_pose_within_a_fraction_of_the_objects_size(estimate, frames):
    source, target = estimate.points
    residual = np.linalg.norm(estimate.sim3.apply(source) - target, axis=1)
    seen = [frame.camera.to_world(object_points(frame)) for frame in frames[1:]]
    # The threshold is 0.2 of the spread of what the views show, which is known within a fifth.
    most = 0.2 * np.sqrt(np.concatenate(seen).var(axis=0).mean())
    sure = np.abs(residual / most - 1) > 0.2
    assert estimate.inliers.sum() > 20
    assert sure.sum() > 40
    assert_array_equal(estimate.inliers[sure], (residual < most)[sure])


def test_the_order_of_the_views_does_not_matter(estimate, views):
    order = [3, 0, 4, 2, 1]
    other = METHOD.estimate_from_views(views[0], [views[1 + index] for index in order])
    assert order[other.view] == estimate.view
    assert_array_equal(other.sim3.matrix, estimate.sim3.matrix)
    assert_array_equal(other.view_scores, estimate.view_scores[order])


def test_a_larger_scene_that_is_rotated_has_a_larger_scale_and_a_rotated_pose(estimate, views):
    turn = look_at((0.2, 0.5, -1)).R

    def moved(view):
        camera = turned(view.frame.camera, turn)
        camera = replace(camera, t=7 * camera.t)
        return replace(view, frame=replace(view.frame, camera=camera, depth=7 * view.frame.depth))

    other = METHOD.estimate_from_views(views[0], [moved(view) for view in views[1:]])
    assert_allclose(other.sim3.scale, 7 * estimate.sim3.scale, rtol=0.02)
    # Against a camera, which turns with the world, the rotation is the same.
    assert other.view == estimate.view
    assert rotation_error(other.sim3.R, estimate.sim3.R) < 0.5


def test_one_target_view_is_enough(views, frames):
    alone = METHOD.estimate_from_views(views[0], views[1:2])
    assert alone.view == 0
    assert rotation_error(alone.sim3.R, truth(alone, frames).R) < 10


def test_views_that_share_no_side_of_the_object_are_flagged():
    cameras = [
        turned(look_at(side, distance=4.5), ELSEWHERE.R)
        for side in [(-1, -0.2, -0.1), (-1, 0.3, -0.2)]
    ]
    reference = render(look_at((1, 0.2, 0.1)), Sim3.identity())
    found = METHOD.estimate(reference, [render(camera, ELSEWHERE) for camera in cameras])
    assert "are not similar" in found.note


def test_uninformative_features_give_a_low_confidence(views, estimate):
    rng = torch.Generator().manual_seed(0)

    def meaningless(view):
        keys = torch.randn(28, 28, 16, generator=rng)
        return replace(view, features=FeatureMap(keys, view.features.saliency, keys[0, 0]))

    found = METHOD.estimate_from_views(
        meaningless(views[0]), [meaningless(view) for view in views[1:]]
    )
    assert found.confidence < estimate.confidence
    assert found.flags


class SymmetricBackbone(CoordinateBackbone):
    """Features that are the same after a half turn about z."""

    def features(self, image):
        x, y, z = np.moveaxis(REACH * (image / 127 - 1), -1, 0)
        same = np.rint((np.stack([x * y, x**2 - y**2, z], -1) / REACH + 1) * 127).clip(1, 254)
        return super().features(np.where(image.any(axis=-1, keepdims=True), same, 0))


# Two by two opposite, so that a half turn about z does not change what was seen, either.
ALL_AROUND = [
    (1, 0.5, 0.5),
    (-1, -0.5, 0.5),
    (-0.4, 1, 0.2),
    (0.4, -1, 0.2),
    (0.6, -0.8, -0.4),
    (-0.6, 0.8, -0.4),
]


def test_a_symmetric_object_is_flagged_as_one_of_two_nearly_as_probable_poses(monkeypatch):
    # A half turn about z does not change it.
    def ellipsoid(points):
        return np.linalg.norm(points / (1.3, 0.9, 0.6), axis=-1) - 1

    monkeypatch.setattr("synthetic_views.inside", ellipsoid)
    cameras = map(look_at, [(0.9, -0.5, 0.3), *ALL_AROUND])
    reference, *targets = [render(camera, Sim3.identity()) for camera in cameras]
    found = ZeroShotPose(SymmetricBackbone(), solver="verified").estimate(reference, targets)
    assert found.one_of_two
    assert "one of two: poses" in found.note
    assert "the object may be symmetric" in found.note
    assert found.angle_to(found.alternatives[0]) > 150
    others = [one.confidence for one in found.alternatives]
    assert found.confidence >= others[0] > found.confidence / np.e
    assert found.confidence < 0.75
    assert found.confidence + sum(others) <= 1
