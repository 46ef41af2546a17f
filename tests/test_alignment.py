"""Umeyama and RANSAC: recovery, reflections, outliers, degenerate input."""

import tracemalloc
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

from zsp_lite import Camera, FeatureMap, Frame, Sim3
from zsp_lite.alignment import ransac, umeyama
from zsp_lite.data.labels import PoseLabel
from zsp_lite.errors import rotation_matrix

seeds = st.integers(0, 2**32 - 1)
scales = st.floats(0.3, 4.0)


def similarity(seed: int, scale: float = 1.3) -> Sim3:
    rng = default_rng(seed)
    return Sim3(scale, Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3) * 3)


def cloud(seed: int, n: int = 20) -> np.ndarray:
    return default_rng(seed).normal(size=(n, 3)) * (1.0, 0.7, 0.4)


def assert_same(first: Sim3, second: Sim3, atol: float = 1e-9):
    assert_allclose(first.matrix, second.matrix, atol=atol)


@given(seeds, scales)
def test_composition_and_application_are_products_with_the_matrix(seed, scale):
    a = similarity(seed, scale)
    b = similarity(seed + 7)
    points = cloud(seed)
    assert_same(a @ a.inverse(), Sim3.identity())
    assert_same(Sim3.from_matrix(a.matrix), a)
    assert_allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-9)
    homogeneous = np.c_[points, np.ones(len(points))] @ a.matrix.T
    assert_allclose(a.apply(points), homogeneous[:, :3], atol=1e-9)


@pytest.mark.parametrize(
    "part, value",
    [
        ("scale", 0.0),
        ("R", np.diag([1.0, 1.0, -1.0])),
        ("R", np.eye(4)),
        ("t", np.array([0.0, np.inf, 0.0])),
    ],
)
def test_what_is_no_similarity_is_refused(part, value):
    refused(f"Sim3: .*{part} .*expected", replace, Sim3.identity(), **{part: value})


def test_a_rounded_rotation_becomes_the_nearest_one_and_another_is_refused():
    exact = similarity(3).R
    R = exact.round(2)
    nearest = Rotation.from_matrix(R).as_matrix()
    camera = Camera(R, np.zeros(3), np.ones(2), np.ones(2), (2, 2))
    for one in (
        Sim3(1.0, R, np.zeros(3)).R,
        rotation_matrix("R", np.stack([R, R]))[1],
        camera.R,
    ):
        assert_allclose(one, nearest, atol=1e-12)
    assert_array_equal(Sim3(1.0, exact.astype(np.float32), np.zeros(3)).R, exact.astype(np.float32))
    refused(
        r"Sim3: R is .*, 0\.029 off the nearest rotation, expected",
        Sim3,
        1.0,
        1.03 * exact,
        np.zeros(3),
    )


def test_records_keep_their_values_when_the_arrays_that_they_were_made_of_change():
    R = np.eye(3)
    t = np.zeros(3)
    trans = np.eye(4)
    rgb = np.zeros((2, 2, 3), np.uint8)
    depth = np.zeros((2, 2), np.float32)
    keys = torch.zeros(2, 2, 1)
    sim3 = Sim3(1.0, R, t)
    label = PoseLabel(trans, "a", "a")
    camera = Camera(R, t, np.ones(2), np.ones(2), (2, 2))
    frame = Frame(rgb, depth, depth, camera)
    features = FeatureMap(keys, keys[..., 0], keys[0, 0])
    for array in (R, t, trans, rgb, depth, keys):
        array[0] = 5
    for matrix in (sim3.matrix, label.trans, camera.matrix):
        assert_array_equal(matrix, np.eye(4))
    for zeros in (frame.rgb, frame.depth, frame.mask, features.keys):
        assert not zeros.any()


@given(seeds, scales, st.integers(4, 40))
def test_umeyama_is_the_best_rotation_by_scipy_also_for_a_mirrored_target(seed, scale, n):
    source = cloud(seed, n)
    for target in (
        similarity(seed, scale).apply(source) + 0.2 * cloud(seed + 1, n),
        source * (1, 1, -1),
    ):
        sim3 = umeyama(source, target)
        x, y = source - source.mean(axis=0), target - target.mean(axis=0)
        assert_allclose(sim3.R, Rotation.align_vectors(y, x)[0].as_matrix(), atol=1e-6)
        # the least-squares scale
        assert sim3.scale == pytest.approx((x @ sim3.R.T * y).sum() / np.square(x).sum())
        assert_allclose(sim3.apply(source.mean(axis=0)), target.mean(axis=0), atol=1e-9)


