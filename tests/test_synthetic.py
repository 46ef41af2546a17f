"""Synthetic data: exports read like CO3D; labels, cameras and depth agree with the geometry."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest

from tools.synthetic import SPLITS, main
from zsp_lite.alignment import umeyama
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import crop_to_object
from zsp_lite.data.labels import read_labels, relative_pose
from zsp_lite.errors import InputError
from zsp_lite.synthetic import export
from zsp_lite.synthetic.assembly import N_MATERIALS, make_shape, surface_spread
from zsp_lite.synthetic.categories import CATEGORIES
from zsp_lite.synthetic.export import PRESETS, export_categories, make_sequence
from zsp_lite.synthetic.materials import random_materials
from zsp_lite.synthetic.sensor import soft_mask
from zsp_lite.synthetic.sequences import handheld_sweep

PAPER = tuple(
    "backpack bicycle book car chair hairdryer handbag hydrant keyboard laptop motorcycle mouse "
    "remote teddybear toaster toilet toybus toyplane toytrain toytruck".split()
)

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
    return [make_sequence("chair", index, FRAMES, SEED, SIZE) for index in range(2)]


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# Categories


def test_the_categories_have_the_names_of_the_paper():
    assert tuple(CATEGORIES) == PRESETS["paper"].categories == PAPER
    assert set(PRESETS["demo"].categories) <= set(CATEGORIES)


@pytest.mark.parametrize(("one", "other"), list(itertools.combinations([*SPLITS.values(), CATEGORIES], 2)))
def test_two_splits_share_no_category_and_no_code(one, other):
    assert not one.keys() & other.keys() and not {*one.values()} & {*other.values()}


def test_the_tool_renders_the_categories_of_a_split(tmp_path, monkeypatch):
    some = dict(list(SPLITS["validation"].items())[:2])
    monkeypatch.setitem(SPLITS, "validation", some)
    main(["validation", "--sequences", "1", "--frames", "1", "--out", str(tmp_path)])
    made = Co3D(tmp_path)
    assert sorted(made.categories()) == sorted(some)
    assert all(len(made.sequences(category)) == 1 for category in some)


@pytest.mark.parametrize("category", sorted(ALL))
def test_objects_of_a_category_are_unit_sized_and_vary(category):
    shapes = [make_shape(ALL[category], seed) for seed in range(4)]
    for shape in shapes:
        assert shape.faces.max() < len(shape.vertices) and np.isfinite(shape.vertices).all()
        assert surface_spread(shape.vertices, shape.faces) == pytest.approx(1)
        assert 0 <= shape.material.min() and shape.material.max() < 8
    extents = np.array([np.ptp(shape.vertices, axis=0) for shape in shapes])
    assert (extents.std(0) / extents.mean(0)).max() > 0.02


@pytest.mark.parametrize("category", sorted(ALL))
def test_front_and_back_of_an_object_differ(category):
    """No object coincides with itself after half a turn about z, otherwise its pose would be ambiguous."""
    shape = make_shape(ALL[category], 3)
    turned = shape.vertices * [-1, -1, 1]
    nearest = np.linalg.norm(shape.vertices[:, None] - turned[None, ::3], axis=-1).min(0)
    assert nearest.max() > 0.2


@pytest.mark.parametrize("seed", range(8))
def test_materials_are_valid_and_depend_on_the_seed_alone(seed):
    points = np.random.default_rng(0).normal(0, 1, (500, 3)).astype(np.float32)
    first, again = random_materials(seed), random_materials(seed)
    assert len(first) == N_MATERIALS
    for material, other in zip(first, again, strict=True):
        assert 0 <= material.specular <= 1 and 0 < material.roughness <= 1
        assert (material.colour == other.colour).all() and material.colour[3] == 1
        if material.pattern:
            colours = material.pattern(points)
            assert colours.min() >= 0 and colours.max() <= 1 and np.ptp(colours, axis=0).max() > 0
            assert (colours == other.pattern(points)).all()
    assert any((one.roughness != two.roughness) for one, two in zip(first, random_materials(seed + 100), strict=True))


# Sequences


def test_the_object_is_inside_the_image_and_fills_it():
    size = (120, 160)
    extents = []
    for seed in range(8):
        vertices = make_shape(CATEGORIES["bicycle"], seed).vertices
        for camera in handheld_sweep(vertices, np.random.default_rng(seed), 12, size):
            pixels, depth = camera.project(vertices)
            assert depth.min() > 1
            assert (pixels > 0).all() and (pixels < size[::-1]).all()
            extents.append(np.ptp(pixels, axis=0).max() / min(size))
    assert 0.5 < np.median(extents) < 0.8


def test_the_camera_moves_once_around_at_10_to_35_degrees_of_elevation():
    vertices = make_shape(CATEGORIES["car"], 0).vertices
    cameras = handheld_sweep(vertices, np.random.default_rng(1), 40, (100, 100))
    x, y, z = np.transpose([camera.centre - (vertices.max(0) + vertices.min(0)) / 2 for camera in cameras])
    turned = np.degrees(np.unwrap(np.arctan2(y, x)))
    assert 330 < np.ptp(turned) < 390
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    assert 8 < elevation.min() and elevation.max() < 37
    assert np.ptp([camera.focal_length[0] for camera in cameras]) == 0


def test_canonical_coordinates_project_onto_their_own_pixels_and_depth(chairs):
    for _, exact in chairs:
        for view in exact.views:
            row, col = np.nonzero(view.mask)
            pixels, depth = view.camera.project(exact.to_world(view.canonical[row, col]))
            assert np.abs(pixels - np.stack([col + 0.5, row + 0.5], 1)).max() < 0.02
            np.testing.assert_allclose(depth, view.depth[row, col], rtol=1e-4)


# Sensor


@pytest.mark.slow
def test_a_third_to_a_half_of_the_depth_is_missing_in_connected_regions():
    unknown, on_object, isolated = [], [], []
    for index, category in enumerate(sorted(CATEGORIES)[::2]):
        data, exact = make_sequence(category, index, 2, SEED, SIZE)
        for frame, view in zip(data.frames, exact.views, strict=True):
            hole = frame.depth == 0
            unknown.append(hole.mean())
            on_object.append(hole[view.mask].mean())
            isolated.append((hole[:, 1:-1] & ~hole[:, :-2] & ~hole[:, 2:]).sum() / hole.sum())
    assert 0.3 < np.mean(on_object) < 0.5
    assert 0.35 < np.mean(unknown) < 0.6
    assert np.mean(isolated) < 0.1


def test_masks_are_soft_and_accurate_to_two_pixels(chairs):
    truth = np.zeros((80, 80), bool)
    truth[20:60, 20:60] = True
    mask = soft_mask(truth, np.random.default_rng(0))
    assert mask[30:50, 30:50].min() > 0.99 and mask[:16].max() < 0.1
    assert ((mask > 0.1) & (mask < 0.9)).sum() > 100
    for data, exact in chairs:
        for frame, view in zip(data.frames, exact.views, strict=True):
            inside = view.mask.astype(np.uint8)
            to_edge = cv2.distanceTransform(inside, cv2.DIST_L2, 5) + cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
            wrong = (frame.mask > 0.5) != view.mask
            assert 0 < wrong.sum() and to_edge[wrong].max() <= 2.5


def test_the_point_cloud_has_unit_spread_and_lies_on_the_object(chairs):
    for data, exact in chairs:
        assert data.points.std(0).mean() == pytest.approx(1)
        np.testing.assert_allclose(np.linalg.norm(data.normals, axis=1), 1, atol=1e-4)
        R, t = exact.object_pose[:3, :3], exact.object_pose[:3, 3]
        canonical = (data.points - t) @ R / exact.scale
        seen = np.concatenate([view.canonical[view.mask] for view in exact.views])
        assert (canonical > seen.min(0) - 0.3).all() and (canonical < seen.max(0) + 0.3).all()


# Export


def test_an_export_reads_back(folder, chairs):
    dataset = Co3D(folder)
    assert dataset.categories() == ["chair", "toytruck"]
    for category in dataset.categories():
        assert len(dataset.select(category)) == 2
        for sequence in dataset.sequences(category):
            assert len(dataset.frames(category, sequence.sequence_name)) == FRAMES
            points, colours = dataset.point_cloud(category, sequence.sequence_name)
            assert len(points) == len(colours) == sequence.point_cloud.n_points
    data = chairs[0][0]
    for annotation, wanted in zip(dataset.frames("chair", data.name), data.frames, strict=True):
        frame = dataset.load(annotation)
        np.testing.assert_allclose(frame.camera.matrix, wanted.camera.matrix, atol=1e-9)
        np.testing.assert_allclose(frame.camera.K, wanted.camera.K, rtol=1e-9)
        np.testing.assert_allclose(frame.depth, wanted.depth, rtol=1e-3)
        np.testing.assert_allclose(frame.mask, wanted.mask, atol=0.51 / 255)
        assert np.abs(frame.rgb.astype(int) - wanted.rgb).mean() < 12  # JPEG
        assert crop_to_object(frame).rgb.size < frame.rgb.size


def test_labels_give_the_transform_between_the_canonical_frames(folder, chairs):
    """Ground truth from labels and cameras equals a fit to the canonical coordinates."""
    labels = read_labels(folder, "chair")
    (data_a, exact_a), (data_b, exact_b) = chairs
    view_a, view_b = exact_a.views[2], exact_b.views[4]
    truth = relative_pose(labels[data_a.name], view_a.camera, labels[data_b.name], view_b.camera)

    def canonical_to_camera(view, depth):
        row, col = np.nonzero(view.mask)
        seen = view.camera.unproject_camera(np.stack([col + 0.5, row + 0.5], 1), depth[row, col])
        return umeyama(view.canonical[row, col].astype(float), seen)

    a, b = canonical_to_camera(view_a, view_a.depth), canonical_to_camera(view_b, view_b.depth)
    np.testing.assert_allclose(truth[:3, :3], np.asarray(b.R) @ np.asarray(a.R).T, atol=1e-3)
    # The origin of the canonical frame is the same point of both objects.
    np.testing.assert_allclose(truth[:3, :3] @ np.asarray(a.t) + truth[:3, 3], np.asarray(b.t), atol=1e-2)
    assert np.array_equal(labels[data_a.name].trans, np.eye(4))


def test_a_sequence_does_not_depend_on_the_rest_of_the_export(folder, tmp_path):
    """An export of one category in two steps has the same bytes as in a full export."""
    export_categories(["toytruck"], tmp_path, 1, FRAMES, SEED, SIZE)
    export_categories(["toytruck"], tmp_path, 2, FRAMES, SEED, SIZE)
    whole = {name: data for name, data in files(folder).items() if "toytruck" in name and "determ_eval" not in name}
    part = {name: data for name, data in files(tmp_path).items() if "toytruck" in name}
    assert part == whole and len(part) > 50


def test_an_interrupted_export_is_completed_and_complete_sequences_stay(tmp_path, monkeypatch):
    made = []

    def interrupt_second(category, index, *rest):
        if made == [0]:
            made.append("interrupted")
            raise KeyboardInterrupt
        made.append(index)
        return make_sequence(category, index, *rest)

    monkeypatch.setattr(export, "make_sequence", interrupt_second)
    with pytest.raises(KeyboardInterrupt):
        export_categories(["mouse"], tmp_path / "a", 2, 2, 1, 48)
    export_categories(["mouse"], tmp_path / "a", 2, 2, 1, 48)
    assert made == [0, "interrupted", 1]
    export_categories(["mouse"], tmp_path / "b", 2, 2, 1, 48)
    assert files(tmp_path / "a") == files(tmp_path / "b")


def test_bad_arguments_and_folders_with_other_settings_are_input_errors(folder, tmp_path):
    with pytest.raises(InputError, match="sofa"):
        export_categories(["sofa"], tmp_path, 1, 1, 0)
    with pytest.raises(InputError, match="sequences is 0, expected an integer from 1"):
        export_categories(["chair"], tmp_path, 0, 1, 0)
    with pytest.raises(InputError, match="imagenet"):
        export.export_preset("imagenet", tmp_path)
    with pytest.raises(InputError, match="was written with"):
        export_categories(["chair"], folder, 2, FRAMES, SEED + 1, SIZE)


@pytest.mark.parametrize("name", ["synthetic.json", "chair/object_poses.json"])
def test_a_damaged_export_is_an_input_error_with_the_name_of_the_file(tmp_path, name):
    (tmp_path / "chair").mkdir()
    (tmp_path / name).write_text('{"seed": ')
    with pytest.raises(InputError, match=name):
        export_categories(["chair"], tmp_path, 1, 2, SEED, 48)
