"""Points marked on one object, found on the others: places, shifted poses, and nothing here."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusals import refused
from scipy.spatial import KDTree

from zsp_lite import Co3D, Sim3, load_backbone
from zsp_lite.data.ground_truth import read_poses
from zsp_lite.scans.category import AlignedObject, CategoryAlignment
from zsp_lite.scans.transfer import object_size, surface_views, transfer


def aligned(sim3s: dict[str, Sim3]) -> CategoryAlignment:
    """An alignment with these similarities from the objects' worlds."""
    objects = {
        name: AlignedObject(sim3, np.zeros(3), 1.0, None, 0.0) for name, sim3 in sim3s.items()
    }
    return CategoryAlignment(objects, ())


def true_sim3(dataset: Co3D, category: str, name: str) -> Sim3:
    """The similarity from an object's world to the frame of its category."""
    pose = read_poses(dataset.root, category)[name]
    return Sim3(pose.scale, pose.R, pose.t).inverse()


def surface_points(views) -> np.ndarray:
    """The points of a surface in the common frame."""
    return np.concatenate([view.points for view in views])


def world_points(views) -> np.ndarray:
    """The points of a surface in the object's world."""
    return views[0].sim3.inverse().apply(surface_points(views))


@pytest.fixture(scope="module")
def samples():
    """Surfaces of a car; of the same car from other frames, with a pose that is wrong by 0.08 of
    its size; and of a chair."""
    dataset = Co3D("data_samples")
    backbone = load_backbone()

    def surface(category, name, count, shift=0.0):
        moved = Sim3(1.0, np.eye(3), np.array([shift, 0, 0])) @ true_sim3(dataset, category, name)
        # Fewer frames than the 12 of the library, for speed, and for other frames of the same car.
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("zsp_lite.scans.transfer.VIEWS", count)
            return surface_views(aligned({name: moved}), dataset, category, name, backbone)

    car = surface("car", "suv", 3)
    shift = 0.08 * object_size(car)
    return car, surface("car", "suv", 5, shift), surface("chair", "plaid_chair", 3)


def test_features_find_the_places_that_a_shifted_pose_misses(samples):
    car, shifted, _ = samples
    marks = world_points(car)
    found = transfer(marks, car, shifted)
    # Worlds and object are the same: each mark is its own true place.
    size = object_size(car) / car[0].sim3.scale
    errors = np.linalg.norm(found.world - marks, axis=1) / size
    # Without features: the nearest point in the common frame.
    nearest = KDTree(surface_points(shifted)).query(surface_points(car))[1]
    misses = np.linalg.norm(world_points(shifted)[nearest] - marks, axis=1) / size
    assert np.median(misses) > 0.06
    assert np.median(errors) < 0.03
    assert (found.confidence > 0.5).mean() > 0.95


def test_nothing_is_found_where_nothing_is_near_or_alike(samples):
    car, _, chair = samples
    marks = world_points(car)
    assert (transfer(marks, car, chair).confidence > 0.5).mean() < 0.4

    far = marks + [0, 0, 0.3 * object_size(car) / car[0].sim3.scale]
    above = transfer(far, car, car)
    missed = above.distance > 0.15  # of the object's size, where patches are sought
    assert missed.any()
    assert_array_equal(above.confidence[missed], 0)


def test_wrong_points_are_refused(samples):
    car, shifted, _ = samples
    refused(
        r"points has shape \(2,\), expected real numbers of shape \(n, 3\)",
        transfer,
        [0, 1],
        car,
        shifted,
    )
    refused("points holds nan, expected finite numbers", transfer, [[0, 0, np.nan]], car, shifted)
