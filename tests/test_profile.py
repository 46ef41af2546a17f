"""What `zsp-lite profile` measures: every stage, with its limit, and the plain loops that the stages replace."""

import numpy as np
import pytest

from zsp_lite.alignment import ransac
from zsp_lite.benchmark.plan import process_memory
from zsp_lite.cli.profile import (
    Measurement,
    made_up_frames,
    measure_ransac,
    measure_similarity,
    measure_verified_solver,
    open_annotations,
    ransac_by_loop,
)

pytestmark = pytest.mark.slow


def test_the_loop_that_ransac_is_timed_against_finds_as_good_a_pose():
    rng = np.random.default_rng(1)
    source = rng.normal(size=(50, 3))
    target = source + 0.02 * rng.normal(size=(50, 3))
    target[:30] = rng.normal(size=(30, 3))
    loop, batch = ransac_by_loop(source, target), ransac(source, target)[1]
    assert loop[30:].all() and batch[30:].all()
    assert abs(loop.sum() - batch.sum()) <= 1


def test_ransac_is_timed_against_the_loop():
    fast, loop, ratio = measure_ransac(repeats=1)
    assert loop.value / fast.value == pytest.approx(ratio.value)
    # A limit on the ratio is for an idle machine; here only that the batch is the faster one by far.
    assert ratio.value > 4


def test_a_measurement_says_whether_it_keeps_its_limit():
    assert not Measurement("x", 2, "s", 1).within_limit and Measurement("x", 2, "s", 1, at_most=False).within_limit
    assert Measurement("x", 2, "s").within_limit
    assert "at most 1, MISSED" in str(Measurement("x", 2, "s", 1)) and "MISSED" not in str(Measurement("x", 1, "s", 1))


def test_the_verified_solver_is_timed_and_has_a_limit():
    row = measure_verified_solver(repeats=1)
    assert row.name == "verified solver, N = 5" and row.limit == 300 and row.at_most and row.value > 1


def test_a_similarity_by_algebra_is_timed_against_the_loop():
    rows = measure_similarity(repeats=1, tokens=1)
    assert rows[-1].value > 30 and "of 784 tokens" in rows[1].note


def test_made_up_frames_have_an_object_and_holes_in_its_depth():
    frames = made_up_frames(2, (120, 160))
    assert (frames[0].rgb != frames[1].rgb).any()
    holes = (frames[0].depth == 0) & (frames[0].mask > 0)
    assert 0.1 < holes.sum() / (frames[0].mask > 0).sum() < 0.6


def test_peak_memory_is_that_of_this_process():
    assert 2**26 < process_memory() < 2**36


def test_opening_a_category_costs_little_more_than_its_json():
    figures = open_annotations(8600)
    assert figures["frames"] == 8600
    assert 1.0 < figures["json_mb"] / 8600 * 1000 < 1.3  # real entries have about 1.2 kB
    # A tenth of the bounds for 86,000 frames (3 s, 400 MB), with room for a busy machine.
    assert figures["seconds"] < 1 and figures["extra_memory_mb"] < 60
