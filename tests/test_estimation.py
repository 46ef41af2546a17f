"""One's own pair: from paths to poses, report, point clouds, table and JSON, by the command and by the Python call."""

import json
from dataclasses import replace

import numpy as np
import pytest
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, inside, look_at, render, true_pose
from test_importers import write_lists
from test_sources import INTRINSICS, write_picture

import zsp_lite
from zsp_lite.cli import main as cli
from zsp_lite.errors import InputError
from zsp_lite.estimation import estimate_pose
from zsp_lite.io.ply import read_ply
from zsp_lite.metrics import rotation_error
from zsp_lite.sources import open_source

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def own(ellipsoids, tmp_path_factory):
    """Both solvers on two labelled sequences, and the folder of their files."""
    out = tmp_path_factory.mktemp("own") / "deep" / "out"
    folder = ellipsoids.root / "ellipsoid"
    found = estimate_pose(
        folder / "a", folder / "b", "both", reference_frame=2, targets=3, backbone=CoordinateBackbone(), out=out
    )
    return found, out


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Two pictures of one object, elsewhere in the second, and its true pose. The second has no mask."""
    folder = tmp_path_factory.mktemp("pictures")
    first, second = look_at((1, 0.3, 0.3)), look_at(ELSEWHERE.R @ (1, 0.6, 0.4))
    write_picture(folder / "cup.jpg", render(first, AT_HOME))
    write_picture(folder / "mug.jpg", render(second, ELSEWHERE), mask=False)
    return folder / "cup.jpg", folder / "mug.jpg", true_pose(first, AT_HOME, second, ELSEWHERE)


@pytest.fixture
def backbone(monkeypatch):
    monkeypatch.setattr("zsp_lite.backbones.load.load_backbone", lambda choice: CoordinateBackbone())
    monkeypatch.setenv("COLUMNS", "160")


def test_labelled_sequences_are_compared_with_their_labels(own):
    found, _ = own
    assert list(found.estimates) == ["paper", "verified"] and found.masks == ("given", "given")
    assert list(found.result.errors) == ["paper", "verified"] and max(found.result.errors.values()) < 25
    assert found.reference.name == "a/2" and [frame.name for frame in found.targets] == ["b/0", "b/2", "b/4"]
    assert "paper: PoseEstimate(" in repr(found) and "verified: PoseEstimate(" in repr(found)


def test_the_aligned_cloud_lies_on_the_target_object_in_its_world(own, ellipsoids):
    found, out = own
    assert sorted(path.name for path in out.iterdir()) == [
        "aligned_paper.ply", "aligned_verified.ply", "report.html", "target.ply",
    ]  # fmt: skip
    # Sequence b is the object of the test's renderer, rotated and shifted.
    label = zsp_lite.labels.read_labels(ellipsoids.root, "ellipsoid")["b"].trans
    clouds = {path.stem: read_ply(path) for path in out.glob("*.ply")}
    for name, (points, colours) in clouds.items():
        at_home = (points - label[:3, 3]) @ label[:3, :3]
        assert len(points) > 500 and np.abs(inside(at_home)).mean() < (0.05 if name == "target" else 0.15), name
        assert len(np.unique(colours, axis=0)) > 100


def test_the_report_has_the_answers_the_sources_and_the_errors(own):
    found, out = own
    text = (out / "report.html").read_text()
    assert "<h1>a to b</h1>" in text and "ellipsoid/a, frame 2" in text and "ellipsoid/b, frames 0, 2, 4" in text
    for solver, error in found.result.errors.items():
        assert f"{solver} solver: rotation error {error:.1f}°" in text.replace("\n", "")
    assert "reference given with the images, target given with the images" in text
    assert "There is no label to compare with" not in text


def test_a_path_that_is_not_utf8_is_written_and_the_clouds_come_before_the_report(own, tmp_path, monkeypatch):
    found, _ = own
    named = replace(found, result=replace(found.result, reference="capture \udcff"))
    paths = named.write(tmp_path / "named")
    assert [path.name for path in paths][:2] == ["report.html", "target.ply"]
    assert "capture ?" in paths[0].read_text(encoding="utf-8")

    def fail(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("zsp_lite.viz.report.write_pair_report", fail)
    with pytest.raises(OSError, match="No space"):
        found.write(tmp_path / "full")
    assert len(list((tmp_path / "full").glob("*.ply"))) == 3


def test_json_has_every_number_of_the_estimates(own):
    found, _ = own
    content = json.loads(json.dumps(found.as_json(), allow_nan=False))
    assert content["target"]["views"] == ["b/0", "b/2", "b/4"] and content["reference"]["masks"] == "given"
    for solver, estimate in found.estimates.items():
        one = content["estimates"][solver]
        np.testing.assert_array_equal(one["matrix"], estimate.sim3.matrix)
        np.testing.assert_allclose(one["scale"] * np.array(one["rotation"]), np.array(one["matrix"])[:3, :3])
        assert one["view_name"] == found.targets[one["view"]].name and one["flags"] == list(estimate.flags)
        assert one["error_degrees"] == found.result.errors[solver] and one["confidence"] == estimate.confidence
        assert one["one_of_two"] == estimate.one_of_two
        for other, alternative in zip(one["alternatives"], estimate.alternatives, strict=True):
            assert other["probability"] == alternative.probability > 0
            np.testing.assert_array_equal(other["matrix"], alternative.sim3.matrix)
        assert len(one["alternatives"]) > 0 or solver == "paper"
    assert content["degrees_between_solvers"] == found.result.disagreement < 20


def test_where_the_answer_is_one_of_two_both_clouds_are_written(own, tmp_path):
    found, out = own
    doubtful = replace(found.estimates["verified"], one_of_two=True)
    pair = replace(found, result=replace(found.result, estimates={"verified": doubtful}))
    assert [path.name for path in pair.write(tmp_path)] == [
        "report.html", "target.ply", "aligned_verified.ply", "aligned_verified_2.ply",
    ]  # fmt: skip
    assert "One of two: both poses of the verified solver" in (tmp_path / "report.html").read_text()
    (first, _), (second, _) = (read_ply(tmp_path / f"aligned_verified{name}.ply") for name in ("", "_2"))
    np.testing.assert_array_equal(first, read_ply(out / "aligned_verified.ply")[0])
    other = doubtful.alternatives[0]
    points = found.targets[doubtful.view].camera.to_camera(first)
    expected = found.targets[other.view].camera.to_world(other.sim3.apply(doubtful.sim3.inverse().apply(points)))
    np.testing.assert_allclose(second, expected, atol=1e-3)
    assert pair.as_json()["estimates"]["verified"]["one_of_two"] is True


def test_two_pictures_without_labels_give_the_true_pose_and_no_error(pictures, tmp_path):
    cup, mug, truth = pictures
    found = zsp_lite.estimate_pose(
        cup, mug, "paper", intrinsics=INTRINSICS, backbone=CoordinateBackbone(), out=tmp_path
    )
    assert found.masks == ("given", "auto") and len(found.targets) == 1
    assert found.result.errors == {} and np.isnan(found.result.error)
    assert rotation_error(found.estimates["paper"].sim3.R, truth.R) < 20
    assert found.estimates["paper"].sim3.scale == pytest.approx(truth.scale, rel=0.2)
    text = (tmp_path / "report.html").read_text()
    assert "There is no label to compare with" in text and "rotation error" not in text
    assert "target found from the depth" in text


def test_the_pose_does_not_depend_on_the_unit_of_length_of_a_capture(pictures):
    """Lengths are scaled to those of CO3D, and those of the result are the capture's."""
    cup, mug, _ = pictures
    metres, millimetres = (
        estimate_pose(
            cup, open_source(mug, INTRINSICS, depth_unit=unit, mask="auto"), "paper", intrinsics=INTRINSICS,
            backbone=CoordinateBackbone(),
        ).estimates["paper"]
        for unit in (0.001, 1.0)
    )  # fmt: skip
    np.testing.assert_array_equal(metres.inliers, millimetres.inliers)
    assert rotation_error(metres.sim3.R, millimetres.sim3.R) < 0.1
    assert millimetres.sim3.scale == pytest.approx(1000 * metres.sim3.scale, rel=1e-3)
    np.testing.assert_allclose(millimetres.sim3.t, 1000 * metres.sim3.t, rtol=1e-2)
    for estimate, unit in ((metres, 1), (millimetres, 1000)):  # points are in the units of the capture
        source, target = (points[estimate.inliers] for points in estimate.points)
        assert np.linalg.norm(estimate.sim3.apply(source) - target, axis=1).max() < 0.3 * unit


