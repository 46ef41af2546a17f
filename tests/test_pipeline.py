"""The whole method on an object with perfect features: the pose, every setting, and frames that
cannot be used.

The values are the truth, or symmetries of the problem (`test_sample_pairs.py` has those of the
one-page version). A setting that is ignored fails: each case changes one, and names the first
result that must differ.
"""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, true_pose

from zsp_lite import FeatureMap, PoseEstimate, ZeroShotPose, pipeline
from zsp_lite.alignment import ransac
from zsp_lite.best_view import VIEW_SELECTORS
from zsp_lite.errors import FatalError
from zsp_lite.estimates import match_points
from zsp_lite.matchers import MATCHERS
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import view_alignment
from zsp_lite.verified import VerifiedSolver
from zsp_lite.views import patch_mask

METHOD = ZeroShotPose(CoordinateBackbone())


@pytest.fixture(scope="module")
def reference(frames):
    """The frame of the reference object."""
    return frames[0]


@pytest.fixture(scope="module")
def targets(frames):
    """Five frames of the target object."""
    return frames[1:]


@pytest.fixture(scope="module")
def seen(frames):
    """The reference view and all target views, with perfect features."""
    return METHOD.views(frames)


@pytest.fixture(scope="module")
def estimate(reference, targets):
    """The estimate from all of them."""
    return METHOD.estimate(reference, targets)


def test_the_true_pose_is_found_within_a_few_degrees(estimate, reference, targets):
    truth = true_pose(reference.camera, AT_HOME, targets[estimate.view].camera, ELSEWHERE)
    assert rotation_error(estimate.sim3.R, truth.R) < 4
    # Matches are whole patches apart from the truth, and least squares shrinks what is noisy.
    assert_allclose(estimate.sim3.scale, truth.scale, rtol=0.1)
    centre = reference.camera.to_camera(np.zeros(3))
    assert_allclose(estimate.sim3.apply(centre), truth.apply(centre), atol=0.1)


def test_an_estimate_by_the_papers_solver_has_times_but_no_doubts(estimate):
    assert (estimate.flags, estimate.note) == ((), "")
    assert list(estimate.timings) == ["features", "matching", "view", "alignment"]
    assert estimate.alternatives == ()
    assert estimate.confidence is None


def test_propagation_gives_the_pose_against_every_target_view(estimate, targets):
    cameras = [frame.camera for frame in targets]
    poses = estimate.propagate(cameras)
    points = np.eye(4, 3)
    world = estimate.target_camera.to_world(estimate.sim3.apply(points))
    for pose, camera in zip(poses, cameras):
        assert_allclose(pose.apply(points), camera.to_camera(world), atol=1e-9)


def test_the_best_view_alone_maps_spread_and_centroid_onto_the_targets(reference):
    # The same view in a world of half the unit, shifted along the ray: all points are half as far.
    near = replace(reference, depth=reference.depth / 2)
    first, second = METHOD.views([reference, near])
    sim3 = view_alignment(first, second)
    assert_allclose(sim3.scale, 0.5, rtol=1e-4)
    points, known = first.patch_points
    assert_allclose(sim3.apply(points[known]), second.patch_points[0][known], atol=1e-3)


class NoisyBackbone(CoordinateBackbone):
    """Coordinates of the object with noise: matches have outliers, so that every setting changes
    the result."""

    def features(self, image):
        found = super().features(image)
        rng = np.random.default_rng(7)
        keys = found.keys + 0.5 * torch.from_numpy(rng.normal(size=found.keys.shape)).float()
        return FeatureMap(
            keys,
            found.saliency * torch.from_numpy(rng.uniform(0.5, 1, found.grid)).float(),
            keys[7, 7],  # any vector does for the whole image
        )


BASE = ZeroShotPose(NoisyBackbone(grid=14), k=30, trials=8, threshold=0.1)


@pytest.fixture(scope="module")
def views(reference, targets):
    """The reference and three target views, with noisy features."""
    return BASE.views([reference, *targets[::2]])


def estimate_noisy(views, **settings) -> PoseEstimate:
    """The estimate from noisy views by `BASE` with other settings."""
    return replace(BASE, **settings).estimate_from_views(views[0], views[1:])


def by_stage(estimate: PoseEstimate) -> dict[str, np.ndarray]:
    """Return the result of each stage, in the order of the stages."""
    return {
        "foreground": estimate.reference_view.foreground.numpy(),
        "scores": estimate.view_scores,
        "matches": np.hstack([estimate.matches.reference, estimate.matches.target]),
        "inliers": estimate.inliers,
        "pose": estimate.sim3.matrix,
    }


