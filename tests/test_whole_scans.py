"""Whole scans: the vertical, the shapes, and the judge of votes, shapes and the vertical."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused
from scipy.spatial.transform import Rotation

from zsp_lite import Co3D, Sim3, ZeroShotPose, estimate_pose, load_backbone
from zsp_lite.course.samples import sample_data
from zsp_lite.data.evaluation import spread
from zsp_lite.importers.sources import open_source
from zsp_lite.metrics import rotation_error, vector_angle
from zsp_lite.objects.scan import Scan
from zsp_lite.scans.category import PairHypotheses
from zsp_lite.scans.judge import Question, asked_positions, judge, judge_pairs
from zsp_lite.scans.shapes import Shape
from zsp_lite.scans.upright import find_up
from zsp_lite.views import object_crop

UP = np.array([0.0, 0.0, 1.0])
NAMES = "first", "second"
TURN = Rotation.from_euler("z", 100, degrees=True).as_matrix()


def about_z(degrees: float) -> Sim3:
    """A turn about the vertical."""
    return Sim3(1.0, Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.zeros(3))


def cloud(seed: int) -> np.ndarray:
    """Points of a long box with a tower near one end and a fin at its side."""
    rng = np.random.default_rng(seed)
    # The middle and the half sides of each part.
    parts = [(0, 0, 0, 2, 0.7, 0.3), (1.3, 0, 0.7, 0.4, 0.4, 0.5), (-1, 0.8, 0, 0.5, 0.2, 0.2)]
    points = [rng.uniform(-1, 1, (400, 3)) * part[3:] + part[:3] for part in parts]
    return rng.permutation(np.concatenate(points))


def shape(points: np.ndarray, up: np.ndarray | None = UP, span: float = 300.0) -> Shape:
    """A shape in its own world: points around their middle, seen over `span` degrees."""
    middle = points.mean(axis=0)
    return Shape(points - middle, Sim3(1.0, np.eye(3), -middle), up is not None, span)


SHAPES = {"first": shape(cloud(0)), "second": shape(cloud(1) @ TURN.T)}


def vote(degrees: float, probability: float, backward: bool = False) -> PairHypotheses:
    """The hypothesis of a frame: a turn about the vertical."""
    sim3 = about_z(-degrees if backward else degrees)
    names = NAMES[::-1] if backward else NAMES
    return PairHypotheses(*names, (sim3,), np.array([probability]), np.zeros(3))


@pytest.fixture(scope="module")
def crops() -> list:
    """Object crops of five frames of a car, all around it."""
    dataset = Co3D(sample_data())
    frames = dataset.frames("car", "suv")
    return [object_crop(dataset.load(frames[k])) for k in spread(5, len(frames))]


def test_the_floor_and_the_ring_of_the_cameras_tell_the_vertical(crops):
    up, problem = find_up(crops)
    of_images = -np.mean([crop.camera.R[1] for crop in crops], axis=0)
    assert problem == ""
    assert vector_angle(up, of_images) < 5
    bare = [replace(crop, depth=np.where(crop.mask > 0.5, crop.depth, 0)) for crop in crops]
    of_ring, _ = find_up(bare)  # without the floor, a little worse
    assert 0.1 < vector_angle(up, of_ring) < 8
    assert find_up(bare[:2]) == (None, "")


def test_a_floor_that_the_ring_contradicts_is_no_vertical(crops, monkeypatch):
    leaning = Rotation.from_euler("x", 45, degrees=True).as_matrix() @ find_up(crops)[0]
    monkeypatch.setattr("zsp_lite.scans.upright._floor_normal", lambda *_: leaning)
    up, problem = find_up(crops)
    assert up is None
    assert problem.startswith("no vertical: floor and ring of the cameras differ by 4")


def test_a_shape_stands_upright_in_the_middle_of_its_object(crops):
    up = find_up(crops)[0]
    found = Shape.of(crops, up)
    assert_allclose(found.from_world.R @ up, UP, atol=1e-9)
    assert_allclose(np.sqrt(found.points.var(axis=0).mean()), 1, atol=1e-9)
    assert found.span > 250  # degrees; five frames all around leave gaps of about 72
    assert not Shape.of(crops, None).upright
    empty = replace(crops[0], depth=np.zeros_like(crops[0].depth))
    refused("no frame shows the object with depth", Shape.of, [empty], up)


def test_shapes_settle_what_the_votes_leave_open_and_votes_what_shapes_do():
    half = [vote(100, 0.5), vote(280, 0.5, backward=True)]
    by_shape = judge(NAMES, SHAPES, half)
    assert rotation_error(by_shape.sim3s[0].R, TURN) < 5
    assert by_shape.probabilities[0] > 0.7
    assert by_shape.probabilities.sum() < 1
    # A slab of two planes looks alike from both sides.
    first, second = np.random.default_rng(0).uniform(-1, 1, (2, 900, 3)) * (2, 1, 0.2)
    slabs = {"first": shape(first), "second": shape(second)}
    by_votes = judge(NAMES, slabs, [vote(0, 0.8), vote(0, 0.8, backward=True)])
    assert rotation_error(by_votes.sim3s[0].R, np.eye(3)) < 5
    assert by_votes.probabilities[0] > 0.8


def test_an_object_that_lies_in_the_second_scan_is_not_forced_upright():
    fall = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    lying = {"first": SHAPES["first"], "second": shape(cloud(1) @ fall.T)}
    fallen = PairHypotheses(*NAMES, (Sim3(1.0, fall, np.zeros(3)),), np.array([0.8]), np.zeros(3))
    found = judge(NAMES, lying, [fallen, fallen])
    assert rotation_error(found.sim3s[0].R, fall) < 5


def test_without_votes_the_headings_are_the_candidates_and_without_a_vertical_nothing_is():
    assert rotation_error(judge(NAMES, SHAPES, []).sim3s[0].R, TURN) < 5
    lost = {name: replace(one, upright=False) for name, one in SHAPES.items()}
    assert judge(NAMES, lost, []) is None
    assert judge_pairs(lost, dict.fromkeys(NAMES, 2), lambda asked: [None] * 4, [NAMES]) == []


@pytest.mark.parametrize("degrees, expected", [(100, 4), (280, 8)])
def test_more_frames_are_asked_where_the_first_do_not_agree(degrees, expected):
    """Votes for the half turn contradict the shapes."""
    asked = []

    def ask(questions: list[Question]) -> list[PairHypotheses]:
        asked.extend(questions)
        return [vote(degrees, 0.9, one.reference == "second") for one in questions]

    judge_pairs(SHAPES, {"first": 4, "second": 4}, ask, [NAMES])
    assert len(asked) == len(set(asked)) == expected
    assert {one.rank for one in asked[:4]} == {0, 1}


def test_the_first_two_frames_that_are_asked_show_different_sides():
    assert asked_positions(4, 5) == [0, 2, 1, 3]
    assert asked_positions(4, 3) == [0, 2, 1]
    assert asked_positions(1, 5) == [0]


def test_points_of_one_scan_are_found_on_the_other(tmp_path):
    folder = sample_data() / "car"
    found = estimate_pose(folder / "peugeot_308", folder / "peugeot_308")
    number = next(iter(found.frames))
    frame = found.frames[number]
    # A pixel at least 12 pixels from the outline.
    inside = cv2.erode((frame.mask > 0.9).astype(np.uint8), np.ones((25, 25)))
    row, column = np.argwhere((inside > 0) & (frame.depth > 0))[0]
    pixel = {"frame": number, "x": column + 0.5, "y": row + 0.5}
    by_pixel = found.transfer(**pixel)
    world = frame.camera.unproject(np.array([column + 0.5, row + 0.5]), frame.depth[row, column])
    by_point = found.transfer(world[None])
    assert_allclose(by_pixel.world, by_point.world)
    assert np.linalg.norm(by_point.world - world) < 0.2  # the object has a standard deviation of 1
    assert by_point.confidence > 0.5
    refused("pixel 0.5,0.5 of frame 0 has no depth", found.transfer, frame=0, x=0.5, y=0.5)
    refused("frame is 1, expected one of 0,", found.transfer, frame=1)


def test_the_vertical_of_an_option_comes_before_what_the_scan_tells():
    method = ZeroShotPose(load_backbone(), solver="verified")
    path = sample_data() / "car" / "suv"
    # The second one says that the vertical is not known.
    for up, expected in (((1, 0, 0), (1, 0, 0)), ((0, 0, 0), None)):
        # One reference frame and three target views.
        found, problem = Scan.of(open_source(path, up=up), method, 1, 3).shape()
        assert (found.upright, problem) == (expected is not None, "")
        if expected:
            assert_allclose(found.from_world.R @ expected, UP, atol=1e-9)
