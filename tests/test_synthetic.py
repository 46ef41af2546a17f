"""Synthetic data: exports are read like CO3D; labels, cameras and depth agree with the geometry."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import DEFAULT, Mock

import cv2
import numpy as np
import pytest
from co3d_folders import contents
from numpy.random import default_rng
from numpy.testing import assert_allclose
from refusals import refused
from sklearn.linear_model import RANSACRegressor

from zsp_lite import Co3D
from zsp_lite.course.synthetic import export, sequences
from zsp_lite.course.synthetic.assembly import make_shape
from zsp_lite.course.synthetic.categories import CATEGORIES
from zsp_lite.course.synthetic.export import (
    export_categories,
    make_object,
    sequence_name,
    shape_turns,
)
from zsp_lite.course.synthetic.primitives import direction, surface_spread
from zsp_lite.course.synthetic.sequences import (
    record_sequence,
    render_sequence,
    stereo_depth,
)
from zsp_lite.data.labels import read_labels
from zsp_lite.io.files import stable_hash

SEED, FRAMES, SIZE = 5, 6, 72  # few frames of a small size, for speed


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """An export of two objects of two categories."""
    out = tmp_path_factory.mktemp("synthetic")
    export_categories(["chair", "toytruck"], out, 2, FRAMES, SEED, SIZE)
    return out


@pytest.fixture(scope="module", params=[0, 1])
def chair(request):
    """A chair as recorded by a sensor, with its exact pose, scale and views."""
    index = request.param
    name = sequence_name(SEED, "chair", index)
    key = stable_hash(f"{SEED}/chair/{index}")
    mesh = make_object("chair", index, SEED)
    # `record_sequence` draws the views with the same generator.
    views, _ = render_sequence(mesh, default_rng([key, 1]), FRAMES, SIZE)
    return *record_sequence(mesh, name, key, FRAMES, SIZE), views


@pytest.fixture(scope="module", params=sorted(CATEGORIES))
def shapes(request):
    """Four objects of one category after the other."""
    return [make_shape(CATEGORIES[request.param], seed) for seed in range(4)]


def test_objects_have_unit_size_and_known_materials(shapes):
    for shape in shapes:
        assert shape.faces.max() < len(shape.vertices)
        assert surface_spread(shape.vertices, shape.faces) == pytest.approx(1)
        assert set(shape.material) <= set(range(8))


def test_an_object_differs_from_its_half_turn_so_that_its_pose_is_unique(shapes):
    vertices = shapes[-1].vertices
    turned = vertices[::3] * [-1, -1, 1]
    distances = np.linalg.norm(vertices[:, None] - turned, axis=-1)
    # Some vertex of the turned object is a fifth of the object's size from all others.
    assert distances.min(0).max() > 0.2


def test_depth_has_holes_and_noise(chair):
    data, _, scale, views = chair
    for frame, view in zip(data.frames, views, strict=True):
        depth = frame.depth[view.mask]
        known = depth > 0
        assert 0.45 < known.mean() < 0.8
        ratios = depth[known] / (scale * view.depth[view.mask][known])
        assert 0 < np.abs(ratios - 1).mean() < 0.02


def test_masks_are_accurate_to_two_pixels(chair):
    data, _, _, views = chair
    for frame, view in zip(data.frames, views, strict=True):
        inside = view.mask.astype(np.uint8)
        # The distance of each pixel from the edge, in pixels.
        distance = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
        distance += cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
        wrong = (frame.mask > 0.5) != view.mask
        assert distance[wrong].max() <= 2.5  # half a pixel more: distances are between centres


def test_a_flat_object_seen_edge_on_has_finite_depth(chair):
    *_, views = chair
    edge_on = replace(views[0], mask=np.zeros_like(views[0].mask))
    # With holes in 0.3 of the object and in 0.2 of the floor.
    assert np.isfinite(stereo_depth(edge_on, 0.3, 0.2, default_rng(0))).all()


def test_the_point_cloud_has_unit_spread_and_lies_on_the_object(chair):
    data, pose, scale, views = chair
    assert data.points.std(0).mean() == pytest.approx(1)
    assert_allclose(np.linalg.norm(data.normals, axis=1), 1, atol=1e-4)
    R, t = pose[:3, :3], pose[:3, 3]
    canonical = (data.points - t) @ R / scale
    seen = np.concatenate([view.canonical[view.mask] for view in views])
    # The views do not show all of the object, so that points may lie a little outside.
    assert (canonical > seen.min(0) - 0.3).all()
    assert (canonical < seen.max(0) + 0.3).all()


def test_coordinates_of_the_object_project_onto_their_own_pixels_and_depth(chair):
    data, pose, scale, views = chair
    R, t = pose[:3, :3], pose[:3, 3]
    for frame, view in zip(data.frames, views, strict=True):
        row, col = np.nonzero(view.mask)
        points = scale * view.canonical[row, col].astype(float) @ R.T + t
        pixels, depth = frame.camera.project(points)
        assert np.abs(pixels - np.stack([col + 0.5, row + 0.5], 1)).max() < 0.02
        assert_allclose(depth, scale * view.depth[row, col], rtol=1e-4)


def test_an_export_reads_back(folder, chair):
    dataset = Co3D(folder)
    assert dataset.categories() == ["chair", "toytruck"]
    assert len(dataset.select("toytruck")) == 2
    data, *_ = chair
    assert data.name in read_labels(folder, "chair")
    assert_allclose(dataset.point_cloud("chair", data.name)[0], data.points, atol=1e-4)
    for annotation, frame in zip(dataset.frames("chair", data.name), data.frames, strict=True):
        # Files hold depth in 16 bits.
        assert_allclose(dataset.load(annotation).depth, frame.depth, rtol=1e-3)


def test_an_interrupted_export_is_completed_and_complete_sequences_stay(tmp_path, monkeypatch):
    def export_mice(out: Path) -> None:
        export_categories(["mouse"], out, 2, frames=2, seed=1, image_size=48)

    # The second of two sequences is interrupted; the first is not recorded again.
    record = Mock(wraps=record_sequence, side_effect=[DEFAULT, KeyboardInterrupt, DEFAULT])
    with monkeypatch.context() as context:
        context.setattr(export, "record_sequence", record)
        with pytest.raises(KeyboardInterrupt):
            export_mice(tmp_path / "a")
        export_mice(tmp_path / "a")
    recorded = [call.args[1] for call in record.call_args_list]
    assert recorded == [sequence_name(1, "mouse", k) for k in (0, 1, 1)]
    export_mice(tmp_path / "b")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_folders_with_other_or_damaged_settings_are_input_errors(folder, tmp_path):
    refused("was written with", export_categories, ["chair"], folder, 2, FRAMES, SEED + 1, SIZE)
    (tmp_path / "synthetic.json").write_text('{"seed": ')
    refused("synthetic.json", export_categories, ["chair"], tmp_path, 1, 2, SEED, 48)


def test_turns_after_which_a_shape_is_the_same_are_known():
    # The corners of a box on a square.
    box = np.array([[x, y, z] for x in (0, 2) for y in (0, 2) for z in (0, 1)], float)
    assert shape_turns(box) == (90, 180, 270)
    assert shape_turns(box * (2, 1, 1)) == (180,)
    assert shape_turns(np.vstack([box, [[3, 1, 0]]])) == ()


def distances_to_lines(frames, headings):
    """Return the angles in degrees, modulo 90, between headings (n, 3) and the directions of lines
    on the floor in their mean, from the background alone."""
    total = 0
    for frame in frames:
        known = (frame.mask < 0.02) & (frame.depth > 0)
        points = frame.camera.unproject(np.argwhere(known)[:, ::-1] + 0.5, frame.depth[known])
        floor = RANSACRegressor(random_state=0).fit(points[:, ::2], points[:, 1])
        normal = np.insert(floor.estimator_.coef_, 1, -1)
        # Vectors of the floor become complex numbers.
        axes = np.linalg.svd(normal[None])[2][1:].T @ [1, 1j]
        # The plane through the camera and a line of the image meets the floor in a line.
        lines = cv2.cornerEigenValsAndVecs(frame.rgb[..., 1], 5, 3)[known]
        planes = np.cross(points - frame.camera.centre, lines[:, 4:] @ frame.camera.R[:2])
        angles = np.angle(np.cross(planes, normal) @ axes)
        # Fourth powers of directions a quarter turn apart are equal.
        total += lines[:, 0] @ np.exp(4j * angles) / (headings @ axes) ** 4
    return abs(np.angle(total, deg=True)) / 4


@pytest.mark.slow
def test_lines_on_the_floor_tell_the_heading_of_the_room_and_not_of_the_object(monkeypatch):
    room = Mock(wraps=sequences.random_room)
    monkeypatch.setattr(sequences, "random_room", room)
    errors = []
    for k in range(24):
        mesh = make_object(sorted(CATEGORIES)[k % len(CATEGORIES)], k, SEED)
        # Five frames of 128 x 128 pixels.
        data, pose, _ = record_sequence(mesh, "", k, 5, 128)
        # That of the object, and that of the room.
        headings = [direction(turn, 0) for turn in (0, room.call_args.args[1])]
        errors.append(distances_to_lines(data.frames, headings @ pose[:3, :3].T))
    # Of 24 headings, those less than 5 degrees off. Errors are at most 45: by chance, one in nine.
    of_object, of_room = np.sum(np.less(errors, 5), 0)
    assert of_room >= 21
    assert of_object <= 4
