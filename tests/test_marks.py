"""Pixels of one object's frames, found on the other objects of its category."""

import json
from dataclasses import replace

import numpy as np
import pytest
from test_transfer import aligned, true_sim3

from zsp_lite import Co3D
from zsp_lite.data.clouds import extent
from zsp_lite.io.ply import read_ply
from zsp_lite.scans.marks import Mark, place_marks, write_marks
from zsp_lite.viz.report import write_category_report

SEAT = Mark("scooter", 0, 180.0, 114.0, "seat")


@pytest.fixture(scope="module")
def dataset():
    return Co3D("data_samples")


@pytest.fixture(scope="module")
def alignment(dataset):
    """The true alignment of two scooters."""
    return aligned(
        {name: true_sim3(dataset, "motorcycle", name) for name in ("scooter", "scooter2")}
    )


@pytest.fixture(scope="module")
def placed(dataset, alignment):
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
    points, _ = read_ply(tmp_path / "marks/scooter2.ply")
    assert np.allclose(points.mean(axis=0), world, atol=0.01)


def test_a_place_is_seen_on_the_object_alone(placed, dataset):
    for name, place in placed[0].places.items():
        for number, (x, y) in place.pixels.items():
            frame = dataset.load(dataset.frame("motorcycle", name, number))
            assert frame.mask[int(y), int(x)] > 0.5


def test_an_object_without_any_place_has_no_file(placed, dataset, tmp_path):
    places = placed[0].places
    missing = places | {"scooter2": replace(places["scooter2"], confidence=0.49)}
    write_marks([replace(placed[0], places=missing)], dataset, "motorcycle", tmp_path)
    assert [path.name for path in (tmp_path / "marks").iterdir()] == ["scooter.ply"]


def test_a_run_leaves_no_outputs_of_an_earlier_one(placed, alignment, tmp_path, run, monkeypatch):
    one = {"scooter2": alignment.objects["scooter2"]}
    answers = iter([alignment, replace(alignment, objects=one)])
    monkeypatch.setattr("zsp_lite.objects.align.align_category", lambda *_, **__: next(answers))
    monkeypatch.setattr("zsp_lite.scans.marks.place_marks", lambda *_: placed)
    line = f"align data_samples --category motorcycle --out {tmp_path}"
    run(f"{line} --mark scooter:0:180,114:seat")
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


def test_the_report_shows_the_marks(placed, dataset, alignment, tmp_path):
    path = tmp_path / "report.html"
    write_category_report(path, alignment, dataset, "motorcycle", placed)
    assert "Marked once" in path.read_text("utf-8")
    assert (tmp_path / "marks.jpg").is_file()
    write_category_report(path, alignment, dataset, "motorcycle")
    assert "Marked once" not in path.read_text("utf-8")


@pytest.mark.parametrize(
    ("marks", "message"),
    [
        (["scooter"], "expected SEQUENCE:FRAME:X,Y"),
        (["nothing:0:1,1"], "have no frames of 'nothing'"),
        (["scooter:99:1,1"], "has no frame number 99"),
        (["scooter:0:900,1"], "outside the image, expected one of 320 x 240"),
        (["scooter:0:nan,1"], "outside the image"),
        (["scooter:0:180,114:a\x07"], "expected SEQUENCE:FRAME:X,Y"),
        (["scooter:0:180,114", "--sequences", "scooter2,yamaha_yzr_r6"], "sequence of the mark"),
        (["scooter:0:1,1"], "has no depth"),
        (["scooter:0:20,160"], "is not on the object"),
        (["scooter:0:180,114:a", "scooter:0:181,114:a"], "2 marks are named 'a'"),
    ],
)
def test_wrong_marks_are_refused_before_anything_is_computed(marks, message, tmp_path, run):
    words = " ".join(f"--mark {mark}" if ":" in mark or len(marks) == 1 else mark for mark in marks)
    out = tmp_path / "out"
    printed = run(f"align data_samples --category motorcycle {words} --out {out}", code=2)
    assert message in printed
    assert printed.count("\n") == 1
    assert not out.exists()
