"""Masks from depth and from a box, and flags of masks that may be wrong: on a red object on a grey
floor, and on a photograph."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from synthetic_views import AT_HOME, look_at, render

from zsp_lite import Frame
from zsp_lite.course.motorcycle import load_photograph
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import mask_to_bbox
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.masks import mask_flags, masks_from_box, masks_from_depth, separate_colours

WALL, FLOOR = -3.0, -0.8  # along x, and below the object
# Directions of cameras, from the middle of the object.
DIRECTIONS = [(1, 0.2, 0.6), (0.4, 1, 0.5), (0.7, -0.8, 0.4), (1, 0.5, 1.5)]


def object_on_floor(direction) -> tuple[Frame, np.ndarray]:
    """A frame of the object of `synthetic_views`, in red on a grey floor before a wall, whose depth
    has holes, and the true mask."""
    camera = look_at(direction, 5.0)
    seen = render(camera, AT_HOME)
    truth = seen.mask > 0
    # Directions of the rays in the world, with depth 1.
    rays = unproject_depth(np.ones(camera.size), camera) @ camera.R
    # The depth of the wall and of the floor.
    depths = (np.array([WALL, FLOOR]) - camera.centre[[0, 2]]) / rays[..., [0, 2]]
    depth = np.where(truth, seen.depth, np.where(depths > 0, depths, np.inf).min(axis=-1))
    rng = np.random.default_rng(0)
    holes = np.kron(rng.random((20, 20)) < 0.3, np.ones((7, 9)))  # of 7 x 9 pixels
    depth = np.where((holes > 0) | (depth > 20), 0, depth)
    rgb = np.where(truth[..., None], (200, 40, 40), 90) + rng.integers(-9, 9, (*camera.size, 3))
    return Frame(rgb.astype(np.uint8), depth.astype(np.float32), None, camera), truth


def overlap(mask, truth):
    """Intersection over union of a mask and a boolean one."""
    found = mask > 0.5
    return (found & truth).sum() / (found | truth).sum()


@pytest.mark.parametrize("count, unit", [(1, 1), (4, 1), (1, 1000)])
def test_the_object_on_a_floor_is_found_without_a_box_in_any_unit_of_length(count, unit):
    scenes = [object_on_floor(direction) for direction in DIRECTIONS[:count]]
    masked = masks_from_depth([scale_frame(frame, unit) for frame, _ in scenes])
    assert min(overlap(frame.mask, truth) for frame, (_, truth) in zip(masked, scenes)) > 0.95
    assert mask_flags(masked) == ()


def test_depth_without_an_object_is_refused_and_no_depth_gives_an_empty_mask():
    frame, truth = object_on_floor(DIRECTIONS[0])
    blind = replace(frame, depth=np.zeros_like(frame.depth))
    refused("no depth is known", masks_from_depth, [blind])
    flat = replace(frame, depth=np.full_like(frame.depth, 2))
    message = "nothing stands out .* expected --box TOP,LEFT,HEIGHT,WIDTH"
    refused(message, masks_from_depth, [flat])
    empty, found = masks_from_depth([blind, frame])
    assert not empty.mask.any()
    assert overlap(found.mask, truth) > 0.95
    assert mask_flags([empty]) == mask_flags([empty, found]) == ()


# Each spoils a mask whose object has a bounding box.
def in_the_corner(mask, *box):
    mask[:50, :50] = 1


def in_two_parts(mask, top, left, height, width):
    mask[top + height // 2 :][:8] = 0


def around_the_object(mask, top, left, height, width):
    on_object = mask > 0
    mask[top - 8 : top + height + 8, left - 8 : left + width + 8] = 1
    mask[on_object] = 0


def on_the_floor_too(mask, top, left, height, width):
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
    (first, truth), (second, _) = (object_on_floor(direction) for direction in DIRECTIONS[:2])
    good = masks_from_depth([first, second])
    assert mask_flags(good) == ()
    spoilt = truth.astype(np.float32)
    spoil(spoilt, *mask_to_bbox(spoilt, padding=0))
    (flag,) = mask_flags([replace(first, mask=spoilt), good[1]])
    assert flag.startswith("the masks may be wrong: ")
    assert f"{sign} (1 of 2 frames)" in flag


def test_an_object_without_a_floor_is_found():
    frame, truth = object_on_floor(DIRECTIONS[0])
    (found,) = masks_from_depth([replace(frame, depth=np.where(truth, frame.depth, np.float32(0)))])
    assert overlap(found.mask, truth) > 0.9
    assert mask_flags([found]) == ()


def test_a_box_finds_the_object_and_stays_empty_where_it_is_not_seen():
    (first, truth), (second, other) = (object_on_floor(direction) for direction in DIRECTIONS[:2])
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
    # The copy has a third of the rows: try all three positions.
    for first in (300, 301, 302):
        inside = np.zeros((960, 960), bool)
        inside[first : first + 360, first : first + 360] = True
        rgb = np.where(inside[..., None], np.uint8([180, 60, 60]), np.uint8(120))
        off.append(np.argwhere(separate_colours(rgb, inside)).mean() - np.argwhere(inside).mean())
    assert np.mean(off) == pytest.approx(0, abs=0.2)
