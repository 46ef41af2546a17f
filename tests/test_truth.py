"""True correspondences of synthetic objects, checked against the meshes and the cameras that made the pictures."""

import numpy as np
import pytest
from sklearn.neighbors import NearestNeighbors

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.depth import patch_points
from zsp_lite.data.samples import sample_data
from zsp_lite.demo import demo_pairs
from zsp_lite.errors import InputError
from zsp_lite.synthetic.export import make_object
from zsp_lite.synthetic.truth import hits, object_frames, patch_coordinates, true_pair, true_partners
from zsp_lite.views import object_crop

GRID = (28, 28)


@pytest.fixture(scope="module")
def dataset() -> Co3D:
    return Co3D(sample_data())


@pytest.fixture(scope="module")
def pair(dataset):
    return demo_pairs(dataset)[0]


def surface(shape, n=20_000):
    """Points drawn evenly from a mesh."""
    rng = np.random.default_rng(0)
    corners = shape.vertices[shape.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weights = rng.dirichlet(np.ones(3), n)
    return np.einsum("nk,nkd->nd", weights, corners[rng.choice(len(area), n, p=area / area.sum())])


def test_what_a_patch_shows_lies_on_the_mesh_that_was_rendered(dataset, pair):
    sequence = pair.reference_sequence
    crop = object_crop(dataset.load(dataset.frame(pair.category, sequence, pair.reference_frame)))
    place = object_frames(dataset, pair.category)[sequence]
    coordinates, known = patch_coordinates(crop, place, GRID)
    points = coordinates[known] * (place.high - place.low) + place.low
    mesh = surface(make_object(pair.category, sequence, seed=0))
    distance = NearestNeighbors(n_neighbors=1).fit(mesh).kneighbors(points)[0]
    assert known.sum() > 100
    # Units of the mesh; the bicycle is seven long, and the depth has an error of half a percent of some seven units.
    assert np.median(distance) < 0.05 and np.percentile(distance, 95) < 0.1


def test_box_coordinates_run_from_0_to_1(dataset, pair):
    for place in object_frames(dataset, pair.category).values():
        corners = np.stack([place.low, place.high])
        world = place.scale * corners @ place.R.T + place.t
        assert np.allclose(place.to_object(world), corners)
        assert np.allclose(place.to_box(world), [[0, 0, 0], [1, 1, 1]])


def test_partners_in_two_views_of_one_object_are_where_the_camera_sees_the_same_point(dataset, pair):
    place = object_frames(dataset, pair.category)[pair.reference_sequence]
    frames = dataset.frames(pair.category, pair.reference_sequence)
    first, second = (object_crop(dataset.load(frames[i])) for i in (3, 4))
    partners, found = true_partners(*(patch_coordinates(crop, place, GRID) for crop in (first, second)))
    points, _ = patch_points(first.depth, first.camera, GRID)
    pixels, _ = second.camera.project(first.camera.to_world(points))
    cells = np.floor(pixels[..., ::-1] * GRID / np.array(second.camera.size)).astype(int)
    assert found.sum() > 100
    assert hits(cells, partners)[found].mean() > 0.85


def test_partners_are_the_nearest_within_the_tolerance():
    first = np.array([[[0.1, 0.5, 0.5], [0.5, 0.5, 0.5], [0.9, 0.5, 0.5]]])
    second = np.array([[[0.52, 0.5, 0.5]], [[0.13, 0.5, 0.5]], [[0.9, 0.5, 0.5]]])
    known = np.array([[True], [True], [False]])
    partners, found = true_partners((first, np.ones((1, 3), bool)), (second, known), tolerance=0.1)
    assert found.tolist() == [[True, True, False]]
    assert partners.tolist() == [[[1, 0], [0, 0], [0, 0]]]
    nothing = true_partners((first, np.zeros((1, 3), bool)), (second, known))
    assert not nothing[1].any()


def test_a_hit_is_a_cell_at_most_one_row_and_one_column_off():
    cells = np.array([[4, 4], [5, 5], [3, 4], [6, 4], [4, 2]])
    assert hits(cells, np.full((5, 2), 4)).tolist() == [True, True, True, False, False]
    assert hits(cells, np.full((5, 2), 4), within=2).all()


def test_the_target_view_of_a_true_pair_shares_the_most_places(dataset, pair):
    best = true_pair(dataset, pair)
    number = int(best.target.name.split("/")[1])
    assert number in pair.target_frames and best.reference.name == f"{pair.reference_sequence}/{pair.reference_frame}"
    places = object_frames(dataset, pair.category)
    shown = patch_coordinates(best.reference, places[pair.reference_sequence], GRID)
    for other in pair.target_frames:
        crop = object_crop(dataset.load(dataset.frame(pair.category, pair.target_sequence, other)))
        seen = patch_coordinates(crop, places[pair.target_sequence], GRID)
        assert true_partners(shown, seen)[1].sum() <= best.found.sum()


def test_a_folder_that_is_not_synthetic_is_refused(tmp_path, dataset):
    with pytest.raises(InputError, match="only they have exact places"):
        object_frames(Co3D(tmp_path), "chair")


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("synthetic.json", '{"preset": "eval"}', "synthetic.json: .*`seed`"),
        ("synthetic.json", '{"seed": "one"}', "synthetic.json: Expected `int`"),
        ("chair/object_poses.json", '{"a": {"trans": []}}', "object_poses.json: .*trans"),
    ],
)
def test_a_synthetic_folder_with_a_wrong_file_is_named(tmp_path, file, content, message):
    (tmp_path / "chair").mkdir()
    for path, text in {"synthetic.json": '{"seed": 0}', "chair/object_poses.json": "{}", file: content}.items():
        (tmp_path / path).write_text(text)
    with pytest.raises(InputError, match=message):
        object_frames(Co3D(tmp_path), "chair")
