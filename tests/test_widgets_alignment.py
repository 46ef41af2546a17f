"""The captions of the widgets on alignment agree with the library at the values of the sliders."""

import numpy as np
import pytest
from matplotlib import pyplot as plt

from zsp_lite.alignment import Sim3, ransac, umeyama
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error

pytest.importorskip("ipywidgets", reason="widgets are an optional extra: pip install 'zsp-lite[notebooks]'")

from zsp_lite.widgets.alignment import one_outlier, ransac_settings

pytestmark = pytest.mark.slow

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    plt.close("all")


def matched_points(outliers=10, noise=0.03):
    rng = np.random.default_rng(0)
    source = rng.normal(size=(40, 3))
    target = Sim3(1.3, TURN, np.ones(3)).apply(source) + noise * rng.normal(size=(40, 3))
    target[:outliers] = rng.normal(size=(outliers, 3)) * 2
    return source, target


def build(points, truth=TURN):
    pixels = np.random.default_rng(1).uniform(0, 60, (2, len(points[0]), 2))
    images = np.zeros((60, 60, 3)), np.ones((60, 60, 3))
    return ransac_settings(images, tuple(pixels), points, truth)


def test_the_caption_agrees_with_ransac():
    points = matched_points()
    widget = build(points)
    for trials, threshold, seed in ((1000, 0.2, 0), (5, 0.1, 3), (100, 0.9, 7)):
        widget.controls["trials"].value = trials
        widget.controls["threshold"].value = threshold
        widget.controls["seed"].value = seed
        sim3, inliers = ransac(*points, threshold, trials, seed=seed, scale_range=(0.2, 5))
        assert f"{inliers.sum()} of 40 matches are inliers; scale {sim3.scale:.2f}" in widget.caption.value
        assert f"rotation error {rotation_error(sim3.R, TURN):.0f}°" in widget.caption.value


def test_every_control_redraws_the_inliers():
    widget = build(matched_points(outliers=20, noise=0.1))
    for name, position in {"threshold": 0.04, "trials": 1, "seed": 4}.items():
        before = widget.picture.value
        widget.controls[name].value = position
        assert widget.picture.value != before, name


def test_without_ground_truth_there_is_no_error():
    assert "error" not in build(matched_points(), truth=None).caption.value


def test_points_on_a_line_give_a_caption_instead_of_a_traceback():
    line = np.outer(np.arange(8.0), [1, 2, 3])
    assert build((line, line)).caption.value.startswith("No fit: ")


def test_three_matches_are_an_input_error():
    with pytest.raises(InputError, match="at least four"):
        build(tuple(part[:3] for part in matched_points()))


def test_the_caption_agrees_with_least_squares():
    source = np.random.default_rng(2).normal(size=(9, 3))
    widget = one_outlier(source, source)
    assert "rotation changes by 0.0°" in widget.caption.value
    widget.controls["distance"].value = 3.0
    target = source.copy()
    target[-1, 0] += 3.0
    fit = umeyama(source, target)
    assert f"rotation changes by {rotation_error(fit.R, np.eye(3)):.1f}°" in widget.caption.value
    assert f"to {fit.scale:.2f}" in widget.caption.value


def test_moving_the_outlier_redraws_the_figure():
    source = np.random.default_rng(2).normal(size=(9, 3))
    widget = one_outlier(source, source)
    before = widget.picture.value
    widget.controls["distance"].value = 2.0
    assert widget.picture.value != before
