"""Ground-truth matches of synthetic objects agree with their meshes and cameras."""

import numpy as np
import pytest
import trimesh
from sklearn.neighbors import NearestNeighbors

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.depth import patch_points
from zsp_lite.demo import demo_pairs
from zsp_lite.errors import InputError
from zsp_lite.samples import sample_data
from zsp_lite.synthetic.export import export_categories, make_object
from zsp_lite.synthetic.ground_truth import correct_matches, ground_truth_matches, object_poses, patch_coordinates
from zsp_lite.views import object_crop

GRID = (28, 28)


@pytest.fixture(scope="module")
def dataset() -> Co3D:
    return Co3D(sample_data())


@pytest.fixture(scope="module")
def pair(dataset):
    return demo_pairs(dataset)[1]  # cars; bicycles are too thin for the statistics of patches


def test_patch_coordinates_lie_on_the_mesh_of_the_object(tmp_path):
    export_categories(["toytruck"], tmp_path, sequences=1, frames=1, seed=0, image_size=128)
    exported = Co3D(tmp_path)
    ((sequence, pose),) = object_poses(exported, "toytruck").items()
    (frame,) = exported.frames("toytruck", sequence)
    coordinates, known = patch_coordinates(object_crop(exported.load(frame)), pose, GRID)
    points = coordinates[known] * np.subtract(pose.high, pose.low) + pose.low
    mesh = make_object("toytruck", 0, seed=0)
    surface, _ = trimesh.sample.sample_surface(trimesh.Trimesh(mesh.vertices, mesh.faces), 20_000, seed=0)
    distance = NearestNeighbors(n_neighbors=1).fit(surface).kneighbors(points)[0]
    assert known.sum() > 100
    # The truck is several units long and several units away; the depth has an error of half a percent.
    assert np.median(distance) < 0.05 and np.percentile(distance, 95) < 0.1


def test_matches_between_two_views_of_one_object_agree_with_the_projection_of_its_points(dataset, pair):
    pose = object_poses(dataset, pair.category)[pair.reference_sequence]
    frames = dataset.frames(pair.category, pair.reference_sequence)
    first, second = (object_crop(dataset.load(frames[i])) for i in (3, 4))
    matched, valid = ground_truth_matches(*(patch_coordinates(crop, pose, GRID) for crop in (first, second)))
    points, _ = patch_points(first.depth, first.camera, GRID)
    pixels, _ = second.camera.project(first.camera.to_world(points))
    cells = np.floor(pixels[..., ::-1] * GRID / np.array(second.camera.size)).astype(int)
    assert valid.sum() > 100
    assert correct_matches(cells, matched)[valid].mean() > 0.85


def test_a_match_is_the_nearest_patch_within_the_tolerance():
    first = np.array([[[0.1, 0.5, 0.5], [0.5, 0.5, 0.5], [0.9, 0.5, 0.5]]])
    second = np.array([[[0.52, 0.5, 0.5]], [[0.13, 0.5, 0.5]], [[0.9, 0.5, 0.5]]])
    known = np.array([[True], [True], [False]])
    matched, valid = ground_truth_matches((first, np.ones((1, 3), bool)), (second, known), tolerance=0.1)
    assert valid.tolist() == [[True, True, False]]
    assert matched.tolist() == [[[1, 0], [0, 0], [0, 0]]]
    nothing = ground_truth_matches((first, np.zeros((1, 3), bool)), (second, known))
    assert not nothing[1].any()


def test_a_correct_match_is_at_most_one_row_and_one_column_off():
    cells = np.array([[4, 4], [5, 5], [3, 4], [6, 4], [4, 2]])
    assert correct_matches(cells, np.full((5, 2), 4)).tolist() == [True, True, True, False, False]
    assert correct_matches(cells, np.full((5, 2), 4), tolerance=2).all()


@pytest.mark.parametrize(
    ("content", "message"), [(None, "expected a synthetic export"), ('{"a": {"scale": 1.0}}', "object_poses.json")]
)
def test_missing_and_damaged_object_poses_are_input_errors(tmp_path, content, message):
    (tmp_path / "chair").mkdir()
    if content:
        (tmp_path / "chair/object_poses.json").write_text(content)
    with pytest.raises(InputError, match=message):
        object_poses(Co3D(tmp_path), "chair")
