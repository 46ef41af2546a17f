"""A reference turned in the image: `upright=False` finds the turn, and the pose is that of the image as given."""

import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, reference_and_targets, true_pose

from zsp_lite.cli import main as cli
from zsp_lite.data.frames import turn_frame
from zsp_lite.features import FeatureMap
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose


class UprightBackbone(CoordinateBackbone):
    """Coordinates of the object in upright images, noise in turned ones. The object's z is blue and points up."""

    images = 0  # that features were computed of
    seconds = 0.0  # of each image
    salient = True  # whether turned images have a foreground

    def features(self, image):
        UprightBackbone.images += 1
        time.sleep(self.seconds)
        found = super().features(image)
        rows, columns = np.nonzero(image.any(axis=-1))
        height = image[rows, columns, 2].astype(float) - image[rows, columns, 2].mean()
        down, right = (height * (rows - rows.mean())).sum(), (height * (columns - columns.mean())).sum()
        if down < 0 and -down > abs(right):
            return found
        noise = torch.from_numpy(np.random.default_rng(5).normal(size=found.keys.shape)).float()
        return FeatureMap(noise, self.salient * found.saliency, found.global_feature)


@pytest.fixture(scope="module")
def frames():
    return reference_and_targets()


@pytest.mark.parametrize("quarters", range(-1, 5))
def test_a_turned_frame_shows_every_world_point_with_the_same_colour_and_depth(frames, quarters):
    frame = frames[0]
    turned_frame = turn_frame(frame, quarters)
    row, column = np.nonzero(frame.mask > 0.5)
    points = frame.camera.unproject(np.stack([column, row], -1) + 0.5, frame.depth[row, column])
    pixels, depth = turned_frame.camera.project(points)
    there = tuple(np.floor(pixels).astype(int).T[::-1])
    np.testing.assert_allclose(pixels % 1, 0.5, atol=1e-6)
    np.testing.assert_array_equal(turned_frame.rgb[there], frame.rgb[row, column])
    np.testing.assert_array_equal(turned_frame.depth[there], frame.depth[row, column])
    np.testing.assert_allclose(depth, frame.depth[row, column], rtol=1e-6)
    assert turned_frame.camera.size == turned_frame.rgb.shape[:2]
    np.testing.assert_array_equal(turned_frame.rgb, np.rot90(frame.rgb, quarters))


@pytest.mark.parametrize(("solver", "quarters"), [("paper", 1), ("paper", 2), ("paper", 3), ("verified", 1)])
def test_the_pose_of_a_turned_reference_is_that_of_the_image_as_given(frames, solver, quarters):
    rolled = turn_frame(frames[0], quarters)
    method = ZeroShotPose(UprightBackbone(), solver=solver, upright=False)
    found = method.estimate(rolled, frames[1:])
    truth = true_pose(rolled.camera, AT_HOME, found.target_camera, ELSEWHERE)
    assert found.reference_turn == 90 * (4 - quarters)
    assert rotation_error(found.sim3.R, truth.R) < 10
    centre = rolled.camera.to_camera(np.zeros(3))
    np.testing.assert_allclose(found.sim3.apply(centre), truth.apply(centre), atol=0.2)
    # The estimate is expressed for the image as given: its crop, its patches, its points.
    crop = method.views([rolled])[0].frame
    np.testing.assert_array_equal(found.reference_view.frame.rgb, crop.rgb)
    assert found.reference_view.frame.camera.size == crop.camera.size
    np.testing.assert_array_equal(found.reference_view.frame.camera.matrix, crop.camera.matrix)
    assert np.abs(found.reference_view.soft_mask - crop.mask).mean() < 0.1
    first, second = found.points
    at_home = rolled.camera.to_world(first)
    elsewhere = ELSEWHERE.inverse().apply(found.target_camera.to_world(second))
    assert np.median(np.linalg.norm(at_home - elsewhere, axis=1)) < 0.15
    assert np.median(np.linalg.norm(found.sim3.apply(first) - second, axis=1)[found.inliers]) < 0.2
    if solver == "verified":
        assert (found.hypotheses[0].sim3.matrix == found.sim3.matrix).all()
    else:  # without the turns, the features are noise
        upright = replace(method, upright=True).estimate(rolled, frames[1:])
        assert rotation_error(upright.sim3.R, truth.R) > 20


def test_a_turn_that_gives_no_pose_is_passed_over(frames, monkeypatch):
    monkeypatch.setattr(UprightBackbone, "salient", False)
    method = ZeroShotPose(UprightBackbone(), solver="verified", upright=False)
    assert method.estimate(turn_frame(frames[0], 1), frames[1:]).reference_turn == 270


def test_an_upright_reference_gives_the_same_with_and_without_the_turns(frames, monkeypatch):
    monkeypatch.setattr(UprightBackbone, "seconds", 0.02)
    plain = ZeroShotPose(UprightBackbone()).estimate(frames[0], frames[1:])
    tried = ZeroShotPose(UprightBackbone(), upright=False).estimate(frames[0], frames[1:])
    assert (tried.sim3.matrix == plain.sim3.matrix).all()
    assert tried.reference_turn == plain.reference_turn == 0
    assert (tried.matches.reference == plain.matches.reference).all()
    assert list(tried.timings) == list(plain.timings)
    assert tried.timings["features"] >= 0.02 * (len(frames) + 3)


@pytest.mark.slow
def test_the_command_tries_the_turns_on_demand(monkeypatch, ellipsoids, tmp_path):
    monkeypatch.setattr("zsp_lite.backbones.load.load_backbone", lambda choice: UprightBackbone())
    monkeypatch.setattr("zsp_lite.own_objects.write_pair", lambda *_: [])
    words = ["estimate", *(str(ellipsoids.root / "ellipsoid" / name) for name in "ab"), "--targets", "2"]
    words += ["--solver", "paper", "--out", str(tmp_path)]
    for options, images in (([], 3), (["--not-upright"], 6)):
        UprightBackbone.images = 0
        assert cli.main([*words, *options]) == 0
        assert UprightBackbone.images == images
