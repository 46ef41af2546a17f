"""Masks from depth and from a box, and flags of masks that may be wrong: on a red ball on a grey
floor, and on a photograph."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from refusals import refused
from synthetic_views import look_at

from zsp_lite import Frame, InputError
from zsp_lite.course.motorcycle import load_photograph
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.masks import mask_flags, masks_from_box, masks_from_depth, separate_colours

RADIUS = 0.3  # of the ball, metres
# Directions of cameras, from the middle of the ball.
DIRECTIONS = [(1, 0.2, 0.6), (0.4, 1, 0.5), (0.7, -0.8, 0.4), (1, 0.5, 1.5)]


def ball_on_floor(direction) -> tuple[Frame, np.ndarray]:
    """A frame of the ball on a floor before a wall, whose depth has holes, and the true mask."""
    camera = look_at(direction, 2.0)
    height, width = camera.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    # Directions of the rays in the world, with depth 1.
    rays = camera.unproject_camera(np.stack([x, y], -1), np.ones((height, width))) @ camera.R
    start = camera.centre
    along, across = rays @ start, np.square(rays).sum(axis=-1)
    root = along**2 - across * (start @ start - RADIUS**2)
    on_ball = root > 0
    ball = np.where(on_ball, (-along - np.sqrt(np.maximum(root, 0))) / across, np.inf)
    with np.errstate(divide="ignore"):
        surfaces = [(-RADIUS - start[2]) / rays[..., 2], (-1.2 - start[0]) / rays[..., 0]]
    depth = np.minimum(ball, np.min([np.where(one > 0, one, np.inf) for one in surfaces], axis=0))
    depth = np.where(np.isfinite(depth) & (depth < 8), depth, 0)
    rng = np.random.default_rng(0)
    holes = rng.uniform(size=(height // 7, width // 9)) < 0.3
    depth[
        cv2.resize(holes.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    ] = 0
    rgb = np.where(on_ball[..., None], (200, 40, 40), 90) + rng.integers(-9, 9, (height, width, 3))
    return Frame(rgb.astype(np.uint8), depth.astype(np.float32), None, camera), on_ball


def overlap(mask, truth):
    """Intersection over union of a mask and a boolean one."""
    found = mask > 0.5
    return (found & truth).sum() / (found | truth).sum()


@pytest.mark.parametrize("count, unit", [(1, 1), (4, 1), (1, 1000)])
def test_the_object_on_a_floor_is_found_without_a_box_in_any_unit_of_length(count, unit):
    scenes = [ball_on_floor(direction) for direction in DIRECTIONS[:count]]
    masked = masks_from_depth([scale_frame(frame, unit) for frame, _ in scenes])
    assert min(overlap(frame.mask, truth) for frame, (_, truth) in zip(masked, scenes)) > 0.95
    assert mask_flags(masked) == ()


def test_depth_without_an_object_is_refused_and_no_depth_gives_an_empty_mask():
    frame, truth = ball_on_floor(DIRECTIONS[0])
    blind = replace(frame, depth=np.zeros_like(frame.depth))
    refused("no depth is known", masks_from_depth, [blind])
    with pytest.raises(
        InputError, match="nothing stands out .* expected --box TOP,LEFT,HEIGHT,WIDTH"
    ):
        masks_from_depth([replace(frame, depth=np.full_like(frame.depth, 2))])
    empty, found = masks_from_depth([blind, frame])
    assert not empty.mask.any()
    assert overlap(found.mask, truth) > 0.95
    assert mask_flags([empty]) == mask_flags([empty, found]) == ()


def bounding(mask, margin):
    """The slices of the box around a mask, with a margin in pixels."""
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    return np.s_[
        rows[0] - margin : rows[-1] + 1 + margin, columns[0] - margin : columns[-1] + 1 + margin
    ]


def in_the_corner(mask):
    mask[:50, :50] = True


def in_two_parts(mask):
    box = bounding(mask, 0)
    middle = (box[0].start + box[0].stop) // 2
    mask[middle - 4 : middle + 4] = False


def around_the_object(mask):
    ball = mask.copy()
    mask[bounding(ball, 8)] = True
    mask &= ~ball


def on_the_floor_too(mask):
    box = bounding(mask, 0)
    mask[box[0].stop - 15 : box[0].stop + 25, box[1].start - 20 : box[1].stop + 20] = True


@pytest.mark.parametrize(
    "spoil, sign",
    [
        (in_the_corner, "several borders of the image are touched"),
        (in_two_parts, "several separate parts"),
        (around_the_object, "colours disagree"),
        (on_the_floor_too, "much of it lies in the plane around it"),
    ],
)
def test_masks_that_may_be_wrong_are_flagged_with_reason_and_number(spoil, sign):
    (first, truth), (second, _) = (ball_on_floor(direction) for direction in DIRECTIONS[:2])
    good = masks_from_depth([first, second])
    assert mask_flags(good) == ()
    spoilt = truth.copy()
    spoil(spoilt)
    (flag,) = mask_flags([replace(first, mask=spoilt.astype(np.float32)), good[1]])
    assert flag.startswith("the masks may be wrong: ")
    assert f"{sign} (1 of 2 frames)" in flag


def test_an_object_without_a_floor_is_found():
    frame, truth = ball_on_floor(DIRECTIONS[0])
    (found,) = masks_from_depth([replace(frame, depth=np.where(truth, frame.depth, np.float32(0)))])
    assert overlap(found.mask, truth) > 0.9
    assert mask_flags([found]) == ()


def test_a_box_finds_the_object_and_stays_empty_where_it_is_not_seen():
    (first, truth), (second, other) = (ball_on_floor(direction) for direction in DIRECTIONS[:2])
    away = ball_on_floor((-1, 0.2, 0.6))[0].camera
    rows, columns = bounding(truth, 5)
    box = tuple(
        map(int, (rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start))
    )
    away = replace(second, camera=replace(away, t=away.t - (0, 0, 9)))  # behind the camera
    black = replace(second, rgb=np.zeros_like(second.rgb))
    masked = list(masks_from_box([first, away, black, second], box))
    assert overlap(masked[0].mask, truth) > 0.9
    assert overlap(masked[3].mask, other) > 0.9
    assert not masked[1].mask.any()
    assert not masked[2].mask.any()


def test_the_photographed_motorcycle_is_found():
    photograph = load_photograph()
    (found,) = masks_from_depth([replace(photograph, mask=None)])
    assert overlap(found.mask, photograph.mask > 0.5) > 0.7


def test_separating_colours_on_a_smaller_copy_does_not_shift_the_mask():
    off = []
    # The copy has a third of the rows: try all three positions.
    for first in (300, 301, 302):
        inside = np.zeros((960, 960), bool)
        inside[first : first + 360, first : first + 360] = True
        rgb = np.where(inside[..., None], np.uint8([180, 60, 60]), np.uint8(120))
        off.append(np.argwhere(separate_colours(rgb, inside)).mean() - np.argwhere(inside).mean())
    assert np.mean(off) == pytest.approx(0, abs=0.2)
