"""Pixels of one object's frames, found on the other objects of its category."""

import json
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from test_transfer import aligned, true_sim3

from zsp_lite import Co3D, Sim3
from zsp_lite.data.clouds import extent
from zsp_lite.data.ground_truth import read_poses
from zsp_lite.io.ply import read_ply
from zsp_lite.metrics import vector_angle
from zsp_lite.objects.align import write_alignment
from zsp_lite.scans.marks import Mark, category_axes, place_marks, read_front, write_marks
from zsp_lite.views import object_crop
from zsp_lite.viz.category_sheet import objects_figure

# Pixels in frame 0 of a scooter. The arrow is from its tail to its tip, parallel to the floor.
SEAT = Mark("scooter", 0, 180.0, 114.0, "seat")
ARROW = Mark("scooter", 0, 200.5, 124.5, "tail"), Mark("scooter", 0, 128.5, 76.5, "tip")


@pytest.fixture(scope="module")
def dataset():
    """The sample data."""
    return Co3D("data_samples")


@pytest.fixture(scope="module")
def alignment(dataset):
    """The true alignment of two scooters."""
    return aligned(
        {name: true_sim3(dataset, "motorcycle", name) for name in ("scooter", "scooter2")}
    )


@pytest.fixture(scope="module")
def placed(dataset, alignment):
    """The seat on both scooters."""
    return place_marks(alignment, dataset, "motorcycle", [SEAT])


def test_a_mark_is_its_own_place_on_its_own_object(placed, dataset):
    place = placed[0].places["scooter"]
    assert place.pixels[0] == (180.0, 114.0)
    assert len(place.pixels) > 3  # seen from other sides, too
    camera = dataset.camera(dataset.frame("motorcycle", "scooter", 0))
    pixel, depth = camera.project(place.world)
    assert np.allclose(pixel, (180, 114))
    assert depth > 0


def test_the_seat_of_one_scooter_is_found_on_the_seat_of_the_other(placed, dataset, alignment):
    place = placed[0].places["scooter2"]
    assert place.found
    common = alignment.objects["scooter2"].sim3.apply(place.world)
    size = extent(dataset, "motorcycle", "scooter2")[1] * alignment.objects["scooter2"].sim3.scale
    assert np.linalg.norm(common - placed[0].common) < 0.15 * size


def test_marks_are_written_for_other_programs(placed, dataset, alignment, tmp_path):
    path = write_marks(placed, dataset, "motorcycle", tmp_path)
    (mark,) = json.loads(path.read_text())
    assert (mark["name"], mark["pixel"]) == ("seat", [180.0, 114.0])
    world = mark["objects"]["scooter2"]["world"]
    points, _ = read_ply(tmp_path / "marks/scooter2.ply")  # a ball around the place
    assert np.allclose(points.mean(axis=0), world, atol=0.01)


def test_a_place_is_seen_on_the_object_alone(placed, dataset):
    for name, place in placed[0].places.items():
        for number, (x, y) in place.pixels.items():
            frame = dataset.load(dataset.frame("motorcycle", name, number))
            assert frame.mask[int(y), int(x)] > 0.5


def test_an_object_without_any_place_has_no_file(placed, dataset, tmp_path):
    places = placed[0].places
    # A place is found from a confidence of 0.5 on.
    missing = places | {"scooter2": replace(places["scooter2"], confidence=0.49)}
    write_marks([replace(placed[0], places=missing)], dataset, "motorcycle", tmp_path)
    assert [path.name for path in (tmp_path / "marks").iterdir()] == ["scooter.ply"]


def test_a_run_leaves_no_outputs_of_an_earlier_one(placed, alignment, tmp_path, run, monkeypatch):
    one = {"scooter2": alignment.objects["scooter2"]}
    # The second run aligns one object of the two.
    answers = iter([alignment, replace(alignment, objects=one)])
    monkeypatch.setattr("zsp_lite.objects.align.align_category", lambda *_, **__: next(answers))
    monkeypatch.setattr("zsp_lite.scans.marks.place_marks", lambda *_: placed)
    line = f"align data_samples --category motorcycle --out {tmp_path}"
    run(f"{line} --mark scooter:0:180,114:seat")
    assert (tmp_path / "marks.jpg").is_file()
    assert "Marked once" in (tmp_path / "report.html").read_text("utf-8")
    (tmp_path / "marks/mine.ply").touch()
    run(line)
    written = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert written == {
        "alignment.json",
        "class_labels/motorcycle/scooter2.json",
        "marks/mine.ply",
        "objects.jpg",
        "report.html",
    }


@pytest.fixture(scope="module")
def axes(dataset, alignment):
    """The axes that the arrow gives."""
    return category_axes(alignment, "scooter", read_front(dataset, "motorcycle", *ARROW))