@pytest.mark.parametrize(
    "setting, value, first_changed",
    [
        ("foreground", "mask", "foreground"),
        ("k", 20, "scores"),
        ("kmeans", False, "scores"),
        ("seed", 1, "scores"),
        ("cycle_from", "target", "scores"),
        ("matcher", "dual softmax", "scores"),
        ("binning", False, "scores"),
        ("view_selector", "global", "scores"),
        ("view_selector", "saliency", "scores"),
        ("view_selector", "cyclical", "scores"),
        ("threshold", 0.02, "inliers"),
        ("trials", 100, "inliers"),
        ("sample_size", 8, "inliers"),
    ],
)
def test_a_setting_reaches_its_stage_and_no_earlier_one(
    reference, targets, setting, value, first_changed
):
    frames = reference, targets[::2]
    base = by_stage(BASE.estimate(*frames))
    other = by_stage(replace(BASE, **{setting: value}).estimate(*frames))
    changed = [name for name in base if not np.array_equal(base[name], other[name])]
    assert changed[0] == first_changed


def test_the_range_of_scales_reaches_ransac(views, monkeypatch):
    free = estimate_noisy(views, trials=1000)
    monkeypatch.setattr(pipeline, "SCALE_RANGE", (1.2, 1.25))  # the true scale is 1.15
    bounded = estimate_noisy(views, trials=1000)
    assert free.sim3.scale < 1.2 <= bounded.sim3.scale <= 1.25
    assert not bounded.flags


def first_view(reference, targets, matched, *, seed, threshold):
    """A solver of one's own: it fits the pose in the first target view."""
    sim3, inliers = ransac(
        *match_points(reference, targets[0], matched[0].matches), threshold, seed=seed
    )
    views = np.zeros(len(targets)), reference, tuple(targets)
    return PoseEstimate(sim3, 0, matched[0].matches, inliers, *views, {"solver": 1.0})


def test_a_given_matcher_selector_and_solver_are_called(views):
    def match_nothing(similarity, foreground1, foreground2):
        return similarity.argmax(dim=1), similarity.new_full((len(similarity),), -np.inf)

    assert len(estimate_noisy(views, matcher=match_nothing).matches) == 0
    numbers = iter([1.0, 3.0, 2.0])
    estimate = estimate_noisy(views, view_selector=lambda pair: next(numbers))
    assert estimate.view == 1
    assert estimate.view_scores.tolist() == [1, 3, 2]

    estimate = estimate_noisy(views, solver=first_view, seed=5, threshold=0.3)
    alone = estimate_noisy(views[:2], trials=1000, seed=5, threshold=0.3)
    assert_array_equal(estimate.sim3.matrix, alone.sim3.matrix)
    assert list(estimate.timings) == ["matching", "solver"]


def overwrite(*given):
    """Overwrite all arrays in what a plug-in was given with zeros."""
    for one in given:
        if isinstance(one, np.ndarray | torch.Tensor):
            one[...] = 0
        elif isinstance(one, list | tuple):
            overwrite(*one)
        elif hasattr(one, "__dict__"):
            overwrite(*vars(one).values())


def spoiling(plug_in):
    """A plug-in that does what the given one does, and then overwrites all that it was given."""

    def run(*given, **settings):
        found = deepcopy(plug_in(*given, **settings))
        overwrite(*given)
        return found

    return run


@pytest.mark.parametrize(
    "name, plug_in",
    [
        ("matcher", MATCHERS["mutual"]),
        ("solver", first_view),
        ("view_selector", VIEW_SELECTORS["correspond"]),
        ("backbone", CoordinateBackbone()),
    ],
)
def test_nothing_that_a_plug_in_overwrites_reaches_the_rest(reference, targets, name, plug_in):
    before = deepcopy((reference.rgb, targets[0].depth))
    found = replace(METHOD, **{name: spoiling(plug_in)}).estimate(reference, targets)
    expected = replace(METHOD, **{name: plug_in}).estimate(reference, targets)
    assert_array_equal(found.sim3.matrix, expected.sim3.matrix)
    one, other = found.target_views[0], expected.target_views[0]
    assert torch.equal(one.features.keys, other.features.keys)
    assert_array_equal(one.frame.rgb, other.frame.rgb)
    assert_array_equal(reference.rgb, before[0])
    assert_array_equal(targets[0].depth, before[1])


@pytest.mark.parametrize("answer", [lambda maps: maps[:-1], lambda maps: [1] * len(maps)])
def test_a_backbone_that_does_not_return_a_map_for_each_image_is_refused(
    reference, targets, answer
):
    method = ZeroShotPose(lambda images: answer(CoordinateBackbone()(images)))
    with pytest.raises(
        FatalError,
        match=r"backbone function returned \d of .* for 6 images, expected 6 of FeatureMap",
    ):
        method.estimate(reference, targets)


