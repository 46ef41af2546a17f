"""Every setting of the method and of the verified solver reaches its stage.

Each case changes one setting. The estimate must equal that of the stages called by hand with the same setting, and
the named result must differ from the one without the change: a setting that is ignored fails.
"""

from dataclasses import astuple, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from synthetic_views import AT_HOME, DIRECTIONS, ELSEWHERE, CoordinateBackbone, look_at, render, turned

from zsp_lite import pipeline
from zsp_lite.alignment import SCALE_RANGE, ransac
from zsp_lite.best_view import VIEW_SELECTORS, ViewPair
from zsp_lite.estimates import match_points
from zsp_lite.features import FeatureMap
from zsp_lite.matching import key_similarities, match, similarity
from zsp_lite.pipeline import ZeroShotPose, view_alignment
from zsp_lite.points import standard_deviation
from zsp_lite.verified import VerifiedSolver, proposals, refinement, soft_icp, solver
from zsp_lite.verified.confidence import Calibration
from zsp_lite.views import extract_views, object_crop


class NoisyBackbone(CoordinateBackbone):
    """Coordinates of the object with noise: matches have outliers, so that every setting changes the result."""

    def features(self, image):
        found = super().features(image)
        rng = np.random.default_rng(7)
        keys = found.keys + 0.5 * torch.from_numpy(rng.normal(size=found.keys.shape)).float()
        return FeatureMap(keys, found.saliency * torch.from_numpy(rng.uniform(0.5, 1, found.grid)).float(), keys[7, 7])


BASE = ZeroShotPose(NoisyBackbone(grid=14), k=30, trials=8, threshold=0.1)


@pytest.fixture(scope="module")
def frames():
    reference = render(look_at((1, 0.6, 0.4)), AT_HOME, "reference")
    cameras = [turned(look_at(direction, distance=4.5), ELSEWHERE.R) for direction in DIRECTIONS[::2]]
    return [reference, *(render(camera, ELSEWHERE, f"target {i}") for i, camera in enumerate(cameras))]


@pytest.fixture(scope="module")
def base(frames):
    return results(BASE.estimate(frames[0], frames[1:]))


def results(estimate) -> dict[str, np.ndarray]:
    return {
        "foreground": estimate.reference_view.foreground.numpy(),
        "matches": np.hstack([estimate.matches.reference, estimate.matches.target]),
        "scores": estimate.view_scores,
        "inliers": estimate.inliers,
        "pose": estimate.sim3.matrix,
    }


def by_hand(frames, s: ZeroShotPose):
    """Call the paper's stages one after the other with the settings `s`."""
    crops = [object_crop(frame) for frame in frames]
    reference, *targets = extract_views(s.backbone, crops, s.foreground, s.saliency_threshold)
    pairs = []
    for target in targets:
        maps = reference.features, target.features
        foregrounds = reference.foreground, target.foreground
        sim = similarity(*maps) if s.binning else key_similarities(maps[0], [maps[1]])[0]
        matches = match(
            *maps, s.k, s.clusters, s.seed, s.cycle_from, 0.0, *foregrounds, sim, matcher=s.matcher, binning=s.binning
        )
        pairs.append(ViewPair(*maps, *foregrounds, sim, matches, s.k))
    scores = np.array([VIEW_SELECTORS[s.view_selector](pair) for pair in pairs])
    view = scores.argmax()
    points = match_points(reference, targets[view], pairs[view].matches)
    target_points, known = targets[view].patch_points
    on_object = targets[view].foreground.numpy() & known
    unit = standard_deviation(target_points[on_object]) if s.adaptive_threshold else 1.0
    sim3, inliers = ransac(*points, unit * s.threshold, s.trials, s.sample_size, s.seed, SCALE_RANGE)
    return SimpleNamespace(
        reference_view=reference, matches=pairs[view].matches, view_scores=scores, inliers=inliers, sim3=sim3
    )


@pytest.mark.parametrize(
    "setting, value, changed",
    [
        ("saliency_threshold", 0.6, "foreground"),
        ("foreground", "mask", "foreground"),
        ("k", 20, "matches"),
        ("kmeans", False, "matches"),
        ("seed", 1, "matches"),
        ("cycle_from", "target", "matches"),
        ("matcher", "dual softmax", "matches"),
        ("binning", False, "matches"),
        ("view_selector", "global", "scores"),
        ("view_selector", "saliency", "scores"),
        ("view_selector", "cyclical", "scores"),
        ("threshold", 0.02, "inliers"),
        ("adaptive_threshold", True, "inliers"),
        ("trials", 100, "pose"),
        ("sample_size", 8, "pose"),
    ],
)
def test_a_setting_reaches_its_stage(frames, base, setting, value, changed):
    method = replace(BASE, **{setting: value})
    found, expected = results(method.estimate(frames[0], frames[1:])), results(by_hand(frames, method))
    for name in found:
        np.testing.assert_array_equal(found[name], expected[name], name)
    assert not np.array_equal(found[changed], base[changed])


def test_the_seed_reaches_ransac(frames):
    # Without k-means, matches do not depend on the seed.
    first, second = (replace(BASE, kmeans=False, seed=seed).estimate(frames[0], frames[1:]) for seed in (0, 1))
    assert (first.matches.reference == second.matches.reference).all()
    assert not np.array_equal(first.sim3.matrix, second.sim3.matrix)


