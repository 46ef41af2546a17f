"""Matchers against their definitions, worked out another way:

POT for the transport, loops for mutual neighbours.
"""

import numpy as np
import ot
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from test_matching import feature_map

from zsp_lite.matchers import MATCHERS, dual_softmax, sinkhorn
from zsp_lite.matching import key_similarities, match


def similarities(seed: int = 0, n1: int = 12, n2: int = 15) -> torch.Tensor:
    return torch.rand(n1, n2, generator=torch.Generator().manual_seed(seed))


def masks() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.arange(12) % 4 > 0, torch.arange(15) % 3 > 0


def test_the_transport_plan_is_pots():
    sim = similarities()
    uniform = [np.full(n, 1 / n) for n in sim.shape]
    expected = ot.sinkhorn(
        *uniform, 1 - sim.double().numpy(), reg=0.05, numItermax=5000, stopThr=1e-14
    )
    assert np.abs(sinkhorn(1 - sim, 0.05, 5000).numpy() - expected).max() < 1e-9


def test_the_dual_softmax_is_the_product_of_two_softmaxes():
    sim = similarities()
    product = (sim / 0.1).softmax(0) * (sim / 0.1).softmax(1)
    partner, score = dual_softmax(sim)
    assert_array_equal(partner, product.argmax(1))
    assert_allclose(score.exp().numpy(), product.max(1).values.numpy(), rtol=1e-4)


def test_mutual_neighbours_are_each_others_choice_among_the_objects_patches():
    sim, (on1, on2) = similarities(), masks()
    partner, score = MATCHERS["mutual"](sim, on1, on2)
    hidden = sim.clone()
    hidden[~on1] = hidden[:, ~on2] = -1
    for u in range(len(sim)):
        v = int(hidden[u].argmax())
        if on1[u] and int(hidden[:, v].argmax()) == u:
            assert partner[u] == v
            assert score[u] == sim[u, v]
        else:
            assert score[u] == -torch.inf


@pytest.mark.parametrize("name", MATCHERS)
def test_partners_are_on_the_objects_and_nothing_is_found_without_one(name):
    sim, (on1, on2) = similarities(), masks()
    partner, score = MATCHERS[name](sim, on1, on2)
    found = score.isfinite()
    assert found.any()
    assert on1[found].all()
    assert on2[partner[found]].all()
    assert not MATCHERS[name](sim, on1, torch.zeros_like(on2))[1].isfinite().any()


@pytest.mark.parametrize("name", MATCHERS)
def test_every_matcher_finds_an_image_in_itself(name):
    features = feature_map(3)
    for kmeans in (False, True):
        found = match(features, features, k=10, kmeans=kmeans, matcher=name)
        assert len(found) == 10
        assert_array_equal(found.reference, found.target)
        assert_allclose(found.similarity, np.ones(10), atol=1e-5)


def test_plain_similarity_is_the_cosine_of_the_keys():
    first, second = feature_map(5), feature_map(6)
    (found,) = key_similarities(first, [second])
    u, v = first.keys[2, 3], second.keys[4, 5]
    assert_allclose(found[2 * 9 + 3, 4 * 9 + 5], float(u @ v / u.norm() / v.norm()), atol=1e-6)
