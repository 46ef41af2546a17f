"""One's own pair: sources opened by their path, masks, poses, report, point clouds, JSON, by
command and by call."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from synthetic_views import (
    AT_HOME,
    ELSEWHERE,
    CoordinateBackbone,
    around,
    inside,
    look_at,
    render,
    true_pose,
)
from test_importers import write_lists
from test_masks import overlap

import zsp_lite
from zsp_lite.alignment import Sim3
from zsp_lite.course.samples import sample_data
from zsp_lite.data.co3d import Pair
from zsp_lite.data.frames import write_image, write_mask
from zsp_lite.errors import InputError
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.sources import open_pair, open_source, spread
from zsp_lite.io.ply import read_ply
from zsp_lite.metrics import rotation_error
from zsp_lite.own_objects import estimate_pose, write_pair
from zsp_lite.pipeline import ZeroShotPose

pytestmark = pytest.mark.slow

INTRINSICS = (190.0, 190.0, 90.0, 70.0)


@pytest.fixture(scope="module")
def frames():
    """Four views around an object, in metres."""
    return around(AT_HOME, 4)


@pytest.fixture
def image(tmp_path, frames):
    return write_picture(tmp_path / "cup.jpg", frames[0])


def write_picture(path, frame, mask=True):
    write_image(path, frame.rgb, 98)
    cv2.imwrite(
        str(path.with_name(f"{path.stem}_depth.png")), np.rint(1000 * frame.depth).astype(np.uint16)
    )
    if mask:
        write_mask(path.with_name(f"{path.stem}_mask.png"), frame.mask)
    return path


def test_a_sequence_of_a_data_folder_is_read_with_its_numbers_and_masks(ellipsoids, monkeypatch):
    source = open_source(ellipsoids.root / "ellipsoid/b")
    assert (source.format, source.mask, source.numbers) == (
        "sequence",
        "given",
        (0, 1, 2, 3, 4, 5, 6),
    )
    assert spread(3, 7) == [0, 2, 4] and spread(50, 7) == [0, 1, 2, 3, 4, 5, 6]
    assert source.select(1, 3, 5)[:2] == ([5], [0, 2, 4]) and source.select(2, 1)[:2] == (
        [0, 3],
        [0],
    )
    frame = source.select(1, 3, 5)[2][5]
    expected = ellipsoids.load(ellipsoids.frame("ellipsoid", "b", 5))
    assert_array_equal(frame.rgb, expected.rgb)
    assert_array_equal(frame.mask, expected.mask)
    assert source.describe([0, 2]).endswith(f"{Path('ellipsoid/b')}, frames 0, 2")
    refused("no frame 7, expected one of 7 from 0 to 6", source.select, 1, 1, 7)
    monkeypatch.chdir(source.path)
    assert open_source(".").name == "b"


def test_a_box_gives_masks_to_every_frame(tmp_path, frames):
    write_lists(tmp_path, frames)
    inside = np.argwhere(frames[0].mask > 0)
    (top, left), (bottom, right) = inside.min(axis=0) - 4, inside.max(axis=0) + 5
    source = open_source(tmp_path, box=(int(top), int(left), int(bottom - top), int(right - left)))
    assert source.mask == "box"
    masked = source.load([3, 1])
    assert [frame.name for frame in masked] == ["0003.jpg", "0001.jpg"]
    assert min(overlap(masked[k].mask, frames[n].mask > 0.5) for k, n in enumerate((3, 1))) > 0.7


def test_options_go_to_the_sources_that_take_them(image, tmp_path, ellipsoids, frames):
    other = write_picture(tmp_path / "mug.jpg", frames[1], mask=False)
    sequence = ellipsoids.root / "ellipsoid/a"
    wide = (100.0, 100.0, 90.0, 70.0)
    pair = open_pair(image, other, {"intrinsics": (INTRINSICS, wide), "mask": ("auto",), "box": ()})
    assert [one.load([0])[0].camera.focal_length[0] for one in pair] == [190, 100]
    assert [one.mask for one in pair] == ["auto", "auto"]
    pair = open_pair(image, other, {"intrinsics": (INTRINSICS,), "box": ((1, 2, 30, 40),)})
    assert [one.box for one in pair] == [(1, 2, 30, 40), None]
    ways = {"intrinsics": (INTRINSICS,), "mask": ("given", "box"), "box": ((1, 2, 30, 40),)}
    assert [(one.mask, one.box) for one in open_pair(image, other, ways)] == [
        ("given", None),
        ("box", (1, 2, 30, 40)),
    ]
    pair = open_pair(
        image, sequence, {"intrinsics": (INTRINSICS,), "depth": (tmp_path / "mug_depth.png",)}
    )
    assert_allclose(pair[0].load([0])[0].depth, frames[1].depth, atol=6e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "no intrinsics, expected --intrinsics FX,FY,CX,CY"),
        ({"intrinsics": INTRINSICS, "mask": "box"}, "--mask box with --box TOP,LEFT,HEIGHT,WIDTH"),
        (
            {"intrinsics": INTRINSICS, "mask": "auto", "box": (1, 1, 9, 9)},
            "mask is 'auto' and box is .*, expected --mask",
        ),
        (
            {"intrinsics": (0.0, 190.0, 1.0, 1.0)},
            "image .*.jpg: camera focal_length is 0.0, expected",
        ),
        (
            {"intrinsics": (1.0, 1.0, 90.0, 70.0)},
            ".jpg: the intrinsics 1,1,90,70 have a field of view of 179 degrees",
        ),
        ({"intrinsics": INTRINSICS, "depth": "lost.png"}, "lost.png"),
    ],
)
def test_what_an_image_lacks_is_named_with_the_option_that_gives_it(image, options, message):
    refused(message, lambda: open_source(image, **options).load([0]))


def test_masks_and_depth_that_are_not_there_are_named_with_the_option_that_cures(tmp_path, frames):
    bare = write_picture(tmp_path / "bare.jpg", frames[0], mask=False)
    with pytest.raises(
        InputError,
        match="no mask, expected masks named like the images, --mask auto or --box "
        "TOP,LEFT,HEIGHT,WIDTH",
    ):
        open_source(bare, INTRINSICS, mask="given").load([0])
    (tmp_path / "bare_depth.png").unlink()
    refused(
        "bare_depth.png or bare_depth.npy beside it, expected .* --depth FILE",
        open_source,
        bare,
        INTRINSICS,
    )


def test_paths_that_are_no_source_are_refused(tmp_path, ellipsoids, frames):
    (tmp_path / "notes.txt").write_text("x")
    for path, message in (
        (tmp_path / "nowhere", "nowhere does not exist, expected a picture .*, CATEGORY/SEQUENCE"),
        (tmp_path / "notes.txt", "notes.txt has another format, expected"),
        (ellipsoids.root / "ellipsoid", "has another format, expected .* CATEGORY/SEQUENCE"),
        (ellipsoids.root / "ellipsoid/c", "does not exist"),
        (tmp_path, r"nerfstudio, .*\(transforms\*.json\); .*lists \(poses.txt\)"),
    ):
        refused(message, open_source, path)


def test_options_that_no_source_takes_are_refused(ellipsoids, image):
    sequence = ellipsoids.root / "ellipsoid/a"
    refused(
        "--depth-unit does not go with .* of the format sequence",
        open_source,
        sequence,
        depth_unit=1.0,
    )
    refused(
        "--mask: 3 values with .*, expected 1 or 2",
        open_pair,
        sequence,
        sequence,
        {"mask": ("auto",) * 3},
    )
    with pytest.raises(InputError, match="--depth: 1 values with image and image, expected 2"):
        open_pair(image, image, {"intrinsics": (INTRINSICS,), "depth": ("z.png",)})


@pytest.fixture(scope="module")
def own(ellipsoids, tmp_path_factory):
    """Both solvers on two labelled sequences, and the folder of their files."""
    out = tmp_path_factory.mktemp("own") / "deep" / "out"
    settings = {"reference_frame": 2, "targets": 3, "backbone": CoordinateBackbone(), "out": out}
    return estimate_pose(
        *(ellipsoids.root / "ellipsoid" / name for name in "ab"), "both", **settings
    ), out


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Two pictures of one object, elsewhere in the second, and its true pose.

    The second has no mask.
    """
    folder = tmp_path_factory.mktemp("pictures")
    first, second = look_at((1, 0.3, 0.3)), look_at(ELSEWHERE.R @ (1, 0.6, 0.4))
    write_picture(folder / "cup.jpg", render(first, AT_HOME))
    write_picture(folder / "mug.jpg", render(second, ELSEWHERE), mask=False)
    return folder / "cup.jpg", folder / "mug.jpg", true_pose(first, AT_HOME, second, ELSEWHERE)