def test_a_capture_is_a_target_of_several_views(pictures, tmp_path):
    cup, _, _ = pictures
    angles = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    cameras = [look_at(ELSEWHERE.R @ (np.cos(a), np.sin(a), 0.3)) for a in angles]
    write_lists(tmp_path, [render(camera, ELSEWHERE, f"{k:04d}") for k, camera in enumerate(cameras)])
    found = estimate_pose(cup, tmp_path, targets=3, intrinsics=INTRINSICS, backbone=CoordinateBackbone())
    estimate = found.estimates["verified"]
    view = cameras[2 * estimate.view]
    truth = true_pose(look_at((1, 0.3, 0.3)), AT_HOME, view, ELSEWHERE)
    assert len(found.targets) == 3 and rotation_error(estimate.sim3.R, truth.R) < 15


def test_wrong_settings_are_refused(pictures):
    cup, mug, _ = pictures
    with pytest.raises(InputError, match="solver is 'best', expected one of paper, verified, both"):
        estimate_pose(cup, mug, "best", intrinsics=INTRINSICS)
    with pytest.raises(InputError, match="targets is 0"):
        estimate_pose(cup, mug, targets=0, intrinsics=INTRINSICS)
    with pytest.raises(InputError, match="expected --intrinsics"):
        estimate_pose(cup, mug)
    with pytest.raises(InputError, match="has no frame 4"):
        estimate_pose(cup, mug, reference_frame=4, intrinsics=INTRINSICS)


