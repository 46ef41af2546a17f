import numpy as np
import pytest
from co3d_folders import random_camera, seeds
from hypothesis import given

from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import decode_depth, encode_depth, inpaint_depth, patch_points, unproject_depth
from zsp_lite.errors import InputError


def frontal(size):
    centre = np.array([size[1] / 2, size[0] / 2])
    return Camera(np.eye(3), np.zeros(3), np.array([50.0, 60.0]), centre, size)


def test_the_bits_are_those_of_a_float16_and_values_that_are_not_positive_and_finite_are_unknown():
    assert encode_depth(np.array([[1.0, 0.0]])).tolist() == [[0x3C00, 0]]
    assert decode_depth(np.array([[0x4000]], np.uint16), 3.0).tolist() == [[6.0]]
    infinite, nan, negative = 0x7C00, 0x7E00, 0xBC00
    assert not decode_depth(np.array([[infinite, nan, negative, 0]], np.uint16)).any()
    assert not encode_depth(np.array([[np.inf, np.nan, -1, 1e9]])).any()


def test_a_hole_in_a_plane_is_filled_with_the_plane():
    plane = np.add.outer(np.zeros(40), np.linspace(2, 3, 50)).astype(np.float32)
    holed = plane.copy()
    holed[10:20, 12:25] = 0
    filled = inpaint_depth(holed)
    np.testing.assert_allclose(filled, plane, atol=0.05)  # the hole spans a range of 0.27
    np.testing.assert_array_equal(filled[holed > 0], plane[holed > 0])


@given(seeds)
def test_filled_depth_stays_between_the_known_depths(seed):
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((20, 24)) < 0.3, rng.uniform(1, 5, (20, 24)), 0).astype(np.float32)
    depth[3, 4] = 2.0
    filled = inpaint_depth(depth)
    assert filled.min() >= depth[depth > 0].min() and filled.max() <= depth.max()
    np.testing.assert_array_equal(inpaint_depth(filled), filled)  # complete depth needs no filling
    with pytest.raises(InputError, match="no known pixel"):
        inpaint_depth(0 * depth)


def test_unprojected_depth_projects_onto_its_own_pixels():
    camera = random_camera(3, (7, 9))
    depth = np.random.default_rng(0).uniform(1, 2, (7, 9))
    pixels, back = camera.project(camera.to_world(unproject_depth(depth, camera)))
    np.testing.assert_allclose(pixels[2, 5], [5.5, 2.5])  # pixel centres lie at half-integers
    np.testing.assert_allclose(pixels[6, 0], [0.5, 6.5])
    np.testing.assert_allclose(back, depth)


def patch_depths_one_by_one(depth, grid):
    """`patch_points` as a loop over patches."""
    height, width = depth.shape[0] // grid[0], depth.shape[1] // grid[1]
    for row in range(grid[0]):
        for col in range(grid[1]):
            patch = depth[row * height : (row + 1) * height, col * width : (col + 1) * width]
            known = np.sort(patch[patch > 0])
            yield row, col, known[(len(known) - 1) // 4] if len(known) else None


@given(seeds)
def test_a_patchs_point_has_the_lower_quartile_of_its_known_depths(seed):
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((24, 32)) < 0.2, rng.uniform(1, 5, (24, 32)), 0).astype(np.float32)
    depth[0, 0] = 3
    camera = frontal((24, 32))
    points, known = patch_points(depth, camera, (6, 8))
    pixels, _ = camera.project(points)
    rows, cols = np.floor(pixels[..., 1]).astype(int), np.floor(pixels[..., 0]).astype(int)
    for row, col, expected in patch_depths_one_by_one(depth, (6, 8)):
        assert known[row, col] == (expected is not None)
        assert rows[row, col] // 4 == row and cols[row, col] // 4 == col  # the pixel is one of the patch
        if expected is not None:
            assert points[row, col, 2] == expected == depth[rows[row, col], cols[row, col]]


def test_a_patch_without_depth_takes_the_filled_depth_at_its_centre():
    depth = np.full((16, 16), 2, np.float32)
    depth[4:8, 8:12] = 0
    camera = frontal((16, 16))
    points, known = patch_points(depth, camera, (4, 4))
    assert not known[1, 2] and known.sum() == 15
    centre = camera.unproject_camera(np.array([10.5, 6.5]), inpaint_depth(depth)[6, 10])
    np.testing.assert_allclose(points[1, 2], centre)
    measured, same = patch_points(depth, camera, (4, 4), inpaint=False)
    assert (same == known).all() and (measured[known] == points[known]).all() and (measured[1, 2] == 0).all()


def test_patches_need_not_divide_the_image():
    depth = np.arange(1, 36, dtype=np.float32).reshape(5, 7)
    points, known = patch_points(depth, frontal((5, 7)), (2, 3))
    assert points.shape == (2, 3, 3) and known.all()
    assert points[1, 2, 2] == np.sort(depth[2:, 4:].ravel())[2]
