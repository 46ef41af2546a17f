"""One's own pair: sources opened by their path, masks, poses, report, point clouds, JSON, by
command and by call."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from captures import write_depth16, write_lists
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from synthetic_views import (
    AT_HOME,
    ELSEWHERE,
    CoordinateBackbone,
    around,
    inside,
    look_at,
    overlap,
    render,
    true_pose,
)

import zsp_lite
from zsp_lite import Frame, PoseEstimate, ZeroShotPose, estimate_pose, open_source
from zsp_lite.course.samples import sample_data
from zsp_lite.data.co3d import Pair
from zsp_lite.data.evaluation import spread
from zsp_lite.data.labels import read_labels
from zsp_lite.data.writing import write_image, write_mask
from zsp_lite.errors import Contradiction, NoPoseError
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.sources import Source, open_pair
from zsp_lite.io.ply import read_ply
from zsp_lite.metrics import rotation_error
from zsp_lite.objects.estimate import write_pair
from zsp_lite.scans.pair_result import PairResult

slow = pytest.mark.slow

INTRINSICS = (190.0, 190.0, 90.0, 70.0)  # of all rendered pictures


@pytest.fixture(scope="module")
def views():
    """Four views around an object, in metres."""
    return around(AT_HOME, 4)


@pytest.fixture
def image(tmp_path, views) -> Path:
    """A picture with depth and mask beside it."""
    return write_picture(tmp_path / "cup.jpg", views[0])


def write_picture(path: Path, frame: Frame, mask: bool = True) -> Path:
    """Write a picture with its depth and, if wanted, its mask; returns its path."""
    write_image(path, frame.rgb, quality=98)
    write_depth16(path.with_name(f"{path.stem}_depth.png"), frame.depth)
    if mask:
        write_mask(path.with_name(f"{path.stem}_mask.png"), frame.mask)
    return path


@pytest.fixture
def sequence(ellipsoids) -> Source:
    """A sequence of seven frames."""
    return open_source(ellipsoids.root / "ellipsoid/b")


def test_frames_are_chosen_evenly_or_by_number(sequence):
    assert spread(3, 7) == [0, 2, 4]
    assert spread(50, 7) == list(range(7))
    usable, frames = sequence.select(3, references=True)
    assert usable == list(frames) == [0, 2, 4]
    # Every second one from 5 on, round all seven.
    assert sequence.select(3, references=True, first=5)[0] == [5, 0, 2]
    refused("frame is 7, expected one of 0, 1, 2, 3", sequence.select, 1, True, first=7)


def test_a_sequence_is_described_by_its_folder(sequence, monkeypatch):
    assert f"{Path('ellipsoid/b')}, frames 0, 3; " in sequence.describe(*sequence.select(2, True))
    monkeypatch.chdir(sequence.path)
    assert open_source(".").name == "b"


def test_an_image_is_described_by_the_size_that_its_intrinsics_give_to_the_object(image):
    source = open_source(image, INTRINSICS)
    # It is 89 pixels wide, and a little farther at its sides.
    size = "the object in cup.jpg is 1.55 m wide and 3.21 m away"
    assert source.describe(*source.select(1, references=True)).endswith(size)


def test_a_box_gives_masks_to_every_frame(tmp_path, views):
    write_lists(tmp_path, views)
    on_object = np.argwhere(views[0].mask > 0)
    # With a margin of four pixels around the object.
    top, left = (on_object.min(axis=0) - 4).tolist()
    bottom, right = (on_object.max(axis=0) + 5).tolist()
    source = open_source(tmp_path, box=(top, left, bottom - top, right - left))
    assert source.mask == "box"
    masked = source.load([3, 1])
    assert [frame.name for frame in masked] == ["0003.jpg", "0001.jpg"]
    for found, view in zip(masked, (views[3], views[1])):
        assert overlap(found.mask, view.mask > 0.5) > 0.7


def test_options_go_to_the_sources_that_take_them(image, tmp_path, ellipsoids, views):
    other = write_picture(tmp_path / "mug.jpg", views[1], mask=False)
    wide, box = (100.0, 100.0, 90.0, 70.0), (1, 2, 30, 40)
    pair = open_pair(image, other, {"intrinsics": (INTRINSICS, wide), "mask": ("auto",), "box": ()})
    assert [one.load([0])[0].camera.focal_length[0] for one in pair] == [190, 100]
    assert [one.mask for one in pair] == ["auto", "auto"]
    pair = open_pair(image, other, {"intrinsics": (INTRINSICS,), "box": (box,)})
    assert [one.box for one in pair] == [box, None]  # a single box is for the first path
    ways = {"intrinsics": (INTRINSICS,), "mask": ("given", "box"), "box": (box,)}
    pair = open_pair(image, other, ways)
    assert [(one.mask, one.box) for one in pair] == [("given", None), ("box", box)]
    depth = {"intrinsics": (INTRINSICS,), "depth": (tmp_path / "mug_depth.png",)}
    first, _ = open_pair(image, ellipsoids.root / "ellipsoid/a", depth)
    # Depth is stored in millimetres.
    assert_allclose(first.load([0])[0].depth, views[1].depth, atol=6e-4)


@pytest.mark.parametrize(
    "options, message",
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


def test_masks_and_depth_that_are_not_there_are_named_with_the_option_that_cures(tmp_path, views):
    bare = write_picture(tmp_path / "bare.jpg", views[0], mask=False)
    cure = "expected masks named like the images, --mask auto or --box TOP,LEFT,HEIGHT,WIDTH"
    refused(f"no mask, {cure}", lambda: open_source(bare, INTRINSICS, mask="given").load([0]))
    (tmp_path / "bare_depth.png").unlink()
    message = "bare_depth.png or bare_depth.npy beside it, expected .* --depth FILE"
    refused(message, open_source, bare, INTRINSICS)


@pytest.mark.parametrize(
    "path, message",
    [
        ("nowhere", "nowhere does not exist, expected a picture .*, CATEGORY/SEQUENCE"),
        ("notes.txt", "notes.txt has another format, expected"),
        ("ellipsoid", "has another format .*, expected .* CATEGORY/SEQUENCE"),
        ("ellipsoid/c", "does not exist"),
        (".", r"nerfstudio, .*\(transforms\*.json\); .*lists \(poses.txt\)"),
    ],
)
def test_paths_that_are_no_source_are_refused(tmp_path, ellipsoids, path, message):
    (tmp_path / "notes.txt").write_text("x")
    root = ellipsoids.root if path.startswith("ellipsoid") else tmp_path
    refused(message, open_source, root / path)


def test_options_that_no_source_takes_are_refused(sequence, image):
    path = sequence.path
    message = "--depth-unit does not go with .* of the format sequence"
    refused(message, open_source, path, depth_unit=1.0)
    message = "--mask: 3 values with .*, expected 1 or 2"
    refused(message, open_pair, path, path, {"mask": ("auto",) * 3})
    one_depth = {"intrinsics": (INTRINSICS,), "depth": ("z.png",)}
    message = "--depth: 1 values with image and image, expected 2"
    refused(message, open_pair, image, image, one_depth)


@pytest.fixture(scope="module")
def own(ellipsoids, tmp_path_factory):
    """Both solvers on two labelled sequences, and the folder of their files."""
    out = tmp_path_factory.mktemp("own") / "deep/out"
    settings = {"reference_frame": 2, "targets": 3, "backbone": CoordinateBackbone(), "out": out}
    folder = ellipsoids.root / "ellipsoid"
    return estimate_pose(folder / "a", folder / "b", "both", **settings), out


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


# Largest mean distances to the object, as `inside` measures them: of the target's own points, and
# of the reference's by the poses of either solver.
REACHED = {"target": 0.05, "aligned_paper": 0.15, "aligned_verified": 0.15}


@slow
def test_the_aligned_cloud_lies_on_the_target_object_in_its_world(own, ellipsoids):
    _, out = own
    names = {f"{name}.ply" for name in REACHED}
    assert {path.name for path in out.iterdir()} == {"report.html", *names}
    # Sequence b is the object of the test's renderer, rotated and shifted.
    label = read_labels(ellipsoids.root, "ellipsoid")["b"].trans
    for name, most in REACHED.items():
        points, colours = read_ply(out / f"{name}.ply")
        assert len(points) > 500, name
        assert len(np.unique(colours, axis=0)) > 100, name
        at_home = (points - label[:3, 3]) @ label[:3, :3]
        assert np.abs(inside(at_home)).mean() < most, name


@slow
def test_json_has_the_numbers_of_the_pair_and_of_each_solver(own):
    found, _ = own
    content = json.loads(json.dumps(found.as_json(), allow_nan=False))
    assert content["target"]["views"] == ["b/0", "b/2", "b/4"]
    assert content["degrees_between_solvers"] == found.disagreement < 20
    for solver, estimate in found.estimates.items():
        numbers = content["estimates"][solver]
        assert numbers["view_name"] == found.targets[estimate.view].name
        assert numbers["error_degrees"] == found.errors[solver] < 25
        assert numbers["matrix"] == estimate.sim3.matrix.tolist()
        scaled = np.multiply(numbers["scale"], numbers["rotation"])
        assert_allclose(scaled, estimate.sim3.matrix[:3, :3])


@pytest.fixture
def without_report(monkeypatch):
    """Writes no report, whose pictures take seconds; its path is still named."""
    monkeypatch.setattr("zsp_lite.viz.report.write_report", lambda path, *_, **__: path)


@slow
def test_where_the_answer_is_one_of_two_both_clouds_are_written(own, tmp_path, without_report):
    found, out = own
    doubtful = replace(found.estimates["verified"], one_of_two=True)
    pair = replace(found, estimates={"verified": doubtful})
    names = ["report.html", "target.ply", "aligned_verified.ply", "aligned_verified_2.ply"]
    assert [path.name for path in write_pair(pair, tmp_path)] == names
    first, _ = read_ply(tmp_path / "aligned_verified.ply")
    second, _ = read_ply(tmp_path / "aligned_verified_2.ply")
    assert_array_equal(first, read_ply(out / "aligned_verified.ply")[0])
    # Back to the reference's camera by the first pose, and into the world by the second.
    other = doubtful.alternatives[0]
    in_target = found.targets[doubtful.view].camera.to_camera(first)
    by_other = other.sim3.apply(doubtful.sim3.inverse().apply(in_target))
    expected = found.targets[other.view].camera.to_world(by_other)
    assert_allclose(second, expected, atol=1e-3)


@pytest.fixture(scope="module")
def metres(pictures) -> PairResult:
    """The two pictures with depth in metres."""
    return in_unit(pictures, 0.001)


def in_unit(pictures: tuple, unit: float) -> PairResult:
    """The two pictures, where a step of the second depth map is `unit` long."""
    cup, mug, _ = pictures
    target = open_source(mug, INTRINSICS, depth_unit=unit, mask="auto")
    return zsp_lite.estimate_pose(
        cup, target, "paper", intrinsics=INTRINSICS, backbone=CoordinateBackbone()
    )


def residuals(estimate: PoseEstimate) -> np.ndarray:
    """Distances of the inliers, in the units of the target."""
    source, target = [points[estimate.inliers] for points in estimate.points]
    return np.linalg.norm(estimate.sim3.apply(source) - target, axis=1)


@slow
def test_two_pictures_give_the_true_pose(pictures, metres):
    *_, truth = pictures
    estimate = metres.estimates["paper"]
    assert rotation_error(estimate.sim3.R, truth.R) < 20
    assert_allclose(estimate.sim3.scale, truth.scale, rtol=0.2)
    assert residuals(estimate).max() < 0.3
    assert metres.masks == ("given", "auto")


@slow
def test_the_result_has_the_unit_of_length_of_the_capture(pictures, metres):
    """Lengths are scaled to those of CO3D, and those of the result are the capture's."""
    one = metres.estimates["paper"]
    other = in_unit(pictures, 1.0).estimates["paper"]  # millimetres
    assert_array_equal(one.inliers, other.inliers)
    assert rotation_error(one.sim3.R, other.sim3.R) < 0.1
    assert_allclose(other.sim3.scale, 1000 * one.sim3.scale, rtol=1e-3)
    assert_allclose(other.sim3.t, 1000 * one.sim3.t, rtol=1e-2)
    assert residuals(other).max() < 300


