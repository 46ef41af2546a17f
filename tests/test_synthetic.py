"""Synthetic data: exports read like CO3D; labels, cameras, depth and true matches agree with the geometry."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from co3d_folders import contents
from scipy.spatial import cKDTree
from sklearn.neighbors import NearestNeighbors

from tools.synthetic import SPLITS
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.depth import patch_points
from zsp_lite.data.labels import read_labels
from zsp_lite.demo import demo_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.files import stable_hash
from zsp_lite.samples import sample_data
from zsp_lite.synthetic import export
from zsp_lite.synthetic.assembly import make_shape
from zsp_lite.synthetic.categories import CATEGORIES
from zsp_lite.synthetic.export import PRESETS, export_categories, make_object, sequence_name
from zsp_lite.synthetic.ground_truth import correct_matches, ground_truth_matches, object_poses, patch_coordinates
from zsp_lite.synthetic.primitives import surface_spread
from zsp_lite.synthetic.recording import shape_turns
from zsp_lite.synthetic.sequences import HEIGHTS, handheld_sweep, record_sequence, soft_mask, stereo_depth
from zsp_lite.views import object_crop

ALL = {name: build for builders in (*SPLITS.values(), CATEGORIES) for name, build in builders.items()}
SEED, FRAMES, SIZE = 5, 6, 72


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("synthetic")
    export_categories(["chair", "toytruck"], out, 2, FRAMES, SEED, SIZE)
    return out


@pytest.fixture(scope="module")
def chairs():
    """Two chairs with simulated sensor errors, each with its exact rendering."""

    def recorded(index):
        name, key = sequence_name(SEED, "chair", index), stable_hash(f"{SEED}/chair/{index}")
        return record_sequence(make_object("chair", index, SEED), name, key, FRAMES, SIZE)

    return [recorded(0), recorded(1)]


# Categories


def test_no_category_is_in_two_splits():
    builders = [build for split in (*SPLITS.values(), CATEGORIES) for build in split.values()]
    assert len(set(builders)) == len(builders) == len(ALL)
    assert len(PRESETS["paper"].categories) == 20 and set(PRESETS["demo"].categories) <= set(CATEGORIES)


@pytest.mark.parametrize("category", sorted(ALL))
def test_objects_of_a_category_are_unit_sized_vary_and_do_not_coincide_with_themselves_after_half_a_turn(category):
    shapes = [make_shape(ALL[category], seed) for seed in range(3)]
    for shape in shapes:
        assert shape.faces.max() < len(shape.vertices) and np.isfinite(shape.vertices).all()
        assert surface_spread(shape.vertices, shape.faces) == pytest.approx(1)
        assert 0 <= shape.material.min() and shape.material.max() < 8
    extents = np.array([np.ptp(shape.vertices, axis=0) for shape in shapes])
    assert (extents.std(0) / extents.mean(0)).max() > 0.02
    distance, _ = cKDTree(shapes[2].vertices).query(shapes[2].vertices[::3] * [-1, -1, 1])
    assert distance.max() > 0.2


# Sequences


@pytest.mark.parametrize("heights", [HEIGHTS, (50.0, 60.0)])
def test_a_sweep_goes_once_around_the_object_at_its_height_and_the_object_fills_the_images(heights):
    size, extents = (120, 160), []
    for seed in range(8):
        vertices = make_shape(CATEGORIES["bicycle"], seed).vertices
        cameras = handheld_sweep(vertices, np.random.default_rng(seed), 12, size, heights)
        for camera in cameras:
            pixels, depth = camera.project(vertices)
            assert depth.min() > 1 and (pixels > 0).all() and (pixels < size[::-1]).all()
            extents.append(np.ptp(pixels, axis=0).max() / min(size))
        x, y, z = np.transpose([camera.centre - (vertices.max(0) + vertices.min(0)) / 2 for camera in cameras])
        assert 300 < np.ptp(np.degrees(np.unwrap(np.arctan2(y, x)))) < 390
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
        assert heights[0] - 11 < elevation.min() and elevation.max() < heights[1] + 7
    assert 0.5 < np.median(extents) < 0.8


# Sensor


def test_depth_has_holes_and_noise_and_masks_are_soft_and_accurate_to_two_pixels(chairs):
    truth = np.zeros((80, 80), bool)
    truth[20:60, 20:60] = True
    mask = soft_mask(truth, np.random.default_rng(0))
    assert mask[30:50, 30:50].min() > 0.99 and mask[:16].max() < 0.1
    assert ((mask > 0.1) & (mask < 0.9)).sum() > 100
    for data, exact in chairs:
        for frame, view in zip(data.frames, exact.views, strict=True):
            known = frame.depth[view.mask] > 0
            assert 0.45 < known.mean() < 0.8  # and the others are holes
            assert np.abs(frame.depth / np.where(view.depth > 0, view.depth, 1) - 1)[view.mask][known].mean() < 0.02
            inside = view.mask.astype(np.uint8)
            to_edge = cv2.distanceTransform(inside, cv2.DIST_L2, 5) + cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
            wrong = (frame.mask > 0.5) != view.mask
            assert 0 < wrong.sum() and to_edge[wrong].max() <= 2.5
    edge_on = replace(chairs[0][1].views[0], mask=np.zeros_like(chairs[0][1].views[0].mask))  # of a flat object
    assert np.isfinite(stereo_depth(edge_on, 0.3, 0.2, np.random.default_rng(0))).all()


def test_the_point_cloud_has_unit_spread_and_lies_on_the_object(chairs):
    for data, exact in chairs:
        assert data.points.std(0).mean() == pytest.approx(1)
        np.testing.assert_allclose(np.linalg.norm(data.normals, axis=1), 1, atol=1e-4)
        R, t = exact.object_pose[:3, :3], exact.object_pose[:3, 3]
        canonical = (data.points - t) @ R / exact.scale
        seen = np.concatenate([view.canonical[view.mask] for view in exact.views])
        assert (canonical > seen.min(0) - 0.3).all() and (canonical < seen.max(0) + 0.3).all()
        for view in exact.views:  # canonical coordinates project onto their own pixels and depth
            row, col = np.nonzero(view.mask)
            pixels, depth = view.camera.project(exact.scale * view.canonical[row, col].astype(float) @ R.T + t)
            assert np.abs(pixels - np.stack([col + 0.5, row + 0.5], 1)).max() < 0.02
            np.testing.assert_allclose(depth, view.depth[row, col], rtol=1e-4)


# Export


def test_an_export_reads_back(folder, chairs):
    dataset = Co3D(folder)
    assert dataset.categories() == ["chair", "toytruck"]
    assert len(dataset.select("toytruck")) == 2
    assert list(read_labels(folder, "chair")) == [data.name for data, _ in chairs]
    for data, _ in chairs:
        np.testing.assert_allclose(dataset.point_cloud("chair", data.name)[0], data.points, atol=1e-4)
        for annotation, wanted in zip(dataset.frames("chair", data.name), data.frames, strict=True):
            np.testing.assert_allclose(dataset.load(annotation).depth, wanted.depth, rtol=1e-3)


def test_an_interrupted_export_is_completed_and_complete_sequences_stay(tmp_path, monkeypatch):
    made = []

    def interrupt_second(mesh, name, *rest):
        if len(made) == 1:
            made.append("interrupted")
            raise KeyboardInterrupt
        made.append(name)
        return record_sequence(mesh, name, *rest)

    monkeypatch.setattr(export, "record_sequence", interrupt_second)
    with pytest.raises(KeyboardInterrupt):
        export_categories(["mouse"], tmp_path / "a", 2, 2, 1, 48)
    export_categories(["mouse"], tmp_path / "a", 2, 2, 1, 48)
    assert made == [sequence_name(1, "mouse", 0), "interrupted", sequence_name(1, "mouse", 1)]
    export_categories(["mouse"], tmp_path / "b", 2, 2, 1, 48)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_folders_with_other_or_damaged_settings_are_input_errors(folder, tmp_path):
    with pytest.raises(InputError, match="was written with"):
        export_categories(["chair"], folder, 2, FRAMES, SEED + 1, SIZE)
    (tmp_path / "synthetic.json").write_text('{"seed": ')
    with pytest.raises(InputError, match="synthetic.json"):
        export_categories(["chair"], tmp_path, 1, 2, SEED, 48)


def test_turns_after_which_a_shape_is_the_same_are_known():
    square = np.array([[x, y, z] for x in (0, 2) for y in (0, 2) for z in (0, 1)], float)
    assert shape_turns(square) == (90, 180, 270)
    assert shape_turns(square * (2, 1, 1)) == (180,)
    assert shape_turns(np.vstack([square, [[3, 1, 0]]])) == ()


# True matches

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
