"""Frames and their depth: crops, sizes, files, depth maps and their points."""

import os
from dataclasses import replace

import cv2
import numpy as np
import pytest
from captures import HALF_PIXEL, straight_places
from co3d_folders import random_camera, seeds, sequence_data
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

from zsp_lite import Camera, Frame
from zsp_lite.data.depth import decode_depth, inpaint_depth, patch_points, unproject_depth
from zsp_lite.data.frames import (
    crop_to_object,
    mask_to_bbox,
    read_image,
    read_mask,
    resize_frame,
)
from zsp_lite.data.writing import encode_depth, write_mask
from zsp_lite.io.files import write_atomic
from zsp_lite.points import (
    object_pixels,
    object_points,
    standard_deviation,
)

SIZE = (24, 32)


@pytest.mark.parametrize(
    "parts, padding, box",
    [
        # Padding adds a tenth of each side, half of it at each end.
        ([(20, 40, 40, 60, 1.0)], 0.1, (18, 37, 44, 66)),
        # The box stays in the image.
        ([(0, 180, 40, 20, 1.0)], 0.1, (0, 179, 42, 21)),
        # Pixels below the threshold do not count.
        ([(20, 40, 40, 60, 1.0), (0, 0, 5, 5, 0.4)], 0, (20, 40, 40, 60)),
        # Where no pixel is above the threshold, it is lowered.
        ([(20, 40, 40, 60, 0.1), (30, 50, 10, 10, 0.3)], 0, (30, 50, 10, 10)),
    ],
)
def test_the_box_bounds_the_pixels_above_the_threshold(parts, padding, box):
    mask = np.zeros((100, 200), np.float32)
    for top, left, height, width, value in parts:
        mask[top : top + height, left : left + width] = value
    assert mask_to_bbox(mask, padding=padding) == box
    refused("is empty", mask_to_bbox, 0 * mask)


def test_cropping_keeps_every_pixels_world_point():
    whole = sequence_data("one").frames[0]
    cropped = crop_to_object(whole)
    top, left, height, width = mask_to_bbox(whole.mask)
    assert (
        cropped.camera.size
        == cropped.rgb.shape[:2]
        == cropped.depth.shape
        == cropped.mask.shape
        == (height, width)
    )
    assert_array_equal(cropped.rgb, whole.rgb[top : top + height, left : left + width])
    pixel = np.array([3.5, 2.5])
    assert_allclose(
        cropped.camera.unproject(pixel, 2.0),
        whole.camera.unproject(pixel + (left, top), 2.0),
        atol=1e-12,
    )


@given(seeds, st.integers(1, 60), st.integers(1, 60))
def test_resized_depth_is_the_depth_under_the_new_pixels_centre(seed, height, width):
    whole = sequence_data("one", frames=1, seed=seed).frames[0]
    small = resize_frame(whole, (height, width))
    scale = np.diag([width / SIZE[1], height / SIZE[0], 1])
    assert_allclose(small.camera.K, scale @ whole.camera.K)
    rows = np.floor((np.arange(height) + 0.5) * SIZE[0] / height).astype(int)
    cols = np.floor((np.arange(width) + 0.5) * SIZE[1] / width).astype(int)
    assert_array_equal(small.depth, whole.depth[rows][:, cols])
    assert small.camera.size == small.rgb.shape[:2] == small.mask.shape == (height, width)


@pytest.mark.parametrize("size", [(4, 48), (48, 4)])
def test_colours_are_averaged_along_a_side_that_shrinks_while_the_other_grows(size):
    stripes = np.zeros((24, 24, 3), np.uint8)
    stripes[::3] = 240  # every third row: a row of the result covers two periods, with mean 80
    stripes = stripes if size[0] < 24 else stripes.swapaxes(0, 1)
    resized = resize_frame(Frame(stripes, None, None, random_camera(0, (24, 24))), size)
    assert_array_equal(resized.rgb, 80)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"rgb": np.zeros((5, 5, 3), np.uint8)}, r"rgb is uint8 \(5, 5, 3\)"),
        ({"depth": np.full(SIZE, np.nan, np.float32)}, "depth has nan"),
        ({"mask": np.full(SIZE, 1.5, np.float32)}, "mask has 1.5 to 1.5"),
    ],
)
def test_inconsistent_parts_are_refused_by_name(changes, message):
    values = {"rgb": np.zeros((*SIZE, 3), np.uint8), "depth": None, "mask": None} | changes
    refused(message, lambda: Frame(**values, camera=random_camera(0, SIZE)))


