"""Baselines: geometry is exact for exact input, RootSIFT is OpenCV's."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from synthetic_views import AT_HOME, look_at, render, true_pose, turned

from zsp_lite import Camera, Frame, Matches, Sim3
from zsp_lite.baselines import geometry
from zsp_lite.baselines.geometry import align, essential_rotation, icp
from zsp_lite.baselines.sift import Sift, dense_sift, mutual_matches
from zsp_lite.metrics import rotation_error


def test_icp_finds_a_small_motion_of_a_cloud_and_its_scale():
    source = default_rng(0).normal(size=(400, 3)) * (1.5, 1.0, 0.6)
    turn = Rotation.from_rotvec([0.05, -0.08, 0.06]).as_matrix()
    truth = Sim3(1.1, turn, np.array([0.05, 0.02, -0.04]))
    found = icp(source, truth.apply(source))
    assert rotation_error(found.R, truth.R) < 0.1
    assert_allclose(found.scale, 1.1, rtol=1e-3)


def test_icp_refuses_a_cloud_without_extent():
    points = default_rng(0).normal(size=(20, 3))
    refused("the scale converged to 0", icp, points, np.zeros((20, 3)))


def test_icp_gets_the_clouds_of_both_objects_where_the_first_cameras_agree(monkeypatch):
    clouds = []

    def find_nothing(source, target):
        clouds.extend((source, target))
        return Sim3.identity()

    monkeypatch.setattr(geometry, "icp", find_nothing)
    camera, *cameras = map(look_at, [(1.0, 0.1, 0.3), (0.95, 0.2, 0.35), (-0.2, 1.0, 0.3)])
    # As in CO3D, the first camera has the same rotation in the world of every sequence.
    turn = camera.R.T @ cameras[0].R
    elsewhere = Sim3(1.0, turn, np.zeros(3))
    targets = [render(turned(one, turn), elsewhere) for one in cameras]
    first = targets[0].camera
    start = align(render(camera, AT_HOME), targets, 0, (camera, first), seed=0)
    truth = true_pose(camera, AT_HOME, first, elsewhere)
    # ICP found nothing, so the answer is that both first cameras see the same.
    assert rotation_error(start.R, np.eye(3)) < 1e-6
    source, target = clouds
    # The two target views together have more points than are taken.
    assert len(source) <= geometry.POINTS == len(target)
    placed = first.to_world(truth.apply(camera.to_camera(source)))
    assert np.median(cKDTree(target).query(placed)[0]) < 0.05


SIZE = (224, 224)
# Smooth noise, which has keypoints everywhere, and a camera.
NOISE = default_rng(0).integers(0, 256, (28, 28, 3), dtype=np.uint8)
PICTURE = cv2.resize(NOISE, SIZE, interpolation=cv2.INTER_CUBIC)
CAMERA = look_at((1, 0, 0), size=SIZE)


def test_sift_matches_an_image_with_its_rotated_copy():
    mask = np.zeros(SIZE, np.float32)
    mask[40:200, 30:190] = 1
    turned = Frame(np.ascontiguousarray(np.rot90(PICTURE)), None, np.rot90(mask), CAMERA)
    one, two = Sift().describe([Frame(PICTURE, None, mask, CAMERA), turned])
    a, b, similarity = mutual_matches(one, two)
    assert len(a) == 50  # as many as `mutual_matches` keeps
    assert (np.diff(similarity) <= 0).all()
    x, y = one.pixels[a].T
    expected = np.stack([y, 224 - x], axis=1)
    assert np.median(np.linalg.norm(expected - two.pixels[b], axis=1)) < 0.1
    # Keypoints lie on the mask, or at most a pixel beside it.
    assert (one.pixels > (29, 39)).all()
    assert (one.pixels < (191, 201)).all()


def test_an_image_without_keypoints_has_no_matches():
    images = PICTURE, np.zeros_like(PICTURE)
    one, blank = Sift().describe([Frame(image, None, None, CAMERA) for image in images])
    assert len(one.pixels) > 0
    assert len(blank.pixels) == 0
    assert len(mutual_matches(one, blank)[0]) == 0


POINTS = 60  # matches
WRONG = 15  # of the matches: a quarter


def essential(first: Camera, second: Camera, matches: int) -> tuple[np.ndarray, int, str]:
    """The rotation by the first `matches` of points that both cameras see, and its inliers."""
    rng = default_rng(0)
    points = rng.normal(size=(POINTS, 3)) * 0.5
    pixels = [np.floor(one.project(points)[0]).astype(int)[:, ::-1] for one in (first, second)]
    pixels[1][:WRONG] = rng.integers(40, 180, (WRONG, 2))
    image = np.zeros((*SIZE, 3), np.uint8)
    frames = [Frame(image, None, None, one) for one in (first, second)]
    ends = [one[:matches] for one in pixels]
    chosen = Matches(*ends, np.ones(matches), np.zeros(matches))
    return essential_rotation(*frames, chosen, SIZE)  # one patch per pixel


# Two cameras with different intrinsics.
CAMERAS = (
    replace(look_at((1, 0, 0.3), size=SIZE), focal_length=np.array([300.0, 260.0])),
    replace(look_at((0.9, 0.45, 0.3), size=SIZE), focal_length=np.array([350.0, 330.0])),
)


def test_the_essential_matrix_gives_the_rotation_between_cameras_of_any_intrinsics():
    first, second = CAMERAS
    rotation, inliers, note = essential(first, second, POINTS)
    assert rotation_error(rotation, second.R @ first.R.T) < 5
    # Rounding to pixels loses some of the right matches, chance adds a few of the wrong ones.
    assert POINTS / 2 <= inliers <= POINTS - WRONG + 5
    assert note == ""


def test_four_matches_determine_no_essential_matrix():
    rotation, inliers, note = essential(*CAMERAS, 4)
    assert_array_equal(rotation, np.eye(3))
    assert inliers == 0
    assert "4 matches" in note


@pytest.mark.parametrize(
    "size, centres", [(24.0, np.arange(3.5, 224, 32)), (7.0, np.array([0.5, 100.3, 223.0]))]
)
def test_the_descriptors_are_those_of_opencv(size, centres):
    grey = cv2.cvtColor(PICTURE, cv2.COLOR_RGB2GRAY)
    keypoints = [cv2.KeyPoint(float(x), float(y), size, 0.0) for y in centres for x in centres]
    _, expected = cv2.SIFT_create().compute(grey, keypoints)
    found = dense_sift(grey, centres, size).reshape(expected.shape)
    # Descriptors are bytes: few may be rounded the other way.
    assert np.abs(found - expected).max() <= 1
    assert (found != expected).mean() < 1e-3
