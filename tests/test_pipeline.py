"""The whole method with perfect features: what is left of the error, and how the pose behaves."""

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from synthetic_views import AT_HOME, DIRECTIONS, ELSEWHERE, CoordinateBackbone, look_at, render, true_pose, turned

from zsp_lite.alignment import ransac, umeyama
from zsp_lite.errors import InputError
from zsp_lite.estimates import PoseEstimate, match_points
from zsp_lite.features import FeatureMap
from zsp_lite.io.html import picture_html
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose, view_alignment
from zsp_lite.verified import VerifiedSolver
from zsp_lite.views import extract_views, object_crop, patch_mask


@pytest.fixture(scope="module")
def method():
    return ZeroShotPose(CoordinateBackbone())


@pytest.fixture(scope="module")
def reference():
    return render(look_at((1, 0.6, 0.4)), AT_HOME, "reference")


@pytest.fixture(scope="module")
def targets():
    # Upright cameras around the object; it and they are turned with its world.
    views = [turned(look_at(direction, distance=4.5), ELSEWHERE.R) for direction in DIRECTIONS]
    return [render(camera, ELSEWHERE, f"target {i}") for i, camera in enumerate(views)]


@pytest.fixture(scope="module")
def estimate(method, reference, targets):
    return method.estimate(reference, targets)


def test_the_true_pose_is_found_within_a_few_degrees(estimate, reference, targets):
    truth = true_pose(reference.camera, AT_HOME, targets[estimate.view].camera, ELSEWHERE)
    assert rotation_error(estimate.sim3.R, truth.R) < 4
    # Matches are whole patches apart from the truth, and least squares shrinks what is noisy.
    assert estimate.sim3.scale == pytest.approx(truth.scale, rel=0.1)
    centre = reference.camera.to_camera(np.zeros(3))
    np.testing.assert_allclose(estimate.sim3.apply(centre), truth.apply(centre), atol=0.1)
    assert estimate.reliable and estimate.note == ""


def test_the_best_view_looks_from_nearly_the_same_side(estimate, reference, targets):
    errors = [
        rotation_error(np.eye(3), true_pose(reference.camera, AT_HOME, target.camera, ELSEWHERE).R)
        for target in targets
    ]
    assert estimate.view == np.argmax(estimate.view_scores)
    assert estimate.view in np.argsort(errors)[:2]


def test_the_pose_is_the_fit_on_the_inlying_matches(estimate):
    source, target = (points[estimate.inliers] for points in estimate.points)
    assert estimate.inliers.sum() > 20
    np.testing.assert_allclose(umeyama(source, target).matrix, estimate.sim3.matrix, atol=1e-9)
    assert len(estimate.points[0]) == len(estimate.inliers) == len(estimate.matches.reference) <= 50


def test_matched_points_are_the_same_point_of_the_object(estimate, reference, targets):
    camera = targets[estimate.view].camera
    first = reference.camera.to_world(estimate.points[0])
    second = ELSEWHERE.inverse().apply(camera.to_world(estimate.points[1]))
    assert np.median(np.linalg.norm(first - second, axis=1)) < 0.1


def test_every_stage_is_timed(estimate):
    assert list(estimate.timings) == ["crop", "features", "matching", "view", "alignment"]
    assert all(seconds >= 0 for seconds in estimate.timings.values())


def test_a_second_run_gives_the_same_numbers(method, estimate, reference, targets):
    again = method.estimate(reference, targets)
    assert (again.sim3.matrix == estimate.sim3.matrix).all()
    assert (again.view_scores == estimate.view_scores).all()


def test_turning_the_target_world_leaves_the_pose_between_cameras(method, estimate, reference, targets):
    turn = look_at((0.2, 0.5, -1)).R
    moved = [replace(frame, camera=turned(frame.camera, turn)) for frame in targets]
    other = method.estimate(reference, moved)
    np.testing.assert_allclose(other.sim3.matrix, estimate.sim3.matrix, atol=1e-12)
    cameras = [frame.camera for frame in targets]
    moved_cameras = [turned(camera, turn) for camera in cameras]
    for before, after in zip(estimate.propagate(cameras), other.propagate(moved_cameras)):
        np.testing.assert_allclose(after.matrix, before.matrix, atol=1e-9)