def test_the_range_of_scales_reaches_ransac(frames, monkeypatch):
    free = replace(BASE, trials=1000).estimate(frames[0], frames[1:])
    monkeypatch.setattr(pipeline, "SCALE_RANGE", (1.2, 1.25))
    bounded = replace(BASE, trials=1000).estimate(frames[0], frames[1:])
    assert free.sim3.scale < 1.2 <= bounded.sim3.scale <= 1.25 and bounded.reliable


def test_a_given_matcher_selector_and_solver_are_called(frames):
    def match_nothing(similarity, foreground1, foreground2):
        return similarity.argmax(dim=1), similarity.new_full((len(similarity),), -np.inf)

    estimate = replace(BASE, matcher=match_nothing).estimate(frames[0], frames[1:])
    assert len(estimate.matches) == 0
    numbers = iter([1.0, 3.0, 2.0])
    estimate = replace(BASE, view_selector=lambda pair: next(numbers)).estimate(frames[0], frames[1:])
    assert estimate.view == 1 and estimate.view_scores.tolist() == [1, 3, 2]
    calls = []

    def record(reference, targets, pairs, *, seed, threshold):
        calls.append((seed, threshold))
        return pipeline.align_best_view(reference, targets, pairs)

    replace(BASE, solver=record, seed=5, threshold=0.3).estimate(frames[0], frames[1:])
    assert calls == [(5, 0.3)]


class Clustering(VerifiedSolver):
    kmeans = True


def test_a_solver_says_whether_kmeans_selects_its_matches(views):
    def matches(**settings):
        method = replace(BASE, **settings)
        return method.match_pair(*views[:2], method.similarities(views[0], views[1:2])[0]).matches.reference

    clustered, best = matches(kmeans=True), matches(kmeans=False)
    assert not np.array_equal(clustered, best)
    for chosen in ("paper", pipeline.align_best_view, Clustering()):
        np.testing.assert_array_equal(matches(solver=chosen), clustered)
        np.testing.assert_array_equal(matches(solver=chosen, kmeans=False), best)
    for chosen in ("verified", VerifiedSolver()):
        np.testing.assert_array_equal(matches(solver=chosen), best)
        np.testing.assert_array_equal(matches(solver=chosen, kmeans=True), clustered)


def test_the_scale_of_the_best_view_alone_is_that_of_target_over_reference(frames):
    reference, target = BASE.views([frames[0], replace(frames[0], depth=3 * frames[0].depth)])
    assert view_alignment(reference, target).scale == pytest.approx(3, rel=1e-4)


VERIFIED = replace(BASE, solver="verified")


@pytest.fixture(scope="module")
def views(frames):
    return BASE.views(frames)


def verify(views, method: ZeroShotPose, **settings):
    """Estimate with the verified solver of these settings, or with the one that "verified" names if there are none."""
    chosen = VerifiedSolver(**settings) if settings else "verified"
    return replace(method, solver=chosen).estimate_from_views(views[0], views[1:])


@pytest.fixture(scope="module")
def verified(views):
    return verify(views, VERIFIED)


@pytest.mark.parametrize("settings", [{"icp": False}, {"refinement": False}, {"feature_weight": 0.0}], ids=str)
def test_a_setting_of_the_verified_solver_changes_its_pose(views, verified, settings):
    assert not np.allclose(verify(views, VERIFIED, **settings).sim3.matrix, verified.sim3.matrix)


def test_the_weights_and_the_calibration_reach_the_verified_solver(views, verified):
    weights = replace(VerifiedSolver().weights, viewpoint=-3.0, forward_similarity=7.0)
    for one in verify(views, VERIFIED, weights=weights).hypotheses:
        assert one.score == pytest.approx(sum(w * t for w, t in zip(astuple(weights), one.terms.values())), abs=1e-3)
    certain = verify(views, VERIFIED, calibration=Calibration(20.0, 0.0, -3.0, 0.0, 0.0, 0.0))  # rivals do not count
    assert certain.confidence == pytest.approx(1 / (1 + np.exp(-3)))
    assert certain.confidence != verified.confidence


def test_the_seed_reaches_the_verified_proposals(views):
    first, second = (verify(views, replace(VERIFIED, seed=seed), icp=False, refinement=False) for seed in (0, 1))
    assert [one.score for one in first.hypotheses] != [one.score for one in second.hypotheses]


def test_the_seed_reaches_the_verified_refinement(views, monkeypatch):
    propose_poses = solver.propose_poses
    monkeypatch.setattr(solver, "propose_poses", lambda scene, rng: propose_poses(scene, 0))
    first, second = (verify(views, replace(VERIFIED, seed=seed)) for seed in (0, 1))
    assert [one.score for one in first.hypotheses] != [one.score for one in second.hypotheses]


def test_the_threshold_reaches_the_verified_solver(views, verified):
    assert verify(views, replace(VERIFIED, threshold=2.0)).inliers.sum() > verified.inliers.sum()


@pytest.mark.parametrize(
    "module, settings",
    [(proposals, {"icp": False, "refinement": False}), (soft_icp, {"refinement": False}), (refinement, {"icp": False})],
)
def test_the_range_of_scales_reaches_the_verified_search(views, monkeypatch, module, settings):
    sims = VERIFIED.similarities(views[0], views[1:])
    pairs = [VERIFIED.match_pair(views[0], target, sim) for target, sim in zip(views[1:], sims)]
    free = VerifiedSolver(**settings).solve(views[0], views[1:], pairs).poses.scale
    monkeypatch.setattr(module, "SCALE_RANGE", (0.6, 0.61))
    assert not torch.equal(VerifiedSolver(**settings).solve(views[0], views[1:], pairs).poses.scale, free)