def test_an_output_that_is_no_folder_is_refused_before_the_computation(pictures, tmp_path):
    def fail(images):
        raise AssertionError("computed")

    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="expected a folder"):
        estimate_pose(*pictures[:2], intrinsics=INTRINSICS, backbone=fail, out=tmp_path / "file")


def test_the_command_prints_the_poses_and_names_its_files(backbone, ellipsoids, tmp_path, capsys):
    folder = ellipsoids.root / "ellipsoid"
    words = [str(folder / "a"), str(folder / "b"), "--targets", "3", "--out", str(tmp_path)]
    assert cli.main(["estimate", *words, "--solver", "both", "--reference-frame", "2"]) == 0
    text = capsys.readouterr().out
    assert (
        "Pose from a to b" in text
        and "error: angle to the labelled rotation" in " ".join(text.split())
        and "confidence" in text
    )
    assert "ellipsoid/a, frame 2 (mask: given)" in text
    assert text.count("reference-camera points to camera points of view") == 2
    assert "hypothesis 2: turned by" in text and "The rotations of both solvers differ by" in text
    for name in ("report.html", "target.ply", "aligned_paper.ply", "aligned_verified.ply"):
        assert f"Written: {tmp_path / name}" in text.replace("\n", "") and (tmp_path / name).is_file()


def test_the_command_prints_json_alone(backbone, pictures, tmp_path, capsys):
    cup, mug, _ = pictures
    words = [str(cup), str(mug), "--intrinsics", ",".join(map(str, INTRINSICS)), "--solver", "paper", "--json"]
    assert cli.main(["estimate", *words, "--mask", "given", "--mask", "auto", "--out", str(tmp_path)]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["estimates"]["paper"]["error_degrees"] is None
    assert (content["reference"]["masks"], content["target"]["masks"]) == ("given", "auto")
    assert content["files"] == [str(tmp_path / name) for name in ("report.html", "target.ply", "aligned_paper.ply")]


def test_the_command_without_labels_says_so(backbone, pictures, tmp_path, capsys):
    cup, mug, _ = pictures
    words = ["--intrinsics", ",".join(map(str, INTRINSICS)), "--solver", "paper", "--out", str(tmp_path)]
    assert cli.main(["estimate", str(cup), str(mug), *words]) == 0
    text = capsys.readouterr().out
    assert "No pose labels: the rotation error is unknown." in text and "error:" not in text
    assert "(masks: auto)" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{cup}"], "Missing argument 'TARGET'"),
        (["{cup}", "{mug}"], "no intrinsics, expected --intrinsics FX,FY,CX,CY"),
        (["{cup}", "nowhere"], "nowhere does not exist"),
        (["{cup}", "{mug}", "--solver", "icp"], "'icp' is not one of 'paper', 'verified', 'both'"),
        (["{cup}", "{mug}", "--intrinsics", "1,2"], "expected four numbers"),
        (["{cup}", "{mug}", "--targets", "0"], "'--targets': 0 is not in the range"),
        (["{cup}", "{mug}", "--intrinsics", "190,190,89.5,69.5", "--reference-frame", "3"], "has no frame 3"),
        (["{cup}", "{mug}", "--intrinsics", "190,190,89.5,69.5", "--box", "0,0,500,500"], "expected one inside"),
        (["{cup}", "{mug}", "--intrinsics", "190,190,89.5,69.5", "--mask", "given"], "expected --mask auto or --box"),
    ],
)
def test_bad_input_is_one_line_with_the_cure_and_nothing_is_written(
    backbone, pictures, tmp_path, monkeypatch, capsys, words, message
):
    monkeypatch.chdir(tmp_path)
    names = {"cup": pictures[0], "mug": pictures[1]}
    assert cli.main(["estimate", *(word.format(**names) for word in words)]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and captured.err.count("\n") == 1 and captured.out == ""
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