def test_without_scale_the_scale_is_one():
    source = cloud(0)
    truth = similarity(1, 1.0)
    assert_same(umeyama(torch.as_tensor(source), truth.apply(source), with_scale=False), truth)
    assert umeyama(source, 3 * source, with_scale=False).scale == 1


line = np.linspace(0, 1, 8)[:, None] * (1.0, 2.0, 3.0)
rounded = (line + (0.1, 0.7, 5.0)).astype(np.float32)  # no longer exactly a line
# A cloud with one coordinate that is not a number.
not_finite = np.where(cloud(0) == cloud(0)[3, 1], np.nan, cloud(0))
DEGENERATE = {
    "two": (cloud(0, 2), cloud(0, 2)),
    "equal": (np.ones((5, 3)), np.ones((5, 3))),
    "target line": (cloud(0, 8), line),
    "rounded line": (rounded, cloud(0, 8)),
    "nan": (not_finite, cloud(0)),
    "nan target": (cloud(0), not_finite),
    "lengths": (cloud(0, 5), cloud(0, 6)),
    "flat": (cloud(0)[:, :2], cloud(0)[:, :2]),
}


@pytest.mark.parametrize("points", DEGENERATE)
@pytest.mark.parametrize("solver", [umeyama, ransac])
def test_degenerate_or_malformed_points_are_refused_in_one_line(solver, points):
    refused("expected|collinear", solver, *DEGENERATE[points])


def contaminated(seed: int, outliers: float = 0.6):
    """Source, target, true similarity, and which points are no outliers."""
    rng = default_rng(seed)
    source = rng.normal(size=(50, 3))
    truth = similarity(seed, 1.2)
    target = truth.apply(source) + 0.01 * rng.normal(size=(50, 3))
    wrong = rng.permutation(50) < outliers * 50
    target[wrong] = truth.t + 2 * rng.normal(size=(wrong.sum(), 3))
    return source, target, truth, ~wrong


@settings(max_examples=25)
@given(seeds)
def test_ransac_recovers_the_pose_with_sixty_percent_outliers(seed):
    source, target, truth, right = contaminated(seed)
    sim3, inliers = ransac(source, target, seed=seed)
    assert inliers[right].mean() > 0.9
    assert_allclose(sim3.matrix, truth.matrix, atol=0.15)


def test_many_trials_need_little_memory_and_the_best_wins_in_blocks_too(monkeypatch):
    source, target, *_ = contaminated(3, outliers=0.8)
    tracemalloc.start()
    ransac(np.tile(source, (20, 1)), np.tile(target, (20, 1)), trials=20_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6  # all residuals at once are 160 MB, their offsets 480 MB
    whole = ransac(source, target)
    monkeypatch.setattr("zsp_lite.alignment._BLOCK", 50 * 64)  # points times trials of a block
    in_blocks = ransac(source, target, seed=default_rng(0))
    assert_same(in_blocks[0], whole[0], atol=0)
    assert_array_equal(in_blocks[1], whole[1])


def test_of_two_motions_with_as_many_inliers_the_closer_fit_wins():
    source, loose, exact = cloud(0, 40), similarity(1), similarity(2)
    target = np.concatenate([loose.apply(source[:20] + 0.02 * cloud(1)), exact.apply(source[20:])])
    assert ransac(source, target)[1].tolist() == [False] * 20 + [True] * 20


def test_the_final_fit_keeps_to_the_scale_range():
    # The inliers fit a scale below 0.2, though samples of them fit scales above.
    rng = default_rng(0)
    source = rng.normal(size=(40, 3))
    target = 0.19 * source + 0.05 * rng.normal(size=(40, 3))
    assert ransac(source, target)[0].scale < 0.2
    bounded, inliers = ransac(source, target, scale_range=(0.2, 5))
    assert bounded.scale == 0.2
    # No other translation fits the inliers better.
    moved = bounded.apply(source[inliers])
    assert_allclose(moved.mean(axis=0), target[inliers].mean(axis=0), atol=1e-12)


@pytest.mark.parametrize(
    "settings",
    [
        {"trials": 0},
        {"sample_size": 2},
        {"scale_range": (2, 3)},
        {"scale_range": (0.2, 0.5)},
        {"threshold": 0},
    ],
)
def test_settings_of_ransac_out_of_range_are_refused(settings):
    (name,) = settings
    refused(name, ransac, cloud(0), cloud(0), **settings)


def test_ransac_needs_as_many_points_as_a_sample_has():
    refused("at least 4", ransac, cloud(0, 3), cloud(0, 3))