@slow
def test_a_captures_target_views_are_those_that_are_not_black_or_empty(pictures, tmp_path):
    cup, _, _ = pictures
    views = around(ELSEWHERE, 6)
    views[2] = replace(views[2], rgb=np.zeros_like(views[2].rgb))
    views[3] = replace(views[3], mask=np.zeros_like(views[3].mask))
    write_lists(tmp_path, views, masks=True)
    found = estimate_pose(
        cup, tmp_path, targets=6, intrinsics=INTRINSICS, backbone=CoordinateBackbone()
    )
    assert found.masks[1] == "given"
    black, empty = found.estimate.flags[-2:]
    assert black == "0002.jpg left out: black image"
    assert empty == "0003.jpg left out: empty object mask"
    # In the order in which they are asked: the first two show different sides.
    assert [vote.name.split()[1] for vote in found.votes[1:]] == ["0", "4", "1", "5"]


ONE = around(AT_HOME, 1)[0]
LOST = Frame.from_arrays(
    ONE.rgb, ONE.depth, ONE.camera.K, pose=np.full((3, 4), np.nan), name="lost"
)
SEVERAL = {"targets": 7, "references": 2, "backbone": CoordinateBackbone()}


@pytest.fixture(scope="module")
def several(ellipsoids) -> PairResult:
    """Several frames of both objects."""
    folder = ellipsoids.root / "ellipsoid"
    return estimate_pose(folder / "a", folder / "b", **SEVERAL)


