"""The widgets on matching agree with the library."""

import matplotlib
import numpy as np
import pytest

from zsp_lite.matchers import MATCHERS
from zsp_lite.matching import cyclical_distances, match, similarity
from zsp_lite.synthetic.ground_truth import correct_matches

pytest.importorskip("ipywidgets", reason="widgets need ipywidgets: pip install 'zsp-lite[notebooks]'")
matplotlib.use("agg")

from tools import widget_examples as examples
from zsp_lite.widgets import matching  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def views():
    return examples.sample_views()


@pytest.fixture(scope="module")
def sim(views):
    return similarity(*(view.features for view in views))


def test_the_cycle_has_the_cyclical_distance(views, sim):
    widget = matching.cycle(*views, sim)
    distances = -cyclical_distances(sim, (28, 28), (28, 28)).numpy()
    for row, col in ((14, 14), (20, 8), (3, 25)):
        widget.controls["row"].value, widget.controls["col"].value = row, col
        assert f"u ({row}, {col}) →" in widget.caption.value
        assert f"d(u, u') = {distances[row, col]:.1f} patches" in widget.caption.value


def test_the_cycle_reports_patches_of_the_background(views, sim):
    widget = matching.cycle(*views, sim)
    valid = np.isfinite(cyclical_distances(sim, (28, 28), (28, 28), *(view.foreground for view in views)).numpy())
    for row, col in ((0, 0), (14, 14), (27, 13)):
        widget.controls["row"].value, widget.controls["col"].value = row, col
        assert ("not on the foreground" in widget.caption.value) == (not valid[row, col])


def test_the_first_patch_of_the_cycle_is_on_the_object(views):
    widget = examples.cycle()
    row, col = widget.controls["row"].value, widget.controls["col"].value
    assert bool(views[0].foreground[row, col])
    before = widget.picture.value
    widget.controls["row"].value = row + 3
    assert widget.picture.value != before


@pytest.mark.parametrize("matcher", ["cyclical", *MATCHERS])
def test_matches_are_compared_with_the_ground_truth(views, sim, matcher):
    truth = examples.sample_pair()
    widget = matching.matches(*views, sim, truth.cells, truth.valid)
    widget.controls["matcher"].value, widget.controls["k"].value, widget.controls["kmeans"].value = matcher, 20, False
    expected = match(views[0].features, views[1].features, 20, False, sim=sim, matcher=matcher)
    at = tuple(expected.reference.T)
    correct = (correct_matches(expected.target, truth.cells[at]) & truth.valid[at]).sum()
    text = widget.caption.value
    assert text.startswith(f"{matcher}: {len(expected)} matches, {correct} correct")
    assert f"{(~truth.valid[at]).sum()} without ground truth" in text
