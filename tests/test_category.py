"""A category in one frame: pairs of frames, recovery of known poses, equivariance,
probabilities."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from zsp_lite import Sim3
from zsp_lite.metrics import rotation_error
from zsp_lite.scans.category import (
    PairHypotheses,
    partners,
    synchronise,
)

seeds = st.integers(0, 2**32 - 1)
HALF_TURN = Sim3(1.0, np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
PROBABILITIES = np.array([0.6, 0.25, 0.05, 0.03])


def similarity(rng):
    return Sim3(
        np.exp(0.3 * rng.normal()),
        Rotation.random(random_state=rng).as_matrix(),
        rng.normal(size=3),
    )


def problem(seed: int, flipped: float = 0.0) -> tuple[list[Sim3], list[PairHypotheses]]:
    """Make six poses and hypotheses of all 30 pairs; the half turn comes first in the share
    `flipped` of the pairs."""
    rng = np.random.default_rng(seed)
    truth = [similarity(rng) for _ in range(6)]
    pairs = []
    # Each object is paired with those that are 1 to 5 places after it in a circle.
    ends = [(a, (a + step) % 6) for step in 1 + rng.permutation(5) for a in range(6)]
    wrong = set(rng.permutation(len(ends))[: int(flipped * len(ends))].tolist())
    for k, (a, b) in enumerate(ends):
        right_and_turned = [
            truth[b].inverse() @ truth[a],
            truth[b].inverse() @ HALF_TURN @ truth[a],
        ]
        sim3s = (*right_and_turned[:: -1 if k in wrong else 1], similarity(rng), similarity(rng))
        pairs.append(
            PairHypotheses(f"{a:03d}", f"{b:03d}", sim3s, PROBABILITIES, rng.normal(size=3))
        )
    return truth, pairs


@settings(max_examples=3)
@given(seeds)
def test_poses_are_recovered_among_outliers_and_half_turns_in_any_order(seed):
    truth, pairs = problem(seed, flipped=0.1)
    alignment = synchronise(pairs)
    again = synchronise(pairs[::-1])
    # The first object has the rotation of the frame and lies at its origin; the mean logarithm of
    # the scales is zero.
    scale = np.exp(np.mean(np.log([one.scale for one in truth])))
    for (name, one), true in zip(alignment.objects.items(), truth, strict=True):
        expected = Sim3(truth[0].scale / scale, np.eye(3), np.zeros(3)) @ truth[0].inverse() @ true
        assert_allclose(one.sim3.matrix, expected.matrix, atol=0.3)  # outliers have a say
        assert_array_equal(one.sim3.matrix, again.objects[name].sim3.matrix)
    assert len(alignment.disagreements) == 3  # a tenth of the pairs
    assert min(alignment.disagreements.values()) > 150


def test_contradictory_evidence_lowers_the_probability_and_names_the_other_turn():
    _, pairs = problem(3)
    before = synchronise(pairs).objects["004"]
    of_object = [k for k, one in enumerate(pairs) if "004" in (one.reference, one.target)]
    for k in of_object[:4]:  # of ten: the half turn comes first
        pairs[k] = replace(pairs[k], sim3s=tuple(pairs[k].sim3s[m] for m in (1, 0, 2, 3)))
    after = synchronise(pairs).objects["004"]
    assert after.probability < before.probability - 0.1
    assert rotation_error(after.sim3.R, after.alternative.R) > 170
    assert after.alternative_probability > before.alternative_probability + 0.1
    assert_allclose(
        after.alternative.apply(after.centre), after.sim3.apply(after.centre), atol=1e-6
    )


# By default all others below twelve objects, and six from there on.
@pytest.mark.parametrize(
    "n, given, per_object",
    [(2, None, 1), (4, None, 3), (11, None, 10), (12, None, 6), (40, None, 6), (6, 4, 4)],
)
def test_pairs_connect_all_objects_and_every_object_has_the_same_number_of_partners(
    n, given, per_object
):
    names = [f"{k:02d}" for k in range(n)]
    pairs = partners(names, given)
    assert pairs == partners(names[::-1], given) == sorted(set(pairs))
    ends = np.array(pairs, int)
    assert (ends[:, 0] < ends[:, 1]).all()
    assert_array_equal(np.bincount(ends.ravel()), np.full(n, per_object))
    assert connected_components(coo_array((np.ones(len(ends)), ends.T), (n, n)))[0] == 1


def test_one_pair_keeps_its_own_probabilities():
    pair = problem(0)[1][0]
    objects = synchronise([pair]).objects.values()
    for one in objects:
        assert (one.probability, one.alternative_probability) == (0.6, 0.25)


def test_pairs_that_do_not_connect_all_objects_are_refused():
    pair = problem(0)[1][0]
    refused("connect 2 of 4", lambda: synchronise([pair, replace(pair, reference="x", target="y")]))
