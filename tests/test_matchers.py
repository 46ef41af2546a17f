"""Matchers against their definitions, worked out another way.

The transport is that of the package POT; mutual neighbours are found by a loop.
"""

import numpy as np
import ot
import pytest
import torch
import torch.nn.functional as F
from numpy.testing import assert_allclose, assert_array_equal
from test_matching import feature_map

from zsp_lite.matchers import MATCHERS, SOFTMAX_TEMPERATURE, dual_softmax, sinkhorn
from zsp_lite.matching import key_similarities, match

# Similarities of the 12 patches of one image and the 15 of another, and which patches are on the
# object: not every fourth of the first image, nor every third of the second.
SIMILARITIES = torch.rand(12, 15, generator=torch.Generator().manual_seed(0))
ON_FIRST = torch.arange(12) % 4 > 0
ON_SECOND = torch.arange(15) % 3 > 0


def test_the_transport_plan_is_pots():
    uniform = [np.full(n, 1 / n) for n in SIMILARITIES.shape]
    cost = 1 - SIMILARITIES.double()
    # So many steps that both have converged.
    steps = 5000
    expected = ot.sinkhorn(*uniform, cost.numpy(), reg=0.05, numItermax=steps, stopThr=1e-14)
    assert_allclose(sinkhorn(cost, 0.05, steps).numpy(), expected, rtol=0, atol=1e-9)


def test_the_dual_softmax_is_the_product_of_two_softmaxes():
    logits = SIMILARITIES / SOFTMAX_TEMPERATURE
    product = logits.softmax(0) * logits.softmax(1)
    partner, score = dual_softmax(SIMILARITIES)
    assert_array_equal(partner, product.argmax(1))
    assert_allclose(score.exp().numpy(), product.max(1).values.numpy(), rtol=1e-4)


def test_mutual_neighbours_are_each_others_choice_among_the_objects_patches():
    partner, score = MATCHERS["mutual"](SIMILARITIES, ON_FIRST, ON_SECOND)
    # Patches off the object are less similar than all others.
    hidden = SIMILARITIES.clone()
    hidden[~ON_FIRST] = hidden[:, ~ON_SECOND] = -1
    for u in range(len(hidden)):
        v = int(hidden[u].argmax())
        if ON_FIRST[u] and int(hidden[:, v].argmax()) == u:
            assert partner[u] == v
            assert score[u] == SIMILARITIES[u, v]
        else:
            assert score[u] == -torch.inf


@pytest.mark.parametrize("name", MATCHERS)
def test_matched_patches_and_their_partners_are_on_the_object(name):
    partner, score = MATCHERS[name](SIMILARITIES, ON_FIRST, ON_SECOND)
    matched = score.isfinite()
    assert matched.any()
    assert ON_FIRST[matched].all()
    assert ON_SECOND[partner[matched]].all()
    _, without = MATCHERS[name](SIMILARITIES, ON_FIRST, torch.zeros_like(ON_SECOND))
    assert not without.isfinite().any()


@pytest.mark.parametrize("name", MATCHERS)
def test_every_matcher_finds_an_image_in_itself(name):
    features = feature_map(3)
    matches = match(features, features, k=10, matcher=name)
    assert len(matches) == 10
    assert_array_equal(matches.reference, matches.target)
    assert_allclose(matches.similarity, np.ones(10), atol=1e-5)


def test_plain_similarity_is_the_cosine_of_the_keys():
    first, second = feature_map(5), feature_map(6)
    (sim,) = key_similarities(first, [second])
    cosine = F.cosine_similarity(first.keys[2, 3], second.keys[4, 5], dim=0)
    # Patches are counted by rows of 9.
    assert_allclose(sim[2 * 9 + 3, 4 * 9 + 5], cosine, atol=1e-6)