def test_propagation_gives_the_pose_against_every_target_view(estimate, reference, targets):
    poses = estimate.propagate([frame.camera for frame in targets])
    np.testing.assert_allclose(poses[estimate.view].matrix, estimate.sim3.matrix, atol=1e-12)
    for pose, frame in zip(poses, targets):
        truth = true_pose(reference.camera, AT_HOME, frame.camera, ELSEWHERE)
        # One rigid target: the error is the same in every view.
        fitted = true_pose(reference.camera, AT_HOME, targets[estimate.view].camera, ELSEWHERE)
        expected = rotation_error(estimate.sim3.R, fitted.R)
        assert rotation_error(pose.R, truth.R) == pytest.approx(expected, abs=1e-6)


def test_views_prepared_before_give_the_same_estimate(method, estimate, reference, targets):
    views = extract_views(method.backbone, [object_crop(frame) for frame in (reference, *targets)])
    shared = method.estimate_from_views(views[0], views[1:])
    assert (shared.sim3.matrix == estimate.sim3.matrix).all()
    assert list(shared.timings) == ["matching", "view", "alignment"]


@pytest.mark.parametrize(
    "settings",
    [
        {"kmeans": False},
        {"k": 20},
        {"foreground": "mask"},
        {"cycle_from": "target"},
        {"view_selector": "global"},
        {"view_selector": "saliency"},
        {"view_selector": "cyclical"},
    ],
    ids=str,
)
def test_with_perfect_features_no_setting_breaks_the_method(method, reference, targets, settings):
    # The two nearest views only: what a selector picks of them can be aligned.
    pair = [targets[0], targets[4]]
    estimate = replace(method, **settings).estimate(reference, pair)
    truth = true_pose(reference.camera, AT_HOME, pair[estimate.view].camera, ELSEWHERE)
    assert rotation_error(estimate.sim3.R, truth.R) < 8


def test_depth_with_holes_still_gives_the_pose(method, reference, targets):
    rng = np.random.default_rng(0)

    def holes(frame):
        return replace(frame, depth=frame.depth * (rng.random(frame.depth.shape) > 0.4))

    estimate = method.estimate(holes(reference), [holes(frame) for frame in targets])
    truth = true_pose(reference.camera, AT_HOME, targets[estimate.view].camera, ELSEWHERE)
    assert rotation_error(estimate.sim3.R, truth.R) < 6


def test_a_frame_without_a_mask_is_taken_whole(reference):
    whole = object_crop(replace(reference, mask=None))
    assert whole.rgb.shape == (224, 224, 3)
    np.testing.assert_allclose(whole.camera.principal_point, 112)


def test_crops_have_the_size_that_the_backbone_takes(reference, targets):
    class Large(CoordinateBackbone):
        image_size = 448

    estimate = ZeroShotPose(Large()).estimate(reference, targets[:2])
    assert {view.frame.rgb.shape for view in (estimate.reference_view, *estimate.target_views)} == {(448, 448, 3)}
    np.testing.assert_allclose(
        ZeroShotPose(Large()).views([replace(reference, mask=None)])[0].frame.camera.K[:2, 2], 224
    )


def test_the_best_view_alone_maps_spread_and_centroid_onto_the_targets(method, reference):
    # The same view in a world of half the unit, shifted along the ray: all points are half as far.
    near = replace(reference, depth=reference.depth / 2)
    first, second = method.views([reference, near])
    sim3 = view_alignment(first, second)
    assert sim3.scale == pytest.approx(0.5, rel=1e-4)
    points, known = first.patch_points
    np.testing.assert_allclose(sim3.apply(points[known]), second.patch_points[0][known], atol=1e-3)