def test_the_aligned_cloud_lies_on_the_target_object_in_its_world(own, ellipsoids):
    found, out = own
    names = ["aligned_paper.ply", "aligned_verified.ply", "report.html", "target.ply"]
    assert sorted(path.name for path in out.iterdir()) == names
    # Sequence b is the object of the test's renderer, rotated and shifted.
    label = zsp_lite.labels.read_labels(ellipsoids.root, "ellipsoid")["b"].trans
    clouds = {path.stem: read_ply(path) for path in out.glob("*.ply")}
    for name, (points, colours) in clouds.items():
        at_home = (points - label[:3, 3]) @ label[:3, :3]
        assert len(points) > 500 and np.abs(inside(at_home)).mean() < (
            0.05 if name == "target" else 0.15
        ), name
        assert len(np.unique(colours, axis=0)) > 100


def test_both_solvers_are_right_and_stand_in_the_representation(own):
    found, _ = own
    assert list(found.errors) == ["paper", "verified"] and max(found.errors.values()) < 25
    assert "paper: PoseEstimate(" in repr(found) and "verified: PoseEstimate(" in repr(found)


def test_json_has_every_number_of_the_estimates(own):
    found, _ = own
    content = json.loads(json.dumps(found.as_json(), allow_nan=False))
    assert (
        content["target"]["views"] == ["b/0", "b/2", "b/4"]
        and content["reference"]["masks"] == "given"
    )
    for solver, estimate in found.estimates.items():
        one = content["estimates"][solver]
        assert_array_equal(one["matrix"], estimate.sim3.matrix)
        assert_allclose(one["scale"] * np.array(one["rotation"]), np.array(one["matrix"])[:3, :3])
        assert one["view_name"] == found.targets[one["view"]].name and one["flags"] == list(
            estimate.flags
        )
        assert (
            one["error_degrees"] == found.errors[solver]
            and one["confidence"] == estimate.confidence
        )
        assert one["one_of_two"] == estimate.one_of_two
        for other, alternative in zip(one["alternatives"], estimate.alternatives, strict=True):
            assert other["probability"] == alternative.confidence > 0
            assert_array_equal(other["matrix"], alternative.sim3.matrix)
        assert len(one["alternatives"]) > 0 or solver == "paper"
    assert content["degrees_between_solvers"] == found.disagreement < 20


