"""Data sets in the layout of CO3D: reading, writing, and files of other people's."""

import gzip
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from co3d_folders import convert_to_v2, edit_json, sequence_data
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused

from zsp_lite.data.annotations import FrameAnnotation
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.writing import write_co3d, write_depth, write_image, write_mask


@pytest.fixture
def root(tmp_path) -> Path:
    """A data folder of two sequences."""
    write_co3d(tmp_path, "chair", [sequence_data("b_2"), sequence_data("a_1", quality=0.5)])
    return tmp_path


def edit_first(root: Path, change: Callable[[dict], object]) -> None:
    """Change the entry of the frame that `first` returns, in place."""
    # `edit_json` would write what `change` returns.
    edit_json(root / "chair/frame_annotations.jgz", lambda frames: change(frames[0]) and None)


def first(root: Path) -> FrameAnnotation:
    """The first frame in the file."""
    return Co3D(root).frame("chair", "b_2", 0)


def test_a_pair_is_loaded_as_its_reference_frame_and_its_target_frames_in_order(root):
    reference, targets = Co3D(root).load_pair(Pair("chair", "a_1", 2, "b_2", (3, 0)))
    assert [frame.name for frame in (reference, *targets)] == ["a_1/2", "b_2/3", "b_2/0"]
    lost = Pair("chair", "a_1", 2, "b_2", (9,))
    refused("chair/b_2 has no frame number 9", Co3D(root).load_pair, lost)


@pytest.mark.parametrize("version", [1, 2])
def test_a_written_sequence_is_read_back(root, version):
    written = sequence_data("b_2", depth_scale_adjustment=1.7)
    write_co3d(root, "chair", [written])
    if version == 2:
        convert_to_v2(root / "chair")
    dataset = Co3D(root)
    annotations = dataset.frames("chair", "b_2")
    assert [annotation.frame_timestamp for annotation in annotations] == written.timestamps
    for annotation, expected in zip(annotations, written.frames, strict=True):
        frame = dataset.load(annotation)
        for name in ("R", "t", "focal_length", "principal_point"):
            assert_allclose(getattr(frame.camera, name), getattr(expected.camera, name), atol=1e-9)
        assert_array_equal(frame.mask, expected.mask)
        assert_allclose(frame.depth, expected.depth, rtol=2**-11)  # a float16
        # JPEG, colours at half resolution
        assert np.abs(frame.rgb.astype(int) - expected.rgb).mean() < 8
    points, colours = dataset.point_cloud("chair", "b_2")
    assert_allclose(points, written.points, rtol=1e-6)
    assert_array_equal(colours, written.colours)


def test_written_files_have_the_layout_of_co3d(root):
    names = {path.name for path in (root / "chair").iterdir()}
    assert names == {"a_1", "b_2", "frame_annotations.jgz", "sequence_annotations.jgz"}
    parts = "images/?.jpg masks/?.png depths/?.jpg.geometric.png depth_masks/?.png pointcloud.ply"
    for part in parts.replace("?", "frame000001").split():
        assert (root / "chair/a_1" / part).is_file()
    entry = json.loads(gzip.decompress((root / "chair/frame_annotations.jgz").read_bytes()))[0]
    assert entry["image"] == {"path": "chair/b_2/images/frame000001.jpg", "size": [24, 32]}
    # v1 has no format
    assert set(entry["viewpoint"]) == {"R", "T", "focal_length", "principal_point"}


def test_a_sequence_written_again_replaces_itself_and_nothing_else(root):
    write_co3d(root, "chair", [sequence_data("b_2", frames=2, quality=0.9)])
    dataset = Co3D(root)
    assert [key.sequence_name for key in dataset.frame_list("chair")] == ["a_1"] * 4 + ["b_2"] * 2
    scores = {s.sequence_name: s.point_cloud.quality_score for s in dataset.sequences("chair")}
    assert scores == {"a_1": 0.5, "b_2": 0.9}


def test_the_frame_list_keeps_file_order_and_frames_are_sorted_by_number(root):
    edit_json(root / "chair/frame_annotations.jgz", lambda frames: frames[::-1])
    dataset = Co3D(root)
    keys = [(key.sequence_name, key.frame_number) for key in dataset.frame_list("chair")]
    assert keys == [(name, number) for name in ("a_1", "b_2") for number in (3, 2, 1, 0)]
    assert [frame.frame_number for frame in dataset.frames("chair", "a_1")] == [0, 1, 2, 3]
    assert dataset.frame("chair", "a_1", 2).image.path == "chair/a_1/images/frame000003.jpg"


