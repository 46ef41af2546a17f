"""A reference whose image lies on its side: `upright=False` finds the turn that sets it up, and
the pose is that of the turned image."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, true_pose

from zsp_lite import FeatureMap, estimate_pose
from zsp_lite.metrics import rotation_error
from zsp_lite.objects.scan import turn_frame


class UprightBackbone(CoordinateBackbone):
    """Coordinates of the object in upright images, noise in turned ones.

    The object's z is blue and points up.
    """

    images = 0  # number of images that features were computed of
    salient = True  # whether turned images have a foreground

    def features(self, image):
        UprightBackbone.images += 1
        found = super().features(image)
        rows, columns = np.nonzero(image.any(axis=-1))
        # Covariances of the object's height with rows and columns.
        _, down, right = np.cov([image[rows, columns, 2], rows, columns])[0]
        if -down > abs(right):
            return found
        noise = torch.from_numpy(np.random.default_rng(5).normal(size=found.keys.shape)).float()
        return FeatureMap(noise, self.salient * found.saliency, found.global_feature)


@pytest.mark.parametrize("quarters", range(-1, 5))
def test_a_turned_frame_shows_every_world_point_with_the_same_colour_and_depth(frames, quarters):
    frame = frames[0]
    turned_frame = turn_frame(frame, quarters)
    row, column = np.nonzero(frame.mask > 0.5)
    points = frame.camera.unproject(np.stack([column, row], -1) + 0.5, frame.depth[row, column])
    pixels, depth = turned_frame.camera.project(points)
    there = tuple(np.floor(pixels).astype(int).T[::-1])
    assert_allclose(pixels % 1, 0.5, atol=1e-6)
    assert_array_equal(turned_frame.rgb[there], frame.rgb[row, column])
    assert_array_equal(turned_frame.depth[there], frame.depth[row, column])
    assert_allclose(depth, frame.depth[row, column], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("solver, quarters", [("paper", 1), ("paper", 2), ("verified", 3)])
def test_a_turned_reference_stands_up_and_the_pose_is_that_of_the_turned_image(
    frames, solver, quarters
):
    rolled, backbone = turn_frame(frames[0], quarters), UprightBackbone()
    found = estimate_pose(
        rolled, frames[1:4], solver, backbone=backbone, upright=False, references=1
    )
    one = found.estimate
    truth = true_pose(frames[0].camera, AT_HOME, one.target_camera, ELSEWHERE)
    flag = (
        f"the reference is turned by {360 - 90 * quarters}° counterclockwise: the pose is that of "
        "the turned image"
    )
    assert rotation_error(one.sim3.R, truth.R) < 10
    assert flag in one.flags
    assert_array_equal(found.reference.rgb, frames[0].rgb)
    assert_allclose(found.reference.camera.matrix, frames[0].camera.matrix, atol=1e-9)
    lying = estimate_pose(rolled, frames[1:4], solver, backbone=backbone, references=1)
    # The features are noise, and all that the paper's solver has; the other one has shapes, too.
    assert solver == "verified" or rotation_error(lying.estimate.sim3.R, truth.R) > 20


@pytest.mark.slow
def test_a_turn_that_gives_no_pose_is_passed_over(frames, monkeypatch):
    monkeypatch.setattr(UprightBackbone, "salient", False)
    found = estimate_pose(
        turn_frame(frames[0], 1), frames[1:4], backbone=UprightBackbone(), upright=False
    )
    assert any("turned by 270°" in flag for flag in found.estimate.flags)


@pytest.mark.slow
def test_the_command_tries_the_turns_on_demand(monkeypatch, ellipsoids, tmp_path, run):
    monkeypatch.setattr("zsp_lite.backbones.named.load_backbone", lambda choice: UprightBackbone())
    monkeypatch.setattr("zsp_lite.objects.estimate.write_pair", lambda *_: [])
    folder = ellipsoids.root / "ellipsoid"
    line = f"estimate {folder}/a {folder}/b --targets 2 --solver paper --out {tmp_path}"
    # The reference and two target views; then the reference in four turns, and in the best one.
    for option, images in (("", 3), ("--not-upright", 8)):
        UprightBackbone.images = 0
        run(f"{line} {option}")
        assert UprightBackbone.images == images
