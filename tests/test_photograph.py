"""The photograph of a motorcycle: depth, mask, directions, and where it comes from."""

import numpy as np
import pytest

from zsp_lite.data import photograph
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.geometry import fit_plane
from zsp_lite.data.photograph import motorcycle_frame
from zsp_lite.points import axis_deviation, object_points

CLEAR_OF_THE_FLOOR = np.s_[450:, :]  # the motorcycle does not reach the lowest rows


def angle(first, second) -> float:
    first, second = np.asarray(first), np.asarray(second)
    return float(np.degrees(np.arccos(first @ second / np.linalg.norm(first) / np.linalg.norm(second))))


@pytest.fixture(scope="module")
def frame():
    """The photograph with depth in metres."""
    import skimage.data

    rgb, _, disparity = skimage.data.stereo_motorcycle()
    return motorcycle_frame(rgb, disparity)


def test_the_mask_is_one_object_of_the_size_of_a_motorcycle(frame):
    on = frame.mask > 0
    points = unproject_depth(frame.depth, frame.camera)[on]
    assert 0.23 < on.mean() < 0.28 and (frame.depth[on] > 0).all()
    length, height = np.ptp(points, axis=0)[:2]
    assert 1.2 < length < 2.2 and 0.7 < height < 1.2  # metres
    rows, cols = np.nonzero(on)
    assert 0 < cols.min() and cols.max() < 740 and 0 < rows.min() and rows.max() < 499


def test_the_mask_holds_the_seat_and_both_wheels_and_neither_the_floor_nor_the_bench(frame):
    seat, rear_tyre, front_tyre, floor, bench = (240, 230), (320, 135), (370, 675), (470, 300), (160, 100)
    assert [frame.mask[pixel] for pixel in (seat, rear_tyre, front_tyre, floor, bench)] == [1, 1, 1, 0, 0]


def test_up_is_the_normal_of_the_floor_and_front_is_parallel_to_it(frame):
    floor = frame.depth[CLEAR_OF_THE_FLOOR] > 0
    normal, _ = fit_plane(unproject_depth(frame.depth, frame.camera)[CLEAR_OF_THE_FLOOR][floor], 0.01)
    assert angle(-np.sign(normal[1]) * normal, photograph.PHOTOGRAPH_UP) < 2
    assert abs(angle(photograph.PHOTOGRAPH_FRONT, photograph.PHOTOGRAPH_UP) - 90) < 1


def test_the_photograph_is_scaled_as_scenes_of_co3d_and_is_the_same_at_every_call(frame):
    first, second = photograph.motorcycle_photograph(), photograph.motorcycle_photograph()
    assert axis_deviation(object_points(first)) == pytest.approx(1, abs=1e-4)
    unit = axis_deviation(object_points(frame))
    assert unit == pytest.approx(0.22, abs=0.005)  # metres, as the documentation says
    np.testing.assert_allclose(first.depth * unit, frame.depth, rtol=1e-5)
    assert all(np.array_equal(getattr(first, name), getattr(second, name)) for name in ("rgb", "depth", "mask"))


def test_depth_follows_from_the_disparity_by_the_calibration(frame):
    import skimage.data

    _, right, disparity = skimage.data.stereo_motorcycle()
    row, col = 330, 390  # on the engine
    point = frame.camera.unproject_camera(np.array([col + 0.5, row + 0.5]), frame.depth[row, col])
    # The right camera stands 0.193001 m to the right; its principal point lies 31.086 pixels farther right.
    seen = 994.978 * (point[0] - 0.193001) / point[2] + 311.193 + 31.086
    assert seen == pytest.approx(col + 0.5 - disparity[row, col], abs=1e-3)
    unknown = ~np.isfinite(disparity)
    assert unknown.any() and (frame.depth[unknown] == 0).all()


def test_a_plane_is_found_among_outliers():
    rng = np.random.default_rng(0)
    normal, offset = np.array([0.6, 0, 0.8]), 2.0
    points = rng.uniform(-3, 3, (3000, 3))
    points[::2] += np.outer(offset - points[::2] @ normal, normal) + rng.normal(0, 0.002, (1500, 3))
    found, found_offset = fit_plane(points, 0.01)
    sign = np.sign(found @ normal)
    assert angle(sign * found, normal) < 0.1 and sign * found_offset == pytest.approx(offset, abs=0.002)


def test_the_plane_of_collinear_points_contains_their_line():
    normal, offset = fit_plane(np.arange(9.0)[:, None] * np.ones(3), 0.01)
    assert np.linalg.norm(normal) == pytest.approx(1) and (normal.sum(), offset) == pytest.approx((0, 0), abs=1e-9)
