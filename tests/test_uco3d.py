"""Sequences of uCO3D become those of a data folder; what is wrong with a sequence is said in one
line."""

import re
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from uco3d_folders import RATE, STEP, WORLD, blob, write_uco3d

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_label, read_labels
from zsp_lite.importers.uco3d import import_uco3d
from zsp_lite.points import object_pixels, world_points

SAMPLES = Path(__file__).parents[1] / "data_samples"
CAR, SUV = "peugeot_308", "suv"
FRAMES = 24  # of a sequence of the sample data


@pytest.fixture(scope="module")
def uco3d(tmp_path_factory):
    """A small uCO3D of two cars of the sample data; the cameras of the second are the better
    ones."""
    return write_uco3d(tmp_path_factory.mktemp("u") / "uco3d", Co3D(SAMPLES), "car", [CAR, SUV])


@pytest.fixture
def changed(uco3d, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(uco3d, tmp_path / "changed")


@pytest.fixture(scope="module")
def imported(uco3d, tmp_path_factory):
    """The data folder to which both cars were imported, the better cameras first."""
    out = tmp_path_factory.mktemp("imported")
    results = dict(import_uco3d(uco3d, out, "car"))
    assert list(results) == [SUV, CAR]
    for result in results.values():
        assert result.frames == FRAMES
        assert result.flags == ()
        assert result.scale == pytest.approx(1 / WORLD)
    return Co3D(out)


def execute(root, statement, *values):
    """Change the metadata of a uCO3D."""
    with closing(sqlite3.connect(root / "metadata.sqlite")) as metadata, metadata:
        metadata.execute(statement, values)


def loaded(dataset, name, numbers=range(FRAMES)):
    """Frames of a car."""
    frames = dataset.frames("car", name)
    return [dataset.load(frames[number]) for number in numbers]


@pytest.mark.parametrize("name", [CAR, SUV])
def test_frames_show_the_same_points_as_those_of_the_data_folder(imported, name):
    changes = []
    for true, read in zip(loaded(Co3D(SAMPLES), name), loaded(imported, name), strict=True):
        assert_allclose(read.camera.R, true.camera.R, atol=1e-6)
        assert_allclose(read.camera.t, true.camera.t, atol=1e-5)
        # Where the surface points of the true frame are in the frame that was read.
        pixels, depth = read.camera.project(world_points(true, object_pixels(true)))
        columns, rows = pixels.astype(int).T
        centres = (pixels[:, None] - 0.5).astype(np.float32)
        colours = cv2.remap(read.rgb, centres, None, cv2.INTER_LINEAR)[:, 0]
        changes.append(np.abs(colours - true.rgb[object_pixels(true)].astype(float)).mean())
        # All but points at the silhouette, and depth up to its 16 bits.
        assert (read.mask[rows, columns] > 0.5).mean() > 0.98
        assert np.median(np.abs(read.depth[rows, columns] - depth)) < 0.002
    assert np.mean(changes) < 6  # 10 and more without the undistortion
    points, _ = imported.point_cloud("car", name)
    assert points.std(axis=0).mean() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("name", [CAR, SUV])
def test_the_alignment_of_uco3d_becomes_a_proposal_for_a_label(imported, name):
    proposal = read_label(imported.root / f"label_proposals/car/{name}.json")
    assert_allclose(proposal.trans, read_labels(SAMPLES, "car")[name].trans, atol=1e-5)
    assert not (imported.root / "class_labels").exists()


def test_the_licence_is_named_beside_the_sequences(imported):
    assert "CC BY 4.0" in (imported.root / "car/ATTRIBUTION.md").read_text()


def test_chosen_frames_are_evenly_spaced_and_have_depth_that_agrees(changed, tmp_path):
    # Every second of the 24 frames has a mask. Of these, six are chosen; two have wrong depth.
    execute(changed, f"UPDATE frame_annots SET _mask_mass = 0 WHERE frame_number % {2 * STEP} != 0")
    numbers = [4 * STEP * k for k in range(6)]
    with h5py.File(changed / "things/car/suv/depth_maps.h5", "a") as depths:
        for number, factor in ((numbers[1], 1.1), (numbers[3], 0.5)):
            depth = depths[str(number + 1)]
            depth[...] = factor * depth[...]
    ((_, result),) = import_uco3d(changed, tmp_path / "out", "car", [SUV], count=6)
    frames = Co3D(tmp_path / "out").frames("car", SUV)
    times = [numbers[k] / RATE for k in (0, 2, 4, 5)]
    assert [frame.frame_timestamp for frame in frames] == times
    assert result.flags[0].startswith("2 of 6 frames left out")


@pytest.fixture
def imports(changed, tmp_path):
    """The command that imports cars, without its options, and the folder to which it imports."""
    out = tmp_path / "out"
    return f"data import uco3d {changed} --category car --out {out}", out


def test_the_best_sequences_are_chosen_and_those_that_are_there_stay(imports, run):
    line, out = imports
    text = run(f"{line} --best 1 --frames 4")
    assert f"{out / 'car' / SUV}: 4 frames" in text
    assert CAR not in text
    before = (out / "car" / SUV / "pointcloud.ply").stat().st_mtime_ns
    text = run(f"{line} --sequences {CAR},{SUV} --frames 3")
    assert f"{out / 'car' / CAR}: 3 frames" in text
    assert SUV not in text
    assert (out / "car" / SUV / "pointcloud.ply").stat().st_mtime_ns == before
    assert "No problems." in run(f"data check {out} --deep")


def test_a_sequence_without_an_alignment_is_imported_without_a_proposal(changed, imports, run):
    line, out = imports
    execute(changed, "UPDATE sequence_annots SET _alignment_R = NULL")
    run(f"{line} --best 1 --frames 4")
    assert not (out / "label_proposals").exists()


def test_nothing_is_written_to_the_metadata(changed, tmp_path, monkeypatch):
    connect = sqlite3.connect

    def checked(*arguments, **options):
        metadata = connect(*arguments, **options)
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            metadata.execute("DELETE FROM frame_annots")
        return metadata

    monkeypatch.setattr(sqlite3, "connect", checked)
    assert len(list(import_uco3d(changed, tmp_path / "out", "car", count=4))) == 2


def refuse(root, tmp_path, expected, category="car", sequences=(SUV,)):
    """Check that an import raises an error with one line that contains a text, and writes
    nothing."""
    out = tmp_path / "out"
    refused(re.escape(expected), lambda: list(import_uco3d(root, out, category, sequences)))
    assert not out.exists()


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("_viewpoint_R", b"12345678", "_viewpoint_R has 8 bytes, expected 36 for numbers of shape"),
        ("_viewpoint_T", b"\xff" * 12, "_viewpoint_T holds nan, expected finite numbers"),
        ("_image_size", None, "Expected `bytes`, got `null` - at `$._image_size`"),
        (
            "_image_size",
            blob([120, 160], "<i4"),
            "rgb_video.mp4 is (240, 320) pixels, expected (H, W)",
        ),
        ("frame_timestamp", 1000.0, "rgb_video.mp4 ends before 1000.00 s"),
        ("_depth_scale_adjustment", 2.0, "0 of 24 frames have depth that agrees with the point"),
    ],
)
def test_a_wrong_value_of_a_frame_is_told_in_one_line(changed, tmp_path, column, value, expected):
    execute(changed, f"UPDATE frame_annots SET {column} = ?", value)
    refuse(changed, tmp_path, expected)


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        (
            "UPDATE sequence_annots SET _alignment_T = x'00'",
            "_alignment_T has 1 bytes, expected 12",
        ),
        ("UPDATE sequence_annots SET _video_path = '../x'", "leads out of the data folder"),
        ("UPDATE sequence_annots SET _video_path = NULL", "`null` - at `$._video_path`"),
        ("DELETE FROM sequence_annots", "no sequence on the disk is in the metadata"),
        ("DROP TABLE sequence_annots", "no such table: sequence_annots, expected uCO3D's tables"),
    ],
)
def test_wrong_rows_of_sequences_are_told_in_one_line(changed, tmp_path, statement, expected):
    execute(changed, statement)
    refuse(changed, tmp_path, expected)