@slow
def test_several_frames_of_both_objects_agree_on_the_similarity_between_their_worlds(
    several, ellipsoids
):
    label = read_labels(ellipsoids.root, "ellipsoid")["b"].trans
    assert rotation_error(several.world_sim3.R, label[:3, :3]) < 5
    assert several.errors["verified"] < 5


@slow
def test_a_first_frame_that_determines_no_pose_leaves_the_answer_to_the_others(
    several, ellipsoids, monkeypatch
):
    solve = ZeroShotPose.estimate_from_views
    failures = iter([NoPoseError("few points")])

    def first_fails(*arguments):
        for failure in failures:
            raise failure
        return solve(*arguments)

    monkeypatch.setattr(ZeroShotPose, "estimate_from_views", first_fails)
    folder = ellipsoids.root / "ellipsoid"
    found = estimate_pose(folder / "a", folder / "b", **SEVERAL)
    assert len(found.votes) == len(several.votes) - 1
    assert rotation_error(found.world_sim3.R, several.world_sim3.R) < 5  # degrees


@slow
def test_frames_that_vote_for_another_pose_are_named(several):
    names = [vote.name for vote in several.votes]
    # Two frames of each object are asked, as SEVERAL says.
    assert names == ["frame 0 of a", "frame 3 of a", "frame 0 of b", "frame 3 of b"]
    # The object looks alike from two sides: frame 0 alone is wrong.
    against = [vote.name for vote in several.votes if vote.degrees > 30]
    assert against == ["frame 0 of b"]
    assert "1 of 4 frames vote for another pose: frame 0 of b" in several.estimate.flags
    content = several.as_json()
    assert [one["frame"] for one in content["votes"]] == names
    matrix = content["estimates"]["verified"]["world_matrix"]
    assert_array_equal(matrix, several.world_sim3.matrix)