def arrays(**changes):
    """Arguments of `Frame.from_arrays`: an image of 24 x 32 pixels, with depth of half its size."""
    depth = np.full((12, 16), 2000.0)
    depth[0, :4] = np.nan, np.inf, 0, -1
    given = {
        "rgb": np.full((*SIZE, 3), 128, np.uint8),
        "depth": depth,
        "K": [[40, 0, 15.5], [0, 41, 11.5], [0, 0, 1]],
    }
    return given | {"depth_unit": 0.001} | changes


def test_arrays_of_a_camera_become_a_frame_with_half_integer_pixel_centres():
    frame = Frame.from_arrays(**arrays(name="cup"))
    assert (frame.name, frame.mask, frame.camera.size) == ("cup", None, SIZE)
    assert_allclose(frame.camera.K, [[40, 0, 16], [0, 41, 12], [0, 0, 1]])
    four = Frame.from_arrays(**arrays(K=(40, 41, 15.5, 11.5)))
    assert_array_equal(four.camera.K, frame.camera.K)


def test_the_pose_of_arrays_is_that_of_the_camera_in_the_world():
    pose = np.eye(4)
    pose[:3, :3] = random_camera().R
    pose[:3, 3] = 1, 2, 3
    for matrix in (pose, pose[:3]):
        camera = Frame.from_arrays(**arrays(pose=matrix)).camera
        assert_allclose(camera.to_world(np.eye(3)), pose[:3, :3].T + (1, 2, 3))


def test_smaller_depth_of_arrays_is_enlarged_and_zero_where_it_is_unknown():
    depth = Frame.from_arrays(**arrays()).depth
    assert_array_equal(depth[:2, :8], 0)
    assert_array_equal(depth[2:], np.float32(2))


@pytest.mark.parametrize("channels", [(), (1,), (3,), (4,)])
@pytest.mark.parametrize("value", [np.uint8(128), np.float32(128 / 255)])
def test_grey_images_alpha_and_floats_are_colours(channels, value):
    rgb = np.full((*SIZE, *channels), value)
    assert_array_equal(Frame.from_arrays(**arrays(rgb=rgb)).rgb, np.full((*SIZE, 3), 128))


def test_a_mask_holds_booleans_zeros_and_ones_or_up_to_255():
    inside = np.zeros(SIZE, bool)
    inside[5:9, 3:20] = True
    for mask in (
        inside,
        inside[..., None],
        inside.astype(np.int64),
        inside.astype(np.float32),
        255 * inside.astype(np.uint8),
    ):
        assert_array_equal(Frame.from_arrays(**arrays(mask=mask)).mask > 0.5, inside)