def test_a_printed_estimate_has_at_most_five_lines(estimate, method, reference, targets):
    for found in (estimate, replace(method, solver="verified").estimate(reference, targets[:2])):
        text = str(found)
        assert len(text) < 400 and text.count("\n") < 5
        assert f"target view {found.view} of {len(found.target_views)}" in text
    for part in (estimate.reference_view, estimate.matches, estimate.reference_view.features):
        assert len(repr(part)) < 200 and "tensor(" not in repr(part)


def test_a_patch_is_foreground_from_a_quarter_of_its_area(reference):
    mask = np.zeros(reference.mask.shape, np.float32)
    mask[:71, :90] = 1  # just over a quarter of 140 x 180 pixels
    assert patch_mask(replace(reference, mask=mask), (1, 1)).item()
    mask[69:] = 0
    assert not patch_mask(replace(reference, mask=mask), (1, 1)).item()


class TwoPatchBackbone(CoordinateBackbone):
    """Perfect features with a foreground of two patches: never four matches."""

    def features(self, image):
        found = super().features(image)
        saliency = torch.zeros_like(found.saliency)
        saliency[14, 14:16] = 1
        return FeatureMap(found.keys, saliency, found.global_feature)


def test_too_few_matches_fall_back_to_the_best_view_with_a_flag(reference, targets):
    estimate = ZeroShotPose(TwoPatchBackbone()).estimate(reference, targets)
    assert not estimate.reliable and "best view" in estimate.note and "at least 4" in estimate.note
    assert (estimate.sim3.R == np.eye(3)).all() and not estimate.inliers.any()
    # The object's middle still lands on the target's middle: both crops hold the object alone.
    middle = estimate.sim3.apply(reference.camera.to_camera(np.zeros(3)))
    truth = targets[estimate.view].camera.to_camera(ELSEWHERE.t)
    assert np.linalg.norm(middle - truth) < 0.5


def test_collinear_points_fall_back_and_say_so(method, reference):
    # The same view twice, at one depth everywhere, with one column of patches as foreground: points on a line.
    flat = replace(reference, depth=np.full_like(reference.depth, 4.0))
    views = extract_views(method.backbone, [object_crop(flat)] * 2)
    for view in views:
        view.foreground[:] = False
        view.foreground[:, 14] = True
    estimate = method.estimate_from_views(views[0], views[1:])
    assert not estimate.reliable and "collinear" in estimate.note


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["paper", "verified"])
@pytest.mark.parametrize("foreground", ["saliency", "mask"])
def test_a_target_with_an_empty_mask_is_left_out_with_a_flag(method, reference, targets, solver, foreground):
    empty = replace(targets[1], mask=np.zeros_like(targets[1].mask))
    method = replace(method, solver=solver, foreground=foreground)
    estimate = method.estimate(reference, [empty, targets[0], targets[4]])
    assert estimate.flags[0] == "target 1 left out: empty object mask"
    assert estimate.view != 0 and np.isneginf(estimate.view_scores[0]) and len(estimate.target_views) == 3
    without = method.estimate(reference, [targets[0], targets[4]])
    assert (estimate.sim3.matrix == without.sim3.matrix).all() and estimate.view == without.view + 1
    assert [one.view for one in estimate.hypotheses] == [one.view + 1 for one in without.hypotheses]


def test_targets_without_depth_or_foreground_are_left_out_with_a_flag(method, reference, targets):
    reference, *views = extract_views(method.backbone, [object_crop(frame) for frame in (reference, *targets)])
    no_depth = replace(views[0], frame=replace(views[0].frame, depth=None))
    unknown = replace(views[1], frame=replace(views[1].frame, depth=np.zeros_like(views[1].frame.depth)))
    blank = replace(views[2], foreground=torch.zeros_like(views[2].foreground))
    estimate = method.estimate_from_views(reference, [no_depth, unknown, blank, views[4]])
    assert estimate.view == 3 and estimate.flags == (
        "target 0 left out: no depth map",
        "target 1 left out: no known depth",
        "target 2 left out: no foreground",
    )
    with pytest.raises(InputError, match="all 2 target views were left out: target 0 left out: no depth map; target 1"):
        method.estimate_from_views(reference, [no_depth, unknown])