@pytest.fixture
def in_memory(ellipsoids) -> list[list[Frame]]:
    """The frames of both sequences."""
    return [[ellipsoids.load(one) for one in ellipsoids.frames("ellipsoid", name)] for name in "ab"]


@slow
def test_a_contradiction_limits_the_probability_of_every_pose(in_memory, monkeypatch):
    # Every confidence is below this, so that the note on low ones is there.
    monkeypatch.setattr("zsp_lite.objects.estimate._LEAST_CONFIDENT", 1.1)
    first, second = in_memory
    # Three frames of the second object.
    flat = [replace(one, depth=np.where(one.depth > 0, 4, one.depth)) for one in second[::3]]
    found = estimate_pose(first, flat, **SEVERAL)
    assert "the object's depth is constant in 3 of 3 frames" in found.estimate.note
    assert "low confidence: --not-upright helps" in found.estimate.note
    estimates = [found.estimate, *(vote.estimate for vote in found.votes)]
    most = max(one.confidence for estimate in estimates for one in estimate.hypotheses)
    assert most <= Contradiction.most + 1e-6  # rounding


@slow
def test_frames_in_memory_in_other_units_and_by_threads_give_the_same(several, in_memory):
    first, second = in_memory
    larger = (scale_frame(frame, 1000.0) for frame in second)
    # Frames may be in any iterable: here an array and a generator.
    again = estimate_pose(np.array([LOST, *first]), larger, **SEVERAL, workers=2)
    assert (again.errors, again.masks) == ({}, ("given", "given"))
    # The source has the name of its first frame; the first usable frame is the next one.
    assert again.votes[0].name == "frame 1 of lost"
    *_, lost, lengths = again.estimate.flags
    assert lost.endswith("frames left out: 1: frame 0: the camera's pose is not finite")
    assert "the object is 3.08e+03 m from the camera, expected 0.05 to 20 m" in lengths
    assert rotation_error(again.world_sim3.R, several.world_sim3.R) < 3
    assert_allclose(again.world_sim3.scale, 1000 * several.world_sim3.scale, rtol=0.05)