@pytest.mark.parametrize("count", [4, 5, 8])
def test_the_distortion_of_arrays_is_corrected(count):
    distortion = [-0.3, 0.1, 0.002, -0.001, 0.02, 0.01, -0.02, 0.01][:count]
    camera = Camera(np.eye(3), np.zeros(3), np.array([90.0, 91]), np.array([64.5, 48.5]), (96, 128))
    # The depth and the mask of a pixel tell its column without distortion.
    places, straight = straight_places(camera, distortion)
    columns = straight[..., 0]
    grey = np.zeros(camera.size)
    K = camera.K - HALF_PIXEL
    frame = Frame.from_arrays(grey, columns + 100, K, columns > 60, distortion=distortion)
    assert_array_equal(frame.camera.K, camera.K)
    inside = np.s_[4:-4, 4:-4]
    errors = np.abs(frame.depth - 100 - places[..., 0])[inside]
    assert errors.max() < 1  # pixel
    # Depth is that of a pixel, not a mean of two.
    assert np.isin(frame.depth, np.float32(columns + 100)).all()
    assert_array_equal((frame.mask > 0.5)[inside][:, :50], False)
    assert_array_equal((frame.mask > 0.5)[inside][:, 60:], True)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"distortion": [0.1, 0.2, 0]}, r"distortion is \[0.1, 0.2, 0.0\], expected OpenCV's k1"),
        ({"distortion": [0.1, 0.2, 0.5, 0, 0]}, "with p1 and p2 from -0.1 to 0.1"),
        (
            {"rgb": np.zeros((3, *SIZE), np.uint8)},
            r"rgb has shape \(3, 24, 32\), expected \(H, W\)",
        ),
        ({"rgb": np.full((*SIZE, 3), 128.0)}, "rgb is float64"),
        ({"depth": np.ones((12, 12))}, r"depth has shape \(12, 12\), expected shape \(24, 32\)"),
        ({"depth_unit": 0.0}, "depth_unit is 0.0, expected a finite number greater than 0"),
        ({"K": np.eye(4)}, r"K has shape \(4, 4\), expected real numbers of shape \(4,\)"),
        (
            {"K": np.array([[40, 0, 16], [1, 41, 12], [0, 0, 1]])},
            "expected fx 0 cx, 0 fy cy, 0 0 1 in pixels",
        ),
        ({"mask": np.full(SIZE, 7)}, "mask has 7 at most, expected booleans, 0 and 1, or 0 to 255"),
        ({"mask": np.ones((0, 0))}, r"mask has shape \(0, 0\), expected \(h, w\)"),
        ({"pose": np.diag([2.0, 2, 2, 1])}, "camera-to-world pose"),
    ],
)
def test_arrays_that_cannot_be_a_frame_are_refused_by_one_line(changes, message):
    line = refused(message, Frame.from_arrays, **arrays(name="cup", **changes))
    assert line.startswith(("frame cup", "depth_unit"))


def test_masks_survive_their_files(tmp_path):
    path = tmp_path / "mask.png"
    mask = default_rng(0).integers(0, 256, SIZE).astype(np.float32) / 255
    # Byte 24 of a PNG is the bits per pixel: a mask of booleans has one.
    for written, bits in ((mask, 8), (mask > 0.5, 1)):
        write_mask(path, written)
        assert_array_equal(read_mask(path), written)
        assert path.read_bytes()[24] == bits


@pytest.mark.parametrize("extension", [".png", ".jpg"])
def test_an_image_file_is_complete_whatever_follows_it(tmp_path, extension):
    pixels = default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    data = cv2.imencode(extension, pixels)[1].tobytes()
    path = tmp_path / "image"
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    for behind in (b"", b"\xff\xda \xff\xd9 IDAT IEND", data[:-9]):
        path.write_bytes(data + behind)
        assert_array_equal(read_image(path), decoded)
    for end in (*range(0, len(data), 37), len(data) - 2, len(data) - 1):
        path.write_bytes(data[:end])
        refused("cannot be decoded", read_image, path)


