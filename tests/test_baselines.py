"""Baselines: geometry is exact for exact input, RootSIFT is OpenCV's."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.random import default_rng
from refusals import refused
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from synthetic_views import look_at, render, true_pose

from zsp_lite.alignment import Sim3
from zsp_lite.baselines import geometry
from zsp_lite.baselines.geometry import align, essential_rotation, icp
from zsp_lite.baselines.sift import Sift, dense_sift, mutual_matches
from zsp_lite.data.frames import Frame
from zsp_lite.matching import Matches
from zsp_lite.metrics import rotation_error


def test_icp_finds_a_small_motion_of_a_cloud_and_its_scale():
    rng = default_rng(0)
    source = rng.normal(size=(400, 3)) * (1.5, 1.0, 0.6)
    truth = Sim3(
        1.1, Rotation.from_rotvec([0.05, -0.08, 0.06]).as_matrix(), np.array([0.05, 0.02, -0.04])
    )
    found = icp(source, truth.apply(source))
    assert rotation_error(found.R, truth.R) < 0.1 and found.scale == pytest.approx(1.1, rel=1e-3)
    refused(".", icp, source, np.zeros((20, 3)))


def test_icp_is_initialised_by_the_first_cameras(monkeypatch):
    """Two sequences of the same object, whose first cameras differ by a few degrees."""
    clouds = []
    monkeypatch.setattr(
        geometry, "icp", lambda *points: (clouds.extend(points), Sim3.identity())[1]
    )
    cameras = [look_at(side) for side in [(1.0, 0.1, 0.3), (0.95, 0.2, 0.35), (-0.2, 1.0, 0.3)]]
    # As in CO3D, the first camera has the same rotation in the world of every sequence.
    turn = cameras[0].R.T @ cameras[1].R
    placements = Sim3.identity(), Sim3(1.0, turn, np.zeros(3))
    first = render(cameras.pop(0), placements[0])
    cameras = [replace(camera, R=camera.R @ turn.T) for camera in cameras]
    targets = [render(camera, placements[1]) for camera in cameras]
    firsts = first.camera, targets[0].camera
    found = align(first, targets, 0, firsts, seed=0)
    assert rotation_error(found.R, np.eye(3)) < 1e-6
    source, target = clouds
    assert len(source) <= geometry.POINTS and len(target) == geometry.POINTS
    distance, _ = cKDTree(target).query(source)
    truth = true_pose(first.camera, placements[0], cameras[0], placements[1])
    assert np.median(distance) < 0.15
    # The first cameras differ by a few degrees, which only ICP could mend.
    assert 2 < rotation_error(found.R, truth.R) < 10
    # With the true pose, both clouds coincide.
    placed = firsts[1].to_world(truth.apply(firsts[0].to_camera(source)))
    assert np.median(cKDTree(target).query(placed)[0]) < 0.05


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    noise = default_rng(0).integers(0, 256, (28, 28, 3), dtype=np.uint8)
    return cv2.resize(noise, (224, 224), interpolation=cv2.INTER_CUBIC)


def test_sift_matches_an_image_with_its_rotated_copy(picture):
    camera = look_at((1, 0, 0), size=(224, 224))
    mask = np.zeros((224, 224), np.float32)
    mask[40:200, 30:190] = 1
    turned = Frame(np.ascontiguousarray(np.rot90(picture)), None, np.rot90(mask), camera)
    one, two = Sift().describe([Frame(picture, None, mask, camera), turned])
    a, b, similarity = mutual_matches(one, two)
    assert len(a) == 50  # as many as `mutual_matches` keeps
    assert (np.diff(similarity) <= 0).all()
    x, y = one.pixels[a].T
    turned = np.stack([y, 224 - x], axis=1)
    assert np.median(np.linalg.norm(turned - two.pixels[b], axis=1)) < 0.1
    # Keypoints lie on the mask, or at most a pixel beside it.
    assert (one.pixels > (29, 39)).all() and (one.pixels < (191, 201)).all()


def test_an_image_without_keypoints_has_no_matches(picture):
    camera = look_at((1, 0, 0), size=(224, 224))
    one, blank = Sift().describe(
        [Frame(image, None, None, camera) for image in (picture, np.zeros_like(picture))]
    )
    assert len(one.pixels) > 0 == len(blank.pixels)
    assert len(mutual_matches(one, blank)[0]) == 0


def test_the_essential_matrix_gives_the_rotation_between_cameras_with_other_intrinsics():
    rng = default_rng(0)
    grid = (224, 224)  # one patch per pixel, for nearly exact matches
    first = replace(look_at((1, 0, 0.3), size=(224, 224)), focal_length=np.array([300.0, 260.0]))
    second = replace(
        look_at((0.9, 0.45, 0.3), size=(224, 224)), focal_length=np.array([350.0, 330.0])
    )
    points = rng.normal(size=(60, 3)) * 0.5
    pixels = [
        np.floor(camera.project(points)[0]).astype(int)[:, ::-1] for camera in (first, second)
    ]
    pixels[1][:15] = rng.integers(40, 180, (15, 2))  # a quarter of the matches are wrong
    image = np.zeros((224, 224, 3), np.uint8)
    frames = [Frame(image, None, None, camera) for camera in (first, second)]
    matches = Matches(pixels[0], pixels[1], np.ones(60), np.zeros(60))
    rotation, inliers, note = essential_rotation(*frames, matches, grid)
    assert rotation_error(rotation, second.R @ first.R.T) < 5
    # 45 of the 60 matches are right; rounding to pixels loses some, chance adds some.
    assert 30 <= inliers <= 50 and note == ""
    few = Matches(pixels[0][:4], pixels[1][:4], np.ones(4), np.zeros(4))
    rotation, inliers, note = essential_rotation(*frames, few, grid)
    assert (rotation == np.eye(3)).all() and inliers == 0 and "4 matches" in note


def test_the_descriptors_are_those_of_opencv(picture):
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    for size, centres in ((24.0, np.arange(3.5, 224, 32)), (7.0, np.array([0.5, 100.3, 223.0]))):
        keypoints = [cv2.KeyPoint(float(x), float(y), size, 0.0) for y in centres for x in centres]
        _, expected = cv2.SIFT_create().compute(grey, keypoints)
        found = dense_sift(grey, centres, size).reshape(expected.shape)
        assert np.abs(found - expected).max() <= 1 and (found != expected).mean() < 1e-3