@slow
@pytest.mark.parametrize(
    "choice, frame",
    [
        ({"reference_frame": 2}, 2),
        ({"references": 1}, 0),
    ],
)
def test_one_reference_frame_is_the_papers_setting(ellipsoids, choice, frame):
    folder, backbone = ellipsoids.root / "ellipsoid", CoordinateBackbone()
    frames = ellipsoids.load_pair(Pair("ellipsoid", "a", frame, "b", (0, 2, 4)))
    expected = ZeroShotPose(backbone, solver="verified").estimate(*frames)
    found = estimate_pose(folder / "a", folder / "b", targets=3, backbone=backbone, **choice)
    assert found.reference.name == f"a/{frame}"
    assert_array_equal(found.estimate.sim3.matrix, expected.sim3.matrix)
    assert found.votes == ()


@pytest.mark.parametrize(
    "given, message",
    [
        ([], r"frames are \[\], expected one zsp_lite.Frame or several"),
        ([1.0], r"frames are \[1.0\], expected"),
        (ONE.rgb, "frames are array.* expected"),
        (
            [LOST, replace(ONE, depth=None)],
            "no frame can be used: frame 0: the camera's pose is not finite; frame 1: no depth map",
        ),
        ([ONE, ONE], "all 2 frames have one camera pose, expected their poses in one world"),
    ],
)
def test_frames_that_are_no_views_of_one_object_are_refused(given, message):
    refused(message, open_source, given)


def test_helpers_in_memory_may_have_equal_names_and_come_from_an_iterator():
    # Names are checked first: the error of the reference shows that they are accepted.
    black = replace(ONE, rgb=0 * ONE.rgb)
    refused("black image", estimate_pose, black, ONE, helpers=iter([ONE]))


