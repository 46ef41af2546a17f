"""Masks from depth and from a box, and flags of masks that may be wrong: on a red object on a grey
floor, and on a photograph."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from synthetic_views import ABOVE_FLOOR, object_on_floor, overlap

from zsp_lite.course.motorcycle import load_photograph
from zsp_lite.data.frames import mask_to_bbox
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.masks import mask_flags, masks_from_box, masks_from_depth, separate_colours


@pytest.mark.parametrize("count, unit", [(1, 1), (4, 1), (1, 1000)])
def test_the_object_on_a_floor_is_found_without_a_box_in_any_unit_of_length(count, unit):
    scenes = [object_on_floor(direction) for direction in ABOVE_FLOOR[:count]]
    masked = masks_from_depth([scale_frame(frame, unit) for frame, _ in scenes])
    assert min(overlap(frame.mask, truth) for frame, (_, truth) in zip(masked, scenes)) > 0.95
    assert mask_flags(masked) == ()


def test_depth_without_an_object_is_refused_and_no_depth_gives_an_empty_mask():
    frame, truth = object_on_floor(ABOVE_FLOOR[0])
    blind = replace(frame, depth=np.zeros_like(frame.depth))
    refused("no depth is known", masks_from_depth, [blind])
    flat = replace(frame, depth=np.full_like(frame.depth, 2))
    message = "nothing stands out .* expected --box TOP,LEFT,HEIGHT,WIDTH"
    refused(message, masks_from_depth, [flat])
    empty, found = masks_from_depth([blind, frame])
    assert not empty.mask.any()
    assert overlap(found.mask, truth) > 0.95
    assert mask_flags([empty]) == mask_flags([empty, found]) == ()


# The next four spoil a mask in place, given the bounding box of its object.
def in_the_corner(mask, *box):
    """Add a corner of the image."""
    mask[:50, :50] = 1


def in_two_parts(mask, top, left, height, width):
    """Remove eight rows in the middle of the object."""
    middle = top + height // 2
    mask[middle : middle + 8] = 0


def around_the_object(mask, top, left, height, width):
    """Take the surroundings in place of the object."""
    on_object = mask > 0
    mask[top - 8 : top + height + 8, left - 8 : left + width + 8] = 1
    mask[on_object] = 0


def on_the_floor_too(mask, top, left, height, width):
    """Add the floor around the lower end of the object."""
    mask[top + height - 15 : top + height + 25, left - 20 : left + width + 20] = 1


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
    (first, truth), (second, _) = (object_on_floor(direction) for direction in ABOVE_FLOOR[:2])
    good = masks_from_depth([first, second])
    assert mask_flags(good) == ()
    spoilt = truth.astype(np.float32)
    spoil(spoilt, *mask_to_bbox(spoilt, padding=0))
    (flag,) = mask_flags([replace(first, mask=spoilt), good[1]])
    assert flag.startswith("the masks may be wrong: ")
    assert f"{sign} (1 of 2 frames)" in flag


def test_an_object_without_a_floor_is_found():
    frame, truth = object_on_floor(ABOVE_FLOOR[0])
    (found,) = masks_from_depth([replace(frame, depth=np.where(truth, frame.depth, np.float32(0)))])
    assert overlap(found.mask, truth) > 0.9
    assert mask_flags([found]) == ()


def test_a_box_finds_the_object_and_stays_empty_where_it_is_not_seen():
    (first, truth), (second, other) = (object_on_floor(direction) for direction in ABOVE_FLOOR[:2])
    box = mask_to_bbox(truth.astype(np.float32), padding=0.2)
    # The object is behind the camera.
    away = replace(second, camera=replace(second.camera, t=-second.camera.t))
    black = replace(second, rgb=np.zeros_like(second.rgb))
    masked = list(masks_from_box([first, away, black, second], box))
    assert overlap(masked[0].mask, truth) > 0.9
    assert overlap(masked[3].mask, other) > 0.85
    assert not masked[1].mask.any()
    assert not masked[2].mask.any()


def test_the_photographed_motorcycle_is_found():
    photograph = load_photograph()
    (found,) = masks_from_depth([replace(photograph, mask=None)])
    assert overlap(found.mask, photograph.mask > 0.5) > 0.7


def test_separating_colours_on_a_smaller_copy_does_not_shift_the_mask():
    off = []
    # The copy has a third of the rows, 320: try all three positions.
    for first in (300, 301, 302):
        inside = np.zeros((960, 960), bool)
        inside[first : first + 360, first : first + 360] = True
        rgb = np.where(inside[..., None], np.uint8([180, 60, 60]), np.uint8(120))
        off.append(np.argwhere(separate_colours(rgb, inside)).mean() - np.argwhere(inside).mean())
    assert np.mean(off) == pytest.approx(0, abs=0.2)
