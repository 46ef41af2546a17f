"""The widgets on matching show the cycle and the matches that the library computes."""

import time

import matplotlib
import numpy as np
import pytest

from zsp_lite.matchers import MATCHERS
from zsp_lite.matching import cyclical_distances, match, similarity
from zsp_lite.synthetic.ground_truth import correct_matches

pytest.importorskip("ipywidgets", reason="widgets need ipywidgets: pip install 'zsp-lite[notebooks]'")
matplotlib.use("agg")

from zsp_lite.widgets import common, latency, matching  # noqa: E402


@pytest.fixture(scope="module")
def views():
    return common.example_pair()


@pytest.fixture(scope="module")
def sim(views):
    return similarity(*(view.features for view in views))


def test_the_cycle_says_the_distance_of_the_map(views, sim):
    widget = matching.cycle(*views, sim)
    distances = -cyclical_distances(sim, (28, 28), (28, 28)).numpy()
    for row, col in ((14, 14), (20, 8), (3, 25)):
        widget.controls["row"].value, widget.controls["col"].value = row, col
        assert f"u ({row}, {col}) →" in widget.sentence.value
        assert f"d(u, u') = {distances[row, col]:.1f} patches" in widget.sentence.value


def test_the_cycle_says_when_it_leaves_the_foreground(views, sim):
    widget = matching.cycle(*views, sim)
    valid = np.isfinite(cyclical_distances(sim, (28, 28), (28, 28), *(view.foreground for view in views)).numpy())
    for row, col in ((0, 0), (14, 14), (27, 13)):
        widget.controls["row"].value, widget.controls["col"].value = row, col
        assert ("off the foreground" in widget.sentence.value) == (not valid[row, col])


def test_the_cycle_starts_at_a_patch_of_the_object_that_returns_a_picture(views, sim):
    widget = matching.cycle(*views, sim)
    row, col = widget.controls["row"].value, widget.controls["col"].value
    assert bool(views[0].foreground[row, col])
    before = widget.picture.value
    widget.controls["row"].value = row + 3
    assert widget.picture.value != before


@pytest.mark.parametrize("way", ["cyclical", *MATCHERS])
def test_matches_are_counted_against_the_truth(views, sim, way):
    truth = common.example_truth()
    widget = matching.matches(*views, sim, truth.cells, truth.valid)
    widget.controls["way"].value, widget.controls["k"].value, widget.controls["kmeans"].value = way, 20, False
    expected = match(views[0].features, views[1].features, 20, False, sim=sim, matcher=way)
    at = tuple(expected.reference.T)
    right = (correct_matches(expected.target, truth.cells[at]) & truth.valid[at]).sum()
    said = widget.sentence.value
    assert (
        said.startswith(f"{way}: {len(expected)} matches, {right} right")
        and f"{(~truth.valid[at]).sum()} without" in said
    )


@pytest.mark.parametrize("name", ["cycle", "matches"])
def test_an_answer_costs_less_than_the_limit(name):
    # This process's own work: the machine may be busy with other things.
    for control, milliseconds in latency.measure(latency.build_example(name), 3, time.process_time).items():
        assert milliseconds < latency.LIMIT, control