@slow
def test_a_target_that_is_seen_from_one_side_is_flagged(pictures, tmp_path):
    cup, mug, _ = pictures
    write_lists(tmp_path, around(ELSEWHERE, 5, arc=90))
    options = {"mask": "auto", "intrinsics": INTRINSICS, "backbone": CoordinateBackbone()}
    # The first and the last of five views in an arc of 90 degrees are 72 degrees apart.
    for target, degrees in ((mug, "0"), (tmp_path, "7[0-5]")):
        (flag,) = estimate_pose(cup, target, "paper", **options).estimates["paper"].flags
        seen = rf"the target was seen from one side only \({degrees} degrees\): if .* is wrong"
        assert re.fullmatch(seen, flag)


def test_objects_of_two_categories_are_flagged():
    car, chair = sample_data() / "car/suv", sample_data() / "chair/classroom_chair"
    found = estimate_pose(car, chair, "paper", targets=1, backbone=CoordinateBackbone())
    first, *_ = found.estimates["paper"].flags
    assert first == "the objects are of different categories: car, chair"


# By default the depth of an image is in millimetres.
@pytest.mark.parametrize("unit, questioned", [(None, True), (1.0, False)])
def test_depth_in_another_unit_is_questioned(image, views, tmp_path, unit, questioned):
    np.save(tmp_path / "z.npy", views[0].depth)  # in metres
    source = open_source(image, INTRINSICS, depth=tmp_path / "z.npy", depth_unit=unit)
    (frame,) = source.load([0])
    flags = "; ".join(source.flags([frame]))
    question = "m from the camera, expected 0.05 to 20 m; .*--depth-unit .*; disparity is no depth"
    assert bool(re.search(question, flags)) == questioned
    if not questioned:
        assert "--depth-unit" not in flags
        assert_array_equal(frame.depth, views[0].depth)


@slow
def test_the_command_prints_the_poses_and_names_its_files(loaded, ellipsoids, tmp_path, run):
    folder = ellipsoids.root / "ellipsoid"
    options = "--targets 1 --solver both --reference-frame 2"
    text = run(f"estimate {folder}/a {folder}/b {options} --out {tmp_path}")
    assert f"{Path('ellipsoid/a')}, frame 2; by depth and intrinsics, the object in a/2 is" in text
    assert "The rotations of both solvers differ by" in text
    for name in ("report.html", "target.ply", "aligned_paper.ply", "aligned_verified.ply"):
        assert f"Written: {tmp_path / name}" in text.replace("\n", "")  # long lines are wrapped
        assert (tmp_path / name).is_file()


@pytest.fixture
def estimate_paper(loaded, pictures, tmp_path, without_report, run):
    """Runs the command on the two pictures by the paper's solver, with more options."""
    cup, mug, _ = pictures
    intrinsics = ",".join(map(str, INTRINSICS))
    line = f"estimate {cup} {mug} --intrinsics {intrinsics} --solver paper --out {tmp_path}"
    return lambda options: run(f"{line} {options}")


@slow
def test_the_command_prints_json_alone(estimate_paper, tmp_path):
    content = json.loads(estimate_paper("--mask given --mask auto --json"))
    assert content["estimates"]["paper"]["error_degrees"] is None
    assert (content["reference"]["masks"], content["target"]["masks"]) == ("given", "auto")
    names = ("report.html", "target.ply", "aligned_paper.ply")
    assert content["files"] == [str(tmp_path / name) for name in names]


@slow
def test_the_command_without_labels_and_report(estimate_paper, tmp_path):
    (tmp_path / "report.html").write_text("of an earlier run")
    text = estimate_paper("--no-report")
    assert not (tmp_path / "report.html").exists()
    assert "No pose labels: the rotation error is unknown." in text
    assert "error:" not in text
    assert "(masks: auto)" in text
    assert "flag: the target was seen from one side only (0 degrees)" in text