@pytest.mark.parametrize(
    ("file", "content", "expected"),
    [
        ("depth_maps.h5", None, "depth maps "),
        ("depth_maps.h5", b"no HDF5", "expected an HDF5 file"),
        ("mask_video.mkv", b"#EXTM3U\n/etc/passwd\n", "cannot be decoded"),
        ("segmented_point_cloud.ply", b"ply\n", "is not a complete PLY file"),
        ("../../../metadata.sqlite", b"no database" * 99, "file is not a database"),
    ],
)
def test_missing_and_damaged_files_are_told_in_one_line(changed, tmp_path, file, content, expected):
    path = changed / "things/car/suv" / file
    path.unlink()
    if content is not None:
        path.write_bytes(content)
    refuse(changed, tmp_path, expected)


def test_depth_of_another_shape_is_refused(changed, tmp_path):
    with h5py.File(changed / "things/car/suv/depth_maps.h5", "w") as depths:
        depths["1"] = np.zeros((2, 3, 4))
    refuse(changed, tmp_path, "shape (2, 3, 4), expected an HDF5 file of (H, W)")


def test_a_category_or_sequence_that_is_not_on_the_disk_is_refused(uco3d, tmp_path):
    refuse(uco3d, tmp_path, "category is 'mug', expected one of car", category="mug")
    refuse(uco3d, tmp_path, f"sequence of car is 'van', expected one of {CAR}", sequences=["van"])


def test_the_missing_package_is_named(uco3d, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    refuse(uco3d, tmp_path, "is an HDF5 file, expected its package: pip install h5py")