def test_where_the_answer_is_one_of_two_both_clouds_are_written(own, tmp_path, monkeypatch):
    monkeypatch.setattr("zsp_lite.viz.report.write_report", lambda path, *_, **__: path)
    found, out = own
    doubtful = replace(found.estimates["verified"], one_of_two=True)
    pair = replace(found, estimates={"verified": doubtful})
    names = ["report.html", "target.ply", "aligned_verified.ply", "aligned_verified_2.ply"]
    assert [path.name for path in write_pair(pair, tmp_path)] == names
    (first, _), (second, _) = (
        read_ply(tmp_path / f"aligned_verified{name}.ply") for name in ("", "_2")
    )
    assert_array_equal(first, read_ply(out / "aligned_verified.ply")[0])
    other = doubtful.alternatives[0]
    points = found.targets[doubtful.view].camera.to_camera(first)
    expected = found.targets[other.view].camera.to_world(
        other.sim3.apply(doubtful.sim3.inverse().apply(points))
    )
    assert_allclose(second, expected, atol=1e-3)


def test_two_pictures_give_the_true_pose_whatever_the_unit_of_length(pictures):
    """Lengths are scaled to those of CO3D, and those of the result are the capture's."""
    cup, mug, truth = pictures
    results = [
        zsp_lite.estimate_pose(
            cup,
            open_source(mug, INTRINSICS, depth_unit=unit, mask="auto"),
            "paper",
            intrinsics=INTRINSICS,
            backbone=CoordinateBackbone(),
        )
        for unit in (0.001, 1.0)
    ]
    assert all(
        one.masks == ("given", "auto") and one.errors == {} and np.isnan(one.error)
        for one in results
    )
    metres, millimetres = (one.estimates["paper"] for one in results)
    assert rotation_error(metres.sim3.R, truth.R) < 20 and metres.sim3.scale == pytest.approx(
        truth.scale, rel=0.2
    )
    assert_array_equal(metres.inliers, millimetres.inliers)
    assert [
        any("from the camera" in flag for flag in one.flags) for one in (metres, millimetres)
    ] == [False, True]
    assert rotation_error(metres.sim3.R, millimetres.sim3.R) < 0.1
    assert millimetres.sim3.scale == pytest.approx(1000 * metres.sim3.scale, rel=1e-3)
    assert_allclose(millimetres.sim3.t, 1000 * metres.sim3.t, rtol=1e-2)
    for estimate, unit in (
        (metres, 1),
        (millimetres, 1000),
    ):  # points are in the units of the capture
        source, target = (points[estimate.inliers] for points in estimate.points)
        assert np.linalg.norm(estimate.sim3.apply(source) - target, axis=1).max() < 0.3 * unit


