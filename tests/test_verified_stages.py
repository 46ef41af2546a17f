"""Each stage of the verified solver by itself, against values worked out another way."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic_views import ELSEWHERE, CoordinateBackbone, true_pose

from zsp_lite import Camera, FeatureMap, Frame, Sim3, ZeroShotPose
from zsp_lite.estimates import Hypothesis
from zsp_lite.metrics import rotation_error
from zsp_lite.verified.confidence import Calibration, evidence, modes, reliability_flags
from zsp_lite.verified.poses import (
    Poses,
    concatenate,
    non_maximum_suppression,
    rotation_angles,
    rotation_matrices,
)
from zsp_lite.verified.proposals import poses_from_matches, poses_from_views
from zsp_lite.verified.refinement import FINE, refine
from zsp_lite.verified.scene import build_maps, build_scene, project_points, surface_weights
from zsp_lite.verified.soft_icp import soft_icp
from zsp_lite.verified.verification import (
    TERM_NAMES,
    ScoreCoefficients,
    score_terms,
)
from zsp_lite.views import View
from zsp_lite.viz.reliability import reliability

seeds = st.integers(0, 2**31)

METHOD = ZeroShotPose(CoordinateBackbone(), solver="verified")


@pytest.fixture(scope="module")
def views(frames):
    """A reference view and three target views."""
    return METHOD.views(frames[:4])


@pytest.fixture(scope="module")
def scene(views):
    """Their scene."""
    reference, *targets = views
    found = [(one.similarity, one.matches) for one in METHOD.match_views(reference, targets)]
    return build_scene(reference, targets, *zip(*found))


def featureless_scene(views):
    """A scene in which the features say nothing: all 28 x 28 patches are equally similar."""
    return build_scene(views[0], views[1:], [torch.zeros(784, 784)] * len(views[1:]), [])


@pytest.fixture(scope="module")
def truth(frames, scene):
    """The true pose in working units."""
    pose = true_pose(frames[0].camera, Sim3.identity(), frames[1].camera, ELSEWHERE)
    pose = scene.target_to_working @ pose @ scene.reference_to_working.inverse()
    parts = [pose.scale], pose.R[None], pose.t[None]
    return Poses(*(torch.tensor(part, dtype=torch.float32) for part in parts))


@given(seeds)
def test_suppression_keeps_the_best_of_each_neighbourhood(seed):
    rng = default_rng(seed)
    rotation = rotation_matrices(torch.tensor(rng.normal(0, 0.5, (12, 3)), dtype=torch.float32))
    score = torch.tensor(rng.normal(size=12))
    # At least 25 degrees apart; as many as there are, 12.
    kept = non_maximum_suppression(rotation, score, 25.0, 12)
    apart = rotation_angles(rotation, rotation)
    assert (score[kept].diff() <= 0).all()
    assert (apart[kept][:, kept] + 180 * torch.eye(len(kept)) >= 25).all()
    for dropped in set(range(12)) - set(kept.tolist()):
        assert any(apart[dropped, k] < 25 and score[k] >= score[dropped] for k in kept)


def wall(mask: np.ndarray, grid: tuple[int, int]) -> View:
    """A view of a wall at depth 2, as wide as it is far away, of which a mask is the object."""
    size = mask.shape
    camera = Camera(np.eye(3), np.zeros(3), np.full(2, 64.0), np.full(2, 32.0), size)
    features = FeatureMap(torch.zeros(*grid, 4), torch.ones(grid), torch.ones(4))
    frame = Frame(np.zeros((*size, 3), np.uint8), np.full(size, 2, np.float32), mask, camera)
    return View(frame, features, torch.ones(grid, dtype=torch.bool), mask)


def test_an_object_cut_off_by_the_border_is_not_known_to_end_there():
    mask = np.zeros((64, 64), np.float32)
    mask[:, :32] = 1  # The object reaches the left border and ends in the middle of the image.
    maps = build_maps([wall(mask, (8, 8))], [Sim3.identity()], Sim3.identity(), [np.arange(64)])
    still = Poses(torch.ones(1), torch.eye(3)[None], torch.zeros(1, 3))
    # Both points project 19.2 pixels beyond a border.
    points = torch.tensor([[-1.6, 0.0, 2.0], [1.6, 0.0, 2.0]])
    _, _, _, distance, _ = project_points(maps, still, points)
    # 32 pixels to the border and 19.2 beyond are 51.2, at 32 pixels per unit of length.
    assert_allclose(distance[0, 0], [0, 51.2 / 32], rtol=0.05)


@pytest.mark.parametrize("size, grid", [((96, 160), (12, 20)), ((210, 140), (15, 7))])
def test_a_map_pixel_reads_the_patch_that_its_centre_lies_in(size, grid):
    view = wall(np.ones(size, np.float32), grid)
    maps = build_maps([view], [Sim3.identity()], Sim3.identity(), [np.arange(grid[0] * grid[1])])
    width, height = maps.size[0].int().tolist()

    def cells(pixels: int, count: int) -> np.ndarray:
        """The cell in which the centre of each pixel of a side lies, in whole numbers."""
        return (2 * np.arange(pixels) + 1) * count // (2 * pixels)

    rows, columns = grid
    expected = cells(height, rows)[:, None] * columns + cells(width, columns)
    assert_array_equal(maps.table[:, 3].reshape(height, width), expected)


def test_outliers_far_behind_the_object_are_left_out(views):
    reference, *targets = views
    depth = reference.frame.depth.copy()
    # All pixels of one patch of the object, 8 x 8, are ten times as far as the object.
    known = np.argwhere(depth > 0)
    row, column = known[len(known) // 2] // 8 * 8
    depth[row : row + 8, column : column + 8] = 40
    spoilt = replace(reference, frame=replace(reference.frame, depth=depth))
    whole = featureless_scene(views)
    without = featureless_scene([spoilt, *targets])
    assert len(without.reference_points) == len(whole.reference_points) - 1
    assert float(without.reference_points.abs().max()) < 4  # times the size of the object


@given(seeds)
@settings(max_examples=25)
def test_matches_with_outliers_propose_the_true_pose(seed):
    rng = default_rng(seed)
    pose = Sim3(
        rng.uniform(0.7, 1.4), Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 0.1, 3)
    )
    source = rng.normal(size=(30, 3))
    target = pose.apply(source)
    # The first 12 of 30 matches are outliers.
    target[:12] = rng.normal(size=(12, 3))
    points = [torch.tensor(part, dtype=torch.float32) for part in (source, target)]
    found = poses_from_matches(*points, default_rng(seed))
    assert rotation_error(found.rotation[0], pose.R) < 1
    # At most six proposals, at least 20 degrees apart.
    assert len(found) <= 6
    assert (rotation_angles(found.rotation, found.rotation).fill_diagonal_(180) >= 20).all()


def test_of_matches_in_one_place_no_pose_is_proposed():
    points = torch.zeros(5, 3)  # no scale is plausible
    assert len(poses_from_matches(points, points, default_rng(0))) == 0


def test_a_view_rotation_sees_the_reference_from_that_view(scene):
    found = poses_from_views(scene)
    assert len(found) == 3 + 11  # one for each view, and turns of the first by 30 to 330 degrees
    for view in range(3):
        assert_allclose(scene.to_sim3(found, view, view).R, np.eye(3), atol=1e-5)


def test_the_first_view_is_turned_about_the_vertical_in_steps_of_30_degrees(scene):
    turned = poses_from_views(scene).rotation[[0, *range(3, 14)]].double().numpy()
    assert_allclose(rotation_error(turned, np.roll(turned, 1, axis=0)), 30, atol=1e-3)
    # The rotation axis is up in all target images: y points down in cameras.
    axis = np.linalg.svd(turned[1] @ turned[0].T - np.eye(3))[2][2]
    in_cameras = scene.target_maps.rotation.double().numpy() @ axis
    assert (np.abs(in_cameras[:, 1]) > 0.7).all()


def test_soft_icp_approaches_the_true_pose_and_keeps_it(scene, truth):
    turn = rotation_matrices(torch.tensor([[0.25, -0.25, 0.17]]))
    start = Poses(truth.scale * 0.8, turn @ truth.rotation, truth.translation + 0.15)
    aligned = soft_icp(scene, concatenate([start, truth]))
    errors = rotation_angles(aligned.rotation, truth.rotation)[:, 0]
    assert float(rotation_angles(start.rotation, truth.rotation)) > 20
    assert errors.max() < 10
    assert (aligned.scale / truth.scale - 1).abs().max() < 0.12


def test_the_truth_scores_above_other_poses(scene, truth):
    # Nearly half turns about the axes, and smaller ones.
    angles = torch.tensor([[3.1, 0, 0], [0, 3.1, 0], [0, 0, 3.1], [0.7, 0, 0], [0, -0.7, 0]])
    turns = rotation_matrices(angles)
    others = Poses(truth.scale.expand(5), turns @ truth.rotation, truth.translation.expand(5, 3))
    terms = score_terms(scene, concatenate([truth, others]))
    assert int(ScoreCoefficients().score(terms).argmax()) == 0
    # Similarities and overlaps are highest, silhouettes and free space lowest.
    assert (terms[0, [0, 1, 4, 5]] > terms[1:, [0, 1, 4, 5]]).all()
    assert terms[0, [2, 3, 6, 7]].max() < 0.02
    # Some of the points tell about the same.
    assert_allclose(score_terms(scene, truth, (2, 3))[0], terms[0], atol=0.02)


def test_the_viewpoint_term_is_highest_from_the_viewpoint_of_the_most_similar_view(views):
    """Of two target views far apart, one is similar: the term is its similarity weighted by the
    angle."""
    alike, other = torch.full((784, 784), 0.2), torch.full((784, 784), -0.4)
    scene = build_scene(views[0], views[1:3], [alike, other], [])
    assert_allclose(scene.view_similarity, [0.3, -0.3], atol=1e-6)
    sides = poses_from_views(scene)[:2]
    apart = rotation_error(*sides.rotation)
    expected = 0.3 * (1 - np.exp(-((apart / 45) ** 2)))
    assert_allclose(score_terms(scene, sides)[:, -1], [expected, -expected], atol=1e-3)


def test_refinement_raises_the_score():
    goal = rotation_matrices(torch.tensor([[0.5, -0.3, 0.8]]))

    def score(poses: Poses) -> torch.Tensor:
        apart = rotation_angles(poses.rotation, goal)[:, 0] / 20
        return -apart - poses.scale.log().square() - poses.translation.square().sum(dim=1)

    turns = rotation_matrices(torch.tensor([[0.2, 0.1, -0.15], [-0.1, 0.15, 0.15]]))
    start = Poses(torch.tensor([0.9, 1.2]), turns @ goal, torch.full((2, 3), 0.1))
    found, reached = refine(start, score, FINE._replace(rounds=8), default_rng(0))
    assert (reached > score(start)).all()
    assert_allclose(reached, score(found), atol=1e-3)
    assert (rotation_angles(found.rotation, goal) < 4).all()


def test_bad_scenes_are_refused_in_one_line(views):
    reference, *targets = views
    empty = replace(reference, foreground=torch.zeros(28, 28, dtype=torch.bool))
    refused(
        "reference: 0 foreground patches of known depth, expected at least 8",
        featureless_scene,
        [empty, *targets],
    )
    refused("target views: 0 foreground patches", featureless_scene, [reference, empty])


def test_surface_weights_do_not_depend_on_the_sampling_density():
    rng = default_rng(6)
    angle = np.concatenate([rng.uniform(0, np.pi, 400), rng.uniform(np.pi, 2 * np.pi, 100)])
    ring = torch.tensor(
        np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) * 2, dtype=torch.float32
    )
    share = surface_weights(ring)
    assert_allclose(share.sum(), 1, atol=1e-5)
    assert_allclose(share[:400].sum(), 0.5, atol=0.05)


def test_reliability_by_hand():
    confidence = np.array([0.1, 0.3, 0.5, 0.7, 0.8, 0.8])
    right = np.array([False, True, False, True, True, True])
    found = reliability(confidence, right, bins=2)
    assert_allclose(found.confidence, [0.3, 2.3 / 3])
    assert_allclose(found.accuracy, [1 / 3, 1])
    assert found.calibration_error == pytest.approx((1 / 3 - 0.3 + 1 - 2.3 / 3) / 2)


# Angles between five rotations about one axis, of 0, 20, 180, 190 and 90 degrees.
TURNS = np.array([0.0, 20, 180, 190, 90])
APART = np.abs((TURNS[:, None] - TURNS + 180) % 360 - 180)


def test_hypotheses_within_30_degrees_of_a_better_one_are_the_same_pose():
    assert_array_equal(modes(APART), [0, 0, 2, 2, 4])
    # The nearest of the better poses stands for it: 25 degrees from the first, 10 from the second.
    line = np.array([0.0, 35, 25])
    assert_array_equal(modes(np.abs(line[:, None] - line)), [0, 1, 1])


def test_probabilities_by_hand():
    # Of four views that span half the circle, the nearest with exp(-(angle / 45)^2) = 1/2.
    known = evidence(180, 4, 45 * np.sqrt(np.log(2)), 0.03, 2.0)
    assert_allclose(known, [1, 0.5, np.log(4), 0.5, 0.03, 2])
    calibration = Calibration((np.log(2), 0, 0, 0, 0, 0), (0, np.log(9), 0, 0, 0, 0), 0.4)
    odds = np.array([1, 1 / 4, 1 / 16, 0])
    found = calibration.probabilities(np.array([0, 1, 2, np.inf]) * np.log(2), known)
    assert_allclose(found, (1 - 0.4 / 4) * odds / (3 + odds.sum()))


@pytest.mark.parametrize(
    "probabilities, angles, one_of_two, start",
    [
        ((0.45, 0.35, 0.1), APART, True, "one of two: poses 180 degrees apart"),
        ((0.5, 0.3, 0.18), APART, True, "one of two"),  # the third is below 1/e of the first
        ((0.6, 0.2, 0.1), APART, False, ""),
        ((0.4, 0.3, 0.2), APART, False, "3 poses more than 30 degrees apart"),
        ((0.25, 0.2, 0.05), APART, False, "2 poses"),  # probably none is right
        # 59.8 degrees apart: a third rotation may be near both.
        ((0.45, 0.35, 0.1), APART / 3.01, False, "2 poses"),
    ],
)
def test_an_answer_is_one_of_two_if_just_two_poses_far_apart_are_nearly_as_probable(
    probabilities, angles, one_of_two, start
):
    terms, mode = dict.fromkeys(TERM_NAMES, 1.0), [0, 0, 2, 2, 4]
    confidence = dict(zip((0, 2, 4), probabilities))
    hypotheses = [Hypothesis(Sim3.identity(), 0, 0.0, terms, confidence[m], m) for m in mode]
    flags, found = reliability_flags(hypotheses, angles)
    assert found == one_of_two
    assert len(flags) == bool(start)
    assert not start or flags[0].startswith(start)
