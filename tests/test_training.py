"""Training: renders of objects, batches of crops with their geometry, and the three losses.

Notebook 09 checks the losses of self-distillation by hand, and its runs.
"""

from unittest.mock import patch

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from zsp_lite.course.synthetic.assembly import make_shape
from zsp_lite.course.training import renders as rendering
from zsp_lite.course.training.batches import crop_grids, sample_batch
from zsp_lite.course.training.objectives import attention_loss, correspondence_loss, losses
from zsp_lite.course.training.renders import GRID, SIZE, VIEWS, render_set
from zsp_lite.course.training.trainee import Trainee, initial_backbone

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def renders():
    """The renders of three training objects, in two rooms in place of many: a room takes five times
    as long as a view."""
    with patch.object(rendering, "ROOMS", 2):
        return render_set(range(3))


def test_surface_points_of_renders_are_coordinates_of_the_object(renders):
    inside = ~np.isnan(renders.surface[..., 0])
    assert renders.rgb.shape == (3, VIEWS, SIZE, SIZE, 3)
    assert inside.shape == (3, VIEWS, GRID, GRID)
    assert 0.05 < inside.mean() < 0.9
    for number, points in enumerate(renders.surface):
        shape = make_shape(rendering.build_random_object, [number, 1]).vertices
        seen = points[inside[number]]
        assert (seen > shape.min(0) - 0.01).all()
        assert (seen < shape.max(0) + 0.01).all()


def test_renders_hold_unit_normals_and_centred_depth_on_the_object(renders):
    inside = ~np.isnan(renders.surface[..., 0])
    normals = np.linalg.norm(renders.geometry[..., :3].astype(np.float64), axis=-1)
    assert_allclose(normals[inside], 1, atol=5e-3)
    assert_array_equal(renders.geometry[~inside], 0)
    # Visible surfaces face the camera, which looks along +z, up to the slant of the rays.
    assert np.mean(renders.geometry[..., 2][inside] < 0.2) > 0.99
    depth = np.where(inside, renders.geometry[..., 3].astype(np.float64), np.nan)
    assert_allclose(np.nanmean(depth, axis=(2, 3)), 0, atol=0.01)
    assert_allclose(np.nanstd(depth, axis=(2, 3)), 1, atol=0.01)


def test_a_batch_carries_surface_points_and_normals_through_crops_and_flips(renders):
    """A patch's surface point is one that the uncropped view shows, and its normal is turned with
    the crop."""
    crops = 3 * VIEWS
    # By the same random numbers as the batch: crops of 96 pixels, at least 0.4 of the image wide.
    grid, turn = crop_grids(default_rng(3), crops, VIEWS, 96, (0.4, 1.0))
    batch = sample_batch(renders, default_rng(3), 3, 96, (0.4, 1.0), members=np.arange(3))
    assert batch.images.shape == (crops, 3, 96, 96)
    assert set(torch.linalg.det(turn).round().tolist()) == {-1.0, 1.0}
    surface = torch.from_numpy(renders.surface).float().view(crops, -1, 3)
    geometry = torch.from_numpy(renders.geometry).float().view(crops, -1, 4)
    for crop in range(crops):
        # The axes of the crop in the uncropped view: from one pixel to the next ones.
        right = grid[crop, 4, 5] - grid[crop, 4, 4]
        down = grid[crop, 5, 4] - grid[crop, 4, 4]
        axes = torch.stack([right / right.norm(), down / down.norm()])
        # A crop that is not square is stretched, so that its axes lean a little.
        torch.testing.assert_close(turn[crop], axes, atol=0.15, rtol=0)
        on_object = ~batch.surface[crop, :, 0].isnan()
        apart, pixel = torch.cdist(
            batch.surface[crop, on_object], surface[crop].nan_to_num(nan=99.0)
        ).min(dim=1)
        assert apart.max() < 1e-3
        normal = batch.geometry[crop, on_object, :3].clone()
        normal[:, :2] = normal[:, :2] @ turn[crop]
        torch.testing.assert_close(normal, geometry[crop, pixel, :3], atol=1e-3, rtol=0)
    covered = batch.coverage > 0.99
    # The coverage is measured at four points around the centre; a narrow gap can lie between them.
    assert batch.surface[..., 0].isnan()[covered].float().mean() < 0.005


def test_the_correspondence_loss_of_right_and_of_wrong_keys_is_that_of_its_formula():
    """Two views of the same 24 places, in pairs one radius apart, with 2.5 between pairs; each has
    its own key."""
    line = 0.15 * (3.5 * torch.arange(12)[:, None] + torch.tensor([0, 1])).flatten()
    places, keys = F.pad(line[:, None], (0, 2)).repeat(2, 1, 1), torch.eye(24).repeat(2, 1, 1)

    def loss(descriptors):
        # One object, a radius of 0.15, a temperature of 0.1, and all 48 patches as queries.
        return correspondence_loss(
            descriptors, places, 1, 0.15, 0.1, 48, torch.Generator().manual_seed(0)
        )

    # The target weighs the place itself and its neighbour, one radius away.
    target = np.array([1, np.exp(-0.5)]) / (1 + np.exp(-0.5))
    # Logits: the similarity 1 of the own key divided by 0.1, and zeros for the 23 others.
    constant = (target * np.log(target)).sum() + np.log(np.exp(10) + 23)
    right, accuracy = loss(keys)
    assert (float(right), accuracy) == (pytest.approx(constant - 10 * target[0], abs=1e-4), 1)
    keys[1] = keys[1].roll(2, 0)
    wrong, accuracy = loss(keys)
    assert (float(wrong), accuracy) == (pytest.approx(constant, abs=1e-4), 0)


def test_losses_of_crops_without_an_object_are_zero_not_nan():
    keys, nowhere = torch.randn(8, 9, 4, requires_grad=True), torch.full((8, 9, 3), torch.nan)
    found = [
        correspondence_loss(keys, nowhere, 1, 0.15, 0.1, 9, torch.Generator().manual_seed(0)),
        attention_loss(keys[:, None, :, 0], torch.zeros(8, 8)),
    ]
    for loss, share in found:
        assert loss == 0
        assert share == 0
        loss.backward()
    assert keys.grad.isfinite().all()


def test_attention_on_the_mask_is_worth_more_than_attention_off_it():
    coverage = torch.zeros(1, 16)
    coverage[:, 4:9] = 1
    logits = torch.full((1, 3, 17), -12.0)
    logits[:, :, 5:10] = 0.0  # column 0 is the CLS token itself
    on, iou = attention_loss(logits, coverage)
    off, missed = attention_loss(-logits, coverage)
    assert iou == 1
    assert missed == 0
    assert on < 0.6
    assert off > 5


def test_the_helping_losses_count_by_their_weight(renders):
    torch.manual_seed(0)
    # Of 24 dimensions, two blocks and two heads; the keys of the last block are trained.
    model = Trainee(initial_backbone(renders, 24, 2, 2), 1)
    batch = sample_batch(renders, default_rng(5), 2, 48, (0.8, 1.0))
    total, figures = losses(model, batch, torch.Generator().manual_seed(0), helpers=0.5)
    expected = figures["match"] + 0.5 * (figures["geometry"] + figures["attention"])
    assert_allclose(total.item(), expected, rtol=1e-5)