def test_a_capture_is_a_target_of_several_views_without_those_that_are_black_or_empty(
    pictures, tmp_path
):
    cup, _, _ = pictures
    views = around(ELSEWHERE, 6)
    views[2] = replace(views[2], rgb=np.zeros_like(views[2].rgb))
    views[3] = replace(views[3], mask=np.zeros_like(views[3].mask))
    write_lists(tmp_path, views, masks=True)
    found = estimate_pose(
        cup, tmp_path, targets=6, intrinsics=INTRINSICS, backbone=CoordinateBackbone()
    )
    estimate = found.estimates["verified"]
    truth = true_pose(look_at((1, 0.3, 0.3)), AT_HOME, views[estimate.view].camera, ELSEWHERE)
    assert found.masks[1] == "given" and rotation_error(estimate.sim3.R, truth.R) < 15
    assert estimate.flags[-2:] == (
        "0002.jpg left out: black image",
        "0003.jpg left out: empty object mask",
    )
    assert [vote.name.split()[1] for vote in found.votes[1:]] == ["0", "1", "4", "5"]


def test_several_frames_of_both_objects_agree_on_the_similarity_between_their_worlds(ellipsoids):
    """The same from a data folder and from frames in memory, in other units, and by threads."""
    folder = ellipsoids.root / "ellipsoid"
    label = zsp_lite.labels.read_labels(ellipsoids.root, "ellipsoid")["b"].trans
    settings = {"targets": 3, "references": 2, "backbone": CoordinateBackbone()}
    found = estimate_pose(folder / "a", folder / "b", **settings)
    assert [vote.name for vote in found.votes] == [
        "frame 0 of a",
        "frame 3 of a",
        "frame 0 of b",
        "frame 3 of b",
    ]
    assert rotation_error(found.world_sim3.R, label[:3, :3]) < 5
    # The object looks alike from two sides: frame 0 alone is wrong.
    against = [vote.name for vote in found.votes if vote.degrees > 30]
    assert found.estimate.flags == (f"2 of 4 frames vote for another pose: {', '.join(against)}",)
    assert against == ["frame 0 of a", "frame 0 of b"] and found.errors["verified"] < 5
    camera = found.targets[found.estimate.view].camera
    expected = Sim3(1.0, camera.R, camera.t) @ found.world_sim3
    reference = Sim3(1.0, found.reference.camera.R, found.reference.camera.t)
    assert_allclose((found.estimate.sim3 @ reference).matrix, expected.matrix, atol=1e-9)
    frames = [
        [ellipsoids.load(one) for one in ellipsoids.frames("ellipsoid", name)] for name in "ab"
    ]
    larger = [scale_frame(frame, 1000.0) for frame in frames[1]]
    again = estimate_pose(frames[0], larger, **settings, workers=2)
    assert (
        again.errors == {} and len(again.estimate.flags) == 1 and again.masks == ("given", "given")
    )
    assert rotation_error(again.world_sim3.R, found.world_sim3.R) < 3
    assert again.world_sim3.scale == pytest.approx(1000 * found.world_sim3.scale, rel=0.05)
    numbers = found.as_json()
    assert_array_equal(numbers["estimates"]["verified"]["world_matrix"], found.world_sim3.matrix)
    assert [one["frame"] for one in numbers["votes"]] == [vote.name for vote in found.votes]