def test_poses_in_the_axes_are_rigid_and_agree_with_the_labels(dataset, alignment, axes, tmp_path):
    written = json.loads(write_alignment(alignment, tmp_path, axes).read_text())
    middle = np.median([one.sim3.t for one in alignment.objects.values()], axis=0)
    for name, label in read_poses(dataset.root, "motorcycle").items():
        if name in alignment.objects:
            matrix = np.array(written["objects"][name]["world_to_axes"])
            front, left, up = matrix[:3, :3]
            assert vector_angle(front, label.R[:, 0]) < 6  # degrees: the arrow is a bit off
            assert vector_angle(up, label.R[:, 2]) < 1
            assert np.allclose(np.cross(up, front), left)
            world = alignment.objects[name].sim3.inverse().apply(middle)
            assert np.allclose(matrix @ [*world, 1], [0, 0, 0, 1])


def test_the_arrows_of_a_picture_point_along_the_objects_front_and_up(dataset, alignment):
    # In the true alignment, the common frame has these axes.
    panel = objects_figure(dataset, "motorcycle", alignment, ["scooter"], Sim3.identity()).axes[0]
    crop = object_crop(dataset.load(dataset.frame("motorcycle", "scooter", 0)))
    label = read_poses(dataset.root, "motorcycle")["scooter"]
    # Each arrow is followed by its name.
    for arrow, direction in zip(panel.texts[::2], label.R.T, strict=True):
        (start, end), _ = crop.camera.project(np.stack([label.t, label.t + direction]))
        assert np.allclose(arrow.xyann, start)
        drawn = np.array([*arrow.xy - start, 0])
        assert vector_angle(drawn, np.array([*end - start, 0])) < 1


def test_the_command_takes_an_arrow_or_two_marks(axes, alignment, tmp_path, run, monkeypatch):
    monkeypatch.setattr("zsp_lite.objects.align.align_category", lambda *_, **__: alignment)
    line = f"align data_samples --category motorcycle --out {tmp_path}"
    marks = "--mark scooter:0:200.5,124.5:rear --mark scooter:0:128.5,76.5:bow"
    for given in ("scooter:front=0:200.5,124.5,0:128.5,76.5", f"rear,bow {marks}"):
        assert f"world_to_axes of each object in {tmp_path}" in run(f"{line} --axes {given}")
        content = json.loads((tmp_path / "alignment.json").read_text())
        pose = np.array(content["objects"]["scooter"]["world_to_axes"])
        assert np.allclose(pose[:3, :3], axes.R @ alignment.objects["scooter"].sim3.R)
        assert "world_to_axes" in (tmp_path / "report.html").read_text("utf-8")
    run(line)
    assert "axes" not in (tmp_path / "alignment.json").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--mark scooter", "expected SEQUENCE:FRAME:X,Y"),
        ("--mark nothing:0:1,1", "have no frames of 'nothing'"),
        ("--mark scooter:99:1,1", "has no frame number 99"),
        ("--mark scooter:0:900,1", "outside the image, expected one of 320 x 240"),
        ("--mark scooter:0:nan,1", "outside the image"),
        ("--mark scooter:0:180,114:a\x07", "expected SEQUENCE:FRAME:X,Y"),
        ("--mark scooter:0:180,114 --sequences scooter2,yamaha_yzr_r6", "sequence of the mark"),
        ("--mark scooter:0:1,1", "has no depth"),
        ("--mark scooter:0:20,160", "is not on the object"),
        ("--mark scooter:0:180,114:a --mark scooter:0:181,114:a", "2 marks are named 'a'"),
        ("--axes scooter:front=0:200,124", "expected SEQUENCE:front=FRAME:X,Y,FRAME:X,Y or"),
        (
            "--axes scooter:front=0:200,124,0:900,1",
            "'tip of --axes': pixel 900,1 of frame 0 is out",
        ),
        ("--axes scooter:front=0:200,124,0:200,124", "is 0 long"),
        ("--axes a,b --axes c,d", "--axes is given twice, expected once"),
        ("--axes scooter:front=0:200,124,0:201,124", "at least 0.62, a tenth of the object"),
        ("--axes scooter:front=0:128.5,140.5,0:128.5,76.5", "84 degrees from the floor"),
        ("--axes scooter:front=0:200,124,0:128,76 --sequences scooter2", "sequence of the mark"),
        (
            "--mark scooter:0:180,114:a --axes a,b",
            "--mark of this command is 'b', expected one of a",
        ),
        (
            "--mark scooter:0:200,124:a --mark scooter2:0:128,120:b --axes a,b",
            "of the arrow's tip is 'scooter2'",
        ),
    ],
)
def test_wrong_marks_and_axes_are_refused_before_anything_is_computed(
    options, message, tmp_path, run
):
    out = tmp_path / "out"
    printed = run(f"align data_samples --category motorcycle {options} --out {out}", code=2)
    assert message in printed
    assert printed.count("\n") == 1
    assert not out.exists()


def test_axes_need_a_vertical_and_an_aligned_object(dataset, alignment, axes, monkeypatch):
    refused("sequence with the arrow is 'x'", category_axes, alignment, "x", axes.R)
    # As where there is no floor.
    monkeypatch.setattr("zsp_lite.scans.marks.find_up", lambda frames: (None, ""))
    refused("no vertical, expected a scan with a floor", read_front, dataset, "motorcycle", *ARROW)