def test_optional_fields_may_be_null_and_unknown_ones_are_ignored(root):
    edit_first(root, lambda frame: frame.update(depth=None, mask=None, novelty={"deep": [1, 2]}))
    frame = Co3D(root).load(first(root))
    assert frame.depth is None
    assert frame.mask is None
    nothing = dict.fromkeys(("video", "point_cloud", "viewpoint_quality_score"))
    edit_json(root / "chair/sequence_annotations.jgz", lambda items: items[0].update(nothing))
    dataset = Co3D(root)
    assert [sequence.sequence_name for sequence in dataset.select("chair")] == ["a_1"]
    refused("chair/b_2 has no point cloud", dataset.point_cloud, "chair", "b_2")


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda frame: frame.pop("sequence_name"),
            r"frame_annotations\.jgz: .*missing required field `sequence_name`",
        ),
        (
            lambda frame: frame["viewpoint"].update(T=[0, float("nan"), 1]),
            r"frame 0 of b_2.*got `null` - at `\$\.viewpoint\.T",
        ),
        (
            lambda frame: frame["viewpoint"].update(R=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]),
            "frame b_2/0: camera R",
        ),
        (
            lambda frame: frame["depth"].update(scale_adjustment=0),
            r"Expected `float` > 0.* - at `\$\.depth",
        ),
        (lambda frame: frame.update(viewpoint=None), "frame b_2/0 has no viewpoint"),
    ],
)
def test_an_invalid_frame_fails_by_name_and_field(root, change, message):
    edit_first(root, change)
    refused(message, lambda: Co3D(root).load(first(root)))
    # Other sequences can be read, but for an entry that does not say of which sequence it is.
    if "`sequence_name`" not in message:
        assert len(Co3D(root).frames("chair", "a_1")) == 4


@pytest.mark.parametrize(
    "call, message",
    [
        (
            lambda root: Co3D(root / "chair/frame_annotations.jgz"),
            "frame_annotations.jgz is not a folder",
        ),
        (
            lambda root: Co3D(root).frame_list("../chair"),
            "category is '../chair', expected one of chair",
        ),
        (lambda root: Co3D(root).frames("chair", "c_3"), "no frames of 'c_3'"),
    ],
)
def test_unknown_folders_categories_sequences_and_frames_are_named(root, call, message):
    refused(message, call, root)


def test_paths_that_leave_the_folder_are_refused(root):
    for part in ("image", "depth", "mask"):
        edit_first(root, lambda frame, part=part: frame[part].update(path="chair/../../secret.jpg"))
        refused("leads out of the data folder", lambda: Co3D(root).load(first(root)))
    items = root / "chair/sequence_annotations.jgz"
    edit_json(items, lambda items: items[0]["point_cloud"].update(path="../secret.ply"))
    refused("leads out of the data folder", lambda: Co3D(root).point_cloud("chair", "b_2"))


def test_the_depth_mask_makes_depth_unknown(root):
    annotation = first(root)
    before = Co3D(root).load(annotation).depth
    allowed = np.arange(32) < np.full((24, 1), 16)
    write_mask(root / annotation.depth.mask_path, allowed)
    after = Co3D(root).load(annotation).depth
    assert_array_equal(after, np.where(allowed, before, 0))
    edit_first(root, lambda frame: frame["depth"].update(scale_adjustment=2.0, mask_path=None))
    assert_array_equal(Co3D(root).load(first(root)).depth, 2 * before)


@pytest.mark.parametrize(
    "part, write", [("image", write_image), ("depth", write_depth), ("mask", write_mask)]
)
def test_missing_files_and_files_of_another_size_are_refused(root, part, write):
    annotation = first(root)
    path = root / getattr(annotation, part).path
    load = Co3D(root).load
    path.unlink()
    refused(f"{part} .*{path.name} cannot be read", load, annotation)
    write(path, np.ones((5, 6, 3) if part == "image" else (5, 6), np.uint8))
    refused(r"is \(5, 6\) pixels, expected \(H, W\) = \(24, 32\)", load, annotation)


def test_selection_takes_the_best_clouds_above_both_bounds(tmp_path):
    # Of the views and of the clouds; the bounds are 1.25 and 0.3, and a score at one is too low.
    scores = {
        "good": (2.0, 0.9),
        "best": (1.3, 1.5),
        "fair": (2.0, 0.31),
        "blurred": (1.25, 2),
        "sparse": (3, 0.3),
    }
    sequences = [
        replace(sequence_data(name, frames=1, quality=of_cloud), viewpoint_quality=of_views)
        for name, (of_views, of_cloud) in scores.items()
    ]
    write_co3d(tmp_path, "chair", sequences)
    names = [sequence.sequence_name for sequence in Co3D(tmp_path).select("chair")]
    assert names == ["best", "good", "fair"]