def test_an_interrupted_write_leaves_the_old_file_alone(tmp_path, monkeypatch):
    write_atomic(tmp_path / "file", b"old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_atomic(tmp_path / "file", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_bytes() == b"old"


def test_a_pixel_is_on_the_object_if_probably_so_and_of_known_depth():
    mask = np.array([[0.0, 0.5, 0.55, 0.85, 1.0, 1.0]], np.float32)
    depth = np.array([[2.0, 2.0, 2.0, 2.0, 2.0, 0.0]], np.float32)
    frame = Frame(np.zeros((1, 6, 3), np.uint8), depth, mask, random_camera(0, (1, 6)))
    assert object_pixels(frame).tolist() == [[False, False, True, True, True, False]]
    assert len(object_points(frame)) == 3
    assert object_pixels(replace(frame, mask=None)).tolist() == (depth > 0).tolist()
    assert repr(frame) == "Frame('', 1 x 6 pixels)"


def test_the_spread_averages_the_variances_of_the_axes():
    points = np.array([[1, 2, 3], [-1, -2, -3], [1, -2, 3], [-1, 2, -3]]) + 7.0
    assert standard_deviation(points) == pytest.approx(np.sqrt((1 + 4 + 9) / 3))


def test_the_bits_are_those_of_a_float16_and_only_positive_finite_values_known():
    # 0x3C00 is 1 and 0x4000 is 2.
    assert encode_depth(np.array([[1.0, 0.0]])).tolist() == [[0x3C00, 0]]
    assert decode_depth(np.array([[0x4000]], np.uint16), 3.0).tolist() == [[6.0]]
    infinite, nan, negative = 0x7C00, 0x7E00, 0xBC00
    assert not decode_depth(np.array([[infinite, nan, negative, 0]], np.uint16)).any()
    assert not encode_depth(np.array([[np.inf, np.nan, -1, 1e9]])).any()


@settings(max_examples=30)
@given(seeds)
def test_holes_in_a_plane_are_filled_with_the_plane(seed):
    plane = np.add.outer(np.zeros(40), np.linspace(2, 3, 50)).astype(np.float32)
    known = default_rng(seed).random(plane.shape) < 0.3
    known[10:20, 12:25] = False
    depth = np.where(known, plane, 0)
    filled = inpaint_depth(depth)
    assert np.abs(filled - plane).mean() < 0.02  # depth differs by 0.27 across the hole
    assert_array_equal(filled[known], plane[known])
    assert filled.min() >= depth[known].min()
    assert filled.max() <= depth.max()
    assert_array_equal(inpaint_depth(filled), filled)  # complete depth needs no filling
    refused("no known pixel", inpaint_depth, 0 * depth)


def test_unprojected_depth_projects_onto_its_own_pixels():
    camera = random_camera(3, (7, 9))
    depth = default_rng(0).uniform(1, 2, (7, 9))
    pixels, back = camera.project(camera.to_world(unproject_depth(depth, camera)))
    assert_allclose(pixels[2, 5], [5.5, 2.5])  # pixel centres lie at half-integers
    assert_allclose(back, depth)


@settings(max_examples=30)
@given(seeds, st.integers(6, 40), st.integers(8, 40))
def test_a_patchs_point_has_the_lower_quartile_of_its_known_depths(seed, height, width):
    rng = default_rng(seed)
    depth = rng.uniform(1, 5, (height, width)) * (rng.random((height, width)) < 0.2)
    camera = random_camera(seed, (height, width))
    points, known = patch_points(depth, camera, (6, 8), inpaint=False)
    pixels, _ = camera.project(camera.to_world(points))
    for row, column in np.ndindex(6, 8):
        # Patches need not divide the image.
        first, last = height * row // 6, height * (row + 1) // 6
        left, right = width * column // 8, width * (column + 1) // 8
        measured = depth[first:last, left:right]
        measured = measured[measured > 0]
        assert known[row, column] == measured.any()
        if measured.any():
            # The point lies on the ray of a pixel of the patch, which has this depth.
            quartile = np.quantile(measured, 0.25, method="lower")
            x, y = np.floor(pixels[row, column]).astype(int)
            assert left <= x < right and first <= y < last
            assert points[row, column, 2] == pytest.approx(quartile)
            assert depth[y, x] == quartile


def test_a_patch_without_depth_takes_the_filled_depth_at_its_centre():
    depth = np.full((16, 16), 2, np.float32)
    depth[4:8, 8:12] = 0
    camera = random_camera(0, (16, 16))
    points, known = patch_points(depth, camera, (4, 4))
    assert not known[1, 2]
    assert known.sum() == 15
    centre = camera.unproject_camera(np.array([10.5, 6.5]), inpaint_depth(depth)[6, 10])
    assert_allclose(points[1, 2], centre)
    measured, same = patch_points(depth, camera, (4, 4), inpaint=False)
    assert_array_equal(same, known)
    assert_array_equal(measured[known], points[known])
    assert_array_equal(measured[1, 2], 0)