def test_a_function_can_be_the_solver(method, reference, targets):
    def first_view(reference, targets, pairs, *, seed, threshold):
        source, target = match_points(reference, targets[0], pairs[0].matches)
        sim3, inliers = ransac(source, target, threshold, seed=seed)
        scores = np.zeros(len(targets))
        return PoseEstimate(sim3, 0, pairs[0].matches, inliers, scores, reference, tuple(targets), {"solver": 1.0})

    estimate = replace(method, solver=first_view).estimate(reference, targets[:2])
    alone = method.estimate(reference, targets[:1])
    np.testing.assert_allclose(estimate.sim3.matrix, alone.sim3.matrix, atol=1e-9)
    assert list(estimate.timings) == ["crop", "features", "matching", "solver"]


@pytest.mark.slow
def test_a_solver_by_name_is_the_same_as_the_object(method, reference, targets):
    named = replace(method, solver="verified").estimate(reference, targets[:2])
    given = replace(method, solver=VerifiedSolver()).estimate(reference, targets[:2])
    assert (named.sim3.matrix == given.sim3.matrix).all() and len(named.hypotheses) == len(given.hypotheses)


def test_unusable_frames_are_refused_in_one_line(method, reference, targets):
    empty = replace(reference, mask=np.zeros_like(reference.mask))
    no_depth = replace(reference, depth=None)
    no_known = replace(reference, depth=np.zeros_like(reference.depth))
    for frame, word in ((empty, "mask"), (no_depth, "depth"), (no_known, "depth")):
        with pytest.raises(InputError, match=word) as error:
            method.estimate(frame, targets)
        assert "reference" in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(InputError, match="no target"):
        method.estimate(reference, [])
    with pytest.raises(InputError, match="mask"):
        replace(method, foreground="mask").estimate(replace(reference, mask=None), targets)


@pytest.mark.parametrize(
    "settings",
    [
        {"view_selector": "best"}, {"foreground": "all"}, {"cycle_from": "both"}, {"solver": "best"}, {"threshold": -1},
        {"k": 0}, {"k": 2.5}, {"k": True}, {"trials": 10.5}, {"trials": 0}, {"sample_size": 2}, {"sample_size": 4.0},
        {"seed": -1}, {"seed": 0.5}, {"kmeans": "no"}, {"adaptive_threshold": "no"}, {"binning": None},
        {"threshold": 0}, {"threshold": np.inf}, {"threshold": np.nan}, {"threshold": "0.2"}, {"threshold": True},
        {"saliency_threshold": np.nan}, {"saliency_threshold": np.inf}, {"saliency_threshold": "x"},
    ],
    ids=str,
)  # fmt: skip
def test_settings_out_of_range_are_refused_and_the_others_kept_as_given(settings):
    with pytest.raises(InputError, match=f"^{next(iter(settings))} is "):
        ZeroShotPose(CoordinateBackbone(), **settings)
    assert ZeroShotPose(CoordinateBackbone(), k=30).k == 30


def test_a_notebook_shows_small_pictures_above_the_text(estimate):
    for part, pictures in ((estimate, 2), (estimate.reference_view.features, 1), (estimate.reference_view.frame, 1)):
        shown = part._repr_html_()
        assert repr(part).replace("'", "&#x27;").replace(">", "&gt;") in shown
        found = [base64.b64decode(data) for data in re.findall(r"data:image/png;base64,([^\"]+)", shown)]
        assert [cv2.imdecode(np.frombuffer(one, np.uint8), 1).shape for one in found] == [(128, 128, 3)] * pictures


def test_a_picture_keeps_its_colours_and_aspect_and_a_map_is_stretched_to_black_and_white():
    red = np.zeros((64, 32, 3), np.uint8)
    red[..., 0] = 200
    ramp = np.linspace(3, 5, 100).reshape(10, 10)
    shown = re.findall(r"base64,([^\"]+)", picture_html("text", red, ramp))
    first, second = (cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), 1) for data in shown)
    assert first.shape == (128, 64, 3) and (first == [0, 0, 200]).all()
    assert second.min() == 0 and second.max() == 255