def test_one_reference_frame_is_the_papers_setting(ellipsoids):
    folder = ellipsoids.root / "ellipsoid"
    pair = Pair("ellipsoid", "a", 2, "b", (0, 2, 4))
    expected = ZeroShotPose(CoordinateBackbone(), solver="verified").estimate(
        *ellipsoids.load_pair(pair)
    )
    for choice in ({"reference_frame": 2}, {"reference_frame": 2, "references": 1}):
        found = estimate_pose(
            folder / "a", folder / "b", targets=3, backbone=CoordinateBackbone(), **choice
        )
        assert (
            np.array_equal(found.estimate.sim3.matrix, expected.sim3.matrix) and found.votes == ()
        )
    found = estimate_pose(
        folder / "a", folder / "b", targets=3, backbone=CoordinateBackbone(), references=1
    )
    assert found.reference.name == "a/0" and found.votes == ()


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], r"frames are \[\], expected a sequence of zsp_lite.Frame"),
        ([1.0], r"frames are \[1.0\], expected"),
        ("same", "all 2 frames have one camera pose, expected their poses in one world"),
        ("no depth", "frame 0 0000 has no depth map, expected one"),
    ],
)
def test_frames_that_are_no_views_of_one_object_are_refused(frames, message):
    first = around(AT_HOME, 1)[0]
    frames = {"same": [first, first], "no depth": [replace(first, depth=None)]}.get(
        str(frames), frames
    )
    refused(message, open_source, frames)


def test_a_target_that_is_seen_from_one_side_is_flagged(pictures, tmp_path):
    cup, mug, _ = pictures
    write_lists(tmp_path, around(ELSEWHERE, 5, 90))
    options = {"mask": "auto", "intrinsics": INTRINSICS, "backbone": CoordinateBackbone()}
    for target, degrees in ((mug, "0"), (tmp_path, "7[0-5]")):
        (flag,) = estimate_pose(cup, target, "paper", **options).estimates["paper"].flags
        assert re.fullmatch(
            rf"the target was seen from one side only \({degrees} degrees\): if .* is wrong", flag
        )


def test_objects_of_two_categories_are_flagged():
    car, chair = (sample_data() / name for name in ("car/suv", "chair/classroom_chair"))
    first, *_ = (
        estimate_pose(car, chair, "paper", targets=1, backbone=CoordinateBackbone())
        .estimates["paper"]
        .flags
    )
    assert first == "the objects are of different categories: car, chair"


def test_depth_in_another_unit_is_questioned(image, frames, tmp_path):
    np.save(tmp_path / "z.npy", frames[0].depth)  # in metres
    for unit, questioned in ((None, True), (30.0, True), (1.0, False)):
        source = open_source(image, INTRINSICS, depth=tmp_path / "z.npy", depth_unit=unit)
        (frame,) = source.load([0])
        flags = "; ".join(source.flags([frame]))
        assert (
            questioned
            == ("m from the camera, expected 0.05 to 20 m; " in flags)
            == ("--depth-unit" in flags)
        )
    assert_array_equal(frame.depth, frames[0].depth)


def test_the_command_prints_the_poses_and_names_its_files(loaded, ellipsoids, tmp_path, run):
    folder = ellipsoids.root / "ellipsoid"
    words = [str(folder / "a"), str(folder / "b"), "--targets", "3", "--out", str(tmp_path)]
    text = run(["estimate", *words, "--solver", "both", "--reference-frame", "2"])
    assert (
        f"{Path('ellipsoid/a')}, frame 2 (mask: given)" in text
        and "The rotations of both solvers differ by" in text
    )
    for name in ("report.html", "target.ply", "aligned_paper.ply", "aligned_verified.ply"):
        assert (
            f"Written: {tmp_path / name}" in text.replace("\n", "") and (tmp_path / name).is_file()
        )


def test_the_command_prints_json_alone_or_that_there_are_no_labels(
    loaded, pictures, tmp_path, monkeypatch, run
):
    cup, mug, _ = pictures
    monkeypatch.setattr("zsp_lite.viz.report.write_report", lambda path, *_, **__: path)
    words = [
        "--intrinsics",
        ",".join(map(str, INTRINSICS)),
        "--solver",
        "paper",
        "--out",
        str(tmp_path),
    ]
    content = json.loads(
        run(["estimate", str(cup), str(mug), *words, *"--mask given --mask auto --json".split()])
    )
    assert content["estimates"]["paper"]["error_degrees"] is None
    assert (content["reference"]["masks"], content["target"]["masks"]) == ("given", "auto")
    assert content["files"] == [
        str(tmp_path / name) for name in ("report.html", "target.ply", "aligned_paper.ply")
    ]
    text = run(["estimate", str(cup), str(mug), *words])
    assert "No pose labels: the rotation error is unknown." in text and "error:" not in text
    assert (
        "(masks: auto)" in text
        and "flag: the target was seen from one side only (0 degrees)" in text
    )