def test_a_solver_says_whether_kmeans_selects_its_matches(views):
    def matches(**settings):
        method = replace(BASE, **settings)
        return method.match_views(views[0], views[1:2])[0].matches.reference

    clustered, best = matches(kmeans=True), matches(kmeans=False)
    assert not np.array_equal(clustered, best)
    assert_array_equal(matches(solver=first_view), clustered)
    for chosen in ("verified", VerifiedSolver()):
        assert_array_equal(matches(solver=chosen), best)
        assert_array_equal(matches(solver=chosen, kmeans=True), clustered)


def scores(estimate: PoseEstimate) -> list[float]:
    return [one.score for one in estimate.hypotheses]


def test_seed_and_threshold_reach_the_verified_solver(views):
    verified = estimate_noisy(views, solver="verified")
    assert scores(estimate_noisy(views, solver="verified", seed=1)) != scores(verified)
    wide = estimate_noisy(views, solver="verified", threshold=2.0)
    assert wide.inliers.sum() > verified.inliers.sum()
    assert_array_equal(wide.sim3.matrix, verified.sim3.matrix)


def test_a_patch_is_foreground_from_a_quarter_of_its_area(reference):
    mask = np.zeros(reference.mask.shape, np.float32)
    mask[:71, :90] = 1  # just over a quarter of 140 x 180 pixels
    assert patch_mask(replace(reference, mask=mask), (1, 1)).item()
    mask[69:] = 0  # just under a quarter
    assert not patch_mask(replace(reference, mask=mask), (1, 1)).item()


def test_too_few_matches_fall_back_to_the_best_view_with_a_flag(seen):
    reference, *targets = seen
    two = torch.zeros_like(reference.foreground)
    two[14, 14:16] = True  # patches in the middle of 28 x 28
    estimate = METHOD.estimate_from_views(replace(reference, foreground=two), targets)
    assert "best view" in estimate.note
    assert "at least 4" in estimate.note
    assert_array_equal(estimate.sim3.R, np.eye(3))
    assert not estimate.inliers.any()
    # The object's middle still lands on the target's middle: both crops hold the object alone.
    middle = estimate.sim3.apply(reference.frame.camera.to_camera(np.zeros(3)))
    truth = estimate.target_camera.to_camera(ELSEWHERE.t)
    assert np.linalg.norm(middle - truth) < 0.5


@pytest.mark.parametrize("solver", ["paper", "verified"])
def test_targets_without_depth_or_foreground_are_left_out_with_a_flag(seen, solver):
    method = replace(METHOD, solver=solver)
    reference, *views = seen
    no_depth = replace(views[0], frame=replace(views[0].frame, depth=None))
    blank = replace(views[1], foreground=torch.zeros_like(views[1].foreground))
    estimate = method.estimate_from_views(reference, [no_depth, blank, views[4]])
    assert estimate.view == 2
    assert len(estimate.view_scores) == 3
    left_out = ("target 0 left out: no depth map", "target 1 left out: no foreground")
    assert estimate.flags[:2] == left_out
    refused(
        f"all 2 target views were left out: {'; '.join(left_out)}",
        method.estimate_from_views,
        reference,
        [no_depth, blank],
    )


def test_unusable_frames_are_refused_in_one_line(reference, targets):
    empty = replace(reference, mask=np.zeros_like(reference.mask))
    no_depth = replace(reference, depth=None)
    for frame, word in ((empty, "mask"), (no_depth, "depth")):
        assert "reference" in refused(word, METHOD.estimate, frame, targets)
    for none in ([], reference.rgb):
        refused("expected one zsp_lite.Frame or several", METHOD.estimate, reference, none)
    refused(
        "mask",
        replace(METHOD, foreground="mask").estimate,
        replace(reference, mask=None),
        targets,
    )


OUT_OF_RANGE = {
    "view_selector": ["best"],
    "foreground": ["all"],
    "cycle_from": ["both"],
    "solver": ["best"],
    "seed": [-1],
    "k": [0, 2.5, True],
    "trials": [0],
    "sample_size": [2],
    "threshold": [0, np.inf, np.nan, "0.2", True],
}


@pytest.mark.parametrize(
    "name, value", [(name, value) for name, values in OUT_OF_RANGE.items() for value in values]
)
def test_settings_out_of_range_are_refused(name, value):
    refused(f"^{name} is ", replace, METHOD, **{name: value})
