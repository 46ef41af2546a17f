"""Damage does what it says, and only that; what is called exact is exact."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_views import CoordinateBackbone, look_at, render

from zsp_lite.alignment import Sim3
from zsp_lite.benchmark.methods import GROUPS, METHODS, fingerprint
from zsp_lite.benchmark.problem import Problem
from zsp_lite.benchmark.robustness import (
    DAMAGES,
    Damaged,
    depth_noise,
    holes,
    mask_error,
    nothing,
    object_spread,
    pose_noise,
)
from zsp_lite.benchmark.store import FrameStore
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.pairs import sample_pairs
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.synthetic.exact import exact_frame
from zsp_lite.synthetic.export import export_categories, make_object, make_sequence


@pytest.fixture(scope="module")
def frame():
    return render(look_at((1, 0.6, 0.4)), Sim3.identity(), "pebble")


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_the_spread_is_that_of_the_points_on_the_object(frame):
    row, column = np.nonzero(frame.mask)
    points = frame.camera.unproject_camera(np.stack([column + 0.5, row + 0.5], -1), frame.depth[row, column])
    expected = np.sqrt(np.mean([np.var(points[:, axis]) for axis in range(3)]))
    assert object_spread(frame) == pytest.approx(expected, rel=1e-5)
    assert object_spread(replace(frame, mask=None)) == pytest.approx(expected, rel=1e-5)  # depth is 0 off the object


def test_holes_take_three_tenths_and_leave_the_rest_alone(frame, rng):
    whole = replace(frame, depth=np.full_like(frame.depth, 3.0))
    pierced = holes(whole, rng).depth
    assert (pierced == 0).mean() == pytest.approx(0.3, abs=0.001)
    assert (pierced[pierced > 0] == 3).all()
    # In patches, not as salt and pepper: neighbours agree.
    assert ((pierced[1:] > 0) == (pierced[:-1] > 0)).mean() > 0.95


def test_depth_noise_is_a_tenth_of_the_spread_and_fills_no_holes(frame, rng):
    noisy = depth_noise(frame, rng).depth
    known = frame.depth > 0
    assert ((noisy > 0) == known).all()
    assert np.std(noisy[known] - frame.depth[known]) == pytest.approx(0.1 * object_spread(frame), rel=0.15)


@pytest.mark.parametrize("pixels", [4, 8])
def test_a_masks_outline_is_off_by_so_many_pixels(frame, rng, pixels):
    """The area between the outlines, per pixel of outline, is the mean absolute error: sqrt(2 / pi) of the r.m.s."""
    ratios = []
    for _ in range(8):
        spoilt = mask_error(pixels)(frame, rng).mask
        padded = np.pad(frame.mask, 1) > 0.5
        length = sum((padded != np.roll(padded, 1, axis)).sum() for axis in (0, 1)) * np.pi / 4
        ratios.append((spoilt != frame.mask).sum() / length)
        assert set(np.unique(spoilt)) <= {0, 1}
    assert np.mean(ratios) == pytest.approx(pixels * np.sqrt(2 / np.pi), rel=0.3)


def test_a_mask_never_vanishes_and_has_to_be_there(frame, rng):
    dot = np.zeros_like(frame.mask)
    dot[70, 90] = 1
    assert all(mask_error(8)(replace(frame, mask=dot), rng).mask.any() for _ in range(10))
    with pytest.raises(InputError, match="pebble: no mask, expected one"):
        mask_error(8)(replace(frame, mask=None), rng)
    with pytest.raises(InputError, match="pebble: no known depth"):
        depth_noise(replace(frame, depth=np.zeros_like(frame.depth)), rng)


def test_a_cameras_noise_is_a_degree_and_a_hundredth_of_its_distance(frame, rng):
    away = float(np.median(frame.depth[frame.depth > 0]))
    for _ in range(5):
        camera = pose_noise(frame, rng).camera
        assert rotation_error(camera.R, frame.camera.R) == pytest.approx(1, abs=1e-3)
        turn = camera.R @ frame.camera.R.T
        assert np.linalg.norm(turn.T @ camera.t - frame.camera.t) == pytest.approx(0.01 * away, rel=1e-6)
    assert nothing(frame, rng) is frame


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("synthetic")
    export_categories(["camera"], root, 2, 6, 5, 96)
    return root


def test_exact_depth_and_mask_are_the_renderers(folder):
    """The export spoils what the renderer saw as a sensor would; made again from the object it is whole."""
    dataset = Co3D(folder)
    name = dataset.sequences("camera")[1].sequence_name
    observed, rendered = make_sequence("camera", 1, 6, 5, 96)
    assert observed.name == name
    stored = dataset.load(dataset.frames("camera", name)[2])
    mended, seen = exact_frame(stored, folder, "camera", name), rendered.views[2]
    assert (mended.mask != seen.mask).mean() < 0.003  # pixels whose centre the outline just touches
    both = (mended.mask > 0) & seen.mask
    np.testing.assert_allclose(mended.depth[both], seen.depth[both], rtol=2e-3)
    assert (mended.depth[mended.mask == 0] == 0).all()
    assert (stored.depth[both] == 0).any()  # there was something to mend


def test_only_what_was_exported_with_the_seed_can_be_made_again(folder, ellipsoids, frame):
    with pytest.raises(InputError, match="does not exist in an export with seed 6"):
        make_object("camera", Co3D(folder).sequences("camera")[0].sequence_name, 6)
    with pytest.raises(InputError, match="expected a folder made by zsp-lite synth"):
        exact_frame(frame, ellipsoids.root, "ellipsoid", "a")


SETTINGS = {"solver": "verified", "foreground": "mask"}


@pytest.fixture(scope="module")
def problem(ellipsoids):
    (pair, *_) = sample_pairs(ellipsoids, "ellipsoid", 2, 2, 0)
    store = FrameStore(ellipsoids, "ellipsoid", {"backbone": CoordinateBackbone(grid=8)})
    return Problem(pair, store)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_row_answers_from_other_views_than_the_whole_one(problem, damage):
    found = Damaged(damage, SETTINGS)(problem)
    whole = problem.estimate(settings=SETTINGS)
    assert (found.sim3.matrix != whole.sim3.matrix).any()
    assert rotation_error(found.sim3.R, whole.sim3.R) < 30 or found.view != whole.view


def test_damage_is_the_same_whenever_the_pair_is(problem):
    first, again = (Damaged("holes")(problem) for _ in range(2))
    assert (first.sim3.matrix == again.sim3.matrix).all()
    assert (first.reference_view.frame.depth == again.reference_view.frame.depth).all()


def test_damages_of_names_of_one_length_draw_different_noise(problem, monkeypatch):
    monkeypatch.setitem(DAMAGES, "seloh", DAMAGES["holes"])
    first, second = (Damaged(name)(problem).reference_view.frame.depth for name in ("holes", "seloh"))
    assert (first != second).any()


def test_every_damage_has_a_row_of_both_solvers_with_a_fingerprint_of_its_own():
    rows = [f"{solver}-{name}" for solver in ("ours", "verified") for name in ("clean", *DAMAGES)]
    assert set(rows) <= set(METHODS) and set(rows) <= set(GROUPS["robustness"])
    assert len({fingerprint(METHODS[row]) for row in rows}) == len(rows)
    # Only the rows that are told the mask can be harmed by a wrong one.
    assert all((METHODS[row].solve.settings.get("foreground") == "mask") == ("mask" in row) for row in rows)
